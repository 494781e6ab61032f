"""Bodies with nodes of their own from meshes whose bodies share those at their interfaces.

Programs for meshes that cut solids along their common surfaces, such as `fragment` of Gmsh, make
conforming meshes: bodies share nodes and facets. For contact each needs nodes of its own. At each
node on the surfaces that are opened, the cells around it fall into groups that are connected
through facets that stay closed. Each group gets a copy of the node. Thus bodies separate where
three of them meet, and nodes at the tip of a crack, around which all cells are connected, stay one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mpi4py import MPI

import numpy as np

from fenics_tfeti.errors import InputError, check_value
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.geometry.normals import facet_normals
from fenics_tfeti.fem.io.tagged_mesh import (
    Names,
    TaggedMesh,
    WholeMesh,
    distribute,
    tags_by_corners,
)
from fenics_tfeti.fem.messages import first_wrong
from fenics_tfeti.fem.topology import (
    NO_TAG,
    cells_of_facets,
    connected_labels,
    dense_tags,
    distinct_rows,
    facet_corners,
    owned_cells,
    tag_names,
)
from fenics_tfeti.parallel import positions, raise_collectively
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class Interface:
    """The surface between two bodies that share its nodes, or a plane cut in a body, to be opened.

    Attributes
    ----------
    bodies : pair of int or str
        The two bodies: tags of cells, or their names. Twice the same one for a cut through it, such
        as the shank of a bolt, along `facets` that are nearly in a plane.
    tags : pair of int or str
        The tags that the surfaces of the first and of the second body get. For a name, a tag is
        chosen that is not used yet, and the name is added to those of the mesh. Several interfaces
        may have a tag in common.
    facets : int or str, optional
        Tag or name of the facets to open; those of them that are between the two bodies are. By
        default all facets between the two bodies.

    Examples
    --------
    >>> Interface(("bolt", "block"), ("shank", "hole")).facets
    """

    bodies: tuple[int | str, int | str]
    tags: tuple[int | str, int | str]
    facets: int | str | None = None

    def __post_init__(self) -> None:
        for name in ("bodies", "tags"):
            pair = getattr(self, name)
            valid = isinstance(pair, list | tuple) and len(pair) == 2
            check_value(valid, f"Interface: {name}", pair, "a pair of integers or names")
            object.__setattr__(self, name, tuple(pair))


def split_interfaces(tagged: TaggedMesh, interfaces: Sequence[Interface]) -> TaggedMesh:
    """Give bodies nodes of their own at the interfaces between them. Collective.

    Rank 0 gathers the cells, as many as it reads from a file of Gmsh.

    Parameters
    ----------
    tagged : TaggedMesh
        A mesh whose bodies share nodes and facets, as `fragment` of Gmsh makes it.
    interfaces : sequence of Interface
        The surfaces to open. Facets between bodies that are in none of them stay as they are. Nodes
        at the border of a surface that ends inside the mesh, such as the tip of a crack, are not
        doubled.

    Returns
    -------
    TaggedMesh
        A new mesh, distributed anew. Each facet of an interface is there twice, on the boundary of
        each body, with the `tags` of the interface in place of its own. All other tags
        and all names are kept.

    Raises
    ------
    InputError
        On all ranks: unknown tags or names, bodies that share no such facet, a facet in two
        interfaces, new tags that other facets have, or facets with all nodes at the border of the
        interface, which would stay closed.

    Examples
    --------
    >>> parts = read_msh("bolt_in_block.msh")  # doctest: +SKIP
    >>> shank = Interface(("bolt", "block"), (11, 12))  # doctest: +SKIP
    >>> parts = split_interfaces(parts, [shank])  # doctest: +SKIP
    >>> ContactPair(parts.facet_tags, slave=11, master=12)  # doctest: +SKIP
    """
    comm, whole = tagged.mesh.comm, gather_mesh(tagged)
    with raise_collectively(comm):
        if whole is not None:
            whole = open_interfaces(whole, interfaces)
    return distribute(comm, whole)


def open_interfaces(whole: WholeMesh, interfaces: Sequence[Interface]) -> WholeMesh:
    """Return the mesh with the interfaces opened."""
    openings, names = _openings(whole, interfaces)
    corners = whole.nodes[:, np.array(whole.kind.facets)]
    facets = distinct_rows(np.sort(corners, axis=2).reshape(-1, corners.shape[2]))[1]
    facets = facets.reshape(corners.shape[:2])
    opened = _opened_facets(whole, facets, openings)
    facet_tag = _new_facet_tags(whole, opened, openings)
    nodes, x = _separated(whole, facets, opened)
    return replace(whole, nodes=nodes, x=x, facet_tag=facet_tag, names=names)


# -- the surfaces on rank 0 --------------------------------------------------------------------


def gather_mesh(tagged: TaggedMesh) -> WholeMesh | None:
    """Gather a mesh on rank 0, in the order of its input; the others get None. Collective."""
    mesh, owned = tagged.mesh, owned_cells(tagged.mesh)
    geometry = _compat.geometry_cells(mesh)[:owned]
    # dolfinx 0.5 may number a node that two ranks share twice; the input's numbers are unique
    numbers = np.asarray(mesh.geometry.input_global_indices, dtype=np.int64)
    tagged_facets = facet_corners(mesh, *cells_of_facets(mesh, tagged.facet_tags.indices))
    columns = (
        _compat.input_cells(mesh),
        numbers[geometry],
        mesh.geometry.x[geometry, : mesh.geometry.dim],
        dense_tags(tagged.cell_tags, owned),
        numbers[tagged_facets],
        tagged.facet_tags.values,
    )
    ranks = mesh.comm.gather(columns)
    if ranks is None:
        return None
    order, nodes, x, cell_tag, corners, values = map(np.concatenate, zip(*ranks, strict=True))
    order = np.argsort(order)
    distinct, first, rows = np.unique(nodes[order], return_index=True, return_inverse=True)
    nodes, cell = rows.reshape(nodes.shape), _compat.cell_name(mesh)
    return WholeMesh(
        cell,
        _compat.geometry_degree(mesh),
        nodes,
        x[order].reshape(-1, mesh.geometry.dim)[first],
        cell_tag[order],
        tags_by_corners(cell, nodes, positions(distinct, corners), values)[0],
        tagged.names,
        dict(tag_names(tagged.cell_tags)),
    )


def _label(opening: Interface) -> str:
    """Return how messages call the facets of an interface."""
    where = "" if opening.facets is None else f" with tag {opening.facets}"
    return f"facets{where} between the bodies {opening.bodies[0]} and {opening.bodies[1]}"


def _openings(
    whole: WholeMesh, interfaces: Sequence[Interface]
) -> tuple[list[Interface], dict[str, int]]:
    """Return interfaces with tags in place of names, and all names."""
    cell_tags, facet_tags = (
        tags[tags != NO_TAG] for tags in map(np.unique, (whole.cell_tag, whole.facet_tag))
    )
    names = Names(whole.names)
    numbers = [t for i in interfaces for t in i.tags if not isinstance(t, str)]
    free = 1 + max([0, *numbers, *(int(t.max(initial=0)) for t in (cell_tags, facet_tags))])
    added: dict[str, int] = {}

    def new_tag(tag: int | str) -> int:
        if not isinstance(tag, str):
            return int(tag)
        if tag in names:
            raise InputError(
                f"the new surface '{tag}' has the name of a body or surface that the mesh has "
                "already; choose another, or pass a number"
            )
        return added.setdefault(tag, free + len(added))

    openings = []
    for i in interfaces:
        first, second = (_tag(t, names, cell_tags, "cell") for t in i.bodies)
        facets = None if i.facets is None else _tag(i.facets, names, facet_tags, "facet")
        tags = new_tag(i.tags[0]), new_tag(i.tags[1])
        if first == second and facets is None:
            raise InputError(
                f"{i}: both are the same body; name the facets of a plane cut, or tag "
                "the cells on one side of the surface differently, then the sides can be told apart"
            )
        if tags[0] == tags[1]:
            raise InputError(f"{i}: the two new surfaces have the same tag")
        openings.append(Interface((first, second), tags, facets))
    return openings, {**names, **added}


def _tag(tag: int | str, names: Names, existing: Numbers, kind: str) -> int:
    number = int(names[tag] if isinstance(tag, str) else tag)
    if number not in existing:
        raise InputError(f"tag {number} is on no {kind}; the {kind} tags are {existing.tolist()}")
    return number


def _opened_facets(whole: WholeMesh, facets: Numbers, openings: Sequence[Interface]) -> Numbers:
    """Return the number of the interface that each facet (m, f) of a cell is in; -1 for none."""
    flat, cell_tag = facets.ravel(), np.repeat(whole.cell_tag, facets.shape[1])
    order, count = np.lexsort((cell_tag, flat)), np.bincount(flat)
    end = np.cumsum(count)
    low, high = cell_tag[order[end - count]], cell_tag[order[end - 1]]
    facet_tag = whole.facet_tag.ravel()[order[end - 1]]
    opened = np.full(count.size, -1, dtype=np.int64)
    for k, opening in enumerate(openings):
        ends = np.sort(opening.bodies)
        selected = (low == ends[0]) & (high == ends[1]) & (count == 2)
        if opening.facets is not None:
            selected &= facet_tag == opening.facets
        if not selected.any():
            raise InputError(
                f"there are no {_label(opening)}: they do not touch, have nodes of their own "
                "already, or the tag is on other facets"
            )
        if repeated := np.count_nonzero(opened[selected] >= 0):
            first = _label(openings[opened[selected].max()])
            raise InputError(
                f"{repeated} of the {_label(opening)} are in two interfaces, also in: {first}"
            )
        opened[selected] = k
    return opened[facets]


def _new_facet_tags(whole: WholeMesh, opened: Numbers, openings: Sequence[Interface]) -> Numbers:
    """Return the tags of the facets (m, f) after the split; the new ones are on no others."""
    facet_tag = whole.facet_tag.copy()
    new = [tag for o in openings for tag in o.tags]
    occupied = np.unique(facet_tag[(opened < 0) & np.isin(facet_tag, new)])
    if occupied.size:
        raise InputError(
            f"other facets have the tags {occupied.tolist()} of new surfaces; choose tags that no "
            "facet has"
        )
    for k, opening in enumerate(openings):
        cell, facet = np.nonzero(opened == k)
        if opening.bodies[0] == opening.bodies[1]:
            is_first = _on_first_side(whole, cell, facet, opening)
        else:
            is_first = whole.cell_tag[cell] == opening.bodies[0]
        facet_tag[cell, facet] = np.where(is_first, *opening.tags)
    return facet_tag


def _on_first_side(whole: WholeMesh, cell: Numbers, facet: Numbers, opening: Interface) -> Mask:
    """Tell which cells are below facets, nearly in a plane whose normal's largest part is up."""
    x, nodes = whole.x, whole.nodes[cell]
    corners = np.array(whole.kind.facet_nodes(1))[facet]
    points = x[np.take_along_axis(nodes, corners, axis=1)]
    outward = points.mean(axis=1) - x[nodes[:, : whole.kind.vertices]].mean(axis=1)
    normal = facet_normals(points)
    normal *= np.sign(np.sum(normal * outward, axis=1))[:, None]
    # the squares add up for both sides
    up = np.linalg.eigh(normal.T @ normal)[1][:, -1]
    up = up * np.sign(up[np.argmax(np.abs(up))])
    cosine = normal @ up / np.linalg.norm(normal, axis=1)
    if bad := first_wrong(MPI.COMM_SELF, np.abs(cosine) < 0.5, points.mean(axis=1)):
        raise InputError(
            f"{bad.number} of the {_label(opening)} are far from the plane of the others, the "
            f"first around {bad.place}: tag the cells on one side of the cut differently, then the "
            "sides can be told apart"
        )
    return cosine > 0.0


# -- nodes -------------------------------------------------------------------------------------


def _separated(whole: WholeMesh, facets: Numbers, opened: Numbers) -> tuple[Numbers, Vector]:
    """Return the nodes of cells, and their places, with a copy for each group of cells."""
    kind, nodes = whole.kind, whole.nodes.copy()
    cell, facet = np.nonzero(opened >= 0)
    corners = np.array(kind.facets)[facet]
    on_surface = np.zeros(len(whole.x), dtype=bool)
    on_surface[nodes[cell[:, None], corners]] = True
    split = on_surface[nodes[:, : kind.vertices]]
    group = _groups_at_vertices(whole, facets, opened, split)
    x = _copy_nodes(nodes, split, group, whole.x)
    if whole.degree == 2:
        # shared where dolfinx sees one edge or face: by cells with the same vertices around them
        around = np.full((*nodes.shape, 1 + kind.vertices), -1, dtype=np.int64)
        around[:, :, 0], near = nodes, np.zeros(nodes.shape, dtype=bool)
        for k, ends in enumerate(kind.midpoints, start=kind.vertices):
            around[:, k, 1 : 1 + len(ends)] = np.sort(nodes[:, ends], axis=1)
            near[:, k] = split[:, ends].any(axis=1)
        x = _copy_nodes(nodes, near, distinct_rows(around[near])[1], x)
    order = np.argsort(facets[cell, facet], kind="stable")
    sides = np.sort(nodes[cell[:, None], corners][order], axis=1).reshape(-1, 2, corners.shape[1])
    closed: Mask = np.all(sides[:, 0] == sides[:, 1], axis=1)
    if bad := first_wrong(MPI.COMM_SELF, closed, x[sides[:, 0]].mean(axis=1)):
        raise InputError(
            f"{bad.number} facets of the interfaces cannot be opened, the first around "
            f"{bad.place}: all their nodes are at the border of the interface, where the bodies "
            "stay together. Open more of the surface, or mesh it more finely"
        )
    return nodes, x


def _groups_at_vertices(whole: WholeMesh, facets: Numbers, opened: Numbers, split: Mask) -> Numbers:
    """Return the group of cells, joined by closed facets, at each vertex that may be split."""
    entry = np.full(split.shape, -1, dtype=np.int64)
    count = entry[split].size
    entry[split] = np.arange(count)
    corners = np.array(whole.kind.facets)
    cell, facet, k = np.nonzero(split[:, corners] & (opened < 0)[:, :, None])
    vertex = corners[facet, k]
    joint = distinct_rows(np.column_stack([facets[cell, facet], whole.nodes[cell, vertex]]))[1]
    size = count + int(joint.max(initial=-1)) + 1
    return connected_labels(np.column_stack([entry[cell, vertex], count + joint]), size)[:count]


def _copy_nodes(nodes: Numbers, chosen: Mask, group: Numbers, x: Vector) -> Vector:
    """Give each group of chosen entries of a table of nodes one of its own; return all places.

    The entries of a group are of one node. Its first group keeps its number.
    """
    cell, column = np.nonzero(chosen)
    _, first, group = np.unique(group, return_index=True, return_inverse=True)
    number = nodes[cell[first], column[first]]
    copied = np.ones(number.size, dtype=bool)
    copied[np.unique(number, return_index=True)[1]] = False
    places: Vector = np.concatenate([x, x[number[copied]]])
    number[copied] = len(x) + np.arange(np.count_nonzero(copied))
    nodes[cell, column] = number[group]
    return places

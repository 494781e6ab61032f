"""Bodies with nodes of their own from meshes whose bodies share those at their interfaces.

Programs for meshes that cut solids along their common surfaces, such as `fragment` of Gmsh, make
conforming meshes: bodies share nodes and facets. For contact each needs nodes of its own. At each
node on the surfaces that are opened, the cells around it fall into groups that are connected
through facets that stay closed. Each group gets a copy of the node. Thus bodies separate where
three of them meet, and nodes at the tip of a crack, around which all cells are connected, stay one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.surfaces.oriented import corner_normals, oriented_corners
from fenics_tfeti.fem.io.tagged_mesh import TaggedMesh, sorted_tags
from fenics_tfeti.fem.messages import first_wrong
from fenics_tfeti.fem.topology import cell_facets, cell_type, global_numbers, owned_cells
from fenics_tfeti.parallel import Directory, concatenate_ranks, first_of_rank, raise_collectively
from fenics_tfeti.typing import Mask, Numbers, Vector

_UNTAGGED = int(np.iinfo(np.int32).min)


@dataclass(frozen=True)
class Interface:
    """The surface between two bodies that share its nodes, or a plane cut in a body, to be opened.

    Attributes
    ----------
    slave, master : int or str
        The bodies: tags of cells, or their names. Twice the same one for a cut through it, such as
        the shank of a bolt, along `facets` that are nearly in a plane.
    slave_tag, master_tag : int or str
        The tags that the two new surfaces get. For a name, a tag is chosen that is not used yet,
        and the name is added to those of the mesh. Several interfaces may have a tag in common.
    facets : int or str, optional
        Tag or name of the facets to open; those of them that are between the two bodies are. By
        default all facets between the two bodies.

    Examples
    --------
    >>> Interface("bolt", "block", slave_tag="shank", master_tag="hole").facets
    """

    slave: int | str
    master: int | str
    slave_tag: int | str
    master_tag: int | str
    facets: int | str | None = None


def split_interfaces(tagged: TaggedMesh, interfaces: Sequence[Interface]) -> TaggedMesh:
    """Give bodies nodes of their own at the interfaces between them. Collective.

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
        each body, with the tags `slave_tag` and `master_tag` in place of its own. All other tags
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
    >>> shank = Interface("bolt", "block", slave_tag=11, master_tag=12)  # doctest: +SKIP
    >>> parts = split_interfaces(parts, [shank])  # doctest: +SKIP
    >>> ContactPair(parts.facet_tags, slave=11, master=12)  # doctest: +SKIP
    """
    mesh = tagged.mesh
    openings, names = _openings(tagged, interfaces)
    sides = _FacetSides.from_mesh(tagged)
    opened = _opened_facets(mesh, sides, openings)
    _check_new_tags(mesh.comm, sides, opened, openings)
    cells, points = _renumbered(mesh, sides, opened)
    _check_open(mesh, sides, opened, cells)

    facet_tags = sides.facet_tag.copy()
    for k, opening in enumerate(openings):
        cell, facet = np.nonzero(opened == k)
        if opening.slave == opening.master:
            on_slave = _on_first_side(mesh, cell, facet, opening)
        else:
            on_slave = sides.cell_tag[cell] == opening.slave
        facet_tags[cell, facet] = np.where(on_slave, opening.slave_tag, opening.master_tag)
    split = _compat.distributed_mesh(
        mesh.comm, cells, points, _compat.cell_name(mesh), _compat.geometry_degree(mesh)
    )
    return _with_tags(split, sides.cell_tag, facet_tags, names)


def _on_first_side(mesh: Mesh, cell: Numbers, facet: Numbers, opening: _Opening) -> Mask:
    """Tell which cells are below facets of theirs that are nearly in a plane. Collective.

    The plane's normal points upwards: its largest component is positive.
    """
    points = mesh.geometry.x[oriented_corners(mesh, cell, facet), : mesh.geometry.dim]
    normal = corner_normals(points).sum(axis=1)
    every = concatenate_ranks(mesh.comm, normal)
    # the squares add up for both sides
    up = np.linalg.eigh(every.T @ every)[1][:, -1]
    up = up * np.sign(up[np.argmax(np.abs(up))])
    cosine = normal @ up / np.linalg.norm(normal, axis=1)
    if bad := first_wrong(mesh.comm, np.abs(cosine) < 0.5, points.mean(axis=1)):
        raise InputError(
            f"{bad.number} of the {opening} are far from the plane of the others, the first around "
            f"{bad.place}: tag the cells on one side of the cut differently, then the sides can be "
            "told apart"
        )
    below: Mask = cosine > 0.0
    return below


@dataclass(frozen=True)
class _Opening:
    """An interface with numbers in place of names."""

    slave: int
    master: int
    slave_tag: int
    master_tag: int
    facets: int | None

    def __str__(self) -> str:
        where = "" if self.facets is None else f" with tag {self.facets}"
        return f"facets{where} between the bodies {self.slave} and {self.master}"


def _openings(
    tagged: TaggedMesh, interfaces: Sequence[Interface]
) -> tuple[list[_Opening], dict[str, int]]:
    """Replace names by tags; also return all names."""
    comm = tagged.mesh.comm
    existing = [
        np.unique(concatenate_ranks(comm, np.unique(tags.values)))
        for tags in (tagged.cell_tags, tagged.facet_tags)
    ]
    numbers = [t for i in interfaces for t in (i.slave_tag, i.master_tag) if not isinstance(t, str)]
    free = 1 + max([0, *numbers, *(int(t.max(initial=0)) for t in existing)])
    added: dict[str, int] = {}

    def new_tag(tag: int | str) -> int:
        if not isinstance(tag, str):
            return int(tag)
        if tag in tagged.names:
            raise InputError(
                f"the new surface '{tag}' has the name of a body or surface that the mesh has "
                "already; choose another, or pass a number"
            )
        return added.setdefault(tag, free + len(added))

    with raise_collectively(comm):
        openings = []
        for i in interfaces:
            slave, master = (
                _tag(t, tagged.names, existing[0], "cell") for t in (i.slave, i.master)
            )
            facets = (
                None if i.facets is None else _tag(i.facets, tagged.names, existing[1], "facet")
            )
            opening = _Opening(slave, master, new_tag(i.slave_tag), new_tag(i.master_tag), facets)
            if slave == master and facets is None:
                raise InputError(
                    f"{i}: slave and master are the same body; name the facets of a plane cut, or "
                    "tag the cells on one side of the surface differently, then the sides can be "
                    "told apart"
                )
            if opening.slave_tag == opening.master_tag:
                raise InputError(f"{i}: the two new surfaces have the same tag")
            openings.append(opening)
    return openings, {**tagged.names, **added}


def _tag(tag: int | str, names: Mapping[str, int], existing: Numbers, kind: str) -> int:
    if isinstance(tag, str) and tag not in names:
        raise InputError(f"no body or surface has the name '{tag}'; the names are {sorted(names)}")
    number = int(names[tag] if isinstance(tag, str) else tag)
    if number not in existing:
        raise InputError(f"tag {number} is on no {kind}; the {kind} tags are {existing.tolist()}")
    return number


@dataclass(frozen=True)
class _FacetSides:
    """The facets of this rank's m cells, each seen from its cell."""

    cell_tag: Numbers  # (m,)
    facet: Numbers  # (m, f) global numbers
    facet_tag: Numbers  # (m, f)
    directory: Directory  # of the facets; the following are for its keys
    low: Numbers  # smallest and largest cell tag at the facet
    high: Numbers
    tag: Numbers  # of the facet
    cells: Numbers  # number of cells at the facet

    @staticmethod
    def from_mesh(tagged: TaggedMesh) -> _FacetSides:
        """Gather the tags around each facet on its home rank. Collective."""
        mesh, owned = tagged.mesh, owned_cells(tagged.mesh)
        local = cell_facets(mesh)[:owned]
        facet_map = mesh.topology.index_map(mesh.topology.dim - 1)
        facet = global_numbers(facet_map, local)
        cell_tag = np.full(owned, _UNTAGGED, dtype=np.int64)
        on_owned = tagged.cell_tags.indices < owned
        cell_tag[tagged.cell_tags.indices[on_owned]] = tagged.cell_tags.values[on_owned]

        directory = Directory(mesh.comm, np.unique(facet))
        keys, values = directory.collect(facet.ravel(), np.repeat(cell_tag, facet.shape[1]))
        order = np.lexsort((values, keys))
        first = np.searchsorted(keys[order], directory.keys)
        last = np.searchsorted(keys[order], directory.keys, side="right") - 1
        low, high = values[order[first]], values[order[last]]
        tag = np.full(directory.keys.size, _UNTAGGED, dtype=np.int64)
        keys, values = directory.collect(
            global_numbers(facet_map, tagged.facet_tags.indices),
            tagged.facet_tags.values.astype(np.int64),
        )
        tag[directory.position(keys)] = values
        facet_tag = directory.lookup(facet.ravel(), tag)[1].reshape(facet.shape)
        return _FacetSides(cell_tag, facet, facet_tag, directory, low, high, tag, last - first + 1)


def _opened_facets(mesh: Mesh, sides: _FacetSides, openings: Sequence[_Opening]) -> Numbers:
    """Return the number of the interface that each facet (m, f) of a cell is in; -1 for none."""
    comm = mesh.comm
    opened = np.full(sides.tag.size, -1, dtype=np.int64)
    for k, opening in enumerate(openings):
        low, high = sorted((opening.slave, opening.master))
        selected = (sides.low == low) & (sides.high == high) & (sides.cells == 2)
        if opening.facets is not None:
            selected &= sides.tag == opening.facets
        number, repeated = comm.allreduce(np.array([selected.sum(), (opened[selected] >= 0).sum()]))
        if not number:
            raise InputError(
                f"there are no {opening}: they do not touch, have nodes of their own already, or "
                "the tag is on other facets"
            )
        if repeated:
            first = openings[int(comm.allreduce(opened[selected].max(initial=-1), MPI.MAX))]
            raise InputError(f"{repeated} of the {opening} are in two interfaces, also in: {first}")
        opened[selected] = k
    numbers: Numbers = sides.directory.lookup(sides.facet.ravel(), opened)[1]
    return numbers.reshape(sides.facet.shape)


def _check_new_tags(
    comm: MPI.Intracomm, sides: _FacetSides, opened: Numbers, openings: Sequence[_Opening]
) -> None:
    """Check that the new tags are on no facet that stays."""
    new = sorted({tag for o in openings for tag in (o.slave_tag, o.master_tag)})
    occupied = np.unique(sides.facet_tag[(opened < 0) & np.isin(sides.facet_tag, new)])
    occupied = np.unique(concatenate_ranks(comm, occupied))
    if occupied.size:
        raise InputError(
            f"other facets have the tags {occupied.tolist()} of new surfaces; choose tags that no "
            "facet has"
        )


# -- nodes -------------------------------------------------------------------------------------


def _renumbered(mesh: Mesh, sides: _FacetSides, opened: Numbers) -> tuple[Numbers, Vector]:
    """Return the nodes of this rank's cells (m, n) in the new mesh, and its share of the points."""
    comm, kind = mesh.comm, cell_type(mesh)
    nodes = _compat.geometry_cells(mesh)[: owned_cells(mesh)]
    # dolfinx 0.5 may number a node that two ranks share twice; the input's numbers are unique
    old = np.asarray(mesh.geometry.input_global_indices, dtype=np.int64)[nodes]
    directory = Directory(comm, np.unique(old))
    on_surface = np.zeros(directory.keys.size, dtype=bool)
    for f, corners in enumerate(kind.facets):
        keys = directory.collect(old[opened[:, f] >= 0][:, corners].ravel())[0]
        on_surface[directory.position(keys)] = True

    vertices = old[:, : kind.vertices]
    split = directory.lookup(vertices.ravel(), on_surface)[1].reshape(vertices.shape)
    copy = _copies_of_vertices(mesh, sides, opened, directory, vertices, split)
    if old.shape[1] > kind.vertices:
        copy = np.hstack([copy, _copies_between_vertices(mesh, directory, old, copy)])

    last_copy = np.zeros(directory.keys.size, dtype=np.int64)
    keys, number = directory.collect(old.ravel(), copy.ravel())
    np.maximum.at(last_copy, directory.position(keys), number)
    first = first_of_rank(comm, int(np.sum(last_copy + 1)))[0]
    start = first + np.cumsum(last_copy + 1) - (last_copy + 1)
    cells = directory.lookup(old.ravel(), start)[1].reshape(old.shape) + copy

    points = np.zeros((directory.keys.size, mesh.geometry.dim))
    keys, x = directory.collect(old.ravel(), mesh.geometry.x[nodes.ravel(), : mesh.geometry.dim])
    points[directory.position(keys)] = x
    return cells, np.repeat(points, last_copy + 1, axis=0)


def _copies_of_vertices(
    mesh: Mesh,
    sides: _FacetSides,
    opened: Numbers,
    directory: Directory,
    vertices: Numbers,
    split: Mask,
) -> Numbers:
    """Return which copy of its vertices each cell has (m, v), counted from 0.

    The home of a vertex joins the cells around it that have a closed facet in common there.
    """
    kind, cell_map = cell_type(mesh), mesh.topology.index_map(mesh.topology.dim)
    number = global_numbers(cell_map, np.arange(len(vertices)))
    columns = []
    for f, corners in enumerate(kind.facets):
        for corner in corners:
            rows = np.flatnonzero(split[:, corner])
            facet = np.where(opened[rows, f] < 0, sides.facet[rows, f], -1)
            columns.append(np.stack([vertices[rows, corner], number[rows], facet]))
    vertex, cell, facet = directory.collect(*np.concatenate(columns, axis=1))
    vertex_cells, cell_position = np.unique(
        np.stack([vertex, cell], axis=1), axis=0, return_inverse=True
    )
    closed = facet >= 0
    joints, joint_position = np.unique(
        np.stack([vertex, facet], axis=1)[closed], axis=0, return_inverse=True
    )
    size = len(vertex_cells) + len(joints)
    ends = (cell_position.ravel()[closed], len(vertex_cells) + joint_position.ravel())
    graph = sp.coo_matrix((np.ones(ends[0].size), ends), (size, size))
    group = connected_components(graph, directed=False)[1][: len(vertex_cells)]
    copy = _rank_within(vertex_cells[:, 0], group)

    vertex, cell, copy = directory.forward(vertex_cells[:, 0], vertex_cells[:, 1], copy)
    copies = np.zeros(split.shape, dtype=np.int64)
    first = int(number[0]) if number.size else 0
    on_rank = (cell >= first) & (cell < first + number.size)
    vertex, cell, copy = vertex[on_rank], cell[on_rank] - first, copy[on_rank]
    corner = np.argmax(vertices[cell] == vertex[:, None], axis=1)
    copies[cell, corner] = copy
    return copies


def _copies_between_vertices(
    mesh: Mesh, directory: Directory, old: Numbers, copies: Numbers
) -> Numbers:
    """Return which copy each cell has of its nodes (m, n - v) on edges and faces.

    Cells have the same copy where they have the same copies of the vertices around it: thus nodes
    of degree 2 are shared where dolfinx sees one edge or face.
    """
    midpoints = cell_type(mesh).midpoints
    digit = 1 + mesh.comm.allreduce(int(copies.max(initial=0)), MPI.MAX)
    span = digit ** copies.shape[1]
    code = np.zeros((len(old), len(midpoints)), dtype=np.int64)
    for k, ends in enumerate(midpoints):
        # neighbours list the vertices in different orders
        order = np.argsort(old[:, ends], axis=1)
        ordered = np.take_along_axis(copies[:, ends], order, axis=1)
        code[:, k] = ordered @ digit ** np.arange(len(ends))
    nodes = old[:, copies.shape[1] :]
    distinct = np.unique(np.stack(directory.collect(nodes.ravel(), code.ravel()), axis=1), axis=0)
    rank = np.arange(len(distinct)) - np.searchsorted(distinct[:, 0], distinct[:, 0])
    node, number, rank = directory.forward(distinct[:, 0], distinct[:, 1], rank)
    keys = node * span + number
    order = np.argsort(keys)
    numbers: Numbers = rank[order][np.searchsorted(keys[order], nodes * span + code)]
    return numbers


def _rank_within(key: Numbers, group: Numbers) -> Numbers:
    """Return the rank of each row's group among those of its key, by first appearance."""
    _, first, inverse = np.unique(group, return_index=True, return_inverse=True)
    order = np.lexsort((first, key[first]))
    keys = key[first][order]
    start = np.searchsorted(keys, keys)
    rank = np.empty(first.size, dtype=np.int64)
    rank[order] = np.arange(first.size) - start
    ranks: Numbers = rank[inverse.ravel()]
    return ranks


def _check_open(mesh: Mesh, sides: _FacetSides, opened: Numbers, cells: Numbers) -> None:
    """Check that the two sides of each opened facet have different vertices."""
    x, nodes = mesh.geometry.x[:, : mesh.geometry.dim], _compat.geometry_cells(mesh)
    rows = []
    for f, corners in enumerate(cell_type(mesh).facets):
        opened_cells = np.flatnonzero(opened[:, f] >= 0)
        middle = x[nodes[opened_cells][:, corners]].mean(axis=1)
        rows.append(
            (sides.facet[opened_cells, f], np.sort(cells[opened_cells][:, corners], axis=1), middle)
        )
    columns = (np.concatenate(column) for column in zip(*rows, strict=True))
    keys, vertices, places = sides.directory.collect(*columns)
    order = np.argsort(keys, kind="stable")
    keys, vertices, places = keys[order], vertices[order], places[order]
    closed: Mask = (keys[1:] == keys[:-1]) & np.all(vertices[1:] == vertices[:-1], axis=1)
    if bad := first_wrong(mesh.comm, closed, places[1:]):
        raise InputError(
            f"{bad.number} facets of the interfaces cannot be opened, the first around "
            f"{bad.place}: all their nodes are at the border of the interface, where the bodies "
            "stay together. Open more of the surface, or mesh it more finely"
        )


# -- tags --------------------------------------------------------------------------------------


def _with_tags(
    mesh: Mesh, cell_tag: Numbers, facet_tag: Numbers, names: dict[str, int]
) -> TaggedMesh:
    """Tag a mesh by the tags of the cells that this rank gave and of their facets (m, f)."""
    dim = mesh.topology.dim
    first = first_of_rank(mesh.comm, len(cell_tag))[0]
    number = first + np.arange(len(cell_tag))
    directory = Directory(mesh.comm, number)
    keys, *columns = directory.collect(number, cell_tag, facet_tag)
    order = np.argsort(keys)
    input_cells = np.asarray(mesh.topology.original_cell_index, dtype=np.int64)
    _, cell_tags, tags_of_facets = directory.lookup(
        input_cells, *(column[order] for column in columns)
    )
    facets = cell_facets(mesh)
    facet_map = mesh.topology.index_map(dim - 1)
    facet_tags = np.full(facet_map.size_local + facet_map.num_ghosts, _UNTAGGED, dtype=np.int64)
    facet_tags[facets] = tags_of_facets
    return TaggedMesh(mesh, _tags(mesh, dim, cell_tags), _tags(mesh, dim - 1, facet_tags), names)


def _tags(mesh: Mesh, dim: int, values: Numbers) -> Any:
    """Return the tags of all entities of this rank that have one."""
    tagged = np.flatnonzero(values != _UNTAGGED)
    return sorted_tags(mesh, dim, tagged, values[tagged])

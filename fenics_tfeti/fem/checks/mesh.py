"""Checks of a mesh, before anything is computed on it: sound cells, connected bodies.

All checks are vectorised over the cells or the surface nodes that a rank owns. Their findings are
gathered, so that all ranks raise the same error with the totals and the same first place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from scipy.spatial import cKDTree

from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.checks.cells import CellGeometry, check_cells, check_overlaps
from fenics_tfeti.fem.contact.descriptions.contacts import Contact, ContactPair, SelfContact
from fenics_tfeti.fem.contact.descriptions.surfaces import surface_tags
from fenics_tfeti.fem.contact.descriptions.ties import BoltPreload, Tie
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.messages import coordinate_order, first_mesh_point
from fenics_tfeti.fem.tolerances import SAME_PLACE
from fenics_tfeti.fem.topology import (
    cells_of_facets,
    exterior_cell_facets,
    facet_corners,
    find_tagged,
    global_numbers,
)
from fenics_tfeti.parallel import Directory, concatenate_ranks, send_rows
from fenics_tfeti.typing import Array, Indices, Mask, Numbers, Vector


@dataclass(frozen=True)
class _SurfaceNodes:
    """Nodes (k,) on the surface of bodies; a node that several bodies share has a row for each."""

    number: Numbers  # global, in the input of the mesh
    x: Vector  # (k, gdim) [m]
    body: Numbers
    size: Vector  # shortest edge of the body's cells at the node, of those longer than zero [m]
    slave: Mask  # on a slave surface of a contact pair
    master: Mask  # on a master surface of a contact pair
    vertex: Numbers  # global number in the distributed mesh

    def __getitem__(self, rows: Any) -> _SurfaceNodes:
        return _SurfaceNodes(*(column[rows] for column in vars(self).values()))


def _surface_nodes(cells: CellGeometry, contacts: Sequence[Contact | Tie]) -> _SurfaceNodes:
    """Return the nodes of the exterior facets of this rank's cells; pairs and bolts mark them."""
    domain = cells.domain
    cell, facet = np.nonzero(exterior_cell_facets(domain))
    nodes = facet_corners(domain, cell, facet)
    local, body = nodes.ravel(), np.repeat(cells.body[cell], nodes.shape[1])
    _, first, row = np.unique(
        body * len(domain.geometry.x) + local, return_index=True, return_inverse=True
    )
    size = np.full(first.size, np.inf)
    np.minimum.at(size, row, np.repeat(cells.shortest_edges(cell), nodes.shape[1]))
    local = local[first]
    slave, master = _contact_nodes(domain, contacts)
    # dolfinx 0.5 numbers a node anew on ranks whose cells meet there without a common facet;
    # the numbers in the input of the mesh are unique
    numbers = np.asarray(domain.geometry.input_global_indices, dtype=np.int64)
    return _SurfaceNodes(
        numbers[local],
        domain.geometry.x[local, : domain.geometry.dim],
        body[first],
        size,
        slave[local],
        master[local],
        global_numbers(domain.geometry.index_map(), local),
    )


def _contact_nodes(domain: Mesh, contacts: Sequence[Contact | Tie]) -> tuple[Mask, Mask]:
    """Mark the nodes on slave and on master surfaces of pairs and bolts; tags are checked later."""
    marks = np.zeros((2, len(domain.geometry.x)), dtype=bool)
    facets: list[list[Indices]] = [[np.zeros(0, dtype=np.int32)] for _ in marks]
    dim = domain.topology.dim - 1
    for contact in contacts:
        if isinstance(contact, SelfContact) and contact.facet_tags is None:
            marks[:] = True
        if not isinstance(contact, ContactPair | BoltPreload | SelfContact):
            continue
        tags = contact.facet_tags
        if tags is not None and _compat.tags_are_on(tags, domain) and tags.dim == dim:
            of_sides = surface_tags(contact)
            for side, tag in zip(facets, (of_sides[0], of_sides[-1]), strict=True):
                side.append(find_tagged(tags, tag))
    for mark, side in zip(marks, facets, strict=True):
        mark[facet_corners(domain, *cells_of_facets(domain, np.concatenate(side)))] = True
    return marks[0], marks[1]


# -- checks ------------------------------------------------------------------------------------


def check_mesh(domain: Mesh, bodies: Bodies, contacts: Sequence[Contact | Tie]) -> None:
    """Check the cells, and that each body is connected through facets. Collective.

    The surfaces of a contact pair may be the two faces of a crack in one body, those of a bolt the
    sides of a cut.
    """
    cells = check_cells(domain, bodies)
    check_overlaps(cells)
    surface = _surface_nodes(cells, contacts)
    _check_pieces(cells, surface)
    _check_joints(domain, bodies, surface)
    _check_split_nodes(domain, surface)
    _check_cracks(domain, bodies, surface)


def _check_pieces(cells: CellGeometry, surface: _SurfaceNodes) -> None:
    """Check that each cell tag, where given, is on one connected body. Collective."""
    domain, bodies = cells.domain, cells.bodies
    if bodies.tags is None:
        return
    tags, counts = np.unique(bodies.tags, return_counts=True)
    if np.all(counts == 1):
        return
    tag = tags[np.argmax(counts > 1)]
    (pieces,) = np.nonzero(bodies.tags == tag)
    in_pieces = np.isin(cells.body, pieces)
    columns = cells.midpoint.T[in_pieces], cells.body[in_pieces]
    midpoints, numbers = (concatenate_ranks(domain.comm, column) for column in columns)
    first, second = (first_mesh_point(domain, midpoints[numbers == piece]) for piece in pieces[:2])
    nodes = surface[np.isin(surface.body, pieces)]
    shared = _shared_nodes(domain, nodes, nodes.body)
    coincident = _coincident_pairs(domain, nodes, np.zeros(nodes.body.size))[0]
    hint = ""
    if len(shared):
        hint = f"They share {_count(domain, shared, 'node')}, but no facet. "
    elif len(coincident):
        pairs = _count(domain, coincident, "pair")
        hint = f"They have {pairs}: were nodes that should be one not merged? "
    raise InputError(
        f"the cells with tag {tag} in cell_tags are in {len(pieces)} pieces, one with a cell "
        f"around {first}, another with one around {second}. {hint}A cell tag stands for one body, "
        "connected through facets: connect the pieces, give each a tag of its own, or leave "
        "cell_tags out, then the bodies are the connected parts of the mesh"
    )


def _check_joints(domain: Mesh, bodies: Bodies, surface: _SurfaceNodes) -> None:
    """Check that parts of the mesh without a common facet have no common node. Collective."""
    part = bodies.part[surface.body]
    shared = _shared_nodes(domain, surface, part)
    if not len(shared):
        return
    first = shared[coordinate_order(shared)[0]]
    at_first = np.all(surface.x == first, axis=1)
    names = [
        bodies.names[b] for b in np.unique(concatenate_ranks(domain.comm, surface.body[at_first]))
    ]
    raise InputError(
        f"bodies are joined through {_count(domain, shared, 'node')}, but through no facet: "
        f"{' and '.join(names)}. An edge or a point cannot hold an elastic body: give each body "
        "nodes of its own (and say by a ContactPair what may touch), or connect them through facets"
    )


def _check_split_nodes(domain: Mesh, surface: _SurfaceNodes) -> None:
    """Check that dolfinx has not split a node where a body is pinched. Collective."""
    split = _shared_nodes(domain, surface, surface.vertex)
    if len(split):
        raise InputError(
            f"on {domain.comm.size} processes, this version of dolfinx makes several nodes of "
            f"{_count(domain, split, 'node')}, where cells of different processes meet in an edge "
            "or a point only: the body would come apart there. Run on one process or with a newer "
            "dolfinx, or mesh the body so that cells meet in facets"
        )


def _check_cracks(domain: Mesh, bodies: Bodies, surface: _SurfaceNodes) -> None:
    """Check that no body has two nodes at one place, except on the faces of a pair. Collective."""
    points, body = _coincident_pairs(domain, surface, surface.body)
    if not len(points):
        return
    raise InputError(
        f"{bodies.names[body[coordinate_order(points)[0]]]} has "
        f"{_count(domain, points, 'pair')}: the cells there are not connected, as in a crack. "
        "Merge these nodes (in Gmsh by removeDuplicateNodes, for this body alone); if a crack is "
        "meant, make its two faces a ContactPair, without the facets at its tip"
    )


def _count(domain: Mesh, points: Vector, what: str) -> str:
    """Return for instance "3 nodes (the first at (1, 0.5))"; collective."""
    pair = " of nodes at the same place" if what == "pair" else ""
    plural, first = ("", "") if len(points) == 1 else ("s", "the first ")
    place = first_mesh_point(domain, points)
    return f"{len(points)} {what}{plural}{pair} ({first}at {place})"


# -- nodes -------------------------------------------------------------------------------------


def _shared_nodes(domain: Mesh, nodes: _SurfaceNodes, group: Numbers) -> Vector:
    """Return the coordinates (n, gdim) of nodes that are in several groups, on all ranks."""
    keys, x, group = Directory(domain.comm, np.unique(nodes.number)).collect(
        nodes.number, nodes.x, group
    )
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    differs = np.zeros(first.size, dtype=bool)
    differs[inverse[group != group[first][inverse]]] = True
    return concatenate_ranks(domain.comm, x[first[differs]])


def _coincident_pairs(domain: Mesh, nodes: _SurfaceNodes, group: Array) -> tuple[Vector, Numbers]:
    """Find pairs of nodes of a group at the same place, except a slave and a master node.

    Return the place (n, gdim) and the body (n,) of each pair, on all ranks. Nodes of different
    groups may coincide.
    """
    comm, gdim = domain.comm, domain.geometry.dim
    reach = SAME_PLACE * comm.allreduce(float(nodes.size.max(initial=0.0)), MPI.MAX)
    rows, ranks = _slabs(comm, nodes.x, reach)
    data = (*vars(nodes).values(), group)
    *columns, group = send_rows(comm, ranks, *(column[rows] for column in data))
    candidates = _SurfaceNodes(*columns)
    pairs = np.zeros((0, 2), dtype=np.int64)
    if group.size:
        # one more coordinate keeps the groups apart
        point = np.column_stack([candidates.x, 4.0 * reach * group])
        pairs = cKDTree(point).query_pairs(reach, output_type="ndarray")
    a, b = candidates[pairs[:, 0]], candidates[pairs[:, 1]]
    distance = np.linalg.norm(a.x - b.x, axis=1)
    wrong = (a.number != b.number) & (distance <= SAME_PLACE * np.minimum(a.size, b.size))
    slave, master = (_marked_anywhere(candidates, m) for m in (candidates.slave, candidates.master))
    first, second = pairs.T
    wrong &= ~((slave[first] & master[second]) | (master[first] & slave[second]))
    numbers = np.sort(np.stack([a.number, b.number], axis=1)[wrong], axis=1)
    gathered = [concatenate_ranks(comm, column) for column in (numbers, a.x[wrong], a.body[wrong])]
    # a pair near the border of slabs is found in both
    distinct = np.unique(gathered[0], axis=0, return_index=True)[1]
    return gathered[1][distinct].reshape(-1, gdim), gathered[2][distinct]


def _marked_anywhere(nodes: _SurfaceNodes, mark: Mask) -> Mask:
    """Tell which nodes are marked in any of their rows: no rank has all facets at a node."""
    numbers, position = np.unique(nodes.number, return_inverse=True)
    marked = np.zeros(numbers.size, dtype=bool)
    np.logical_or.at(marked, position, mark)
    return marked[position]


def _slabs(comm: MPI.Intracomm, x: Vector, reach: float) -> tuple[Numbers, Numbers]:
    """Cut the mesh into a slab for each rank, across its longest axis.

    Return rows of points and the rank of the slab that each is in or within `reach` of: both of two
    for some.
    """
    low, high = x.min(axis=0, initial=np.inf), x.max(axis=0, initial=-np.inf)
    comm.Allreduce(MPI.IN_PLACE, low, MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, high, MPI.MAX)
    axis = int(np.argmax(high - low))
    width = max((high - low)[axis] / comm.size, 2.0 * reach, np.finfo(float).tiny)
    first, second = (
        np.clip((x[:, axis] + step - low[axis]) // width, 0, comm.size - 1).astype(np.int64)
        for step in (-reach, reach)
    )
    (both,) = np.nonzero(first != second)
    return np.append(np.arange(len(x)), both), np.append(first, second[both])

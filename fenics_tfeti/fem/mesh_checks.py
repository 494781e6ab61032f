"""What a mesh has to be before anything is computed on it: sound cells, connected bodies.

All checks are vectorised over the cells or the surface nodes that a rank owns. What they find is
gathered, so that all ranks raise the same error with the totals and the same first place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.contact import Contact, ContactPair
from fenics_tfeti.fem.decomposition.partition import Bodies, cell_facets, exterior_cell_facets
from fenics_tfeti.parallel import Directory, concatenate_ranks, raise_collectively

__all__ = ["check_mesh"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# |det J| relative to (size of the cell)^dim below which a cell is flat
_FLAT = 1e-10
# distance relative to the shortest edge around below which two nodes are at the same place;
# coordinates of single precision are still equal, gaps that are meant are not
_SAME_PLACE = 1e-5
# bins of coordinates along the longest side of the mesh, which spread the nodes over the ranks
_BINS = 64
_KEYS = 2**20

# vertices of the facets, in the order of the reference cells of dolfinx
_FACETS = {
    "triangle": ((1, 2), (0, 2), (0, 1)),
    "quadrilateral": ((0, 1), (0, 2), (1, 3), (2, 3)),
    "tetrahedron": ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2)),
    "hexahedron": (
        (0, 1, 2, 3),
        (0, 1, 4, 5),
        (0, 2, 4, 6),
        (1, 3, 5, 7),
        (2, 3, 6, 7),
        (4, 5, 6, 7),
    ),
}


def check_mesh(domain: Mesh, bodies: Bodies, contacts: Sequence[Contact]) -> None:
    """Check the cells, and that each body is connected and all of one piece. Collective.

    Parameters
    ----------
    domain : Mesh
        The mesh, of straight-sided cells.
    bodies : Bodies
        Its bodies.
    contacts : sequence of ContactPair or RigidObstacle
        The faces of a pair may be two sides of a crack in one body.

    Raises
    ------
    InputError
        On all ranks: coordinates that are NaN, cells without volume, twisted or on top of each
        other, a cell tag on several pieces, bodies joined through edges or points only, nodes that
        dolfinx has split, and nodes at the same place in one body.
    """
    with raise_collectively(domain.comm):
        _check_finite(domain)
    cells = _Cells.of(domain, bodies)
    _check_shapes(domain, bodies, cells)
    _check_overlaps(domain, bodies, cells)
    surface = _surface_nodes(domain, bodies, cells, contacts)
    _check_pieces(domain, bodies, cells, surface)
    _check_joints(domain, bodies, surface)
    _check_split_nodes(domain, surface)
    _check_cracks(domain, bodies, surface)


def _check_finite(domain: Mesh) -> None:
    bad = np.count_nonzero(~np.isfinite(domain.geometry.x).all(axis=1))
    if bad:
        raise InputError(
            f"{bad} of {len(domain.geometry.x)} nodes of the mesh on rank {domain.comm.rank} have "
            "coordinates that are NaN or infinite"
        )


@dataclass(frozen=True)
class _Cells:
    """The cells that this rank owns.

    Attributes
    ----------
    shape : str
        Such as "hexahedron".
    nodes : (m, v) integer array
        Rows of ``geometry.x``.
    corners : (m, v, gdim) array
        Coordinates [m].
    midpoint : (m, gdim) array
        Means of the corners [m].
    size : (m,) array
        Twice the largest distance of a corner from the midpoint [m].
    body : (m,) integer array
        The body of each.
    """

    shape: str
    nodes: NDArray[np.int32]
    corners: Vector
    midpoint: Vector
    size: Vector
    body: Numbers

    @staticmethod
    def of(domain: Mesh, bodies: Bodies) -> _Cells:
        nodes = _compat.geometry_cells(domain)[: bodies.of_cell.size]
        corners = domain.geometry.x[:, : domain.geometry.dim][nodes]
        # einsum: sums over short axes by reductions take several times as long
        midpoint = np.einsum("ijk->ik", corners) / max(corners.shape[1], 1)
        spokes = corners - midpoint[:, None]
        squares = np.einsum("ijk,ijk->ij", spokes, spokes)
        size = 2.0 * np.sqrt(squares.max(axis=1, initial=0.0))
        return _Cells(_compat.cell_name(domain), nodes, corners, midpoint, size, bodies.of_cell)


# -- single cells ------------------------------------------------------------------------------


def _check_shapes(domain: Mesh, bodies: Bodies, cells: _Cells) -> None:
    """Check the determinants of the Jacobians; dolfinx takes them without their sign."""
    at_corners, at_midpoint = _determinants(cells)
    dim = cells.midpoint.shape[1]
    scale = _FLAT * cells.size**dim
    turned = (at_corners.min(axis=1) < -scale) & (at_corners.max(axis=1) > scale)
    _raise_for_cells(
        domain,
        bodies,
        cells,
        turned,
        "twisted cells, in which the determinant of the Jacobian changes its sign",
        "Are their vertices in the order of dolfinx (those of a quadrilateral row by row, not "
        "around it)? Otherwise mesh there again",
    )
    what = "volume (det J / size^3" if dim == 3 else "area (det J / size^2"
    _raise_for_cells(
        domain,
        bodies,
        cells,
        np.abs(at_midpoint) <= scale,
        f"cells without {what} is below {_FLAT:g})",
        "Mesh there again, or take these cells out",
    )


def _determinants(cells: _Cells) -> tuple[Vector, Vector]:
    """Return det J (m, corners) at the corners and (m,) at the midpoint."""
    x, dim = cells.corners, cells.midpoint.shape[1]
    if cells.shape in ("triangle", "tetrahedron"):
        constant = _determinant([x[:, k] - x[:, 0] for k in range(1, dim + 1)])
        return constant[:, None], constant
    # in tensor order, corners that differ in bit d of their number are the ends of an edge along d
    grid = x.reshape(len(x), *(2,) * dim, dim)
    edges = [np.diff(grid, axis=dim - d) for d in range(dim)]
    number = 2 ** (dim - 1)
    means = [np.einsum("ijk->ik", e.reshape(len(x), number, dim)) / number for e in edges]
    return _determinant(edges).reshape(len(x), 2**dim), _determinant(means)


def _determinant(columns: Sequence[Vector]) -> Vector:
    """Return the determinants (...) of matrices given by their columns (..., dim)."""
    a, b = columns[0], columns[1]
    plane: Vector = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    if len(columns) == 2:
        return plane
    c = columns[2]
    volume: Vector = (
        plane * c[..., 2]
        + (a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]) * c[..., 0]
        + (a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]) * c[..., 1]
    )
    return volume


def _raise_for_cells(
    domain: Mesh, bodies: Bodies, cells: _Cells, wrong: Mask, what: str, remedy: str
) -> None:
    """Raise on all ranks if any has wrong cells, naming the first by its coordinates."""
    points = concatenate_ranks(domain.comm, cells.midpoint[wrong])
    of = concatenate_ranks(domain.comm, cells.body[wrong])
    if not len(points):
        return
    first = _first(points)
    total = domain.comm.allreduce(cells.body.size)
    where = "around" if len(points) == 1 else "the first around"
    raise InputError(
        f"the mesh has {what}: {len(points)} of {total} cells, {where} "
        f"{_format(domain, points[first])} in {bodies.names[of[first]]}. {remedy}"
    )


# -- neighbours --------------------------------------------------------------------------------


def _check_overlaps(domain: Mesh, bodies: Bodies, cells: _Cells) -> None:
    """Check that the cells of a facet are on its two sides; a cell pushed inside out is not."""
    facets = cell_facets(domain)[0][: cells.body.size]
    simplices = cells.shape in ("triangle", "tetrahedron")
    side = _sides_of_simplices(cells) if simplices else _sides_by_place(facets, cells)
    number = int(facets.max(initial=-1)) + 1
    above, below = (np.bincount(facets[side == s], minlength=number) for s in (1.0, -1.0))
    folded = np.count_nonzero(((above > 1) | (below > 1))[facets], axis=1)
    # the neighbours of a cell turned inside out have one such facet each, the cell itself several
    most = domain.comm.allreduce(int(folded.max(initial=0)), MPI.MAX)
    _raise_for_cells(
        domain,
        bodies,
        cells,
        (folded > 0) & (folded == most),
        "cells that overlap their neighbours, on the same side of a common facet",
        "A vertex was pushed through the opposite side: mesh there again",
    )


def _sides_of_simplices(cells: _Cells) -> Vector:
    """Return for each facet of each simplex on which side of it the simplex is: -1, 0, 1.

    A positive simplex orients its facets, the k-th by (-1)^k and the order of its vertices; cells
    on the two sides of a facet give it opposite orientations.
    """
    volume = np.sign(_determinants(cells)[1])
    side = np.empty(cells.nodes.shape)
    for k, facet in enumerate(_FACETS[cells.shape]):
        pairs = combinations(facet, 2)
        odd = np.bitwise_xor.reduce([cells.nodes[:, a] > cells.nodes[:, b] for a, b in pairs])
        side[:, k] = np.where(odd, -volume, volume) * (-1) ** k
    return side


def _sides_by_place(facets: NDArray[np.int32], cells: _Cells) -> Vector:
    """Return for each facet of each cell on which side of it the cell's midpoint is: -1, 0, 1."""
    local = np.array(_FACETS[cells.shape])
    count, per_cell = facets.shape
    # any one of a facet's cells says where it is
    seen = np.zeros(int(facets.max(initial=-1)) + 1, dtype=np.int64)
    seen[facets.ravel()] = np.arange(facets.size)
    cell, position = np.divmod(seen, per_cell)
    x = cells.corners[cell[:, None], local[position]]
    if x.shape[2] == 2:
        tangent = x[:, 1] - x[:, 0]
        normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    else:
        # the diagonals
        normal = np.cross(x[:, 3] - x[:, 0], x[:, 2] - x[:, 1])
    height = np.empty((count, per_cell))
    centre = x.mean(axis=1)
    for k in range(per_cell):
        of = facets[:, k]
        height[:, k] = np.einsum("ij,ij->i", cells.midpoint - centre[of], normal[of])
    limit = _FLAT * cells.size[:, None] ** x.shape[2]
    return np.where(np.abs(height) > limit, np.sign(height), 0.0)


# -- bodies ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Nodes:
    """Nodes on the surface of bodies; those that several bodies share are there once for each.

    Attributes
    ----------
    number : (k,) integer array
        Global node numbers of what the mesh was made of.
    x : (k, gdim) array
        [m].
    body : (k,) integer array
        The body.
    size : (k,) array
        Shortest edge of the body's cells around it; edges without length do not count [m].
    slave, master : (k,) bool array
        Whether it is on such a face of a contact pair.
    vertex : (k,) integer array
        Global node numbers of the distributed mesh.
    """

    number: Numbers
    x: Vector
    body: Numbers
    size: Vector
    slave: Mask
    master: Mask
    vertex: Numbers

    def __getitem__(self, chosen: Any) -> _Nodes:
        return _Nodes(*(column[chosen] for column in self.columns()))

    def columns(self) -> tuple[Any, ...]:
        nodes = (self.number, self.x, self.body, self.size)
        return (*nodes, self.slave, self.master, self.vertex)

    def merged(self) -> _Nodes:
        """Return each pair of node and body once."""
        keys = np.stack([self.body, self.number], axis=1)
        _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        inverse = inverse.ravel()
        size = np.full(first.size, np.inf)
        np.minimum.at(size, inverse, self.size)
        slave, master = np.zeros(first.size, dtype=bool), np.zeros(first.size, dtype=bool)
        np.logical_or.at(slave, inverse, self.slave)
        np.logical_or.at(master, inverse, self.master)
        return replace(self[first], size=size, slave=slave, master=master)


def _surface_nodes(
    domain: Mesh, bodies: Bodies, cells: _Cells, contacts: Sequence[Contact]
) -> _Nodes:
    """Return the nodes of the facets of this rank's cells that are on the boundary of the mesh."""
    cell, facet = np.nonzero(exterior_cell_facets(domain))
    nodes = cells.nodes[cell[:, None], np.array(_FACETS[cells.shape])[facet]]
    per_facet = nodes.shape[1]
    local = nodes.ravel()
    slave, master = _contact_nodes(domain, contacts)
    # dolfinx 0.5 numbers a node anew on ranks whose cells meet there without a common facet, hence
    # the numbers that the mesh was made with
    numbers = np.asarray(domain.geometry.input_global_indices, dtype=np.int64)
    to_global = domain.geometry.index_map().local_to_global
    return _Nodes(
        numbers[local],
        domain.geometry.x[local, : domain.geometry.dim],
        np.repeat(cells.body[cell], per_facet),
        np.repeat(_shortest_edges(cells)[cell], per_facet),
        slave[local],
        master[local],
        np.asarray(to_global(local.astype(np.int32)), dtype=np.int64),
    ).merged()


def _shortest_edges(cells: _Cells) -> Vector:
    """Return the length of each cell's shortest edge that has one."""
    tensor = cells.shape in ("quadrilateral", "hexahedron")
    shortest = cells.size.copy()
    for a, b in combinations(range(cells.nodes.shape[1]), 2):
        # in tensor order, the numbers of the two ends differ in one bit
        if tensor and a ^ b not in (1, 2, 4):
            continue
        length = np.linalg.norm(cells.corners[:, a] - cells.corners[:, b], axis=1)
        np.minimum(shortest, length, out=shortest, where=length > _FLAT * cells.size)
    return shortest


def _contact_nodes(domain: Mesh, contacts: Sequence[Contact]) -> tuple[Mask, Mask]:
    """Mark the nodes on slave and on master faces of pairs; wrong tags are found elsewhere."""
    marks = np.zeros((2, len(domain.geometry.x)), dtype=bool)
    dim = domain.topology.dim - 1
    for contact in contacts:
        if not isinstance(contact, ContactPair):
            continue
        tags = contact.facet_tags
        if _compat.tags_are_on(tags, domain) and tags.dim == dim:
            for mark, tag in zip(marks, (contact.slave, contact.master), strict=True):
                mark[_compat.entity_nodes(domain, dim, tags.find(tag))] = True
    return marks[0], marks[1]


def _check_pieces(domain: Mesh, bodies: Bodies, cells: _Cells, surface: _Nodes) -> None:
    """Check that a cell tag, where given, is on one connected body."""
    if bodies.tags is None:
        return
    tags, pieces = np.unique(bodies.tags, return_counts=True)
    if np.all(pieces == 1):
        return
    tag = tags[np.argmax(pieces > 1)]
    (here,) = np.nonzero(bodies.tags == tag)
    mine = np.isin(cells.body, here)
    places, of = (concatenate_ranks(domain.comm, a[mine]) for a in (cells.midpoint, cells.body))
    one, other = (places[of == body][_first(places[of == body])] for body in here[:2])

    nodes = surface[np.isin(surface.body, here)]
    shared = _shared(domain, nodes, nodes.body)
    same = _coincident(domain, nodes, np.zeros(nodes.body.size))[0]
    hint = ""
    if len(shared):
        hint = f"They share {_count(domain, shared, 'node')}, but no facet. "
    elif len(same):
        hint = (
            f"They have {_count(domain, same, 'pair')}: were nodes that should be one not merged? "
        )
    raise InputError(
        f"the cells with tag {tag} in cell_tags are in {len(here)} pieces, one with a cell around "
        f"{_format(domain, one)}, another with one around {_format(domain, other)}. {hint}A cell "
        "tag stands for one body, connected through facets: connect the pieces, give each a tag "
        "of its own, or leave cell_tags out, then the bodies are the connected parts of the mesh"
    )


def _check_joints(domain: Mesh, bodies: Bodies, surface: _Nodes) -> None:
    """Check that parts of the mesh that share no facet share no node."""
    part = bodies.part[surface.body]
    shared = _shared(domain, surface, part)
    if not len(shared):
        return
    first = shared[_first(shared)]
    near = np.all(surface.x == first, axis=1)
    names = [bodies.names[b] for b in np.unique(concatenate_ranks(domain.comm, surface.body[near]))]
    raise InputError(
        f"bodies hang together through {_count(domain, shared, 'node')}, but through no facet: "
        f"{' and '.join(names)}. An edge or a point cannot hold an elastic body: give each body "
        "nodes of its own (and say by a ContactPair what may touch), or connect them through facets"
    )


def _check_split_nodes(domain: Mesh, surface: _Nodes) -> None:
    """Check that dolfinx has not made several nodes of one where a body is pinched."""
    split = _shared(domain, surface, surface.vertex)
    if len(split):
        raise InputError(
            f"on {domain.comm.size} processes, this version of dolfinx makes several nodes of "
            f"{_count(domain, split, 'node')}, where cells of different processes meet in an edge "
            "or a point only: the body would come apart there. Run on one process or with a newer "
            "dolfinx, or mesh the body so that cells meet in facets"
        )


def _check_cracks(domain: Mesh, bodies: Bodies, surface: _Nodes) -> None:
    """Check that a body has no two nodes at the same place, but for the two faces of a pair."""
    points, of = _coincident(domain, surface, surface.body)
    if not len(points):
        return
    raise InputError(
        f"{bodies.names[of[_first(points)]]} has "
        f"{_count(domain, points, 'pair')}: the cells there are not connected, as in a crack. "
        "Merge these nodes (in Gmsh by removeDuplicateNodes, for this body alone); if a crack is "
        "meant, make its two faces a ContactPair, without the facets at its tip"
    )


def _shared(domain: Mesh, nodes: _Nodes, group: Numbers) -> Vector:
    """Return the places (n, gdim) of nodes that are in several groups, on all ranks."""
    keys, x, group = Directory(domain.comm, np.unique(nodes.number)).collect(
        nodes.number, nodes.x, group
    )
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    differs = np.zeros(first.size, dtype=bool)
    differs[inverse[group != group[first][inverse]]] = True
    return concatenate_ranks(domain.comm, x[first[differs]])


def _coincident(domain: Mesh, nodes: _Nodes, group: NDArray[Any]) -> tuple[Vector, Numbers]:
    """Find different nodes of a group at the same place, but for a slave and its master.

    Parameters
    ----------
    domain : Mesh
        The mesh.
    nodes : _Nodes
        Nodes of this rank.
    group : (k,) array
        Nodes of different groups may coincide.

    Returns
    -------
    points, body : (n, gdim), (n,) arrays
        The place and the body of each such pair, on all ranks.
    """
    comm, gdim = domain.comm, domain.geometry.dim
    reach = _SAME_PLACE * comm.allreduce(float(nodes.size.max(initial=0.0)), MPI.MAX)
    keys, rows = _bins(comm, nodes.x, reach)
    data = (*nodes.columns(), group)
    *columns, group = Directory(comm, np.unique(keys)).collect(keys, *(d[rows] for d in data))[1:]
    near = _Nodes(*columns)
    pairs = np.zeros((0, 2), dtype=np.int64)
    if group.size:
        # groups lie far apart along one more coordinate
        place = np.column_stack([near.x, 4.0 * reach * group])
        pairs = cKDTree(place).query_pairs(reach, output_type="ndarray")
    a, b = near[pairs[:, 0]], near[pairs[:, 1]]
    distance = np.linalg.norm(a.x - b.x, axis=1)
    wrong = (a.number != b.number) & (distance <= _SAME_PLACE * np.minimum(a.size, b.size))
    slave, master = _anywhere(near, near.slave), _anywhere(near, near.master)
    one, other = pairs.T
    wrong &= ~((slave[one] & master[other]) | (master[one] & slave[other]))
    numbers = np.sort(np.stack([a.number, b.number], axis=1)[wrong], axis=1)
    found = [concatenate_ranks(comm, column) for column in (numbers, a.x[wrong], a.body[wrong])]
    # a pair near the border of bins is found in each of them
    once = np.unique(found[0], axis=0, return_index=True)[1]
    return found[1][once].reshape(-1, gdim), found[2][once]


def _anywhere(nodes: _Nodes, mark: Mask) -> Mask:
    """Tell which nodes are marked in any of their rows: not all ranks have all their facets."""
    numbers, place = np.unique(nodes.number, return_inverse=True)
    marked = np.zeros(numbers.size, dtype=bool)
    np.logical_or.at(marked, place, mark)
    return marked[place]


def _bins(comm: MPI.Intracomm, x: Vector, reach: float) -> tuple[Numbers, Numbers]:
    """Return keys of bins in space and the points in them, also of those that reach into them."""
    low, high = x.min(axis=0, initial=np.inf), x.max(axis=0, initial=-np.inf)
    comm.Allreduce(MPI.IN_PLACE, low, MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, high, MPI.MAX)
    width = max(float(np.max(high - low)) / _BINS, 4.0 * reach, np.finfo(float).tiny)
    steps = np.array(list(product((-reach, reach), repeat=x.shape[1])))
    bins = np.floor((x[:, None] + steps - low) / width).astype(np.int64)
    # multiplied by large primes: even over the keys, however the mesh lies
    keys = (bins @ np.array([73856093, 19349663, 83492791])[: x.shape[1]]) % _KEYS
    rows = np.repeat(np.arange(len(x)), len(steps))
    both = np.unique(np.stack([keys.ravel(), rows], axis=1), axis=0)
    return both[:, 0], both[:, 1]


# -- words -------------------------------------------------------------------------------------


def _first(points: Vector) -> int:
    """Return the first point in the order of coordinates: the same for any number of ranks."""
    return int(np.lexsort(points.T[::-1])[0])


def _count(domain: Mesh, points: Vector, what: str) -> str:
    """Return for instance "3 nodes (the first at (1, 0.5))"; collective."""
    of = " of nodes at the same place" if what == "pair" else ""
    plural, first = ("", "") if len(points) == 1 else ("s", "the first ")
    return f"{len(points)} {what}{plural}{of} ({first}at {_format(domain, points[_first(points)])})"


def _format(domain: Mesh, point: Vector) -> str:
    """Write a point; collective."""
    size = float(np.abs(domain.geometry.x).max(initial=0.0))
    return format_point(point, domain.comm.allreduce(size, MPI.MAX))

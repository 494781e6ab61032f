"""Contact pairs of all bodies that are near each other, without tags of their surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from dolfinx.mesh import Mesh

from fenics_tfeti.errors import warn_user
from fenics_tfeti.fem.checks.cells import check_cells
from fenics_tfeti.fem.contact.descriptions.contacts import ContactPair
from fenics_tfeti.fem.contact.descriptions.friction import FrictionLaw
from fenics_tfeti.fem.contact.mortar.cells import (
    Cells,
    MasterTree,
    inside,
    nearest_layers,
    overlapping_cells,
)
from fenics_tfeti.fem.contact.mortar.facets import Facets, Planes
from fenics_tfeti.fem.contact.surfaces.box_tree import BoxTree
from fenics_tfeti.fem.contact.surfaces.faceted import edge_lengths
from fenics_tfeti.fem.contact.surfaces.nearby import facets_in_boxes
from fenics_tfeti.fem.contact.surfaces.oriented import oriented_corners
from fenics_tfeti.fem.contact.surfaces.surface_facets import SurfaceFacets
from fenics_tfeti.fem.decomposition.bodies import Bodies, find_bodies
from fenics_tfeti.fem.io.tagged_mesh import sorted_tags
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING, SAME_PLACE
from fenics_tfeti.fem.topology import batches, cell_facets, distinct_rows, exterior_cell_facets
from fenics_tfeti.fem.user_data import check_positive
from fenics_tfeti.parallel import (
    Directory,
    all_to_all,
    concatenate_ranks,
    first_of_rank,
    raise_collectively,
    send_rows,
)
from fenics_tfeti.typing import Indices, Mask, Numbers, Vector

# angle by which facets that touch face to face may be inclined before [rad]
_INCLINED = 0.1


def find_contacts(
    mesh: Mesh,
    cell_tags: Any | None = None,
    *,
    distance: float | None = None,
    friction: FrictionLaw | None = None,
    whole_faces: bool = False,
) -> list[ContactPair]:
    """Return contact pairs of all bodies that are near each other. Collective.

    A facet on the boundary of a body belongs to a pair if a facet of the other body is opposite it
    along its normal, within the distance; of several bodies one behind the other it is the nearest.
    Facets of one body, and of bodies that are glued to each other, are not paired.

    Parameters
    ----------
    mesh : dolfinx.mesh.Mesh
        The mesh.
    cell_tags : MeshTags, optional
        The bodies, as for `ContactProblem`; by default the connected parts of the mesh.
    distance : float, optional
        Largest gap between facets [m]. A part of a surface that may touch later has to be within
        it. By default it is the shortest edge of the facet. Without `whole_faces`, that of facets
        which are inclined to each other by more than 0.1 rad is the one where their bodies are
        nearest to others; a warning has the pairs of bodies that are left out.
    friction : Tresca or Coulomb, optional
        The law of friction of all pairs; by default there is none.
    whole_faces : bool
        Whether surfaces are extended to the edges of their bodies, for bodies that slide along each
        other by more than a facet.

    Returns
    -------
    list of ContactPair
        By the numbers of the bodies, which names have. The slave is the body with the larger
        facets; where sizes vary, the ratio of opposite facets counts where it is largest. Where
        slave facets meet at a sharp edge there is a pair for either side. The list is empty, with
        a warning, where no bodies are near each other.

    Raises
    ------
    InputError
        On all ranks, for a distance that is no positive number, or wrong cell tags.

    Examples
    --------
    >>> from fenics_tfeti.io import Box, boxes
    >>> slabs = [Box((0, 0, k), (3, 2, k + 1), divisions=(3, 2, 2)) for k in range(3)]
    >>> pile = boxes(MPI.COMM_SELF, slabs)
    >>> for pair in find_contacts(pile.mesh, pile.cell_tags):
    ...     print(pair.name, len(pair.facet_tags.find(pair.slave)))
    body 0 (cell tag 1) on body 1 (cell tag 2) 6
    body 1 (cell tag 2) on body 2 (cell tag 3) 6
    """
    comm = mesh.comm
    with raise_collectively(comm):
        if distance is not None:
            check_positive(distance, "find_contacts: the distance")
    bodies = find_bodies(mesh, cell_tags)
    check_cells(mesh, bodies)
    facets = ExteriorFacets.of(mesh, bodies)
    opposite = _opposite_facets(comm, facets, distance)
    opposite = opposite.chosen(_is_apart(comm, opposite, bodies))
    if distance is None and not whole_faces:
        opposite = opposite.chosen(_may_touch(comm, opposite, bodies))
    opposite = opposite.chosen(_is_from_slave(comm, opposite))
    surfaces = _surfaces(comm, opposite.rows, facets, whole_faces)
    if not surfaces:
        _warn_of_gaps(comm, facets, bodies)
    contacts = []
    for number, ((slave, master, side), rows) in enumerate(surfaces.items()):
        tags = [2 * number + 1, 2 * number + 2]
        first, second = (bodies.names[body].split(" in ")[0] for body in (slave, master))
        contacts.append(
            ContactPair(
                sorted_tags(
                    mesh,
                    mesh.topology.dim - 1,
                    facets.number[np.concatenate(rows)],
                    np.repeat(tags, [len(part) for part in rows]),
                ),
                *tags,
                name=f"{first} on {second}" + (f", side {side + 1}" if side else ""),
                friction=friction,
            )
        )
    return contacts


@dataclass(frozen=True)
class OppositeFacets:
    """Facets of this rank, each with one opposite to it of another body."""

    rows: Numbers  # (p, 4): bodies of both, the facet, and the number of the other over all ranks
    ratio: Vector  # (p,): size of the other over that of the facet, by their areas
    gap: Vector  # (p,): distance along the facet's normal [m]
    reach: Vector  # (p,): largest gap that is looked for [m]
    cosine: Vector  # (p,): of the angle by which they are inclined to each other

    def chosen(self, kept: Mask) -> OppositeFacets:
        """Return some of the pairs."""
        return OppositeFacets(*(column[kept] for column in vars(self).values()))

    def nearest(self, comm: MPI.Intracomm) -> tuple[float, list[int]]:
        """Return the smallest gap of all ranks, and its bodies; infinite without. Collective."""
        bodies = np.sort(self.rows[:, :2], axis=1)
        pairs = zip(self.gap.tolist(), bodies.tolist(), strict=True)
        nearest: tuple[float, list[int]] = min(comm.allgather(min(pairs, default=(np.inf, []))))
        return nearest


def _opposite_facets(
    comm: MPI.Intracomm, facets: ExteriorFacets, distance: float | None
) -> OppositeFacets:
    """Find the facets opposite to those of this rank. Collective."""
    x, n = facets.corners, facets.number.size
    v, gdim = x.shape[1:]
    reach = edge_lengths(x).min(axis=1) if distance is None else np.full(n, float(distance))
    chosen = [np.arange(n)]
    if comm.size > 1:
        around = np.stack([x.min(axis=1) - reach[:, None], x.max(axis=1) + reach[:, None]], axis=1)
        needed = comm.allgather(BoxTree(around).boxes())
        chosen = facets_in_boxes(comm, needed, BoxTree(x))
    number = first_of_rank(comm, n)[0] + np.arange(n)
    columns = (number, facets.body, facets.vertices, x)
    received = all_to_all(comm, [tuple(column[rows] for column in columns) for rows in chosen])
    number, body, vertices, corners = (np.concatenate(c) for c in zip(*received, strict=True))
    nodes, first, inverse = np.unique(vertices, return_index=True, return_inverse=True)
    points = corners.reshape(-1, gdim)[first]
    others = SurfaceFacets(nodes, Facets(points, inverse.reshape(-1, v)), np.zeros_like(points))
    parts, measures = [np.zeros((0, 4), dtype=np.int64)], [np.zeros((0, 4))]
    if n:
        areas = Planes.of(corners).area
        surface = Facets(x.reshape(-1, gdim), np.arange(n * v).reshape(n, v))
        planes, tree = Planes.of(x), MasterTree(others.facets)
        for block in batches(n, 2048):
            rows = np.arange(block.start, block.stop)
            cells = overlapping_cells(surface, planes, rows, tree, reach)
            cells = cells.select_pairs(body[cells.master] != facets.body[cells.slave])
            cells = cells.select_pairs(_is_near(cells, planes, others, body, reach))
            cells = nearest_layers(cells, planes, tree)
            bodies = (facets.body[cells.slave], body[cells.master])
            parts.append(np.column_stack([*bodies, cells.slave, number[cells.master]]))
            ratio = (areas[cells.master] / planes.area[cells.slave]) ** (1.0 / (gdim - 1))
            gap, normals = np.abs(cells.centre()[1]), (planes.normal, tree.planes.normal)
            cosine = -np.sum(normals[0][cells.slave] * normals[1][cells.master], axis=1)
            measures.append(np.column_stack([ratio, gap, reach[cells.slave], cosine]))
    return OppositeFacets(np.concatenate(parts), *np.concatenate(measures).T)


def _is_near(
    cells: Cells, planes: Planes, others: SurfaceFacets, body: Numbers, reach: Vector
) -> Mask:
    """Tell which pairs (p,) of facets are within reach and overlap by more than rounding.

    A facet behind one is near only if its body penetrates there.
    """
    middle, gap = cells.centre()
    near: Mask = cells.pair_area() > SAME_PLACE * planes.area[cells.slave]
    near &= np.abs(gap) <= reach[cells.slave]
    behind = np.flatnonzero(near & (gap < -RELATIVE_ROUNDING * planes.diameter[cells.slave]))
    facet, master = cells.slave[behind], body[cells.master[behind]]
    in_plane = np.einsum("pa,pad->pd", middle[behind], planes.axes[facet, :-1])
    points = planes.origin[facet] + in_plane
    near[behind] = inside(points, master, others.facets, body)
    return near


def _is_apart(comm: MPI.Intracomm, opposite: OppositeFacets, bodies: Bodies) -> Mask:
    """Tell which pairs are of bodies that are not glued; warn of those that are. Collective."""
    of_bodies = opposite.rows[:, :2]
    first, second = bodies.part[of_bodies].T
    glued = first == second
    pairs = distinct_rows(concatenate_ranks(comm, np.sort(of_bodies[glued], axis=1)))[0]
    with raise_collectively(comm):
        if len(pairs) and comm.rank == 0:
            names = " and ".join(bodies.names[body] for body in pairs[0])
            warn_user(
                f"find_contacts: {len(pairs)} pairs of bodies are near each other, but get no "
                f"contact, because they are connected through facets: the first {names}. Where "
                "they may touch, tag their surfaces and add a ContactPair"
            )
    apart: Mask = ~glued
    return apart


def _may_touch(comm: MPI.Intracomm, opposite: OppositeFacets, bodies: Bodies) -> Mask:
    """Tell which pairs may touch with small strains; warn of bodies without one. Collective.

    Facets that are inclined do not become parallel then: they touch where their bodies are
    nearest to others, within the size of the facets there.
    """
    gap, reach, of_bodies = opposite.gap, opposite.reach, opposite.rows[:, :2].T
    nearest = np.full(len(bodies.names), np.inf)
    size = np.zeros(len(bodies.names))
    for body in of_bodies:
        np.minimum.at(nearest, body, gap)
    comm.Allreduce(MPI.IN_PLACE, nearest, MPI.MIN)
    for body in of_bodies:
        there = gap <= nearest[body] + SAME_PLACE * reach
        np.maximum.at(size, body[there], reach[there])
    comm.Allreduce(MPI.IN_PLACE, size, MPI.MAX)
    may_touch: Mask = gap <= size[of_bodies].max(axis=0)
    may_touch |= opposite.cosine >= np.cos(_INCLINED)
    pair = np.max(of_bodies, axis=0) * nearest.size + np.min(of_bodies, axis=0)
    kept = np.unique(concatenate_ranks(comm, np.unique(pair[may_touch])))
    lost = ~np.isin(pair, kept)
    number = np.unique(concatenate_ranks(comm, np.unique(pair[lost]))).size
    least, names = opposite.chosen(lost).nearest(comm)
    with raise_collectively(comm):
        if number and comm.rank == 0:
            warn_user(
                f"find_contacts: {number} pairs of bodies get no contact, because they are "
                "farther apart than the facets are large where these bodies are nearest to others: "
                f"the nearest {' and '.join(bodies.names[body] for body in names)}, with a gap of "
                f"{least:.3g}. Where they may touch, pass "
                f"contacts=find_contacts(mesh, cell_tags, distance={1.01 * least:.3g})"
            )
    return may_touch


def _warn_of_gaps(comm: MPI.Intracomm, facets: ExteriorFacets, bodies: Bodies) -> None:
    """Warn that no bodies are near each other, and say how far apart the nearest are. Collective.

    Searched is the whole mesh.
    """
    x = concatenate_ranks(comm, facets.corners.reshape(-1, facets.corners.shape[2]))
    found = _opposite_facets(comm, facets, float(np.linalg.norm(np.ptp(x, axis=0))))
    first, second = bodies.part[found.rows[:, :2]].T
    gap, pair = found.chosen(first != second).nearest(comm)
    with raise_collectively(comm):
        if comm.rank == 0:
            names = " and ".join(bodies.names[body] for body in pair)
            warn_user(
                f"find_contacts: none of {len(bodies.names)} bodies are near each other, there is "
                "no contact between them. "
                + (
                    f"The smallest gap is {gap:.3g}, between {names}: where it may close, pass "
                    f"contacts=find_contacts(mesh, cell_tags, distance={1.01 * gap:.3g})"
                    if pair
                    else "No facet is opposite to one of another body"
                )
            )


def _is_from_slave(comm: MPI.Intracomm, opposite: OppositeFacets) -> Mask:
    """Tell which pairs are of the two bodies' slave. Collective.

    The condition number grows with the size of the master's facets over that of the slave's
    opposite them. The slave is the body for which the largest such ratio is the smaller one, of
    equal ones that with the lower number; a body without facets that are near the other is none.
    """
    ratio, is_lower = opposite.ratio, opposite.rows[:, 0] < opposite.rows[:, 1]
    ratios = np.where(is_lower, [ratio, 1.0 / ratio], [1.0 / ratio, ratio])
    values = np.column_stack([*ratios, is_lower, ~is_lower])
    pairs, inverse = distinct_rows(np.sort(opposite.rows[:, :2], axis=1))
    largest = np.zeros((len(pairs), 4))
    np.maximum.at(largest, inverse, values)
    every, inverse_of = distinct_rows(concatenate_ranks(comm, pairs))
    of_all = np.zeros((len(every), 4))
    np.maximum.at(of_all, inverse_of, concatenate_ranks(comm, largest))
    as_lower, as_higher, lower_is_near, higher_is_near = of_all.T
    lower = (as_lower <= (1.0 + RELATIVE_ROUNDING) * as_higher) | (higher_is_near == 0.0)
    lower &= lower_is_near > 0.0
    first = first_of_rank(comm, len(pairs))[0]
    is_from_slave: Mask = is_lower == lower[inverse_of[first + inverse]]
    return is_from_slave


def _surfaces(
    comm: MPI.Intracomm, opposite: Numbers, facets: ExteriorFacets, whole_faces: bool
) -> dict[tuple[int, int, int], tuple[Numbers, Numbers]]:
    """Return this rank's facets of slave and master of each pair. Collective.

    The keys, alike on all ranks, are the bodies of slave and master and the side of the slave.
    """
    face = facets.faces(comm)
    slaves = distinct_rows(opposite[:, :3])[0]
    if whole_faces:
        slaves = _extended(comm, slaves, face)
    side_of = _sides(comm, slaves, facets, face)

    def keys(rows: Numbers) -> Numbers:
        distinct, inverse = distinct_rows(np.column_stack([rows[:, :2], face[rows[:, 2]]]))
        distinct[:, 2] = [side_of.get((a, b, number), 0) for a, b, number in distinct.tolist()]
        return distinct[inverse]

    slaves = np.column_stack([keys(slaves), slaves[:, 2]])
    masters = distinct_rows(np.column_stack([keys(opposite[:, :3]), opposite[:, 3]]))[0]
    masters = _sent_to_owners(comm, masters, facets.number.size)
    if whole_faces:
        masters = _extended(comm, masters, face)
    pairs = distinct_rows(concatenate_ranks(comm, distinct_rows(slaves[:, :3])[0]))[0]
    parts = [_split(rows, pairs) for rows in (slaves, masters)]
    return dict(zip(map(tuple, pairs.tolist()), zip(*parts, strict=True), strict=True))


def _extended(comm: MPI.Intracomm, rows: Numbers, face: Numbers) -> Numbers:
    """Return rows (n, k) of a pair and a facet with all facets of their faces. Collective."""
    whole = distinct_rows(np.column_stack([rows[:, :-1], face[rows[:, -1]]]))[0]
    whole = distinct_rows(concatenate_ranks(comm, whole))[0]
    order = np.argsort(face, kind="stable")
    begin, end = (np.searchsorted(face[order], whole[:, -1], side) for side in ("left", "right"))
    number = end - begin
    place = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
    facet = order[np.repeat(begin, number) + place]
    return np.column_stack([np.repeat(whole[:, :-1], number, axis=0), facet])


def _sides(
    comm: MPI.Intracomm, slaves: Numbers, facets: ExteriorFacets, face: Numbers
) -> dict[tuple[int, int, int], int]:
    """Return the side of faces of a slave that meet others of the same pair. Collective.

    Of the slave's faces that have a common node, each gets a side of its own. The keys are two
    bodies and a face; faces that meet no others are not there, they are on side 0.
    """
    pairs, facet = slaves[:, :2], slaves[:, 2]
    faces = np.column_stack([pairs, face[facet]])
    vertices = facets.vertices[facet]
    directory = Directory(comm, np.unique(vertices))
    vertex, rows = directory.collect(vertices.ravel(), np.repeat(faces, vertices.shape[1], axis=0))
    rows = distinct_rows(np.column_stack([rows[:, :2], vertex, rows[:, 2]]))[0]
    meetings = [np.zeros((0, 4), dtype=np.int64)]
    for step in range(1, len(rows)):
        meet = (rows[step:, :3] == rows[:-step, :3]).all(axis=1)
        if not meet.any():
            break
        meetings.append(np.column_stack([rows[step:][meet][:, [0, 1, 3]], rows[:-step][meet, 3]]))
    neighbours: dict[tuple[int, int, int], set[int]] = {}
    for a, b, *ends in concatenate_ranks(comm, np.concatenate(meetings)).tolist():
        for first, second in (ends, ends[::-1]):
            neighbours.setdefault((a, b, first), set()).add(second)
    places: dict[tuple[int, int, int], list[Any]] = {}
    for key, corners in zip(map(tuple, faces.tolist()), facets.corners[facet], strict=True):
        if key in neighbours:
            places.setdefault(key, []).extend(map(tuple, corners.tolist()))
    parts = comm.allgather({key: (min(x), max(x)) for key, x in places.items()})
    # the order of faces does not depend on how facets are distributed
    place = {}
    for key in neighbours:
        low, high = zip(*(part[key] for part in parts if key in part), strict=True)
        place[key] = min(low), max(high)
    side_of: dict[tuple[int, int, int], int] = {}
    for key in sorted(neighbours, key=lambda key: (key[:2], place[key])):
        taken = {side_of.get((*key[:2], other)) for other in neighbours[key]}
        side_of[key] = min(set(range(len(taken) + 1)) - taken)
    return side_of


def _sent_to_owners(comm: MPI.Intracomm, rows: Numbers, owned: int) -> Numbers:
    """Send rows, the last column a facet's number over all ranks, to its owner. Collective.

    Of those that arrive, each once, the last column is the facet on this rank.
    """
    firsts = np.cumsum([0, *comm.allgather(owned)])
    rank = np.searchsorted(firsts, rows[:, -1], "right") - 1
    (arrived,) = send_rows(comm, rank, rows)
    arrived[:, -1] -= firsts[comm.rank]
    return distinct_rows(arrived)[0]


def _split(rows: Numbers, pairs: Numbers) -> list[Numbers]:
    """Return the last column of rows, sorted by the others, for each pair (n, k)."""
    _, inverse = distinct_rows(np.concatenate([pairs, rows[:, :-1]]))
    number = inverse[len(pairs) :]
    order = np.argsort(number, kind="stable")
    cuts = np.searchsorted(number[order], np.arange(1, len(pairs)))
    return np.split(rows[order, -1], cuts) if len(pairs) else []


@dataclass(frozen=True)
class ExteriorFacets:
    """The facets (f,) on the boundary of the mesh that this rank owns, with straight edges."""

    number: Indices  # local numbers of the facets
    body: Numbers
    vertices: Numbers  # (f, v): numbers in the input of the mesh, oriented outwards as in `Facets`
    corners: Vector  # (f, v, gdim) [m]

    @staticmethod
    def of(domain: Mesh, bodies: Bodies) -> ExteriorFacets:
        """Find the facets of this rank's cells that have no neighbour."""
        cell, facet = np.nonzero(exterior_cell_facets(domain))
        nodes = oriented_corners(domain, cell, facet)
        # the numbers in the input are those of all ranks, see `_surface_nodes`
        input_numbers = np.asarray(domain.geometry.input_global_indices, dtype=np.int64)
        return ExteriorFacets(
            cell_facets(domain)[cell, facet],
            bodies.of_cell[cell],
            input_numbers[nodes],
            domain.geometry.x[nodes, : domain.geometry.dim],
        )

    def faces(self, comm: MPI.Intracomm) -> Numbers:
        """Return the number, over all ranks, of the smooth face that each facet is in. Collective.

        A face ends where normals of neighbours turn by more than 60 degrees.
        """
        v, gdim = self.corners.shape[1:]
        ends = self.vertices[..., None]
        if gdim == 3:
            ends = np.sort(np.stack([self.vertices, np.roll(self.vertices, -1, axis=1)], 2), axis=2)
        edges = ends.reshape(self.number.size * v, gdim - 1)
        facet = np.repeat(np.arange(self.number.size), v)
        keys = np.column_stack([self.body[facet], edges])
        normal = Planes.of(self.corners).normal[facet]
        part = _components(_smooth_pairs(keys, normal, facet), self.number.size)
        # parts of faces on this rank, numbered over all ranks, then joined through their edges
        first, total = first_of_rank(comm, int(part.max(initial=-1)) + 1)
        directory = Directory(comm, np.unique(edges[:, 0]))
        _, *columns = directory.collect(edges[:, 0], keys, normal, first + part[facet])
        joined = distinct_rows(_smooth_pairs(*columns))[0]
        face: Numbers = _components(concatenate_ranks(comm, joined), total)[first + part]
        return face


def _smooth_pairs(keys: Numbers, normal: Vector, label: Numbers) -> Numbers:
    """Return pairs (p, 2) of different labels of facets that meet smoothly at edges (n, k)."""
    least_cosine = 0.5
    order = np.lexsort(keys.T)
    keys, normal, label = keys[order], normal[order], label[order]
    smooth = np.sum(normal[1:] * normal[:-1], axis=1) > least_cosine
    meet = (keys[1:] == keys[:-1]).all(axis=1) & smooth & (label[1:] != label[:-1])
    return np.column_stack([label[:-1][meet], label[1:][meet]])


def _components(pairs: Numbers, size: int) -> Numbers:
    """Return the connected component of each of `size` labels."""
    graph = sp.csr_matrix((np.ones(len(pairs)), tuple(pairs.T)), shape=(size, size))
    number: Numbers = connected_components(graph, directed=False)[1].astype(np.int64)
    return number

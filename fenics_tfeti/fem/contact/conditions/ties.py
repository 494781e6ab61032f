"""Equality rows of ties: of mortar conditions, of surfaces that match, and any of the user's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.contact_conditions import row_values
from fenics_tfeti.fem.contact.conditions.mortars import tied_conditions
from fenics_tfeti.fem.contact.conditions.summary import matching_summaries
from fenics_tfeti.fem.contact.conditions.surface_pairs import check_covered
from fenics_tfeti.fem.contact.descriptions.surfaces import SurfacePair, surface_tags
from fenics_tfeti.fem.contact.descriptions.ties import (
    BoltPreload,
    LinearRows,
    PeriodicPair,
    Tie,
    TiedPair,
)
from fenics_tfeti.fem.contact.surfaces.nearby import gather_nearby
from fenics_tfeti.fem.contact.surfaces.rotations import SurfaceRotations
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, Surface, tagged_surface
from fenics_tfeti.fem.geometry.normals import facet_normals
from fenics_tfeti.fem.geometry.vectors import angles_between, cross, nearest_rotation, unit
from fenics_tfeti.fem.messages import first_wrong
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING, SAME_PLACE
from fenics_tfeti.fem.user_data import as_direction, vectors_at
from fenics_tfeti.feti.system import ContactRows, Subdomain, are_same
from fenics_tfeti.parallel import concatenate_ranks, raise_collectively
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class Preload:
    """The shortening of a bolt, given or an unknown of the torn system."""

    axis: Vector  # (gdim,), on the side of the slave's outward normal
    shortening: float | None  # [m]
    # without load: the body that the shortening moves along the axis where the force is given
    body: Subdomain | None = None
    force: float = 0.0  # [N]
    rotation: Vector | None = None  # (gdim, gdim), by which the cut has turned

    @property
    def direction(self) -> Vector:
        """The axis (gdim,) where the bolt is."""
        return self.axis if self.rotation is None else self.rotation @ self.axis

    def subdomain(self, number: int) -> Subdomain:
        """Return the body with a number and the present load."""
        assert self.body is not None
        return replace(self.body, body=number, load=self.force * self.axis)


@dataclass(frozen=True)
class TiedConditions:
    """The equality rows of a tie whose slave nodes this rank owns."""

    boundary: MeshBoundary
    rows: ContactRows  # the normals are directions of the slave's displacement
    nodes: Numbers  # (k,): slave nodes, ascending
    area: Vector  # (k,): that belongs to each; NaN where there is none [m^2 or m]
    summary: dict[str, Any]  # the tie's entry of `ContactEntry.matching`
    # of mortar conditions the slave's surface, and the components (s, gdim) prescribed at its nodes
    surface: Surface | None = None
    prescribed: Mask | None = None
    shares: sp.csr_matrix | None = None  # see `mean_traction`
    preload: Preload | None = None  # of bolts
    # of surfaces with gaps between them the rows of the mean displacements alone
    of_means: ContactRows | None = None

    @property
    def name(self) -> str:
        """The name of the tie."""
        return self.summary["contact"]

    @property
    def coordinates(self) -> Vector:
        """The undeformed slave nodes (k, 3) [m]."""
        return self.boundary.coordinates[self.nodes - self.boundary.nodes.first]

    @property
    def is_mortar(self) -> bool:
        """Whether the rows are mortar conditions of two surfaces."""
        return self.prescribed is not None

    def forces(self, row_forces: Vector) -> Vector:
        """Return the forces (k, gdim) on the slave nodes of those of the rows [N]."""
        force = np.zeros((self.nodes.size, self.rows.coefficients.shape[1]))
        # the force of a row acts on the slave against its direction
        position = np.searchsorted(self.nodes, self.rows.slave)
        np.subtract.at(force, position, row_forces[:, None] * self.rows.normal)
        return force

    def with_turned_axis(self, uh: Function) -> TiedConditions:
        """Return the rows of a bolt whose axis has turned with its cut. Collective."""
        assert self.preload is not None
        nodes = self.boundary.nodes
        comm, weight = nodes.comm, self.area[:, None]
        start = self.coordinates[:, : nodes.components]
        end = start + nodes.values(uh)[self.nodes - nodes.first]
        places = np.column_stack([start, end, np.ones(len(start))])
        sums = comm.allreduce(np.sum(weight * places, axis=0))
        first, second = np.split(sums[:-1] / sums[-1], 2)
        # fitted to the displacement of the slave's side by least squares
        rotation = nearest_rotation(comm.allreduce((weight * (end - second)).T @ (start - first)))
        turned = self.rows.coefficients.copy()
        # the shortening is along the axis of the undeformed bolt
        in_mesh = self.rows.nodes < nodes.total
        turned[in_mesh] = turned[in_mesh] @ rotation.T
        return replace(
            self,
            rows=replace(self.rows, coefficients=turned),
            preload=replace(self.preload, rotation=rotation),
        )

    def with_turned_gaps(self, deformed: MeshBoundary) -> TiedConditions:
        """Return the rows of surfaces whose gaps turn with the slave's facets. Collective.

        With the mean vectors g from the master to the slave, turned by R, the rows vanish where the
        surfaces are apart by Rg now. Linearised they leave rigid motions free.
        """
        assert self.of_means is not None and self.surface is not None
        rows, nodes = self.of_means, self.boundary.nodes
        before, now = (
            boundary.coordinates[: nodes.owned, : nodes.components]
            for boundary in (self.boundary, deformed)
        )
        direction = rows.normal
        weights = np.sum(rows.coefficients * direction[rows.row], axis=1)
        gap = np.zeros_like(direction)
        np.add.at(gap, rows.row, weights[:, None] * nodes.values_at(before, rows.nodes))
        position = self.surface.rows_of(rows.slave)
        rotations = SurfaceRotations.of(self.surface, deformed)
        gap = rotations.turned(gap, position)
        unused = ((0, 0), (0, 3 - nodes.components))
        moment = cross(np.pad(direction, unused), np.pad(gap, unused))
        chosen = np.flatnonzero(moment.any(axis=1))
        row, corners, coefficients = rotations.terms(moment[chosen], position[chosen])
        turned = rows.with_slave_terms(chosen[row], corners, coefficients)
        apart = row_values(nodes, rows, now) - np.sum(gap * direction, axis=1)
        moved = row_values(nodes, turned, now - before)
        return replace(self, rows=replace(turned, gap=moved - apart))


def rows_of_tie(
    boundary: MeshBoundary, tie: Tie, number: int, name: str, fixed: Mask, known: Preload | None
) -> TiedConditions:
    """Return the rows of a tie, with `prescribed_components`. Collective.

    A bolt of this number had the known preload.
    """
    match tie:
        case TiedPair():
            return _tied_surfaces(boundary, tie, name, fixed)
        case PeriodicPair():
            return _periodic_rows(boundary, tie, name)
        case BoltPreload():
            return _preload_rows(boundary, tie, number, name, known)
        case LinearRows():
            return _linear_rows(boundary, tie, name)


def _tied_surfaces(
    boundary: MeshBoundary, pair: TiedPair, name: str, fixed: Mask
) -> TiedConditions:
    """Find the conditions of a tied pair. Collective."""
    comm = boundary.nodes.comm
    slave, tagged_master = _surfaces(boundary, pair, name)
    master = gather_nearby(tagged_master, slave)
    slave.check_separate(
        np.isin(slave.nodes, master.nodes),
        "Surfaces that share nodes are one already: leave the pair out, or give each part nodes of "
        "its own by fenics_tfeti.io.split_interfaces",
    )
    fixed = fixed[slave.local]
    conditions = tied_conditions(slave, slave.oriented_part(), master, fixed)
    # nodes where a component is prescribed have no condition for it
    sizes = [comm.allreduce(part.terms.slave.size) for part in conditions]
    fullest = conditions[int(np.argmax(sizes))]
    check_covered([slave], [int(fullest.covered.sum())], [fullest.area.size])
    rows = slave.rows_of(fullest.terms.slave)
    distance = np.linalg.norm(fullest.gap, axis=1)
    slave.check_joined(distance, rows)
    gap, accuracy = np.sum(fullest.gap * slave.normal[rows], axis=1), fullest.accuracy()
    (summary,) = matching_summaries(
        comm,
        [name],
        "tied",
        slave.contact[rows],
        gap,
        accuracy.angle,
        slave.contact,
        area=fullest.area,
        covered_area=accuracy.covered_area,
    )
    nodes, first = np.unique(
        np.concatenate([part.terms.slave for part in conditions]), return_index=True
    )
    # nodes have the same shares in all components
    of_parts = [part.shares.matrix for part in conditions if part.shares is not None]
    shares = sp.vstack(of_parts, format="csr")[first]
    area = np.zeros(nodes.size)
    for part in conditions:
        area[np.searchsorted(nodes, part.terms.slave)] = part.area
    components = [
        part.terms.rows(np.tile(axis, (part.area.size, 1)), np.zeros(part.area.size), 0)
        for part, axis in zip(conditions, np.eye(len(conditions)), strict=True)
    ]
    rows_of_all = ContactRows.concatenate(components)
    tied = TiedConditions(boundary, rows_of_all, nodes, area, summary, slave, fixed, shares)
    has_gaps = comm.allreduce(bool(slave.without_rounding(distance, slave.contact[rows]).any()))
    return replace(tied, of_means=rows_of_all).with_turned_gaps(boundary) if has_gaps else tied


def _surfaces(boundary: MeshBoundary, pair: SurfacePair, name: str) -> tuple[Surface, Surface]:
    """Return the slave and the master of a pair. Collective."""
    slave, master = (
        tagged_surface(boundary, pair.facet_tags, tag, name, role)
        for role, tag in zip(("slave", "master"), surface_tags(pair), strict=True)
    )
    return slave, master


@dataclass(frozen=True)
class _Match:
    """The nodes of a slave's surface, at its vertices and between them, and their partners."""

    surface: Surface
    nodes: Numbers  # (k,): global nodes that this rank owns, ascending
    master: Numbers  # (k,): the master's nodes
    distance: Vector  # (k,): of the master's nodes from the places where they should be [m]
    angle: Vector  # (k,): between the normals of facets and the opposite of the master's [degrees]

    def conditions(self, kind: str, rows: ContactRows) -> TiedConditions:
        """Return the conditions with these rows. Collective."""
        surface = self.surface
        contact = np.zeros(self.nodes.size, dtype=np.int64)
        distance = surface.without_rounding(self.distance, contact)
        whole = surface.areas(surface.whole)
        area = np.full(self.nodes.size, np.nan)
        area[np.searchsorted(self.nodes, surface.nodes)] = whole
        (summary,) = matching_summaries(
            surface.comm,
            surface.names,
            kind,
            contact,
            np.zeros(self.nodes.size),
            self.angle,
            contact,
            distance,
            surface.size.min(initial=np.inf),
            np.nan_to_num(area),
            surface.area.sum(keepdims=True),
        )
        return TiedConditions(surface.boundary, rows, self.nodes, area, summary)


def _periodic_rows(boundary: MeshBoundary, pair: PeriodicPair, name: str) -> TiedConditions:
    """Return the rows of a periodic pair. Collective."""
    comm, gdim = boundary.nodes.comm, boundary.nodes.components
    with raise_collectively(comm):
        Q = np.identity(gdim) if pair.rotation is None else np.asarray(pair.rotation, dtype=float)
        t = np.zeros(gdim) if pair.translation is None else np.asarray(pair.translation, float)
        for what, shape, expected in (
            ("rotation", Q.shape, (gdim, gdim)),
            ("translation", t.shape, (gdim,)),
        ):
            if shape != expected:
                raise InputError(f"{name}: the {what} has shape {shape}, expected {expected}")
    match = _matched(boundary, pair, name, Q, t)
    jump = np.zeros((match.nodes.size, gdim))
    if pair.jump is not None:
        places = boundary.coordinates[match.nodes - boundary.nodes.first]
        jump = vectors_at(comm, pair.jump, places, gdim, f"the jump of {name}")
    rows = _rows(match.nodes, match.master, np.identity(gdim), Q, jump)
    return match.conditions("periodic", rows)


def _preload_rows(
    boundary: MeshBoundary, bolt: BoltPreload, number: int, name: str, known: Preload | None
) -> TiedConditions:
    """Return the rows of the cut through a bolt: across its axis and along it. Collective.

    If its force is given, the shortening is the motion of a body of one node, which is taken from a
    known preload of this number if it is the same.
    """
    gdim = boundary.nodes.components
    match = _matched(boundary, bolt, name, np.identity(gdim), np.zeros(gdim))
    axis = _axis(match.surface, bolt)
    # the first of an orthonormal basis
    basis = np.linalg.qr(np.column_stack([axis, np.identity(gdim)]))[0].T
    basis[0] = axis
    jump = np.tile((bolt.shortening or 0.0) * axis, (match.nodes.size, 1))
    rows = _rows(match.nodes, match.master, basis, np.identity(gdim), jump)
    preload = Preload(axis, bolt.shortening)
    if bolt.force is not None:
        # a node in the middle of the cut that can move along the axis
        area, points = match.surface.area, match.surface.points
        sums = match.surface.comm.allreduce(np.append(area @ points, area.sum()))
        middle, node = sums[None, :-1] / sums[-1], boundary.nodes.total + number
        body = Subdomain.rigid(np.zeros(gdim), middle, [node], 0, axis[:, None])
        if known is not None and known.body is not None and are_same([known.body], [body]):
            body = known.body
        preload = Preload(axis, None, body, bolt.force)
        along = np.flatnonzero(np.arange(rows.size) % gdim == 0)
        size = (along.size, 1)
        rows = rows.with_terms(along, np.repeat(body.nodes, along.size), np.tile(-axis, size))
    return replace(match.conditions("bolt", rows), preload=preload)


def _linear_rows(boundary: MeshBoundary, given: LinearRows, name: str) -> TiedConditions:
    """Return the user's rows, those with the slaves that this rank owns. Collective."""
    nodes = boundary.nodes
    gdim = nodes.components
    slaves, masters, offsets = (
        np.asarray(part).astype(np.int64) for part in (given.slaves, given.masters, given.offsets)
    )
    with raise_collectively(nodes.comm):
        if slaves.size and not (slaves.min() >= 0 and slaves.max() < gdim * nodes.owned):
            raise InputError(
                f"{name}: a slave is none of the {gdim * nodes.owned} degrees of freedom that "
                f"rank {nodes.comm.rank} owns; each rank gives the conditions of its own slaves"
            )
        if masters.size and not (masters.min() >= 0 and masters.max() < gdim * nodes.total):
            raise InputError(f"{name}: a master is none of the {gdim * nodes.total} unknowns")
    row = np.repeat(np.arange(slaves.size), np.diff(offsets))
    dofs = np.append(slaves + gdim * nodes.first, masters)
    factor = np.append(np.ones(slaves.size), -np.asarray(given.coefficients, dtype=float))
    row = np.append(np.arange(slaves.size), row)
    shape = (slaves.size, gdim * nodes.total)
    terms = sp.csr_matrix((factor, (row, dofs)), shape).tobsr((1, gdim))
    # the slave's node comes first, then those of the masters
    slave = slaves // gdim + nodes.first
    row = np.repeat(np.arange(slaves.size), np.diff(terms.indptr))
    order = np.lexsort((terms.indices, terms.indices != slave[row], row))
    rows = ContactRows(
        terms.indptr,
        terms.indices[order],
        terms.data[order, 0],
        np.broadcast_to(np.asarray(given.values, dtype=float), slaves.shape).copy(),
        np.zeros(slaves.size, dtype=np.int64),
    )
    distinct, none = np.unique(slave), np.zeros(slaves.size)
    (summary,) = matching_summaries(
        nodes.comm, [name], "rows", rows.contact, none, none, rows.contact
    )
    return TiedConditions(boundary, rows, distinct, np.full(distinct.size, np.nan), summary)


def _matched(
    boundary: MeshBoundary, pair: PeriodicPair | BoltPreload, name: str, Q: Vector, t: Vector
) -> _Match:
    """Find for each slave node x' the master's node x with x' = Qx + t, facet by facet. Collective.

    Several bodies may have nodes at one place: those of facets that match are partners.
    """
    slave, tagged_master = _surfaces(boundary, pair, name)
    master = tagged_master.gathered()
    if isinstance(pair, BoltPreload):
        slave.check_separate(
            np.isin(slave.nodes, master.nodes),
            "The cut does not go through the shank: extend the facets that "
            "fenics_tfeti.io.split_interfaces opens to its surface",
        )
    numbers = boundary.nodes.to_global(slave.facet_nodes)
    x = boundary.coordinates[slave.facet_nodes, : len(t)]
    image = (master.points @ Q.T + t)[master.facets.nodes]
    facet = cKDTree(image.mean(axis=1)).query(x.mean(axis=1))[1]
    between = np.linalg.norm(x[:, :, None] - image[facet][:, None], axis=3)
    partner = np.take_along_axis(master.facets.nodes[facet], between.argmin(axis=2), axis=1)
    distance = between.min(axis=2)
    size = slave.comm.allreduce(float(slave.size.min(initial=np.inf)), MPI.MIN)
    _check_matching(slave, distance.max(axis=1) > SAME_PLACE * size, x, facet, image)
    n, opposite = (unit(facet_normals(ends[:, : len(t)])) for ends in (x, image[facet]))
    angle = np.repeat(angles_between(n, -opposite), numbers.shape[1])

    all_nodes, partner = boundary.nodes, master.nodes[partner].ravel()
    columns = np.column_stack([partner, -partner, distance.ravel(), angle])
    local = np.unique(all_nodes.to_owners(numbers.ravel())[0])
    largest = all_nodes.reduce_at_owners(numbers.ravel(), columns, np.maximum)[local]
    highest, lowest = largest[:, 0].astype(np.int64), -largest[:, 1].astype(np.int64)
    places = boundary.coordinates[local, : len(t)]
    if bad := first_wrong(slave.comm, highest != lowest, places):
        raise InputError(
            f"{name}: {bad.number} nodes of the slave have several partners, the first at "
            f"{bad.place}: the facets of the master around them share no nodes. Exchange slave and "
            "master"
        )
    return _Match(slave, local + all_nodes.first, highest, *largest[:, 2:].T)


def _check_matching(slave: Surface, alone: Mask, x: Vector, facet: Numbers, image: Vector) -> None:
    """Check that each facet of either surface has one of the other. Collective.

    `alone` (f,) are the slave's facets at x that have none, `facet` the nearest ones of the
    master's, whose images all ranks have.
    """
    found = np.zeros(len(image), dtype=bool)
    found[concatenate_ranks(slave.comm, facet[~alone])] = True
    for side, other, comm, wrong, places in (
        ("slave", "master", slave.comm, alone, x),
        ("master", "slave", MPI.COMM_SELF, ~found, image),
    ):
        total = comm.allreduce(len(places))
        if bad := first_wrong(comm, wrong, places.mean(axis=1)):
            raise InputError(
                f"{slave.names[0]}: {bad.number} of {total} facets of the {side} have no facet of "
                f"the {other} with the same nodes, the first around {bad.place} on the slave's "
                "side: the surfaces do not match. Mesh them alike (setPeriodic in Gmsh), or "
                "correct the translation or rotation from the master to the slave"
            )


def _axis(surface: Surface, bolt: BoltPreload) -> Vector:
    """Return the axis of a bolt on the side of the slave's outward normal. Collective."""
    name, mean = surface.names[0], surface.comm.allreduce(surface.area @ surface.normal)
    normal: Vector = mean / np.linalg.norm(mean)
    if bolt.axis is not None:
        with raise_collectively(surface.comm):
            axis = as_direction(bolt.axis, f"{name}: the axis")
            if axis.shape != normal.shape or abs(axis @ normal) < RELATIVE_ROUNDING:
                raise InputError(
                    f"{name}: the axis {bolt.axis!r} is in the plane of the cut, or has another "
                    "dimension than the mesh; it has to go through the cut"
                )
        return axis if axis @ normal > 0.0 else -axis
    if bad := surface.first_wrong(np.linalg.norm(surface.normal - normal, axis=1) > SAME_PLACE):
        raise InputError(
            f"{name}: the cut is not plane, at {bad.number} nodes its normals are not the mean one "
            f"{np.round(normal, 4).tolist()}, the first at {bad.place}. Cut the shank by a plane, "
            "or give the axis"
        )
    return normal


def _rows(
    slave: Numbers, master: Numbers, directions: Vector, Q: Vector, jump: Vector
) -> ContactRows:
    """Return d'(u(slave) - Qu(master) - jump) = 0 for each direction d, node by node.

    Of a node that is its own image, rows that vanish are left out.
    """
    gdim = len(directions)
    row_slave, row_master = np.repeat(slave, gdim), np.repeat(master, gdim)
    of_slave, of_master = (np.tile(d, (slave.size, 1)) for d in (directions, -directions @ Q))
    own = row_slave == row_master
    of_slave = np.where(own[:, None], of_slave + of_master, of_slave)
    terms = np.where(own, 1, 2)
    terms[own & (np.linalg.norm(of_slave, axis=1) <= RELATIVE_ROUNDING)] = 0
    chosen = np.stack([terms > 0, terms > 1], axis=1)
    kept = terms > 0
    return ContactRows(
        np.append(0, np.cumsum(terms[kept])),
        np.stack([row_slave, row_master], axis=1)[chosen],
        np.stack([of_slave, of_master], axis=1)[chosen],
        (jump @ directions.T).ravel()[kept],
        np.zeros(int(kept.sum()), dtype=np.int64),
    )

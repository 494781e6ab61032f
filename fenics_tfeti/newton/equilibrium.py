"""Equilibrium of deformed bodies in contact: rows at a displacement, multipliers, residual.

Multipliers belong to slave nodes: those of one step press along the normals of the next.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import format_point
from fenics_tfeti.fem.contact.conditions.contact_conditions import SlaveValues, row_values
from fenics_tfeti.fem.contact.conditions.friction import SlipOrigin
from fenics_tfeti.fem.contact.contact_set import ContactSet
from fenics_tfeti.fem.displacement import owned_values, prescribed_components
from fenics_tfeti.fem.geometry.vectors import unit
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.feti.solver import TornSolution
from fenics_tfeti.feti.system import ContactRows, Friction
from fenics_tfeti.newton.rounding import Rounding
from fenics_tfeti.parallel import largest_of_ranks
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class DeformedRows:
    """The conditions of surfaces deformed by u, with gaps and slips for an increment of u."""

    contact_set: ContactSet
    contacts: ContactRows
    friction: Friction
    tied: ContactRows

    @staticmethod
    def of(contact_set: ContactSet, uh: Function, origin: SlipOrigin) -> DeformedRows:
        """Return those of conditions of the deformed surfaces. Collective.

        Slip is that from the origin to u and to where the rigid bodies are.
        """
        nodes, u = contact_set.boundary.nodes, owned_values(uh)
        contacts, tied = contact_set.rows(), contact_set.tied_rows()
        free = contact_set.bodies.free_displacements(nodes.total)
        moved = row_values(nodes, contacts, u, free)
        here = replace(contact_set, bodies=replace(contact_set.bodies, from_here=True))
        return DeformedRows(
            contact_set,
            replace(contacts, gap=contacts.gap - moved),
            contact_set.with_bond_slips(here.friction_rows(origin, u), u),
            replace(tied, gap=tied.gap - row_values(nodes, tied, u, free)),
        )

    @property
    def surface_nodes(self) -> Numbers:
        """The global nodes (s,) of the slaves' surfaces, one contact after the other."""
        nodes = [conditions.surface.nodes for conditions in self.contact_set.all_conditions]
        return np.concatenate([np.zeros(0, dtype=np.int64), *nodes])

    @cached_property
    def place(self) -> Numbers:
        """The place of each row's slave node among `surface_nodes` (k,)."""
        first, places = 0, [np.zeros(0, dtype=np.int64)]
        for conditions in self.contact_set.all_conditions:
            places.append(first + conditions.on_surface)
            first += conditions.surface.nodes.size
        return np.concatenate(places)

    @property
    def distance(self) -> Vector:
        """Distances of the surfaces at each row (k,) [m], negative inside."""
        return self.contacts.gap / self.contacts.length

    @property
    def is_bonded(self) -> Mask:
        """Tell which rows (k,) may pull, by the springs of bonds."""
        return np.isfinite(np.asarray(self.contacts.compliance)[:, 1])

    def compliance(self, multipliers: Multipliers) -> Vector:
        """Return how far a unit of force closes each row (k,) [m/N]; zero is rigid.

        That of bonds is another one where they pull.
        """
        pressed, pulled = np.asarray(self.contacts.compliance).T
        pulls = self.is_bonded & (self.normal_forces(multipliers) < 0.0)
        return np.where(pulls, pulled, pressed)

    def given_way(self, multipliers: Multipliers) -> Vector:
        """Return how far springs give way (k,) [m]."""
        return self.compliance(multipliers) * self.normal_forces(multipliers)

    def slips_left(self, multipliers: Multipliers) -> Vector:
        """Return `Friction.slip` (k, gdim - 1) without what springs have given way by [m]."""
        elastic = self.elastic_slip(self.friction_forces(multipliers))
        return np.asarray(self.friction.slip) + elastic

    def distances_under(self, multipliers: Multipliers) -> Vector:
        """Return distances (k,) without what springs give way by: zero of rows that press [m]."""
        return self.distance + self.given_way(multipliers)

    def excess(self, multipliers: Multipliers, stiffness: float, negligible: float) -> Vector:
        """Return by how much forces break the law of friction, (k,) at each site [N].

        It is the distance of a tangential force t from the projection of t + stiffness * slip on
        the disc of the slip bound: what t is above the bound, or away from it where the node slips;
        slip, times the stiffness [N/m], where the force is below the bound. Slips up to a length
        [m] are negligible.
        """
        force, bound = self.friction_forces(multipliers), self.slip_bounds(multipliers)
        slip = self.slip - self.elastic_slip(force)
        # in directions without force supports decide the slip
        slip = np.where((force == 0.0) | (np.abs(slip) <= negligible), 0.0, slip)
        trial = force + stiffness * slip
        size = np.linalg.norm(trial, axis=1)
        share = np.divide(bound, size, out=np.ones_like(size), where=size > bound)
        return np.linalg.norm(force - share[:, None] * trial, axis=1)

    @property
    def slip(self) -> Vector:
        """Slip since the last load step (k, gdim - 1) along the tangents of each site [m].

        Of bonds it is that of all steps.
        """
        return -np.asarray(self.friction.slip)

    def elastic_slip(self, force: Vector) -> Vector:
        """Return the slips (k, gdim - 1) of bonds under tangential forces [m]."""
        return np.asarray(self.friction.compliance)[:, None] * force

    def friction_forces(self, multipliers: Multipliers) -> Vector:
        """Return the tangential forces (k, gdim - 1) along the tangents of each site [N]."""
        traction = multipliers.tangential[self.place[self.friction.row]]
        length = self.contacts.length[self.friction.row]
        return length[:, None] * np.einsum("kta,ka->kt", self.friction.tangents, traction)

    def possible(self, normal: Vector) -> Vector:
        """Return normal forces (k,), none that pull where nothing is bonded [N]."""
        return np.where(self.is_bonded, normal, np.maximum(normal, 0.0))

    def normal_forces(self, multipliers: Multipliers) -> Vector:
        """Return the normal forces (k,) of the contact rows [N]."""
        return self.contacts.length * multipliers.normal[self.place]

    def slip_bounds(self, multipliers: Multipliers) -> Vector:
        """Return the slip bounds (k,) of normal forces [N]."""
        friction, normal = self.friction, self.normal_forces(multipliers)
        pressing = np.maximum(normal[friction.row], 0.0)
        return friction.bound + np.asarray(friction.coefficient) * pressing

    def at_bounds(self, multipliers: Multipliers) -> Multipliers:
        """Return multipliers with forces at their bounds, in their directions, where nodes slip."""
        friction, place = self.friction, self.place[self.friction.row]
        # bonds hold without bound, and do not slip
        slipping = multipliers.slipping[place] & np.isfinite(friction.bound)
        if not slipping.any():
            return multipliers
        along = unit(self.friction_forces(multipliers))
        bounds = np.where(slipping, self.slip_bounds(multipliers), 0.0)
        traction = bounds / self.contacts.length[friction.row]
        vectors = np.einsum("kt,kta->ka", traction[:, None] * along, friction.tangents)
        tangential = multipliers.tangential.copy()
        tangential[place[slipping]] = vectors[slipping]
        return replace(multipliers, tangential=tangential)

    @cached_property
    def _tangential_rows(self) -> ContactRows:
        return self.friction.tangential_rows(self.contacts)

    def force(self, multipliers: Multipliers) -> tuple[Vector, Vector]:
        """Return B'lambda (nodes, gdim) at the nodes that this rank owns [N]. Collective.

        With it that at the nodes (b, gdim) beyond those of the mesh, of rigid bodies and bolts.
        """
        nodes = self.contact_set.boundary.nodes
        _, at, forces = self.force_terms(multipliers)
        in_mesh = at < nodes.total
        last = nodes.comm.allreduce(int(at.max(initial=-1)), MPI.MAX)
        corners = len(self.contact_set.bodies.free_displacements(nodes.total))
        beyond = np.zeros((max(corners, last + 1 - nodes.total), nodes.components))
        np.add.at(beyond, at[~in_mesh] - nodes.total, forces[~in_mesh])
        nodes.comm.Allreduce(MPI.IN_PLACE, beyond)
        return nodes.reduce_at_owners(at[in_mesh], forces[in_mesh]), beyond

    def force_terms(self, multipliers: Multipliers) -> tuple[Numbers, Numbers, Vector]:
        """Return rows (t,), of contacts and then of ties, their nodes, and forces (t, gdim) [N]."""
        site, normal = self.friction.row, self.normal_forces(multipliers)
        parts = [
            (self.contacts, normal, np.arange(normal.size)),
            (self.tied, multipliers.tied, normal.size + np.arange(self.tied.size)),
        ]
        if site.size:
            friction = self.friction_forces(multipliers)
            parts.append((self._tangential_rows, friction.ravel(), site.repeat(friction.shape[1])))
        forces = [(p / rows.length)[rows.row][:, None] * rows.coefficients for rows, p, _ in parts]
        return (
            np.concatenate([number[rows.row] for rows, _, number in parts]),
            np.concatenate([rows.nodes for rows, _, _ in parts]),
            np.concatenate(forces),
        )


@dataclass(frozen=True)
class Multipliers:
    """Multipliers of contact at the nodes of the slaves' surfaces, and forces of tied rows [N].

    The nodes are those of `DeformedRows.surface_nodes`: in steps whose conditions are at other
    nodes multipliers have the same size. They are forces over the lengths of rows: pressures in
    mortar conditions, forces otherwise.
    """

    normal: Vector  # (s,)
    tangential: Vector  # (s, gdim), against the force on the slave
    tied: Vector  # (tied rows,)
    slipping: Mask  # (s,): where friction is at its bound, and does not hold the node
    slid: Mask  # (s,): where it was so in the last step already

    @staticmethod
    def none(rows: DeformedRows) -> Multipliers:
        """Return zeros; friction holds all nodes."""
        size, gdim = rows.surface_nodes.size, rows.contact_set.boundary.nodes.components
        no = np.zeros(size, dtype=bool)
        return Multipliers(np.zeros(size), np.zeros((size, gdim)), np.zeros(rows.tied.size), no, no)

    @staticmethod
    def of(rows: DeformedRows, solution: TornSolution) -> Multipliers:
        """Return those of a solution for the rows."""
        normal = rows.possible(solution.normal_force)
        forces = normal, solution.tangential_force, solution.tied_force
        return Multipliers.at_rows(rows, *forces, ~solution.sticking)

    @staticmethod
    def at_rows(
        rows: DeformedRows, normal: Vector, tangential: Vector, tied: Vector, slipping: Mask
    ) -> Multipliers:
        """Return those of forces at contact rows, at sites along their tangents, and of ties."""
        new, length, site = Multipliers.none(rows), rows.contacts.length, rows.friction.row
        place = rows.place[site]
        new.normal[rows.place] = normal / length
        new.tangential[place] = np.einsum(
            "kt,kta->ka", tangential / length[site, None], rows.friction.tangents
        )
        slips = new.slipping.copy()
        slips[place] = slipping
        return replace(new, tied=tied, slipping=slips)

    @staticmethod
    def from_forces(rows: DeformedRows, force: SlaveValues) -> Multipliers:
        """Return those of normal forces (k,) alone [N]."""
        new = Multipliers.none(rows)
        normal = rows.possible(rows.contact_set.at_conditions(force))
        new.normal[rows.place] = normal / rows.contacts.length
        return new


@dataclass(frozen=True)
class Equilibrium:
    """How well a displacement and multipliers fulfil equilibrium and contact; on all ranks.

    What rounding of coordinates leaves counts as fulfilled.
    """

    residual: float  # of F(u) + B'lambda, relative to the largest sum of forces
    penetration: float  # relative to the largest displacement
    separation: float  # distance of pressing nodes, relative to the largest displacement
    friction: float  # by how much forces break its law, relative as the residual
    force: float  # the size of the forces that the residual is relative to [N]
    place: str  # where the residual is largest

    @property
    def error(self) -> float:
        """The largest of the four measures."""
        return max(self.residual, self.penetration, self.separation, self.friction)

    @staticmethod
    def of(
        internal: Vector,
        rows: DeformedRows,
        multipliers: Multipliers,
        displacement: Vector,
        least: float,
        rounding: Rounding,
    ) -> Equilibrium:
        """Measure it. Collective.

        The internal forces (nodes, gdim), less loads, are F(u) at the nodes that this rank owns.
        The residual is relative to a least force [N] or more.
        """
        nodes, prescribed = rows.contact_set.boundary.nodes, rows.contact_set.prescribed
        contact, on_bodies = rows.force(multipliers)
        free = ~prescribed_components(nodes, prescribed)[: nodes.owned]
        size = largest_of_ranks(nodes.comm, np.abs(displacement))
        r = out_of_balance(internal + contact, rows, size, rounding)
        squares = np.array([(r**2).sum(), (internal[~free] ** 2).sum(), (contact**2).sum()])
        left = _left_on_bodies(rows, on_bodies, size, rounding)
        if nodes.comm.rank == 0:
            squares[0] += (left**2).sum()
        residual, reaction, pressing = np.sqrt(nodes.comm.allreduce(squares)).tolist()
        distance = rows.distances_under(multipliers)
        distance = np.where(np.isfinite(distance), distance, np.inf)
        counts = np.isfinite(distance) & (np.abs(distance) > rounding.length(size))
        # bonds have the forces of their openings
        loaded = rows.is_bonded | (multipliers.normal[rows.place] > 0.0)
        penetration = largest_of_ranks(nodes.comm, -distance[counts])
        separation = largest_of_ranks(nodes.comm, np.abs(distance[counts & loaded]))
        tiny = float(np.finfo(float).tiny)
        # a load on a body at rest is balanced by nothing yet
        force = max(least, reaction, pressing) or residual or tiny
        broken = _broken_friction(rows, multipliers, force, size, rounding)
        size = size or tiny
        return Equilibrium(
            residual / force,
            penetration / size,
            separation / size,
            broken / force,
            force,
            _largest(nodes, r),
        )


def out_of_balance(
    forces: Vector, rows: DeformedRows, displacement: float, rounding: Rounding
) -> Vector:
    """Return nodal forces (owned, gdim), but none that supports carry or that are rounding [N]."""
    nodes, prescribed = rows.contact_set.boundary.nodes, rows.contact_set.prescribed
    free = ~prescribed_components(nodes, prescribed)[: nodes.owned]
    counts = free & (np.abs(forces) > rounding.internal_forces(displacement)[:, None])
    return np.where(counts, forces, 0.0)


def _left_on_bodies(
    rows: DeformedRows, on_bodies: Vector, displacement: float, rounding: Rounding
) -> Vector:
    """Return what is out of balance on rigid bodies, as of `RigidBodies.free_forces`. Collective.

    What rounding leaves of all contact forces together is none on a body without more load. Forces
    on a body with a load are found together with what they balance, whatever the load.
    """
    nodes, gdim = rows.contact_set.boundary.nodes, rows.contact_set.boundary.nodes.components
    left, load = (
        rows.contact_set.bodies.free_forces(forces, nodes.total).reshape(-1, gdim * (gdim + 1))
        for forces in (-on_bodies, 0.0 * on_bodies)
    )
    slaves = rows.surface_nodes - nodes.first
    negligible = nodes.comm.allreduce(float(rounding.contact_forces(displacement)[slaves].sum()))
    size = np.maximum(*(np.linalg.norm(part, axis=1, keepdims=True) for part in (left, load)))
    return np.where(size > negligible, left, 0.0).ravel()


def _broken_friction(
    rows: DeformedRows,
    multipliers: Multipliers,
    force: float,
    displacement: float,
    rounding: Rounding,
) -> float:
    """Return by how much forces break the law of friction in all [N]. Collective.

    Slips are times a force over the largest displacement.
    """
    nodes, stiffness = (
        rows.contact_set.boundary.nodes,
        force / displacement if displacement else 0.0,
    )
    excess = rows.excess(multipliers, stiffness, rounding.length(displacement))
    slaves = rows.surface_nodes[rows.place[rows.friction.row]] - nodes.first
    excess = excess[excess > rounding.contact_forces(displacement)[slaves]]
    return float(np.sqrt(nodes.comm.allreduce(float(excess @ excess))))


def _largest(nodes: NodeMap, r: Vector) -> str:
    """Return the place of the node with the largest force. Collective."""
    size = np.linalg.norm(r, axis=1)
    node = int(size.argmax()) if size.size else -1
    place = format_point(nodes.coordinates[node]) if size.size else ""
    return str(max(nodes.comm.allgather((float(size.max(initial=0.0)), place)))[1])


def misfit_of_forces(
    rows: DeformedRows, multipliers: Multipliers, displacement: Vector, rounding: Rounding
) -> tuple[float, float]:
    """Return how far forces are off equilibrium of rigid bodies, and off friction. Collective.

    The first is what acts on the bodies where they are now, the second as of `Equilibrium`. Both
    are relative to the contact forces and loads of rigid bodies.
    """
    nodes, bodies = rows.contact_set.boundary.nodes, rows.contact_set.bodies
    contact, on_bodies = rows.force(multipliers)
    loads = bodies.free_forces(0.0 * on_bodies, nodes.total)
    pressing = np.sqrt(nodes.comm.allreduce(float(np.sum(contact**2))))
    size = largest_of_ranks(nodes.comm, np.abs(displacement))
    force = max(pressing, float(np.linalg.norm(loads)))
    if not force * size:
        return 0.0, 0.0
    left = _left_on_bodies(rows, on_bodies, size, rounding)
    broken = _broken_friction(rows, multipliers, force, size, rounding)
    return float(np.linalg.norm(left)) / force, broken / force

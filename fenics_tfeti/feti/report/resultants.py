"""Resultants: forces and moments of loads, supports, springs and contacts, from B'lambda.

A row sum_k c_k'u(node_k) exerts -lambda c_k on its nodes. Nodes that are unknowns of rows, as the
shortening of a bolt, have no part in the sums: what acts on them is internal.

The torn displacement fulfils Ku_t = f - B'lambda. At a prescribed component, -B'lambda summed over
the copies of the node is what holds the node: the force of the support, and that of contacts, whose
rows have no entry at prescribed components. Gluing rows add nothing to the sum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mpi4py.MPI import Comm

import numpy as np

from fenics_tfeti.feti.constraints.ground import TornUnknowns
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.dual.operator import DualOperator
from fenics_tfeti.feti.solution.setup import LocalSetup
from fenics_tfeti.feti.solution.states import ContactData
from fenics_tfeti.feti.system import ContactRows, Friction, TornSystem
from fenics_tfeti.parallel import Directory, concatenate_ranks, count_over_ranks
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class Resultant:
    """The sum of forces and of their moments.

    Attributes
    ----------
    name : str
        What exerts the forces.
    force : list of float
        gdim components [N]; [N/m] in 2D.
    moment : list of float
        About the origin, in the undeformed state: three components [N m], in 2D the one out of the
        plane [N].
    """

    name: str
    force: list[float]
    moment: list[float]


@dataclass(frozen=True)
class ContactForces:
    """The forces of a contact or of a tied pair, summed over its surface.

    Attributes
    ----------
    name : str
        Name of the contact.
    normal_force : float
        Sum of the normal forces [N]; [N/m] in plane problems; zero for tied pairs. In axisymmetric
        ones all forces are those of the whole body if the forms have the factor 2 pi r, and those
        of one radian if they have r.
    force, moment : list of float
        Sums on the slave, see `Resultant`.
    force_on_master, moment_on_master : list of float
        The same on the master; zero for rigid obstacles, on which nothing is counted.
    friction_work : float
        Work that friction dissipates: tangential forces times slips beyond elastic ones [J].
    """

    name: str
    normal_force: float
    force: list[float]
    moment: list[float]
    force_on_master: list[float]
    moment_on_master: list[float]
    friction_work: float


@dataclass(frozen=True)
class Resultants:
    """The resultants of a solution; equal on all ranks.

    The equilibrium is the sum of all forces from outside (load, reactions, springs and obstacles),
    relative to the largest sum of magnitudes of nodal forces of loads, supports and obstacles.
    """

    load: Resultant  # of f
    # of several Dirichlet conditions for one displacement the last one counts
    reactions: list[Resultant]  # forces of the support, for each condition
    springs: Resultant  # forces of elastic supports in the stiffness
    contacts: list[ContactForces]  # for each contact and tied pair
    equilibrium: float


@dataclass(frozen=True)
class _NodalForces:
    """Forces (k, gdim) at points (k, gdim), each on one rank only."""

    points: Vector
    forces: Vector

    def sums(self) -> Vector:
        """Return the sums of forces, of moments, and of the magnitudes of forces."""
        acting = self.forces.any(axis=1)
        points, forces = self.points[acting], self.forces[acting]
        moment = moments(points, forces).sum(axis=0)
        return np.concatenate([forces.sum(axis=0), moment, [_size(forces)]])


def tangential_forces(constraints: Constraints, data: ContactData, multipliers: Vector) -> Vector:
    """Return the tangential force of each frictional row of this rank, (k, gdim - 1) [N].

    It acts on the slave against the tangents. It is zero where there is nothing to touch, and in
    directions that prescribed displacements decide. Collective.
    """
    friction, shares = constraints.friction, friction_shares(constraints, data, multipliers)
    forces = friction.given(friction.scale[:, None] * friction.at_sites(multipliers))
    return shares[:, None] * forces


def friction_shares(constraints: Constraints, data: ContactData, multipliers: Vector) -> Vector:
    """Return the part (k,) of a site's force that each frictional row of this rank has.

    Contacts at one site share its force as their bounds are. Collective.
    """
    friction = constraints.friction
    pressing = friction.pressing(multipliers, constraints.layout)
    # the bounds of an unloaded site are those of any force
    pressing = np.where(pressing > 0.0, pressing, 1.0)
    bound, part = (
        friction.given(data.bound.at(pressing)),
        data.own_bound.at(friction.given(pressing)),
    )
    return np.divide(part, bound, out=np.ones_like(part), where=bound > 0.0)


def resultants(
    system: TornSystem,
    F: DualOperator,
    local: LocalSetup,
    data: ContactData,
    multipliers: Vector,
    slips: Vector,
) -> Resultants:
    """Sum up the forces of a solution over all ranks. Collective.

    `slips` are those at the sites of friction without elastic slips, scaled as the rows.
    """
    gdim, comm, unknowns = system.gdim, system.comm, local.unknowns
    friction_force = tangential_forces(F.constraints, data, multipliers)
    forces = _row_forces(system, F.constraints, multipliers, friction_force)
    rows = forces.rows
    loads = unknowns.without_ground(data.load).reshape(-1, gdim)
    supports = unknowns.without_ground(F.constraint_forces(multipliers)).reshape(-1, gdim)
    # subdomains that cannot move freely in all directions have springs
    modes = np.array([kernel.shape[1] for kernel in local.kernels], dtype=np.int64)
    sprung = system.at_copies(modes - unknowns.grounds < {2: 3, 3: 6}[gdim])
    internal = system.at_copies(np.array([s.is_unknown for s in system.subdomains], dtype=bool))

    # most nodes are inside a subdomain, and nothing acts there
    acting = loads.any(axis=1) | supports.any(axis=1) | _touched(F, unknowns, gdim)
    nodes, x = system.chosen_copies(acting)
    sprung, outside = sprung[acting], ~internal[acting, None]
    loads, supports = loads[acting] * outside, -supports[acting] * outside
    # the other forces on a subdomain with springs, f - B'lambda = K u_t, balance theirs
    springs = _NodalForces(x[sprung], -(loads + supports)[sprung])
    reactions = _reactions(system, nodes, x, supports, rows.nodes, forces.terms)
    external = [_NodalForces(x, loads), springs, *reactions]
    sums = comm.allreduce(np.array([part.sums() for part in external]))

    contacts = max(len(system.contact_names), count_over_ranks(comm, rows.contact))
    friction = F.constraints.friction
    work_of_rows = np.sum(friction_force * friction.given(slips / friction.scale[:, None]), axis=1)
    contact = system.contacts.contact[system.friction.row]
    work = np.bincount(contact, work_of_rows, contacts).astype(np.float64)
    directory = Directory(comm, np.unique(rows.nodes))
    points = directory.lookup(rows.nodes, *directory.table(nodes, x))[1]
    contact_names = [system.contact_name(i) for i in range(contacts)]
    of_contacts = forces.of_contacts(system.contacts, contact_names, points, work, comm)
    # what a row exerts in all is a force from outside: that of an obstacle
    obstacle = np.zeros((rows.size, gdim))
    np.add.at(obstacle, rows.row, forces.terms)
    obstacles = comm.allreduce(np.append(obstacle.sum(axis=0), _size(obstacle)))

    largest = max(sums[0, -1], sums[2:, -1].sum(), obstacles[-1])
    missing = float(np.linalg.norm(sums[:, :gdim].sum(axis=0) + obstacles[:gdim]))
    names = ["load", "springs", *_condition_names(system, len(reactions))]
    load_sum, spring_sum, *support_sums = (
        Resultant(name, row[:gdim].tolist(), row[gdim:-1].tolist())
        for name, row in zip(names, sums, strict=True)
    )
    return Resultants(
        load_sum,
        support_sums,
        spring_sum,
        of_contacts,
        missing / largest if largest > 0.0 else 0.0,
    )


@dataclass(frozen=True)
class RowForces:
    """The forces (terms, gdim) that contact, tied and tangential rows exert at their nodes."""

    rows: ContactRows  # those of contacts come first
    terms: Vector

    @staticmethod
    def of(
        contacts: ContactRows,
        tied: ContactRows,
        friction: Friction,
        forces: Sequence[Vector],
        unknowns: Numbers,
    ) -> RowForces:
        """Return those of normal, tied and tangential forces; none at nodes that are unknowns."""
        rows = ContactRows.concatenate([contacts, tied, friction.tangential_rows(contacts)])
        factor = -(np.concatenate([part.ravel() for part in forces]) / rows.length)[rows.row]
        factor[np.isin(rows.nodes, unknowns)] = 0.0
        return RowForces(rows, factor[:, None] * rows.coefficients)

    def of_contacts(
        self, contacts: ContactRows, names: Sequence[str], points: Vector, work: Vector, comm: Comm
    ) -> list[ContactForces]:
        """Return the sums of each contact and tied pair, by number. Collective.

        The points (terms, gdim) are those of the nodes, the work (contacts,) this rank's part.
        """
        normal_sums = comm.allreduce(self._normal_sums(contacts, len(names)))
        sides = comm.allreduce(self._sums_of_sides(points, len(names)))
        gdim, work = points.shape[1], comm.allreduce(work)
        return [
            ContactForces(
                name,
                float(normal_sums[i]),
                force=slave[:gdim],
                moment=slave[gdim:],
                force_on_master=master[:gdim],
                moment_on_master=master[gdim:],
                friction_work=float(work[i]),
            )
            for i, (name, (slave, master)) in enumerate(
                zip(names, sides.transpose(1, 0, 2).tolist(), strict=True)
            )
        ]

    def _normal_sums(self, contacts: ContactRows, number: int) -> Vector:
        """Return the sum of the normal forces of each contact; the contact rows come first."""
        slave = np.zeros((self.rows.size, self.terms.shape[1]))
        np.add.at(slave, self.rows.row[self.rows.on_slave], self.terms[self.rows.on_slave])
        pressing = -np.sum(slave * self.rows.normal, axis=1)[: contacts.size]
        sums = np.bincount(contacts.contact, weights=pressing, minlength=number)
        return sums.astype(np.float64)

    def _sums_of_sides(self, x: Vector, number: int) -> Vector:
        """Return the sums of forces and moments on slaves and on masters, (2, contacts, ...)."""
        side = (~self.rows.on_slave).astype(np.int64)
        columns = np.column_stack([self.terms, moments(x, self.terms)])
        sums = np.zeros((2, number, columns.shape[1]))
        np.add.at(sums, (side, self.rows.contact[self.rows.row]), columns)
        return sums


def _row_forces(
    system: TornSystem, constraints: Constraints, multipliers: Vector, friction_force: Vector
) -> RowForces:
    """Return the forces of all rows that this rank gave at their nodes. Collective."""
    forces = [
        constraints.contacts.forces(multipliers),
        constraints.tied.forces(multipliers),
        friction_force,
    ]
    internal = system.at_copies(np.array([s.is_unknown for s in system.subdomains], dtype=bool))
    unknowns = concatenate_ranks(system.comm, system.nodes[internal])
    return RowForces.of(system.contacts, system.tied, system.friction, forces, unknowns)


def _touched(F: DualOperator, unknowns: TornUnknowns, gdim: int) -> Mask:
    """Tell which copies of nodes B acts on, (copies,)."""
    touched = np.zeros(int(unknowns.ends[-1]), dtype=bool)
    touched[F.interface.columns] = True
    copies: Mask = unknowns.without_ground(touched).reshape(-1, gdim).any(axis=1)
    return copies


def _size(forces: Vector) -> float:
    return float(np.linalg.norm(forces, axis=1).sum())


def _condition_names(system: TornSystem, conditions: int) -> list[str]:
    unnamed = range(len(system.condition_names), conditions)
    return [*system.condition_names, *(f"Dirichlet condition {i}" for i in unnamed)]


def moments(points: Vector, forces: Vector) -> Vector:
    """Return the moments (k, 3) of forces about the origin, or (k, 1) in two dimensions."""
    if points.shape[1] == 3:
        return np.cross(points, forces)
    return (points[:, 0] * forces[:, 1] - points[:, 1] * forces[:, 0])[:, None]


def _reactions(
    system: TornSystem,
    copies: Numbers,
    x: Vector,
    supports: Vector,
    ends: Numbers,
    end_forces: Vector,
) -> list[_NodalForces]:
    """Return for each Dirichlet condition the forces at prescribed components. Collective.

    Each node's forces are summed on its home rank, from all its copies, at x (k, gdim) with the
    forces of supports (k, gdim), and the terms of contact and tied rows, which exert `end_forces`
    at the nodes `ends`.
    """
    comm, gdim, prescribed = system.comm, system.gdim, system.prescribed
    number = np.asarray(prescribed.condition, dtype=np.int64)
    conditions = max(len(system.condition_names), count_over_ranks(comm, number))
    directory = Directory(comm, np.unique(prescribed.nodes))
    shape = (directory.keys.size, gdim)
    nodes, components, number = directory.collect(prescribed.nodes, prescribed.components, number)
    condition = np.full(shape, -1, dtype=np.int64)
    np.maximum.at(condition, (directory.position(nodes), components), number)

    loaded, pressed = supports.any(axis=1), end_forces.any(axis=1)
    (points,) = directory.table(copies[loaded], x[loaded])
    # a contact force on a prescribed component is in the multiplier of the support
    reaction = directory.sums(
        np.append(copies[loaded], ends[pressed]),
        np.concatenate([supports[loaded], -end_forces[pressed]]),
    )
    return [
        _NodalForces(points, np.where(condition == i, reaction, 0.0)) for i in range(conditions)
    ]

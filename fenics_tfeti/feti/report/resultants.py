"""Resultants: forces and moments of loads, supports, springs and contacts, from B'lambda.

A row sum_k c_k'u(node_k) exerts -lambda c_k on its nodes.

The torn displacement fulfils Ku_t = f - B'lambda. At a prescribed component, -B'lambda summed over
the copies of the node is what holds the node: the force of the support, and that of contacts, whose
rows have no entry at prescribed components. Gluing rows add nothing to the sum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.feti.constraints.ground import TornUnknowns
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.dual.operator import DualOperator
from fenics_tfeti.feti.system import ContactRows, TornSystem
from fenics_tfeti.parallel import Directory
from fenics_tfeti.typing import Numbers, Vector


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
class Resultants:
    """The resultants of a solution; equal on all ranks.

    Attributes
    ----------
    load : Resultant
        Of f.
    reactions : list of Resultant
        What the support exerts, for each Dirichlet condition. Of several conditions for one
        displacement the last one counts.
    springs : Resultant
        What elastic supports in the stiffness exert.
    normal_forces : list of float
        For each contact the sum of the normal forces [N]; zero for tied pairs.
    on_slaves, on_masters : list of Resultant
        For each contact and tied pair the forces on the slave's nodes and on those of the
        master; none on rigid obstacles.
    equilibrium : float
        The sum of all forces from outside (load, reactions, springs and obstacles), relative to the
        largest sum of magnitudes of nodal forces of loads, supports and obstacles.
    """

    load: Resultant
    reactions: list[Resultant]
    springs: Resultant
    normal_forces: list[float]
    on_slaves: list[Resultant]
    on_masters: list[Resultant]
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
        moment = _moments(points, forces).sum(axis=0)
        return np.concatenate([forces.sum(axis=0), moment, [_size(forces)]])


def normal_forces(constraints: Constraints, multipliers: Vector) -> Vector:
    """Return the normal force of each contact row that this rank gave [N].

    It is zero for rows that are no rows of B: far away, decided by prescribed displacements, or
    implied by others.
    """
    rows = constraints.inequality
    return _given(multipliers, rows, constraints.scale, constraints.own_rows)


def tied_forces(constraints: Constraints, multipliers: Vector) -> Vector:
    """Return the force of each tied row that this rank gave [N].

    It acts on the slave against the row's normal. It is zero for rows
    that are no rows of B: decided by prescribed displacements, or implied by others.
    """
    tied = constraints.tied
    return _given(multipliers, tied.rows, tied.scale, tied.own_rows)


def tangential_forces(constraints: Constraints, multipliers: Vector) -> Vector:
    """Return the tangential force at each site of friction that this rank gave, (k, gdim - 1) [N].

    It acts on the slave against the tangents. It is zero where there is nothing to touch, and in
    directions that prescribed displacements decide.
    """
    friction = constraints.friction
    return friction.given(friction.scale[:, None] * friction.at_sites(multipliers))


def _given(multipliers: Vector, rows: Numbers, scale: Vector, own: Numbers) -> Vector:
    """Return the multipliers of the rows that this rank gave, times their scale."""
    # -1 is the last one, zero; a rank may give rows without holding a single row of B
    force = np.zeros(multipliers.size + 1)
    force[rows] = scale * multipliers[rows]
    given: Vector = force[own]
    return given


def resultants(
    system: TornSystem,
    F: DualOperator,
    kernels: Sequence[Vector],
    unknowns: TornUnknowns,
    load: Vector,
    multipliers: Vector,
) -> Resultants:
    """Sum up the forces of a solution over all ranks. Collective.

    Parameters
    ----------
    system : TornSystem
        Subdomains, prescribed displacements and contact rows.
    F : DualOperator
        For B'.
    kernels : sequence of (n_i, k_i) arrays
        R_i of this rank's subdomains: one that cannot move rigidly has springs.
    unknowns : TornUnknowns
        Displacements and the ground of soft springs.
    load : (n,) array
        f of this rank's subdomains [N].
    multipliers : (m,) array
        lambda.
    """
    gdim, comm = system.gdim, system.comm
    tangential = system.friction.tangential_rows(system.contacts)
    rows = ContactRows.concatenate([system.contacts, system.tied, tangential])
    x = np.concatenate([np.zeros((0, gdim)), *(s.coordinates for s in system.subdomains)])
    loads = unknowns.without_ground(load).reshape(-1, gdim)
    held = -unknowns.without_ground(F.constraint_forces(multipliers)).reshape(-1, gdim)
    normal = normal_forces(F.constraints, multipliers)
    force = np.concatenate(
        [
            normal,
            tied_forces(F.constraints, multipliers),
            tangential_forces(F.constraints, multipliers).ravel(),
        ]
    )
    on_nodes = -(force / rows.length)[rows.row][:, None] * rows.coefficients
    on_slave = np.zeros((rows.size, gdim))
    np.add.at(on_slave, rows.row[rows.on_slave], on_nodes[rows.on_slave])
    pressing = -np.sum(on_slave * rows.normal, axis=1)[: normal.size]

    sprung = _with_springs(system, kernels, unknowns)
    # the other forces on a subdomain with springs, f - B'lambda = K u_t, balance theirs
    springs = _NodalForces(x[sprung], -(loads + held)[sprung])
    reactions = _reactions(system, x, held, rows.nodes, on_nodes)
    outside = [_NodalForces(x, loads), springs, *reactions]
    sums = comm.allreduce(np.array([forces.sums() for forces in outside]))

    contacts = max(
        len(system.contact_names), comm.allreduce(int(rows.contact.max(initial=-1)), MPI.MAX) + 1
    )
    normal_sums = np.bincount(system.contacts.contact, weights=pressing, minlength=contacts)
    at = _points(system, x, F, unknowns, rows.nodes)
    of_contact = _of_contacts(rows, at, on_nodes, contacts)
    normal_sums, of_contact = comm.allreduce(normal_sums), comm.allreduce(of_contact)
    # what a row exerts in all is a force from outside: that of an obstacle
    of_obstacles = np.zeros((rows.size, gdim))
    np.add.at(of_obstacles, rows.row, on_nodes)
    obstacles = comm.allreduce(np.append(of_obstacles.sum(axis=0), _size(of_obstacles)))

    largest = max(sums[0, -1], sums[2:, -1].sum(), obstacles[-1])
    missing = float(np.linalg.norm(sums[:, :gdim].sum(axis=0) + obstacles[:gdim]))
    names = ["load", "springs", *_condition_names(system, len(reactions))]
    load_sum, spring_sum, *supports = (
        Resultant(name, row[:gdim].tolist(), row[gdim:-1].tolist())
        for name, row in zip(names, sums, strict=True)
    )
    on_slaves, on_masters = (
        [
            Resultant(system.contact_name(i), row[:gdim].tolist(), row[gdim:].tolist())
            for i, row in enumerate(side)
        ]
        for side in of_contact
    )
    return Resultants(
        load_sum,
        supports,
        spring_sum,
        normal_sums.tolist(),
        on_slaves,
        on_masters,
        missing / largest if largest > 0.0 else 0.0,
    )


def _of_contacts(rows: ContactRows, x: Vector, on_nodes: Vector, contacts: int) -> Vector:
    """Return the sums of forces and moments on slaves and on masters, (2, contacts, ...)."""
    on_master = (~rows.on_slave).astype(np.int64)
    both = np.column_stack([on_nodes, _moments(x, on_nodes)])
    sums = np.zeros((2, contacts, both.shape[1]))
    np.add.at(sums, (on_master, rows.contact[rows.row]), both)
    return sums


def _points(
    system: TornSystem, x: Vector, F: DualOperator, unknowns: TornUnknowns, nodes: Numbers
) -> Vector:
    """Return the coordinates of any nodes that B acts on. Collective."""
    gdim = system.gdim
    touched = np.zeros(int(unknowns.ends[-1]), dtype=bool)
    touched[F.interface.columns] = True
    here = unknowns.without_ground(touched).reshape(-1, gdim).any(axis=1)
    of_copies = np.concatenate([np.zeros(0, dtype=np.int64), *(s.nodes for s in system.subdomains)])
    directory = Directory(system.comm, np.unique(nodes))
    table = np.zeros((directory.keys.size, gdim))
    at, (points,) = _known(directory, *directory.collect(of_copies[here], x[here]))
    table[at] = points
    found: Vector = directory.lookup(nodes, table)[1]
    return found


def _size(forces: Vector) -> float:
    return float(np.linalg.norm(forces, axis=1).sum())


def _condition_names(system: TornSystem, conditions: int) -> list[str]:
    unnamed = range(len(system.condition_names), conditions)
    return [*system.condition_names, *(f"Dirichlet condition {i}" for i in unnamed)]


def _moments(points: Vector, forces: Vector) -> Vector:
    """Return the moments (k, 3) of forces about the origin, or (k, 1) in two dimensions."""
    if points.shape[1] == 3:
        return np.cross(points, forces)
    return (points[:, 0] * forces[:, 1] - points[:, 1] * forces[:, 0])[:, None]


def _with_springs(
    system: TornSystem, kernels: Sequence[Vector], unknowns: TornUnknowns
) -> NDArray[np.bool_]:
    """Tell which torn nodes are in subdomains that cannot move freely in all directions."""
    rigid = {2: 3, 3: 6}[system.gdim]
    return np.concatenate(
        [
            np.zeros(0, dtype=bool),
            *(
                np.full(subdomain.nodes.size, kernel.shape[1] - grounds < rigid)
                for subdomain, kernel, grounds in zip(
                    system.subdomains, kernels, unknowns.grounds, strict=True
                )
            ),
        ]
    )


def _reactions(
    system: TornSystem, x: Vector, held: Vector, ends: Numbers, on_ends: Vector
) -> list[_NodalForces]:
    """Return for each Dirichlet condition the forces at prescribed components. Collective.

    Each node's forces are summed on its home rank, from all its copies and the terms of contact
    and tied rows, which exert `on_ends` at the nodes `ends`.
    """
    comm, gdim, given = system.comm, system.gdim, system.prescribed
    number = np.asarray(given.condition, dtype=np.int64)
    conditions = max(
        len(system.condition_names), comm.allreduce(int(number.max(initial=-1)), MPI.MAX) + 1
    )
    directory = Directory(comm, np.unique(given.nodes))
    shape = (directory.keys.size, gdim)
    nodes, components, number = directory.collect(given.nodes, given.components, number)
    condition = np.full(shape, -1, dtype=np.int64)
    np.maximum.at(condition, (directory.position(nodes), components), number)

    nodes = np.concatenate([np.zeros(0, dtype=np.int64), *(s.nodes for s in system.subdomains)])
    loaded = held.any(axis=1)
    points, reaction = np.zeros(shape), np.zeros(shape)
    at, where, force = directory.collect(nodes[loaded], x[loaded], held[loaded])
    at, (where, force) = _known(directory, at, where, force)
    points[at] = where
    np.add.at(reaction, at, force)

    # a contact force on a prescribed component is in the multiplier of the support
    pressed = on_ends.any(axis=1)
    at, (force,) = _known(directory, *directory.collect(ends[pressed], on_ends[pressed]))
    np.subtract.at(reaction, at, force)
    return [
        _NodalForces(points, np.where(condition == i, reaction, 0.0)) for i in range(conditions)
    ]


def _known(
    directory: Directory, nodes: Numbers, *columns: Vector
) -> tuple[Numbers, tuple[Vector, ...]]:
    """Return the positions at home of the nodes that the directory has, and their columns."""
    at = directory.position(nodes)
    return at[at >= 0], tuple(column[at >= 0] for column in columns)

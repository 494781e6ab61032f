"""Torn systems without dolfinx: cubes of trilinear hexahedra."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from lattice import box_stiffness, lattice_points

from fenics_tfeti.feti import ContactRows, Prescribed, Subdomain, TornSystem
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.dual.face_operators import FaceOperators
from fenics_tfeti.feti.dual.problem import DualProblem

YOUNG, POISSON = 1.0, 0.3


def cube(n: int, corner=(0, 0, 0), body: int = 0, first: int = 0, load=(0, 0, 0)) -> Subdomain:
    """Return a unit cube of n^3 elements at an integer corner.

    Nodes are numbered by position within a body (first + lattice number), so neighbours are glued.
    """
    lattice = lattice_points(n, n, n)
    K = YOUNG * box_stiffness(n, np.ones(3), POISSON)
    place = lattice + n * np.array(corner)
    nodes = first + (place[:, 0] * 1000 + place[:, 1]) * 1000 + place[:, 2]
    force = np.tile(np.asarray(load, float) / len(lattice), len(lattice))
    return Subdomain(K, force, place * (1.0 / n), nodes.astype(np.int64), body)


def node_rows(slave, normal, master=-1, gap=0.0, contact: int = 0) -> ContactRows:
    """Return rows of one contact between nodes, or of nodes and an obstacle, of one normal."""
    k = slave.size
    return ContactRows.node_to_node(
        slave,
        np.broadcast_to(master, k),
        np.tile(np.asarray(normal, float), (k, 1)),
        np.broadcast_to(np.asarray(gap, float), k),
        np.full(k, contact),
    )


def fixed_nodes(nodes, components, value: float = 0.0) -> Prescribed:
    """Prescribe one value of some components of nodes."""
    size = nodes.size * len(components)
    every = np.repeat(nodes, len(components))
    return Prescribed(every, np.tile(components, nodes.size), np.full(size, value))


def with_prescribed(system: TornSystem, nodes, components, value: float = 0.0) -> TornSystem:
    """Return a system of which some components of nodes are prescribed too."""
    old, new = system.prescribed, fixed_nodes(np.asarray(nodes), components, value)
    both = (np.append(getattr(old, f.name), getattr(new, f.name)) for f in dataclasses.fields(old))
    return dataclasses.replace(system, prescribed=Prescribed(*both))


def with_fields(system: TornSystem, part: str, **changes) -> TornSystem:
    """Return a system with changes of its `contacts`, `friction` or another part."""
    changed = dataclasses.replace(getattr(system, part), **changes)
    return dataclasses.replace(system, **{part: changed})


def in_units(system: TornSystem, force: float, length: float) -> TornSystem:
    """Return the system with forces and lengths in other units; stiffness is force over length."""
    subdomains = [
        dataclasses.replace(
            s,
            stiffness=s.stiffness * (force / length),
            load=s.load * force,
            coordinates=s.coordinates * length,
        )
        for s in system.subdomains
    ]
    system = dataclasses.replace(system, subdomains=subdomains)
    if system.friction.size:
        bound, slip = force * system.friction.bound, length * np.asarray(system.friction.slip)
        system = with_fields(system, "friction", bound=bound, slip=slip)
    system = with_fields(system, "contacts", gap=system.contacts.gap * length)
    return with_fields(system, "prescribed", values=system.prescribed.values * length)


def column(n: int = 3, height: int = 2, contact: bool = True, load=(0, 0, -1.0)) -> TornSystem:
    """Return a lower body of `height` cubes, fixed at its bottom, and a cube on top, free or glued.

    The upper cube is held against sliding at its top face and may move up and down.
    """
    lower = [cube(n, (0, 0, k)) for k in range(height)]
    second = 10**9 if contact else 0
    upper = cube(n, (0, 0, height), body=int(contact), first=second, load=load)
    bottom = lower[0].nodes[lower[0].coordinates[:, 2] == 0]
    top = upper.nodes[np.isclose(upper.coordinates[:, 2], height + 1)]
    fixed = Prescribed(
        np.concatenate([np.repeat(bottom, 3), np.repeat(top, 2)]),
        np.concatenate([np.tile([0, 1, 2], bottom.size), np.tile([0, 1], top.size)]),
        np.zeros(3 * bottom.size + 2 * top.size),
    )
    rows = ContactRows.none(3)
    if contact:
        slave = upper.nodes[np.isclose(upper.coordinates[:, 2], height)]
        rows = node_rows(slave, [0.0, 0.0, -1.0], master=slave - second)
    return TornSystem([*lower, upper], fixed, rows, 3, ["lower", "upper"], ["joint"])


def matrix(rows: ContactRows, nodes: np.ndarray) -> np.ndarray:
    """Return rows as a dense matrix of the glued unknowns."""
    gdim = rows.coefficients.shape[1]
    C = np.zeros((rows.size, gdim * nodes.size))
    columns = gdim * np.searchsorted(nodes, rows.nodes)[:, None] + np.arange(gdim)
    np.add.at(C, (rows.row[:, None], columns), rows.coefficients)
    return C


def operators_on(problem: DualProblem, active: np.ndarray) -> FaceOperators:
    """Return the operators of the face of no multipliers with these active contact rows."""
    face = problem.face_of(np.zeros_like(problem.d), active)
    return FaceOperators.build(problem, Projector.build(problem.coarse_space, face))


@dataclass
class Glued:
    """A torn system on one rank as a whole, dense: K, f, contact rows C and tied rows T.

    `places` are the unknowns of each subdomain, `u` is the prescribed displacement, zero on the
    `free` unknowns.
    """

    K: np.ndarray
    f: np.ndarray
    C: np.ndarray
    T: np.ndarray
    nodes: np.ndarray
    places: list[np.ndarray]
    u: np.ndarray
    free: np.ndarray

    @classmethod
    def of(cls, system: TornSystem) -> Glued:
        gdim, nodes = system.gdim, np.unique(np.concatenate([s.nodes for s in system.subdomains]))
        size = gdim * nodes.size
        K, f, u, places = np.zeros((size, size)), np.zeros(size), np.zeros(size), []
        for s in system.subdomains:
            at = (gdim * np.searchsorted(nodes, s.nodes)[:, None] + np.arange(gdim)).ravel()
            K[np.ix_(at, at)] += s.stiffness.toarray()
            f[at] += s.load
            places.append(at)
        given = system.prescribed
        fixed = gdim * np.searchsorted(nodes, given.nodes) + given.components
        u[fixed] = given.values
        free = np.setdiff1d(np.arange(size), fixed)
        C, T = (matrix(rows, nodes) for rows in (system.contacts, system.tied))
        return cls(K, f, C, T, nodes, places, u, free)

    def torn(self) -> list[np.ndarray]:
        """Return the displacements of the subdomains."""
        return [self.u[at] for at in self.places]

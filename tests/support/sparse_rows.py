"""Blocks whose meshes do not match, with sparse contact and tied rows, and their dense solution."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

from mpi4py import MPI

import daqp
import numpy as np
from numpy.random import Generator
from torn import Glued, cube, fixed_nodes

from fenics_tfeti.feti import (
    ContactRows,
    Friction,
    Options,
    Prescribed,
    Subdomain,
    TornSolver,
    TornSystem,
)

SECOND = 10**9
LENGTHS = (-6.0, 6.0)


def two_blocks(lower: int = 2, upper: int = 3, load=(0.1, 0.0, -1.0), stiffness: float = 1.0):
    """Return the subdomains of two blocks of 2 x 1 x 1 cubes, one on the other."""
    below = [cube(lower, (i, 0, 0)) for i in range(2)]
    above = [cube(upper, (i, 0, 1), body=1, first=SECOND, load=load) for i in range(2)]
    above = [dataclasses.replace(s, stiffness=stiffness * s.stiffness) for s in above]
    return [*below, *above]


def clamped(subdomains: list[Subdomain], *places: tuple[int, float]) -> Prescribed:
    """Prescribe no displacement at x[axis] == value of the places."""
    nodes = [s.nodes[np.isclose(s.coordinates[:, a], v)] for a, v in places for s in subdomains]
    every = np.unique(np.concatenate(nodes))
    return fixed_nodes(every, [0, 1, 2])


def plane(subdomains: list[Subdomain], body: int, z: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes of a body on a plane, and their coordinates."""
    own = [s for s in subdomains if s.body == body]
    nodes = np.concatenate([s.nodes for s in own])
    x = np.concatenate([s.coordinates for s in own])
    nodes, first = np.unique(nodes, return_index=True)
    on = np.isclose(x[first, 2], z)
    return nodes[on], x[first][on]


def interpolated(
    subdomains: list[Subdomain], n_master: int, directions, area=None, master_above: bool = False
) -> ContactRows:
    """Return rows D d'(u(node) - interpolated master) = 0 of all nodes on the plane z = 1.

    The master's cubes have `n_master` elements an edge: a grid of bilinear facets. At every node
    there is a row for each of the directions d (k, 3); D, 1 by default, is a function of places.
    """
    slave, x = plane(subdomains, int(not master_above), 1.0)
    master, y = plane(subdomains, int(master_above), 1.0)
    D = np.ones(slave.size) if area is None else area(x)
    lattice = np.rint(y * n_master).astype(int)[:, :2]
    number = {tuple(p): i for p, i in zip(lattice, master, strict=True)}
    offsets, nodes, coefficients = [0], [], []
    for k, place in enumerate(x[:, :2] * n_master):
        corner = np.minimum(np.floor(place + 1e-9), [2 * n_master - 1, n_master - 1])
        s, t = place - corner
        along, across = (1 - s, s), (1 - t, t)
        weights = {(i, j): along[i] * across[j] for i in (0, 1) for j in (0, 1)}
        for d in np.atleast_2d(directions):
            nodes.append(slave[k])
            coefficients.append(D[k] * d)
            for shift, weight in weights.items():
                if weight > 1e-9:
                    nodes.append(number[tuple((corner + shift).astype(int))])
                    coefficients.append(-D[k] * weight * d)
            offsets.append(len(nodes))
    rows = len(offsets) - 1
    return ContactRows(offsets, nodes, coefficients, np.zeros(rows), np.zeros(rows, dtype=int))


def random_rows(
    subdomains: list[Subdomain], rng: Generator, count: int, terms=(3, 9), lengths=LENGTHS
) -> ContactRows:
    """Return rows between random nodes on and near the plane z = 1, with any coefficients."""
    if not count:
        return ContactRows.none(3)
    near = [s.nodes[np.abs(s.coordinates[:, 2] - 1.0) < 0.6] for s in subdomains]
    nodes = np.unique(np.concatenate(near))
    size = rng.integers(*terms, count)
    chosen = np.concatenate([rng.choice(nodes, k, replace=False) for k in size])
    length = 10.0 ** rng.uniform(*lengths, count)
    coefficients = np.repeat(length, size)[:, None] * rng.normal(size=(chosen.size, 3))
    gap = length * rng.uniform(-0.05, 0.2, count)
    offsets = np.append(0, np.cumsum(size))
    return ContactRows(offsets, chosen, coefficients, gap, np.zeros(count, dtype=int))


def distributed(system: TornSystem, comm: MPI.Comm) -> TornSystem:
    """Deal the subdomains and the rows out to the ranks in turn."""
    mine = slice(comm.rank, None, comm.size)
    contacts, tied = (
        rows.chosen(np.arange(rows.size)[mine]) for rows in (system.contacts, system.tied)
    )
    prescribed = system.prescribed if comm.rank == comm.size - 1 else Prescribed()
    given = system.friction
    here = np.flatnonzero(np.isin(given.row, np.arange(system.contacts.size)[mine]))
    friction = Friction(
        given.row[here] // comm.size,
        *(np.asarray(column)[here] for column in list(vars(given).values())[1:]),
    )
    return dataclasses.replace(
        system,
        subdomains=system.subdomains[mine],
        prescribed=prescribed,
        contacts=contacts,
        tied=tied,
        friction=friction,
        comm=comm,
    )


def assert_same_on_ranks(system: TornSystem, options: Options, rtol: float) -> tuple[Any, Any]:
    """Solve on one rank and, dealt out, on all; return both solutions if they are the same."""
    comm = MPI.COMM_WORLD
    alone = TornSolver(dataclasses.replace(system, comm=MPI.COMM_SELF), options).solve()
    found = TornSolver(distributed(system, comm), options).solve()
    mine = slice(comm.rank, None, comm.size)
    size = max(np.abs(u).max() for u in alone.displacements)
    for u, expected in zip(found.displacements, alone.displacements[mine], strict=True):
        np.testing.assert_allclose(u, expected, rtol=0.0, atol=rtol * size)
    for name in ("normal_force", "tied_force"):
        expected = getattr(alone, name)
        atol = 10.0 * rtol * np.abs(expected).max(initial=0.0)
        np.testing.assert_allclose(getattr(found, name), expected[mine], rtol=0.0, atol=atol)
    torn = {"torn": found.report.unknowns["torn"]}
    assert found.report.unknowns == alone.report.unknowns | torn
    groups = [[g.bodies for g in s.report.certificate.groups] for s in (alone, found)]
    assert groups[0] == groups[1]
    for ours, theirs in zip(found.report.contacts, alone.report.contacts, strict=True):
        for name in ("force", "moment", "force_on_master", "moment_on_master"):
            one, other = getattr(ours, name), getattr(theirs, name)
            np.testing.assert_allclose(one, other, rtol=0.0, atol=10.0 * rtol)
    return alone, found


@dataclass
class Dense(Glued):
    """The glued problem, and its solution by a dense active set method for quadratic programmes.

    `contact` and `tied` are the multipliers of the rows as given.
    """

    contact: np.ndarray = field(default_factory=lambda: np.zeros(0))
    tied: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def solve(cls, system: TornSystem) -> Dense:
        """Solve a system on one rank whose Dirichlet conditions and tied rows hold all bodies."""
        self = cls.of(system)
        K, u, free = self.K, self.u, self.free
        A = np.vstack([self.C, self.T])
        bound = np.append(system.contacts.gap, system.tied.gap) - A @ u
        A = A[:, free]
        lengths = np.linalg.norm(A, axis=1)
        lengths[lengths == 0.0] = 1.0
        A, upper = A / lengths[:, None], bound / lengths
        is_tied = np.arange(len(A)) >= len(self.C)
        # what the tied rows alone hold has stiffness as well; the solution is the same
        stiff = K.diagonal().max() * A[is_tied].T
        x, _, exitflag, info = daqp.solve(
            np.ascontiguousarray(K[np.ix_(free, free)] + stiff @ A[is_tied]),
            -(self.f - K @ u)[free] - stiff @ upper[is_tied],
            np.ascontiguousarray(A),
            np.minimum(upper, 1e30),
            np.where(is_tied, upper, -1e30),
            np.where(is_tied, 5, 0).astype(np.int32),
            primal_tol=1e-12,
            dual_tol=1e-12,
            eps_prox=0.0,
        )
        assert exitflag == 1
        u[free] = x
        multipliers = np.asarray(info["lam"]) / lengths
        self.contact, self.tied = np.split(multipliers, [len(self.C)])
        return self

    def energy_norm(self, displacements: list[np.ndarray]) -> float:
        """Return the energy norm of torn displacements that are glued."""
        u = np.zeros(self.f.size)
        for at, part in zip(self.places, displacements, strict=True):
            u[at] = part
        return float(np.sqrt(max(0.0, u @ self.K @ u)))

"""Weighted rows of B on several ranks: orthonormal, and those of one process."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from torn import cube

from fenics_tfeti.feti import ContactRows, Prescribed, TornSystem
from fenics_tfeti.feti.constraints.rows import Constraints, build_constraints
from fenics_tfeti.feti.constraints.scaling import node_weights

comm = MPI.COMM_WORLD
pytestmark = pytest.mark.ranks(2, 3)
CUBES = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
CENTRE, OTHER = 2002002, 2002001  # nodes of eight cubes, and of four of them
WAYS = ("random", "stiffness", "multiplicity")


def system(ranks: MPI.Comm) -> TornSystem:
    """Return eight glued cubes of different moduli, dealt to the ranks in turn; rank 0 gives rows.

    One row is between two nodes, both have several copies.
    """
    mine = [cube(2, corner) for corner in CUBES]
    for number, subdomain in enumerate(mine):
        subdomain.stiffness.data *= 10.0 ** (number % 4)
    prescribed, contacts = Prescribed(), ContactRows.none(3)
    if ranks.rank == 0:
        prescribed = Prescribed(np.array([CENTRE]), np.array([0]), np.array([0.5]))
        contacts = ContactRows.node_to_node(
            np.array([CENTRE]),
            np.array([OTHER]),
            np.array([[0.6, 0.0, 0.8]]),
            np.array([0.1]),
            np.array([0]),
        )
    return TornSystem(mine[ranks.rank :: ranks.size], prescribed, contacts, 3, comm=ranks)


def weights(torn: TornSystem, way: str) -> np.ndarray:
    """Return weights of the copies, the same for each cube wherever it is."""
    if way != "random":
        return node_weights(torn, way).values
    parts = []
    for subdomain in torn.subdomains:
        generator = np.random.default_rng(int(subdomain.nodes[0]))
        parts.append(10.0 ** generator.uniform(-4.0, 0.0, subdomain.nodes.size))
    return np.concatenate(parts)


def whole(constraints: Constraints, ranks: MPI.Comm) -> np.ndarray:
    """Return B D^{-1/2} of all cubes in the order of `CUBES`."""
    part = constraints.matrix.toarray() / np.sqrt(constraints.weights)
    cubes = CUBES[ranks.rank :: ranks.size]
    blocks = np.split(part, len(cubes), axis=1)
    found = np.zeros((constraints.layout.size, len(CUBES), blocks[0].shape[1]))
    for corner, block in zip(cubes, blocks, strict=True):
        found[constraints.layout.numbers, CUBES.index(corner)] = block
    return ranks.allreduce(found).reshape(constraints.layout.size, -1)


@pytest.mark.parametrize("way", WAYS)
def test_rows_are_those_of_one_process(way):
    """Orthonormal in the inverse weights, with the same span and the same contact row."""
    found, rows = [], []
    for ranks in (comm, MPI.COMM_SELF):
        torn = system(ranks)
        constraints, c = build_constraints(torn, weights(torn, way))
        B = whole(constraints, ranks)
        np.testing.assert_allclose(B @ B.T, np.eye(len(B)), rtol=0.0, atol=1e-14)
        found.append(B.T @ B)  # does not depend on the order of the rows
        at = constraints.inequality[: constraints.owned_inequalities]
        # inequalities come last
        rows.append(np.append(B[-1], ranks.allreduce(float(c[at].sum()))))
    np.testing.assert_allclose(*found, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(*rows, rtol=0.0, atol=1e-13)

"""Contact and tied rows that reach over several ranks: the same on any number of them."""

from __future__ import annotations

import dataclasses

from mpi4py import MPI

import numpy as np
import pytest
from sparse_rows import clamped, distributed, interpolated, random_rows, two_blocks
from torn import cube

from fenics_tfeti.feti import ContactRows, Options, TornSolver, TornSystem
from fenics_tfeti.feti.constraints.rows import build_constraints
from fenics_tfeti.parallel import concatenate_ranks

COMM = MPI.COMM_WORLD
NONE = ContactRows.none(3)


def random_system() -> TornSystem:
    rng, blocks = np.random.default_rng(3), two_blocks()
    contacts, tied = random_rows(blocks, rng, 30), random_rows(blocks, rng, 10)
    return TornSystem(blocks, clamped(blocks, (2, 0.0), (2, 2.0)), contacts, 3, tied=tied)


def tied_system() -> TornSystem:
    blocks = two_blocks(2, 4)
    tied = interpolated(blocks, 2, np.eye(3), lambda x: 1e-3 + x[:, 0])
    return TornSystem(blocks, clamped(blocks, (2, 0.0)), NONE, 3, ["lower", "upper"], tied=tied)


def contact_system() -> TornSystem:
    blocks = two_blocks(2, 4)
    rows = interpolated(blocks, 2, np.array([0.0, 0.0, -1.0]), lambda x: 1e-3 + x[:, 0])
    return TornSystem(blocks, clamped(blocks, (2, 0.0), (2, 2.0)), rows, 3)


SYSTEMS = {"random": random_system, "tied": tied_system, "contact": contact_system}


def in_order(values: np.ndarray, rows: int) -> np.ndarray:
    """Gather what the ranks have for the rows that were dealt out to them in turn."""
    parts = COMM.allgather(values)
    whole = np.zeros(rows)
    for rank, part in enumerate(parts):
        whole[rank :: COMM.size] = part
    return whole


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
@pytest.mark.parametrize("name", SYSTEMS)
def test_solution_does_not_depend_on_ranks(name, method):
    system, options = SYSTEMS[name](), Options(rtol=1e-8, method=method)
    alone = TornSolver(system, options).solve()
    found = TornSolver(distributed(system, COMM), options).solve()
    own = alone.displacements[COMM.rank :: COMM.size]
    size = max(np.abs(u).max() for u in alone.displacements)
    for u, expected in zip(found.displacements, own, strict=True):
        np.testing.assert_allclose(u, expected, rtol=0.0, atol=1e-7 * size)
    for force, expected in (
        (in_order(found.normal_force, system.contacts.size), alone.normal_force),
        (in_order(found.tied_force, system.tied.size), alone.tied_force),
    ):
        atol = 1e-6 * np.abs(expected).max(initial=0.0)
        np.testing.assert_allclose(force, expected, rtol=0.0, atol=atol)
    assert abs(found.report.products["total"] - alone.report.products["total"]) <= 1
    for one, other in zip(found.report.contacts, alone.report.contacts, strict=True):
        for name in ("force", "moment", "force_on_master", "moment_on_master"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-6)
    groups = [g.bodies for g in found.report.certificate.groups]
    assert groups == [g.bodies for g in alone.report.certificate.groups]
    assert found.report.unknowns == alone.report.unknowns | {"torn": found.report.unknowns["torn"]}


def test_gram_matrix_is_that_of_all_ranks():
    constraints, _ = build_constraints(distributed(random_system(), COMM))
    numbers, coupling = constraints.layout.numbers, constraints.coupling
    own = constraints.matrix.multiply(1.0 / np.sqrt(constraints.weights)).tocoo()
    row, column, value = (
        concatenate_ranks(COMM, part)
        for part in (numbers[own.row], own.col + 10**6 * COMM.rank, own.data)
    )
    B = np.zeros((constraints.layout.size, np.unique(column).size))
    B[row, np.unique(column, return_inverse=True)[1]] = value
    expected = np.eye(len(B))
    expected[np.ix_(coupling.numbers, coupling.numbers)] = coupling.gram.toarray()
    np.testing.assert_allclose(B @ B.T, expected, rtol=0.0, atol=1e-14)


def test_preconditioner_is_that_of_one_rank():
    system, options = random_system(), Options(preconditioner="lumped")
    alone, found = TornSolver(system, options), TornSolver(distributed(system, COMM), options)
    rng = np.random.default_rng(0)
    forces, ties = rng.normal(size=system.contacts.size), rng.normal(size=system.tied.size)
    active = rng.random(system.contacts.size) < 0.5

    def energy(solver: TornSolver, mine: slice) -> float:
        constraints = solver.setup.constraints
        tied, x = constraints.tied, np.zeros(constraints.size)
        x[constraints.own_rows] = np.where(active, forces, 0.0)[mine]
        x[tied.own_rows] = ties[mine]
        on_face = np.zeros(constraints.size)
        on_face[constraints.own_rows] = active[mine]
        x, on_face = constraints.layout.sum(x), constraints.layout.sum(on_face)
        rows = constraints.equality | (on_face > 0.0)
        M = solver.setup.preconditioner.on_face(rows)
        return constraints.layout.space.dots((x, constraints.layout.sum(M(x))))[0]

    mine = slice(COMM.rank, None, COMM.size)
    np.testing.assert_allclose(energy(found, mine), energy(alone, slice(None)), rtol=1e-11)


def test_rows_that_one_rank_gives_alone():
    """The others have none, and the last has no subdomain."""
    system = contact_system()
    mine = slice(COMM.rank, None, max(1, COMM.size - 1))
    rows = system.contacts if COMM.rank == 0 else NONE
    last = COMM.size > 1 and COMM.rank == COMM.size - 1
    share = dataclasses.replace(
        distributed(system, COMM), subdomains=[] if last else system.subdomains[mine], contacts=rows
    )
    report = TornSolver(share, Options(rtol=1e-8)).solve().report
    alone = TornSolver(system, Options(rtol=1e-8)).solve().report
    np.testing.assert_allclose(
        [c.normal_force for c in report.contacts],
        [c.normal_force for c in alone.contacts],
        rtol=1e-7,
    )


def test_rank_that_gives_far_rows_and_holds_none():
    """One body on the first rank; the last one gives rows with infinite gaps."""
    block = cube(2, load=(0.0, 0.0, -1.0))
    nodes = block.nodes[block.coordinates[:, 2] == 1.0]
    k = nodes.size
    rows = ContactRows.node_to_node(
        nodes, np.full(k, -1), np.tile([0, 0, 1.0], (k, 1)), np.full(k, np.inf), np.zeros(k, int)
    )
    last = COMM.rank == COMM.size - 1
    held = clamped([block], (2, 0.0))
    system = TornSystem(
        [block] if COMM.rank == 0 else [], held, rows if last else NONE, 3, comm=COMM
    )
    solution = TornSolver(system, Options(rtol=1e-8)).solve()
    assert not solution.normal_force.any()
    np.testing.assert_allclose(solution.report.reactions[0].force, [0, 0, 1.0], atol=1e-8)

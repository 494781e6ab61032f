"""Contact and tied rows between any nodes: against a dense solver of quadratic programmes."""

from __future__ import annotations

import dataclasses

from mpi4py import MPI

import numpy as np
import pytest
from pairwise import pairwise
from sparse_rows import (
    SECOND,
    Dense,
    assert_same_on_ranks,
    clamped,
    distributed,
    interpolated,
    plane,
    random_rows,
    two_blocks,
)
from torn import cube, node_rows, with_fields, with_prescribed

from fenics_tfeti import InputError, UnresistedMotion
from fenics_tfeti.feti import ContactRows, Options, TornSolver, TornSystem
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.constraints.rows import build_constraints
from fenics_tfeti.parallel import concatenate_ranks

COMM = MPI.COMM_WORLD

NONE = ContactRows.none(3)
DOWN = np.array([0.0, 0.0, -1.0])
both_methods = pytest.mark.parametrize("method", ["active_set", "smalbe"])


def area(x: np.ndarray) -> np.ndarray:
    """Return areas of nodes from 1e-6 to 1e6."""
    return 10.0 ** (6.0 * np.sin(7.0 * x[:, 0] + 3.0 * x[:, 1]))


def of_blocks(contacts=NONE, tied=NONE, prescribed=None, blocks=None) -> TornSystem:
    blocks = blocks or two_blocks()
    prescribed = prescribed or clamped(blocks, (2, 0.0), (2, 2.0))
    names = ["lower", "upper"]
    return TornSystem(blocks, prescribed, contacts, 3, names, ["joint", "glue"], tied=tied)


def with_random_rows(seed: int, contacts: int, tied: int) -> TornSystem:
    rng, blocks = np.random.default_rng(seed), two_blocks()
    rows, ties = random_rows(blocks, rng, contacts), random_rows(blocks, rng, tied)
    ties = dataclasses.replace(ties, contact=ties.contact + 1)
    return of_blocks(rows, ties, blocks=blocks)


def tied_system(n: int = 4, area=lambda x: 1e-3 + x[:, 0], lower: int = 2) -> TornSystem:
    """Return a block that ties alone hold on another one, whose meshes do not match."""
    blocks = two_blocks(lower, n)
    tied = interpolated(blocks, lower, np.eye(3), area)
    return of_blocks(tied=tied, prescribed=clamped(blocks, (2, 0.0)), blocks=blocks)


def contact_system(area=lambda x: 1e-3 + x[:, 0]) -> TornSystem:
    blocks = two_blocks(2, 4)
    return of_blocks(interpolated(blocks, 2, DOWN, area), blocks=blocks)


SYSTEMS = {
    "random": lambda: with_random_rows(3, 30, 10),
    "tied": tied_system,
    "contact": contact_system,
}


def assert_solves(system: TornSystem, solution, rtol: float) -> None:
    exact = Dense.solve(system)
    difference = [u - v for u, v in zip(solution.displacements, exact.torn(), strict=True)]
    assert exact.energy_norm(difference) <= 10.0 * rtol * exact.energy_norm(exact.torn())
    u = np.zeros(exact.f.size)
    for at, part in zip(exact.places, solution.displacements, strict=True):
        u[at] = part
    contacts, tied = system.contacts, system.tied
    size = np.abs(u).max()
    # nothing is penetrated, tied surfaces stay together, and closed contacts are closed
    distance = (exact.C @ u - contacts.gap) / contacts.length
    assert distance.max(initial=0.0) <= 1e-13 * size
    assert np.abs(distance[solution.active]).max(initial=0.0) <= 1e-13 * size
    assert np.abs((exact.T @ u - tied.gap) / tied.length).max(initial=0.0) <= 1e-13 * size
    for found, multipliers, rows in (
        (solution.normal_force, exact.contact, contacts),
        (solution.tied_force, exact.tied, tied),
    ):
        force = multipliers * rows.length
        limit = 100.0 * rtol * np.abs(force).max(initial=0.0)
        np.testing.assert_allclose(found, force, rtol=0.0, atol=limit)


@pytest.mark.parametrize(
    ("counts", "preconditioner", "method"),
    pairwise(
        [(20, 0), (20, 8), (0, 8), (60, 20)],
        ["none", "lumped", "dirichlet"],
        ["active_set", "smalbe"],
    ),
)
def test_random_rows(counts, preconditioner, method):
    contacts, tied = counts
    system = with_random_rows(tied, contacts, tied)
    options = Options(rtol=1e-8, method=method, preconditioner=preconditioner)
    solution = TornSolver(system, options).solve()
    assert_solves(system, solution, 1e-8)
    assert solution.report.unknowns["tied"] == tied
    assert solution.report.equilibrium <= 1e-9


@pytest.mark.parametrize(
    ("meshes", "method"), [((2, 3), "active_set"), ((2, 4), "smalbe"), ((4, 2), "active_set")]
)
def test_body_that_is_tied_only(meshes, method):
    """The tied rows hold it: nothing is undetermined, and both bodies are one group."""
    system = tied_system(meshes[1], area, meshes[0])
    solution = TornSolver(system, Options(rtol=1e-8, method=method)).solve()
    assert_solves(system, solution, 1e-8)
    assert not solution.report.free_motions
    assert [g.bodies for g in solution.report.certificate.groups] == [["lower", "upper"]]


@pytest.mark.parametrize(
    ("stiffness", "lower_is_slave", "method"),
    pairwise([1e-3, 1.0, 1e3], [False, True], ["active_set", "smalbe"]),
)
def test_contact_of_meshes_that_do_not_match(stiffness, lower_is_slave, method):
    blocks = two_blocks(2, 4, stiffness=stiffness)
    normal, n = (-DOWN, 4) if lower_is_slave else (DOWN, 2)
    rows = interpolated(blocks, n, normal, area, master_above=lower_is_slave)
    system = of_blocks(rows, blocks=blocks)
    solution = TornSolver(system, Options(rtol=1e-8, method=method)).solve()
    assert solution.active.any()
    assert_solves(system, solution, 1e-8)


@both_methods
def test_slave_nodes_that_supports_move(method):
    """There are more of them than master nodes, so that their conditions depend on each other."""
    system = contact_system(area)
    system = with_prescribed(system, plane(system.subdomains, 1, 1.0)[0], [2], -0.01)
    solution = TornSolver(system, Options(rtol=1e-8, method=method)).solve()
    exact = Dense.solve(system)
    difference = [u - v for u, v in zip(solution.displacements, exact.torn(), strict=True)]
    assert exact.energy_norm(difference) <= 1e-7 * exact.energy_norm(exact.torn())
    assert solution.report.unknowns["dependent"] == 45 - 15
    total = exact.contact @ system.contacts.length
    np.testing.assert_allclose(solution.report.contacts[0].normal_force, total, rtol=1e-6)


def test_tied_forces_are_those_of_the_glued_mesh():
    """Where the meshes match, tied rows are gluing rows: the same displacement and forces."""
    apart = tied_system(2, area)
    whole = [dataclasses.replace(s, nodes=s.nodes % SECOND, body=0) for s in apart.subdomains]
    glued = TornSystem(whole, apart.prescribed, NONE, 3)
    one, two = (TornSolver(system, Options(rtol=1e-9)).solve() for system in (glued, apart))
    for found, expected in zip(two.displacements, one.displacements, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-7 * np.abs(expected).max())
    # the weight of the upper blocks goes through the tied surface
    np.testing.assert_allclose(two.report.contacts[0].force, [-0.2, 0.0, 2.0], atol=1e-7)
    assert [c.normal_force for c in two.report.contacts] == [0.0, 0.0]


def test_forces_and_moments_on_both_sides():
    """They are equal and opposite, and those on the slave balance the load."""
    report = TornSolver(tied_system(3, area), Options(rtol=1e-9)).solve().report
    joint = report.contacts[0]
    assert joint.name == "joint"
    for name in ("force", "moment"):
        pushed, exerted = getattr(joint, name), getattr(joint, f"{name}_on_master")
        np.testing.assert_allclose(pushed, -np.array(exerted), rtol=0.0, atol=1e-12)
        held = getattr(report.reactions[0], name)
        np.testing.assert_allclose(exerted, -np.array(held), rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(joint.moment, -np.array(report.load.moment), atol=1e-7)


def test_row_over_three_bodies_makes_them_one_group():
    blocks = [cube(2, load=DOWN), cube(2, (1, 0, 0), 1, SECOND), cube(2, (2, 0, 0), 2, 2 * SECOND)]
    one, *others = (s.nodes[-1] for s in blocks)
    # the mean of the last bodies' nodes is pushed down by the first
    rows = ContactRows([0, 3], [one, *others], [DOWN, -0.5 * DOWN, -0.5 * DOWN], [0.0], [0])
    fixed = clamped(blocks, (2, 0.0))
    system = TornSystem(blocks, fixed, rows, 3)
    solution = TornSolver(system, Options(rtol=1e-8)).solve()
    assert solution.active.all()
    assert_solves(system, solution, 1e-8)
    assert len(solution.report.certificate.groups) == 1


def test_tied_rows_that_leave_a_motion_free():
    """Ties along z alone hold no body against sliding."""
    blocks = two_blocks(2, 3)
    tied = interpolated(blocks, 2, DOWN)
    system = of_blocks(tied=tied, prescribed=clamped(blocks, (2, 0.0)), blocks=blocks)
    with pytest.raises(UnresistedMotion, match="upper: translation"):
        TornSolver(system)


def test_load_that_tied_nodes_share_out_moves_nothing():
    system = tied_system(2, area)
    blocks = [dataclasses.replace(s, load=np.zeros(s.load.size)) for s in system.subdomains]
    blocks[0].load[3 * 5 + 2], blocks[2].load[3 * 3 + 2] = 0.5, -0.5
    assert blocks[0].nodes[5] == blocks[2].nodes[3] - SECOND
    system = dataclasses.replace(system, subdomains=blocks)
    solution = TornSolver(system, Options(rtol=1e-8)).solve()
    assert not any(u.any() for u in solution.displacements)
    np.testing.assert_allclose(np.abs(solution.tied_force).sum(), 0.5, rtol=1e-12)


def test_prescribed_displacements_that_tear_tied_surfaces_apart():
    system = tied_system(2, None)
    one, other = system.tied.nodes[:2]
    torn = with_prescribed(with_prescribed(system, [one], [0]), [other], [0], 0.1)
    with pytest.raises(InputError, match=f"contradict 1 tied.*node {one}.*jump of -?0.1"):
        TornSolver(torn)


@both_methods
def test_next_solver_reuses_the_set_up(method):
    """Other gaps, the same rows."""
    options = Options(rtol=1e-8, method=method)
    system = with_random_rows(0, 20, 8)
    first = TornSolver(system, options)
    first.solve()
    wider = with_fields(system, "contacts", gap=1.1 * system.contacts.gap)
    second = TornSolver(wider, options, previous=first)
    assert second.reused == ["factors", "coarse problem", "norm", "multipliers"]
    assert_solves(wider, second.solve(), 1e-8)


@pytest.mark.ranks(2)
@pytest.mark.parametrize(
    ("name", "method"), [("random", "active_set"), ("tied", "smalbe"), ("contact", "active_set")]
)
def test_solution_does_not_depend_on_ranks(name, method):
    options = Options(rtol=1e-8, method=method)
    alone, found = assert_same_on_ranks(SYSTEMS[name](), options, 1e-7)
    assert abs(found.report.products["total"] - alone.report.products["total"]) <= 1


@pytest.mark.ranks(2, 3)
@pytest.mark.parametrize("weighted", [False, True])
def test_gram_matrix_is_that_of_all_ranks(weighted):
    """The identity but for coupled rows, which all ranks number alike."""
    share = distributed(SYSTEMS["random"](), COMM)
    weights = [
        10.0 ** np.random.default_rng(int(s.nodes[0])).uniform(-4.0, 0.0, s.nodes.size)
        for s in share.subdomains
    ]
    constraints, _ = build_constraints(share, np.concatenate(weights) if weighted else None)
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
    held = numbers[coupling.rows]
    np.testing.assert_array_equal(held, coupling.numbers[coupling.positions])
    assert np.isin(numbers, coupling.numbers).sum() == held.size


@pytest.mark.ranks(2)
def test_preconditioner_is_that_of_one_rank():
    system, options = SYSTEMS["random"](), Options(preconditioner="lumped")
    alone, found = TornSolver(system, options), TornSolver(distributed(system, COMM), options)
    rng = np.random.default_rng(0)
    forces, ties = rng.normal(size=system.contacts.size), rng.normal(size=system.tied.size)
    active = rng.random(system.contacts.size) < 0.5

    def energy(solver: TornSolver, mine: slice) -> float:
        constraints = solver.setup.constraints
        tied, x = constraints.tied, np.zeros(constraints.size)
        x[constraints.contacts.own_rows] = np.where(active, forces, 0.0)[mine]
        x[tied.own_rows] = ties[mine]
        on_face = np.zeros(constraints.size)
        on_face[constraints.contacts.own_rows] = active[mine]
        x, on_face = constraints.layout.sum(x), constraints.layout.sum(on_face)
        rows = constraints.equality | (on_face > 0.0)
        M = solver.setup.preconditioner.on(Face.of_rows(constraints, rows))
        return constraints.layout.space.dots((x, constraints.layout.sum(M(x))))[0]

    mine = slice(COMM.rank, None, COMM.size)
    np.testing.assert_allclose(energy(found, mine), energy(alone, slice(None)), rtol=1e-11)


@pytest.mark.ranks(2, 3)
def test_rows_that_one_rank_gives_alone():
    """The others have none, and the last has no subdomain."""
    system = contact_system()
    mine = slice(COMM.rank, None, COMM.size - 1)
    share = dataclasses.replace(
        distributed(system, COMM),
        subdomains=[] if COMM.rank == COMM.size - 1 else system.subdomains[mine],
        contacts=system.contacts if COMM.rank == 0 else NONE,
    )
    found, alone = (
        [c.normal_force for c in TornSolver(s, Options(rtol=1e-8)).solve().report.contacts]
        for s in (share, system)
    )
    np.testing.assert_allclose(found, alone, rtol=1e-7)


@pytest.mark.ranks(2, 3)
def test_rank_that_gives_far_rows_and_holds_none():
    """One body on the first rank; the last one gives rows with infinite gaps."""
    block = cube(2, load=(0.0, 0.0, -1.0))
    nodes = block.nodes[block.coordinates[:, 2] == 1.0]
    rows = node_rows(nodes, [0, 0, 1.0], gap=np.inf)
    last = COMM.rank == COMM.size - 1
    held = clamped([block], (2, 0.0))
    system = TornSystem(
        [block] if COMM.rank == 0 else [], held, rows if last else NONE, 3, comm=COMM
    )
    solution = TornSolver(system, Options(rtol=1e-8)).solve()
    assert not solution.normal_force.any()
    np.testing.assert_allclose(solution.report.reactions[0].force, [0, 0, 1.0], atol=1e-8)

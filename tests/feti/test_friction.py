"""Friction with a given bound: whole torn problems against a solver for second-order cones."""

from __future__ import annotations

import dataclasses
import itertools
from functools import cache

from mpi4py import MPI

import numpy as np
import pytest
from friction_problems import (
    STORED,
    blocks_that_do_not_match,
    held_block,
    horizontal,
    in_a_corner,
    in_a_groove,
    on_the_ground,
    pulled_strip,
    pushed_block,
    random_tangents,
    solve_by_cones,
)
from sparse_rows import clamped, distributed, random_rows, two_blocks
from torn import with_fields, with_prescribed

from fenics_tfeti import InputError, UnresistedMotion
from fenics_tfeti.feti import (
    ContactGuess,
    Friction,
    Options,
    SlipBoundStep,
    TornSolver,
    TornSystem,
    load_system,
    save_system,
)
from fenics_tfeti.feti.constraints.rows import build_constraints
from fenics_tfeti.feti.solution.monitor import describe_step
from fenics_tfeti.parallel import concatenate_ranks

pytestmark = pytest.mark.once

COMM = MPI.COMM_WORLD


def nodes_where(system: TornSystem, axis: int, value: float, bodies=(0, 1)) -> np.ndarray:
    """Return the nodes of subdomains at x[axis] == value."""
    parts = [system.subdomains[body] for body in bodies]
    return np.concatenate([s.nodes[s.coordinates[:, axis] == value] for s in parts])


def slave_held_across() -> TornSystem:
    """Return the pushed block with symmetry planes y = 0 of both bodies."""
    system = pushed_block(load=(0.15, 0.0, -1.0))
    return with_prescribed(system, nodes_where(system, 1, 0.0), [1])


def moved_support() -> TornSystem:
    """Return the pushed block on a support that moves by more than the bodies deform."""
    system = pushed_block()
    values = np.choose(system.prescribed.components, [0.3, -0.2, 0.1])
    return with_fields(system, "prescribed", values=values)


def some_without_friction() -> TornSystem:
    """Return the pushed block with friction at every other row, of various bounds."""
    system = pushed_block()
    rows = np.arange(0, system.contacts.size, 2)
    bound = np.linspace(0.0, 0.06, rows.size)
    tangents = system.friction.tangents[rows]
    return dataclasses.replace(system, friction=Friction(rows, tangents, bound))


def turned_tangents() -> TornSystem:
    """Return the pushed block with tangents turned by another angle at each row."""
    system = pushed_block()
    angle = np.arange(system.friction.size)
    along = np.stack([np.cos(angle), np.sin(angle), np.zeros(angle.size)], axis=1)
    across = np.stack([-np.sin(angle), np.cos(angle), np.zeros(angle.size)], axis=1)
    return with_fields(system, "friction", tangents=np.stack([along, across], axis=1))


def prescribed_too(system: TornSystem, body: int, component: int, value: float) -> TornSystem:
    """Prescribe a component of the contact nodes of one body."""
    return with_prescribed(system, nodes_where(system, 2, 1.0, [body]), [component], value)


def one_side_held_across() -> TornSystem:
    """Return the pushed block, of which one side alone cannot move along y: rows of two lengths."""
    return prescribed_too(pushed_block(), 0, 1, 0.0)


def one_side_held_across_tangents() -> TornSystem:
    """Return the same with turned tangents: rows that are not orthogonal."""
    return prescribed_too(turned_tangents(), 1, 1, 0.0)


def half_held() -> TornSystem:
    """Return blocks that do not match, the lower one held along x where they touch."""
    return prescribed_too(blocks_that_do_not_match(), 0, 0, 0.0)


SYSTEMS = {
    "pushed": pushed_block,
    "earlier slip": lambda: pushed_block(slip=(0.01, -0.003)),
    "held": held_block,
    "do not match": blocks_that_do_not_match,
    "ground": on_the_ground,
    "strip": pulled_strip,
    "symmetry": slave_held_across,
    "moved": moved_support,
    "some": some_without_friction,
    "turned": turned_tangents,
    "one side": one_side_held_across,
    "one side, turned": one_side_held_across_tangents,
    "half": half_held,
}
ON_RANKS = ["pushed", "do not match", "ground", "strip"]
USUAL, *OTHER_WAYS = itertools.product(("lumped", "dirichlet", "none"), ("active_set", "smalbe"))
SLOW = {"friction_50076", "friction_50136", "friction_50140", "friction_50220"}
ON_RANKS_TOO = next(path for path in STORED if path.stem not in SLOW)
stored = pytest.mark.parametrize(
    "path",
    [
        pytest.param(
            path,
            id=path.stem,
            marks=[pytest.mark.heavy] * (path.stem in SLOW)
            + [pytest.mark.ranks] * (path == ON_RANKS_TOO),
        )
        for path in STORED
    ],
)
SOLVED = [
    *(
        pytest.param(name, *USUAL, marks=[pytest.mark.ranks(1, 2, 3)] * (name in ON_RANKS))
        for name in SYSTEMS
    ),
    *((name, *way) for name, way in zip(SYSTEMS, itertools.cycle(OTHER_WAYS), strict=False)),
]


@cache
def expected(name: str):
    return solve_by_cones(SYSTEMS[name]())


@cache
def solved(name: str, preconditioner: str, method: str):
    options = Options(rtol=1e-8, preconditioner=preconditioner, method=method)
    return TornSolver(distributed(SYSTEMS[name](), COMM), options).solve()


def assert_friction_conditions(found, friction):
    """At most the bound; below it no slip; at it the slip is along the force."""
    force = np.linalg.norm(found.tangential_force, axis=1)
    slip = np.linalg.norm(found.slip, axis=1)
    assert np.all(force <= friction.bound * (1.0 + 1e-12))
    assert not slip[found.sticking].any()
    np.testing.assert_allclose(force[slip > 0.0], friction.bound[slip > 0.0], rtol=1e-12)
    clear = (slip > 1e-4 * slip.max(initial=0.0)) & (friction.bound > 0.0)
    cosine = np.sum(found.slip * found.tangential_force, axis=1)[clear] / (force * slip)[clear]
    np.testing.assert_allclose(cosine, 1.0, atol=1e-6)


def assert_report(found, friction):
    """Certificate, numbers of sites and the work of friction."""
    report, numbers = found.report, found.report.certificate.numbers()
    assert report.converged
    assert max(numbers.values()) <= 1e-8
    assert {"friction above its bound", "slip below the bound", "slip across the force"} <= set(
        numbers
    )
    assert report.unknowns["friction"] == COMM.allreduce(friction.size)
    assert report.unknowns["sticking"] == COMM.allreduce(np.count_nonzero(found.sticking))
    work = COMM.allreduce(float(np.sum(found.slip * found.tangential_force)))
    assert [c.friction_work for c in report.contacts] == [pytest.approx(work, rel=1e-12, abs=1e-15)]
    assert report.equilibrium < 1e-8


@pytest.mark.parametrize(("name", "preconditioner", "method"), SOLVED)
def test_solution(name, preconditioner, method):
    """By the conic solver, and by the conditions of friction; on any number of ranks."""
    found, exact = solved(name, preconditioner, method), expected(name)
    friction = distributed(SYSTEMS[name](), COMM).friction
    assert found.report.energy == pytest.approx(exact.energy, rel=1e-8)
    mine = slice(COMM.rank, None, COMM.size)
    of_site = np.isin(SYSTEMS[name]().friction.row, np.arange(exact.normal_force.size)[mine])
    for force, other, own in (
        (found.normal_force, exact.normal_force, mine),
        (found.tangential_force, exact.tangential_force, of_site),
    ):
        np.testing.assert_allclose(force, other[own], rtol=0.0, atol=1e-6 * np.abs(other).max())
    size = np.abs(exact.displacement).max()
    np.testing.assert_allclose(found.slip, exact.slip[of_site], rtol=0.0, atol=1e-6 * size)
    if (preconditioner, method) == USUAL:
        assert_friction_conditions(found, friction)
        assert_report(found, friction)


@pytest.mark.parametrize("seed", range(4))
def test_random_rows_that_depend_on_each_other(seed):
    """Any coefficients, tangents, bounds and slips; more rows than components at some nodes."""
    rng = np.random.default_rng(seed)
    subdomains = two_blocks(1, 2, (*rng.normal(0.0, 0.1, 2), -rng.uniform(0.2, 1.0)))
    rows = random_rows(subdomains, rng, int(rng.integers(2, 12)), lengths=(-1, 1))
    tangents = random_tangents(rows.normal, rng)
    bound = 0.1 * 10.0 ** rng.uniform(-2, 1, rows.size) * (rng.random(rows.size) < 0.9)
    slip = 0.01 * rng.standard_normal((rows.size, 2))
    friction = Friction(np.arange(rows.size), tangents, bound, slip)
    fixed = clamped(subdomains, (2, 0.0), (2, 2.0))
    system = TornSystem(subdomains, fixed, rows, 3, friction=friction)
    found = TornSolver(system, Options(rtol=1e-7)).solve()
    assert found.report.energy == pytest.approx(solve_by_cones(system).energy, rel=1e-9)
    assert found.report.outer_iterations == 0


@stored
def test_rows_that_stick_and_cannot_be_closed_together(path):
    """With Coulomb's law they are those of the slip bounds that were found; on any ranks."""
    system = load_system(path)
    found = TornSolver(load_system(path, COMM), Options()).solve()
    bound = concatenate_ranks(COMM, found.slip_bound)
    exact = solve_by_cones(with_fields(system, "friction", bound=bound, coefficient=None))
    assert found.report.certificate.worst <= 1e-6
    assert found.report.energy == pytest.approx(exact.energy, rel=1e-5)


@pytest.mark.parametrize("seed", [2, 12])
def test_forces_in_a_corner(seed):
    """Rows of sites in the edge depend on each other, and forces turn without end in some."""
    system = in_a_corner(seed)
    found = TornSolver(system, Options()).solve().report
    assert found.energy == pytest.approx(solve_by_cones(system).energy, rel=1e-9)
    # 10,000 for seed 12 without Newton's method on proximal problems
    assert found.products["total"] <= 3000


@pytest.mark.parametrize(("bound", "preconditioner"), [(1e-3, "dirichlet"), (0.02, "lumped")])
def test_nodes_between_two_planes(bound, preconditioner):
    """Four directions of sticking or turning forces in the plane across the groove."""
    system, options = in_a_groove(bound), Options(preconditioner=preconditioner)
    report = TornSolver(system, options).solve().report
    assert report.energy == pytest.approx(solve_by_cones(system).energy, rel=1e-9)
    # 4000 where the preconditioner does not see forces that only turn against each other
    assert report.products["total"] <= 1000


def test_problems_have_both_states():
    """Otherwise the tests of this file say nothing about one of them."""
    mixed = [name for name in SYSTEMS if np.count_nonzero(solved(name, *USUAL).sticking) > 0]
    slipping = [name for name in mixed if not solved(name, *USUAL).sticking.all()]
    assert len(slipping) >= 7


@pytest.mark.parametrize(
    ("name", "rtol"), [("pushed", 1e-2), ("do not match", 1e-4), ("strip", 1e-2), ("turned", 1e-4)]
)
def test_bound_of_the_error_is_one(name, rtol):
    system = SYSTEMS[name]()
    found, exact = TornSolver(system, Options(rtol=rtol)).solve(), solved(name, *USUAL)
    error2 = 0.0
    for subdomain, u, v in zip(
        system.subdomains, found.displacements, exact.displacements, strict=True
    ):
        error2 += (u - v) @ (subdomain.stiffness @ (u - v))
    assert np.sqrt(error2) <= found.report.certificate.bound * 1.001 + 1e-8
    assert found.report.certificate.error <= rtol


def test_forces_on_both_sides_are_opposite_and_balance_the_load():
    report = solved("pushed", *USUAL).report
    np.testing.assert_allclose(report.contacts[0].force, [-0.15, -0.05, 1.0], atol=1e-9)
    np.testing.assert_allclose(report.contacts[0].force_on_master, [0.15, 0.05, -1.0], atol=1e-9)
    np.testing.assert_allclose(report.reactions[0].force, [-0.15, -0.05, 1.0], atol=1e-9)
    assert [c.normal_force for c in report.contacts] == [pytest.approx(1.0, rel=1e-9)]


@pytest.mark.parametrize("name", ["pushed", "strip", "one side", "half"])
def test_products_of_the_active_set_method(name):
    """It ends by itself, and takes less than SMALBE-M."""
    found, other = (solved(name, "lumped", m).report for m in ("active_set", "smalbe"))
    assert found.outer_iterations == 0
    assert other.faces == []
    assert found.products["total"] <= 0.6 * other.products["total"]


def test_products_are_at_most_three_times_those_of_tied_surfaces():
    """Two of four subdomains slip in part, on three meshes."""
    for n in (3, 5, 7):
        system = pushed_block(n, bound=0.32 / (n + 1) ** 2 * (0.95 if n == 3 else 0.6))
        tied = dataclasses.replace(system, friction=horizontal(system.contacts, 1e3))
        rubbing, sticking = (TornSolver(s, Options(rtol=1e-6)).solve() for s in (system, tied))
        assert 0 < np.count_nonzero(rubbing.sticking) < rubbing.sticking.size
        assert rubbing.report.products["total"] <= 3 * sticking.report.products["total"]


def test_guess_of_the_contact_is_taken():
    """A guess that is the solution saves the search for what presses."""
    system, exact = pushed_block(), solved("pushed", *USUAL)
    guess = ContactGuess(exact.normal_force, np.where(exact.active, 0.0, 1.0))
    found = TornSolver(system, Options(rtol=1e-8), guess=guess).solve()
    assert "contact guess" in found.report.reused
    assert found.report.energy == pytest.approx(exact.report.energy, rel=1e-12)


@pytest.mark.parametrize("bound", [1e-8, 1e-9, 1e-10])
def test_force_that_a_slip_out_of_proportion_turns(bound):
    """The curvature of its cost, |slip| / bound, is up to 10^14 times the compliance of bodies."""
    system, given, site = pushed_block(), np.array([600.0, 800.0]), 4
    bounds, slips = system.friction.bound.copy(), np.zeros((system.friction.size, 2))
    bounds[site], slips[site] = bound, given

    def solve(bounds, slips):
        changed = with_fields(system, "friction", bound=bounds, slip=slips)
        return TornSolver(changed, Options(rtol=1e-9)).solve()

    solution = solve(bounds, slips)
    force = solution.tangential_force[site]
    # the slip of the bodies, which adds to the given one, is about 0.1
    np.testing.assert_allclose(force, -bound * given / 1e3, rtol=1e-3)
    bounds[site] = 0.0
    without = solve(bounds, np.zeros_like(slips))
    for u, exact in zip(solution.displacements, without.displacements, strict=True):
        np.testing.assert_allclose(u, exact, atol=100.0 * bound + 1e-8)
    # the first faces take the site as one that sticks
    assert solution.report.products["total"] <= 2.5 * without.report.products["total"]


def test_rows_without_anything_to_touch_have_no_friction():
    system = held_block()
    far = np.arange(system.contacts.size) % 3 == 0
    system = with_fields(system, "contacts", gap=np.where(far, np.inf, system.contacts.gap))
    found = TornSolver(system).solve()
    assert found.report.unknowns["friction"] == np.count_nonzero(~far)
    assert not any(x[far].any() for x in (found.tangential_force, found.slip, found.sticking))
    assert found.tangential_force[~far].any()


def test_next_load_starts_from_the_last_multipliers():
    """Slip is counted from the last step: taken back by the same load in the other direction."""
    options = Options(rtol=1e-8)
    first = TornSolver(pushed_block(), options)
    before = first.solve()
    system = first.system
    again = TornSolver(dataclasses.replace(system), options, previous=first)
    assert set(again.reused) >= {"factors", "coarse problem", "norm", "multipliers"}
    repeated = again.solve()
    assert repeated.report.products["total"] <= 0.5 * before.report.products["total"]
    np.testing.assert_allclose(repeated.slip, before.slip, atol=1e-6 * np.abs(before.slip).max())
    # the same load once more, slip counted from here: nothing slips, the same displacement
    further = with_fields(system, "friction", slip=before.slip)
    after = TornSolver(further, options, previous=again).solve()
    size = np.abs(np.concatenate(before.displacements)).max()
    for u, v in zip(after.displacements, before.displacements, strict=True):
        np.testing.assert_allclose(u, v, atol=1e-6 * size)
    assert np.abs(after.slip).max() <= 1e-6 * np.abs(before.slip).max()


# -- loads that friction cannot hold -------------------------------------------------------------


def test_load_that_friction_cannot_hold_names_body_motion_and_how_much_it_would_take():
    """16 nodes of bound 0.0095 hold 0.152, against a push of 0.1581."""
    total = np.hypot(0.15, 0.05)
    with pytest.raises(
        UnresistedMotion, match=rf"slides upper: translation along .* {total / 0.152:.4g} times"
    ):
        TornSolver(pushed_block(bound=0.152 / 16))


@pytest.mark.parametrize("part", [0.9, 0.999, 1.001])
def test_limit_of_what_friction_holds(part):
    system = pushed_block(load=(0.16 * part, 0.0, -1.0), bound=0.01)
    if part > 1.0:
        with pytest.raises(UnresistedMotion, match=r"friction cannot hold"):
            TornSolver(system)
        return
    solver = TornSolver(system, Options(rtol=1e-6))
    friction, start = solver.setup.constraints.friction, solver.data.feasible
    coarse_space = solver.setup.projector.coarse_space
    np.testing.assert_allclose(coarse_space.restrict(start), solver.data.e, atol=1e-9)
    force = np.linalg.norm(friction.at_sites(start), axis=1)
    assert np.all(force <= friction.bound.radius * (1.0 + 1e-12))
    assert np.all(start[solver.setup.constraints.inequality] >= 0.0)


@pytest.mark.parametrize(("part", "method"), [
    (0.9, "active_set"), (0.99, "active_set"), (0.999, "active_set"), (0.9, "smalbe"),
])  # fmt: skip
def test_load_close_to_the_limit(part, method):
    """Few nodes stick, or none: then the directions of the forces balance the load."""
    system = pushed_block(load=(0.16 * part, 0.0, -1.0), bound=0.01)
    found = TornSolver(system, Options(rtol=1e-8, method=method)).solve()
    assert found.report.energy == pytest.approx(solve_by_cones(system).energy, rel=1e-8)
    assert np.count_nonzero(found.sticking) <= 4
    assert method == "smalbe" or found.report.outer_iterations == 0


def test_load_that_no_friction_holds():
    with pytest.raises(UnresistedMotion, match=r"upper: translation along \(0, 0, 1\)") as raised:
        TornSolver(pushed_block(load=(0.0, 0.0, 1.0)))
    assert "times the slip bounds" not in str(raised.value)


def test_twist_is_held_by_friction_too():
    """A couple about the vertical axis: discs take it as far as their lever arms reach."""
    system = pushed_block(bound=0.02)
    upper = system.subdomains[-1]
    x = upper.coordinates - upper.coordinates.mean(axis=0)
    load = upper.load.reshape(-1, 3).copy()
    load[:, :2] = 2e-3 * np.stack([-x[:, 1], x[:, 0]], axis=1)
    twisted = dataclasses.replace(upper, load=load.ravel())
    system = dataclasses.replace(system, subdomains=[*system.subdomains[:-1], twisted])
    found, exact = TornSolver(system, Options(rtol=1e-8)).solve(), solve_by_cones(system)
    assert found.report.energy == pytest.approx(exact.energy, rel=1e-8)
    assert abs(found.report.contacts[0].moment[2]) > 1e-3


# -- Coulomb's law --------------------------------------------------------------------------------


def by_pressure(system: TornSystem, coefficient: float, bound: float = 0.0) -> TornSystem:
    k = system.friction.size
    return with_fields(
        system, "friction", bound=np.full(k, bound), coefficient=np.full(k, coefficient)
    )


@pytest.fixture(scope="module")
def coulomb():
    """Return a pushed block with a coefficient and a bound, and its solution."""
    system = by_pressure(pushed_block(), 0.22, 0.002)
    return system, TornSolver(system, Options(rtol=1e-7)).solve()


def test_coulomb_is_tresca_with_its_own_bounds(coulomb):
    """The conic solver gets the bounds that the normal forces and the given ones make."""
    system, found = coulomb
    bound = 0.002 + 0.22 * found.normal_force
    np.testing.assert_allclose(found.slip_bound, bound, atol=1e-6 * bound.max())
    exact = solve_by_cones(with_fields(system, "friction", bound=bound))
    largest = np.abs(exact.normal_force).max()
    np.testing.assert_allclose(found.normal_force, exact.normal_force, atol=1e-5 * largest)
    np.testing.assert_allclose(found.tangential_force, exact.tangential_force, atol=1e-5 * largest)
    assert 0 < np.count_nonzero(found.sticking) < found.sticking.size


def test_next_load_with_coulomb_starts_from_the_last_bounds(coulomb):
    system, before = coulomb
    first = TornSolver(system, Options(rtol=1e-7))
    first.solve()
    again = TornSolver(dataclasses.replace(system), Options(rtol=1e-7), previous=first).solve()
    assert again.report.products["total"] <= 0.6 * before.report.products["total"]
    assert len(again.report.slip_bounds) <= 3


def test_coefficient_where_the_normal_force_is_not_known():
    """The contact nodes of both blocks are held vertically, closed or open; they may slip."""
    system = prescribed_too(prescribed_too(pushed_block(), 0, 2, 0.0), 1, 2, 0.0)
    with pytest.warns(UserWarning, match="there is no friction at 16 nodes of joint"):
        without = build_constraints(by_pressure(system, 0.3))[0].friction
    assert not without.bound.at(np.ones(without.size)).any()
    assert build_constraints(system)[0].friction.bound.radius.all()
    apart = with_fields(system, "contacts", gap=np.full(system.contacts.size, 0.1))
    assert not build_constraints(by_pressure(apart, 0.3))[0].friction.size


def test_monitor_is_told_of_steps_and_files_keep_coefficients(coulomb, tmp_path):
    system, _ = coulomb
    save_system(tmp_path / "system.npz", system)
    read = load_system(tmp_path / "system.npz")
    np.testing.assert_array_equal(read.friction.coefficient, system.friction.coefficient)
    steps = []
    report = TornSolver(read, Options(rtol=1e-4)).solve(steps.append).report
    assert [step for step in steps if isinstance(step, SlipBoundStep)] == report.slip_bounds
    lines = [describe_step(step, i) for i, step in enumerate(report.slip_bounds)]
    assert lines[0].startswith("slip    0")
    assert "ratio" in lines[1]


# -- input ----------------------------------------------------------------------------------------

FRAME = np.tile([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], (2, 1, 1))


@pytest.mark.parametrize(("friction", "message"), [
    (None, "friction: got NoneType"),
    (Friction([0, 1], FRAME, [1.0]), r"friction.bound: got shape \(1,\)"),
    (Friction([0, 1], FRAME[:, :1], [1.0, 1.0]), "friction.tangents: got shape"),
    (Friction([0, 99], FRAME, [1.0, 1.0]), r"friction.row: 1 of 2 numbers are not in \[0, 16\)"),
    (Friction([1, 0], FRAME, [1.0, 1.0]), "must ascend"),
    (Friction([0, 1], FRAME, [1.0, -1.0]), "-1 N at position 1; a slip bound is at least 0"),
    (Friction([0, 1], FRAME, [1.0, np.nan]), "friction.bound: 1 of 2 numbers are NaN"),
    (Friction([0, 1], 2.0 * FRAME, [1.0, 1.0]), "not orthonormal"),
    (Friction([0, 1], FRAME[:, :, ::-1], [1.0, 1.0]), "not orthonormal"),
    (Friction([0, 1], np.nan * FRAME, [1.0, 1.0]), "friction.tangents: 12 of 12"),
    (Friction([0, 1], FRAME, [1.0, 1.0], [[0.0, 0.0]]), r"friction.slip: got shape \(1, 2\)"),
    (Friction([0, 1], FRAME, [1.0, 1.0], coefficient=[0.1]), r"coefficient: got shape \(1,\)"),
    (Friction([0, 1], FRAME, [0.0, 0.0], compliance=[0.1, -0.1]),
     "friction.compliance: -0.1 m/N at position 1; a compliance is at least 0"),
    (Friction([0, 1], FRAME, [0.0, 0.0], coefficient=[0.1, -0.1]),
     "-0.1 at position 1; a coefficient of friction is at least 0"),
    (Friction([0, 1], FRAME, [0.0, 0.0], coefficient=[0.1, np.inf]),
     "friction.coefficient: 1 of 2 numbers are"),
])  # fmt: skip
def test_wrong_friction_is_named(friction, message):
    system = dataclasses.replace(pushed_block(), friction=friction)
    with pytest.raises(InputError, match=message):
        TornSolver(system)


def test_prescribed_slip_in_one_direction_is_an_error():
    system = prescribed_too(prescribed_too(pushed_block(), 0, 1, 0.0), 1, 1, 0.1)
    with pytest.raises(InputError, match="slide 16 contact rows in one tangential direction"):
        TornSolver(system)


@pytest.mark.ranks(2, 3)
@pytest.mark.parametrize("name", ON_RANKS)
def test_all_rows_of_a_site_are_on_the_same_ranks(name):
    constraints = build_constraints(distributed(SYSTEMS[name](), COMM))[0]
    friction, owned = constraints.friction, constraints.layout.owned
    assert friction.present.all()
    assert np.all((friction.rows < owned).all(axis=1) == (friction.rows < owned).any(axis=1))
    total = COMM.allreduce(int(np.count_nonzero(friction.owned(owned))))
    assert total == SYSTEMS[name]().friction.size


@pytest.mark.ranks(2, 3)
def test_ranks_without_subdomains_or_rows():
    system = on_the_ground()
    here = COMM.rank == COMM.size - 1
    alone = TornSolver(system, Options(rtol=1e-8)).solve()
    empty = dataclasses.replace(
        system,
        subdomains=system.subdomains if here else [],
        contacts=system.contacts if here else system.contacts.chosen(np.zeros(0, int)),
        friction=system.friction if here else type(system.friction).none(3),
        comm=COMM,
    )
    found = TornSolver(empty, Options(rtol=1e-8)).solve()
    assert found.report.energy == pytest.approx(alone.report.energy, rel=1e-12)


@pytest.mark.ranks(2)
def test_load_that_friction_cannot_hold_is_an_error_on_all_ranks():
    system = distributed(on_the_ground(bound=0.003), COMM)
    with pytest.raises(UnresistedMotion, match=r"It would take 1\.333 times the slip bounds"):
        TornSolver(system)


@pytest.mark.ranks(2)
def test_friction_in_a_file(shared_folder):
    """Rows are written in the order of ranks, and dealt out to them in blocks."""
    path = shared_folder / "system.npz"
    system = blocks_that_do_not_match()
    save_system(path, distributed(system, COMM))
    read = load_system(path, COMM)
    assert COMM.allreduce(read.friction.size) == system.friction.size
    found, exact = (TornSolver(s, Options(rtol=1e-8)).solve().report for s in (read, system))
    assert found.energy == pytest.approx(exact.energy, rel=1e-12)
    assert found.unknowns["sticking"] == exact.unknowns["sticking"]

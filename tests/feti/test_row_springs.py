"""Contact rows with springs, against a conic solver, closed forms and ties."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from friction_problems import horizontal, pushed_block
from row_springs import WithSprings, random_system, with_friction, with_springs
from sparse_rows import SECOND, assert_same_on_ranks, distributed
from torn import (
    POISSON,
    YOUNG,
    Glued,
    column,
    fixed_nodes,
    node_rows,
    operators_on,
    with_fields,
    with_prescribed,
)

from fenics_tfeti import InputError
from fenics_tfeti.feti import (
    ContactRows,
    Options,
    Prescribed,
    TornSolver,
    TornSystem,
    load_checkpoint,
    save_checkpoint,
)
from fenics_tfeti.feti.dual.iterate import Iterate, SolveStatus, Turn
from fenics_tfeti.feti.dual.pcpg import pcpg
from fenics_tfeti.feti.dual.proximal_newton import proximal_newton
from fenics_tfeti.feti.solution.linear import LinearData
from fenics_tfeti.feti.system import RowValues
from fenics_tfeti.qp import Products

once = pytest.mark.once
# accuracy of the conic solver's forces, relative to the largest
CONIC = 1e-7


def free_column(load, compliance: float, n: int = 2) -> TornSystem:
    """Return a cube on a fixed one that springs across and along the joint alone hold."""
    system = column(n, 1, load=load)
    bottom = system.prescribed.nodes < SECOND
    fixed = Prescribed(*(x[bottom] for x in vars(system.prescribed).values()))
    slave = system.contacts.slave
    normals = [[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    parts = [node_rows(slave, n, slave - SECOND, contact=k) for k, n in enumerate(normals)]
    pressed = np.repeat([0.0, compliance, compliance], slave.size)
    system = replace(
        system,
        prescribed=fixed,
        contacts=ContactRows.concatenate(parts),
        contact_names=["across", "along x", "along y"],
    )
    return with_springs(system, pressed, compliance)


def assert_solves(system: TornSystem, options: Options) -> None:
    """Compare with the conic solver; the bound is one of the energy, springs included."""
    exact, solution = WithSprings.solve(system), TornSolver(system, options).solve()
    report = solution.report
    certificate = report.certificate
    differences = [u - v for u, v in zip(solution.displacements, exact.torn(), strict=True)]
    error, norm = exact.energy_norm(differences), exact.energy_norm(exact.torn())
    assert certificate.guaranteed
    assert error <= certificate.bound + CONIC * norm
    assert 2.0 * (report.energy - exact.energy) <= certificate.bound**2 + 1e-11 * abs(exact.energy)
    size = np.abs(exact.force).max()
    np.testing.assert_allclose(solution.normal_force, exact.force, atol=CONIC * size)


@once
@pytest.mark.parametrize("seed", range(30))
def test_random_springs(seed):
    """Contact, soft contact, cohesion, springs and ties side by side, with gaps."""
    assert_solves(random_system(seed), Options(rtol=1e-8))


@once
@pytest.mark.parametrize("seed", range(30, 42))
def test_random_springs_by_smalbe(seed):
    """Multipliers that may pull are split into two that may not."""
    assert_solves(random_system(seed), Options(rtol=1e-8, method="smalbe"))


@once
@pytest.mark.parametrize("seed", range(42, 48))
@pytest.mark.parametrize("rtol", [0.3, 1e-2])
def test_bound_of_inaccurate_solutions(seed, rtol):
    assert_solves_roughly(random_system(seed), rtol)


def assert_solves_roughly(system: TornSystem, rtol: float) -> None:
    """Test the bound alone, which is within a factor of ten of the error."""
    exact = WithSprings.solve(system)
    report = TornSolver(system, Options(rtol=rtol)).solve().report
    excess = 2.0 * (report.energy - exact.energy)
    assert -1e-11 * abs(exact.energy) <= excess <= report.certificate.bound**2


@once
@pytest.mark.parametrize("load", [(0.2, 0.1, 1.0), (0.2, 0.1, -1.0)], ids=["pulled", "pressed"])
@pytest.mark.parametrize("compliance", [1e-6, 1e-2, 1.0, 1e2, 1e4])
@pytest.mark.parametrize("method", ["active_set", "smalbe"])
def test_springs_alone_hold_a_body(load, compliance, method):
    assert_solves(free_column(load, compliance), Options(rtol=1e-8, method=method))


@once
@pytest.mark.parametrize("seed", range(48, 54))
def test_newtons_method_on_proximal_problems(seed):
    """From nothing, as it goes on where active sets repeat."""
    system = random_system(seed)
    solver, exact = TornSolver(system), WithSprings.solve(system)
    problem = solver.dual_problem()
    turn = Turn(1e-9 * problem.energy_norm, 10_000, Products(), monitor=lambda step: None)
    iterate = Iterate(np.zeros_like(problem.d))
    for _ in range(60):
        iterate = proximal_newton(problem, iterate, turn)
        if iterate.status is SolveStatus.SOLVED:
            break
    assert iterate.status is SolveStatus.SOLVED
    forces = solver.setup.constraints.contacts.forces(iterate.multipliers)
    np.testing.assert_allclose(forces, exact.force, atol=1e-5 * np.abs(exact.force).max())


# -- closed forms ----------------------------------------------------------------------------------

# of uniaxial strain
MODULUS = YOUNG * (1.0 - POISSON) / ((1.0 + POISSON) * (1.0 - 2.0 * POISSON))


def bar(displacement: float, n: int = 3, gap: float = 0.0) -> tuple[TornSystem, np.ndarray]:
    """Return two unit cubes, held sideways everywhere and moved together, with the areas of rows.

    Stress and strain are uniform.
    """
    system = column(n, 1, load=(0.0, 0.0, 0.0))
    upper = system.subdomains[-1]
    nodes = np.concatenate([s.nodes for s in system.subdomains])
    top = upper.nodes[np.isclose(upper.coordinates[:, 2], 2.0)]
    system = with_prescribed(with_prescribed(system, nodes, [0, 1]), top, [2], displacement)
    x = upper.coordinates[np.searchsorted(upper.nodes, system.contacts.slave)]
    at_rim = np.isclose(x[:, :2], 0.0) | np.isclose(x[:, :2], 1.0)
    areas = np.prod(np.where(at_rim, 0.5, 1.0), axis=1) / n**2
    return with_fields(system, "contacts", gap=np.full(areas.size, gap)), areas


@once
@pytest.mark.parametrize("stiffness", [1e-2, 1.0, 1e3])
@pytest.mark.parametrize(("displacement", "kind"), [
    (-0.02, "soft contact"), (0.02, "cohesion"), (-0.02, "spring"), (0.02, "spring"),
])  # fmt: skip
def test_uniform_stress(displacement, kind, stiffness):
    """The bodies and the layer of springs in series."""
    system, areas = bar(displacement)
    compliance = 1.0 / (stiffness * areas)
    pressed = 0.0 if kind == "cohesion" else compliance
    pulled = np.inf if kind == "soft contact" else compliance
    solution = TornSolver(with_springs(system, pressed, pulled), Options(rtol=1e-11)).solve()
    pressure = -displacement / (2.0 / MODULUS + 1.0 / stiffness)
    np.testing.assert_allclose(solution.normal_force / areas, pressure, rtol=1e-9)
    # work of the prescribed displacement
    energy = -0.5 * pressure * displacement
    assert solution.report.energy == pytest.approx(energy, rel=1e-9)


@once
@pytest.mark.parametrize("displacement", [0.02, -0.02])
def test_springs_count_from_the_gap(displacement):
    """Springs are longer by the gap, and unstrained without a displacement."""
    system, areas = bar(displacement, gap=0.01)
    compliance = 1.0 / areas
    solution = TornSolver(with_springs(system, compliance, compliance), Options(rtol=1e-11)).solve()
    pressure = -(displacement + 0.01) / (2.0 / MODULUS + 1.0)
    np.testing.assert_allclose(solution.normal_force / areas, pressure, rtol=1e-9)


@once
def test_stiff_springs_are_ties_and_soft_ones_nothing():
    system, areas = bar(0.02)
    force = {}
    for stiffness in (0.0, 1e7 * MODULUS, 1e-9 * MODULUS):
        pulled = 0.0 if not stiffness else 1.0 / (stiffness * areas)
        solution = TornSolver(with_springs(system, 0.0, pulled), Options(rtol=1e-9)).solve()
        force[stiffness] = -solution.normal_force.sum()
    tied, stiff, soft = force.values()
    assert tied == pytest.approx(0.01 * MODULUS, rel=1e-9)
    assert stiff == pytest.approx(tied, rel=1e-6)
    assert soft == pytest.approx(0.02e-9 * MODULUS, rel=1e-6)


@once
def test_springs_side_by_side_share_the_force_by_their_stiffness():
    """Their rows are parallel, but for gaps and compliances that differ."""
    system, areas = bar(-0.02)
    rows, k = system.contacts, np.array([1.0, 3.0])
    both = ContactRows.concatenate([rows, replace(rows, gap=rows.gap + 0.001)])
    compliance = np.concatenate([1.0 / (stiffness * areas) for stiffness in k])
    system = replace(system, contacts=both)
    solution = TornSolver(with_springs(system, compliance, np.inf), Options(rtol=1e-11)).solve()
    # p = k1 v + k2 (v - 0.001) = M (0.02 - v) / 2
    closing = (0.01 * MODULUS + k[1] * 0.001) / (k.sum() + 0.5 * MODULUS)
    expected = np.concatenate([k[0] * closing * areas, k[1] * (closing - 0.001) * areas])
    np.testing.assert_allclose(solution.normal_force, expected, rtol=1e-7)
    assert solution.report.certificate.worst <= 1e-9


@once
def test_soft_contact_between_supports():
    """Rows that prescribed displacements close have no row of B, and are no contradiction."""
    system, areas = bar(-0.02, n=1)
    held = np.unique(system.contacts.nodes)
    system = with_prescribed(system, held[held >= SECOND], [2], -0.01)
    system = with_prescribed(system, held[held < SECOND], [2], 0.0)
    solution = TornSolver(with_springs(system, 1.0 / areas, np.inf)).solve()
    assert not solution.normal_force.any()
    with pytest.raises(InputError, match="prescribed displacements violate 4 contact conditions"):
        TornSolver(system)


# -- adhesion --------------------------------------------------------------------------------------


@once
@pytest.mark.parametrize(("displacement", "opens"), [(-0.02, False), (0.02, False), (0.06, True)])
def test_adhesion_up_to_a_traction(displacement, opens):
    """Surfaces are closed up to it, and pulled by it when they come apart."""
    system, areas = bar(displacement)
    traction = 0.02 * MODULUS
    system = with_fields(system, "contacts", adhesion=traction * areas)
    solution = TornSolver(system, Options(rtol=1e-11)).solve()
    pressure = max(-0.5 * MODULUS * displacement, -traction)
    np.testing.assert_allclose(solution.normal_force / areas, pressure, rtol=1e-9)
    assert solution.active.all() == (not opens)
    opening = displacement + 2.0 * pressure / MODULUS
    energy = pressure**2 / MODULUS + traction * opening
    assert solution.report.energy == pytest.approx(energy, rel=1e-9)
    assert solution.report.contacts[0].normal_force == pytest.approx(pressure, rel=1e-9)


@once
@pytest.mark.parametrize(("seed", "method"), [(9, "active_set"), (1, "active_set"), (5, "smalbe")])
def test_random_adhesion(seed, method):
    """Beside springs, at nodes, in rows that interpolate, and in any rows."""
    system = random_system(seed)
    rows = system.contacts
    adheres = (np.arange(rows.size) % 2 == 0)[:, None]
    compliance = np.where(adheres, [0.0, np.inf], np.asarray(rows.compliance))
    adhesion = np.where(adheres[:, 0], np.linspace(0.01, 0.2, rows.size), 0.0)
    system = with_fields(system, "contacts", adhesion=adhesion, compliance=compliance)
    exact = WithSprings.solve(system)
    assert (exact.force[adhesion > 0.0] < 0.0).any()
    assert_solves(system, Options(rtol=1e-8, method=method))


# -- friction --------------------------------------------------------------------------------------


@once
@pytest.mark.parametrize(("seed", "method"), [
    *((seed, "active_set") for seed in range(16) if seed != 7),
    *((seed, "smalbe") for seed in range(16, 20)),
])  # fmt: skip
def test_random_friction_with_elastic_slip(seed, method):
    """With given bounds, beside springs; the conic solver has 1e-7 here, and no answer for 7."""
    system = with_friction(random_system(seed), seed)
    exact, solution = WithSprings.solve(system), TornSolver(system, Options(1e-8, method)).solve()
    certificate, energy = solution.report.certificate, solution.report.energy
    assert certificate.worst <= 1e-8
    assert abs(energy - exact.energy) <= 0.5 * certificate.bound**2 + 1e-10 * abs(exact.energy)
    size = max(np.abs(exact.force).max(), np.abs(exact.tangential).max())
    np.testing.assert_allclose(solution.normal_force, exact.force, atol=1e-6 * size)
    np.testing.assert_allclose(solution.tangential_force, exact.tangential, atol=1e-6 * size)
    np.testing.assert_allclose(solution.slip, exact.slip, atol=1e-6 * np.abs(exact.slip).max())


def sheared(displacement: float, bound: float, stiffness: float, n: int = 2) -> TornSystem:
    """Return two unit cubes in simple shear, with a bound and a stiffness per unit of area."""
    system, areas = bar(0.0, n)
    nodes = np.unique(np.concatenate([s.nodes for s in system.subdomains]))
    subdomains = system.subdomains
    bottom, top = (
        np.unique(np.concatenate([s.nodes[np.isclose(s.coordinates[:, 2], z)] for s in subdomains]))
        for z in (0.0, 2.0)
    )
    system = replace(system, prescribed=fixed_nodes(nodes, [1, 2]))
    system = with_prescribed(with_prescribed(system, bottom, [0]), top, [0], displacement)
    friction = horizontal(system.contacts, bound * areas)
    friction = replace(friction, compliance=1.0 / (stiffness * areas))
    return replace(system, friction=friction)


@once
@pytest.mark.parametrize("stiffness", [1e-2, 1.0, 1e4])
@pytest.mark.parametrize("displacement", [0.1, -0.1])
@pytest.mark.parametrize("part", [0.5, 2.0], ids=["slips", "sticks"])
def test_elastic_slip_in_simple_shear(stiffness, displacement, part):
    shear = YOUNG / (2.0 * (1.0 + POISSON))
    elastic = displacement / (2.0 / shear + 1.0 / stiffness)
    system = sheared(displacement, part * abs(elastic), stiffness)
    solution = TornSolver(system, Options(rtol=1e-11)).solve()
    stress = min(part, 1.0) * elastic
    areas = system.friction.bound / (part * abs(elastic))
    np.testing.assert_allclose(solution.tangential_force[:, 0] / areas, stress, rtol=1e-9)
    slip = displacement - 2.0 * stress / shear
    np.testing.assert_allclose(solution.slip[:, 0], slip, rtol=1e-9)
    assert solution.sticking.all() == (part > 1.0)
    work = solution.report.contacts[0].friction_work
    assert work == pytest.approx(abs(stress) * (abs(slip) - abs(stress) / stiffness), abs=1e-12)


@once
def test_coulombs_law_on_soft_contact():
    """It is the solution with the bounds that the forces of the springs make."""
    system = with_springs(pushed_block(load=(0.15, 0.05, -1.0)), 0.3, np.inf)
    none, coefficient = np.zeros(system.friction.size), np.full(system.friction.size, 0.2)
    compliance = np.full(system.friction.size, 0.5)
    coulomb = with_fields(
        system, "friction", bound=none, coefficient=coefficient, compliance=compliance
    )
    solution = TornSolver(coulomb, Options(rtol=1e-9)).solve()
    bound = solution.slip_bound
    np.testing.assert_allclose(bound, 0.2 * solution.normal_force, rtol=1e-6)
    assert 0 < np.count_nonzero(solution.sticking) < bound.size
    tresca = with_fields(system, "friction", bound=bound, compliance=compliance)
    exact = WithSprings.solve(tresca)
    size = np.abs(exact.force).max()
    np.testing.assert_allclose(solution.normal_force, exact.force, atol=1e-6 * size)
    np.testing.assert_allclose(solution.tangential_force, exact.tangential, atol=1e-6 * size)


# -- what is renewed, and what a solve takes -------------------------------------------------------


@once
def test_other_compliances_renew_nothing():
    """As damage grows; rows that have failed are those of contact."""
    system = column(3, 1, load=(0.1, 0.0, 1.0))
    pulled = np.full(system.contacts.size, 0.1)
    pulled[:3] = np.inf
    first = TornSolver(with_springs(system, 0.0, 0.01))
    first.solve()
    second = TornSolver(with_springs(system, 0.0, pulled), previous=first)
    assert second.reused == ["factors", "coarse problem", "norm", "multipliers"]
    assert second.setup is first.setup
    solution = second.solve()
    alone = TornSolver(with_springs(system, 0.0, pulled)).solve()
    assert solution.report.energy == pytest.approx(alone.report.energy, rel=1e-9)
    assert (solution.normal_force[:3] >= 0.0).all()


@once
def test_springs_whose_stiffness_is_rounding_are_none():
    """As of a damage of 1 - 1e-15, beside rows that are hardly damaged."""
    system = column(3, 2, load=(0.1, 0.0, 1.0))
    gone = np.arange(system.contacts.size) < 4
    forces = [
        TornSolver(with_springs(system, 0.0, np.where(gone, last, 0.1)), Options(rtol=1e-8))
        for last in (np.inf, 1e15)
    ]
    one, other = (solver.solve() for solver in forces)
    np.testing.assert_array_equal(one.normal_force, other.normal_force)
    assert other.report.products["cg"] <= 20


@once
@pytest.mark.parametrize("preconditioner", ["lumped", "dirichlet"])
def test_products_are_those_of_ties(preconditioner):
    """Unless springs are much softer than the nodes that they join."""
    system, options = column(5, 2, load=(0.1, 0.0, 1.0)), Options(preconditioner=preconditioner)
    solvers = {c: TornSolver(with_springs(system, 0.0, c), options) for c in (0.0, 1e-8, 0.1, 2.0)}
    products = {c: solver.solve().report.products["cg"] for c, solver in solvers.items()}
    unit = solvers[0.0].setup.local.unit
    assert 2.0 * unit > 0.5
    assert max(products.values()) <= 1.2 * products[0.0]


@once
@pytest.mark.parametrize("preconditioner", ["lumped", "dirichlet"])
def test_much_softer_springs_beside_ties_take_no_more(preconditioner):
    """Rigid motions are removed by forces of the ties; by all rows it is twice the products."""
    system, options = column(5, 2, load=(0.1, 0.0, 1.0)), Options(preconditioner=preconditioner)
    soft = np.arange(system.contacts.size) >= 0.3 * system.contacts.size
    unit = TornSolver(with_springs(system, 0.0, 0.0), options).setup.local.unit
    compliances = [np.where(soft, c / unit, 0.0) for c in (300.0, 1e4, 1e6)]
    solutions = [TornSolver(with_springs(system, c, c), options).solve() for c in compliances]
    products = [solution.report.products["cg"] for solution in solutions]
    assert max(products[1:]) <= products[0]
    for solution in solutions:
        assert solution.report.certificate.worst <= 1e-6


@once
@pytest.mark.parametrize("seed", range(54, 58))
def test_direct_solvers_of_faces(seed):
    """The compliances are in the factor of a face."""
    solver = TornSolver(random_system(seed), Options(rtol=1e-8))
    problem = solver.dual_problem()
    assert problem.preconditioner is not None
    direct = replace(problem, preconditioner=problem.preconditioner.for_solve(True))
    assert direct.preconditioner is not None and direct.preconditioner.is_direct
    products = []
    for each in (problem, direct):
        operators = operators_on(each, np.arange(each.constraints.inequality.size) % 2 == 0)
        count = Products()
        end = pcpg(
            each,
            operators,
            np.zeros_like(each.d),
            tolerance=1e-8 * each.energy_norm,
            sign_factor=0.0,
            max_products=500,
            products=count,
        )
        products.append((count.total, end.multipliers))
    (_, one), (few, other) = products
    assert few <= 6
    np.testing.assert_allclose(other, one, atol=1e-6 * np.abs(one).max())


@once
@pytest.mark.parametrize("seed", range(58, 62))
def test_linear_problem_on_the_face(seed):
    """As a dense saddle point with the compliances of the branches."""
    system, rng = random_system(seed), np.random.default_rng(seed)
    solver = TornSolver(system, Options(rtol=1e-10))
    force = solver.solve().normal_force
    linear, none = solver.linear_problem(), RowValues.zeros(system)
    loads = [rng.standard_normal(s.size) for s in system.subdomains]
    jumps = rng.standard_normal(force.size)
    found = linear.solve(LinearData(loads, replace(none, normal=jumps), none), 1e-10)
    whole = Glued.of(system)
    f = np.zeros(whole.f.size)
    for load, at in zip(loads, whole.places, strict=True):
        np.add.at(f, at, load)
    rows, length = np.flatnonzero(linear.active), system.contacts.length
    compliance = np.where(force > 0.0, *np.asarray(system.contacts.compliance).T)[rows]
    C, free = whole.C[rows] / length[rows, None], whole.free
    assert (compliance > 0.0).any() and np.isfinite(compliance).all()
    K = whole.K[np.ix_(free, free)]
    matrix = np.block([[K, C[:, free].T], [C[:, free], -np.diag(compliance)]])
    x = np.linalg.lstsq(matrix, np.append(f[free], jumps[rows]), rcond=None)[0]
    u = np.zeros(f.size)
    u[free] = x[: free.size]
    size = np.abs(u).max()
    for one, at in zip(found.displacements, whole.places, strict=True):
        np.testing.assert_allclose(one, u[at], atol=1e-8 * size)


@pytest.mark.ranks(2, 3)
@pytest.mark.parametrize(("seed", "method"), [(0, "active_set"), (1, "active_set"), (3, "smalbe")])
def test_same_as_on_one_rank(seed, method):
    assert_same_on_ranks(random_system(seed), Options(rtol=1e-8, method=method), 1e-6)


@pytest.mark.ranks(2, 3)
def test_adhesion_as_on_one_rank():
    system = column(3, 2, load=(0.1, 0.0, 1.0))
    system = with_fields(system, "contacts", adhesion=np.full(system.contacts.size, 0.2))
    assert_same_on_ranks(system, Options(rtol=1e-8), 1e-6)


@pytest.mark.ranks(1, 2)
def test_checkpoint_of_multipliers_that_pull(shared_folder):
    """A run that goes on starts where the other has ended."""
    whole = with_springs(column(3, 1, load=(0.1, 0.0, 1.0)), 0.0, 0.1)
    system = distributed(whole, MPI.COMM_WORLD)
    first = TornSolver(system, Options(rtol=1e-6))
    force = first.solve().normal_force
    save_checkpoint(shared_folder / "state", system, first.state)
    state = load_checkpoint(shared_folder / "state", system)
    second = TornSolver(system, Options(rtol=1e-6), start=state)
    assert second.reused == ["checkpoint"]
    solution = second.solve()
    assert solution.report.products["cg"] <= 1
    np.testing.assert_allclose(solution.normal_force, force, rtol=1e-4)


@pytest.mark.ranks(2, 3)
@pytest.mark.parametrize("seed", [1, 3])
def test_friction_as_on_one_rank(seed):
    assert_same_on_ranks(with_friction(random_system(seed), seed), Options(rtol=1e-8), 1e-6)

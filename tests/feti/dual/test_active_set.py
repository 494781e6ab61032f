from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from friction_problems import pushed_block
from scipy.optimize import nnls
from torn import column, operators_on, with_fields

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti import (
    ContactGuess,
    ContactRows,
    Options,
    Prescribed,
    Subdomain,
    TornSolver,
    TornSystem,
)
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.dual.active_set import _Progress, close_first_gaps
from fenics_tfeti.feti.dual.face_operators import FaceOperators
from fenics_tfeti.feti.dual.pcpg import pcpg
from fenics_tfeti.feti.dual.preconditioner import _scaled
from fenics_tfeti.qp import Products, balls

pytestmark = pytest.mark.once

# Curtis, Han, Robinson, Comput. Optim. Appl. 60 (2015), example 1: active sets that repeat
CYCLING = np.array([[4.0, 5.0, -5.0], [5.0, 9.0, -5.0], [-5.0, -5.0, 7.0]])
LOAD = np.array([2.0, 1.0, -3.0])


def springs(F: np.ndarray, d: np.ndarray) -> TornSystem:
    """Return a system in the plane whose dual problem is min 1/2 l'Fl - d'l, l >= o.

    Its nodes are on springs in x; in y they are coupled by F^{-1}.
    """
    k = len(F)
    K = np.kron(np.eye(k), np.diag([1.0, 0.0])) + np.kron(np.linalg.inv(F), np.diag([0.0, 1.0]))
    points = np.column_stack([np.arange(k), np.arange(k) ** 2])
    numbers = np.arange(k)
    force = np.column_stack([np.zeros(k), np.linalg.solve(F, d)]).ravel()
    block = Subdomain(sp.csr_matrix(K), force, points.astype(float), numbers, 0)
    up, none = np.tile([0.0, 1.0], (k, 1)), np.full(k, -1)
    rows = ContactRows.node_to_node(numbers, none, up, np.zeros(k), 0 * numbers)
    return TornSystem([block], Prescribed(), rows, 2)


def random_programme(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((8, 8))
    return A @ A.T + 0.1 * np.eye(8), rng.standard_normal(8)


@pytest.mark.parametrize(("F", "d"), [
    (CYCLING, LOAD),
    *map(random_programme, range(4)),
], ids=["cycle that Newton's method ends", *map(str, range(4))])  # fmt: skip
def test_quadratic_programme(F, d):
    options = Options(rtol=1e-10, dual_operator="explicit")
    solution = TornSolver(springs(F, d), options).solve()
    factor = np.linalg.cholesky(F).T
    exact = nnls(factor, np.linalg.solve(factor.T, d))[0]
    assert solution.report.converged
    assert solution.report.outer_iterations == 0
    np.testing.assert_allclose(solution.normal_force, exact, atol=1e-8)


def test_faces_are_solved_more_accurately_where_the_violation_of_signs_does_not_decrease():
    """A plank that is lifted peels off node by node: there accuracy would be wasted."""
    progress, active = _Progress(), np.ones(3, dtype=bool)
    for violation in (1.0, 0.95, 0.9):
        progress.update(violation, active)
    assert progress.sign_factor == 1.0
    progress.update(0.9, active)
    assert progress.sign_factor == 0.5
    assert len(progress.sets) == 4


def test_limit_of_products_holds_here_too():
    options = Options(max_products=5, error_if_not_converged=False)
    report = TornSolver(column(), options).solve().report
    assert not report.converged
    assert report.products["total"] <= 5 + 1


# -- a guess of the contact ------------------------------------------------------------------------


def bowl() -> TornSystem:
    """Return the column of cubes; gaps open towards the rim, so that part of them closes."""
    system = column(n=6)
    upper = system.subdomains[-1]
    x = upper.coordinates[np.searchsorted(upper.nodes, system.contacts.slave)]
    return with_fields(system, "contacts", gap=20.0 * np.sum((x[:, :2] - 0.3) ** 2, axis=1))


def exact_guess(system: TornSystem, options: Options) -> ContactGuess:
    force = TornSolver(system, options).solve().normal_force
    assert 0 < np.count_nonzero(force) < force.size
    return ContactGuess(force, np.where(force > 0.0, 0.0, 1.0))


WHATEVER_THE_SIGNS = {"sign_factor": 0.0, "max_products": 10_000}


def linear_products(solver: TornSolver, active: np.ndarray, tolerance: float) -> Products:
    """Count what the linear problem with these rows costs, from nothing."""
    problem = replace(solver.dual_problem(), norm=solver.setup.norm(3))
    face = operators_on(problem, active)
    products = Products()
    start = np.zeros_like(problem.d)
    pcpg(problem, face, start, tolerance=tolerance, **WHATEVER_THE_SIGNS, products=products)
    return products


@pytest.mark.parametrize(("preconditioner", "scaling"), [
    ("none", "stiffness"), ("lumped", "multiplicity"), ("dirichlet", "stiffness"),
])  # fmt: skip
def test_exact_guess_costs_a_linear_solve(preconditioner, scaling):
    options = Options(rtol=1e-5, preconditioner=preconditioner, scaling=scaling)
    system = bowl()
    solver = TornSolver(system, options, guess=exact_guess(system, options))
    solution = solver.solve()
    active = solution.multipliers[solver.setup.constraints.inequality] > 0.0
    linear = linear_products(solver, active, solution.report.dual_tolerance)
    assert solution.report.reused == ["contact guess"]
    assert {face.changed for face in solution.report.faces} == {0}
    # the certificate may want a bit more than the residual
    assert solution.report.products["total"] <= linear.total + 2


@pytest.mark.parametrize("expected", ["all", "none", "random"])
def test_wrong_guess_is_only_a_start(expected):
    system, options = bowl(), Options(rtol=1e-8)
    right = TornSolver(system, options).solve().normal_force
    random = np.random.default_rng(0).random(right.size) < 0.5
    force = {"all": np.ones(right.size), "none": 0.0 * right, "random": 1.0 * random}[expected]
    guess = ContactGuess(force, np.where(force > 0.0, 0.0, 1.0))
    found = TornSolver(system, options, guess=guess).solve().normal_force
    np.testing.assert_allclose(found, right, atol=1e-6 * right.max())


@pytest.mark.parametrize("scaling", ["stiffness", "multiplicity"])
@pytest.mark.parametrize("share, active", [(0.9, 0), (1.1, 1)])
def test_row_with_force_and_gap_presses_if_the_force_would_close_it(share, active, scaling):
    """Springs of 1 N/m along x and 2 N/m along y count as 1.5 N/m; of that 0.3 on a surface."""
    system = springs(0.5 * np.eye(2), np.ones(2))
    guess = ContactGuess(np.array([share * 0.3 * 1.5 * 0.2, 0.0]), np.array([0.2, 1.0]))
    report = TornSolver(system, Options(scaling=scaling), guess=guess).solve().report
    assert report.faces[0].active == active


def test_guess_is_for_the_active_set_method():
    guess = ContactGuess(np.zeros(49), np.zeros(49))
    with pytest.raises(InputError, match="active_set.*smalbe"):
        TornSolver(bowl(), Options(method="smalbe"), guess=guess)


def test_smaller_tolerance_goes_on_where_the_larger_one_ended():
    """More of the same face costs no product for a new start."""
    system, options = bowl(), Options(rtol=1e-8)
    solver = TornSolver(system, options)
    active = solver.solve().multipliers[solver.setup.constraints.inequality] > 0.0
    problem, start = solver.dual_problem(), np.zeros(solver.setup.constraints.size)
    face, once, twice = operators_on(problem, active), Products(), Products()
    scale = np.linalg.norm(solver.setup.projector.P(problem.d))
    coarse, fine = (
        {"tolerance": tolerance * scale, **WHATEVER_THE_SIGNS} for tolerance in (1e-4, 1e-9)
    )
    first = pcpg(problem, face, start, **coarse, products=twice)
    second = pcpg(problem, face, first, **fine, products=twice, resume=True)
    direct = pcpg(problem, face, start, **fine, products=once)
    assert twice.total == once.total
    assert second.residual == pytest.approx(direct.residual, rel=1e-3)


def test_light_body_beside_a_heavy_one_closes_its_gaps():
    """Its load is too small for a scale that all bodies share."""
    heavy = column(n=2)
    light = [
        replace(s, nodes=s.nodes + 10**10, body=s.body + 2, load=1e-12 * s.load)
        for s in heavy.subdomains
    ]
    held, rows = heavy.prescribed, heavy.contacts
    moved = replace(rows, nodes=rows.nodes + 10**10, contact=rows.contact + 1)
    both = replace(
        heavy,
        subdomains=[*heavy.subdomains, *light],
        prescribed=Prescribed(
            np.concatenate([held.nodes, held.nodes + 10**10]),
            np.tile(held.components, 2),
            np.tile(held.values, 2),
        ),
        contacts=ContactRows.concatenate([rows, moved]),
        body_names=(),
        contact_names=("heavy", "light"),
    )
    forces = [c.normal_force for c in TornSolver(both).solve().report.contacts]
    assert forces == pytest.approx([1.0, 1e-12], rel=1e-6)


# -- friction --------------------------------------------------------------------------------------


def test_curvature_of_forces_that_turn():
    """Second derivative of -v't on the circle of t, v along t; forces that stick do not turn."""
    problem, rng = TornSolver(pushed_block(), Options()).dual_problem(), np.random.default_rng(0)
    friction, radius = problem.constraints.friction, problem.radius
    slipping = np.arange(friction.size) % 2 == 1
    direction = balls.directions(rng.standard_normal((friction.size, 2)))
    forces = (np.where(slipping, 2.0, 0.5) * radius)[:, None] * direction
    slips = rng.uniform(1.0, 2.0, friction.size)[:, None] * direction
    slips[1] *= -1.0  # against the force
    found = problem.face_of(friction.with_sites(np.zeros_like(problem.d), forces), slips=slips)
    np.testing.assert_array_equal(found.sticking, ~slipping)
    expected = np.where(slipping, np.linalg.norm(slips, axis=1) / radius, 0.0)
    expected[1] = 0.0
    np.testing.assert_allclose(found.curvature, expected, rtol=1e-12)


def test_preconditioner_of_forces_that_turn_is_the_inverse_for_rows_alone():
    """(I / unit + curvature t t')^{-1} of the tangents t, where F is I / unit."""
    problem, rng = TornSolver(pushed_block(), Options()).dual_problem(), np.random.default_rng(0)
    friction, x = problem.constraints.friction, rng.standard_normal(problem.d.size)
    tangent = balls.directions(rng.standard_normal((friction.size, 2)))
    curvature = 10.0 ** rng.uniform(-2, 2, friction.size) / problem.unit
    active = np.ones(problem.constraints.inequality.size, dtype=bool)
    face = replace(Face.of(problem.constraints, active, curvature=curvature), tangents=tangent)
    found = _scaled(lambda y: problem.unit * y, face, problem.unit)(x)
    along = curvature * np.sum(friction.at_sites(found) * tangent, axis=1)
    left = found / problem.unit + friction.spread(along[:, None] * tangent, x.size)
    np.testing.assert_allclose(left, x, atol=1e-13)


@pytest.mark.parametrize("preconditioner", ["none", "lumped", "dirichlet"])
def test_face_with_forces_that_turn_is_a_linear_problem(preconditioner):
    """Minimise 1/2 l'(F + S_D)l - d'l, G l = e, l the given forces but for S l."""
    solver = TornSolver(pushed_block(), Options(preconditioner=preconditioner))
    problem, rng = solver.dual_problem(), np.random.default_rng(0)
    constraints, n = problem.constraints, problem.d.size
    friction = constraints.friction
    active = np.ones(constraints.inequality.size, dtype=bool)
    sticking = np.arange(friction.size) % 2 == 0
    forces = rng.standard_normal(n)
    at_sites = balls.on_boundary(friction.at_sites(forces), problem.radius, ~sticking)
    forces = friction.with_sites(forces, at_sites)
    curvature = np.where(sticking, 0.0, 10.0 ** rng.uniform(-2, 2, friction.size))
    face = Face.of(constraints, active, sticking, forces, curvature).with_turning_forces()
    operators = FaceOperators.build(problem, Projector.build(problem.coarse_space, face))
    found = pcpg(
        problem, operators, np.zeros(n), tolerance=1e-12, **WHATEVER_THE_SIGNS, products=Products()
    )
    unit = np.eye(n)
    F = np.column_stack([problem.F(x) for x in unit])
    S = np.column_stack([face.part(x) for x in unit])
    curvature_gradient = np.column_stack([face.curved(x) for x in unit])
    np.testing.assert_allclose(curvature_gradient, curvature_gradient.T, atol=1e-15)
    G = np.column_stack([problem.coarse_space.restrict(x) for x in unit])
    basis = np.linalg.svd(S)[0][:, : round(np.trace(S))]
    fixed = face.fixed
    k = len(G)
    matrix = np.block(
        [[basis.T @ (F + curvature_gradient) @ basis, basis.T @ G.T], [G @ basis, np.zeros((k, k))]]
    )
    right = np.append(basis.T @ (problem.d - F @ fixed), problem.e - G @ fixed)
    exact = fixed + basis @ np.linalg.lstsq(matrix, right, rcond=1e-12)[0][: basis.shape[1]]
    np.testing.assert_allclose(found.multipliers, exact, atol=1e-7 * np.abs(exact).max())


def test_slip_is_taken_back_where_the_load_needs_it():
    """All sites slip against the load; the first one that a motion along the load stops sticks."""
    solver = TornSolver(pushed_block(load=(0.1, 0.0, -1.0), bound=1e-4 + 0.1 / 16))
    problem = solver.dual_problem()
    constraints, friction = problem.constraints, problem.constraints.friction
    forces, gradient = np.zeros(problem.d.size), np.zeros(problem.d.size)
    # forces push along the load, and so are the slips: a motion takes them farther back
    forces[friction.rows[:, 0]] = -problem.radius
    gradient[friction.rows[:, 0]] = 1e-3 * (1.0 + np.arange(16))
    slipping = Face.of(constraints, np.ones(constraints.inequality.size, dtype=bool), forces=forces)
    operators = close_first_gaps(problem, slipping, gradient)
    face = operators.face
    first = np.argmin(gradient[friction.rows[:, 0]])
    assert face.sticking[first]
    assert 1 <= np.count_nonzero(face.sticking) < 16
    assert not face.fixed[friction.rows[first]].any()
    assert not operators.projector.unresisted(
        problem.e - problem.coarse_space.restrict(face.fixed), problem.e_size
    ).any()

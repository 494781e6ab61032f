"""The direct solver of faces against dense algebra."""

from dataclasses import replace

import numpy as np
import pytest
from dense import DenseSystem
from torn import column

from fenics_tfeti.feti import Options, TornSolver, load_checkpoint, save_checkpoint
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.face import Face, Proximal
from fenics_tfeti.feti.dual import direct_faces
from fenics_tfeti.feti.dual.active_set import close_first_gaps
from fenics_tfeti.feti.dual.pcpg import pcpg
from fenics_tfeti.qp import Products


@pytest.mark.parametrize("compliance", [0.0, 2.0])
@pytest.mark.parametrize("active", ["all", "some"])
def test_inverse_on_a_face(active, compliance):
    """(PFP + C)^{-1} on the rows of a face, but for the compliance that all of them have."""
    solver = TornSolver(column(height=1), Options())
    setup = solver.setup
    dense, constraints = DenseSystem.of(solver), setup.constraints
    closed = np.ones(constraints.inequality.size, dtype=bool)
    closed[::3] = active == "all"
    per_row = compliance / setup.local.unit
    term = Proximal(np.zeros(constraints.size), 1.0 / per_row) if compliance else None
    face = replace(Face.of(constraints, closed), proximal=term)
    projector = Projector.build(setup.projector.coarse_space, face)
    solve = setup.preconditioner.direct.on(face)
    random = np.random.default_rng(1).standard_normal(constraints.size)
    x = projector.P(face.part(random))
    C = np.where(constraints.equality, 0.0, per_row) + direct_faces._COMPLIANCE / setup.local.unit
    part = projector.P(face.part(dense.F @ x + C * x))
    assert projector.P(solve(part)) == pytest.approx(x, abs=1e-9 * np.abs(x).max())


def test_direct_from_the_time_of_a_factor_on(monkeypatch):
    """Of all two blocks, which are in contact; many unknowns are left to conjugate gradients."""
    setup = TornSolver(column(height=1), Options()).setup
    preconditioner = setup.for_solve().preconditioner
    steps = preconditioner.direct.patience
    assert 40 < steps < np.inf
    for products, direct in ((int(steps), False), (int(steps) + 1, True)):
        assert preconditioner.becomes_direct(products) == direct
        assert preconditioner.is_direct == direct
    assert not setup.is_direct, "solves leave the set-up as it is"
    monkeypatch.setattr(direct_faces, "_MOST", 10)
    preconditioner = TornSolver(column(height=1), Options()).setup.preconditioner
    assert not preconditioner.becomes_direct(10**9)
    assert not preconditioner.is_direct


def slow_solver(**arguments) -> TornSolver:
    """Return a solver for which each step of conjugate gradients is a slow one."""
    solver = TornSolver(column(height=1), Options(rtol=1e-10), **arguments)
    solver.setup.preconditioner.direct.patience = 1
    return solver


def test_the_next_solver_and_a_checkpoint_go_on_with_direct_solvers(tmp_path):
    first = slow_solver()
    assert not first.setup.is_direct
    first.solve()
    assert first.state.direct_faces
    path = tmp_path / "state.npz"
    save_checkpoint(path, first.system, first.state)
    start = load_checkpoint(path, first.system)
    assert start.direct_faces
    previous, restarted = slow_solver(previous=first), slow_solver(start=start)
    products = [solver.solve().report.products["cg"] for solver in (first, previous, restarted)]
    assert products[0] == products[1] == products[2]
    assert previous.setup.preconditioner is not restarted.setup.preconditioner


@pytest.mark.parametrize("is_direct", [False, True])
def test_conjugate_gradients_are_not_continued_with_another_preconditioner(is_direct):
    """They have the residual and the direction of the other one, and begin anew."""
    solver = TornSolver(column(height=1), Options())
    problem = solver.dual_problem()
    face = problem.face_of(problem.feasible)
    options = {"tolerance": 0.0, "sign_factor": 0.0}

    def steps(start, number, **more):
        operators, limit = close_first_gaps(problem, face, problem.c), {"max_products": number}
        return pcpg(problem, operators, start, products=Products(), **limit, **more, **options)

    problem.preconditioner.is_direct = not is_direct
    half = steps(problem.feasible, 3)
    problem.preconditioner.is_direct = is_direct
    found = steps(half, 2, resume=True)
    fresh = steps(
        replace(half, direction=0.0 * half.direction, preconditioned=None), 2, resume=True
    )
    np.testing.assert_allclose(found.multipliers, fresh.multipliers, rtol=1e-12)
    assert found.is_direct == is_direct

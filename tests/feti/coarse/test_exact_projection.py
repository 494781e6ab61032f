"""The nearest multipliers with Gl = e and the bounds, against a dense conic programme."""

import clarabel
import numpy as np
import pytest
import scipy.sparse as sp
from friction_problems import (
    blocks_that_do_not_match,
    in_a_corner,
    pulled_strip,
    pushed_block,
)

from fenics_tfeti.feti import TornSolver
from fenics_tfeti.feti.coarse.exact_projection import (
    ExactProjection,
    GramMetric,
    _nearly_dependent,
)

pytestmark = pytest.mark.once

SYSTEMS = {
    "strip": pulled_strip,
    "discs": pushed_block,
    "glued and coupled": lambda: blocks_that_do_not_match(0.01, free=True),
    "several subdomains": lambda: in_a_corner(3),
}


@pytest.fixture(scope="module", params=SYSTEMS)
def solver(request):
    return TornSolver(SYSTEMS[request.param]())


def random_metric(constraints, rng):
    """Return H with groups of whole sites and of contact rows."""
    friction = constraints.friction
    of_sites = friction.on_rows(rng.random(friction.size) < 0.3, constraints.size)
    chosen = np.flatnonzero(of_sites)
    chosen = np.union1d(chosen, rng.choice(constraints.inequality, 3, replace=False))
    scale = np.ones(constraints.size)
    scale[chosen] = 0.1
    C = np.zeros((constraints.size, 4))
    C[chosen] = rng.standard_normal((chosen.size, 4)) / 2.0
    return GramMetric(scale, sp.csr_matrix(C), constraints)


def by_cones(projection, b, radius, H=None):
    """Return the minimiser by an interior point method, by default in the metric of its rows."""
    space, metric = projection.coarse_space, projection.metric
    constraints, m = space.constraints, b.size
    friction, eye = constraints.friction, np.identity(m)
    G, C = space.own.T.toarray(), metric.springs.toarray()
    # resisted motions only: rows of G may depend on each other
    U, s, V = np.linalg.svd(G, full_matrices=False)
    kept = s > 1e-9 * s[0]
    G, e = V[kept], (U.T @ projection.e)[kept] / s[kept]
    blocks, right = [G, -eye[constraints.inequality]], [e, np.zeros(constraints.inequality.size)]
    cones = [clarabel.ZeroConeT(len(e)), clarabel.NonnegativeConeT(constraints.inequality.size)]
    for rows, r in zip(friction.rows, radius, strict=True):
        rows = rows[rows >= 0]
        blocks.append(np.vstack([np.zeros(m), -eye[rows]]))
        right.append(np.append(r, np.zeros(rows.size)))
        cones.append(clarabel.SecondOrderConeT(1 + rows.size))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    H = np.diag(metric.scale**2) + C @ C.T if H is None else H
    size = np.linalg.norm(b)
    problem = clarabel.DefaultSolver(
        sp.csc_matrix(np.triu(H)),
        -b / size,
        sp.csc_matrix(np.vstack(blocks)),
        np.concatenate(right) / size,
        cones,
        settings,
    )
    return size * np.array(problem.solve().x)


@pytest.mark.parametrize("grouped", [False, True])
def test_minimiser_on_random_sets(solver, grouped):
    rng = np.random.default_rng(7)
    constraints, data = solver.setup.constraints, solver.data
    metric = GramMetric.build(constraints)
    force = np.abs(data.feasible).max()
    for _ in range(12):
        if grouped:
            metric = random_metric(constraints, rng)
        projection = ExactProjection(solver.setup.projector.coarse_space, data.e, metric)
        held = np.linalg.norm(constraints.friction.at_sites(data.feasible), axis=1)
        radius = held * (1.0 + rng.random(held.size)) + force * rng.random() ** 4
        b = force * 10.0 ** rng.uniform(-1, 1) * rng.standard_normal(constraints.size)
        l = projection(b, radius)
        assert projection.balanced
        missing = data.e - projection.coarse_space.restrict(l)
        assert np.abs(missing).max() <= 1e-10 * np.abs(data.e).max()
        assert (l[constraints.inequality] >= 0.0).all()
        exact = by_cones(projection, b, radius)
        np.testing.assert_allclose(l, exact, atol=3e-6 * np.abs(exact).max())
        # again from its own motions
        np.testing.assert_allclose(projection(b, radius), l, atol=1e-8 * np.abs(l).max())


@pytest.mark.parametrize("name", ["glued and coupled", "several subdomains"])
def test_preconditioner_of_rows_without_bounds(name):
    """With M, the inverse of H there."""
    rng, solver = np.random.default_rng(7), TornSolver(SYSTEMS[name]())
    constraints, data = solver.setup.constraints, solver.data
    rows, whole = np.flatnonzero(constraints.equality), np.identity(constraints.size)
    part = rng.standard_normal((rows.size, rows.size)) / rows.size
    whole[np.ix_(rows, rows)] = np.identity(rows.size) / 2.0 + part @ part.T
    metric = GramMetric.build(constraints)
    projection = ExactProjection(
        solver.setup.projector.coarse_space, data.e, metric, lambda x: whole @ x
    )
    H = np.diag(metric.scale**2) + (metric.springs @ metric.springs.T).toarray()
    H[np.ix_(rows, rows)] = np.linalg.inv(whole[np.ix_(rows, rows)])
    radius = 1.5 * np.linalg.norm(constraints.friction.at_sites(data.feasible), axis=1)
    b = np.abs(data.feasible).max() * rng.standard_normal(constraints.size)
    l = projection(whole @ b, radius)
    exact = by_cones(projection, b, radius, H)
    np.testing.assert_allclose(l, exact, atol=3e-6 * np.abs(exact).max())


def test_bounds_that_cannot_hold_the_load():
    solver = TornSolver(pushed_block())
    metric = GramMetric.build(solver.setup.constraints)
    projection = ExactProjection(solver.setup.projector.coarse_space, solver.data.e, metric)
    radius = np.linalg.norm(
        solver.setup.constraints.friction.at_sites(solver.data.feasible), axis=1
    )
    projection(solver.data.feasible, radius)
    assert projection.balanced
    projection(solver.data.feasible, 0.1 * radius)
    assert not projection.balanced
    projection.motion = np.zeros_like(projection.motion)
    projection(solver.data.feasible, radius)
    assert projection.balanced


@pytest.mark.parametrize(("between", "groups"), [
    (0.0, []),
    (0.5, []),
    (0.99, [[1, 2]]),
    (1.0, []),
])  # fmt: skip
def test_rows_that_nearly_depend_on_each_other(between, groups):
    """Two rows at an angle; those that are one row do not count."""
    W = np.identity(4)
    W[1, 2] = W[2, 1] = between
    found = _nearly_dependent(sp.csr_matrix(W), np.arange(4))
    assert [rows.tolist() for rows in found] == groups

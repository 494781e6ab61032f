"""Contact rows that hold with equality, and linear problems on a face, as dense saddle points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from torn import Glued, column, node_rows, with_fields, with_prescribed

from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.solution.linear import LinearData
from fenics_tfeti.feti.system import RowValues

RTOL = 1e-10


def system(held, load=(0.2, -0.1, 1.0)):
    """Return a column of two blocks, pulled apart, with gaps; some contact rows hold."""
    given = column(n=2, height=2, load=load)
    lower = given.subdomains[1]
    side = lower.nodes[(lower.coordinates[:, 0] == 0.0) & (lower.coordinates[:, 2] == 1.5)][:2]
    tied = node_rows(side, [0.0, 1.0, 0.0], gap=1e-3, contact=1)
    given = replace(given, tied=tied, contact_names=["joint", "tie"])
    upper = given.subdomains[-1]
    top = upper.nodes[np.isclose(upper.coordinates[:, 2], 3.0)]
    given = with_prescribed(given, top[:1], [2], 0.01)
    return with_fields(given, "contacts", held=held, gap=1e-3 * np.arange(given.contacts.size))


def saddle_point(given, rows, f, gap, tied_gap, u):
    """Return displacement, forces of the rows and of tied rows of the dense problem."""
    whole = Glued.of(given)
    C = np.vstack([whole.C[rows], whole.T])
    free, k = whole.free, len(C)
    matrix = np.block([[whole.K[np.ix_(free, free)], C[:, free].T], [C[:, free], np.zeros((k, k))]])
    right = np.append((f - whole.K @ u)[free], np.append(gap[rows], tied_gap) - C @ u)
    x = np.linalg.solve(matrix, right)
    u = u.copy()
    u[free] = x[: free.size]
    forces = np.zeros(gap.size)
    forces[rows] = x[free.size :][: np.count_nonzero(rows)]
    return [u[at] for at in whole.places], forces, x[free.size + np.count_nonzero(rows) :]


def assert_close(found, expected):
    displacements, normal, tied = found
    for one, other in zip(displacements, expected[0], strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(normal, expected[1], rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(tied, expected[2], rtol=0.0, atol=1e-7)


HELD = {"all": np.ones(9, dtype=bool), "some": np.arange(9) % 2 == 0}


@pytest.mark.parametrize("kind", HELD)
@pytest.mark.parametrize("preconditioner", ["none", "dirichlet"])
def test_held_rows_are_equalities(kind, preconditioner):
    """They pull; the others are open."""
    held = HELD[kind]
    given = system(held)
    whole = Glued.of(given)
    solution = TornSolver(given, Options(rtol=RTOL, preconditioner=preconditioner)).solve()
    expected = saddle_point(given, held, whole.f, given.contacts.gap, given.tied.gap, whole.u)
    found = solution.displacements, solution.normal_force, solution.tied_force
    assert_close(found, expected)
    assert solution.normal_force.min() < -0.01
    np.testing.assert_array_equal(solution.active, held)
    assert solution.report.contacts[0].normal_force == pytest.approx(expected[1].sum(), rel=1e-7)


@pytest.mark.parametrize("kind", HELD)
def test_linear_problem_on_the_face(kind):
    """Other loads, gaps of held rows and of tied ones; prescribed displacements are zero."""
    held, rng = HELD[kind], np.random.default_rng(0)
    given = system(held)
    solver = TornSolver(given, Options(rtol=RTOL))
    solver.solve()
    linear = solver.linear_problem()
    np.testing.assert_array_equal(linear.active, held)
    loads = [rng.standard_normal(s.size) for s in given.subdomains]
    none = RowValues.zeros(given)
    jumps = replace(none, normal=rng.standard_normal(9), tied=rng.standard_normal(given.tied.size))
    solution = linear.solve(LinearData(loads, jumps, none), RTOL)
    whole, f = Glued.of(given), 0.0
    for load, at in zip(loads, whole.places, strict=True):
        f = f + np.bincount(at, load, whole.f.size)
    expected = saddle_point(given, held, f, jumps.normal, jumps.tied, 0.0 * whole.u)
    size = max(np.abs(u).max() for u in expected[0])
    forces = solution.forces
    scaled = (
        ([u / size for u in solution.displacements], forces.normal / size, forces.tied / size),
        ([u / size for u in expected[0]], expected[1] / size, expected[2] / size),
    )
    assert_close(*scaled)
    np.testing.assert_allclose(solution.jumps.normal[held], jumps.normal[held], atol=1e-10)


def test_rows_that_are_held_are_told_from_others():
    """With other held rows the operators are made anew."""
    first = TornSolver(system(HELD["all"]))
    other = TornSolver(with_fields(first.system, "contacts", held=HELD["some"]), previous=first)
    same = TornSolver(with_fields(first.system, "contacts", gap=np.ones(9)), previous=first)
    assert other.reused == ["factors"]
    assert "coarse problem" in same.reused

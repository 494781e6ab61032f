"""Elastic supports that are soft or stiff beside the subdomains, against direct solutions.

The tolerance of the displacement, in the Euclidean norm, is the sum of two bounds. With K the
stiffness of the glued bodies and lambda its smallest eigenvalue, s for springs of stiffness s:

- `rtol` bounds the error e in the energy norm, so ||e||^2 <= rtol^2 u'Ku / lambda. Closed contact
  rows only add to lambda.
- Where springs are added to K, and where the copies of a node are, entries are rounded: |dK| <= 2
  eps |K|. As ||du|| <= ||K^{-1} dK u||, that is 2 eps || |K| || ||u|| / lambda. For springs of
  1e-13 it is a tenth of u: the rest of their stiffness is not in K.
"""

import numpy as np
import pytest
import scipy.linalg
from sparse_rows import assert_same_on_ranks
from springs import glued_column, pressed_column, standing_cube
from torn import Glued

from fenics_tfeti.feti import Options, TornSolver

EPS = float(np.finfo(float).eps)

both_methods = pytest.mark.parametrize("method", ["active_set", "smalbe"])
all_springs = pytest.mark.parametrize("stiffness", [1e-13, 1e-9, 1e-3, 1e3])


def solve_refined(A, b):
    """Solve by LU, with iterative refinement in extended precision."""
    factors = scipy.linalg.lu_factor(A)
    x = scipy.linalg.lu_solve(factors, b)
    for _ in range(8):
        residual = b - A.astype(np.longdouble) @ x
        x = x + scipy.linalg.lu_solve(factors, residual.astype(float))
    return x


def assert_solves(system, solution, rtol):
    """Compare with the direct solution on the active set, whose signs show that it is the one."""
    whole = Glued.of(system)
    K, f, C, places = whole.K, whole.f, whole.C, np.concatenate(whole.places)
    closed, gap = solution.active, system.contacts.gap
    active = C[closed]
    zero = np.zeros((len(active), len(active)))
    x = solve_refined(np.block([[K, active.T], [active, zero]]), np.concatenate([f, gap[closed]]))
    u, force = x[: f.size], x[f.size :]
    assert (force >= 0.0).all()
    assert (C[~closed] @ u <= gap[~closed] + 16 * EPS * np.abs(u).max()).all()
    smallest = scipy.linalg.eigvalsh(K)[0]
    iterations = rtol * np.sqrt(u @ K @ u / smallest)
    rounding = 2 * EPS * np.linalg.norm(np.abs(K), 2) * np.linalg.norm(u) / smallest
    error = np.concatenate(solution.displacements) - u[places]
    # copies of a node count twice here
    assert np.linalg.norm(error) <= np.sqrt(2.0) * (iterations + rounding)
    assert solution.report.certificate.worst <= rtol


def products(system, method, rtol=1e-6):
    return TornSolver(system, Options(rtol=rtol, method=method)).solve().report.products["total"]


@both_methods
@all_springs
@pytest.mark.parametrize("height", [1, 2])
def test_glued_cubes(height, stiffness, method):
    """One cube alone has no multipliers but those of its ground."""
    system = glued_column(stiffness, height)
    solution = TornSolver(system, Options(rtol=1e-8, method=method)).solve()
    assert_solves(system, solution, 1e-8)


@both_methods
@all_springs
@pytest.mark.parametrize("load", [(0.2, 0.0, -1.0), (0.0, 0.0, 1.0)], ids=["pressed", "pulled"])
def test_contact(load, stiffness, method):
    """Two bodies that only springs hold press on each other, or each hangs on its own springs."""
    system = pressed_column(stiffness, load=load)
    solution = TornSolver(system, Options(rtol=1e-6, method=method)).solve()
    assert solution.active.any() == (load[2] < 0.0)
    assert_solves(system, solution, 1e-6)
    # statics, whatever the springs are
    np.testing.assert_allclose(solution.report.springs.force, -np.array(load), atol=1e-8)


@all_springs
@pytest.mark.parametrize(
    ("method", "preconditioner"), [("active_set", "dirichlet"), ("smalbe", "lumped")]
)
def test_springs_along_one_component(stiffness, method, preconditioner):
    """The floor and the springs carry the load; the cube may slide and spin about the vertical.

    Nothing of these motions is seen on the interface, the foot's displacements along z.
    """
    system = standing_cube(stiffness)
    options = Options(rtol=1e-6, method=method, preconditioner=preconditioner)
    solution = TornSolver(system, options).solve()
    block = system.subdomains[0]
    u = solution.displacements[0].reshape(-1, 3)
    foot = block.coordinates[:, 2] == 0.0
    assert len(solution.report.free_motions) == 3
    assert solution.report.certificate.worst <= 1e-6
    force = solution.report.contacts[0].normal_force
    # the whole foot stands on the floor, and the springs are strained by about the gap and more
    np.testing.assert_allclose(u[foot, 2], -0.01, atol=1e-6 * np.abs(u).max())
    top = np.isclose(block.coordinates[:, 2], 1.0)
    largest = abs(standing_cube(0.0).subdomains[0].stiffness).max()
    carried = -stiffness * largest * u[top, 2].sum()
    assert force + carried == pytest.approx(1.0, rel=1e-6)


@both_methods
@pytest.mark.parametrize("problem", [lambda s: glued_column(s, 2), pressed_column, standing_cube])
def test_products_do_not_grow(problem, method):
    """Compared with springs that are as good as rigid.

    SMALBE-M updates mu for motions that are resisted neither well nor softly, which takes it outer
    iterations.
    """
    factor = 1.5 if method == "active_set" else 2.0
    enough = max(products(problem(1e3), method), 6)
    for stiffness in (1e-13, 1e-9, 1e-4, 1e-2):
        assert products(problem(stiffness), method) <= factor * enough, stiffness


@pytest.mark.ranks(2)
@pytest.mark.parametrize(("problem", "stiffness", "method"), [
    (lambda s: glued_column(s, 3), 1e-13, "active_set"),
    (pressed_column, 1e-10, "smalbe"),
    # not symmetric: rounding would decide which of two alike nodes joins first
    (lambda s: pressed_column(s, load=(0.2, 0.1, -1.0)), 1e-3, "active_set"),
])  # fmt: skip
def test_same_as_on_one_rank(problem, stiffness, method):
    """K is the same to the last bit, so that only the tolerance and other sums remain."""
    alone, found = assert_same_on_ranks(problem(stiffness), Options(rtol=1e-8, method=method), 1e-6)
    assert found.report.certificate.worst <= 1e-8
    # softer springs amplify rounding to more than the tolerance, and steps are spent on it
    few = 2 if stiffness >= 1e-6 else 20
    assert abs(found.report.products["total"] - alone.report.products["total"]) <= few

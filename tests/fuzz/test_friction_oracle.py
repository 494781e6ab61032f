"""The conditions of problems with friction, on solutions that are right and wrong."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from cases import _solve_torn
from friction_oracle import compare_with_friction, verdict_with_friction
from torn_problems import draw_torn

from fenics_tfeti.errors import NotConverged
from fenics_tfeti.feti.dual.iterate import SolveStatus

pytestmark = pytest.mark.once

RTOL = 1e-6


@pytest.fixture(scope="module")
def solved():
    """A problem in which some sites stick and some slip, and the package's solution."""
    for seed in range(10_000):
        problem = draw_torn(seed)
        friction = problem.glued.friction
        if friction is None or friction.coefficient.any() or not friction.bound.all():
            continue
        if verdict_with_friction(problem.glued).verdict != "solution":
            continue
        problem = replace(problem, options={"rtol": 1e-9})
        found = _solve_torn(problem, MPI.COMM_SELF, seed)
        slips = np.linalg.norm(friction.slips(found.displacement), axis=1)
        if 0 < np.count_nonzero(slips > 1e-6 * slips.max()) < slips.size:
            return problem.glued, found
    raise AssertionError("there is no such problem")


def test_solution_is_right(solved):
    assert compare_with_friction(*solved, RTOL).kind == "right"


@pytest.mark.parametrize("change", [
    lambda found: {"displacement": found.displacement * (1 + 1e3 * RTOL)},
    lambda found: {"tangential": -found.tangential},
    lambda found: {"tangential": found.tangential * (1 + 1e3 * RTOL)},
    lambda found: {"tangential": 0.0 * found.tangential},
    lambda found: {"force": found.force * (1 + 1e3 * RTOL)},
    lambda found: {"energy": 2.0 * found.energy},
    lambda found: {"jump": found.jump + np.abs(found.displacement).max()},
], ids=["scaled", "against", "above", "without", "forces", "energy", "jumps"])  # fmt: skip
def test_wrong_solution_is_wrong(solved, change):
    problem, found = solved
    assert compare_with_friction(problem, replace(found, **change(found)), RTOL).kind == "wrong"


@pytest.mark.parametrize(("factor", "kind"), [
    (1.0, "limit of rounding"), (1 + 1e3 * RTOL, "no convergence")
])  # fmt: skip
def test_iterate_at_the_limit_of_rounding_is_measured(solved, factor, kind):
    """The certificate is that of rounding, which nobody knows."""
    problem, found = solved
    error = NotConverged(SolveStatus.AT_LIMIT.value)
    found = replace(found, displacement=factor * found.displacement, error=error)
    assert compare_with_friction(problem, found, RTOL).kind == kind


def test_load_of_a_body_that_is_rounding_of_others():
    """Forces leave 3e-9 of the largest load, which is 5e-5 of that on the body."""
    answer = verdict_with_friction(draw_torn(92182).glued)
    assert (answer.verdict, "of what acts on it" in answer.why) == ("unsure", True)


def test_every_kind_of_friction_is_drawn():
    drawn = [draw_torn(seed).glued for seed in range(100)]
    drawn = [problem for problem in drawn if problem.friction is not None]
    kinds = {(p.friction.bound.any(), p.friction.coefficient.any()) for p in drawn}
    assert {(True, False), (False, True), (True, True)} <= kinds
    verdicts = [verdict_with_friction(problem).verdict for problem in drawn[:12]]
    assert {"solution", "unbounded"} <= {v.replace("infeasible and ", "") for v in verdicts}

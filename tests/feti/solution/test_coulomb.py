"""When the fixed point on the slip bounds is given up."""

from __future__ import annotations

import numpy as np
import pytest
from friction_problems import pushed_block
from torn import with_fields

from fenics_tfeti.feti import Options, SlipBoundStep, TornSolver
from fenics_tfeti.feti.solution.coulomb import _failure
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.qp import OuterIteration

pytestmark = pytest.mark.once


@pytest.mark.parametrize(
    "changes",
    [
        *([ratio**k for k in range(12)] for ratio in (0.1, 0.5, 0.89)),
        # one large change is no failure
        [1.0, 0.5, 0.2, 0.4, 0.1, 0.05],
        # a change that is rounding says nothing about the map: what follows it is larger
        [1e-2, 1e-16, *(0.1 * 0.5**k for k in range(15))],
    ],
)
def test_steps_that_contract_go_on(changes):
    assert all(_failure(changes[: k + 1]) == "" for k in range(len(changes)))


@pytest.mark.parametrize("ratio", [0.91, 1.0, 1.3])
def test_fifteen_steps_that_do_not_contract_are_enough(ratio):
    changes = [0.5 * ratio**k for k in range(16)]
    assert _failure(changes[:15]) == ""
    assert f"a factor of {ratio:.2f} a step only" in _failure(changes)


def with_coulomb(load) -> TornSystem:
    """Return two blocks with Coulomb's law."""
    system = pushed_block(2, load)
    ratio = np.full(system.friction.size, 0.3)
    return with_fields(system, "friction", bound=0.0 * ratio, coefficient=ratio)


def test_tolerances_of_steps_follow_the_changes():
    """The last step has the tolerance asked for, and none a finer one."""
    solver = TornSolver(with_coulomb((0.15, 0.05, -1.0)), Options(rtol=1e-4))
    report = solver.solve().report
    assert report.converged and report.certificate.worst <= 1e-4
    rtols = [step.rtol for step in report.slip_bounds]
    assert rtols == sorted(rtols, reverse=True) and rtols[-1] == 1e-4
    # from a start the first step has that tolerance; the next one that of the change it found
    further = with_coulomb((0.25, 0.05, -1.0))
    solver = TornSolver(further, Options(rtol=1e-4), previous=solver)
    first, second, *_ = solver.solve().report.slip_bounds
    assert first.rtol == 1e-4
    assert second.rtol == pytest.approx(min(1e-2, 0.05 * first.change))
    assert second.rtol > 2e-4


def test_limit_on_outer_iterations_is_that_of_each_step():
    system, counts = with_coulomb((0.15, 0.05, -1.0)), [0]

    def count(step) -> None:
        counts[-1] += isinstance(step, OuterIteration)
        if isinstance(step, SlipBoundStep):
            counts.append(0)

    TornSolver(system, Options(method="smalbe")).solve(count)
    largest, total = max(counts), sum(counts)
    assert 1 < largest < total
    options = Options(method="smalbe", smalbe_max_it=largest)
    assert TornSolver(system, options).solve().report.converged


def test_step_that_has_spent_the_products_is_named():
    options = Options(max_products=2, error_if_not_converged=False)
    report = TornSolver(with_coulomb((0.15, 0.05, -1.0)), options).solve().report
    assert not report.converged
    assert report.reason.endswith("products; in step 1 of the slip bounds")

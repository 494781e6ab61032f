"""When the fixed point on the slip bounds is given up."""

from __future__ import annotations

from dataclasses import replace

import pytest
from friction_problems import pushed_block

from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.dual.iterate import SolveStatus
from fenics_tfeti.feti.solution import coulomb
from fenics_tfeti.feti.solution.coulomb import _failure


@pytest.mark.parametrize("ratio", [0.1, 0.5, 0.89])
def test_steps_that_contract_go_on(ratio):
    changes = [ratio**k for k in range(12)]
    assert all(_failure(changes[:k]) == "" for k in range(13))


@pytest.mark.parametrize("ratio", [0.91, 1.0, 1.3])
def test_fifteen_steps_that_do_not_contract_are_enough(ratio):
    changes = [0.5 * ratio**k for k in range(16)]
    assert _failure(changes[:15]) == ""
    assert f"a factor of {ratio:.2f} a step only" in _failure(changes)


def test_one_large_change_is_no_failure():
    assert _failure([1.0, 0.5, 0.2, 0.4, 0.1, 0.05]) == ""


def test_step_that_misses_its_tolerance_may_be_accurate_enough(monkeypatch):
    """Steps take finer tolerances than asked for, which rounding may not allow."""

    def limited(context, start):
        outcome = solve(context, start)
        solved = outcome.converged and context.options.rtol > 1e-4
        status = SolveStatus.SOLVED if solved else SolveStatus.AT_LIMIT
        return replace(outcome, status=status, reason="rounding")

    solve = coulomb.iterate_until_certified
    system = pushed_block(2)
    friction = system.friction
    ratio = 0.3 + 0.0 * friction.bound
    system = replace(system, friction=replace(friction, bound=0.0 * ratio, coefficient=ratio))
    monkeypatch.setattr(coulomb, "iterate_until_certified", limited)
    report = TornSolver(system, Options(rtol=1e-4)).solve().report
    assert report.converged and report.certificate.worst <= 1e-4
    assert report.slip_bounds[-1].rtol <= 1e-4

"""The outer loop: methods take over from each other, and the best iterate is returned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stiff_half import stiff_half
from torn import column, with_fields

from fenics_tfeti.feti import Options, TornSolver, TornSystem
from fenics_tfeti.feti.coarse import projector
from fenics_tfeti.feti.dual.iterate import SolveStatus
from fenics_tfeti.feti.solution import outer

pytestmark = pytest.mark.once


def stiff_block_over_uneven_gaps() -> TornSystem:
    """Return a block that falls, tilts and comes to rest on three nodes."""
    system = column(n=2)
    *lower, upper = system.subdomains
    stiff = replace(upper, stiffness=(1e4 * upper.stiffness).tocsr())
    gap = 1e3 * np.random.default_rng(1).random(system.contacts.gap.size)
    return with_fields(replace(system, subdomains=[*lower, stiff]), "contacts", gap=gap)


@pytest.fixture(scope="module")
def expected() -> np.ndarray:
    return np.concatenate(TornSolver(stiff_block_over_uneven_gaps()).solve().displacements)


@pytest.mark.parametrize("patience", [1, 20, 1000])
def test_smalbe_hands_over_where_it_is_slow(patience, expected):
    options = Options(method="smalbe", scaling="multiplicity", smalbe_patience=patience)
    solution = TornSolver(stiff_block_over_uneven_gaps(), options).solve()
    error = np.abs(np.concatenate(solution.displacements) - expected).max()
    assert error <= 1e-6 * np.abs(expected).max()
    assert bool(solution.report.faces) == (patience < 1000)


def test_smalbe_keeps_its_iterate_when_the_face_is_not_the_last(monkeypatch):
    """The active set method solves nothing: SMALBE-M has to do it alone, as if never stopped."""

    def fails(*args, **kwargs):
        return replace(active_set(*args, **kwargs), status=SolveStatus.STALLED)

    active_set = outer.primal_dual_active_set
    options = Options(method="smalbe", scaling="multiplicity", smalbe_patience=3)
    alone = TornSolver(
        stiff_block_over_uneven_gaps(), replace(options, smalbe_patience=1000)
    ).solve()
    monkeypatch.setattr(outer, "primal_dual_active_set", fails)
    both = TornSolver(stiff_block_over_uneven_gaps(), options).solve()
    assert both.report.outer_iterations <= 2 * alone.report.outer_iterations


@pytest.fixture
def inaccurate(monkeypatch):
    """Apply P once at a jump of 1e10, so that rounding limits the error to about 1e-4."""
    monkeypatch.setattr(projector, "_MOST_PASSES", 1)
    return stiff_half(1e10)


@pytest.mark.parametrize("preconditioner", ["lumped", "dirichlet"])
def test_rounding_is_noticed_and_its_error_is_named(preconditioner, inaccurate):
    options = Options(preconditioner=preconditioner, smalbe_max_it=1, error_if_not_converged=False)
    report = TornSolver(inaccurate, options).solve().report
    assert not report.converged
    assert report.certificate.error <= 1e-3
    # of the whole or of its only group: the same number but for rounding
    assert f"its certificate has reached {report.certificate.worst:.1e} (error" in report.reason
    assert "rounding has ended the conjugate gradients" in report.reason
    # the residual of the recurrences falls again after it has risen, off Gl = e
    assert report.products["total"] <= 50


def test_bound_holds_where_rounding_ends_the_iterations(inaccurate, monkeypatch):
    """J(u) - J(u*) is half of the square of the error in the energy norm."""
    options = Options(smalbe_max_it=1, error_if_not_converged=False)
    report = TornSolver(inaccurate, options).solve().report
    monkeypatch.undo()
    exact = TornSolver(stiff_half(1e10), Options(rtol=1e-7)).solve().report.energy
    error = np.sqrt(2.0 * max(0.0, report.energy - exact))
    assert error <= report.certificate.bound + np.sqrt(1e-14 * abs(exact))


def test_best_iterate_is_returned(inaccurate, monkeypatch):
    def spoils(problem, start, turn):
        nothing = np.zeros_like(start.multipliers)
        return replace(start, multipliers=nothing, status=SolveStatus.OUT_OF_STEPS)

    monkeypatch.setattr(outer, "solve_by_smalbe", spoils)
    report = TornSolver(inaccurate, Options(error_if_not_converged=False)).solve().report
    assert report.reason.startswith("limit of 1000 outer iterations (smalbe_max_it); its")
    assert report.certificate.error <= 1e-3

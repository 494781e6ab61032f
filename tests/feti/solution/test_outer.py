"""The outer loop: the two methods for the dual problem take over from each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from torn import column

from fenics_tfeti.feti import Options, TornSolver, TornSystem

pytestmark = pytest.mark.once


def stiff_block_over_uneven_gaps() -> TornSystem:
    """Return a block that falls, tilts and comes to rest on three nodes."""
    system = column(n=2)
    *lower, upper = system.subdomains
    stiff = replace(upper, stiffness=(1e4 * upper.stiffness).tocsr())
    gap = 1e3 * np.random.default_rng(1).random(system.contacts.gap.size)
    return replace(system, subdomains=[*lower, stiff], contacts=replace(system.contacts, gap=gap))


@pytest.fixture(scope="module")
def expected() -> np.ndarray:
    return np.concatenate(TornSolver(stiff_block_over_uneven_gaps()).solve().displacements)


@pytest.mark.parametrize("patience", [1, 3, 20, 1000])
def test_smalbe_hands_over_where_it_is_slow(patience, expected):
    options = Options(method="smalbe", scaling="multiplicity", smalbe_patience=patience)
    solution = TornSolver(stiff_block_over_uneven_gaps(), options).solve()
    error = np.abs(np.concatenate(solution.displacements) - expected).max()
    assert error <= 1e-6 * np.abs(expected).max()
    assert bool(solution.report.faces) == (patience < 1000)


def test_smalbe_keeps_its_iterate_when_the_face_is_not_the_last(monkeypatch):
    """The active set method solves nothing: SMALBE-M has to do it alone, as if never stopped."""
    import fenics_tfeti.feti.solution.outer as outer

    def fails(*args, **kwargs):
        return replace(active_set(*args, **kwargs), solved=False)

    active_set = outer.primal_dual_active_set
    options = Options(method="smalbe", scaling="multiplicity", smalbe_patience=3)
    alone = TornSolver(
        stiff_block_over_uneven_gaps(), replace(options, smalbe_patience=1000)
    ).solve()
    monkeypatch.setattr(outer, "primal_dual_active_set", fails)
    both = TornSolver(stiff_block_over_uneven_gaps(), options).solve()
    assert both.report.outer_iterations <= 2 * alone.report.outer_iterations

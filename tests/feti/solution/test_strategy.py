"""Which method goes on after which, and how many products it may spend."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from fenics_tfeti.feti import Options
from fenics_tfeti.feti.dual.iterate import Method, SolveStatus
from fenics_tfeti.feti.solution.monitor import Monitor
from fenics_tfeti.feti.solution.states import History
from fenics_tfeti.feti.solution.strategy import Strategy

pytestmark = pytest.mark.once

ACTIVE_SET, GRADIENTS, NEWTON, SMALBE = Method
STALLED, CENTRED = SolveStatus.STALLED, SolveStatus.CENTRED


def strategy(start: Method, follows: bool = False, deflated: bool = False) -> Strategy:
    monitor = Monitor(History(), MPI.COMM_SELF)
    found = Strategy.of(start, Options(), monitor, follows=follows, deflated=deflated)
    found.begin(1.0)
    return found


def spend(turns: Strategy, method: Method, products: int, end: SolveStatus) -> tuple[int, Method]:
    """Return how many products the method may spend, and who goes on after it."""
    before = turns.monitor.history.products
    limit = turns.turn(method).max_products - before.total
    before.cg += products
    return limit, turns.after(method, end, products)


@pytest.mark.parametrize(("start", "order"), [
    (ACTIVE_SET, [ACTIVE_SET, NEWTON, ACTIVE_SET, NEWTON]),
    (GRADIENTS, [GRADIENTS, ACTIVE_SET, NEWTON, GRADIENTS]),
    (SMALBE, [SMALBE, ACTIVE_SET, NEWTON, SMALBE]),
])  # fmt: skip
def test_methods_without_progress_go_round(start, order):
    turns, method = strategy(start), start
    for expected in order:
        assert method is expected
        method = spend(turns, method, 1, STALLED)[1]


@pytest.mark.parametrize(("follows", "first"), [(False, 10_000), (True, 2000)])
def test_shares_double_in_each_round(follows, first):
    turns, limits = strategy(ACTIVE_SET, follows), []
    for method in 3 * [ACTIVE_SET, NEWTON]:
        limits.append(spend(turns, method, 0, STALLED)[0])
    assert limits == [first, 2000, 4000, 4000, 8000, 8000]


def test_trials_between_proximal_problems_are_no_part_of_the_turn():
    """They take as many products as all before, or as are left; the turn of Newton goes on."""
    turns = strategy(ACTIVE_SET)
    assert spend(turns, ACTIVE_SET, 100, STALLED) == (10_000, NEWTON)
    assert spend(turns, NEWTON, 300, CENTRED) == (2000, ACTIVE_SET)
    assert spend(turns, ACTIVE_SET, 400, STALLED) == (400, NEWTON)
    assert spend(turns, NEWTON, 1600, CENTRED) == (1700, ACTIVE_SET)
    assert spend(turns, ACTIVE_SET, 100, STALLED) == (100, NEWTON)
    assert spend(turns, NEWTON, 100, STALLED) == (100, ACTIVE_SET)


def test_rounding_ends_a_pass_in_its_first_turn_only():
    turns = strategy(ACTIVE_SET)
    assert spend(turns, ACTIVE_SET, 1, SolveStatus.AT_ROUNDING)[1] is None
    turns.begin(0.1)
    spend(turns, ACTIVE_SET, 1, STALLED)
    spend(turns, NEWTON, 1, CENTRED)
    assert spend(turns, ACTIVE_SET, 1, SolveStatus.AT_ROUNDING)[1] is NEWTON


@pytest.mark.parametrize(("spent", "left"), [(100, 2000), (3000, 3000), (8000, 2000)])
def test_smalbe_goes_on_from_rounding_with_as_many_products(spent, left):
    turns = strategy(ACTIVE_SET)
    assert spend(turns, ACTIVE_SET, spent, SolveStatus.AT_ROUNDING)[1] is None
    assert turns.after_rounding(ACTIVE_SET) is SMALBE
    turns.begin(1.0)
    assert spend(turns, SMALBE, left, STALLED) == (left, ACTIVE_SET)
    assert turns.is_spent


@pytest.mark.parametrize("deflated", [False, True])
def test_smalbe_without_curvature(deflated):
    """Rounding may hide it in deflated directions: then the active set method is tried, once."""
    turns = strategy(SMALBE, deflated=deflated)
    ends = [spend(turns, SMALBE, 1, SolveStatus.FLAT)[1] for _ in range(2)]
    assert ends == [ACTIVE_SET if deflated else None, None]


def test_passes_without_progress_are_left_to_the_active_set_method_once():
    assert strategy(ACTIVE_SET).after_passes(ACTIVE_SET) is None
    turns = strategy(SMALBE)
    assert [turns.after_passes(SMALBE) for _ in range(2)] == [ACTIVE_SET, None]


@pytest.mark.parametrize("end", [SolveStatus.SOLVED, SolveStatus.INTERRUPTED])
def test_certificate_decides_after_all_other_ends(end):
    assert all(spend(strategy(method), method, 1, end)[1] is None for method in Method)

from __future__ import annotations

import pytest
from torn import column

from fenics_tfeti.errors import FactorizationError
from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.coarse.factor import choose_coarse_solver, choose_groups
from fenics_tfeti.feti.solution.setup import choose_factor


@pytest.mark.parametrize("ranks", [1, 2])
def test_one_or_two_ranks_have_the_whole_factor(ranks):
    assert choose_coarse_solver(ranks, 10**6) == "redundant"


@pytest.mark.parametrize("ranks", [2, 3, 30, 300, 3000])
def test_small_matrices_stay_whole(ranks):
    assert choose_coarse_solver(ranks, 600) == "redundant"


@pytest.mark.parametrize("ranks", [3, 30, 300, 3000])
def test_large_matrices_do_not(ranks):
    assert choose_coarse_solver(ranks, 10**5) == "distributed"


def test_few_of_many_ranks_share_a_factor():
    groups = [choose_groups(3000, size) for size in (600, 6000, 60_000, 600_000)]
    assert groups == sorted(groups)
    assert groups[0] == 1
    assert groups[-1] < 1000


def test_nothing_is_distributed_without_mumps():
    assert choose_coarse_solver(100, 10**6) == "distributed"
    assert choose_coarse_solver(100, 10**6, mumps=False) == "redundant"


@pytest.mark.parametrize("solver", ["distributed", "iterative"])
def test_a_missing_mumps_is_an_error(solver):
    with pytest.raises(FactorizationError, match="'mumps'"):
        choose_factor(Options(coarse_solver=solver), ["cholmod"])


@pytest.mark.parametrize("solver", ["distributed", "iterative"])
def test_on_one_rank(solver):
    report = TornSolver(column(), Options(coarse_solver=solver)).solve().report
    assert report.converged

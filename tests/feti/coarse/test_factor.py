from __future__ import annotations

import pytest
from torn import column

from fenics_tfeti.errors import FactorizationError
from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.coarse.factor import choose_coarse_solver
from fenics_tfeti.feti.solution.setup import choose_factor


@pytest.mark.parametrize("ranks", [1, 2])
def test_one_or_two_ranks_have_the_whole_factor(ranks):
    assert choose_coarse_solver(ranks, 10**6, 100) == "redundant"


@pytest.mark.parametrize("ranks", [2, 3, 30, 300, 3000])
def test_small_matrices_stay_whole(ranks):
    assert choose_coarse_solver(ranks, 600, 60) == "redundant"


@pytest.mark.parametrize("ranks", [3, 30, 300, 3000])
def test_large_matrices_do_not(ranks):
    assert choose_coarse_solver(ranks, 10**5, 1000) != "redundant"


@pytest.mark.parametrize(("changes", "solver"), [(100, "inverse"), (10_000, "distributed")])
def test_faces_are_changes_where_these_are_few(changes, solver):
    assert choose_coarse_solver(500, 30_000, changes) == solver


def test_nothing_is_distributed_without_mumps():
    assert choose_coarse_solver(100, 10**6, 10**6) == "distributed"
    assert choose_coarse_solver(100, 10**6, 10**6, mumps=False) == "redundant"


def test_distributed_without_mumps_is_an_error():
    with pytest.raises(FactorizationError, match="'mumps'"):
        choose_factor(Options(coarse_solver="distributed"), ["cholmod"])


@pytest.mark.parametrize("solver", ["distributed", "inverse"])
def test_on_one_rank(solver):
    report = TornSolver(column(), Options(coarse_solver=solver)).solve().report
    assert report.converged

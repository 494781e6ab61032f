import pytest
from torn import column

from fenics_tfeti.errors import FactorizationError
from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.coarse.factor import choose_coarse_solver, choose_groups
from fenics_tfeti.feti.factors import cholesky
from fenics_tfeti.feti.solution.setup import choose_factor


@pytest.mark.parametrize(("ranks", "size", "mumps", "solver"), [
    *((ranks, 10**6, True, "redundant") for ranks in (1, 2)),
    *((ranks, 600, True, "redundant") for ranks in (2, 3, 30, 300, 3000)),
    *((ranks, 10**5, True, "distributed") for ranks in (3, 30, 300, 3000)),
    (100, 10**6, False, "redundant"),
])  # fmt: skip
def test_large_matrices_are_distributed_over_more_than_two_ranks(ranks, size, mumps, solver):
    assert choose_coarse_solver(ranks, size, mumps=mumps) == solver


def test_few_of_many_ranks_share_a_factor():
    groups = [choose_groups(3000, size) for size in (600, 6000, 60_000, 600_000)]
    assert groups == sorted(groups)
    assert groups[0] == 1
    assert groups[-1] < 1000


def test_a_missing_mumps_is_an_error(monkeypatch):
    monkeypatch.setattr(cholesky, "_is_available", lambda name: name == "cholmod")
    with pytest.raises(FactorizationError, match="'mumps'"):
        choose_factor(Options(coarse_solver="distributed"))


def test_on_one_rank():
    report = TornSolver(column(), Options(coarse_solver="distributed")).solve().report
    assert report.converged

from __future__ import annotations

import pytest
from torn import column

from fenics_tfeti.errors import FactorizationError
from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.coarse import factor
from fenics_tfeti.feti.coarse.factor import distribution_pays
from fenics_tfeti.feti.local import cholesky


@pytest.mark.parametrize("ranks", [1, 2])
def test_one_or_two_ranks_never_distribute(ranks):
    assert not distribution_pays(ranks, 10**6)


@pytest.mark.parametrize("ranks", [3, 30, 300, 3000])
def test_small_matrices_stay_whole_and_large_ones_do_not(ranks):
    assert not distribution_pays(ranks, 600)
    assert distribution_pays(ranks, 10**5)


def test_without_mumps_matrices_stay_whole(monkeypatch):
    monkeypatch.setattr(factor, "available_packages", lambda: ["cholmod"])
    assert not distribution_pays(100, 10**6)


def test_distributed_without_mumps_is_an_error(monkeypatch):
    monkeypatch.setattr(cholesky, "available_packages", lambda: ["cholmod"])
    with pytest.raises(FactorizationError, match="'mumps'"):
        TornSolver(column(), Options(coarse_solver="distributed"))


def test_distributed_on_one_rank():
    report = TornSolver(column(), Options(coarse_solver="distributed")).solve().report
    assert report.converged

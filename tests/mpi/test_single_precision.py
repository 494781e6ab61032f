"""Dense operators in float32 on some of the ranks."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scenes import two_beams

from fenics_tfeti.feti import dual

comm = MPI.COMM_WORLD


@pytest.mark.parametrize("ranks", ["all", "first"])
def test_replacements_are_the_same_on_all_ranks(monkeypatch, ranks):
    """A rank without a dense matrix takes part in every product, rough or not."""
    monkeypatch.setattr(dual, "_explicit_pays", lambda *_: ranks == "all" or comm.rank == 0)
    scene = two_beams(comm, "hexahedron", 4)
    options = {"rtol": 1e-9, "subdomain_size": 200, "operator_precision": "single"}
    problem = scene.problem(options=options)
    problem.solve()
    report = problem.report
    kinds = report.dual_operator
    assert report.products["replacement"] > 0
    assert len(set(comm.allgather(tuple(report.products.values())))) == 1
    assert kinds["explicit"] == 0
    assert (kinds["implicit"] > 0) == (ranks == "first" and comm.size > 1)
    assert kinds["single"] > 0
    np.testing.assert_allclose(report.contact_force, scene.total_forces, rtol=1e-8)

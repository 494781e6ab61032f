"""Meshes whose cells grow away from the contact: preconditioner and deflation by the data."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import pytest
from graded_block import graded_block

pytestmark = pytest.mark.once

CASES = {"2D": (2, 40, 1.2, 20.0), "3D": (3, 4, 1.4, 20.0)}


def report(case: str, **options: Any) -> Any:
    problem = graded_block(MPI.COMM_SELF, *CASES[case], rtol=1e-6, **options)
    problem.solve()
    return problem.report


@pytest.mark.parametrize(
    ("case", "factor", "chosen"),
    [("2D", 4.0, "dirichlet, for flat or graded cells at interfaces"), ("3D", 2.0, "lumped")],
)
def test_fewer_products(case, factor, chosen):
    """The force is that of the lumped preconditioner alone, which takes many more products."""
    found = report(case)
    other = report(case, preconditioner="lumped", deflation="off")
    assert other.products["total"] >= factor * found.products["total"]
    assert found.certificate.worst <= 1e-6
    force, expected = (r.contacts[0].normal_force for r in (found, other))
    assert force == pytest.approx(expected, rel=1e-5)
    assert found.deflation["vectors"] > 0
    assert f"preconditioner  {chosen}\n" in str(found)


def test_a_uniform_mesh_pays_nothing():
    problem = graded_block(MPI.COMM_SELF, 3, 4, 1.0, 4.0, subdomain_size=1500)
    problem.solve()
    found = problem.report
    assert found.subdomains == 8
    assert (found.preconditioner, found.preconditioner_reason) == ("lumped", "")
    assert found.deflation["vectors"] == found.products["deflation"] == 0

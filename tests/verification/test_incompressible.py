"""Nearly incompressible materials: about as many products as for others, the same certificate."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from mpi4py import MPI

import pytest
from pressed_blocks import pressed_blocks

from fenics_tfeti import ContactProblem

pytestmark = pytest.mark.once


@lru_cache(maxsize=None)
def solved(**case: Any) -> ContactProblem:
    problem = pressed_blocks(MPI.COMM_SELF, **case)
    problem.solve()
    return problem


CASES = {
    "3D": {"gdim": 3, "subdomain_size": 400},
    "3D, SCOTCH": {"gdim": 3, "subdomain_size": 450, "partitioner": "scotch"},
    "3D, friction": {"gdim": 3, "subdomain_size": 400, "friction": True},
    "3D, degree 2": {"gdim": 3, "subdomain_size": 800, "degree": 2},
    "2D": {"gdim": 2, "subdomain_size": 200},
    "2D, degree 2": {"gdim": 2, "subdomain_size": 400, "degree": 2},
}


@pytest.mark.parametrize("case", CASES)
def test_about_twice_as_many_products(case):
    products = [solved(nu=nu, **CASES[case]).report.products["total"] for nu in (0.3, 0.49999)]
    assert products[1] <= 2.2 * products[0]


@pytest.mark.parametrize("case", CASES)
def test_certificate_and_force(case):
    """The force is that of another preconditioner, which takes many more products."""
    report = solved(nu=0.499, **CASES[case]).report
    assert report.certificate.worst <= 1e-6
    plain = {"preconditioner": "lumped", "deflation": "off", "scaling": "multiplicity"}
    other = solved(nu=0.499, **CASES[case], **plain).report
    force, expected = (r.contacts[0].normal_force for r in (report, other))
    assert force == pytest.approx(expected, rel=1e-5)
    assert report.products["total"] < other.products["total"]


def test_compressible_materials_are_treated_as_before():
    setup = solved(nu=0.3, **CASES["3D"]).report
    assert setup.deflation["vectors"] == 0
    assert setup.preconditioner == "lumped"

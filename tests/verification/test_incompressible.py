"""Nearly incompressible materials: about as many products as for others, the same certificate."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import pytest
from pressed_blocks import pressed_blocks

pytestmark = pytest.mark.once


def report(**case: Any) -> Any:
    problem = pressed_blocks(MPI.COMM_SELF, **case)
    problem.solve()
    return problem.report


CASES = {
    "3D": {"gdim": 3, "subdomain_size": 400},
    "3D, SCOTCH": {"gdim": 3, "subdomain_size": 450, "partitioner": "scotch"},
    "3D, friction": {"gdim": 3, "subdomain_size": 400, "friction": True},
    "3D, degree 2": {"gdim": 3, "subdomain_size": 800, "degree": 2},
    "2D": {"gdim": 2, "subdomain_size": 200},
    "2D, degree 2": {"gdim": 2, "subdomain_size": 400, "degree": 2},
}
QUICK = [case for case in CASES if case != "3D, SCOTCH"]
REST = [case for case in CASES if case not in ("3D, friction", "2D, degree 2")]
heavy = pytest.mark.heavy


@pytest.mark.parametrize("case", [pytest.param("3D, SCOTCH", marks=heavy), *QUICK])
def test_at_most_twice_as_many_products(case):
    compressible, other = (report(nu=nu, **CASES[case]) for nu in (0.3, 0.49999))
    assert other.products["total"] <= 2.0 * compressible.products["total"]
    if case == "3D":
        # treated as before
        assert compressible.deflation["vectors"] == 0
        assert compressible.preconditioner == "lumped"


@pytest.mark.parametrize(
    "case", ["3D, friction", "2D, degree 2", *(pytest.param(case, marks=heavy) for case in REST)]
)
def test_certificate_and_force(case):
    """The force is that of another preconditioner, which takes many more products."""
    found = report(nu=0.499, **CASES[case])
    assert found.certificate.worst <= 1e-6
    plain = {"preconditioner": "lumped", "deflation": "off", "scaling": "multiplicity"}
    other = report(nu=0.499, **CASES[case], **plain)
    force, expected = (r.contacts[0].normal_force for r in (found, other))
    assert force == pytest.approx(expected, rel=1e-5)
    assert found.products["total"] < other.products["total"]

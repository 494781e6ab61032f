"""Exact non-penetration on any number of ranks is that of one."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from stepped_blocks import two_blocks

COMM = MPI.COMM_WORLD
OPTIONS = {
    "rtol": 1e-8,
    "non_penetration": "exact",
    "non_penetration_tolerance": 1e-4,
    "non_penetration_max_it": 40,
    "subdomain_size": 200,
}


@pytest.mark.parametrize(
    ("slide", "upper"),
    [(0.01, 12), (0.01, 9), (0.3, 9), pytest.param(0.3, 12, marks=pytest.mark.heavy)],
)
def test_bodies_that_slide(slide, upper):
    """On matching meshes, and with mortars."""
    problem = two_blocks(slide, OPTIONS, comm=COMM, upper=upper)
    alone = two_blocks(slide, OPTIONS, comm=MPI.COMM_SELF, upper=upper)
    problem.solve()
    alone.solve()
    mine, theirs = problem.report.passes, alone.report.passes
    assert len(mine) == len(theirs)
    for one, other in zip(mine, theirs, strict=True):
        np.testing.assert_allclose(
            [one.penetration, one.separation, one.slip, one.tilt],
            [other.penetration, other.separation, other.slip, other.tilt],
            rtol=1e-3,
            atol=1e-7,
        )
    np.testing.assert_allclose(
        [c.normal_force for c in problem.report.contacts],
        [c.normal_force for c in alone.report.contacts],
        rtol=1e-5,
    )
    found, expected = (p.results[0].gather() for p in (problem, alone))
    order, expected_order = (np.argsort(c.coordinates[:, 0]) for c in (found, expected))
    np.testing.assert_allclose(
        found.normal_force[order],
        expected.normal_force[expected_order],
        atol=1e-4 * expected.normal_force.max(),
    )

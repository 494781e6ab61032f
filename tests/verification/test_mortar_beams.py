"""Two beams, one on the other, meshed apart: forces, energy and products as of equal meshes."""

from __future__ import annotations

import warnings
from functools import lru_cache

from mpi4py import MPI

import pytest
from scenes import (
    CLAMPED,
    LOADED,
    MASTER,
    ROLLER,
    SLAVE,
    TRACTION,
    YOUNG,
    at,
    beams_supports,
    elasticity,
    vector_space,
)

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import Box, boxes, tag_facets


@lru_cache(maxsize=None)
def report(lower, upper, ratio, exchanged=False):
    """Return the report for numbers of elements over the beams' height and a ratio of moduli."""
    parts = [Box((0, 0), (2, 1), (2 * lower, lower)), Box((1, 1), (3, 2), (2 * upper, upper))]
    beams = boxes(MPI.COMM_SELF, parts, "quadrilateral")
    over = at(1, 1.0)
    tags = tag_facets(
        beams.mesh,
        [
            (CLAMPED, at(0, 0.0), 1),
            (ROLLER, at(0, 3.0), 2),
            (LOADED, at(1, 2.0), 2),
            (SLAVE, lambda x: over(x) & (x[0] < 2.0 + 1e-9), 2),
            (MASTER, over, 1),
        ],
        beams.cell_tags,
    )
    V = vector_space(beams.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    dx = ufl.Measure("dx", domain=beams.mesh, subdomain_data=beams.cell_tags)
    ds = ufl.Measure("ds", domain=beams.mesh, subdomain_data=tags)
    young = [fem.Constant(beams.mesh, YOUNG), fem.Constant(beams.mesh, ratio * YOUNG)]
    traction = fem.Constant(beams.mesh, TRACTION)
    roles = (MASTER, SLAVE) if exchanged else (SLAVE, MASTER)
    problem = ContactProblem(
        sum(elasticity(u, v, modulus, dx(k + 1)) for k, modulus in enumerate(young)),
        -traction * v[1] * ds(LOADED),
        bcs=beams_supports(V, tags),
        contacts=ContactPair(tags, *roles, roles="given"),
        cell_tags=beams.cell_tags,
        options={"rtol": 1e-8, "subdomain_size": 300},
    )
    problem.solve()
    return problem.report


@pytest.mark.filterwarnings("ignore:contact 0")
@pytest.mark.parametrize("exchanged", [False, True], ids=["upper slave", "lower slave"])
@pytest.mark.parametrize("ratio", [1.0, 100.0, 0.01])
@pytest.mark.parametrize("upper", [14, 30])
def test_meshes_in_the_ratios_of_7_to_5_and_3_to_1(upper, ratio, exchanged):
    found, equal = report(10, upper, ratio, exchanged), report(10, 10, ratio)
    assert found.contacts[0].pairing["discretisation"] == "mortar"
    assert equal.contacts[0].pairing["discretisation"] == "node_to_node"
    force = found.contacts[0].force[1] * (-1.0 if exchanged else 1.0)
    assert force == pytest.approx(2.0 * TRACTION, rel=1e-8)
    # the finer beam is softer
    assert 0.999 < found.energy / equal.energy < 1.05
    # of meshes that match, the finer one has smaller subdomains
    products = [r.products["total"] for r in (equal, report(upper, upper, ratio))]
    if found.contacts[0].roles_ratio < 20.0:
        assert found.products["total"] <= 1.3 * max(products)


def test_bad_roles_are_a_warning():
    report.cache_clear()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        report(10, 14, 100.0)
    assert any("E / h" in str(warning.message) for warning in caught)

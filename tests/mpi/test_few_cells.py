"""Ranks may have no cells at all."""

from __future__ import annotations

from mpi4py import MPI

import pytest
from mesh_arrays import grid, mesh_of
from scenes import TRACTION, YOUNG, at, elasticity, fixed, vector_space

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Plane, RigidObstacle
from fenics_tfeti.io import tag_facets

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize("divisions", [(1, 2), (1, 1, 2)])
def test_two_cells_on_all_ranks(divisions):
    cell = {2: "quadrilateral", 3: "hexahedron"}[len(divisions)]
    up = len(divisions) - 1
    domain = mesh_of(COMM, cell, *grid(divisions))
    facet_tags = tag_facets(domain, [(1, at(up, 0.0)), (2, at(up, 2.0))])
    V = vector_space(domain)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    young, traction = fem.Constant(domain, YOUNG), fem.Constant(domain, -TRACTION)
    ds = ufl.Measure("ds", domain=domain, subdomain_data=facet_tags)
    ground = Plane(point=(0.0,) * (up + 1), normal=(*(0.0,) * up, 1.0))
    problem = ContactProblem(
        elasticity(u, v, young),
        traction * v[up] * ds(2),
        bcs=[fixed(V, facet_tags, 1, k) for k in range(up)],
        contacts=[RigidObstacle(facet_tags, slave=1, obstacle=ground)],
    )
    problem.solve()
    assert problem.report.contacts[0].normal_force == pytest.approx(TRACTION, rel=1e-6)

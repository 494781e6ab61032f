"""Ranks may have no cells at all."""

from mpi4py import MPI

import numpy as np
import pytest
from mesh_arrays import grid, mesh_of
from scenes import TRACTION, YOUNG, Scene, at, plane

from dolfinx.mesh import meshtags

from fenics_tfeti.fem.topology import owned_cells
from fenics_tfeti.io import tag_facets

COMM = MPI.COMM_WORLD
pytestmark = pytest.mark.ranks(2, 3)


@pytest.mark.parametrize("by_cell", [False, True])
@pytest.mark.parametrize("divisions", [(1, 2), (1, 1, 2)])
def test_two_cells_on_all_ranks(divisions, by_cell):
    """Young's modulus is constant, or a function with a value in each cell."""
    cell = {2: "quadrilateral", 3: "hexahedron"}[len(divisions)]
    up = len(divisions) - 1
    domain = mesh_of(COMM, cell, *grid(divisions))
    facet_tags = tag_facets(domain, [(1, at(up, 0.0)), (2, at(up, 2.0))])
    if by_cell:
        cells = np.arange(owned_cells(domain), dtype=np.int32)
        cell_tags = meshtags(domain, up + 1, cells, np.ones_like(cells))
        scene = Scene(domain, facet_tags, cell_tags, young={1: YOUNG})
    else:
        scene = Scene(domain, facet_tags)
    scene.add_load(2, -TRACTION)
    for k in range(up):
        scene.fix(1, k)
    scene.add_obstacle(1, plane(up, up + 1))
    problem = scene.problem()
    problem.solve()
    assert problem.report.contacts[0].normal_force == pytest.approx(TRACTION, rel=1e-6)

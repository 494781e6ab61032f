"""Periodic and cyclic surfaces on several ranks are those of one process."""

from mpi4py import MPI

import numpy as np
import pytest
from periodic_cells import grains, homogeneous_cell, ring

from fenics_tfeti import InputError, LinearRows, Tresca
from fenics_tfeti.parallel import concatenate_ranks

COMM = MPI.COMM_WORLD
STRAIN = np.array([[-1e-3, 3e-4], [3e-4, -6e-4]])
PROBLEMS = {
    "grains": lambda comm: grains(1, STRAIN, Tresca(5e7), n=1, comm=comm),
    "sector": lambda comm: ring(1, 6, law=Tresca(1e6), comm=comm),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_solution_of_one_rank(name):
    here, alone = PROBLEMS[name](COMM), PROBLEMS[name](MPI.COMM_SELF)
    here.solve()
    alone.solve()
    assert here.report.energy == pytest.approx(alone.report.energy, rel=1e-8)
    # where four grains meet and stick, contact forces are not unique
    for found, expected in zip(here.results[-2:], alone.results[-2:], strict=True):
        scale = np.linalg.norm(expected.force)
        np.testing.assert_allclose(found.force, expected.force, atol=1e-6 * scale)
    entries = [problem.report.contacts[-1].matching for problem in (here, alone)]
    assert entries[0] == pytest.approx(entries[1], abs=1e-12)
    tie = here.results[-1].gather()
    assert tie.nodes.size == alone.results[-1].nodes.size
    np.testing.assert_allclose(tie.area.sum(), alone.results[-1].area.sum())


@pytest.mark.parametrize("degree", [1, 2])
def test_any_strain(degree):
    scene = homogeneous_cell("tetrahedron", np.diag([1e-3, -2e-3, 5e-4]), degree, COMM)
    problem = scene.problem(options={"rtol": 1e-11, "subdomain_size": 100})
    u = problem.solve().x.array.reshape(-1, 3)
    x = problem.space.tabulate_dof_coordinates()
    difference = concatenate_ranks(COMM, u - x * [1e-3, -2e-3, 5e-4])
    assert np.abs(difference - difference[0]).max() < 1e-11


@pytest.mark.ranks(2, 3)
def test_rows_with_masters_of_other_ranks():
    """Those of the vertical pair of a cell, each rank those of its slaves."""
    scene = homogeneous_cell("quadrilateral", np.diag([0.0, -1e-3]), comm=COMM)
    problem = scene.problem(contacts=scene.contacts[1], options={"rtol": 1e-11})
    expected = problem.solve().x.array.copy()
    pairs, first = problem.system.tied, scene.V.dofmap.index_map.local_range[0]
    component = np.argmax(np.abs(pairs.coefficients[::2]), axis=1)
    slaves, masters = (2 * pairs.nodes[k::2] + component for k in range(2))
    ends, ones = np.arange(slaves.size + 1), np.ones(slaves.size)
    rows = LinearRows(slaves - 2 * first, masters, ones, ends, values=pairs.gap)
    found = scene.problem(contacts=rows, options={"rtol": 1e-11}).solve().x.array
    difference = concatenate_ranks(COMM, (found - expected).reshape(-1, 2))
    assert np.abs(difference - difference[0]).max() < 1e-11


def test_surfaces_that_do_not_match():
    scene = homogeneous_cell("quadrilateral", STRAIN, comm=COMM)
    scene.mesh.geometry.x[np.isclose(scene.mesh.geometry.x[:, :2], [1.0, 0.5]).all(axis=1), 1] += (
        0.01
    )
    with pytest.raises(InputError, match=r"periodic pair 0: 2 of 3 facets of the slave have no"):
        scene.problem()

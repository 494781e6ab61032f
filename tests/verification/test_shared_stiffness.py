"""Subdomains that share a stiffness matrix give what they give each with its own."""

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
from scenes import YOUNG, elasticity, scalar_space, two_beams

from dolfinx import fem

from fenics_tfeti.fem import _compat

pytestmark = pytest.mark.once

PER_METRE = 2  # boxes
N = 3  # elements along a box


def ladder():
    """Return the two beams in boxes, with a modulus for each cell."""
    scene = two_beams(MPI.COMM_SELF, "quadrilateral", PER_METRE * N)
    domain = scene.mesh
    young = fem.Function(scalar_space(domain, "DG", 0))
    young.x.array[:] = YOUNG
    scene.a = elasticity(scene.u, scene.v, young)
    middles = domain.geometry.x[_compat.geometry_cells(domain)].mean(axis=1)
    places = np.column_stack([scene.cell_tags.values, np.floor(PER_METRE * middles)])
    boxes = np.unique(places, axis=0, return_inverse=True)[1].ravel()
    return SimpleNamespace(scene=scene, young=young, boxes=boxes)


def problem_of(ladder):
    return ladder.scene.problem(subdomains=ladder.boxes, options={"rtol": 1e-9})


def matrices(problem):
    return len({id(s.stiffness) for s in problem.system.subdomains})


def softer(ladder):
    ladder.young.x.array[np.flatnonzero(ladder.boxes == 2)[0]] = 0.1 * YOUNG


def test_a_coefficient_changed_in_one_subdomain_parts_it_from_the_others():
    beams = ladder()
    problem = problem_of(beams)
    before = problem.solve().x.array.copy()
    softer(beams)
    after = problem.solve().x.array
    assert matrices(problem) == problem.report.classes == 2
    assert np.abs(after - before).max() > 1e-3 * np.abs(before).max()
    expected = problem_of(beams).solve().x.array
    np.testing.assert_allclose(after, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def test_a_coefficient_changed_back_joins_them_again():
    beams = ladder()
    softer(beams)
    problem = problem_of(beams)
    problem.solve()
    beams.young.x.array[:] = YOUNG
    problem.solve()
    assert matrices(problem) == problem.report.classes == 1

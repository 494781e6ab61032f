"""A block pressed in by a rigid ball by a third of its height, against plain dolfinx and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from finite_strains import indented_block

heavy = pytest.mark.heavy

# (dimension, cells along the height, nu, vertical force, strain energy)
REFERENCES = [
    (2, 8, 0.3, 0.351780904, 0.044085597),
    (2, 8, 0.45, 0.455382296, 0.056941146),
    pytest.param(2, 16, 0.3, 0.354499336, 0.044453877, marks=heavy),
    pytest.param(2, 16, 0.45, 0.454031963, 0.056578295, marks=heavy),
    (3, 4, 0.3, 0.218769199, 0.024488602),
    pytest.param(3, 4, 0.45, 0.244196484, 0.027575479, marks=heavy),
]


@pytest.mark.parametrize(("dim", "n", "nu", "force", "energy"), REFERENCES)
@pytest.mark.parametrize("size", [200, 3000])
def test_force_and_energy(dim, n, nu, force, energy, size):
    scene = indented_block(dim, n, nu, newton_rtol=1e-8, subdomain_size=size)
    scene.solve([1 / 3, 2 / 3, 1.0])
    expected = [0.0] * (dim - 1) + [-force]
    np.testing.assert_allclose(scene.problem.results[0].force, expected, atol=1e-7)
    assert scene.energy == pytest.approx(energy, abs=1e-7)


def test_one_load_step_gives_the_same():
    scene = indented_block(newton_rtol=1e-8)
    scene.solve([1.0])
    assert -scene.problem.results[0].force[1] == pytest.approx(0.351780904, abs=1e-7)
    assert scene.counts()[0] <= 12


def test_tangents_are_kept_near_the_end():
    """As many steps as with a new tangent in each, and directions of negative energy are told."""
    scene = indented_block(subdomain_size=200)
    steps = []
    for load in (1 / 3, 2 / 3, 1.0):
        scene.solve([load])
        steps.append(scene.problem.report.newton)
    assert [len(of_load) for of_load in steps] == [5, 5, 6]
    assert sum(step.factorised for of_load in steps for step in of_load) <= 10
    for of_load in steps:
        assert of_load[0].factorised and not of_load[-1].factorised
        assert "tangent kept" in str(of_load[-1])
        assert max(step.negative for step in of_load) > 0

"""Blocks under uniform compression: the closed form, however they are turned and held."""

import numpy as np
import pytest
from finite_strains import pressed_patch, squeezed_block

from fenics_tfeti import Coulomb


@pytest.mark.parametrize(
    ("confined", "compression", "turned"),
    [
        (True, 0.4, 30.0),
        (False, 0.2, 0.0),
        pytest.param(True, 0.4, 0.0, marks=pytest.mark.heavy),
        pytest.param(False, 0.2, 30.0, marks=pytest.mark.heavy),
    ],
)
def test_uniform_compression(confined, compression, turned):
    scene, force = pressed_patch(compression, confined, turned, newton_rtol=1e-9, subdomain_size=60)
    scene.solve([0.5, 1.0])
    result = scene.problem.results[0]
    pressure = np.linalg.norm(force) / result.area.sum()  # in the deformed state
    # the nodes at both ends, whose displacements are prescribed, leave their forces to others
    assert np.count_nonzero(result.active) == (7 if confined else result.nodes.size)
    rtol = 1e-7 if confined else 1e-6
    np.testing.assert_allclose(result.pressure[result.active], pressure, rtol=rtol)
    np.testing.assert_allclose(result.force, force, atol=1e-7)


@pytest.mark.once
@pytest.mark.parametrize("size", [60, pytest.param(3000, marks=pytest.mark.heavy)])
def test_free_edges_that_lie_on_each_other(size):
    """Only the stiffness of the contact forces makes them stable, at a pressure of 0.6 E."""
    scene, force = pressed_patch(0.4, False, 30.0, newton_rtol=1e-7, subdomain_size=size)
    scene.solve([0.5, 1.0])
    np.testing.assert_allclose(scene.problem.results[0].force, force, atol=1e-6)
    assert scene.counts()[0] <= 14


CELLS = {
    ("quadrilateral", 2): ("slave",),
    ("triangle", 1): ("tied",),
    ("triangle", 2): ("tied",),
    ("tetrahedron", 1): ("slave",),
    ("tetrahedron", 2): (),
    ("hexahedron", 1): ("master",),
}


@pytest.mark.parametrize(
    ("cell", "degree", "upper"),
    [
        pytest.param(*cell, upper, marks=[pytest.mark.heavy] * (upper not in light))
        for cell, light in CELLS.items()
        for upper in ("slave", "master", "tied")
    ],
)
def test_cells_degrees_and_roles(cell, degree, upper):
    scene, force = pressed_patch(
        0.1, False, 30.0, cell=cell, degree=degree, upper=upper, newton_rtol=1e-9, subdomain_size=60
    )
    scene.solve([1.0])
    sign = -1.0 if upper == "master" else 1.0
    np.testing.assert_allclose(scene.problem.results[0].force, sign * force, atol=1e-8)


@pytest.mark.once
def test_turning_is_no_slip():
    """Pressed blocks that stick are turned by 60 degrees, in steps of 30."""
    scene, force = pressed_patch(
        0.1, False, motion=60.0, friction=Coulomb(0.3), newton_rtol=1e-9, subdomain_size=60
    )
    scene.solve([0.5, 1.0])
    result = scene.problem.results[0]
    np.testing.assert_allclose(result.force, force, atol=1e-7)
    assert result.friction.sticking.all()
    assert np.abs(result.friction.force).max() < 1e-7


@pytest.mark.parametrize(
    ("dim", "n", "turned"),
    [(2, 6, 37.0), (3, 2, 37.0), pytest.param(2, 6, 0.0, marks=pytest.mark.heavy)],
)
def test_floating_block(dim, n, turned):
    """Nothing but contact with two planes holds it: its tangents are projected."""
    scene, force = squeezed_block(dim, n, turned=turned, newton_rtol=1e-9, subdomain_size=60)
    scene.solve([0.5, 1.0])
    lower, upper = scene.problem.results
    np.testing.assert_allclose(lower.force, force, atol=1e-8)
    np.testing.assert_allclose(upper.force, -force, atol=1e-8)

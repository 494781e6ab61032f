"""Bulk and shear modulus from stiffness matrices."""

import numpy as np
import pytest
import torn
from springs import on_springs

from fenics_tfeti.feti.local.moduli import (
    NEARLY_INCOMPRESSIBLE,
    bulk_over_shear,
    compressibility,
    share_of_shear,
)

pytestmark = pytest.mark.once


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.499])
def test_ratio_of_a_uniform_material(monkeypatch, nu):
    monkeypatch.setattr(torn, "POISSON", nu)
    cube = torn.cube(2, corner=(3, 0, 1))
    expected = 2.0 * (1.0 + nu) / (3.0 * (1.0 - 2.0 * nu))
    assert bulk_over_shear(cube.stiffness, cube.coordinates) == pytest.approx(expected, rel=1e-9)
    assert compressibility([cube, cube]).keys() == {id(cube.stiffness)}
    # a matrix without shear stiffness is not incompressible
    assert bulk_over_shear(0.0 * cube.stiffness, cube.coordinates) == 1.0


@pytest.mark.parametrize("stiffness", [1e-9, 1e-3, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("components", [(2,), (0, 1, 2)])
def test_springs_of_the_ground_are_not_a_bulk_modulus(stiffness, components):
    cube = on_springs(torn.cube(2), 1.0, stiffness, components)
    ratio = bulk_over_shear(torn.cube(2).stiffness, cube.coordinates)
    assert bulk_over_shear(cube.stiffness, cube.coordinates) <= 2.0 * ratio


def test_share_of_the_diagonal():
    """Nodal diagonals of a material without bulk modulus and of a nearly incompressible one."""
    assert share_of_shear(NEARLY_INCOMPRESSIBLE, 3) == 1.0
    mu, lame = 1.0, 1000.0
    ratio = (lame + 2.0 * mu / 3.0) / mu
    assert share_of_shear(ratio, 3) == pytest.approx(4.0 * mu / (lame + 4.0 * mu), rel=1e-12)
    assert np.isclose(share_of_shear(lame + 1.0, 2), 3.0 / (lame + 3.0))

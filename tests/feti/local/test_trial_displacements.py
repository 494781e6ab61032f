"""Trial displacements of cubes: their energies by the moduli."""

import numpy as np
import pytest
import torn

from fenics_tfeti.feti.local.trial_displacements import TrialDisplacements, bending, strains

pytestmark = pytest.mark.once


def test_energies_of_strains(monkeypatch):
    """With Poisson's ratio 0 the strain has E |e|^2: of 2 for a stretch, of 1 for both shears."""
    monkeypatch.setattr(torn, "POISSON", 0.0)
    cube = torn.cube(2)
    every = np.arange(cube.size)
    trial = TrialDisplacements.build(cube.stiffness, cube.coordinates, every)
    assert trial.strains == 6
    energies = np.sort(trial.energies[:6]) / trial.energies[:6].min()
    np.testing.assert_allclose(energies, [1, 1, 1, 2, 2, 2], rtol=1e-9)
    np.testing.assert_allclose(
        np.sum(trial.values.T * (cube.stiffness @ trial.values.T), axis=0), trial.energies
    )
    assert trial.largest(np.ones(6)) == pytest.approx(1.0 / trial.energies[:6].min())


@pytest.mark.parametrize("gdim", [2, 3])
def test_numbers_and_rotation(gdim):
    """A rotated body has the same displacements, rotated."""
    x = np.random.default_rng(0).standard_normal((20, gdim)) * np.arange(1, gdim + 1)
    Q = np.linalg.qr(np.random.default_rng(1).standard_normal((gdim, gdim)))[0]
    for fields, number in ((strains, gdim * (gdim + 1) // 2), (bending, gdim * (gdim - 1))):
        u, rotated = fields(x), fields(x @ Q.T)
        assert u.shape == rotated.shape == (number, x.size)
        back = (rotated.reshape(number, *x.shape) @ Q).reshape(number, -1)
        # but for the signs of the axes
        np.testing.assert_allclose(np.abs(back), np.abs(u), atol=1e-12 * np.abs(u).max())

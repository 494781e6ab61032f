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
    energies = trial.energies.diagonal()[:6]
    np.testing.assert_allclose(np.sort(energies) / energies.min(), [1, 1, 1, 2, 2, 2], rtol=1e-9)
    np.testing.assert_allclose(
        trial.values @ (cube.stiffness @ trial.values.T),
        trial.energies,
        atol=1e-12 * trial.energies.max(),
    )
    assert trial.largest(np.identity(6)) == pytest.approx(1.0 / energies.min())


@pytest.mark.parametrize("gdim", [2, 3])
def test_sums_are_all_strains_and_bendings(gdim):
    """Also those along axes that are turned: the sums do not depend on the axes."""
    rng = np.random.default_rng(0)
    x = rng.standard_normal((20, gdim))
    a, b = np.linalg.qr(rng.standard_normal((gdim, gdim)))[0][:2]
    linear, curved = strains(x), bending(x)
    assert (len(linear), len(curved)) == {2: (3, 4), 3: (6, 15)}[gdim]
    y = x - x.mean(axis=0)
    strain = np.outer(y @ b, a) + np.outer(y @ a, b)
    bent = np.outer(0.5 * (y @ a) ** 2, b) - np.outer((y @ a) * (y @ b), a)
    for rows, u in ((linear, strain), (curved, bent)):
        missing = np.linalg.lstsq(rows.T, u.ravel(), rcond=None)[0] @ rows - u.ravel()
        assert np.abs(missing).max() <= 1e-12


@pytest.mark.parametrize("shift", [0.1, 1e3])
def test_estimates_do_not_depend_on_the_origin(shift):
    """The principal axes of a cube are any."""
    cube = torn.cube(3)
    found = []
    for x in (cube.coordinates, cube.coordinates + shift):
        trial = TrialDisplacements.build(cube.stiffness, x, np.arange(cube.size))
        u = trial.values
        found.append([trial.largest(u[:k] @ u[:k].T) for k in (trial.strains, len(u))])
    np.testing.assert_allclose(*found, rtol=1e-9)


def test_estimates_of_a_rotated_mesh_are_the_same():
    """A plate, whose bending and twist have different energies, in another frame."""
    cube, Q = torn.cube(3), np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    x = cube.coordinates * [1.0, 1.0, 0.1]
    turn = np.kron(np.identity(len(x)), Q)
    found = []
    for K, places in ((cube.stiffness, x), (turn @ cube.stiffness @ turn.T, x @ Q.T)):
        trial = TrialDisplacements.build(K, places, np.arange(cube.size))
        u = trial.values
        found.append([trial.largest(u[:k] @ u[:k].T) for k in (trial.strains, len(u))])
    np.testing.assert_allclose(*found, rtol=1e-9)

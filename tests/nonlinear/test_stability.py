"""Equilibria that are not stable are told, against eigenvalues of the dense tangent."""

import numpy as np
import pytest
from finite_strains import leaning_column, pressed_patch

import ufl
from dolfinx import fem
from dolfinx.fem import petsc

from fenics_tfeti.models import neo_hookean

pytestmark = pytest.mark.once


def is_told(scene):
    return any("the equilibrium is not stable" in text for text in scene.problem.report.to_check)


def least_eigenvalue(scene):
    """Return that of the tangent of a column whose top stays on the plane."""
    u, V = scene.problem.u, scene.problem.space
    W = neo_hookean(1.0, 0.3)(u) * ufl.dx(metadata={"quadrature_degree": 3})
    v, du = ufl.TestFunction(V), ufl.TrialFunction(V)
    K = petsc.assemble_matrix(fem.form(ufl.derivative(ufl.derivative(W, u, v), u, du)))
    K.assemble()
    y = np.repeat(V.tabulate_dof_coordinates()[:, 1], 2)
    held = np.isclose(y, 0.0) | (np.isclose(y, 1.0) & (np.arange(y.size) % 2 == 1))
    free = np.flatnonzero(~held)
    return np.linalg.eigvalsh(K.convert("dense").getDenseArray()[np.ix_(free, free)])[0]


def test_column_that_stays_straight():
    """Pressed by a plane, beyond its buckling load."""
    scene, least = leaning_column(lean=0.0, newton_rtol=1e-8), []
    for load in (0.05, 0.1, 0.15, 0.2):
        scene.solve([load])
        least.append(least_eigenvalue(scene))
        assert is_told(scene) == (least[-1] < 0.0)
    assert least[0] > 0.0 > least[-1]
    (text,) = (text for text in scene.problem.report.to_check if "stable" in text)
    assert "largest at (0.05, 1)" in text or "largest at (0, 1)" in text or "(0.1, 1)" in text


@pytest.mark.ranks(1, 2)
def test_column_of_many_subdomains():
    """A set-up is of the state that a load step begins with: the next step tells at the latest."""
    scene = leaning_column(lean=0.0, subdomain_size=20)
    scene.solve([0.05, 0.2])
    scene.solve([0.22])
    assert is_told(scene)


def test_column_that_has_buckled():
    scene = leaning_column()
    scene.solve([0.5, 1.0])
    assert not is_told(scene)


def test_patch_that_contact_keeps_stable():
    """Tangents of the bodies alone are not positive at the end; forces that turn make up for it."""
    scene, _ = pressed_patch(0.4, False, newton_rtol=1e-8)
    for load in (0.5, 1.0):
        scene.solve([load])
        assert not is_told(scene)

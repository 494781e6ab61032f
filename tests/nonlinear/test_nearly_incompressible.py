"""Rubber whose volume hardly changes, with few points for the volumetric term."""

from mpi4py import MPI

import numpy as np
import pytest
from pressurised import pressure_on_incompressible_tube, tube

import ufl
from dolfinx import fem

from fenics_tfeti import InputError
from fenics_tfeti.io import Box, boxes, displacement_space
from fenics_tfeti.models import nearly_incompressible_energy, neo_hookean


def opened(energy, degree=1, n=6):
    """Return the tube under a third of its load, and its opening."""
    scene = tube("plane", degree, n, energy=energy)
    for load in (0.1, 0.2, 1 / 3):
        scene.set_load(load)
        scene.problem.solve()
    return scene, np.abs(scene.u.x.array).max()


@pytest.mark.parametrize(("degree", "n"), [(1, 6), (2, 3)])
def test_thick_tube_opens_as_the_formula_says(degree, n):
    scene, opening = opened(lambda u: nearly_incompressible_energy(1.0, 0.4999, u), degree, n)
    assert 0.04 < opening < 0.2
    pressure = pressure_on_incompressible_tube(opening)
    assert scene.pressure.value == pytest.approx(pressure, rel=0.015)


def test_full_integration_locks():
    """And the problem says so."""
    dx = ufl.dx(metadata={"quadrature_degree": 2})
    with pytest.warns(UserWarning, match="lock at a Poisson's ratio of 0.4999"):
        _, opening = opened(lambda u: neo_hookean(1.0, 0.4999)(u) * dx)
    assert opening < 0.02


@pytest.mark.parametrize(("cell", "degree"), [("quadrilateral", 1), ("triangle", 2)])
def test_energy_of_uniform_strains_is_that_of_neo_hookean(cell, degree):
    mesh = boxes(MPI.COMM_SELF, [Box((0, 0), (1, 1), (2, 2))], cell).mesh
    u = fem.Function(displacement_space(mesh, degree))
    u.interpolate(lambda x: np.stack([0.1 * x[0] + 0.2 * x[1], -0.1 * x[0]]))
    energies = nearly_incompressible_energy(2.0, 0.49, u), neo_hookean(2.0, 0.49)(u) * ufl.dx
    # terms with different rules are compiled apart
    parts = [ufl.Form([part]) for form in energies for part in form.integrals()]
    *reduced, whole = (fem.assemble_scalar(fem.form(part)) for part in parts)
    assert sum(reduced) == pytest.approx(whole, rel=1e-10)


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_simplices_of_degree_1(cell):
    dim = 2 if cell == "triangle" else 3
    mesh = boxes(MPI.COMM_SELF, [Box((0,) * dim, (1,) * dim, (1,) * dim)], cell).mesh
    u = fem.Function(displacement_space(mesh))
    with pytest.raises(InputError, match=f"cells of the type {cell} with displacements of degree"):
        nearly_incompressible_energy(1.0, 0.4999, u)
    with pytest.raises(InputError, match="nearly_incompressible_energy: u is a float"):
        nearly_incompressible_energy(1.0, 0.4999, 1.0)

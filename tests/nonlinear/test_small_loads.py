"""Loads that hardly strain: the answers of a linear problem with exact non-penetration."""

import numpy as np
import pytest
from finite_strains import indented_block, ironing

import ufl

from fenics_tfeti import ContactProblem, Coulomb, Deformed
from fenics_tfeti.models import isotropic, small_strain

pytestmark = pytest.mark.once

DEPTH = 1e-5


def linear(problem):
    """Solve the same contacts between linear elastic bodies."""
    u, v = ufl.TrialFunction(problem.space), ufl.TestFunction(problem.space)
    a = ufl.inner(isotropic(1.0, 0.3)(u), small_strain(v)) * ufl.dx
    same = ContactProblem(
        a,
        0.0,
        bcs=problem.bcs,
        contacts=problem.contacts,
        gaps=Deformed(tolerance=1e-7),
        options={"rtol": 1e-8},
    )
    same.solve()
    return same


def agree(problem):
    """Compare forces and displacements with those of the linear problem."""
    same = linear(problem)
    force, expected = problem.results[0].force, same.results[0].force
    np.testing.assert_allclose(force, expected, rtol=0, atol=1e-4 * np.linalg.norm(expected))
    np.testing.assert_allclose(problem.u.x.array, same.u.x.array, rtol=0, atol=1e-4 * DEPTH)


@pytest.mark.parametrize(
    ("dim", "n", "cell", "degree"),
    [
        (2, 8, "quadrilateral", 1),
        (2, 4, "triangle", 2),
        (3, 2, "hexahedron", 1),
        (3, 2, "tetrahedron", 1),
    ],
)
def test_obstacle(dim, n, cell, degree):
    """A flat paraboloid."""

    def tool(x):
        across = x[: dim - 1]
        normal = np.vstack([across / 500.0, -np.ones(x.shape[1])])
        length = np.linalg.norm(normal, axis=0)
        gap = 1.0 - DEPTH + (across**2).sum(axis=0) / 1000.0 - x[dim - 1]
        return gap / length, normal / length

    scene = indented_block(
        dim, n, cell=cell, degree=degree, obstacle=tool, newton_rtol=1e-8, subdomain_size=100
    )
    scene.solve([1.0])
    agree(scene.problem)


@pytest.mark.parametrize("friction", [None, Coulomb(0.3)])
def test_pair(friction):
    scene = ironing(friction, n=6, stiffness=1.0, newton_rtol=1e-8, subdomain_size=100)
    scene.solve([DEPTH / 0.3])
    agree(scene.problem)

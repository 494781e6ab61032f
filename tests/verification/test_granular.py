"""Coulomb's law on bodies that contact and friction alone hold."""

from mpi4py import MPI

import numpy as np
import pytest
from granular import grains, grains_in_space, packing

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem

pytestmark = pytest.mark.once

WEIGHT = {"grains": 2600.0 * 9.81, "packing": 1.0}

SCENES = {
    "grains": (lambda comm, **o: grains(12, 0.1, 0.3, comm, **o), 150),
    "grains that slip": (lambda comm, **o: grains(12, 0.1, 0.2, comm, **o), 170),
    "more grains": (lambda comm, **o: grains(30, 0.05, 0.3, comm, **o), 130),
    # steps that begin far from the forces
    "coarse grains": (lambda comm, **o: grains(30, 0.1, 0.3, comm, **o), 90),
    "packing": (lambda comm, **o: packing(2, 3, 1e-3, 0.6, comm, **o), 80),
    "regular packing": (lambda comm, **o: packing(3, 2, 0.0, 0.3, comm, **o), 80),
}


def volume(problem: ContactProblem) -> float:
    mesh = problem.u.function_space.mesh
    one = fem.Constant(mesh, 1.0)
    return float(mesh.comm.allreduce(fem.assemble_scalar(fem.form(one * ufl.dx))))


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.ranks] * (name in ("grains that slip", "packing")))
        for name in SCENES
    ],
)
def test_certified_in_few_products_and_in_balance(name):
    scene, products = SCENES[name]
    problem = scene(MPI.COMM_WORLD)
    problem.solve()
    report = problem.report
    assert report.certificate.worst <= 1e-6
    # on several ranks bodies are cut
    if MPI.COMM_WORLD.size == 1:
        assert report.products["total"] <= products
    walls = [c.force for c in report.contacts if " on " not in c.name]
    weight = WEIGHT["packing" if "packing" in name else "grains"] * volume(problem)
    total = np.sum(walls, axis=0)
    size = np.sum([np.linalg.norm(force) for force in walls])
    np.testing.assert_allclose(np.abs(total), [0.0, weight], atol=1e-5 * size)


@pytest.mark.heavy
def test_grains_in_space():
    """Their active sets do not end: bounds that follow the forces go on."""
    problem = grains_in_space((2, 1, 1), 0.3, 0.3)
    problem.solve()
    report = problem.report
    assert report.certificate.worst <= 1e-6
    walls = np.array([c.force for c in report.contacts if " on " not in c.name])
    size = np.linalg.norm(walls, axis=1).sum()
    weight = WEIGHT["grains"] * volume(problem)
    np.testing.assert_allclose(np.abs(walls.sum(axis=0)), [0.0, 0.0, weight], atol=1e-5 * size)


def test_displacement_is_that_of_the_fixed_point():
    """A packing that the active set method solves, too."""
    found = packing(2, 2, 0.0, 0.3)
    expected = packing(2, 2, 0.0, 0.3, method="smalbe")
    u, v = found.solve().x.array, expected.solve().x.array
    assert len(expected.report.slip_bounds) > 1 == len(found.report.slip_bounds)
    np.testing.assert_allclose(u, v, atol=1e-4 * np.abs(v).max())


def test_next_step_with_the_same_load_slips_no_further():
    problem = packing(2, 3, 1e-3, 0.3)
    first = problem.solve().x.array.copy()
    problem.advance()
    np.testing.assert_allclose(problem.solve().x.array, first, atol=1e-6 * np.abs(first).max())


def test_discs_that_are_cut():
    """Each into four subdomains: the displacement is that of whole ones, in 1.1 times the products.

    The preconditioner of the face of glued rows takes the place of the identity there.
    """
    whole, cut = (packing(2, 2, 1e-4, 0.3, subdomain_size=size) for size in (10_000, 300))
    u, v = whole.solve().x.array, cut.solve().x.array
    assert cut.report.subdomains == 4 * whole.report.subdomains
    assert cut.report.products["total"] <= 80
    np.testing.assert_allclose(v, u, atol=1e-6 * np.abs(u).max())

"""A block pressed in by a rigid ball by a third of its height, against plain dolfinx and SciPy."""

import numpy as np
import pytest
from finite_strains import indented_block, rotation

import ufl

heavy = pytest.mark.heavy

# (dimension, cells along the height, nu): (vertical force, strain energy)
REFERENCES = {
    (2, 8, 0.3): (0.351780904, 0.044085597),
    (2, 8, 0.45): (0.455382296, 0.056941146),
    (2, 16, 0.3): (0.354499336, 0.044453877),
    (2, 16, 0.45): (0.454031963, 0.056578295),
    (3, 3, 0.3): (0.164758922, 0.019315266),
    (3, 4, 0.3): (0.218769199, 0.024488602),
    (3, 4, 0.45): (0.244196484, 0.027575479),
}
THIRDS = [1 / 3, 2 / 3, 1.0]


def check(scene, block, turned=0.0):
    force, energy = REFERENCES[block]
    expected = rotation(turned, block[0])[:, -1] * -force
    np.testing.assert_allclose(scene.problem.results[0].force, expected, atol=1e-7)
    assert scene.energy == pytest.approx(energy, abs=1e-7)


@heavy
@pytest.mark.parametrize("size", [200, 3000])
@pytest.mark.parametrize("block", REFERENCES)
def test_force_and_energy(block, size):
    scene = indented_block(*block, newton_rtol=1e-8, subdomain_size=size)
    scene.solve(THIRDS)
    check(scene, block)


def test_one_load_step_of_a_turned_block_gives_the_same():
    """Forces turn with everything else."""
    scene = indented_block(3, 3, 0.3, newton_rtol=1e-8, subdomain_size=200, turned=37.0)
    scene.solve([1.0])
    check(scene, (3, 3, 0.3), 37.0)
    assert scene.counts()[0] <= 12


def test_small_subdomains():
    """They share a matrix until they are deformed; compression drives rotations of them."""
    scene = indented_block(newton_rtol=1e-8, subdomain_size=60)
    torn = scene.problem._torn.torn
    assert len({id(part.stiffness) for part in torn.subdomains}) < len(torn.subdomains)
    for load in THIRDS:
        scene.solve([load])
        assert max(step.negative for step in scene.problem.report.newton) > 0
    assert len({id(part.stiffness) for part in torn.subdomains}) == len(torn.subdomains)
    check(scene, (2, 8, 0.3))


def test_turned_block_of_degree_2():
    forces = []
    for turned in [0.0, 37.0]:
        scene = indented_block(2, 3, degree=2, turned=turned, newton_rtol=1e-9, subdomain_size=100)
        scene.solve([1.0])
        forces.append(rotation(turned).T @ scene.problem.results[0].force)
    np.testing.assert_allclose(forces[1], forces[0], atol=1e-8)


@pytest.mark.parametrize("first", [pytest.param(1 / 6, marks=heavy), 1.0])
def test_nearly_incompressible(first):
    """Its volumetric energy is integrated by one point of each cell; no load step is cut."""

    def energy(u, nu=0.499):
        mu, lmbda = 1 / (2 * (1 + nu)), nu / ((1 + nu) * (1 - 2 * nu))
        F = ufl.Identity(2) + ufl.grad(u)
        log = ufl.ln(ufl.det(F))
        one_point = ufl.dx(metadata={"quadrature_degree": 0})
        shear = mu / 2 * (ufl.inner(F, F) - 2) - mu * log
        return shear * ufl.dx + lmbda / 2 * log**2 * one_point

    scene = indented_block(n=4, energy=energy, newton_rtol=1e-8, subdomain_size=60)
    assert list(scene.problem.steps(scene.set_load, 0.0, 1.0, first=first))[0] == first
    assert scene.problem.results[0].force[1] == pytest.approx(-0.387400069, abs=1e-7)
    assert scene.energy == pytest.approx(0.052013656, abs=1e-7)

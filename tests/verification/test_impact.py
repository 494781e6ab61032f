"""Impact in time steps: waves in bars, Hertz's ball that bounces, a block that slides to rest."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from moving_bodies import SPEED, Motion, draw_meridian, two_bars

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Coulomb, Plane, RigidObstacle
from fenics_tfeti.io import Box, boxes, displacement_space, read_msh, tag_facets
from fenics_tfeti.models import (
    axisymmetric_strain,
    isotropic,
    redistributed_density,
    small_strain,
    symmetry_plane,
)

KEPT = ["factors", "coarse problem", "norm", "multipliers"]


@pytest.mark.heavy
@pytest.mark.once
@pytest.mark.parametrize(("n", "courant", "steps"), [(40, 0.5, 184), (200, 0.5, 1000)])
def test_two_bars_exchange_their_velocities(n, courant, steps):
    """The contact ends when the waves come back, at 2L/c, with the force rho c v / 2 till then."""
    motion, momenta, h = two_bars(n, courant)
    times, forces, energies = motion.dt * np.arange(1, steps + 1), [], []
    for _ in range(steps):
        forces.append(motion.step() / (h * SPEED))
        energies.append(motion.energy / (h * SPEED**2 / 2))
    pressed = np.array(forces) > 1e-6
    assert pressed[0]
    assert np.count_nonzero(np.diff(pressed)) == 1
    tolerance = 0.01 if n > 100 else 0.02
    assert times[pressed][-1] == pytest.approx(2.0, rel=tolerance)
    velocities = [motion.total(momentum) / (h * SPEED) for momentum in momenta]
    np.testing.assert_allclose(velocities, [0.0, 1.0], atol=0.01)
    np.testing.assert_allclose(energies, 1.0, atol=0.005)
    plateau = np.array(forces)[(times > 0.3) & (times < 1.7)]
    np.testing.assert_allclose(plateau, 0.5, rtol=0.01)


def test_momentum_and_energy_without_damping():
    motion, momenta, h = two_bars(20, 1.0, alpha=0.0)
    for step in range(45):
        motion.step()
        # nothing is assembled or factorised after the first step
        assert step == 0 or motion.problem.report.reused == KEPT
        assert sum(motion.total(m) for m in momenta) == pytest.approx(h * SPEED, rel=1e-6)
        assert motion.energy == pytest.approx(h * SPEED**2 / 2, rel=0.005)


@pytest.mark.ranks(2)
def test_bars_on_several_ranks():
    """Subdomains, and ranks, change nothing."""
    motion, _, _ = two_bars(12, 1.0, comm=MPI.COMM_WORLD, options={"subdomain_size": 20})
    alone, _, _ = two_bars(12, 1.0)
    for _ in range(4):
        assert motion.step() == pytest.approx(alone.step(), rel=1e-3, abs=1e-5 * SPEED)
    assert motion.energy == pytest.approx(alone.energy, rel=1e-4)


shallow = pytest.param(0.0025, 60, marks=[pytest.mark.heavy])


@pytest.mark.once
@pytest.mark.parametrize(("approach", "steps"), [(0.01, 30), shallow])
def test_ball_that_bounces(approach, steps, tmp_path):
    """Hertz's impact in so many steps, within 5 %, as long as waves are much faster.

    The finite ball is stiffer than the half space of the formula: its force is larger and its
    impact shorter by about a / 2R. Elements of a/5 are enough. The end of the impact is between two
    steps, where F^(2/3), which is proportional to the approach, goes through zero.
    """
    R, E, nu, rho = 1.0, 1.0, 0.3, 1.0
    a, dt = np.sqrt(R * approach), 1 / steps
    E_star, mass = E / (1 - nu**2), 4 / 3 * np.pi * R**3 * rho
    speed = np.sqrt(16 / 15 * E_star * np.sqrt(R) * approach**2.5 / mass)
    time = 2.9432 * approach / speed
    draw_meridian(tmp_path / "ball.msh", R, 0.2 * a, 1.2 * a)
    mesh = read_msh(tmp_path / "ball.msh", MPI.COMM_SELF, gdim=2).mesh

    def near(x):
        return np.isclose(np.hypot(x[0], x[1] - R), R) & (np.hypot(x[0], x[1]) < 1.5 * a)

    tags = tag_facets(mesh, {1: lambda x: np.isclose(x[0], 0), 2: near})
    contacts = [RigidObstacle(tags, 2, Plane((0, 0), (0, 1)))]
    V, weight = displacement_space(mesh), 2 * ufl.pi * ufl.SpatialCoordinate(mesh)[0]
    density = redistributed_density(mesh, rho, contacts, weight)
    sigma, bc = isotropic(E, nu, axisymmetric_strain), symmetry_plane(V, tags, 1, axis=0)
    motion = Motion(
        lambda a, L: ContactProblem(a, L, bcs=bc, contacts=contacts, measure_weight=weight),
        lambda u, w: ufl.inner(sigma(u), axisymmetric_strain(w)) * weight * ufl.dx,
        lambda a, w: density * ufl.inner(a, w) * weight * ufl.dx,
        V,
        dt * time,
    )
    motion.v.x.array[1::2] = -speed
    start, momentum = motion.energy, fem.form(density * motion.v[1] * weight * ufl.dx)
    before = motion.total(momentum)
    forces, energies = [], []
    for _ in range(round(1.1 * steps)):
        forces.append(motion.step())
        energies.append(motion.energy / start)
    pressed = np.flatnonzero(np.array(forces) > 1e-3 * max(forces))
    assert pressed.tolist() == list(range(len(pressed)))
    last, end = np.array(forces)[pressed[-2:]] ** (2 / 3)
    duration = (len(pressed) + end / (last - end)) * dt
    finite = 0.5 * a / R
    assert duration == pytest.approx(1.0, abs=0.05)
    assert duration == pytest.approx(1.0 - finite, abs=0.012)
    peak = 4 / 3 * E_star * approach**1.5
    assert max(forces) == pytest.approx((1 + finite) * peak, rel=0.015)
    assert motion.total(momentum) == pytest.approx(-before, rel=0.002)
    np.testing.assert_allclose(energies, 1.0, atol=0.005)


@pytest.mark.once
@pytest.mark.parametrize("steps", [20, pytest.param(160, marks=pytest.mark.heavy)])
def test_block_that_slides_to_rest(steps):
    """The way v^2 / (2 mu g). It starts with the stresses of steady sliding, so that it is quiet.

    These are those of the block that is pushed by mu times its weight, while the plane moves back.
    """
    E, nu, rho, g, mu, speed = 1e7, 0.3, 1e3, 10.0, 0.3, 2.0
    mesh = boxes(MPI.COMM_SELF, [Box((0, 0), (0.2, 0.1), (8, 4))], "quadrilateral").mesh
    tags = tag_facets(mesh, {1: lambda x: np.isclose(x[1], 0), 2: lambda x: np.isclose(x[1], 0.1)})
    contact = RigidObstacle(tags, 1, Plane((0, 0), (0, 1)), friction=Coulomb(mu))
    V, sigma = displacement_space(mesh), isotropic(E, nu)
    density = redistributed_density(mesh, rho, [contact])

    def elastic(u, w):
        return ufl.inner(sigma(u), small_strain(w)) * ufl.dx

    def inertia(a, w):
        return density * ufl.inner(a, w) * ufl.dx

    held = fem.locate_dofs_topological(V.sub(0), 1, tags.find(2))[:1]
    u, w = ufl.TrialFunction(V), ufl.TestFunction(V)
    steady = ContactProblem(
        elastic(u, w),
        inertia(ufl.as_vector((mu * g, -g)), w),
        bcs=fem.dirichletbc(0.0, held, V.sub(0)),
        contacts=replace(contact, displacement=(-1.0, 0.0)),
    )
    motion = Motion(
        lambda a, L: ContactProblem(a, L, contacts=contact),
        elastic,
        inertia,
        V,
        speed / (mu * g) / steps,
        load=lambda w: inertia(ufl.as_vector((0.0, -g)), w),
    )
    motion.u.x.array[:] = steady.solve().x.array
    motion.v.x.array[::2], motion.a.x.array[::2] = speed, -mu * g
    centre = fem.form(density * motion.u[0] * ufl.dx)
    mass, begin = rho * 0.02, motion.total(centre)
    for step in range(round(1.1 * steps)):
        motion.step()
        friction = motion.problem.results[0].force
        if step < steps - 1:
            assert friction[0] == pytest.approx(-mu * friction[1], rel=1e-3)
    way = (motion.total(centre) - begin) / mass
    assert way == pytest.approx(speed**2 / (2 * mu * g), rel=0.005)
    assert np.abs(motion.v.x.array[::2]).max() < 0.01 * speed

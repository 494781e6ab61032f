"""Time steps with inertia: what is kept in free flight, and in impacts."""

from mpi4py import MPI

import numpy as np
import pytest
from moving_rubber import Motion

import ufl
from dolfinx import fem

from fenics_tfeti import InputError
from fenics_tfeti.models import EnergyMomentumStep, neo_hookean, neo_hookean_of_strain

COMM = MPI.COMM_WORLD


def spinning(x):
    """Return a velocity of a rotation with a stretch."""
    return np.stack([0.1 * x[0] - x[1], x[0] + 0.05 * x[0] * x[1], 0.2 * x[0] - 0.1 * x[2]])


@pytest.mark.parametrize(("dim", "dt", "steps"), [(2, 0.1, 12), (2, 0.5, 6), (3, 0.2, 2)])
def test_free_body_keeps_energy_and_momenta(dim, dt, steps):
    """Whatever the step: half a radian in the second case."""
    motion = Motion(dim, dt=dt, n=4 if dim == 2 else 2)
    motion.throw(spinning)
    energy, momenta = sum(motion.step.energies()), motion.momenta()
    for _ in range(steps):
        motion.advance()
        assert len(motion.problem.report.newton) <= 4 if dt < 0.5 else 7
    assert motion.step.energies()[1] > 0.001 * energy
    assert sum(motion.step.energies()) == pytest.approx(energy, rel=1e-9)
    np.testing.assert_allclose(motion.momenta(), momenta, atol=1e-9 * np.abs(momenta).max())


def test_dead_load_does_its_work():
    """A block in free fall: its place is exact, and it stays unstrained."""
    motion = Motion(load=(0.3, -1.0), dt=0.1)
    for _ in range(5):
        motion.advance()
    fall = motion.u.x.array.reshape(-1, 2)
    np.testing.assert_allclose(fall, [[0.3 * 0.125, -0.125]] * len(fall), atol=1e-12)
    assert motion.step.energies()[1] < 1e-20


def falling(x):
    return np.stack([0.0 * x[0], -0.3 + 0.0 * x[0], 0.0 * x[0]])


@pytest.mark.once
@pytest.mark.parametrize(("mass", "steps"), [("moved", 40), ("at nodes", 12)])
def test_no_energy_comes_from_a_plane(mass, steps):
    """What is lost is that of nodes which stop, and of cells without mass."""
    motion = Motion(floor="plane", mass=mass)
    motion.throw(falling)
    energies, forces = [sum(motion.step.energies())], []
    for _ in range(steps):
        motion.advance()
        energies.append(sum(motion.step.energies()))
        forces.append(motion.problem.results[0].force[1])
    assert np.diff(energies).max() < 1e-9 * energies[0]
    assert energies[-1] > 0.85 * energies[0]
    if mass == "moved":
        # one contact, with a force that changes little in a step
        pressed = np.flatnonzero(np.array(forces) > 1e-9)
        assert np.all(np.diff(pressed) == 1) and pressed[-1] < steps - 1
        assert np.abs(np.diff(forces)).max() < 0.2 * max(forces)
        assert motion.momenta()[1] > 0.2


@pytest.mark.once
def test_two_blocks_exchange_their_momenta():
    """The energy of one of them falls, at no step it grows."""
    motion = Motion(floor="block", dt=0.15, n=3)
    motion.throw(falling)
    energies, momenta = [sum(motion.step.energies())], motion.momenta()
    for _ in range(16):
        motion.advance()
        energies.append(sum(motion.step.energies()))
    assert not motion.problem.results[0].active.any()
    np.testing.assert_allclose(motion.momenta(), momenta, atol=1e-9)
    assert np.diff(energies).max() < 1e-9 * energies[0]
    assert motion.momenta(2)[1] == pytest.approx(momenta[1], rel=0.15)


@pytest.mark.ranks(2)
def test_impact_on_several_ranks():
    found = []
    for comm in (COMM, MPI.COMM_SELF):
        motion = Motion(floor="plane", comm=comm, subdomain_size=20)
        motion.throw(falling)
        for _ in range(4):
            motion.advance()
        found.append([*motion.step.energies(), motion.problem.results[0].force[1]])
    np.testing.assert_allclose(*found, rtol=1e-7)


def test_wrong_arguments():
    u = Motion().u
    energy = neo_hookean_of_strain(1.0, 0.3)
    with pytest.raises(InputError, match="energy is a float; a function of C"):
        EnergyMomentumStep(1.0, u, 1.0, 0.1)
    with pytest.raises(InputError, match="u is a str; the displacement"):
        EnergyMomentumStep(energy, "u", 1.0, 0.1)
    for dt in (0.0, -1.0, "0.1"):
        with pytest.raises(InputError, match="dt is .*; a positive number is expected"):
            EnergyMomentumStep(energy, u, 1.0, dt)


def test_energy_of_strain_is_that_of_the_displacement():
    u = Motion().u
    u.interpolate(lambda x: np.stack([0.1 * x[0] * x[1], 0.3 * x[1] - 0.2 * x[0]]))
    F = ufl.Identity(2) + ufl.grad(u)
    densities = neo_hookean(2.0, 0.3)(u), neo_hookean_of_strain(2.0, 0.3)(F.T * F)
    dx = ufl.dx(metadata={"quadrature_degree": 2})
    one, other = (fem.assemble_scalar(fem.form(density * dx)) for density in densities)
    assert one == pytest.approx(other, rel=1e-12)

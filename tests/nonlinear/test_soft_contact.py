"""Soft contact at finite strains: columns of uniform stress, and a die that irons a block."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from columns import FOOT, MESHES, YOUNG, columns, pulled
from finite_strains import ironing
from scenes import plane
from scipy.optimize import brentq

import ufl
from dolfinx import fem

from fenics_tfeti import Coulomb, InputError, NonlinearContactProblem, SoftContact

OPTIONS = {"newton_rtol": 1e-9, "subdomain_size": 60}


def soft_columns(cell, upper, stiffness, comm=MPI.COMM_SELF):
    """Return columns with a soft layer, of a material without lateral strain, and their top."""
    scene = columns(cell, upper, comm)
    moved = pulled(scene, 0.0)
    scene.add_pair(law=SoftContact(stiffness), name="layer")
    u = fem.Function(scene.V)
    F = ufl.Identity(scene.gdim) + ufl.grad(u)
    stress = F * (0.5 * YOUNG * (F.T * F - ufl.Identity(scene.gdim)))
    residual = ufl.inner(stress, ufl.grad(scene.v)) * scene.dx
    problem = NonlinearContactProblem(
        residual, u, bcs=scene.bcs, contacts=scene.contacts, options=OPTIONS
    )
    return problem, moved


def in_series(stiffness: float, moved: float) -> float:
    """Return the pressure of two columns and the layer, whose top has moved down."""

    def shortened(pressure: float) -> float:
        def lacking(d: float) -> float:
            return 0.5 * YOUNG * (1.0 - (1.0 - d) ** 2) * (1.0 - d) - pressure

        return brentq(lacking, 0.0, 0.4)

    return brentq(lambda p: 2.0 * shortened(p) + p / stiffness - moved, 0.0, 0.19 * YOUNG)


def press(problem, moved, displacement):
    gdim = moved.function_space.dofmap.index_map_bs
    moved.x.array.reshape(-1, gdim)[:, -1] = -displacement
    problem.solve()
    return problem.results["layer"]


@MESHES
@pytest.mark.parametrize("stiffness", [50.0, 5e4])
def test_columns(cell, upper, stiffness):
    """Pressed by a tenth, less, apart and pressed again: no more Newton steps than hard contact."""
    problem, moved = soft_columns(cell, upper, stiffness)
    for displacement in (0.1, 0.2, 0.02, -0.05, 0.1):
        layer = press(problem, moved, displacement)
        pressure = in_series(stiffness, displacement) if displacement > 0.0 else 0.0
        np.testing.assert_allclose(layer.pressure, pressure, rtol=1e-7, atol=1e-10)
        opening = -pressure / stiffness if pressure else -displacement
        np.testing.assert_allclose(layer.opening, opening, rtol=1e-6)
        assert layer.active.all() == (displacement > 0.0)
        assert len(problem.report.newton) <= 6


@pytest.mark.ranks(2, 3)
def test_columns_on_several_ranks():
    problem, moved = soft_columns("quadrilateral", 5, 500.0, MPI.COMM_WORLD)
    layer = press(problem, moved, 0.1)
    np.testing.assert_allclose(layer.pressure, in_series(500.0, 0.1), rtol=1e-7)


@pytest.mark.once
@pytest.mark.parametrize("friction", [None, Coulomb(0.3)])
def test_die_that_is_dragged(friction):
    """Each node follows the law on the deformed surface; a stiff layer is hard contact."""
    forces, steps = {}, {}
    for stiffness in (None, 1e6, 10.0, 0.1):
        scene = ironing(friction, n=8, newton_rtol=1e-9, subdomain_size=400)
        law = stiffness and SoftContact(stiffness)
        scene.problem.contacts = [replace(scene.problem.contacts[0], law=law)]
        scene.solve([0.5, 1.0, 1.1])
        result = scene.problem.results[0]
        forces[stiffness], steps[stiffness] = result.force, scene.counts()[0]
        np.testing.assert_allclose(
            result.force, -np.array(scene.problem.report.reactions[1].force), atol=1e-9
        )
        if stiffness:
            depth = np.maximum(-result.opening, 0.0)
            np.testing.assert_allclose(result.pressure, stiffness * depth, atol=1e-5)
    np.testing.assert_allclose(forces[1e6], forces[None], rtol=1e-4)
    assert forces[0.1][1] < 0.2 * forces[10.0][1] < 0.2 * forces[None][1]
    assert steps[0.1] <= steps[10.0] <= steps[None]


def test_body_on_a_soft_floor():
    """Its weight over the area is the pressure; it may slide freely."""
    scene = columns("quadrilateral")
    scene.bcs = []
    u = fem.Function(scene.V)
    F = ufl.Identity(2) + ufl.grad(u)
    stress = F * (0.5 * YOUNG * (F.T * F - ufl.Identity(2)))
    load = ufl.inner(fem.Constant(scene.mesh, np.array([0.0, -3.0])), scene.v) * scene.dx
    residual = ufl.inner(stress, ufl.grad(scene.v)) * scene.dx - load
    scene.add_pair(name="joint")
    scene.add_obstacle(FOOT, plane(1, 2), law=SoftContact(40.0), name="floor")
    problem = NonlinearContactProblem(residual, u, contacts=scene.contacts, options=OPTIONS)
    problem.solve()
    floor = problem.results["floor"]
    np.testing.assert_allclose(floor.pressure, 6.0, rtol=1e-7)
    np.testing.assert_allclose(floor.opening, -6.0 / 40.0, rtol=1e-7)


def test_no_derivatives_of_it():
    problem, moved = soft_columns("quadrilateral", 4, 500.0)
    press(problem, moved, 0.05)
    with pytest.raises(InputError, match="layer: derivatives at finite strains know no"):
        problem.tangent({moved: np.ones(moved.x.array.size)})

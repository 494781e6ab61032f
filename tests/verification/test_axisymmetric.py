"""Axisymmetric forms: pressures by formulas, with the factors 2 pi r and r of the measures."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import (
    GROUND,
    LOADED,
    MASTER,
    SIDE_X,
    SIDE_Y,
    SLAVE,
    Scene,
    at,
    axisymmetric_strain,
    elasticity,
    plane,
)

import ufl

YOUNG, POISSON = 2e9, 0.3


def radius(mesh):
    return ufl.SpatialCoordinate(mesh)[0]


def whole(mesh):
    """The forms integrate over the circumference."""
    return 2 * ufl.pi * radius(mesh)


def pressed_cylinder(cell, weight):
    """Press the end of a full cylinder, R = 0.5 m, H = 1 m, onto a plane by 1 mm."""
    marks = [(GROUND, at(1, 0.0)), (LOADED, at(1, 1.0)), (SIDE_X, at(0, 0.0))]
    scene = Scene.of_boxes(MPI.COMM_SELF, cell, [((0, 0), (0.5, 1), (4, 6))], marks, young=YOUNG)
    scene.fix(SIDE_X, 0)
    scene.fix(LOADED, 1, -1e-3)
    scene.add_obstacle(GROUND, plane(1, 2))
    return solved(scene, weight, cell_tags=None, options={"rtol": 1e-10})


def solved(scene, weight, **arguments):
    factor = weight(scene.mesh)
    scene.a = elasticity(scene.u, scene.v, scene.young * factor, strain=axisymmetric_strain)
    problem = scene.problem(measure_weight=factor, **arguments)
    problem.solve()
    return problem


@pytest.mark.parametrize(
    ("cell", "weight", "angle"), [("triangle", whole, 2 * np.pi), ("quadrilateral", radius, 1.0)]
)
def test_uniform_pressure_on_the_end_of_a_cylinder(cell, weight, angle):
    """The stress is uniaxial and the displacement linear: exact on any mesh.

    Forces are of the whole body, or per radian.
    """
    problem = pressed_cylinder(cell, weight)
    np.testing.assert_allclose(problem.results[0].pressure, YOUNG * 1e-3, rtol=1e-9)
    exact = angle * 0.5 * 0.5**2 * YOUNG * 1e-3
    assert [c.normal_force for c in problem.report.contacts] == pytest.approx([exact], rel=1e-9)
    assert problem.report.reactions[1].force[1] == pytest.approx(-exact, rel=1e-9)


A, B, C = 0.1, 0.2, 0.3  # radii of two tubes, one in the other [m]
INSIDE = 1e6  # pressure in the inner tube [Pa]
STIFFER = 3.0  # the outer tube


def lame(a, b, inside, outside, r, young):
    """Return the radial displacement of a tube under pressure in plane strain."""
    uniform = (inside * a**2 - outside * b**2) / (b**2 - a**2)
    rest = (inside - outside) * a**2 * b**2 / (b**2 - a**2)
    return (1 + POISSON) / young * ((1 - 2 * POISSON) * uniform * r + rest / r)


def pressure_between_tubes():
    """Return the contact pressure by Lame: both tubes have the same displacement at r = B."""

    def mismatch(q):
        inner = lame(A, B, INSIDE, q, B, YOUNG)
        return inner - lame(B, C, q, 0.0, B, STIFFER * YOUNG)

    return mismatch(0.0) / (mismatch(0.0) - mismatch(1.0))


def tubes(cell, n, weight=whole, outer_is_slave=False):
    """Two tubes, the inner one under pressure, between planes that keep their length."""
    parts = [((A, 0), (B, 0.1), (n, n)), ((B, 0), (C, 0.1), (n, n))]
    roles = (MASTER, SLAVE) if outer_is_slave else (SLAVE, MASTER)
    marks = [(roles[0], at(0, B), 1), (roles[1], at(0, B), 2), (LOADED, at(0, A))]
    marks += [(SIDE_Y, lambda x: np.isclose(x[1], 0.0) | np.isclose(x[1], 0.1))]
    young = {1: YOUNG, 2: STIFFER * YOUNG}
    scene = Scene.of_boxes(MPI.COMM_SELF, cell, parts, marks, young=young)
    scene.L = scene.constant(INSIDE) * scene.v[0] * weight(scene.mesh) * scene.ds(LOADED)
    scene.fix(SIDE_Y, 1)
    scene.add_pair()
    return solved(scene, weight)


@pytest.mark.parametrize(("weight", "outer_is_slave"), [(whole, False), (radius, True)])
def test_tubes_by_lame(weight, outer_is_slave):
    pressure = tubes("quadrilateral", 16, weight, outer_is_slave).results[0].pressure
    np.testing.assert_allclose(pressure, pressure_between_tubes(), rtol=1e-3)


def test_hoop_stress_carries_the_radial_load():
    """By the equilibrium of half a tube; the report has it among the springs."""
    report = tubes("quadrilateral", 4).report
    assert report.load.force == pytest.approx([2 * np.pi * A * 0.1 * INSIDE, 0.0])
    assert report.springs.force[0] == pytest.approx(-report.load.force[0], rel=1e-9)
    assert report.equilibrium < 1e-9

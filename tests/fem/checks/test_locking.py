"""Locking of linear elements: measured by element matrices, told with the remedy."""

import warnings
from itertools import cycle

from mpi4py import MPI

import numpy as np
import pytest
from scenes import CELLS, YOUNG, Scene, at, dimension, elasticity, plane, scalar_space

import ufl
from dolfinx import fem

COMM = MPI.COMM_WORLD

TOP, GROUND = 1, 2
ONE_POINT = ufl.dx(metadata={"quadrature_degree": 0})


def hooke(u, v, poisson):
    """Return the form of elasticity, in two dimensions of plane strain."""
    return elasticity(u, v, fem.Constant(u.ufl_function_space().mesh, YOUNG), poisson=poisson)


def by_one_point(u, v, poisson):
    """Return the form of elasticity with its volumetric part by one point."""
    mu, lam = YOUNG / (2 * (1 + poisson)), YOUNG * poisson / ((1 + poisson) * (1 - 2 * poisson))
    strain, variation = ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v))
    shear = 2 * mu * ufl.inner(strain, variation) * ufl.dx
    return shear + lam * ufl.div(u) * ufl.div(v) * ONE_POINT


def told(cell, form, degree=1, comm=MPI.COMM_SELF, distort=0.03):
    """Return the warnings of a block on a rigid plane, with distorted cells."""
    d = dimension(cell)

    def distorted(x):
        x[0] += 4 * distort * np.prod(np.sin(np.pi * x), axis=0)
        return x

    parts, marks = [((0.0,) * d, (2.0, 1.0, 1.0)[:d], (6, 3, 3)[:d])], [(TOP, at(d - 1, 1.0))]
    marks += [(GROUND, at(d - 1, 0.0))]
    scene = Scene.of_boxes(comm, cell, parts, marks, distorted, degree=degree)
    scene.a = form(scene.u, scene.v)
    scene.fix(TOP, None, -1e-3)
    scene.add_obstacle(GROUND, plane(d - 1, d))
    return warnings_of(scene, cell_tags=None)


def warnings_of(scene, **arguments):
    """Return the warnings when the problem is posed."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene.problem(**arguments)
    return [str(warning.message) for warning in caught if warning.category is UserWarning]


@pytest.mark.parametrize(
    ("cell", "poisson"), list(zip(CELLS, cycle((0.495, 0.4999)), strict=False))
)
def test_nearly_incompressible_cells_of_degree_1(cell, poisson):
    (message,) = told(cell, lambda u, v: hooke(u, v, poisson))
    assert f"degree 1 lock at a Poisson's ratio of {poisson:.4g}" in message
    assert "degree=2" in message
    assert ("by one point" in message) == (cell in ("quadrilateral", "hexahedron"))


@pytest.mark.parametrize(
    ("cell", "poisson"),
    [*((cell, 0.485) for cell in CELLS), ("triangle", -0.3), ("hexahedron", 0.3)],
)
def test_compressible_materials_do_not_lock(cell, poisson):
    assert not told(cell, lambda u, v: hooke(u, v, poisson))


@pytest.mark.parametrize(("cell", "poisson"), [("quadrilateral", 0.495), ("hexahedron", 0.4999)])
def test_one_point_of_the_volumetric_term_does_not_lock(cell, poisson):
    assert not told(cell, lambda u, v: by_one_point(u, v, poisson))


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_degree_2_does_not_lock(cell):
    assert not told(cell, lambda u, v: hooke(u, v, 0.4999), degree=2)


def test_plane_stress_does_not_lock():
    def form(u, v):
        strain = ufl.sym(ufl.grad(u))
        stress = YOUNG / (1 - 0.5**2) * (0.5 * strain + 0.5 * ufl.tr(strain) * ufl.Identity(2))
        return ufl.inner(stress, ufl.sym(ufl.grad(v))) * ufl.dx

    assert not told("triangle", form)


def test_stiff_fibres_do_not_lock():
    """The stiffest strain is not the dilatation."""

    def form(u, v):
        fibres = 1e3 * YOUNG * u[0].dx(0) * v[0].dx(0) * ufl.dx
        return hooke(u, v, 0.3) + fibres

    assert not told("hexahedron", form)


@pytest.mark.parametrize("soft", [0, -1])
def test_one_cell_of_another_material(soft):
    """Poisson's ratio is a function; the cell with the largest one is among those measured."""

    def form(u, v):
        domain = u.ufl_function_space().mesh
        ratio = fem.Function(scalar_space(domain, "DG", 0))
        ratio.x.array[:] = 0.3
        ratio.x.array[soft] = 0.499
        return hooke(u, v, ratio)

    (message,) = told("hexahedron", form)
    assert "0.499" in message


def told_of_two_blocks(comm):
    """Return the warnings of two blocks, of which the second is nearly incompressible."""
    parts = [((0, 0), (1, 1), (4, 4)), ((3, 0), (4, 1), (4, 4))]
    scene = Scene.of_boxes(comm, "quadrilateral", parts, [(1, at(1, 0.0))])
    bulk = scene.constant(1e3 * YOUNG)
    scene.a += bulk * ufl.div(scene.u) * ufl.div(scene.v) * scene.dx(2)
    scene.fix(1)
    return warnings_of(scene)


@pytest.mark.ranks(2)
def test_rank_0_warns_as_one_rank_alone_does():
    alone, together = told_of_two_blocks(MPI.COMM_SELF), told_of_two_blocks(COMM)
    assert len(alone) == 1
    assert alone[0].startswith("body 1 (cell tag 2)")
    assert together == (alone if COMM.rank == 0 else [])

"""Subdomains that are rotated images share a stiffness matrix if their forms allow it."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import Scene, at, dimension, elasticity, scalar_space

import ufl
from dolfinx import fem

from fenics_tfeti import Plane
from fenics_tfeti.fem import _compat

SECTORS, ANGLE, N = 5, np.pi / 7, 2  # elements of a sector in each direction
ROOT, END, INSIDE = 1, 2, 3


def arch(cell):
    """Return a bent beam, fixed at its root, whose end is pressed on a plane."""
    gdim = dimension(cell)
    parts = [((0,) * gdim, (SECTORS, *(1,) * (gdim - 1)), (SECTORS * N, *(N,) * (gdim - 1)))]
    marks = [(ROOT, at(0, 0.0)), (END, at(0, SECTORS)), (INSIDE, at(1, 0.0))]
    scene = Scene.of_boxes(MPI.COMM_SELF, cell, parts, marks)
    x, cells = scene.mesh.geometry.x, _compat.geometry_cells(scene.mesh)
    middles = x[cells].mean(axis=1)
    scene.labels = np.floor(middles[:, 0]).astype(int)
    along, radius = x[:, 0].copy(), 2.0 + x[:, 1]
    x[:, 0], x[:, 1] = radius * np.cos(ANGLE * along), radius * np.sin(ANGLE * along)
    scene.young = fem.Function(scalar_space(scene.mesh, "DG", 0))
    # stiffer inside
    scene.young.x.array[:] = 10.0 - np.floor(N * middles[:, 1])
    scene.a = elasticity(scene.u, scene.v, scene.young)
    force = scene.constant(np.array([-1e-3, -2e-3, 1e-3][:gdim]))
    scene.L = ufl.inner(force, scene.v) * ufl.dx
    scene.fix(ROOT)
    outwards = np.array([np.cos(SECTORS * ANGLE), np.sin(SECTORS * ANGLE), 0.0][:gdim])
    normal = np.array([outwards[1], -outwards[0], 0.0][:gdim])
    scene.add_obstacle(END, Plane(2.5 * outwards, normal))
    return scene


def isotropic(arch):
    pass


def supported_inside(arch):
    arch.a += 0.1 * ufl.inner(arch.u, arch.v) * arch.ds(INSIDE)


def supported_radially(arch):
    n = ufl.FacetNormal(arch.mesh)
    arch.a += 0.1 * ufl.inner(ufl.dot(arch.u, n), ufl.dot(arch.v, n)) * arch.ds(INSIDE)


def softer_in_one_cell(arch):
    arch.young.x.array[np.flatnonzero(arch.labels == 2)[3]] *= 0.5


def fibres_in_one_direction(arch):
    d = arch.constant(np.array([1.0, 0.3, 0.2][: arch.gdim]))
    arch.a += ufl.inner(ufl.dot(ufl.grad(arch.u), d), ufl.dot(ufl.grad(arch.v), d)) * ufl.dx


def fibres_in_one_cell_of_each(arch):
    """Data that are equal in all sectors, but for the direction a vector that does not turn."""
    amount = fem.Function(scalar_space(arch.mesh, "DG", 0))
    for label in range(SECTORS):
        amount.x.array[np.flatnonzero(arch.labels == label)[-1]] = 1.0
    d = arch.constant(np.array([1.0, 0.3, 0.2][: arch.gdim]))
    stretch = [ufl.dot(ufl.grad(w), d) for w in (arch.u, arch.v)]
    arch.a += amount * ufl.inner(*stretch) * ufl.dx


CLASSES = {
    isotropic: 1,
    supported_inside: 1,
    supported_radially: 1,
    softer_in_one_cell: 2,
    fibres_in_one_direction: SECTORS,
    fibres_in_one_cell_of_each: SECTORS,
}


@pytest.mark.parametrize(
    ("cell", "change", "expected"),
    [
        *(("triangle", change, expected) for change, expected in CLASSES.items()),
        ("tetrahedron", supported_radially, 1),
        ("hexahedron", fibres_in_one_cell_of_each, SECTORS),
    ],
)
def test_shared_or_not(cell, change, expected):
    scene = arch(cell)
    change(scene)
    # zero, of data that are the same in all cells at first
    data = fem.Function(scalar_space(scene.mesh, "DG", 0))
    scene.a += scene.constant(0.0) * data * ufl.inner(scene.u, scene.v) * ufl.dx

    def problem():
        options = {"rtol": 1e-9}
        return scene.problem(cell_tags=None, subdomains=scene.labels, options=options)

    shared = problem()
    displacement = shared.solve().x.array
    assert shared.report.classes == expected
    assert shared.results[0].nodal_normal_force.sum() > 0.0
    data.x.array[:] = scene.labels
    other = problem()
    reference = other.solve().x.array
    assert other.report.classes == SECTORS
    np.testing.assert_allclose(displacement, reference, rtol=0, atol=1e-8 * np.abs(reference).max())

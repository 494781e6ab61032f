"""The stiffness of a uniform pressure whose direction turns with the surface: closed forms."""

from mpi4py import MPI

import numpy as np
import pytest
import scipy.sparse as sp
from scenes import CELLS, MASTER, SLAVE, Scene, at, dimension

import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_vector

from fenics_tfeti import Coulomb
from fenics_tfeti.fem.newton.contact_stiffness import (
    ContactStiffness,
    _relative_to_far_nodes,
    _without_curvature,
)

PRESSURE = 0.7


def energies(scene, u, du):
    """Return the energies of an increment with the stiffness of a uniform pressure on each body."""
    problem = scene.problem(options={"subdomain_size": 10**6})
    force = fem.form(
        PRESSURE * ufl.inner(ufl.FacetNormal(scene.mesh), scene.v) * scene.ds((MASTER, SLAVE))
    )
    torn = problem._torn
    stiffness = ContactStiffness(u, scene.contacts, torn.data.compiler)
    nodal = assemble_vector(force).array.reshape(-1, len(u))
    values = torn.nodes.values(du)
    x = [values[torn.nodes.to_local(s.nodes)].ravel() for s in torn.torn.subdomains]
    return [x @ K @ x for x, K in zip(x, stiffness.matrices(torn.torn, nodal), strict=True)]


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", CELLS)
def test_energy(cell, degree):
    """It is -2 p times the integral of sliding times slope, that of x^k times k x^(k-1) here."""
    dim = dimension(cell)
    up = np.eye(dim)[-1]
    blocks = [(k * up, k * up + 1.0, (2 + k,) * dim) for k in range(2)]
    marks = [(MASTER, at(dim - 1, 1.0), 1), (SLAVE, at(dim - 1, 1.0), 2)]
    scene = Scene.of_boxes(MPI.COMM_WORLD, cell, blocks, marks, degree=degree)
    scene.add_pair()
    u, du = fem.Function(scene.V), fem.Function(scene.V)
    du.interpolate(lambda x: np.stack([x[0] ** degree, *0 * x[: dim - 2], x[0] ** degree]))
    assert energies(scene, u, du) == pytest.approx([-PRESSURE, PRESSURE])


@pytest.mark.parametrize("degree", [1, 2])
def test_energy_of_a_rotation(degree):
    """That of a ring in itself: p times the sliding squared over the radius, integrated.

    Normals at both ends are those of one facet, whose curvature is half as large.
    """
    angle, inner, radius, outer = np.pi / 3, 0.5, 1.0, 2.0
    blocks = [((0, 0), (1, 1), (40, 2)), ((0, 2), (1, 3), (60, 2))]
    marks = [(MASTER, at(1, 2.0), 2), (SLAVE, at(1, 1.0), 1)]

    def bent(x):
        r = np.interp(x[1], [0, 1, 2, 3], [inner, radius, radius, outer])
        return np.stack([r * np.cos(angle * x[0]), r * np.sin(angle * x[0])])

    scene = Scene.of_boxes(MPI.COMM_WORLD, "quadrilateral", blocks, marks, bent, degree=degree)
    scene.add_pair(initial_gap="touching")
    du = fem.Function(scene.V)
    du.interpolate(lambda x: np.stack([-x[1], x[0]]))
    whole = PRESSURE * angle * radius**2
    expected = [(1 + 1 / 40) * whole, -(1 + 1 / 60) * whole]
    assert energies(scene, fem.Function(scene.V), du) == pytest.approx(expected, rel=1e-3)


def test_no_force_of_a_translation():
    """The energy is that of sliding relative to the mean of the nodes far from the contact."""
    rng = np.random.default_rng(0)
    x = np.column_stack([np.arange(10.0), np.zeros(10)])  # the first two in contact
    K, u = np.zeros((20, 20)), rng.standard_normal((10, 2))
    K[:4, :4] = rng.standard_normal((4, 4))
    K += K.T
    relative = (u - u[8:].mean(axis=0)).ravel()
    of_subdomain = _relative_to_far_nodes(sp.csr_matrix(K), x)
    assert u.ravel() @ of_subdomain @ u.ravel() == pytest.approx(relative @ K @ relative)
    np.testing.assert_allclose(of_subdomain.toarray(), of_subdomain.toarray().T, atol=1e-14)


@pytest.mark.parametrize(("friction", "number"), [(None, 1), (Coulomb(0.3), 5)])
def test_nodes_without_curvature(friction, number):
    """They are the corner that the top and a side of a block share; with friction all of both."""
    marks = [(MASTER, at(1, 1.0), 1), (SLAVE, at(0, 0.0), 1)]
    scene = Scene.of_boxes(MPI.COMM_WORLD, "quadrilateral", [((0, 0), (1, 1), (2, 2))], marks)
    scene.add_pair(friction=friction)
    places = scene.V.tabulate_dof_coordinates()[_without_curvature(scene.V, scene.contacts), :2]
    assert len(places) == number
    assert [0.0, 1.0] in places.round(12).tolist()

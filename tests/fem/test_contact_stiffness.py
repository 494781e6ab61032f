"""The stiffness of a uniform pressure whose direction turns with the surface: its closed form."""

from mpi4py import MPI

import numpy as np
import pytest
import scipy.sparse as sp
from scenes import CELLS, MASTER, SLAVE, Scene, at, dimension

import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_vector

from fenics_tfeti.fem.newton.contact_stiffness import ContactStiffness, _relative_to_far_nodes

PRESSURE = 0.7


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
    problem = scene.problem(options={"subdomain_size": 10**6})
    force = fem.form(
        PRESSURE * ufl.inner(ufl.FacetNormal(scene.mesh), scene.v) * scene.ds((MASTER, SLAVE))
    )
    u, du = fem.Function(scene.V), fem.Function(scene.V)
    du.interpolate(lambda x: np.stack([x[0] ** degree, *0 * x[: dim - 2], x[0] ** degree]))
    torn = problem._torn
    stiffness = ContactStiffness(u, scene.contacts, torn.data.compiler)
    matrices = stiffness.matrices(torn.torn, assemble_vector(force).array.reshape(-1, dim))
    values = torn.nodes.values(du)
    for s, K, sign in zip(torn.torn.subdomains, matrices, (-1.0, 1.0), strict=True):
        x = values[torn.nodes.to_local(s.nodes)].ravel()
        assert x @ K @ x == pytest.approx(sign * PRESSURE)


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

"""Subdomains that are rotated images share a stiffness matrix if their forms allow it."""

from __future__ import annotations

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
from scenes import elasticity, fixed, nothing_but_labels, scalar_space, vector_space

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Plane, RigidObstacle
from fenics_tfeti.fem import _compat
from fenics_tfeti.io import Box, boxes, tag_facets

SECTORS, ANGLE, N = 5, np.pi / 7, 3  # elements of a sector in each direction
ROOT, END, INSIDE = 1, 2, 3
CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")


def arch(cell):
    """Return a bent beam, fixed at its root, whose end is pressed on a plane."""
    gdim = 2 if cell in CELLS[:2] else 3
    box = Box((0,) * gdim, (SECTORS, *(1,) * (gdim - 1)), (SECTORS * N, *(N,) * (gdim - 1)))
    domain = boxes(MPI.COMM_SELF, [box], cell).mesh
    middles = domain.geometry.x[_compat.geometry_cells(domain)].mean(axis=1)
    facet_tags = tag_facets(
        domain,
        {
            ROOT: lambda x: np.isclose(x[0], 0.0),
            END: lambda x: np.isclose(x[0], SECTORS),
            INSIDE: lambda x: np.isclose(x[1], 0.0),
        },
    )
    x = domain.geometry.x
    along, radius = x[:, 0].copy(), 2.0 + x[:, 1]
    x[:, 0], x[:, 1] = radius * np.cos(ANGLE * along), radius * np.sin(ANGLE * along)

    V = vector_space(domain)
    young = fem.Function(scalar_space(domain, "DG", 0))
    # stiffer inside
    young.x.array[:] = 10.0 - np.floor(N * middles[:, 1])
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    force = fem.Constant(domain, np.array([-1e-3, -2e-3, 1e-3][:gdim]))
    outwards = np.array([np.cos(SECTORS * ANGLE), np.sin(SECTORS * ANGLE), 0.0][:gdim])
    normal = np.array([outwards[1], -outwards[0], 0.0][:gdim])
    end = RigidObstacle(facet_tags, END, Plane(2.5 * outwards, normal))
    return SimpleNamespace(
        mesh=domain,
        V=V,
        u=u,
        v=v,
        young=young,
        a=elasticity(u, v, young),
        L=ufl.inner(force, v) * ufl.dx,
        bcs=[fixed(V, facet_tags, ROOT, None)],
        contacts=[end],
        inside=ufl.Measure("ds", domain=domain, subdomain_data=facet_tags)(INSIDE),
        labels=np.floor(middles[:, 0]).astype(int),
    )


def isotropic(arch):
    pass


def supported_inside(arch):
    arch.a += 0.1 * ufl.inner(arch.u, arch.v) * arch.inside


def supported_radially(arch):
    n = ufl.FacetNormal(arch.mesh)
    arch.a += 0.1 * ufl.inner(ufl.dot(arch.u, n), ufl.dot(arch.v, n)) * arch.inside


def softer_in_one_cell(arch):
    arch.young.x.array[np.flatnonzero(arch.labels == 2)[4]] *= 0.5


def fibres_in_one_direction(arch):
    gdim = arch.mesh.geometry.dim
    d = fem.Constant(arch.mesh, np.array([1.0, 0.3, 0.2][:gdim]))
    arch.a += ufl.inner(ufl.dot(ufl.grad(arch.u), d), ufl.dot(ufl.grad(arch.v), d)) * ufl.dx


def fibres_in_one_cell_of_each(arch):
    """Data that are equal in all sectors, but for the direction a vector that does not turn."""
    gdim = arch.mesh.geometry.dim
    amount = fem.Function(scalar_space(arch.mesh, "DG", 0))
    for label in range(SECTORS):
        amount.x.array[np.flatnonzero(arch.labels == label)[-1]] = 1.0
    d = fem.Constant(arch.mesh, np.array([1.0, 0.3, 0.2][:gdim]))
    stretch = [ufl.dot(ufl.grad(w), d) for w in (arch.u, arch.v)]
    arch.a += amount * ufl.inner(*stretch) * ufl.dx


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (isotropic, 1),
        (supported_inside, 1),
        (supported_radially, 1),
        (softer_in_one_cell, 2),
        (fibres_in_one_direction, SECTORS),
        (fibres_in_one_cell_of_each, SECTORS),
    ],
)
@pytest.mark.parametrize("cell", CELLS)
def test_shared_or_not(cell, change, expected):
    scene = arch(cell)
    change(scene)

    def problem():
        arguments = {"bcs": scene.bcs, "contacts": scene.contacts, "subdomains": scene.labels}
        return ContactProblem(scene.a, scene.L, options={"rtol": 1e-9}, **arguments)

    shared = problem()
    displacement = shared.solve().x.array
    assert shared.report.classes == expected
    assert shared.results[0].normal_force.sum() > 0.0
    scene.a += nothing_but_labels(scene.mesh, scene.labels) * ufl.inner(scene.u, scene.v) * ufl.dx
    other = problem()
    reference = other.solve().x.array
    assert other.report.classes == SECTORS
    np.testing.assert_allclose(displacement, reference, rtol=0, atol=1e-8 * np.abs(reference).max())

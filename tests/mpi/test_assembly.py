"""Each rank's subdomains together make the matrix and the load that dolfinx assembles."""

from __future__ import annotations

from mpi4py import MPI

from petsc4py import PETSc

import numpy as np
import pytest
from scenes import elasticity, scalar_space, two_materials

import ufl
from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc

from fenics_tfeti.fem import _compat

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
@pytest.mark.parametrize("place", ["tagged", "anywhere", "in space"])
def test_energy_and_work(cell, place):
    scene = two_materials(COMM, cell, 4)
    domain, V = scene.mesh, scene.V
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    if place != "tagged":
        young = fem.Function(scalar_space(domain, "DG", 0))
        young.x.array[:] = 1.0
        x = ufl.SpatialCoordinate(domain)
        scene.a = elasticity(u, v, young * (1.0 + x[0]) if place == "in space" else young)
        scene.L = x[1] * v[0] * ufl.dx(domain=domain)
    owned = domain.topology.index_map(domain.topology.dim).size_local
    middles = domain.geometry.x[_compat.geometry_cells(domain)[:owned]].mean(axis=1)
    cubes = np.floor(2 * middles).astype(int) @ (1, 10, 100)
    problem = scene.problem(subdomains=cubes)
    subdomains = problem.system.subdomains

    moved = fem.Function(V)
    gdim = domain.geometry.dim
    moved.interpolate(lambda x: np.sin(3 * x[:gdim] + x[0] ** 2))
    to_global = V.dofmap.index_map.local_to_global
    values = moved.x.array.reshape(-1, gdim)
    local = {int(n): k for k, n in enumerate(to_global(np.arange(len(values), dtype=np.int32)))}
    torn = [values[[local[n] for n in s.nodes]].ravel() for s in subdomains]
    ours = COMM.allreduce(
        np.array(
            [
                sum(x @ (s.stiffness @ x) for x, s in zip(torn, subdomains, strict=True)),
                sum(x @ s.load for x, s in zip(torn, subdomains, strict=True)),
            ]
        )
    )

    A = fem_petsc.assemble_matrix(fem.form(scene.a))
    A.assemble()
    x = A.createVecRight()
    x.array_w[:] = moved.x.array[: x.getLocalSize()]
    b = fem_petsc.assemble_vector(fem.form(scene.L))
    b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    np.testing.assert_allclose(ours, [x.dot(A * x), x.dot(b)], rtol=1e-12)


@pytest.mark.parametrize(("cell", "shapes"), [("quadrilateral", 1), ("tetrahedron", 6)])
def test_cells_of_few_shapes_have_few_matrices(cell, shapes):
    """Each cell is a subdomain."""
    scene = two_materials(COMM, cell, 4)
    domain, V = scene.mesh, scene.V
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    owned = domain.topology.index_map(domain.topology.dim).size_local
    young = fem.Constant(domain, 1.0)
    scene.a = elasticity(u, v, young)
    problem = scene.problem(subdomains=np.arange(owned))
    different = len({id(s.stiffness) for s in problem.system.subdomains})
    assert different <= shapes

"""The scenes of `peers.py` in dolfinx: fenics_tfeti, and PETSc's SNESVI for the rigid ground."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

from petsc4py import PETSc

import numpy as np
from peers_scene import LAMBDA, MU, TRACTION, Answer, Scene, ground_gap

import ufl
from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc
from dolfinx.mesh import meshtags

from fenics_tfeti import ContactPair, ContactProblem, RigidObstacle
from fenics_tfeti.fem import _compat
from fenics_tfeti.io import displacement_space, tag_facets

CLAMPED, GUIDED, SLAVE, MASTER, LOADED = 3, 4, 5, 6, 7


class Elasticity:
    """Forms and supports of a scene, as in demos/two_beams.py."""

    def __init__(self, scene: Scene) -> None:
        mesh = _compat.distributed_mesh(
            MPI.COMM_SELF, scene.cells, np.ascontiguousarray(scene.points), "hexahedron"
        )
        body = scene.body[mesh.topology.original_cell_index]
        bodies = meshtags(mesh, 3, np.arange(len(body), dtype=np.int32), body)
        self.has_lower = bool(np.any(body == 1))
        markers = [
            (GUIDED, lambda x: np.isclose(x[0], 3), 2),
            (SLAVE, lambda x: np.isclose(x[2], 1) & self._is_over(x), 2),
            (LOADED, lambda x: np.isclose(x[2], 2), 2),
            (LOADED, lambda x: np.isclose(x[0], 1), 2),
        ]
        if self.has_lower:
            markers.append((CLAMPED, lambda x: np.isclose(x[0], 0), 1))
            markers.append((MASTER, lambda x: np.isclose(x[2], 1) & (x[0] > 1 - 1e-9), 1))
        self.facet_tags = tag_facets(mesh, markers, bodies)
        self.mesh, self.bodies = mesh, bodies
        self.space = displacement_space(mesh)
        self.a, self.L = self._forms()
        self.bcs = self._supports()

    def _is_over(self, x: Any) -> Any:
        """Select the part of the face z = 1 of the slave that is above the master or the ground."""
        return x[0] < 2 + 1e-9 if self.has_lower else x[0] < np.inf

    def _forms(self) -> tuple[Any, Any]:
        mu, lmbda = (fem.Constant(self.mesh, value) for value in (MU, LAMBDA))
        u, v = ufl.TrialFunction(self.space), ufl.TestFunction(self.space)
        strain = ufl.sym(ufl.grad(u))
        stress = lmbda * ufl.tr(strain) * ufl.Identity(3) + 2 * mu * strain
        ds = ufl.Measure("ds", domain=self.mesh, subdomain_data=self.facet_tags)
        traction = fem.Constant(self.mesh, np.array([0.0, 0.0, -TRACTION]))
        a = ufl.inner(stress, ufl.sym(ufl.grad(v))) * ufl.dx
        return a, ufl.inner(traction, v) * ds(LOADED)

    def dofs(self, tag: int, component: int) -> Any:
        """Return the degrees of freedom of one component on a tagged surface."""
        part = self.space.sub(component)
        return fem.locate_dofs_topological(part, 2, self.facet_tags.find(tag))

    def _supports(self) -> list[Any]:
        wanted = [(GUIDED, c) for c in (0, 1)]
        if self.has_lower:
            wanted += [(CLAMPED, c) for c in (0, 1, 2)]
        return [fem.dirichletbc(0.0, self.dofs(tag, c), self.space.sub(c)) for tag, c in wanted]

    def answer(self, values: Any, force: float, pressure: Any = (), **facts: Any) -> Answer:
        """Return an answer from the values (3 n) of the displacement."""
        nodes = _compat.cell_dofs(self.space)
        body = np.zeros(len(values) // 3, dtype=np.int32)
        body[nodes] = self.bodies.values[:, np.newaxis]
        points = self.space.tabulate_dof_coordinates()
        return Answer(
            points, np.asarray(values).reshape(-1, 3), body, force, facts, np.asarray(pressure)
        )


def solve_by_tfeti(scene: Scene, rtol: float, partitioner: str = "auto") -> Answer:
    """Solve a scene by fenics_tfeti with its defaults, or in subdomains by SCOTCH."""
    parts = Elasticity(scene)
    contact: ContactPair | RigidObstacle = RigidObstacle(parts.facet_tags, SLAVE, _ground)
    if parts.has_lower:
        contact = ContactPair(parts.facet_tags, SLAVE, MASTER)
    problem = ContactProblem(
        parts.a,
        parts.L,
        bcs=parts.bcs,
        contacts=[contact],
        options={"rtol": rtol, "partitioner": partitioner},
    )
    uh = problem.solve()
    pressure = np.full(len(scene.points), np.nan)
    pressure[problem.results[0].nodes] = problem.results[0].pressure
    return parts.answer(
        uh.x.array.copy(),
        float(problem.results[0].normal_force.sum()),
        pressure,
        iterations=problem.report.products["total"],
        iterations_of="products with F",
        residual=max(problem.report.certificate.numbers().values()),
    )


def _ground(x: Any) -> tuple[Any, Any]:
    """Return the gap along z, as in the bound of SNESVI, and the normal."""
    return ground_gap(x), np.tile([[0.0], [0.0], [1.0]], x.shape[1])


def solve_by_snesvi(scene: Scene, rtol: float, solver: str) -> Answer:
    """Solve the rigid scene as a bound-constrained linear problem by vinewtonrsls.

    `solver` is "mumps" (a Cholesky factorisation for each active set), or one of PETSc's
    preconditioners for conjugate gradients: "gamg", "hypre", "icc".
    """
    parts = Elasticity(scene)
    matrix = fem_petsc.assemble_matrix(fem.form(parts.a), bcs=parts.bcs)
    matrix.assemble()
    matrix.setOption(PETSc.Mat.Option.SPD, True)
    load = fem_petsc.assemble_vector(fem.form(parts.L))
    load.array[np.concatenate([parts.dofs(GUIDED, c) for c in (0, 1)])] = 0.0
    lower, upper = load.duplicate(), load.duplicate()
    lower.set(PETSc.NINFINITY)
    upper.set(PETSc.INFINITY)
    bottom = parts.dofs(SLAVE, 2)
    lower.array[bottom] = -ground_gap(parts.space.tabulate_dof_coordinates()[bottom // 3].T)

    snes = _newton(matrix, load, rtol, solver)
    snes.setVariableBounds(lower, upper)
    solution = load.duplicate()
    snes.solve(None, solution)
    if snes.getConvergedReason() < 0:
        raise RuntimeError(f"SNESVI did not converge: {snes.getConvergedReason()}")
    force = matrix * solution - load
    return parts.answer(
        solution.array.copy(),
        float(force.array[bottom].sum()),
        iterations=snes.getIterationNumber(),
        iterations_of="Newton steps",
        linear_iterations=snes.getLinearSolveIterations(),
    )


def _newton(matrix: Any, load: Any, rtol: float, solver: str) -> Any:
    snes = PETSc.SNES().create(PETSc.COMM_SELF)
    snes.setType("vinewtonrsls")

    def residual(_: Any, x: Any, out: Any) -> None:
        matrix.mult(x, out)
        out.axpy(-1.0, load)

    def jacobian(snes: Any, _: Any, J: Any, P: Any) -> None:
        # the size of the reduced matrix changes with the active set; GAMG has to be reset for that
        _linear_solver(snes.getKSP(), rtol, solver)

    snes.setFunction(residual, load.duplicate())
    snes.setJacobian(jacobian, matrix)
    snes.setTolerances(rtol=rtol, atol=0.0, stol=0.0, max_it=100)
    return snes


def _linear_solver(ksp: Any, rtol: float, solver: str) -> None:
    ksp.reset()
    pc = ksp.getPC()
    pc.setType("none")
    if solver == "mumps":
        ksp.setType("preonly")
        pc.setType("cholesky")
        pc.setFactorSolverType("mumps")
        return
    ksp.setType("cg")
    ksp.setTolerances(rtol=0.1 * rtol, max_it=5000)
    pc.setType(solver)

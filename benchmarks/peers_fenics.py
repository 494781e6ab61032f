"""The scenes of `peers.py` in dolfinx: fenics_tfeti, and PETSc's SNESVI for the rigid ground."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

from petsc4py import PETSc

import numpy as np
from peers_scene import POISSON, TRACTION, YOUNG, Answer, Scene, ground_gap
from scenes import CLAMPED, LOADED, MASTER, ROLLER, SLAVE, at, elasticity
from scenes import Scene as Tagged

from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc
from dolfinx.mesh import meshtags

from fenics_tfeti.fem import _compat
from fenics_tfeti.io import tag_facets


class Elasticity:
    """Forms and supports of a scene, as in demos/two_beams.py."""

    def __init__(self, scene: Scene) -> None:
        mesh = _compat.distributed_mesh(
            MPI.COMM_SELF, scene.cells, np.ascontiguousarray(scene.points), "hexahedron"
        )
        body = scene.body[mesh.topology.original_cell_index]
        bodies = meshtags(mesh, 3, np.arange(len(body), dtype=np.int32), body)
        self.has_lower = bool(np.any(body == 1))
        # the part of the slave that is above the master or the ground
        end = 2 + 1e-9 if self.has_lower else np.inf
        markers = [
            (ROLLER, at(0, 3), 2),
            (SLAVE, lambda x: np.isclose(x[2], 1) & (x[0] < end), 2),
            (LOADED, at(2, 2), 2),
            (LOADED, at(0, 1), 2),
        ]
        if self.has_lower:
            markers.append((CLAMPED, at(0, 0), 1))
            markers.append((MASTER, lambda x: np.isclose(x[2], 1) & (x[0] > 1 - 1e-9), 1))
        self.tagged = tagged = Tagged(mesh, tag_facets(mesh, markers, bodies), bodies)
        tagged.a = elasticity(tagged.u, tagged.v, YOUNG, poisson=POISSON)
        tagged.add_load(LOADED, np.array([0.0, 0.0, -TRACTION]))
        held = [(ROLLER, 0), (ROLLER, 1), *((CLAMPED, c) for c in range(3) if self.has_lower)]
        for tag, component in held:
            tagged.fix(tag, component)

    def dofs(self, tag: int, component: int) -> Any:
        """Return the degrees of freedom of one component on a tagged surface."""
        part = self.tagged.V.sub(component)
        return fem.locate_dofs_topological(part, 2, self.tagged.facet_tags.find(tag))

    def answer(self, values: Any, force: float, pressure: Any = (), **facts: Any) -> Answer:
        """Return an answer from the values (3 n) of the displacement."""
        nodes = _compat.cell_dofs(self.tagged.V)
        body = np.zeros(len(values) // 3, dtype=np.int32)
        body[nodes] = self.tagged.cell_tags.values[:, np.newaxis]
        points = self.tagged.V.tabulate_dof_coordinates()
        return Answer(
            points, np.asarray(values).reshape(-1, 3), body, force, facts, np.asarray(pressure)
        )


def solve_by_tfeti(scene: Scene, rtol: float, partitioner: str = "auto") -> Answer:
    """Solve a scene by fenics_tfeti with its defaults, or in subdomains by SCOTCH."""
    parts = Elasticity(scene)
    if parts.has_lower:
        parts.tagged.add_pair()
    else:
        parts.tagged.add_obstacle(SLAVE, _ground)
    options = {"rtol": rtol, "partitioner": partitioner}
    problem = parts.tagged.problem(cell_tags=None, options=options)
    uh = problem.solve()
    pressure = np.full(len(scene.points), np.nan)
    pressure[problem.results[0].nodes] = problem.results[0].pressure
    return parts.answer(
        uh.x.array.copy(),
        float(problem.results[0].nodal_normal_force.sum()),
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
    tagged = parts.tagged
    matrix = fem_petsc.assemble_matrix(fem.form(tagged.a), bcs=tagged.bcs)
    matrix.assemble()
    matrix.setOption(PETSc.Mat.Option.SPD, True)
    load = fem_petsc.assemble_vector(fem.form(tagged.L))
    load.array[np.concatenate([parts.dofs(ROLLER, c) for c in (0, 1)])] = 0.0
    lower, upper = load.duplicate(), load.duplicate()
    lower.set(PETSc.NINFINITY)
    upper.set(PETSc.INFINITY)
    bottom = parts.dofs(SLAVE, 2)
    lower.array[bottom] = -ground_gap(tagged.V.tabulate_dof_coordinates()[bottom // 3].T)

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

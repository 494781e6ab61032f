"""Newton's method of dolfinx alone, for the penalty terms that the pages compare with."""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np

import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix, assemble_vector


def newton(F: ufl.Form, u: fem.Function, bcs: list[fem.DirichletBC], max_it: int = 50) -> int:
    """Solve F(u; v) = 0 from the present u on one rank, which has zeros where `bcs` prescribe them.

    Full steps, as in scripts with `NewtonSolver`; returns how many of them were taken.
    """
    residual, tangent = fem.form(F), fem.form(ufl.derivative(F, u))
    fixed = np.concatenate([bc.dof_indices()[0] for bc in bcs])
    solver = PETSc.KSP().create(u.function_space.mesh.comm)
    solver.setType("preonly")
    solver.getPC().setType("lu")
    for step in range(1, max_it + 1):
        b, A = assemble_vector(residual), assemble_matrix(tangent, bcs=bcs)
        b.array[fixed] = 0.0
        A.assemble()
        solver.setOperators(A)
        solver.solve(-b, b)
        if not np.isfinite(b.norm()):
            raise FloatingPointError(f"NaN in step {step} of Newton's method")
        u.x.array[:] += b.array
        if b.norm() < 1e-8 * np.linalg.norm(u.x.array):
            return step
    raise FloatingPointError(f"no convergence in {max_it} steps of Newton's method")

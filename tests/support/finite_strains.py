"""Bodies with finite strains in contact, whose forces and energies are known from other programs.

The references of the indented block are those of a Newton method with plain dolfinx and SciPy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import NonlinearContactProblem, RigidObstacle, Sphere
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
from fenics_tfeti.models import neo_hookean

BASE, TOP = 1, 2


@dataclass(frozen=True)
class Scene:
    """A problem with what a test changes and measures."""

    problem: NonlinearContactProblem
    strain_energy: Any  # compiled form
    set_load: Callable[[float], None]  # a part of the load, 0 to 1

    @property
    def energy(self) -> float:
        """The energy stored in the bodies [J]."""
        comm = self.problem.space.mesh.comm
        return float(comm.allreduce(fem.assemble_scalar(self.strain_energy)))

    def solve(self, loads: list[float]) -> None:
        """Solve and accept load steps."""
        for load in loads:
            self.set_load(load)
            self.problem.solve()
            self.problem.advance()

    def counts(self) -> tuple[int, float]:
        """Return the Newton steps of the last solve, and their mean products with F."""
        steps = self.problem.report.newton
        return len(steps), float(np.mean([step.products for step in steps]))


def clamped(V: Any, facets: Any) -> Any:
    """Return the condition that nothing moves at facets."""
    dofs = fem.locate_dofs_topological(V, V.mesh.topology.dim - 1, facets)
    return fem.dirichletbc(np.zeros(V.mesh.geometry.dim), dofs, V)


def indented_block(
    dim: int = 2,
    n: int = 8,
    nu: float = 0.3,
    depth: float = 0.3,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    degree: int = 1,
    **options: Any,
) -> Scene:
    """Make a block of height 1 and width 2, clamped at its base, under a rigid ball of radius 0.5.

    In two dimensions the ball is a cylinder.
    """
    low, high = (-1.0,) * (dim - 1) + (0.0,), (1.0,) * dim
    cells = (2 * n,) * (dim - 1) + (n,)
    cell = {2: "quadrilateral", 3: "hexahedron"}[dim]
    mesh = boxes(comm, [Box(low, high, cells)], cell).mesh
    tags = tag_facets(
        mesh, {BASE: lambda x: np.isclose(x[dim - 1], 0), TOP: lambda x: np.isclose(x[dim - 1], 1)}
    )
    V = displacement_space(mesh, degree)
    u = fem.Function(V)
    W = neo_hookean(1.0, nu)(u) * ufl.dx
    load = {"depth": 0.0}

    def ball(x: Any) -> Any:
        centre = [0.0] * (dim - 1) + [1.5 - load["depth"]]
        return Sphere(centre, 0.5)(x)

    problem = NonlinearContactProblem(
        ufl.derivative(W, u, ufl.TestFunction(V)),
        u,
        bcs=[clamped(V, tags.find(BASE))],
        contacts=[RigidObstacle(tags, TOP, ball)],
        options=options,
    )
    return Scene(problem, fem.form(W), lambda part: load.update(depth=part * depth))

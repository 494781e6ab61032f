"""The linear solves on the last face, of an adjoint or a tangent."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fenics_tfeti.feti.solution.linear import LinearData, LinearSolution
from fenics_tfeti.parallel import first_of_rank
from fenics_tfeti.qp import Space
from fenics_tfeti.qp.gmres import gmres
from fenics_tfeti.sensitivities.state import SolvedState
from fenics_tfeti.typing import Vector


class LinearSolves:
    """Linear solves, and what they cost.

    Attributes
    ----------
    products : int
        Applications of F.
    number : int
        Linear solves.
    residual : float
        The largest energy norm of a residual, relative to that of no displacement.
    """

    def __init__(self, state: SolvedState, rtol: float) -> None:
        self._state, self._rtol = state, rtol
        self.products, self.number, self.residual = 0, 0, 0.0

    def solve(self, data: LinearData) -> LinearSolution:
        """Solve with loads, jumps and forces. Collective."""
        solution = self._state.linear.solve(data, self._rtol)
        self.products += solution.products
        self.number += 1
        self.residual = max(self.residual, solution.residual)
        return solution

    def by_gmres(self, apply: Callable[[Vector], Vector], b: Vector) -> Vector:
        """Solve apply(y) = b for numbers at sites, of which each rank has a part. Collective."""
        comm = self._state.torn.nodes.comm
        space = Space(sum_over_ranks=comm.allreduce)
        norm, (_, size) = space.norm(b), first_of_rank(comm, b.size)
        vectors, y, left = gmres(
            lambda v: (v, apply(v)), b, space, tolerance=self._rtol * norm, max_it=size
        )
        self.residual = max(self.residual, left / norm if norm > 0.0 else 0.0)
        total: Vector = sum((c * v for c, v in zip(y, vectors, strict=True)), np.zeros_like(b))
        return total

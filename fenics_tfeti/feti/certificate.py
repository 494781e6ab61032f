"""The certificate: how well displacements and multipliers solve the primal problem (11.21)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.feti.dual.operator import DualOperator
from fenics_tfeti.feti.local.congruence import apply_by_class, times_rows

__all__ = ["Certificate", "PrimalProblem"]

Vector = NDArray[np.float64]

# forces and energies below this part of the uncancelled sums |K||u| count as none
_CANCELLED = 1e-6


@dataclass(frozen=True)
class Certificate:
    """How well displacements and multipliers solve (11.21), from K, f, B and c alone.

    All numbers are relative; all are zero for an exact solution.

    Attributes
    ----------
    equilibrium : float
        ||Ku - f + B'lambda|| / max(||f||, ||B'lambda||).
    gluing : float
        Largest component of B_E u - c_E relative to the largest displacement.
    penetration : float
        Largest violation of (u_slave - u_master)'n <= gap, relative to the largest displacement.
    smallest_force : float
        Smallest contact force relative to the largest; negative numbers pull.
    complementarity : float
        Largest product of force and distance, relative to the largest force times the largest
        displacement.
    duality_gap : float
        Difference of primal energy and dual value, relative to the primal energy.
    """

    equilibrium: float
    gluing: float
    penetration: float
    smallest_force: float
    complementarity: float
    duality_gap: float

    @property
    def worst(self) -> float:
        """The largest violation."""
        values = asdict(self)
        values["smallest_force"] = max(0.0, -self.smallest_force)
        return float(max(values.values()))


@dataclass(frozen=True)
class PrimalProblem:
    """K, f, B and c of (11.21) on this rank.

    Attributes
    ----------
    stiffness : list of (n_i, n_i) scipy.sparse.csr_matrix
        K_i of each class of congruent subdomains [N/m].
    load : (n,) array
        f [N].
    c : (m,) array
        Right-hand sides of the constraints.
    F : DualOperator
        For B.
    """

    stiffness: list[sp.csr_matrix]
    load: Vector
    c: Vector
    F: DualOperator

    def internal_forces(self, u: Vector) -> Vector:
        """Return Ku."""
        return self._apply(self.stiffness, u)

    def _apply(self, matrices: Sequence[sp.csr_matrix], u: Vector) -> Vector:
        operators = [partial(times_rows, K) for K in matrices]
        return apply_by_class(self.F.interface.classes, operators, u)

    def energy(self, u: Vector) -> float:
        """Return 1/2 u'Ku - f'u [J]."""
        comm = self.F.constraints.layout.comm
        return float(comm.allreduce(float(u @ (0.5 * self.internal_forces(u) - self.load))))

    def certify(self, u: Vector, multipliers: Vector) -> Certificate:
        """Measure how well u and lambda solve the primal problem."""
        constraints = self.F.constraints
        comm, space = constraints.layout.comm, constraints.layout.space
        Ku = self.internal_forces(u)
        constraint_forces = self.F.constraint_forces(multipliers)
        residual, f, reaction, Ku_u, f_u = comm.allreduce(
            np.array(
                [
                    np.sum((Ku - self.load + constraint_forces) ** 2),
                    np.sum(self.load**2),
                    np.sum(constraint_forces**2),
                    Ku @ u,
                    self.load @ u,
                ]
            )
        )
        # what is left of cancelling stiffness times displacement is rounding, not a force or energy
        rhs_gap = self.c[constraints.inequality] / constraints.scale
        largest_gap = comm.allreduce(float(np.abs(rhs_gap).max(initial=0.0)), MPI.MAX)
        size = np.maximum(np.abs(u), _CANCELLED * largest_gap)
        spring = self._apply([abs(K) for K in self.stiffness], size)
        spring2, strain = comm.allreduce(np.array([spring @ spring, size @ spring]))
        jump = self.F.jumps(u) - self.c
        contact = constraints.inequality
        distance = jump[contact] / constraints.scale
        normal_force = multipliers[contact] * constraints.scale
        maxima = np.array(
            [
                size.max(initial=0.0),
                np.abs(jump[constraints.equality]).max(initial=0.0),
                distance.max(initial=0.0),
                normal_force.max(initial=0.0),
                (-normal_force).max(initial=-np.inf),
                np.abs(distance * normal_force).max(initial=0.0),
            ]
        )
        comm.Allreduce(MPI.IN_PLACE, maxima, MPI.MAX)
        largest_u, gluing, penetration, force, pull, product = maxima
        # L(u, lambda) with the u that minimises it is the dual value; (11.25) makes it
        # -1/2 u'Ku - c'lambda
        primal = 0.5 * Ku_u - f_u
        dual = -0.5 * Ku_u - space.dots((self.c, multipliers))[0]
        return Certificate(
            equilibrium=_ratio(
                np.sqrt(residual), max(np.sqrt(max(f, reaction)), _CANCELLED * np.sqrt(spring2))
            ),
            gluing=_ratio(gluing, largest_u),
            penetration=_ratio(penetration, largest_u),
            smallest_force=_ratio(-pull, force) if np.isfinite(pull) else 0.0,
            complementarity=_ratio(product, force * largest_u),
            duality_gap=_ratio(
                abs(primal - dual), max(abs(primal), 0.5 * Ku_u, _CANCELLED * strain)
            ),
        )


def _ratio(value: float, scale: float) -> float:
    return float(value / scale) if scale > 0.0 else float(value)

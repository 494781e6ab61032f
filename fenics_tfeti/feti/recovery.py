"""From multipliers to displacements (11.29), and the certificate of the primal problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.optimize import nnls

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.dual.operator import DualOperator
from fenics_tfeti.feti.local.congruence import apply_by_class, times_rows
from fenics_tfeti.parallel import concatenate_ranks

__all__ = ["Certificate", "PrimalProblem", "least_distance", "recover_displacement"]

Vector = NDArray[np.float64]

# forces and energies below this part of the uncancelled sums |K||u| count as none
_CANCELLED = 1e-6
# rounds of taking in violated conditions
_CUTS = 100
# residual of the least-distance problem that says that there is no solution
_NO_ROOM = 1e-12


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


def recover_displacement(
    F: DualOperator, space: CoarseSpace, load: Vector, multipliers: Vector
) -> tuple[Vector, Projector]:
    """Return u = K^+(f - B'lambda) + R alpha (11.29).

    alpha makes the equality rows and the active inequality rows hold, in the least squares sense;
    where these leave motions free, it is the one of smallest norm that penetrates nothing.

    Parameters
    ----------
    F : DualOperator
        K^+ and B.
    space : CoarseSpace
        G.
    load : (n,) array
        f of this rank's subdomains [N].
    multipliers : (m,) array
        lambda.

    Returns
    -------
    displacement : (n,) array
        u of this rank's subdomains [m].
    active : Projector
        That of the equality and active rows; its ``free`` motions are those left undetermined.
    """
    constraints = F.constraints
    forces = load - F.constraint_forces(multipliers)
    # what the stopping test left in the kernel of K; K^+ would turn it into a displacement
    u = F.generalized_inverse(forces - space.motion(space.work(forces)))

    active = Projector.build(space, multipliers[constraints.inequality] > 0.0)
    alpha = active.coefficients(constraints.rhs - F.jumps(u))
    # K^+ leaves some of the free motions in u
    present = alpha + space.work(u)
    alpha -= active.free @ (active.free.T @ present)
    u += space.motion(alpha)
    if active.free.shape[1]:
        away = _out_of_the_way(space, active, constraints.rhs - F.jumps(u))
        u += space.motion(active.free @ away)
    return u, active


def _out_of_the_way(space: CoarseSpace, active: Projector, room: Vector) -> Vector:
    """Return the smallest free motions (in the basis ``active.free``) that penetrate nothing.

    Bodies that nothing presses together may part, but not overlap. The conditions are taken in as
    they are violated: the worst of each contact and rank at a time.
    """
    constraints, comm = space.constraints, space.comm
    owned = constraints.inequality[: constraints.owned_inequalities]
    inactive = np.flatnonzero(~active.columns[owned])
    contact = constraints.contact[inactive]
    closing = np.asarray(space.contact[:, inactive].T @ active.free)
    room = room[owned[inactive]]
    z = np.zeros(active.free.shape[1])
    taken, limits = np.zeros((0, z.size)), np.zeros(0)
    negligible = 1e-9 * comm.allreduce(float((-room).max(initial=0.0)), MPI.MAX)
    for _ in range(_CUTS):
        excess = closing @ z - room
        order = np.lexsort((-excess, contact))
        worst = order[np.unique(contact[order], return_index=True)[1]]
        worst = worst[excess[worst] > negligible]
        new = concatenate_ranks(comm, closing[worst])
        if not len(new):
            break
        taken = np.concatenate([taken, new])
        limits = np.concatenate([limits, concatenate_ranks(comm, room[worst])])
        z = least_distance(taken, limits)
    return z


def least_distance(A: Vector, b: Vector) -> Vector:
    """Minimise ||z|| subject to Az <= b (Lawson and Hanson, Solving Least Squares Problems, 23.4).

    Parameters
    ----------
    A : (m, k) array
        Rows of any length.
    b : (m,) array
        Right-hand sides.

    Returns
    -------
    (k,) array
        The solution; zeros if no z fulfils the conditions.

    Examples
    --------
    >>> import numpy as np
    >>> z = least_distance(np.array([[-1.0, 0.0], [0.0, -2.0]]), np.array([-1.0, 4.0]))
    >>> (z.round(12) + 0.0).tolist()
    [1.0, 0.0]
    """
    scale = float(np.abs(b).max(initial=0.0))
    if scale == 0.0:
        return np.zeros(A.shape[1])
    lengths = np.maximum(np.linalg.norm(A, axis=1), np.finfo(float).tiny)
    rows = np.vstack([A.T / lengths, b / lengths / scale])
    target = np.append(np.zeros(A.shape[1]), 1.0)
    weights = nnls(-rows, target, maxiter=10 * max(A.shape))[0]
    residual = -rows @ weights - target
    if np.linalg.norm(residual) <= _NO_ROOM:
        return np.zeros(A.shape[1])
    z: Vector = -scale * residual[:-1] / residual[-1]
    return z


@dataclass(frozen=True)
class PrimalProblem:
    """K, f, B and c of (11.21) on this rank, and what they say of a solution.

    Attributes
    ----------
    stiffness : list of (n_i, n_i) scipy.sparse.csr_matrix
        K_i of each class of congruent subdomains [N/m].
    load : (n,) array
        f [N].
    F : DualOperator
        For B and c.
    """

    stiffness: list[sp.csr_matrix]
    load: Vector
    F: DualOperator

    def internal_forces(self, u: Vector) -> Vector:
        """Return Ku."""
        return self._apply(self.stiffness, u)

    def _apply(self, matrices: Sequence[sp.csr_matrix], u: Vector) -> Vector:
        operators = [partial(times_rows, K) for K in matrices]
        return apply_by_class(self.F.interface.classes, operators, u)

    def energy(self, u: Vector) -> float:
        """Return 1/2 u'Ku - f'u [J]."""
        comm = self.F.constraints.multipliers.comm
        return float(comm.allreduce(float(u @ (0.5 * self.internal_forces(u) - self.load))))

    def certify(self, u: Vector, multipliers: Vector) -> Certificate:
        """Measure how well u and lambda solve the primal problem."""
        constraints = self.F.constraints
        comm, space = constraints.multipliers.comm, constraints.multipliers.space
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
        rhs_gap = constraints.rhs[constraints.inequality] / constraints.scale
        largest_gap = comm.allreduce(float(np.abs(rhs_gap).max(initial=0.0)), MPI.MAX)
        size = np.maximum(np.abs(u), _CANCELLED * largest_gap)
        spring = self._apply([abs(K) for K in self.stiffness], size)
        spring2, strain = comm.allreduce(np.array([spring @ spring, size @ spring]))
        jump = self.F.jumps(u) - constraints.rhs
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
        dual = -0.5 * Ku_u - space.dots((constraints.rhs, multipliers))[0]
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

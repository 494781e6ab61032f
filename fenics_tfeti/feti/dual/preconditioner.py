"""Lumped and Dirichlet preconditioners in the face (sec. 11.12).

B_D S B_D' with B_D = (B_R D^{-1} B_R')^{-1} B_R D^{-1} of the rows R of the face: of all rows but
the coupled ones this is B D^{-1}, of those W_RR^{-1} B D^{-1} (`constraints.coupling`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

from mpi4py import MPI

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.feti.constraints.coupling import RowInverse, null_space
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.dual.deluxe_scaling import DeluxeScaling
from fenics_tfeti.feti.dual.direct_faces import DirectFaces
from fenics_tfeti.feti.dual.operator import DualOperator
from fenics_tfeti.feti.factors.cholesky import sparse_cholesky
from fenics_tfeti.feti.local.congruence import dense_if_small, times_rows
from fenics_tfeti.feti.local.generalized_inverse import regularized_stiffness
from fenics_tfeti.feti.local.trial_displacements import TrialDisplacements
from fenics_tfeti.feti.tolerances import ZERO
from fenics_tfeti.typing import Mask, Numbers, Operator, Vector

PreconditionerKind = Literal["auto", "lumped", "dirichlet", "none"]

# bulk over shear modulus from which on the Dirichlet preconditioner takes less time: Poisson's
# ratio 0.48
_INCOMPRESSIBLE = 25.0
# part of the stiffness of a node that springs are compared with: with 1, or without springs in the
# preconditioner, soft springs take twice the steps
_SPRINGS = 0.1


@dataclass
class Preconditioner:
    """B_D S B_D' on the faces of a dual problem, or their direct solvers."""

    # x -> this rank's part of B D^{-1} S D^{-1} B'x, see `interface_operator`
    apply: Callable[[Vector], Vector]
    constraints: Constraints
    unit: float  # stiffness that a weight of 1 stands for [N/m]
    scaling: DeluxeScaling | None = None  # of stiff modes, which `apply` has too
    direct: DirectFaces | None = None  # for faces that converge slowly; None where K is indefinite
    # whether faces are solved directly: conjugate gradients were slow on one, now or before
    is_direct: bool = False

    def for_solve(self, is_direct: bool) -> Preconditioner:
        """Return that of one solve, in which faces are solved directly from the start, or not."""
        return replace(self, is_direct=is_direct and self.direct is not None)

    def on(self, face: Face) -> Operator:
        """Return x -> this rank's part of Mx, x zero off the face. Collective.

        M is B_D S B_D', scaled where forces turn and where springs are, and the inverse of C on
        what B_D S B_D' does not see.
        """
        precondition = self._of_rows(face.touched)
        if face.tangents is not None:
            precondition = _scaled(precondition, face, self.unit)
        if face.springs is not None:
            precondition = _scaled_by_springs(precondition, face, self.unit)
        kernel = self.on_kernel(face)
        if kernel is None:
            return precondition
        return lambda x: precondition(x) + kernel(x)

    def _of_rows(self, rows: Mask) -> Operator:
        """Return x -> this rank's part of B_D S B_D'x of some rows (m,). Collective."""
        coupling = self.constraints.coupling
        if not coupling.numbers.size and self.scaling is None:
            return self.apply
        inverse = self._inverse_of(rows)
        if self.scaling is not None:
            return self._with_scaling(self.scaling.on_face(rows, inverse))

        def precondition(x: Vector) -> Vector:
            x = x.copy()
            x[coupling.rows] = inverse.solve(coupling.gather(x)[0])[coupling.positions]
            part = self.apply(x)
            closed = inverse.solve(coupling.sum(part))[coupling.positions]
            # the sum over the ranks is known already: it is its owner's part
            part[coupling.rows] = np.where(coupling.owned, closed, 0.0)
            return part

        return precondition

    def becomes_direct(self, steps: int) -> bool:
        """Tell if faces are solved directly from now on, after some steps on one. Collective."""
        if self.direct is None or self.is_direct:
            return False
        self.is_direct = steps >= self.direct.patience
        return self.is_direct

    def _with_scaling(self, close: Operator) -> Operator:
        layout = self.constraints.layout
        return lambda x: layout.owned_part(close(layout.sum(self.apply(close(x)))))

    def kernel_part(self, x: Vector, face: Face) -> Vector | float:
        """Return the part of x that the preconditioner of a face takes to zero. Collective.

        It is that in the kernel of W_RR, along which the face has neither forces nor energy.
        """
        coupling = self.constraints.coupling
        if not coupling.groups:
            return 0.0
        null = self._inverse_of(face.rows).null
        part = np.zeros_like(x)
        part[coupling.rows] = (null @ (null.T @ coupling.gather(x)[0]))[coupling.positions]
        return part

    def on_kernel(self, face: Face) -> Operator | None:
        """Return x -> this rank's part of N (N'CN)^+ N'x. Collective.

        N are the combinations of rows of a face that vanish, B'N = o: neither F nor B_D S B_D' sees
        them, but C does. None if C does not see N, on all ranks.
        """
        coupling = self.constraints.coupling
        if not coupling.groups or (face.tangents is None and face.compliance is None):
            return None
        kernel = self._inverse_of(face.touched).null.toarray()
        if not kernel.shape[1]:
            return None
        turned = None
        if face.tangents is not None:
            kernel, turned, curvature = self._turning(kernel, face.tangents, face.curvature)
        hessian = face.proximal_compliance * np.identity(kernel.shape[1])
        if turned is not None:
            hessian += turned.T @ (curvature * turned)
        springs = face.spring_compliance
        if springs is not None:
            hessian += kernel.T @ (coupling.gather(springs)[0][:, None] * kernel)
        if not hessian.any():
            return None
        inverse = np.linalg.pinv(hessian, rcond=ZERO, hermitian=True)

        def apply(x: Vector) -> Vector:
            y = kernel @ (inverse @ (kernel.T @ coupling.gather(x)[0]))
            part = np.zeros_like(x)
            part[coupling.rows] = np.where(coupling.owned, y[coupling.positions], 0.0)
            return part

        return apply

    def _turning(
        self, kernel: Vector, tangent: Vector, curvature: Vector
    ) -> tuple[Vector, Vector, Vector]:
        """Return the part of a kernel that forces of a given size have no part in along themselves.

        With it what it turns the force of each site by, and the curvature there. Collective.
        """
        constraints, coupling = self.constraints, self.constraints.coupling
        friction, size = constraints.friction, constraints.size
        along, number = tangent[:, ::-1] * [1.0, -1.0], friction.numbers(constraints.layout)
        at_sites = (tangent, along, number, curvature)
        turns, along, site, curvature = coupling.gather(
            *(friction.spread(x, size) for x in at_sites)
        )
        turning = np.flatnonzero(np.abs(turns) + np.abs(along) > 0.0)
        if not turning.size:
            return kernel, np.zeros((0, kernel.shape[1])), np.zeros((0, 1))
        _, first, at = np.unique(site[turning], return_index=True, return_inverse=True)
        places, shape = (at.ravel(), turning), (first.size, site.size)
        fixed = _without_rounding(sp.csr_matrix((along[turning], places), shape) @ kernel)
        kernel = kernel @ null_space(fixed.T @ fixed)
        moved = _without_rounding(sp.csr_matrix((turns[turning], places), shape) @ kernel)
        return kernel, moved, curvature[turning[first]][:, None]

    def _inverse_of(self, rows: Mask) -> RowInverse:
        """Factor W_RR of rows (m,). Collective."""
        coupling = self.constraints.coupling
        return coupling.inverse(coupling.gather(rows.astype(float))[0] > 0.0)


def _scaled(apply: Operator, face: Face, unit: float) -> Operator:
    """Return the preconditioner with forces that turn scaled for their curvature.

    Where F has an inverse m, which is about the unit of stiffness for rows of length 1, the inverse
    of F + curvature is m / (1 + curvature m).
    """
    friction, tangents = face.constraints.friction, face.tangents
    assert tangents is not None
    less = 1.0 - 1.0 / np.sqrt(1.0 + unit * face.curvature)

    def scale(x: Vector) -> Vector:
        size = less * np.sum(friction.at_sites(x) * tangents, axis=1)
        return x - friction.spread(size[:, None] * tangents, x.size)

    return lambda x: scale(apply(scale(x)))


def _scaled_by_springs(apply: Operator, face: Face, unit: float) -> Operator:
    """Return the preconditioner with spring rows scaled for their compliance C.

    The factor 1 in place of `_SPRINGS` is right where F has the inverse `unit`, which it has along
    the smallest waves of a surface; of larger ones it is more flexible.
    """
    springs = face.spring_compliance
    assert springs is not None
    scale = 1.0 / np.sqrt(1.0 + _SPRINGS * unit * springs)
    return lambda x: scale * apply(scale * x)


def _without_rounding(x: Vector) -> Vector:
    """Return combinations of unit vectors, with zeros for those that cancel up to rounding."""
    return np.where(np.abs(x) > ZERO, x, 0.0)


@dataclass(frozen=True)
class Choice:
    """A preconditioner, and why "auto" has chosen it."""

    kind: PreconditionerKind
    reason: str = ""

    @staticmethod
    def by_data(comm: MPI.Intracomm, ratios: Sequence[float], excesses: Sequence[float]) -> Choice:
        """Return what "auto" stands for. Collective.

        For each class of congruent subdomains the bulk over the shear modulus and `lumped_excess`.
        An application of the Dirichlet preconditioner takes at most as long as a product with F; it
        pays where half as many products are needed, with a quarter of the condition number.
        """
        largest = np.array([max(ratios, default=0.0), max(excesses, default=0.0)])
        comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
        ratio, excess = largest
        if ratio > _INCOMPRESSIBLE:
            return Choice("dirichlet", "nearly incompressible material")
        if excess > 4.0:
            return Choice("dirichlet", "flat or graded cells at interfaces")
        return Choice("lumped")

    def with_stiff_modes(self, number: int) -> Choice:
        """Return the same, with a number of stiff modes that have weights of their own."""
        modes = f"{number} stiff modes"
        return Choice(self.kind, f"{self.reason}, {modes}" if self.reason else modes)


def lumped_excess(reaction: Operator, trial: TrialDisplacements, edge: float) -> float:
    """Return the condition number of PMPF with the lumped over that with Dirichlet's, estimated.

    The lumped one's is the largest eigenvalue of S^+ K_bb, at least what uniform strains show;
    Dirichlet's is about (1 + log(H / h))^2. The reaction is K_bb, H / h is nodes along an edge.
    """
    u = trial.values[: trial.strains]
    largest = trial.largest(u @ reaction(u).T)
    return float(largest / (1.0 + np.log(edge)) ** 2)


def interface_operator(
    F: DualOperator, reactions: Sequence[Operator], scaling: DeluxeScaling | None = None
) -> Operator:
    """Return this rank's part of x -> B D^{-1} S D^{-1} B'x, S the stiffness of interfaces.

    The interface is what B has entries on; the reactions are S of each class of congruent
    subdomains, for rows (k, b). The scaling has other weights than D.
    """
    interface = F.interface
    flexibility = 1.0 / F.constraints.weights[interface.columns]
    weighted = scaling.displacements if scaling else lambda forces: flexibility * forces

    def apply(x: Vector) -> Vector:
        displacements = weighted(interface.transposed @ x)
        return interface.matrix @ weighted(interface.apply(reactions, displacements))

    return apply


def interface_reactions(
    kind: PreconditionerKind,
    unknowns: Sequence[Numbers],
    stiffness: Sequence[sp.csr_matrix],
    kernels: Sequence[Vector],
    package: str,
) -> list[Operator]:
    """Return the forces on the interface as a function of its displacements, for each class.

    Lumped takes K_bb, the interior held still; Dirichlet the Schur complement
    K_bb - K_bi K_ii^{-1} K_ib, the interior free to follow. K_i is (n, n), its kernel R_i (n, k).
    """
    return [
        _reaction(kind, K, R, local, package)
        for K, R, local in zip(stiffness, kernels, unknowns, strict=True)
    ]


def _reaction(
    kind: str, K: sp.csr_matrix, R: Vector, local: NDArray[np.int64], package: str
) -> Operator:
    """Return the forces on a subdomain's interface as a function of its displacements there."""
    rows = K[local]
    K_bb = rows[:, local].tocsr()
    interior = np.delete(np.arange(K.shape[0]), local)
    if kind == "lumped" or 0 in (interior.size, local.size, K.nnz):
        return partial(times_rows, dense_if_small(K_bb))
    K_bi = rows[:, interior].tocsr()
    K_ib = K_bi.T.tocsr()
    factor = sparse_cholesky(_held_interior(K, R, local, interior), package)

    def schur_complement(u: Vector) -> Vector:
        follow = factor.solve(K_ib @ u.T if len(u) > 1 else K_ib @ u[0])
        return times_rows(K_bb, u) - (K_bi @ follow).T

    return schur_complement


def _held_interior(
    K: sp.csr_matrix, R: Vector, local: NDArray[np.int64], interior: NDArray[np.int64]
) -> sp.csr_matrix:
    """Return K_ii, regularised for rigid motions that do not move the unknowns of the interface.

    These do no work on K_ib u, so that any generalized inverse of K_ii gives the same reactions.
    """
    K_ii = K[interior][:, interior].tocsr()
    # R is orthonormal: motions that do not move the interface are so beside 1, not beside others
    _, moves, motions = np.linalg.svd(np.linalg.qr(R[local], mode="r"))
    left = motions[np.count_nonzero(moves > ZERO) :].T
    if not left.shape[1]:
        return K_ii
    N = R[interior] @ left
    # as many unknowns as motions, which tell these apart best
    held = scipy.linalg.qr(N.T, mode="r", pivoting=True)[1][: left.shape[1]]
    return regularized_stiffness(K_ii, N, held.astype(np.int64))

"""SMALBE-M on the dual problem with projector preconditioning, (11.40).

    minimise 1/2 x'(PFP + rho Q)x - x'Pd_0  subject to  Gx = o,  x_I >= -lambda~_I,

and |lambda~_T + x_T| <= r where there is friction, with lambda = lambda~ + x, the feasible lambda~
of (11.37) and d_0 = d - F lambda~. F is scaled by ||PFP||, so that ||PFP + rho Q|| = max(1, rho).

Springs add C l^2 / 2 to the cost, with another C for pulls than for pushes. The multiplier of a row
that may pull is split, l = l+ - l- with both parts nonnegative, each with its own C: bounds again.
At the solution one of them is zero. Parts of large C are scaled, so that the Hessian stays small.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from mpi4py import MPI

import numpy as np

from fenics_tfeti.feti import interruption
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.constraints.springs import Springs
from fenics_tfeti.feti.dual.face_operators import FaceOperators
from fenics_tfeti.feti.dual.iterate import Iterate, Method, SolveStatus, Turn
from fenics_tfeti.feti.dual.pcpg import first_iterate
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.qp import (
    Bounds,
    Discs,
    ProductSet,
    ProportioningOptions,
    SMALBEOptions,
    SMALBEState,
    Space,
    Unbounded,
    smalbe,
)
from fenics_tfeti.typing import Mask, Numbers, Vector


class _Stopped(Exception):  # noqa: N818 - no error
    """SMALBE-M was interrupted, on all ranks."""


def solve_by_smalbe(problem: DualProblem, start: Iterate, turn: Turn) -> Iterate:
    """Run SMALBE-M on (11.40).

    The norm of the problem has to be an upper bound of ||PFP||. Returns the start where SMALBE-M is
    interrupted or finds no curvature.
    """
    norm, options = problem.norm, turn.options
    start = replace(start, method=Method.SMALBE)
    parts = None if problem.springs is None else _Parts.of(problem, problem.springs)
    programme = _Programme.of(problem, options.smalbe_rho)
    if parts is not None:
        programme = parts.split(programme, options.smalbe_rho)
    state = _first_state(problem, parts, start, turn)
    norm_b = problem.energy_norm * np.sqrt(norm)
    try:
        result = smalbe(
            _until_interrupted(programme.hessian),
            programme.b,
            programme.feasible,
            replace(state, q=state.q / norm),
            norm_b=norm_b / norm,
            options=_smalbe_options(
                turn, turn.tolerance / (problem.energy_norm or 1.0), programme.norm
            ),
            space=programme.space,
            precondition=programme.precondition,
            products=turn.products,
            monitor=turn.monitor,
        )
    except Unbounded:
        return replace(start, status=SolveStatus.FLAT)
    except _Stopped:
        return replace(start, status=SolveStatus.INTERRUPTED)
    state = replace(result.state, q=norm * result.state.q)
    if result.converged:
        # a balance parameter that the smaller tolerance of the next pass starts anew
        state = replace(state, M=None)
    x = state.x if parts is None else parts.joined(state.x)
    return replace(
        start.remembering(Method.SMALBE, state),
        multipliers=problem.feasible + x,
        status=_STATUS[result.reason],
        on_face=None,
    )


_STATUS = {
    "converged": SolveStatus.SOLVED,
    "slow": SolveStatus.STALLED,
    "max_products": SolveStatus.STALLED,
    "max_it": SolveStatus.OUT_OF_STEPS,
}


@dataclass(frozen=True)
class _Programme:
    """Minimise 1/2 x'Ax - b'x subject to Gx = o on a feasible set."""

    hessian: Callable[[Vector], tuple[Vector, Vector]]  # x -> Ax + rho Qx, Qx
    b: Vector
    feasible: ProductSet
    norm: float  # an upper bound of ||A + rho Q||
    space: Space
    precondition: Callable[[Vector, Numbers], Vector] | None

    @staticmethod
    def of(problem: DualProblem, rho: float) -> _Programme:
        """Return (11.40), without springs."""
        return _Programme(
            augmented_hessian(problem, rho),
            problem.projector.P(problem.d_0) / problem.norm,
            problem.multiplier_set(problem.feasible),
            max(1.0, rho),
            problem.space,
            _augmented_preconditioner(problem, rho),
        )


@dataclass(frozen=True)
class _Parts:
    """The parts y of the multipliers, l = lambda~ + x with x = E y, of rows with springs.

    Parts that this rank owns come first, as its rows do.
    """

    problem: DualProblem
    springs: Springs
    row: Numbers  # (n,): local position of each part's row
    factor: Vector  # (n,): entry of E: negative for l-
    compliance: Vector  # (n,): C of the part, over ||PFP||
    start: Vector  # (n,): the part of lambda~, which its y adds to
    is_bounded: Mask  # (n,): whether the part is not negative: that of a contact row
    pair: Numbers  # (p, 2): the parts l+ and l- of each row that is split

    @staticmethod
    def of(problem: DualProblem, springs: Springs) -> _Parts:
        """Split the rows that may pull and are stiffer or softer then. Collective."""
        layout, rows = problem.constraints.layout, problem.constraints.inequality
        size, split = layout.numbers.size, springs.pulling & (springs.pulled != springs.pressed)
        pressed, pulled = np.zeros((2, size))
        pressed[rows], pulled[rows[split]] = springs.pressed, springs.pulled[split]
        pressed += problem.constraints.friction.spread(springs.sticking, size)
        row = np.concatenate([np.arange(size), rows[split]])
        is_pull = np.arange(row.size) >= size
        order = np.argsort(row >= layout.owned, kind="stable")
        row, is_pull = row[order], is_pull[order]
        compliance = np.where(is_pull, pulled[row], pressed[row]) / problem.norm
        # with y in place of s y the diagonal of the Hessian is C s^2 / (1 + C s^2) or less
        factor = np.where(is_pull, -1.0, 1.0) / np.sqrt(1.0 + compliance)
        both = np.isin(row, rows[split])
        start = problem.feasible[row] / factor
        start[both] = np.maximum(start[both], 0.0)
        is_bounded = both | np.isin(row, rows[~springs.pulling])
        place = np.argsort(row[both], kind="stable")
        # of the parts of a row the one that pushes comes first
        pair = np.flatnonzero(both)[place].reshape(-1, 2)
        return _Parts(problem, springs, row, factor, compliance, start, is_bounded, pair)

    @property
    def stiffness(self) -> Vector:
        """The diagonal (n,) that springs add to the Hessian."""
        return self.compliance * self.factor**2

    def joined(self, y: Vector) -> Vector:
        """Return E y."""
        return self._sums(self.factor * y)

    def _sums(self, of_parts: Vector) -> Vector:
        """Return the sums (m,) of values of the parts of each row."""
        return np.bincount(self.row, of_parts, self.problem.feasible.size).astype(np.float64)

    def transposed(self, x: Vector) -> Vector:
        """Return E'x."""
        return self.factor * x[self.row]

    def of_multipliers(self, multipliers: Vector) -> Vector:
        """Return the y (n,) of multipliers, one part of each row zero."""
        parts = multipliers[self.row] / self.factor
        split = self.pair.ravel()
        parts[split] = np.maximum(parts[split], 0.0)
        return parts - self.start

    def split(self, programme: _Programme, rho: float) -> _Programme:
        """Return the programme for the parts."""
        problem, stiffness = self.problem, self.stiffness

        def hessian(y: Vector) -> tuple[Vector, Vector]:
            product, Qx = programme.hessian(self.joined(y))
            return self.transposed(product) + stiffness * y, self.transposed(Qx)

        columns = self._sums(self.factor**2)
        largest = np.array([columns.max(initial=0.0), stiffness.max(initial=0.0)])
        problem.constraints.layout.comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
        owned = int(np.count_nonzero(self.row < problem.constraints.layout.owned))
        return _Programme(
            hessian,
            self.transposed(programme.b) - stiffness * self.start,
            self._feasible_set(),
            float(largest[0] * programme.norm + largest[1]),
            replace(problem.space, owned=owned),
            self._preconditioner(rho),
        )

    def _feasible_set(self) -> ProductSet:
        """Return the set of the parts: bounds of contact rows, and that of friction."""
        feasible = self.problem.multiplier_set(self.problem.feasible)
        place = np.full(self.problem.feasible.size, -1)
        place[self.row[::-1]] = np.arange(self.row.size)[::-1]
        # tangential rows have one part
        bounds, at = feasible.bounds, place[feasible.bounds.indices]
        lower, upper = np.full((2, self.row.size), [[-np.inf], [np.inf]])
        lower[at], upper[at] = bounds.lower / self.factor[at], bounds.upper / self.factor[at]
        lower[self.is_bounded] = -self.start[self.is_bounded]
        discs = feasible.discs
        if discs is not None:
            at = place[discs.indices]
            factor = self.factor[at[:, 0]]
            discs = Discs(at, discs.centre / factor[:, None], discs.radius / factor)
        return ProductSet(Bounds.from_vector(lower, upper), discs)

    def _preconditioner(self, rho: float) -> Callable[[Vector, Numbers], Vector] | None:
        """Return E^+ M^{-1} E^+' of the free parts, M^{-1} that of rows with these springs.

        Where both parts of a row are free, the inverse of C is added along the motion that leaves
        their difference as it is.
        """
        if self.problem.preconditioner is None:
            return None
        first, second = self.pair.T

        def apply(y: Vector, on_bounds: Numbers) -> Vector:
            factor = self.factor.copy()
            factor[on_bounds] = 0.0
            squares = self._sums(factor**2)
            inverse = np.divide(
                factor, squares[self.row], out=np.zeros_like(factor), where=factor != 0.0
            )
            pressing = np.zeros(squares.size, dtype=bool)
            pressing[self.row[factor > 0.0]] = True
            active = pressing[self.problem.constraints.inequality]
            face = replace(
                Face.of_rows(self.problem.constraints, squares > 0.0),
                active=active,
                springs=self.springs,
            )
            x = self._sums(inverse * y)
            z = inverse * _precondition(self.problem, face, x, rho)[self.row]
            along = factor[second] * y[first] - factor[first] * y[second]
            both = (factor[first] != 0.0) & (factor[second] != 0.0)
            a, b = first[both], second[both]
            curvature = self.stiffness[a] * factor[b] ** 2 + self.stiffness[b] * factor[a] ** 2
            along = along[both] / curvature
            z[a] += along * factor[b]
            z[b] -= along * factor[a]
            return z

        return apply


def _first_state(
    problem: DualProblem, parts: _Parts | None, start: Iterate, turn: Turn
) -> SMALBEState:
    """Return the first x, and G'mu = Q(Fl - d) + G'a, which costs a product where it is unknown."""
    known: SMALBEState | None = start.memory.get(Method.SMALBE)
    if known is not None:
        return known
    x, on_face = start.multipliers - problem.feasible, start.on_face
    if on_face is None and problem.space.norm(start.multipliers) > 0.0:
        face = problem.face_of(start.multipliers, start.active)
        operators = FaceOperators.build(problem, Projector.build(problem.coarse_space, face))
        on_face = first_iterate(problem, operators, start.multipliers, turn.products)
    q = np.zeros_like(x) if on_face is None else problem.projector.Q(on_face.gradient)
    if parts is not None:
        return SMALBEState(parts.of_multipliers(start.multipliers), parts.transposed(q))
    return SMALBEState(x, q)


def _until_interrupted(
    hessian: Callable[[Vector], tuple[Vector, Vector]],
) -> Callable[[Vector], tuple[Vector, Vector]]:
    def apply(x: Vector) -> tuple[Vector, Vector]:
        if interruption.agreed():
            raise _Stopped
        return hessian(x)

    return apply


def augmented_hessian(
    problem: DualProblem, rho: float
) -> Callable[[Vector], tuple[Vector, Vector]]:
    """Return x -> (PFP / ||PFP|| + rho Q)x, Qx, the Hessian of (11.40)."""
    projector, layout = problem.projector, problem.constraints.layout

    def apply(x: Vector) -> tuple[Vector, Vector]:
        part, Qx = projector.part_of_Q(x)
        y = projector.part_of_P(problem.F(x - Qx)) / problem.norm
        product, Qx = layout.sum(np.column_stack([y + rho * part, part])).T.copy()
        return product, Qx

    return apply


def _augmented_preconditioner(
    problem: DualProblem, rho: float
) -> Callable[[Vector, Numbers], Vector] | None:
    """Return M^{-1} = ||PFP|| P B_D S B_D' P + Q / rho, for the Hessian of (11.40).

    B_D is that of the rows whose multipliers are free. Where these depend on each other the cost
    falls without curvature, until one of them meets its bound; M^{-1} is the identity there.
    """
    if problem.preconditioner is None:
        return None

    def apply(x: Vector, on_bounds: Numbers) -> Vector:
        rows = np.ones(x.size, dtype=bool)
        rows[on_bounds] = False
        return _precondition(problem, Face.of_rows(problem.constraints, rows), x, rho)

    return apply


def _precondition(problem: DualProblem, free: Face, x: Vector, rho: float) -> Vector:
    """Return M^{-1}x for the free rows."""
    preconditioner, projector = problem.preconditioner, problem.projector
    assert preconditioner is not None
    part, Qx = projector.part_of_Q(x)
    y = projector.part_of_P(preconditioner.on(free)(x - Qx))
    z = problem.constraints.layout.sum(problem.norm * y + part / rho)
    return z + preconditioner.kernel_part(x, free)


def _smalbe_options(turn: Turn, rtol: float, norm: float) -> SMALBEOptions:
    options = turn.options
    inner = ProportioningOptions(
        Gamma=options.mprgp_gamma,
        step_length=options.mprgp_alpha / norm,
        expansion=options.mprgp_expansion,
        max_products=turn.max_products,
    )
    return SMALBEOptions(
        rtol=rtol,
        rho=options.smalbe_rho,
        M0=options.smalbe_M0,
        beta=options.smalbe_beta,
        eta=options.smalbe_eta,
        max_it=max(1, turn.max_outer),
        patience=turn.patience,
        inner=inner,
    )

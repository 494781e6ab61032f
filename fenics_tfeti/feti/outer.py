"""The outer loop: from the set-up to multipliers and displacements with a certificate.

repeat
lambda   by the primal-dual active set method, or by SMALBE-M on (11.40)
u        by recovery (11.29)
stop     when the certificate of u and lambda holds
eps      is reduced by what the certificate lacks
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.feti.certificate import Certificate, PrimalProblem
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.dual.active_set import ActiveSetStep, primal_dual_active_set
from fenics_tfeti.feti.dual.augmented import solve_by_smalbe
from fenics_tfeti.feti.dual.pcpg import PCPGIterate
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.feti.options import Options
from fenics_tfeti.feti.recovery import recover_displacement
from fenics_tfeti.feti.setup import DualSetup
from fenics_tfeti.feti.timer import Timer
from fenics_tfeti.feti.tolerances import ROUNDING
from fenics_tfeti.qp import OuterIteration, Products, SMALBEState

__all__ = ["ContactData", "DualState", "Outcome", "iterate_until_certified"]

logger = logging.getLogger(__name__)

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Lanczos steps for ||PFP||: an upper bound as the scale of SMALBE-M, and a rough value as the scale
# of gaps against forces
LANCZOS_STEPS = 15
_ROUGH_LANCZOS_STEPS = 3
# contact forces and residuals below this part of ||d|| are rounding
_NEGLIGIBLE = 1e-13


@dataclass(frozen=True)
class ContactData:
    """The data of one solve: loads and right-hand sides.

    Attributes
    ----------
    load : (n,) array
        f of this rank's subdomains [N].
    c : (m,) array
        Right-hand sides of the constraints.
    e : (coarse,) array
        R'f.
    feasible : (m,) array
        lambda~ with G lambda~ = e and lambda~_I >= o.
    """

    load: Vector
    c: Vector
    e: Vector
    feasible: Vector


@dataclass(frozen=True)
class DualState:
    """An iterate of the dual problem, from which a later solve may start.

    Attributes
    ----------
    multipliers : (m,) array
        lambda.
    coarse_gradient : (m,) array
        The equality multipliers' part G'mu of the gradient.
    active : (i,) bool array or None
        Active set to start from; None for the rows with positive multipliers.
    """

    multipliers: Vector
    coarse_gradient: Vector
    active: Mask | None = None


@dataclass(frozen=True)
class Candidate:
    """A solution with its certificate.

    Attributes
    ----------
    displacement : (n,) array
        u of this rank's subdomains [m].
    multipliers : (m,) array
        lambda.
    certificate : Certificate
        How well they solve (11.21).
    active : Projector
        That of the equality rows and the active rows; its ``free`` motions are undetermined.
    """

    displacement: Vector
    multipliers: Vector
    certificate: Certificate
    active: Projector


@dataclass(frozen=True)
class Outcome:
    """Result of the outer loop.

    Attributes
    ----------
    candidate : Candidate
        The last candidate.
    state : DualState
        Where a later solve may start.
    converged : bool
        Whether the certificate holds.
    reason : str
        Why the iterations ended.
    """

    candidate: Candidate
    state: DualState
    converged: bool
    reason: str


@dataclass
class History:
    """Counters and histories of one solve.

    Attributes
    ----------
    products : Products
        Products with F by kind of step.
    outer : list of OuterIteration
        One entry for each outer iteration of SMALBE-M.
    faces : list of ActiveSetStep
        One entry for each face of the active set method.
    norm_products_before : int
        Products for ||PFP|| that were spent before.
    """

    products: Products = field(default_factory=Products)
    outer: list[OuterIteration] = field(default_factory=list)
    faces: list[ActiveSetStep] = field(default_factory=list)
    norm_products_before: int = 0


@dataclass(frozen=True)
class _Stage:
    """What one pass of the loop ends with."""

    state: DualState
    solved: bool
    reason: str = ""
    iterate: PCPGIterate | None = None


def iterate_until_certified(
    setup: DualSetup,
    data: ContactData,
    start: DualState | None,
    options: Options,
    timer: Timer,
    history: History,
) -> Outcome:
    """Solve the dual problem to tolerances that decrease until the certificate holds.

    Parameters
    ----------
    setup : DualSetup
        Operators.
    data : ContactData
        Loads and right-hand sides.
    start : DualState or None
        First iterate; multipliers that vanish by default.
    options : Options
        Methods, tolerances and limits.
    timer : Timer
        To add the times of phases to.
    history : History
        To add to.

    Returns
    -------
    Outcome
        The last candidate, and whether it is certified.
    """
    loop = _Loop.begin(setup, data, options, timer, history)
    at_rest = _is_at_rest(setup, data)
    stage = _Stage(loop.first_state(start, at_rest), solved=False)
    use_active_set = options.method == "active_set" and loop.norm_b > 0.0 and not at_rest
    rtol, limit = options.rtol, max(options.rtol, ROUNDING)
    while True:
        if use_active_set:
            stage = loop.active_set(stage, rtol)
            use_active_set = stage.solved
        if not stage.solved or not use_active_set:
            stage = loop.smalbe(stage.state, rtol)
        candidate = loop.recover(stage.state)
        worst = candidate.certificate.worst
        if worst <= limit:
            return Outcome(candidate, stage.state, True, "converged")
        if not stage.solved:
            return Outcome(candidate, stage.state, False, stage.reason)
        if rtol <= 1e-4 * options.rtol:
            reason = (
                f"the certificate's worst residual is {worst:.1e} although the dual problem is "
                "solved: the accuracy is at the limit of rounding"
            )
            return Outcome(candidate, stage.state, False, reason)
        rtol *= max(0.5 * limit / worst, 0.1)


def _is_at_rest(setup: DualSetup, data: ContactData) -> bool:
    """Tell whether nothing moves: no load, no prescribed displacement, no penetration at first.

    Displacements of rounding size, with nothing to compare them to, would never be certified.
    """
    constraints = setup.constraints
    rest = (
        not data.load.any()
        and not data.c[constraints.equality].any()
        and bool((data.c[constraints.inequality] >= 0.0).all())
    )
    return bool(constraints.layout.comm.allreduce(rest, MPI.LAND))


@dataclass(frozen=True)
class _Loop:
    """What stays the same during the outer loop.

    Attributes
    ----------
    setup, data, options, timer, history
        As given.
    d : (m,) array
        d~ = BK^+(f - B'lambda~) - c of (11.40).
    norm_b : float
        ||Pd~||, the scale of residuals.
    negligible : float
        Multipliers below this are rounding.
    """

    setup: DualSetup
    data: ContactData
    options: Options
    timer: Timer
    history: History
    d: Vector
    norm_b: float
    negligible: float

    @staticmethod
    def begin(
        setup: DualSetup, data: ContactData, options: Options, timer: Timer, history: History
    ) -> _Loop:
        """Compute d~ and its norms."""
        F, space = setup.F, setup.constraints.layout.space
        with timer.phase("iterations"):
            d = F.load(data.load - F.constraint_forces(data.feasible), data.c)
            negligible = _NEGLIGIBLE * space.norm(d)
            norm_b = max(space.norm(setup.projector.P(d)), negligible / options.rtol)
        return _Loop(setup, data, options, timer, history, d, norm_b, negligible)

    def first_state(self, start: DualState | None, at_rest: bool) -> DualState:
        """Return the given state, or multipliers that vanish: no contact, nothing glued."""
        none = np.zeros_like(self.d)
        if at_rest:
            return DualState(none, -self.setup.projector.Q(self.d))
        return start or DualState(none, none)

    def active_set(self, stage: _Stage, rtol: float) -> _Stage:
        """Run the primal-dual active set method on (11.36)."""
        start, active = self._first_face(stage)
        problem = self._problem(_ROUGH_LANCZOS_STEPS)
        with self.timer.phase("iterations"):
            result = primal_dual_active_set(
                problem,
                start,
                active,
                tolerance=rtol * self.norm_b,
                norm_b=self.norm_b,
                max_products=self.options.max_products,
                products=self.history.products,
                monitor=self._log_face,
            )
        state = DualState(result.multipliers, result.coarse_gradient)
        return _Stage(state, result.solved, iterate=result.iterate)

    def smalbe(self, state: DualState, rtol: float) -> _Stage:
        """Run SMALBE-M on (11.40)."""
        before = len(self.history.outer)
        problem = self._problem(LANCZOS_STEPS)
        with self.timer.phase("iterations"):
            result = solve_by_smalbe(
                problem,
                self.data.feasible,
                self.d,
                SMALBEState(state.multipliers - self.data.feasible, state.coarse_gradient),
                rtol=rtol,
                norm_b=self.norm_b,
                options=self.options,
                outer_so_far=before,
                products=self.history.products,
                monitor=lambda line: self._log_outer(line, before),
            )
        self.history.outer += result.history
        state = DualState(self.data.feasible + result.state.x, result.state.q)
        limits = {
            "max_it": f"limit of {self.options.smalbe_max_it} outer iterations (smalbe_max_it)",
            "max_products": f"limit of {self.options.max_products} products (max_products)",
        }
        return _Stage(state, result.converged, limits.get(result.reason, result.reason))

    def recover(self, state: DualState) -> Candidate:
        """Recover u by (11.29), and measure how well u and lambda solve (11.21)."""
        setup, data, rows = self.setup, self.data, self.setup.constraints.inequality
        multipliers = state.multipliers.copy()
        # where lambda~ and x cancel: no force, and no row for the rigid motions to follow
        multipliers[rows] = np.where(multipliers[rows] > self.negligible, multipliers[rows], 0.0)
        with self.timer.phase("recovery"):
            active = Projector.build(setup.projector.coarse_space, multipliers[rows] > 0.0)
            u = recover_displacement(setup.F, active, data.load, data.c, multipliers)
            primal = PrimalProblem(setup.local.stiffness, data.load, data.c, setup.F)
            return Candidate(u, multipliers, primal.certify(u, multipliers), active)

    def _problem(self, lanczos_steps: int) -> DualProblem:
        with self.timer.phase("norm"):
            norm = self.setup.norm(lanczos_steps)
        with self.timer.phase("iterations"):
            return dual_problem(self.setup, self.data, norm)

    def _first_face(self, stage: _Stage) -> tuple[Vector | PCPGIterate, Mask]:
        """Return where the active set method starts."""
        if stage.iterate is not None:
            return stage.iterate, stage.iterate.active
        multipliers, active = stage.state.multipliers, stage.state.active
        if active is None:
            active = multipliers[self.setup.constraints.inequality] > 0.0
        return multipliers, active

    def _log_face(self, step: ActiveSetStep) -> None:
        self.history.faces.append(step)
        if self.setup.constraints.layout.comm.rank == 0:
            logger.info(
                "face  %3d  products %4d  residual %.2e  active %d  changed %d",
                len(self.history.faces) - 1,
                step.products,
                step.residual,
                step.active,
                step.changed,
            )

    def _log_outer(self, line: OuterIteration, before: int) -> None:
        if self.setup.constraints.layout.comm.rank == 0:
            logger.info(
                "outer %3d  products %4d  |g^P| %.2e  |Gx| %.2e  M %.1e  active %d",
                line.number + before,
                line.products,
                line.gradient,
                line.constraint,
                line.M,
                line.active,
            )


def dual_problem(setup: DualSetup, data: ContactData, norm: float) -> DualProblem:
    """Return (11.36); its d takes one application of K^+."""
    return DualProblem(
        setup.F.part,
        setup.F.load(data.load, data.c),
        data.e,
        data.c,
        setup.projector,
        norm,
        setup.precondition,
    )

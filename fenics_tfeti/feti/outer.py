"""The outer loop: from the set-up to multipliers and displacements with a certificate.

repeat
lambda   by the primal-dual active set method, or by SMALBE-M on (11.40): each continues where the
         other makes no progress
u        by recovery (11.29)
stop     when the certificate of u and lambda holds
eps      is reduced by what the certificate lacks
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.feti.certificate import Certificate, PrimalProblem
from fenics_tfeti.feti.coarse.prescribed_motion import prescribed_motion
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.dual.active_set import ActiveSetStep, primal_dual_active_set
from fenics_tfeti.feti.dual.augmented import solve_by_smalbe
from fenics_tfeti.feti.dual.pcpg import PCPGIterate
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.feti.options import Options
from fenics_tfeti.feti.recovery import (
    Recovered,
    balance_multipliers,
    forces_at_rest,
    recover_displacement,
)
from fenics_tfeti.feti.setup import DualSetup
from fenics_tfeti.feti.timer import Timer
from fenics_tfeti.feti.tolerances import ROUNDING
from fenics_tfeti.qp import OuterIteration, Products, SMALBEState, Unbounded

__all__ = ["ContactData", "DualState", "Outcome", "iterate_until_certified"]

logger = logging.getLogger(__name__)

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Lanczos steps for ||PFP||: an upper bound as the scale of SMALBE-M, and a rough value as the scale
# of gaps against forces
LANCZOS_STEPS = 15
_ROUGH_LANCZOS_STEPS = 3
# a contact force below this part of the two numbers that it is the sum of is rounding
_CANCELLED = 1e-13
# rounding errors, in units of the last place, that add up in the jumps
_ROUNDING_ERRORS = 64
# limit on the passes of the outer loop; most solutions take one to three
_PASSES = 50
# gaps farther than this many times the largest jump of displacements are shortened
_FAR = 1e6


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
    removed : (m,) array or float
        B R a of prescribed motions that were taken out of c.
    """

    load: Vector
    c: Vector
    e: Vector
    feasible: Vector
    removed: Vector | float = 0.0


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
    recovered : Recovered
        Displacements.
    multipliers : (m,) array
        lambda.
    certificate : Certificate
        How well they solve (11.21).
    energy : float
        1/2 u'Ku - f'u [J].
    face : Projector
        That of the equality rows and the contact rows with a force; its ``free`` motions are
        undetermined.
    """

    recovered: Recovered
    multipliers: Vector
    certificate: Certificate
    energy: float
    face: Projector


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
    tolerance : float
        Tolerance of the dual problem in the last pass [sqrt(J)].
    """

    candidate: Candidate
    state: DualState
    converged: bool
    reason: str
    tolerance: float


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


@dataclass
class _Progress:
    """The decrease of the certificate from pass to pass.

    Attributes
    ----------
    bound, worst : float
        The smallest so far: the bound of the error, and the largest number of the certificate.
    at, tolerance : float
        Tolerances when one of them last halved, and of the last pass.
    failures : int
        Passes since then that changed the certificate: one that changes nothing has only brought
        the tolerance down to the iterate.
    last : tuple of float
        The two numbers of the last pass.
    passes : int
        All passes.
    """

    bound: float = np.inf
    worst: float = np.inf
    at: float = np.inf
    tolerance: float = np.inf
    failures: int = 0
    last: tuple[float, float] = (np.inf, np.inf)
    passes: int = 0

    def update(self, certificate: Certificate, tolerance: float) -> None:
        """Compare a certificate with the smallest numbers so far."""
        self.tolerance = tolerance
        self.passes += 1
        last, self.last = self.last, (certificate.bound, certificate.worst)
        if self.last == last:
            self.at = tolerance
        else:
            self.failures += 1
        if certificate.bound <= 0.5 * self.bound or certificate.worst <= 0.5 * self.worst:
            self.bound = min(self.bound, certificate.bound)
            self.worst = min(self.worst, certificate.worst)
            self.at, self.failures = tolerance, 0

    @property
    def stagnates(self) -> bool:
        """Whether three passes, to a hundredth of the tolerance, have halved neither of them."""
        failed = self.failures >= 3 and self.tolerance <= 1e-2 * self.at
        return failed or self.passes >= _PASSES


@dataclass(frozen=True)
class _Stage:
    """What one pass of the loop ends with."""

    state: DualState
    solved: bool
    reason: str = ""
    slow: bool = False
    iterate: PCPGIterate | None = None


def iterate_until_certified(
    setup: DualSetup,
    data: ContactData,
    start: DualState | None,
    options: Options,
    timer: Timer,
    history: History,
    body_names: Sequence[str] = (),
) -> Outcome:
    """Solve the dual problem to tolerances that decrease until the certificate holds.

    Rigid motions that supports prescribe are taken out, and put back in the end.

    Gaps that are far from closing are shortened: all contact rows share the projector, so a gap out
    of all proportion would swamp the others by rounding. As long as no row with a shortened gap
    closes, the solution is the same; if one does, the gaps are lengthened.

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
    body_names : sequence of str
        Names of the bodies for the certificate.

    Returns
    -------
    Outcome
        The last candidate, and whether it is certified.
    """
    with timer.phase("iterations"):
        coarse_space = setup.projector.coarse_space
        motion = prescribed_motion(coarse_space, data.c)
        removed = coarse_space.prolong(motion)
        data = replace(data, c=data.c - removed, removed=removed)
        feasible = _FeasibleState.of(setup, data)
    rows, comm = setup.constraints.inequality, setup.constraints.layout.comm
    longest = _FAR * feasible.largest_jump
    while True:
        far = data.c[rows] > longest if longest > 0.0 else np.zeros(rows.size, dtype=bool)
        c = data.c.copy()
        c[rows] = np.where(far, longest, data.c[rows])
        near = replace(data, c=c)
        loop = _Loop.begin(setup, near, far, feasible, options, timer, history, body_names)
        outcome = _iterate(loop, start)
        closed = bool((outcome.candidate.recovered.closed & far).any())
        if not comm.allreduce(closed, MPI.LOR):
            candidate = _moved(outcome.candidate, data, coarse_space.rigid_motion(motion))
            return replace(outcome, candidate=candidate)
        longest, start = _FAR * longest, outcome.state


def _moved(candidate: Candidate, data: ContactData, motion: Vector) -> Candidate:
    """Return a candidate with a rigid motion added to its displacements. Collective."""
    recovered, comm = candidate.recovered, candidate.face.coarse_space.comm
    moved = replace(
        recovered, torn=recovered.torn + motion, displacement=recovered.displacement + motion
    )
    work = float(comm.allreduce(float(data.load @ motion)))
    return replace(candidate, recovered=moved, energy=candidate.energy - work)


def _iterate(loop: _Loop, start: DualState | None) -> Outcome:
    """Solve the dual problem to tolerances that decrease until the certificate holds."""
    options = loop.options
    forces = forces_at_rest(loop.setup.F, loop.data.load, loop.data.c)
    if forces is not None:
        return loop.at_rest(forces)
    stage = _Stage(loop.first_state(start), solved=False)
    by_active_set = options.method == "active_set"
    limit, tolerance = max(options.rtol, ROUNDING), options.rtol * loop.scale
    rounding, changed_method = loop.rounding_at(loop.scale), False
    progress = _Progress()
    while True:
        tolerance = max(tolerance, rounding)
        stage = loop.minimise(stage, tolerance, by_active_set)
        by_active_set = stage.iterate is not None
        candidate = loop.recover(stage.state)
        worst = candidate.certificate.worst
        if worst <= limit:
            return Outcome(candidate, stage.state, True, "converged", tolerance)
        if not stage.solved:
            return Outcome(candidate, stage.state, False, stage.reason, tolerance)
        progress.update(candidate.certificate, tolerance)
        rounding = min(rounding, loop.rounding_at(candidate.certificate.energy_norm))
        limited = progress.stagnates or tolerance <= rounding
        if limited and not by_active_set and not changed_method:
            by_active_set = changed_method = True
            progress = _Progress()
        elif limited:
            reason = (
                f"the error of the displacement is {worst:.1e}, and more iterations do not reduce "
                "it: the accuracy is at the limit of rounding"
            )
            return Outcome(candidate, stage.state, False, reason, tolerance)
        tolerance *= min(max(0.5 * limit / worst, 1e-3), 0.5)


@dataclass(frozen=True)
class _FeasibleState:
    """The torn displacement K^+(f - B'lambda~) at the feasible start.

    Attributes
    ----------
    jumps : (m,) array
        Its jumps, scaled as the rows.
    strain : float
        f'K^+f of the forces f - B'lambda~ [J].
    largest_jump : float
        Largest absolute value of jumps and of prescribed displacements, over all ranks.
    """

    jumps: Vector
    strain: float
    largest_jump: float

    @staticmethod
    def of(setup: DualSetup, data: ContactData) -> _FeasibleState:
        """Apply K^+ once."""
        F, comm = setup.F, setup.constraints.layout.comm
        forces = data.load - F.constraint_forces(data.feasible)
        strained = F.generalized_inverse(forces)
        jumps = F.jumps(strained)
        strain = float(comm.allreduce(max(0.0, float(strained @ forces))))
        prescribed = data.c[setup.constraints.equality]
        largest = max(np.abs(jumps).max(initial=0.0), np.abs(prescribed).max(initial=0.0))
        return _FeasibleState(jumps, strain, float(comm.allreduce(float(largest), MPI.MAX)))


@dataclass(frozen=True)
class _Loop:
    """What stays the same during the outer loop.

    Attributes
    ----------
    setup, data, options, timer, history
        As given.
    primal : PrimalProblem
        The primal problem (11.21).
    d : (m,) array
        d_0 = BK^+(f - B'lambda~) - c, printed d in (11.39).
    scale : float
        An energy norm as large as the solution's, or larger [sqrt(J)].
    closing : float
        Energy norm of rigid motions that close the prescribed jumps [sqrt(J)].
    """

    setup: DualSetup
    data: ContactData
    options: Options
    timer: Timer
    history: History
    primal: PrimalProblem
    d: Vector
    scale: float
    closing: float

    @staticmethod
    def begin(
        setup: DualSetup,
        data: ContactData,
        far: Mask,
        feasible: _FeasibleState,
        options: Options,
        timer: Timer,
        history: History,
        body_names: Sequence[str],
    ) -> _Loop:
        """Compute d_0 and the scale: the energy norms of u_t at lambda~ and of its jumps."""
        F, layout = setup.F, setup.constraints.layout
        primal = PrimalProblem(
            setup.local.stiffness,
            data.load,
            data.c,
            np.broadcast_to(data.removed, data.c.shape),
            F,
            setup.row_bodies,
            body_names,
            setup.local.unit,
        )
        d = feasible.jumps - data.c
        jumps = _energy_of_jumps(setup, data, far, d, timer, history)
        scale = float(np.sqrt(max(feasible.strain, jumps)))
        # jumps that have to be closed, with prescribed displacements and penetrated gaps
        rows, closing = setup.constraints.inequality, data.c.copy()
        closing[rows] = np.minimum(closing[rows], 0.0)
        rigid = float(np.sqrt(setup.local.unit) * layout.space.norm(closing))
        return _Loop(setup, data, options, timer, history, primal, d, scale, rigid)

    def rounding_at(self, energy_norm: float) -> float:
        """Return the energy norm of what rounding leaves in jumps of displacements [sqrt(J)]."""
        return float(_ROUNDING_ERRORS * np.finfo(float).eps * (energy_norm + self.closing))

    def at_rest(self, multipliers: Vector) -> Outcome:
        """Return u = o, with multipliers that balance the load."""
        setup, none = self.setup, np.zeros_like(self.data.load)
        active = np.zeros(setup.constraints.inequality.size, dtype=bool)
        with self.timer.phase("recovery"):
            face = Projector.build(setup.projector.coarse_space, active)
            recovered = Recovered(none, none, none, active)
            certificate = self.primal.certify(recovered, multipliers)
        candidate = Candidate(recovered, multipliers, certificate, 0.0, face)
        state = DualState(multipliers, np.zeros_like(multipliers))
        return Outcome(candidate, state, True, "converged", 0.0)

    def first_state(self, start: DualState | None) -> DualState:
        """Return the given state, or multipliers that vanish: no contact, nothing glued."""
        none = DualState(np.zeros_like(self.d), np.zeros_like(self.d))
        # where nothing moves, other multipliers would leave displacements of rounding size
        return none if start is None or self.scale == 0.0 else start

    def minimise(self, stage: _Stage, tolerance: float, by_active_set: bool) -> _Stage:
        """Solve the dual problem: by one method, and where it makes no progress by both in turn."""
        if by_active_set:
            stage = self.active_set(stage, tolerance)
            if stage.solved:
                return stage
        patience = self.options.smalbe_patience
        while True:
            stage = self.smalbe(stage.state, tolerance, patience)
            if not stage.slow:
                return stage
            # the face that SMALBE-M has found; if it is not the last one, SMALBE-M goes on
            on_faces = self.active_set(stage, tolerance)
            if on_faces.solved:
                return on_faces
            patience *= 2

    def active_set(self, stage: _Stage, tolerance: float) -> _Stage:
        """Run the primal-dual active set method on (11.36)."""
        start, active = self._first_face(stage)
        problem = self._problem(_ROUGH_LANCZOS_STEPS)
        with self.timer.phase("iterations"):
            result = primal_dual_active_set(
                problem,
                start,
                active,
                tolerance=tolerance,
                max_products=self.options.max_products,
                products=self.history.products,
                monitor=self._log_face,
            )
        state = DualState(result.multipliers, result.coarse_gradient)
        return _Stage(state, result.solved, iterate=result.iterate)

    def smalbe(self, state: DualState, tolerance: float, patience: int) -> _Stage:
        """Run SMALBE-M on (11.40)."""
        before, feasible = len(self.history.outer), self.data.feasible
        problem = self._problem(LANCZOS_STEPS)
        try:
            with self.timer.phase("iterations"):
                result = solve_by_smalbe(
                    problem,
                    feasible,
                    self.d,
                    SMALBEState(state.multipliers - feasible, state.coarse_gradient),
                    rtol=tolerance / (self.scale or 1.0),
                    norm_b=self.scale * np.sqrt(problem.norm),
                    options=self.options,
                    outer_so_far=before,
                    patience=patience,
                    products=self.history.products,
                    monitor=lambda line: self._log_outer(line, before),
                )
        except Unbounded:
            reason = (
                "SMALBE-M found no curvature along a direction: the contact conditions contradict "
                "each other, or rounding hides it"
            )
            return _Stage(state, solved=False, reason=reason)
        self.history.outer += result.history
        limits = {
            "max_it": f"limit of {self.options.smalbe_max_it} outer iterations (smalbe_max_it)",
            "max_products": f"limit of {self.options.max_products} products (max_products)",
        }
        multipliers = feasible + result.state.x
        cancelled = multipliers <= _CANCELLED * (np.abs(feasible) + np.abs(result.state.x))
        cancelled[self.setup.constraints.equality] = False
        return _Stage(
            DualState(np.where(cancelled, 0.0, multipliers), result.state.q),
            result.converged,
            limits.get(result.reason, result.reason),
            slow=result.reason == "slow",
        )

    def recover(self, state: DualState) -> Candidate:
        """Recover displacements, and measure how well they and lambda solve (11.21)."""
        setup, data, rows = self.setup, self.data, self.setup.constraints.inequality
        multipliers = state.multipliers.copy()
        multipliers[rows] = np.maximum(multipliers[rows], 0.0)
        with self.timer.phase("recovery"):
            coarse_space = setup.projector.coarse_space
            multipliers, face = balance_multipliers(coarse_space, data.e, multipliers)
            recovered = recover_displacement(setup.F, face, data.load, data.c, multipliers)
            certificate = self.primal.certify(recovered, multipliers)
            energy = self.primal.energy(recovered)
        return Candidate(recovered, multipliers, certificate, energy, face)

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


def _energy_of_jumps(
    setup: DualSetup, data: ContactData, far: Mask, d: Vector, timer: Timer, history: History
) -> float:
    """Return r'Mr of the jumps r = B u_t - c at lambda~ that have to be closed [J].

    These are the jumps on the face of lambda~, and on other contact rows the penetrations. Rows
    with a far gap are expected to stay open, whatever lambda~ is there.
    """
    layout, rows = setup.constraints.layout, setup.constraints.inequality
    pressing = (data.feasible[rows] > 0.0) & ~far
    face = Projector.build(setup.projector.coarse_space, pressing)
    r = face.remove_rigid_motion(layout.owned_part(d), d)[0]
    r[rows] = np.where(pressing, r[rows], np.maximum(r[rows], 0.0))
    if setup.precondition is None:
        with timer.phase("norm"):
            norm = setup.norm(_ROUGH_LANCZOS_STEPS)
        return layout.space.dots((r, r))[0] / (norm or 1.0)
    history.products.preconditioner += 1
    part = np.array([r @ setup.precondition(r)])
    return float(layout.space.sum_over_ranks(part)[0])


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

"""The outer loop: from the set-up to multipliers and displacements with a certificate.

repeat
lambda   by the primal-dual active set method, or by SMALBE-M on (11.40): each continues where the
         other makes no progress; with friction Newton's method on proximal problems in place of
         the active set method from then on
u        by recovery (11.29)
stop     when the certificate of u and lambda holds
eps      is reduced by what the certificate lacks
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

from mpi4py import MPI

import numpy as np

from fenics_tfeti.feti import interruption
from fenics_tfeti.feti.coarse.prescribed_motion import prescribed_motion
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.dual.active_set import ActiveSetResult, primal_dual_active_set
from fenics_tfeti.feti.dual.augmented import Stopped, solve_by_smalbe
from fenics_tfeti.feti.dual.pcpg import PCPGIterate, Signs
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.feti.dual.proximal_newton import proximal_newton
from fenics_tfeti.feti.options import Options
from fenics_tfeti.feti.solution.certificate import Certificate, PrimalProblem
from fenics_tfeti.feti.solution.idle_bodies import without_idle_forces
from fenics_tfeti.feti.solution.monitor import Monitor
from fenics_tfeti.feti.solution.progress import Progress
from fenics_tfeti.feti.solution.recovery import (
    Recovered,
    balance_multipliers,
    forces_at_rest,
    recover_displacement,
)
from fenics_tfeti.feti.solution.scale import ROUGH_LANCZOS_STEPS, EnergyScale, FeasibleState
from fenics_tfeti.feti.solution.setup import DualSetup, dual_problem
from fenics_tfeti.feti.solution.states import Candidate, ContactData, DualState, Outcome
from fenics_tfeti.feti.timer import Timer
from fenics_tfeti.feti.tolerances import CERTIFIED, FAR
from fenics_tfeti.qp import SMALBEState, Unbounded
from fenics_tfeti.typing import Mask, Vector

# Lanczos steps for an upper bound of ||PFP||, the scale of SMALBE-M
LANCZOS_STEPS = 15
# products of SMALBE-M with friction after which Newton's method gets as many; doubled each time
_FIRST_SHARE = 2000
# a contact force below this part of the two numbers that it is the sum of is rounding
_CANCELLED = 1e-13


@dataclass(frozen=True)
class _Stage:
    """What one pass of the loop ends with."""

    state: DualState
    solved: bool
    reason: str = ""
    slow: bool = False
    flat: bool = False
    iterate: PCPGIterate | None = None

    @property
    def at_limit(self) -> bool:
        """Whether rounding has ended the conjugate gradients of the active set method."""
        return not self.solved and self.iterate is not None and self.iterate.at_limit

    def started_anew(self) -> _Stage:
        """Return the stage without residuals, in whose recurrences rounding has added up."""
        if self.iterate is None or self.iterate.signs.proximal is not None:
            return self
        active = self.iterate.signs.active
        return replace(self, state=replace(self.state, active=active), iterate=None)


def iterate_until_certified(
    setup: DualSetup,
    data: ContactData,
    start: DualState | None,
    options: Options,
    timer: Timer,
    monitor: Monitor,
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
    monitor : Monitor
        To tell of each step; with the history to add to.
    body_names : sequence of str
        Names of the bodies for the certificate.

    Returns
    -------
    Outcome
        The certified candidate, or the one with the smallest certificate.
    """
    with timer.phase("iterations"):
        coarse_space = setup.projector.coarse_space
        motion = prescribed_motion(coarse_space, data.c)
        removed = coarse_space.prolong(motion)
        data = replace(data, c=data.c - removed, removed=removed)
        feasible = FeasibleState.of(setup, data)
    rows, comm = setup.constraints.inequality, setup.constraints.layout.comm
    longest = FAR * feasible.largest_jump
    while True:
        far = data.c[rows] > longest if longest > 0.0 else np.zeros(rows.size, dtype=bool)
        c = data.c.copy()
        c[rows] = np.where(far, longest, data.c[rows])
        near = replace(data, c=c)
        loop = _Loop.begin(setup, near, far, feasible, options, timer, monitor, body_names)
        outcome = _iterate(loop, start)
        closed = bool((outcome.candidate.recovered.closed & far).any())
        if not comm.allreduce(closed, MPI.LOR) or interruption.agreed():
            candidate = _moved(outcome.candidate, data, motion)
            return replace(outcome, candidate=candidate)
        longest, start = FAR * longest, outcome.state


def _moved(candidate: Candidate, data: ContactData, motion: Vector) -> Candidate:
    """Return a candidate with rigid motions (coarse,) added to its displacements. Collective."""
    if not motion.any():
        return candidate
    recovered, coarse_space = candidate.recovered, candidate.face.coarse_space
    comm, motion = coarse_space.comm, coarse_space.rigid_motion(motion)
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
    scale, limit = loop.scale, max(options.rtol, CERTIFIED)
    tolerance, rounding = options.rtol * scale.energy_norm, scale.rounding_at(scale.energy_norm)
    changed_method = False
    progress, best = Progress(), _Best()
    while True:
        tolerance = max(tolerance, rounding)
        stage = loop.minimise(stage, tolerance, by_active_set)
        by_active_set = stage.iterate is not None
        candidate = loop.recover(stage.state)
        worst = candidate.certificate.worst
        if worst <= limit:
            return Outcome(candidate, stage.state, True, "converged", tolerance)
        best.update(stage.state, candidate.certificate)
        if interruption.agreed():
            outcome = best.outcome(loop, candidate, "", tolerance)
            return replace(outcome, reason="interrupted")
        if stage.at_limit:
            best.rounded = worst
            # not accurate enough: SMALBE-M goes on from the best state
            by_active_set = False
            stage = replace(stage, state=best.start(loop))
            continue
        if not stage.solved:
            return best.outcome(loop, candidate, stage.reason, tolerance)
        progress.update(candidate.certificate, tolerance)
        rounding = min(rounding, scale.rounding_at(candidate.certificate.energy_norm))
        limited = progress.stagnates or tolerance <= rounding
        if limited and not by_active_set and not changed_method:
            by_active_set = changed_method = True
            progress = Progress()
        elif limited:
            if candidate.certificate.with_idle_bodies().worst <= limit:
                return Outcome(candidate, stage.state, True, "converged", tolerance)
            reason = "the accuracy is at the limit of rounding: more iterations do not change it"
            return best.outcome(loop, candidate, reason, tolerance)
        if progress.failures:
            stage = stage.started_anew()
        # its displacements are the largest vectors: the next ones take their place
        del candidate
        tolerance *= min(max(0.5 * limit / worst, 1e-3), 0.5)


@dataclass
class _Best:
    """The state with the smallest certificate, which need not be the last one, and what ended it.

    Of the states only the multipliers are kept.
    """

    state: DualState | None = None
    worst: float = np.inf
    name: str = ""  # of the largest number of the certificate
    is_last: bool = False
    rounded: float | None = None  # the certificate where rounding has ended conjugate gradients

    def update(self, state: DualState, certificate: Certificate) -> None:
        """Take in a state and its certificate."""
        self.is_last = self.state is None or certificate.worst < self.worst
        if self.is_last:
            self.state, self.worst, self.name = state, certificate.worst, certificate.worst_name

    def start(self, loop: _Loop) -> DualState:
        """Return the state to go on from: the best one, or none where rounding has spoilt all."""
        if self.state is not None and np.isfinite(self.worst):
            return self.state
        return loop.first_state(None)

    def outcome(self, loop: _Loop, last: Candidate, reason: str, tolerance: float) -> Outcome:
        """Return it as not converged, with its displacements; `reason` is what ended the loop."""
        assert self.state is not None
        candidate = last if self.is_last else loop.recover(self.state)
        found = "the contact forces do not balance the load"
        if np.isfinite(self.worst):
            found = f"its certificate has reached {self.worst:.1e} ({self.name})"
        if self.rounded is not None:
            found += f"; rounding has ended the conjugate gradients at {self.rounded:.1e}"
        return Outcome(candidate, self.state, False, f"{reason}; {found}", tolerance)


@dataclass(frozen=True)
class _Loop:
    """What stays the same during the outer loop.

    Attributes
    ----------
    setup, data, options, timer, monitor
        As given.
    primal : PrimalProblem
        The primal problem (11.21).
    d : (m,) array
        d_0 = BK^+(f - B'lambda~) - c, printed d in (11.39), not deflated.
    scale : EnergyScale
        What the tolerances are relative to.
    """

    setup: DualSetup
    data: ContactData
    options: Options
    timer: Timer
    monitor: Monitor
    primal: PrimalProblem
    d: Vector
    scale: EnergyScale

    @staticmethod
    def begin(
        setup: DualSetup,
        data: ContactData,
        far: Mask,
        feasible: FeasibleState,
        options: Options,
        timer: Timer,
        monitor: Monitor,
        body_names: Sequence[str],
    ) -> _Loop:
        """Compute d_0 and the scale."""
        primal = PrimalProblem(
            setup.local.stiffness,
            data.load,
            data.c,
            np.broadcast_to(data.removed, data.c.shape),
            setup.F,
            setup.row_bodies,
            body_names,
            setup.local.unit,
            data.radius,
        )
        scale = EnergyScale.of(setup, data, feasible, far, timer, monitor.history)
        return _Loop(setup, data, options, timer, monitor, primal, feasible.jumps - data.c, scale)

    def at_rest(self, multipliers: Vector) -> Outcome:
        """Return u = o, with multipliers that balance the load."""
        setup, none = self.setup, np.zeros_like(self.data.load)
        active = np.zeros(setup.constraints.inequality.size, dtype=bool)
        with self.timer.phase("recovery"):
            sticking = setup.constraints.friction.sticking(multipliers, self.data.radius)
            face = Projector.build(setup.projector.coarse_space, active, sticking)
            recovered = Recovered(none, none, none, -self.data.c, active, sticking)
            certificate, energy = self.primal.certify(recovered, multipliers, face)
            slips = self.primal.slips(recovered)
        candidate = Candidate(
            recovered, multipliers, certificate, energy, face, slips, self.data.radius
        )
        state = DualState(multipliers, np.zeros_like(multipliers))
        return Outcome(candidate, state, True, "converged", 0.0)

    def first_state(self, start: DualState | None) -> DualState:
        """Return the given state, or multipliers that vanish: no contact, nothing glued."""
        none = DualState(np.zeros_like(self.d), np.zeros_like(self.d))
        # where nothing moves, other multipliers would leave displacements of rounding size
        return none if start is None or self.scale.energy_norm == 0.0 else start

    def minimise(self, stage: _Stage, tolerance: float, by_active_set: bool) -> _Stage:
        """Solve the dual problem: by one method, and where it makes no progress by both in turn."""
        share, patience = _FIRST_SHARE, self.options.smalbe_patience
        on_faces = None
        if by_active_set:
            stage = on_faces = self.on_faces(stage, tolerance, share)
            if stage.solved or stage.at_limit or interruption.agreed():
                return stage
        while True:
            stage = self.smalbe(stage.state, tolerance, patience, share)
            if stage.flat and self.setup.deflation is not None:
                # directions of U have no curvature: rounding of the gradient may have led there
                on_faces = self.on_faces(stage, tolerance, share)
                return on_faces if on_faces.solved else stage
            if not stage.slow or interruption.agreed():
                return stage
            # from the face that SMALBE-M has found; if it is not the last one, SMALBE-M goes on,
            # and with friction Newton's method from where it was
            by_newton = self.setup.constraints.has_friction
            before = on_faces if on_faces is not None and by_newton else stage
            on_faces = self.on_faces(before, tolerance, share, by_newton)
            if on_faces.solved or interruption.agreed():
                return on_faces
            patience, share = 2 * patience, 2 * share

    def on_faces(
        self, stage: _Stage, tolerance: float, share: int, by_newton: bool = False
    ) -> _Stage:
        """Run the primal-dual active set method on (11.36), or Newton's on proximal problems.

        The latter gets a share of products, and goes on where it has begun. It does not cycle where
        forces turn.
        """
        problem = self._problem(ROUGH_LANCZOS_STEPS)
        start, signs = self._first_face(stage, problem)
        run = partial(self._run, problem, tolerance)
        with self.timer.phase("iterations"):
            if signs.proximal is None and not by_newton:
                result = run(primal_dual_active_set, start, signs)
            else:
                result = run(proximal_newton, start, signs, share)
                if result.solved:
                    # without the proximal term forces that vanish do so exactly
                    face = replace(result.iterate.signs, proximal=None)
                    last = run(primal_dual_active_set, result.iterate, face)
                    result = last if last.solved else result
            multipliers = self._completed(result.multipliers)
        state = DualState(multipliers, result.coarse_gradient)
        return _Stage(state, result.solved, iterate=result.iterate)

    def _run(
        self,
        problem: DualProblem,
        tolerance: float,
        method: Callable[..., ActiveSetResult],
        start: Vector | PCPGIterate,
        signs: Signs,
        share: int | None = None,
    ) -> ActiveSetResult:
        """Run a method for a share of the products, or for all that are left."""
        products, limit = self.monitor.history.products, self.options.max_products
        return method(
            problem,
            start,
            signs,
            tolerance=tolerance,
            max_products=limit if share is None else min(limit, products.total + share),
            products=products,
            monitor=self.monitor.face,
        )

    def smalbe(self, state: DualState, tolerance: float, patience: int, share: int) -> _Stage:
        """Run SMALBE-M on (11.40)."""
        before, feasible = len(self.monitor.history.outer), self.data.feasible
        energy_norm = self.scale.energy_norm
        problem, options = self._problem(LANCZOS_STEPS), self.options
        products, limit = self.monitor.history.products, options.max_products
        if problem.constraints.has_friction:
            limit = min(limit, products.total + share)
        try:
            with self.timer.phase("iterations"):
                result = solve_by_smalbe(
                    problem,
                    feasible,
                    self.setup.reduced(self.d),
                    SMALBEState(state.multipliers - feasible, state.coarse_gradient),
                    rtol=tolerance / (energy_norm or 1.0),
                    norm_b=energy_norm * np.sqrt(problem.norm),
                    options=replace(options, max_products=limit),
                    outer_so_far=before,
                    patience=patience,
                    products=products,
                    monitor=self.monitor.outer,
                )
        except Unbounded:
            reason = (
                "SMALBE-M found no curvature along a direction: the contact conditions contradict "
                "each other, or rounding hides it"
            )
            return _Stage(state, solved=False, reason=reason, flat=True)
        except Stopped:
            return _Stage(state, solved=False)
        limits = {
            "max_it": f"limit of {options.smalbe_max_it} outer iterations (smalbe_max_it)",
            "max_products": f"limit of {options.max_products} products (max_products)",
        }
        multipliers = feasible + result.state.x
        cancelled = np.zeros(multipliers.size, dtype=bool)
        rows, size = self.setup.constraints.inequality, np.abs(feasible) + np.abs(result.state.x)
        cancelled[rows] = multipliers[rows] <= _CANCELLED * size[rows]
        with self.timer.phase("iterations"):
            multipliers = self._completed(np.where(cancelled, 0.0, multipliers))
        return _Stage(
            DualState(multipliers, result.state.q),
            result.converged,
            limits.get(result.reason, result.reason),
            slow=result.reason == "slow" or options.max_products > products.total >= limit,
        )

    def recover(self, state: DualState) -> Candidate:
        """Recover displacements, and measure how well they and lambda solve (11.21)."""
        setup, data, constraints = self.setup, self.data, self.setup.constraints
        feasible = constraints.friction.multiplier_set(
            constraints.inequality, np.zeros(constraints.size), data.radius
        )
        multipliers = feasible.project(state.multipliers.copy())
        multipliers = constraints.friction.at_bound(multipliers, data.radius)
        with self.timer.phase("recovery"):
            coarse_space = setup.projector.coarse_space
            multipliers, face = balance_multipliers(coarse_space, data.e, multipliers, data.radius)
            # F makes jumps of what the balance has added, large ones in the deflated directions
            multipliers = without_idle_forces(
                constraints, setup.row_bodies, data.load, data.c, self._completed(multipliers)
            )
            recovered = recover_displacement(
                setup.F, face, data.load, data.c, multipliers, setup.local.unit
            )
            certificate, energy = self.primal.certify(recovered, multipliers, face)
            slips = self.primal.slips(recovered)
        return Candidate(recovered, multipliers, certificate, energy, face, slips, data.radius)

    def _completed(self, multipliers: Vector) -> Vector:
        """Return the multipliers with their part in the deflated directions."""
        deflation = self.setup.deflation
        if deflation is None:
            return multipliers
        return deflation.completed(multipliers, self.d, self.data.feasible)

    @cached_property
    def _load(self) -> Vector:
        with self.timer.phase("iterations"):
            return self.setup.load(self.data)

    def _problem(self, lanczos_steps: int) -> DualProblem:
        with self.timer.phase("norm"):
            norm = self.setup.norm(lanczos_steps)
        return dual_problem(self.setup, self.data, self._load, norm)

    def _first_face(
        self, stage: _Stage, problem: DualProblem
    ) -> tuple[Vector | PCPGIterate, Signs]:
        """Return where the active set method starts."""
        if stage.iterate is not None:
            return stage.iterate, stage.iterate.signs
        multipliers = stage.state.multipliers
        return multipliers, Signs.of(problem, multipliers, stage.state.active, stage.state.slips)

"""The outer loop: from the set-up to multipliers and displacements with a certificate.

repeat
lambda   by the primal-dual active set method, Newton's method on proximal problems, projected
         gradients or SMALBE-M on (11.40): where one makes no progress, `strategy` has the next one
u        by recovery (11.29)
stop     when the certificate of u and lambda holds
eps      is reduced by what the certificate lacks
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

from mpi4py import MPI

import numpy as np

from fenics_tfeti.errors import first_few
from fenics_tfeti.feti import interruption
from fenics_tfeti.feti.coarse.prescribed_motion import (
    closing_motion,
    prescribed_motion,
    without_motion,
)
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.constraints.springs import pushing_rows
from fenics_tfeti.feti.dual.active_set import primal_dual_active_set
from fenics_tfeti.feti.dual.augmented import solve_by_smalbe
from fenics_tfeti.feti.dual.iterate import Iterate, Method, SolveStatus, Turn
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.feti.dual.projected_gradients import projected_gradients
from fenics_tfeti.feti.dual.proximal_newton import proximal_newton
from fenics_tfeti.feti.solution.attempts import most_spent
from fenics_tfeti.feti.solution.certificate import Certificate
from fenics_tfeti.feti.solution.certifier import Certifier
from fenics_tfeti.feti.solution.progress import Progress, Stagnation
from fenics_tfeti.feti.solution.recovery import (
    Recovered,
    balance_multipliers,
    forces_at_rest,
    recover_displacement,
)
from fenics_tfeti.feti.solution.row_bodies import without_unloaded_groups
from fenics_tfeti.feti.solution.scale import (
    LANCZOS_STEPS,
    ROUGH_LANCZOS_STEPS,
    EnergyScale,
    FeasibleState,
)
from fenics_tfeti.feti.solution.setup import SolveContext
from fenics_tfeti.feti.solution.states import Candidate, ContactData, Outcome
from fenics_tfeti.feti.solution.strategy import Strategy
from fenics_tfeti.feti.tolerances import CERTIFIED, FAR
from fenics_tfeti.parallel import largest_of_ranks
from fenics_tfeti.typing import Mask, Vector

# bodies that the reason of an end without convergence names
_BODIES = 2


Bounds = Callable[[Vector], Vector]
Suffices = Callable[[Iterate], bool]


def iterate_until_certified(
    context: SolveContext,
    start: Iterate | None,
    bounds: Bounds | None = None,
    suffices: Suffices | None = None,
) -> Outcome:
    """Solve the dual problem to tolerances that decrease until the certificate holds.

    With `bounds`, the slip bounds (k,) that multipliers make, projected gradients go first, whose
    bounds follow the forces. Where the active set method stalls, `suffices` tells whether its
    iterate is accurate enough: then the outcome is INEXACT.

    Rigid motions that supports prescribe, and those that close the contacts which press at the
    start, are taken out, and put back in the end; of the latter once more without them where the
    solution has gone back. Gaps that are far from closing are shortened: all
    contact rows share the projector, so a gap out of all proportion would swamp the others by
    rounding. As long as no row with a shortened gap closes, the solution is the same; if one does,
    the gaps are lengthened. Without `start` the first multipliers vanish.
    """
    data, coarse_space = context.data, context.setup.projector.coarse_space
    rows = context.setup.constraints.inequality
    with context.timer.phase("iterations"):
        motion = prescribed_motion(coarse_space, data.c)
        removed = coarse_space.prolong(motion)
        data = replace(data, c=data.c - removed, motion=motion, removed=removed)
        closing = np.zeros_like(motion)
        if context.options.method != "smalbe":
            # whose start has no regard to gaps
            closing = closing_motion(coarse_space, data.c, data.feasible[rows] > 0.0)
    if closing.any():
        closed = replace(
            data, c=without_motion(coarse_space, data.c, closing), motion=motion + closing
        )
        outcome = _with_shortened_gaps(context, closed, start, bounds, suffices)
        if not _is_undone(coarse_space, closing, outcome.candidate.recovered.displacement):
            return outcome
        start = outcome.start
    return _with_shortened_gaps(context, data, start, bounds, suffices)


def _is_undone(coarse_space: CoarseSpace, closing: Vector, displacement: Vector) -> bool:
    """Tell whether bodies have gone back where they were before a motion. Collective.

    The contacts that pressed at the start do not in the end, and what rounding has left of the
    motion would be all of the displacement.
    """
    moved = np.abs(coarse_space.rigid_motion(closing))
    sizes = [largest_of_ranks(coarse_space.comm, np.abs(x)) for x in (moved, displacement)]
    return sizes[0] > FAR * sizes[1]


def _with_shortened_gaps(
    context: SolveContext,
    data: ContactData,
    start: Iterate | None,
    bounds: Bounds | None,
    suffices: Suffices | None,
) -> Outcome:
    """Solve with gaps that are far from closing shortened; put motions back. Collective."""
    rows, comm = context.setup.constraints.inequality, context.setup.constraints.layout.comm
    with context.timer.phase("iterations"):
        feasible = FeasibleState.of(context.setup, data)
    longest = FAR * feasible.largest_jump
    while True:
        shortened = (data.c[rows] > longest) & (longest > 0.0)
        if data.springs is not None:
            # which pull, however far
            shortened &= ~data.springs.pulling
        c = data.c.copy()
        c[rows] = np.where(shortened, longest, data.c[rows])
        inner = replace(context, data=replace(data, c=c))
        loop = _Loop.begin(inner, shortened, feasible, bounds, suffices)
        outcome = _iterate(loop, start)
        closed = bool((outcome.candidate.recovered.closed & shortened).any())
        if not comm.allreduce(closed, MPI.LOR) or interruption.agreed():
            candidate = _moved(outcome.candidate, data)
            return replace(outcome, candidate=candidate)
        longest, start = FAR * longest, outcome.start


def dual_problem(context: SolveContext) -> DualProblem:
    """Return (11.36) with an upper bound of ||PFP||. Collective."""
    shortened = np.zeros(context.setup.constraints.inequality.size, dtype=bool)
    feasible = FeasibleState.of(context.setup, context.data)
    return _Loop.begin(context, shortened, feasible).problem(LANCZOS_STEPS)


def _moved(candidate: Candidate, data: ContactData) -> Candidate:
    """Return a candidate with the motions taken out added to its displacements. Collective."""
    if data.motion is None or not data.motion.any():
        return candidate
    recovered, coarse_space = candidate.recovered, candidate.projector.coarse_space
    comm, motion = coarse_space.comm, coarse_space.rigid_motion(data.motion)
    moved = replace(
        recovered, torn=recovered.torn + motion, displacement=recovered.displacement + motion
    )
    work = float(comm.allreduce(float(data.load @ motion)))
    return replace(candidate, recovered=moved, energy=candidate.energy - work)


def _iterate(loop: _Loop, start: Iterate | None) -> Outcome:
    """Solve the dual problem to tolerances that decrease until the certificate holds."""
    context = loop.context
    data = context.data
    forces = forces_at_rest(context.setup.F, data.load, data.c, data.springs)
    if forces is not None:
        return loop.at_rest(forces)
    iterate, limit = loop.first(start), max(context.options.rtol, CERTIFIED)
    strategy = loop.strategy(iterate.method)
    tolerance = context.options.rtol * loop.scale.energy_norm
    progress, best = Progress.start(loop.scale), _Best()
    while True:
        tolerance = max(tolerance, progress.rounding)
        iterate = loop.minimise(iterate, strategy, tolerance)
        candidate = loop.recover(iterate)
        certificate = candidate.certificate
        if certificate.worst <= limit:
            return Outcome(candidate, iterate, SolveStatus.SOLVED, "converged", tolerance)
        if iterate.status is SolveStatus.INEXACT:
            return Outcome(candidate, iterate, iterate.status, iterate.status.value, tolerance)
        best.update(iterate, certificate)
        if iterate.status is SolveStatus.AT_ROUNDING:
            best.rounded = certificate.worst
            iterate = best.start(loop, strategy.after_rounding(iterate.method))
            continue
        if iterate.status is SolveStatus.OUT_OF_PRODUCTS and best.rounded is not None:
            return best.outcome(loop, candidate, SolveStatus.AT_LIMIT, tolerance)
        if iterate.status is not SolveStatus.SOLVED:
            return best.outcome(loop, candidate, iterate.status, tolerance)
        stagnation, following = progress.judge(certificate, tolerance), None
        if stagnation is Stagnation.FINAL:
            following = strategy.after_passes(iterate.method)
        if stagnation is Stagnation.FINAL and following is None:
            relaxed = certificate.with_nearly_unloaded_bodies()
            if relaxed.worst <= limit:
                candidate = replace(candidate, certificate=relaxed)
                return Outcome(candidate, iterate, SolveStatus.SOLVED, "converged", tolerance)
            return best.outcome(loop, candidate, SolveStatus.AT_LIMIT, tolerance)
        if following is not None:
            progress.restart()
            iterate = replace(iterate, method=following, slips=candidate.slips)
        elif stagnation is Stagnation.OF_PASS:
            iterate = iterate.at_multipliers(candidate.slips)
        # its displacements are the largest vectors: the next ones take their place
        del candidate
        tolerance *= min(max(0.5 * limit / certificate.worst, 1e-3), 0.5)


@dataclass
class _Best:
    """The iterate with the smallest certificate, which need not be the last one."""

    iterate: Iterate | None = None
    worst: float = np.inf
    name: str = ""  # of the largest number of the certificate
    is_last: bool = False
    rounded: float | None = None  # the certificate where rounding has ended conjugate gradients

    def update(self, iterate: Iterate, certificate: Certificate) -> None:
        """Take in an iterate and its certificate."""
        self.is_last = self.iterate is None or certificate.worst < self.worst
        if self.is_last:
            self.iterate, self.worst = iterate, certificate.worst
            self.name = certificate.worst_name

    def start(self, loop: _Loop, method: Method) -> Iterate:
        """Return the iterate for a method to go on from; none without a finite certificate."""
        spoilt = self.iterate is None or not np.isfinite(self.worst)
        iterate = loop.first(None) if spoilt else self.iterate
        assert iterate is not None
        return replace(iterate, method=method)

    def outcome(
        self, loop: _Loop, last: Candidate, status: SolveStatus, tolerance: float
    ) -> Outcome:
        """Return it as not converged, with its displacements; `status` is what ended the loop."""
        assert self.iterate is not None
        options = loop.context.options
        candidate = last if self.is_last else loop.recover(self.iterate)
        reached = "the contact forces do not balance the load"
        if np.isfinite(self.worst):
            bodies = ", ".join(first_few(candidate.certificate.worst_bodies, _BODIES, "bodies"))
            where = f", largest in {bodies}" if bodies else ""
            reached = f"its certificate has reached {self.worst:.1e} ({self.name}{where})"
            if self.name == "equilibrium":
                setup = loop.context.setup
                jump = largest_of_ranks(setup.constraints.layout.comm, setup.local.jumps())
                reached += f"; stiffness matrices, whose diagonals jump by up to {jump:.0e}, "
                reached += "are accurate to the rounding of their largest entries"
        if self.rounded is not None:
            reached += f"; rounding has ended the conjugate gradients at {self.rounded:.1e}"
        spent = most_spent(loop.context.monitor.history.spent)
        reason = f"{status.describe(options)}; {reached}; {spent}"
        if status is SolveStatus.INTERRUPTED:
            reason = status.describe(options)
        return Outcome(candidate, self.iterate, status, reason, tolerance)


@dataclass(frozen=True)
class _Loop:
    """The problem and the scale of one outer loop."""

    context: SolveContext  # with the data of this loop
    certifier: Certifier
    d_0: Vector  # (m,) BK^+(f - B'lambda~) - c, printed d in (11.39), not deflated
    scale: EnergyScale  # the tolerances are relative to it
    bounds: Bounds | None  # slip bounds that multipliers make, if these follow them
    suffices: Suffices | None  # whether an iterate that stalls is accurate enough

    @staticmethod
    def begin(
        context: SolveContext,
        shortened: Mask,
        feasible: FeasibleState,
        bounds: Bounds | None = None,
        suffices: Suffices | None = None,
    ) -> _Loop:
        """Compute d_0 and the scale."""
        certifier = Certifier(context.setup, context.data, context.body_names)
        scale = EnergyScale.of(context, feasible, shortened)
        return _Loop(context, certifier, feasible.jumps - context.data.c, scale, bounds, suffices)

    def at_rest(self, multipliers: Vector) -> Outcome:
        """Return u = o, with multipliers that balance the load."""
        setup, data = self.context.setup, self.context.data
        none = np.zeros_like(data.load)
        active = np.zeros(setup.constraints.inequality.size, dtype=bool)
        with self.context.timer.phase("recovery"):
            face = Face.of_multipliers(
                setup.constraints, multipliers, data.radius, active, springs=data.springs
            )
            projector = Projector.build(setup.projector.coarse_space, face)
            recovered = Recovered(none, none, none, -data.c, active, face)
            candidate = self._certified(recovered, multipliers, projector)
        return Outcome(candidate, Iterate(multipliers), SolveStatus.SOLVED, "converged", 0.0)

    def first(self, start: Iterate | None) -> Iterate:
        """Return the start, or multipliers that vanish: no contact, nothing glued."""
        method = Method(self.context.options.method)
        if self.bounds is not None:
            method = Method.GRADIENTS
        # where nothing moves, other multipliers would leave displacements of rounding size
        if start is None or self.scale.energy_norm == 0.0:
            return Iterate(np.zeros_like(self.d_0), method)
        return replace(start, method=method)

    def strategy(self, first: Method) -> Strategy:
        """Return who goes on after whom, from a first method on."""
        context, deflated = self.context, self.context.setup.deflation is not None
        return Strategy.of(
            first,
            context.options,
            context.monitor,
            follows=self.bounds is not None,
            deflated=deflated,
        )

    def minimise(self, iterate: Iterate, strategy: Strategy, tolerance: float) -> Iterate:
        """Solve the dual problem by one method after another, first the one of the iterate."""
        products = self.context.monitor.history.products
        following: Method | None = iterate.method
        strategy.begin(tolerance)
        while following is not None:
            method, begin, before = following, iterate, products.total
            iterate = self._run(method, begin, strategy)
            if self._suffices(iterate):
                return replace(iterate, status=SolveStatus.INEXACT)
            following = strategy.after(method, iterate.status, products.total - before)
            if iterate.status is SolveStatus.AT_ROUNDING and following is not None:
                # rounding has spoilt it: the next method goes on from where this one began
                iterate = replace(begin, status=iterate.status)
        return iterate

    def _suffices(self, iterate: Iterate) -> bool:
        """Tell whether the active set method has stalled where no better solution is needed."""
        stalled = iterate.method is Method.ACTIVE_SET and iterate.status is SolveStatus.STALLED
        return stalled and self.suffices is not None and self.suffices(iterate)

    def _run(self, method: Method, iterate: Iterate, strategy: Strategy) -> Iterate:
        """Run a method for its turn."""
        turn = strategy.turn(method)
        if method is not Method.GRADIENTS:
            # the other methods take the bounds of the problem
            iterate = replace(iterate, radius=None)
        by_smalbe = method is Method.SMALBE
        problem = self.problem(LANCZOS_STEPS if by_smalbe else ROUGH_LANCZOS_STEPS)
        run: dict[Method, Callable[[DualProblem, Iterate, Turn], Iterate]] = {
            Method.ACTIVE_SET: primal_dual_active_set,
            Method.GRADIENTS: partial(projected_gradients, bounds=self.bounds),
            Method.NEWTON: proximal_newton,
            Method.SMALBE: solve_by_smalbe,
        }
        spent, before = self.context.monitor.history.spent, turn.products.total
        with self.context.timer.phase("iterations"):
            iterate = run[method](problem, iterate, turn)
            iterate = replace(iterate, multipliers=self._completed(iterate.multipliers))
        spent[method] = spent.get(method, 0) + turn.products.total - before
        if iterate.status is SolveStatus.SOLVED:
            return iterate
        if interruption.agreed():
            return replace(iterate, status=SolveStatus.INTERRUPTED)
        if strategy.is_spent:
            return replace(iterate, status=SolveStatus.OUT_OF_PRODUCTS)
        return iterate

    def recover(self, iterate: Iterate) -> Candidate:
        """Recover displacements, and measure how well they and lambda solve (11.21)."""
        if iterate.radius is not None and iterate.radius is not self.context.data.radius:
            return self._with_radius(iterate.radius).recover(iterate)
        multipliers = iterate.multipliers
        setup, data = self.context.setup, self.context.data
        constraints = setup.constraints
        feasible = constraints.friction.multiplier_set(
            pushing_rows(constraints, data.springs), np.zeros(constraints.size), data.radius
        )
        multipliers = feasible.project(multipliers.copy())
        multipliers = constraints.friction.at_bound(multipliers, data.radius)
        with self.context.timer.phase("recovery"):
            coarse_space = setup.projector.coarse_space
            multipliers, projector = balance_multipliers(
                coarse_space, data.e, multipliers, data.radius, data.springs
            )
            # F makes jumps of what the balance has added, large ones in the deflated directions
            multipliers = without_unloaded_groups(
                constraints,
                setup.row_bodies,
                data.load,
                data.c,
                self._completed(multipliers),
                data.springs,
            )
            recovered = recover_displacement(
                setup.F, projector, data.load, data.c, multipliers, setup.local.unit, data.motion
            )
            return self._certified(recovered, multipliers, projector)

    def _with_radius(self, radius: Vector) -> _Loop:
        """Return the loop with other slip bounds."""
        context = replace(self.context, data=replace(self.context.data, radius=radius))
        certifier = Certifier(context.setup, context.data, context.body_names)
        return replace(self, context=context, certifier=certifier)

    def _certified(
        self, recovered: Recovered, multipliers: Vector, projector: Projector
    ) -> Candidate:
        """Measure how well displacements and multipliers solve (11.21)."""
        certificate, energy = self.certifier.certify(recovered, multipliers, projector.coarse_space)
        slips, radius = self.certifier.slips(recovered), self.context.data.radius
        return Candidate(recovered, multipliers, certificate, energy, projector, slips, radius)

    def _completed(self, multipliers: Vector) -> Vector:
        """Return the multipliers with their part in the deflated directions."""
        deflation = self.context.setup.deflation
        if deflation is None:
            return multipliers
        return deflation.completed(multipliers, self.d_0, self.context.data.feasible)

    @cached_property
    def _loads(self) -> tuple[Vector, Vector]:
        """Right-hand sides d and d_0, deflated or not."""
        setup = self.context.setup
        with self.context.timer.phase("iterations"):
            return setup.load(self.context.data), setup.reduced(self.d_0)

    def problem(self, lanczos_steps: int) -> DualProblem:
        """Return (11.36), deflated or not."""
        setup, data = self.context.setup, self.context.data
        with self.context.timer.phase("norm"):
            norm = setup.norm(lanczos_steps)
        d, d_0 = self._loads
        return DualProblem(
            setup.part,
            d,
            data.e,
            data.e_size,
            data.c,
            setup.projector,
            norm,
            setup.preconditioner,
            data.radius,
            setup.local.unit,
            data.feasible,
            d_0,
            self.scale.energy_norm,
            data.springs,
        )

"""TornSolver: Total FETI from a torn system to displacements, contact forces and a report."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.errors import InputError, Interrupted, NotConverged
from fenics_tfeti.feti import interruption
from fenics_tfeti.feti.checks.system import check_guess, check_system, check_types
from fenics_tfeti.feti.coarse.feasible_start import feasible_start
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.coarse.unresisted import check_load
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.constraints.feasibility import check_conditions
from fenics_tfeti.feti.constraints.ground import hold_ground
from fenics_tfeti.feti.constraints.interface import Interface
from fenics_tfeti.feti.constraints.row_table import Kind
from fenics_tfeti.feti.constraints.rows import Constraints, build_constraints
from fenics_tfeti.feti.constraints.springs import Springs, adhesion
from fenics_tfeti.feti.dual.iterate import Iterate
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.feti.factors.supernodal import Orderings
from fenics_tfeti.feti.files.checkpoint import SavedState
from fenics_tfeti.feti.options import Options
from fenics_tfeti.feti.report.report import Report, build_report
from fenics_tfeti.feti.report.resultants import friction_shares, tangential_forces
from fenics_tfeti.feti.solution.attempts import next_attempt
from fenics_tfeti.feti.solution.coulomb import iterate_slip_bounds
from fenics_tfeti.feti.solution.linear import LinearProblem
from fenics_tfeti.feti.solution.monitor import Monitor, MonitorFunction
from fenics_tfeti.feti.solution.outer import dual_problem
from fenics_tfeti.feti.solution.setup import (
    DualSetup,
    LocalSetup,
    SolveContext,
    choose_factor,
    factor_subdomains,
)
from fenics_tfeti.feti.solution.states import Candidate, ContactData, History, Outcome
from fenics_tfeti.feti.system import ContactGuess, TornSystem
from fenics_tfeti.feti.timer import Timer
from fenics_tfeti.feti.tolerances import SURFACE
from fenics_tfeti.parallel import any_rank, raise_collectively
from fenics_tfeti.typing import Vector


@dataclass(frozen=True)
class TornSolution:
    """The solution on this rank.

    Attributes
    ----------
    displacements : list of (n_i,) arrays
        u_i of this rank's subdomains, equal at all copies of a node; nothing is penetrated [m].
    torn_displacements : list of (n_i,) arrays
        u_i by (11.29), in equilibrium with the multipliers; copies of a node differ by what the
        stopping test leaves [m].
    normal_force : (contact rows of this rank,) array
        Nodal normal force of each contact row that this rank gave; negative where a spring pulls,
        or adhesion [N].
    active : (contact rows of this rank,) bool array
        Whether the row presses, or is kept closed by adhesion; of a held row whether it is a row of
        the problem.
    tied_force : (tied rows of this rank,) array
        Force of each tied row that this rank gave, on the slave against the direction of the
        slave's sum [N].
    tangential_force : (sites of this rank, gdim - 1) array
        Friction force at each contact row with friction that this rank gave, on the slave against
        the tangents [N].
    slip : (sites of this rank, gdim - 1) array
        Its slip along the tangents [m]; zero where it sticks without elastic slip, and where it is
        not a part of the problem: nothing to touch there, or a direction that prescribed
        displacements decide.
    sticking : (sites of this rank,) bool array
        Whether the tangential force is below its bound.
    slip_bound : (sites of this rank,) array
        Its slip bound; with Coulomb's law that of its normal force [N].
    multipliers : (m,) array
        lambda, as far as this rank holds it.
    report : Report
        Sizes, iterations, residuals and times.
    """

    displacements: list[Vector]
    torn_displacements: list[Vector]
    normal_force: Vector
    active: NDArray[np.bool_]
    tied_force: Vector
    tangential_force: Vector
    slip: Vector
    sticking: NDArray[np.bool_]
    slip_bound: Vector
    multipliers: Vector
    report: Report


class TornSolver:
    """Total FETI for one torn system; the set-up is done at once.

    For a sequence of systems, give each solver the one before: factors are reused where the
    stiffness matrices are the same objects, the coarse problem, F, its norm and the preconditioner
    where the constraint rows are equal too (whatever their gaps and compliances), and the
    iterations start from the last multipliers.

    Parameters
    ----------
    system : TornSystem
        Subdomains, prescribed displacements, contact rows.
    options : Options, optional
        Tolerances and methods.
    timer : Timer, optional
        To add the times of phases to; by default each report has those since the one before.
    previous : TornSolver, optional
        Solver of an earlier, similar system with the same options.
    guess : ContactGuess, optional
        Expected contact forces and gaps: the start of the active set method.
    start : SavedState, optional
        The state of a checkpoint, where the iterations start if there is no previous solver; left
        out if it has other rows.

    Attributes
    ----------
    setup : DualSetup
        Operators.
    data : ContactData
        Loads, right-hand sides and the feasible start.
    reused : list of str
        What was taken over from the previous solver.

    Raises
    ------
    InputError
        Wrong or contradictory data, before any factorisation.
    UnresistedMotion
        The load pushes a body where nothing holds it, before any factorisation of a stiffness.
    FactorizationError
        A stiffness matrix is not positive semidefinite.
    """

    setup: DualSetup
    data: ContactData
    reused: list[str]

    def __init__(
        self,
        system: TornSystem,
        options: Options | None = None,
        timer: Timer | None = None,
        previous: TornSolver | None = None,
        guess: ContactGuess | None = None,
        start: SavedState | None = None,
    ) -> None:
        _check_arguments(system, options)
        self.system = system
        self.options = options or Options()
        self.timer = timer or Timer()
        self._has_own_timer = timer is None
        _given_by_all(system.comm, "start", start, "load_checkpoint gives each rank its part")
        with raise_collectively(system.comm):
            package = choose_factor(self.options)
        self._deflation_solves = 0
        # of the factors of all solvers of a sequence
        self._orderings: Orderings = {} if previous is None else previous._orderings
        with interruption.deferred():
            self.setup, self.data, self.reused = self._set_up(package, previous, guess)
        self._constraints = self.setup.constraints
        self._norm_products = self.setup.norm.products
        self._start = self._first_state(previous, guess, start)
        self._last: Candidate | None = None  # where the last solve has ended

    def _set_up(
        self, package: str, previous: TornSolver | None, guess: ContactGuess | None
    ) -> tuple[DualSetup, ContactData, list[str]]:
        """Check all data; build the operators, or take over those of the previous solver."""
        system, options, phase = self.system, self.options, self._phase
        same_K = previous is not None and _has_same_stiffness(system, previous.system)
        known = previous.setup if previous is not None and same_K else None
        with phase("constraints"):
            check_system(system, stiffness=known is None)
            _check_guess(guess, system, options)
            local = known.local if known else LocalSetup.build(system, options)
            constraints, c = build_constraints(system, local.weights)
            check_conditions(system, constraints, c)
            constraints, c = hold_ground(constraints, c, local.unknowns)
            springs = Springs.build(system, constraints, local.unit)
            adhesive = adhesion(system, constraints)
            same_B = known if known and constraints.same_rows(known.constraints) else None
        with phase("coarse problem"):
            if same_B:
                projector = same_B.projector
            else:
                interface = Interface.build(constraints.matrix, local.classes)
                coarse_space = CoarseSpace.build(
                    system,
                    constraints,
                    interface,
                    local.kernels,
                    package,
                    options.coarse_solver,
                )
                projector = Projector.build(coarse_space, Face.whole(constraints))
        with phase("feasible start"):
            data = self._data(local, projector, c, constraints, springs, adhesive)
        with phase("factorisation"):
            if same_B:
                return same_B, data, ["factors", "coarse problem", "norm"]
            inverses = (
                known.F.inverses
                if known
                else factor_subdomains(system, options, local, package, self._orderings)
            )
            setup = DualSetup.build(system, options, local, projector, inverses, package)
        with phase("deflation"):
            setup = setup.deflated(system, options, known)
        self._deflation_solves = setup.deflation_solves
        return setup, data, ["factors"] if known else []

    @contextmanager
    def _phase(self, name: str) -> Iterator[None]:
        """Add the time of a block to a phase, after which the ranks may be interrupted."""
        with self.timer.phase(name):
            yield
        interruption.check(self.system.comm)

    def _data(
        self,
        local: LocalSetup,
        projector: Projector,
        c: Vector,
        constraints: Constraints,
        springs: Springs | None,
        adhesive: Vector | None,
    ) -> ContactData:
        """Return loads and right-hand sides, after checking that the load can be balanced."""
        system, coarse_space = self.system, projector.coarse_space
        load = local.unknowns.with_ground(
            np.concatenate([np.zeros(0), *(s.load for s in system.subdomains)])
        )
        load_size = local.unknowns.with_ground(
            np.concatenate([np.zeros(0), *(s.size_of_load for s in system.subdomains)])
        )
        if adhesive is not None:
            pulls = constraints.matrix.T @ adhesive
            load, load_size = load + pulls, load_size + np.abs(pulls)
        friction = constraints.friction
        e = coarse_space.coarse_load(load)
        check_load(system, projector, e)
        bound = friction.bound
        self._balance = partial(
            feasible_start,
            system,
            coarse_space,
            e,
            c,
            local.unit,
            springs=springs,
            close_gaps=self.options.method != "smalbe",
        )
        feasible = self._balance(bound)
        radius = bound.at(friction.pressing(feasible, coarse_space.constraints.layout))
        size = coarse_space.coarse_load_size(load_size)
        return ContactData(
            load,
            c,
            e,
            size,
            feasible,
            bound,
            friction.own_bound,
            radius,
            springs=springs,
            adhesion=adhesive,
        )

    def _first_state(
        self, previous: TornSolver | None, guess: ContactGuess | None, start: SavedState | None
    ) -> Iterate | None:
        """Return where the last solve ended, if its multipliers are the same ones, or the guess."""
        state: Iterate | None = None
        if previous is None and start is not None:
            state = start.for_rows(self.setup.constraints)
            if state is not None:
                self.reused.append("checkpoint")
        if previous is not None and previous._start is not None:
            last, constraints = previous._start, self.setup.constraints
            if constraints.same_numbering(previous._constraints):
                state = Iterate(last.multipliers, is_direct=last.is_direct)
                self.reused.append("multipliers")
        if guess is None:
            return state
        self.reused.append("contact guess")
        return self._guessed_state(state, guess)

    def _guessed_state(self, state: Iterate | None, guess: ContactGuess) -> Iterate:
        """Return a state with the guessed forces and active set of the inequality rows."""
        constraints, contacts = self.setup.constraints, self.setup.constraints.contacts
        kept, rows = contacts.own_rows >= 0, constraints.inequality
        own, share = contacts.own_rows[kept], contacts.share[kept]
        force, gap = np.zeros(constraints.size), np.zeros(constraints.size)
        np.add.at(force, own, np.maximum(guess.normal_force[kept], 0.0))
        # beyond any gap is far enough; infinite ones are no numbers to be summed with zeros
        np.add.at(gap, own, share * np.minimum(guess.gap[kept], np.finfo(float).max))
        force, gap = (constraints.layout.sum(x)[rows] for x in (force, gap))
        # scale^2 is the stiffness, relative to that of a weight, of the row's nodes in series
        # a guessed force closes the gap against the stiffness of the surface
        unit, scale = SURFACE * self.setup.local.unit, constraints.rows.of(Kind.CONTACT).scale
        active = force / (unit * scale**2) > gap
        multipliers = np.zeros(constraints.size) if state is None else state.multipliers.copy()
        multipliers[rows] = np.where(active, force / scale, 0.0)
        return Iterate(multipliers, active=active, is_direct=_is_direct(state))

    @property
    def state(self) -> SavedState:
        """The last iterate, for `save_checkpoint`.

        Raises
        ------
        InputError
            If nothing was solved.
        """
        if self._start is None:
            raise InputError("there is no state to save; call solve() first")
        return SavedState.of(self._start, self._constraints)

    def dual_problem(self) -> DualProblem:
        """Return the dual problem (11.36), to solve it by another method. Collective.

        It is that with F and d themselves, without deflation.
        """
        setup, monitor = self.setup.for_solve(), Monitor(History(), self.system.comm)
        setup = setup.without_deflation()
        return dual_problem(SolveContext(setup, self.data, self.options, self.timer, monitor))

    def linear_problem(self) -> LinearProblem:
        """Return the linear problem on the face where the last solve has ended. Collective.

        Raises
        ------
        InputError
            If nothing was solved, or the solver was released.
        """
        if self._last is None:
            raise InputError("there is no face that a solve has ended on; call solve() first")
        setup = self.setup.for_solve(_is_direct(self._start))
        shares = friction_shares(self._constraints, self.data, self._last.multipliers)
        return LinearProblem.build(self.system, setup, self._last, self.options, shares)

    def release(self) -> None:
        """Free the factors and the stiffness matrices of this solver, which cannot solve then.

        As `previous` of another solver it passes on its last multipliers. Without this call, both
        sets of factors are in memory while the other solver is made.
        """
        self.system = replace(self.system, subdomains=[])
        if hasattr(self, "setup"):
            del self.setup, self._balance
            self._last = None

    def solve(self, monitor: MonitorFunction | None = None) -> TornSolution:
        """Solve the dual problem (11.36) and recover the displacement (11.29).

        After an interruption, calling it again goes on from the last iterate.

        Parameters
        ----------
        monitor : callable, optional
            Called on all ranks with an `ActiveSetStep` for each face of the active set method and
            an `OuterIteration` for each outer iteration of SMALBE-M, when they end.

        Returns
        -------
        TornSolution
            Displacements, forces and the report.

        Raises
        ------
        InputError
            If the solver was released.
        NotConverged
            At a limit on iterations, unless the options ask for the best iterate.
        Interrupted
            After Ctrl-C or SIGINT to one rank, on all of them, with the last iterate; of SMALBE-M
            the one that it has started from.
        """
        if not hasattr(self, "setup"):
            raise InputError("the solver was released, and can only be the previous one of another")
        history = History(
            norm_products_before=self._norm_products, deflation_solves=self._deflation_solves
        )
        comm = self.system.comm
        watched = any_rank(comm, monitor is not None)
        with interruption.deferred():
            return self._solve(
                Monitor(history, comm, monitor, watched, self.options.print_progress)
            )

    def _solve(self, monitor: Monitor) -> TornSolution:
        setup = self.setup.for_solve(_is_direct(self._start))
        context = SolveContext(
            setup, self.data, self.options, self.timer, monitor, self.system.body_names
        )
        balance = partial(self._balance, explain=False)
        outcome = iterate_slip_bounds(context, self._start, balance)
        self._start = replace(outcome.start, is_direct=setup.is_direct)
        # for derivatives, which need neither u_t nor its strained part
        none, last = np.zeros(0), outcome.candidate
        recovered = replace(last.recovered, strained=none, torn=none)
        self._last = replace(last, recovered=recovered)
        report = build_report(self.system, context, outcome, list(self.reused))
        if self._has_own_timer:
            self.timer.restart()
        # a further solve spends nothing on the set-up
        self.reused = ["factors", "coarse problem", "norm", "multipliers"]
        self._norm_products, self._deflation_solves = self.setup.norm.products, 0
        solution = self._solution(outcome, report)
        try:
            interruption.check(self.system.comm)
        except Interrupted:
            raise Interrupted("interrupted", solution, report) from None
        if not outcome.converged and self.options.error_if_not_converged:
            remedy = next_attempt(
                outcome.status, monitor.history.spent, self.options, report.preconditioner
            )
            raise NotConverged(
                f"not converged to rtol {self.options.rtol:g}: {outcome.reason}. {remedy}, or set "
                "error_if_not_converged to false to get the best iterate",
                solution,
                report,
            )
        return solution

    def _solution(self, outcome: Outcome, report: Report) -> TornSolution:
        multipliers = outcome.candidate.multipliers
        unknowns = self.setup.local.unknowns
        recovered = outcome.candidate.recovered
        constraints = self.setup.constraints
        pressed, friction = constraints.contacts.forces(multipliers), constraints.friction
        forces = self.data.without_adhesion(multipliers)
        # where nothing slips the last bounds may be those of other normal forces
        pressing = friction.given(friction.pressing(multipliers, constraints.layout))
        bound = friction.given(friction.scale) * self.data.own_bound.at(pressing)
        bound = np.where(np.isinf(self.system.friction.bound), np.inf, bound)
        return TornSolution(
            unknowns.split(recovered.displacement),
            unknowns.split(recovered.torn),
            constraints.contacts.forces(forces),
            (pressed > 0.0) | constraints.held,
            constraints.tied.forces(multipliers),
            tangential_forces(constraints, self.data, multipliers),
            friction.given(outcome.candidate.slips / friction.scale[:, None]),
            friction.given(recovered.face.sticking.astype(float)) > 0.0,
            bound,
            multipliers,
            report,
        )


def _check_arguments(system: TornSystem, options: Options | None) -> None:
    """Check types that no communicator is needed for; they are the same on all ranks."""
    if not isinstance(system, TornSystem):
        raise InputError(f"system: got {type(system).__name__}, expected a TornSystem")
    if options is not None and not isinstance(options, Options):
        raise InputError(
            f"options: got {type(options).__name__}, expected Options; parse_options makes them "
            "from a mapping"
        )


def _is_direct(start: Iterate | None) -> bool:
    """Tell whether faces are solved directly from a start on."""
    return start is not None and start.is_direct


def _has_same_stiffness(system: TornSystem, previous: TornSystem) -> bool:
    """Tell, with one answer on all ranks, whether two systems share their stiffness matrices."""
    with raise_collectively(system.comm):
        check_types(system)
    same = len(system.subdomains) == len(previous.subdomains) and all(
        s.stiffness is t.stiffness
        and s.nodes is t.nodes
        and s.frame is t.frame
        and s.has_kernel_of(t)
        for s, t in zip(system.subdomains, previous.subdomains, strict=True)
    )
    return bool(system.comm.allreduce(same, MPI.LAND))


def _check_guess(guess: ContactGuess | None, system: TornSystem, options: Options) -> None:
    """Check that all ranks or none give a guess, each for its contact rows. Collective."""
    remedy = "a rank without contact rows gives a ContactGuess of empty arrays"
    if not _given_by_all(system.comm, "guess", guess, remedy):
        return
    with raise_collectively(system.comm):
        assert guess is not None
        check_guess(guess, system.contacts.size)
        if options.method != "active_set":
            raise InputError(
                "a guess of the contact is the start of method='active_set'; with "
                f"{options.method!r} leave it out"
            )


def _given_by_all(comm: MPI.Intracomm, what: str, value: object, remedy: str) -> bool:
    """Tell whether an argument is given; `InputError` if it is on some ranks only. Collective."""
    is_given = any_rank(comm, value is not None)
    with raise_collectively(comm):
        if is_given and value is None:
            raise InputError(f"{what}: this rank gives none, others do; {remedy}")
    return is_given

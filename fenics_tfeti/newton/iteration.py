"""Newton's method for bodies in contact: a contact problem for the increment in each step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import (
    InputError,
    NotConverged,
    UnstableTangent,
    first_few,
    format_point,
)
from fenics_tfeti.fem.displacement import fill_displacement, owned_values
from fenics_tfeti.feti import (
    TangentKind,
    Timer,
    TornSolution,
    TornSolver,
    interruption,
    prepare_tangents,
)
from fenics_tfeti.feti.coarse.free_motions import describe_free_motions
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.feti.tangents import has_small_strains, have_symmetric_tangents
from fenics_tfeti.newton.contact_hessian import ContactHessian, Correction, Spent
from fenics_tfeti.newton.equilibrium import Multipliers
from fenics_tfeti.newton.face import Change, Face
from fenics_tfeti.newton.frozen_setup import FrozenSetup
from fenics_tfeti.newton.load_case import LoadCase, NewtonState
from fenics_tfeti.options import NewtonOptions
from fenics_tfeti.parallel import any_rank, largest_of_groups, print_on_first_rank
from fenics_tfeti.typing import Numbers, Vector

Monitor = Callable[[Any], None]

# accuracy of GMRES, by the residual of Newton's method, and its limits
_FORCING, _LOOSEST, _TIGHTEST = 0.3, 0.01, 1e-5
# residual above which a step turns away from equilibria that are not stable
_FAR = 0.01
# part of its residual that GMRES may leave
_FAILED = 0.1
# face solves of a step, with what a frozen set-up lacks, above which it is made anew
_SLOW = 8
# shortest part of a step that is tried
_SHORTEST = 1e-3
# the remedy for steps that fail
SMALLER = "Take shorter load steps: problem.steps(set_load, begin, end) halves those that fail"


@dataclass(frozen=True)
class NewtonStep:
    """One step of Newton's method.

    Attributes
    ----------
    residual : float
        Forces at free nodes that are not in equilibrium, after the step, relative to the largest of
        reactions, contact forces and the first residual; with contact forces along the normals of
        the surfaces after the step. Here and below, what rounding of coordinates leaves of forces
        and distances is none.
    penetration : float
        Largest depth of a slave node in its master or obstacle, relative to the displacement.
    separation : float
        Largest distance of a pressing node, relative to the displacement.
    friction : float
        By how much friction forces break their law, relative to the forces as the residual: what
        they are above their bounds, or below them where nodes slip; slips of nodes that stick,
        relative to the displacement.
    length : float
        Part of the increment that was taken: 1, or less where deformations would change too much.
    active : int
        Pressing conditions.
    products : int
        Applications of F, also for solutions that were not taken.
    corrections : int
        Solutions on the face of the pressing conditions, for contact forces that turn and move with
        the surfaces, and all of a step that takes the set-up of an earlier one.
    negative : int
        Directions of negative energy of the torn subdomains, which deflation removes.
    seconds : float
        Wall time [s].
    """

    residual: float
    penetration: float
    separation: float
    friction: float
    length: float
    active: int
    products: int
    corrections: int
    negative: int
    seconds: float

    def __str__(self) -> str:
        """Return the step as a line to read."""
        return (
            f"residual {self.residual:.1e}, penetration {self.penetration:.1e}, separation "
            f"{self.separation:.1e}, friction {self.friction:.1e}, length {self.length:.2g}"
            f", {self.active} pressing, {self.products} products"
        )


@dataclass(frozen=True)
class LinearisedStep:
    """The solution of the linearised problem of a step."""

    face: Face
    corrected: Correction
    first: TornSolution  # of the set-up's problem, without the Hessian of contact

    def multipliers(self, part: float) -> Multipliers:
        """Return the forces after a part of the step."""
        changes = self.corrected.change.forces
        return self.face.after(changes, part, self.first.active, self.first.sticking)


class NewtonIteration:
    """Newton steps of one load step, from a state to equilibrium."""

    solution: TornSolution  # of the last step
    set_up: FrozenSetup | None = None  # of the last step that took GMRES
    has_unstable_tangents = False  # in the last set-up, as far as the bodies alone say
    # along a path of equilibria tangents are those of saddles, too, and taken whole
    _follows_path = False

    def __init__(
        self, load_case: LoadCase, options: NewtonOptions, timer: Timer, last: TornSolver | None
    ) -> None:
        self._load_case, self._options, self._timer = load_case, options, timer
        self.solver = last
        self.steps: list[NewtonStep] = []
        self._find_free_motions: Callable[[], list[str]] | None = None  # of the last solution
        self._increment = Function(load_case.torn.space)
        self._frozen: FrozenSetup | None = None
        self._spent = Spent()
        self._least = 0.0  # force that residuals are relative to [N]
        # nodes whose contact changed in the last step, and also in the one before
        self._changed = self._alternating = np.zeros(0, dtype=bool)

    def run(self, state: NewtonState, monitor: Monitor | None) -> Iterator[NewtonState]:
        """Yield the state after each step, the last one in equilibrium."""
        comm, options = self._load_case.torn.nodes.comm, self._options
        first = state.equilibrium
        self._least = first.force * max(1.0, first.residual)
        while len(self.steps) < options.newton_max_it:
            state = self._take_step(state, monitor)
            self.steps.append(replace(self.steps.pop(), seconds=self._timer.lap(comm)))
            self._report(monitor)
            yield state
            if self._is_converged(state):
                return
        raise NotConverged(self._not_converged(state))

    def linearised(self, state: NewtonState) -> tuple[Face, FrozenSetup]:
        """Return the face of a state in equilibrium, and a set-up for it. Collective."""
        face = self._load_case.face_of(state)
        if self.set_up is not None and self.set_up.has_conditions_of(self._load_case, face):
            return face, self.set_up
        self._frozen, self._follows_path = None, True
        face = self._solve_linearised(state, None).face
        assert self.set_up is not None
        return face, self.set_up

    def described_solution(self) -> TornSolution:
        """Return the last solution, with the motions that nothing resists. Collective."""
        if self._find_free_motions is not None:
            report = replace(self.solution.report, free_motions=self._find_free_motions())
            self.solution = replace(self.solution, report=report)
            self._find_free_motions = None
        return self.solution

    def _report(self, monitor: Monitor | None) -> None:
        """Pass the last step on to the user."""
        number, step = len(self.steps), self.steps[-1]
        if self._options.solver.print_progress:
            print_on_first_rank(self._load_case.torn.nodes.comm, f"Newton step {number}: {step}")
        if monitor is not None:
            monitor(step)

    def _is_converged(self, state: NewtonState) -> bool:
        is_whole = self.steps[-1].length == 1.0
        return is_whole and state.equilibrium.error <= self._options.newton_rtol

    def _take_step(self, state: NewtonState, monitor: Monitor | None) -> NewtonState:
        """Return the state after one step."""
        self._spent = Spent()
        step = self._solve_linearised(state, monitor)
        corrected = step.corrected
        change = corrected.change
        # it has the shortenings of bolts, which no state has
        self.solution = replace(self.solution, displacements=list(change.displacements))
        bodies, start = state.bodies, state.bodies.motions
        motions = state.rows.contact_set.motions_after(change.displacements)
        turned = [end - begin for begin, end in zip(start, motions, strict=True)]
        torn = self._load_case.torn
        fill_displacement(self._increment, torn.torn.subdomains, change.displacements)
        increment = np.concatenate([owned_values(self._increment), bodies.as_vector(turned)])
        new, length = self._shortened(state, increment, step, self._allowed_length(turned))
        pressing = new.multipliers.normal > 0.0
        changed = np.sign(new.multipliers.normal) != np.sign(state.multipliers.normal)
        self._alternating = changed & self._changed if self._changed.size else changed & False
        self._changed = changed
        report = self.solution.report
        self.steps.append(
            NewtonStep(
                new.equilibrium.residual,
                new.equilibrium.penetration,
                new.equilibrium.separation,
                new.equilibrium.friction,
                length,
                int(torn.nodes.comm.allreduce(np.count_nonzero(pressing))),
                self._spent.products,
                corrected.solves,
                report.deflation["negative"],
                0.0,
            )
        )
        return new

    def _allowed_length(self, turned: Sequence[Vector]) -> float:
        """Return the part of the increment that may be taken, with motions of bodies. Collective.

        A change of volume by tr(A^2) / 2, besides what is linear in the increment, is a pressure of
        at most mu: stresses above it, which equilibrium does not have, dominate the next tangent,
        and Newton's method wanders.
        """
        load_case, limit = self._load_case, self._options.newton_step_limit
        nodes = load_case.torn.nodes
        u, du = nodes.values(load_case.u), nodes.values(self._increment)
        size, trace = load_case.gradients.largest_increment(u, du)
        angles = [float(np.linalg.norm(motion[nodes.components :])) for motion in turned]
        of_volume = np.sqrt(0.5 * trace / load_case.shear_over_bulk)
        # in units of what is allowed
        excess = max([size / limit, of_volume, *np.divide(angles, limit)])
        return 1.0 if excess <= 1.0 else float(1.0 / excess)

    def _solve_linearised(self, state: NewtonState, monitor: Monitor | None) -> LinearisedStep:
        """Solve the linearised problem of a step.

        First with exact tangents on the face of the rows that press. Where the face leaves these
        unstable, with projected ones, for which GMRES makes up, but away from equilibria that are
        not stable; where that does not get anywhere with projected tangents in the whole contact
        problem.
        """
        options = self._options
        has_settled = not any_rank(self._load_case.torn.nodes.comm, self._changed)
        face = self._load_case.face_of(state, has_settled)
        if (step := self._solve_again(face, state)) is not None:
            return step
        on_face = any_rank(self._load_case.torn.nodes.comm, face.held)
        if options.tangent != "projected":
            self.has_unstable_tangents = False
            try:
                if (step := self._solve_on(face, state, options.tangent, monitor)) is not None:
                    return step
            except UnstableTangent:
                self.has_unstable_tangents = True
        if on_face:
            face = self._load_case.face_of(state)
            step = self._solve_on(face, state, "projected", monitor)
            if step is not None:
                return step
        face = face.without(face.held)
        step = self._solve_on(face, state, "projected", monitor, is_last=True)
        assert step is not None
        return step

    def _solve_again(self, face: Face, state: NewtonState) -> LinearisedStep | None:
        """Solve the linearised problem with the last set-up, if that is good for it. Collective."""
        interruption.check(self._load_case.torn.nodes.comm)
        frozen, self._frozen = self._frozen, None
        is_whole = bool(self.steps) and self.steps[-1].length == 1.0
        if frozen is None or not is_whole or not frozen.serves(self._load_case, face):
            return None
        accuracy = self._options.solver.rtol, *self._accuracy(state)
        corrected = None
        # rows may have no values near the state
        with suppress(InputError, NotConverged):
            corrected = frozen.corrected(self._load_case, state, face, accuracy, self._spent)
        if corrected is None or corrected.left > _FAILED:
            return None
        self.set_up = frozen
        if corrected.solves <= _SLOW:
            self._frozen = frozen
        return LinearisedStep(face, corrected, frozen.solution)

    def _accuracy(self, state: NewtonState) -> tuple[float, float]:
        """Return the part of its residual that GMRES leaves, and negligible forces [N]."""
        end = state.equilibrium
        # the residual at the start does not tell of supports that move
        residual = end.residual if self.steps else 1.0
        rtol = max(min(_LOOSEST, _FORCING * residual), _TIGHTEST)
        return rtol, 0.1 * self._options.newton_rtol * end.force

    def _solve_on(
        self,
        face: Face,
        state: NewtonState,
        tangent: TangentKind,
        monitor: Monitor | None,
        is_last: bool = False,
        known: tuple[TornSystem, TornSystem] | None = None,
    ) -> LinearisedStep | None:
        """Solve the linearised problem; None where another one should be tried. Collective.

        The system on another face of the state, and the one with its tangents, may be known.
        """
        load_case, options = self._load_case, self._options
        if self.solver is not None and known is None:
            self.solver.release()
        system = load_case.system_at(face, has_small_strains)
        force, beyond = load_case.out_of_balance(state, face)
        added = load_case.torn.spread(system.subdomains, force, beyond)
        system = replace(
            system,
            subdomains=[
                replace(s, load=load, load_size=np.abs(s.load) + np.abs(load))
                if s.nodes[0] < load_case.torn.nodes.total
                else replace(s, load=s.load + load)
                for s, load in zip(system.subdomains, added, strict=True)
            ],
        )
        prepared = prepare_tangents(system, tangent, known)
        solver = replace(options.solver, error_if_not_converged=False)
        self.solver = TornSolver(prepared, solver, self._timer, self.solver)
        self.solution = solution = self.solver.solve(monitor)
        self._find_free_motions = None
        self._spent.products += solution.report.products["total"]
        if not (is_last or solution.report.converged):
            return None
        comm, pulling = load_case.torn.nodes.comm, face.pulling(solution.normal_force)
        if any_rank(comm, pulling):
            face, known = face.without(pulling), (system, prepared)
            return self._solve_on(face, state, tangent, monitor, is_last, known)
        corrected = without = Correction(Change.of(solution))
        # forces of ties and bolts turn with them, too, and pressures follow the surface
        lacks = face.held.any() or face.rows.tied.size > 0
        lacks = lacks or self._follows_path or not have_symmetric_tangents(system.subdomains)
        if any_rank(comm, [lacks]):
            linear = self.solver.linear_problem()
            hessian = ContactHessian(
                load_case,
                state.displacement,
                face.with_free_forces(corrected.change.forces, solution.sticking),
                system.subdomains,
                face,
                linear,
                prepared.subdomains,
                self._spent,
            )
            # rows may have no values near the state
            with suppress(InputError, NotConverged):
                corrected = hessian.corrected(
                    without.change, (force, beyond), *self._accuracy(state)
                )
            if corrected is without or corrected.left > _FAILED:
                if not is_last:
                    return None
                corrected = without
            self._frozen = self.set_up = FrozenSetup(face, linear, prepared.subdomains, solution)
            # near its end Newton's method goes to the equilibrium that is there
            is_far = state.equilibrium.residual > _FAR
            if tangent == "projected" and is_far and not self._follows_path:
                corrected = corrected.downhill()
        self._find_free_motions = partial(
            describe_free_motions, system, solution.active, solution.sticking
        )
        return LinearisedStep(face, corrected, solution)

    def _shortened(
        self, last: NewtonState, increment: Vector, step: LinearisedStep, length: float
    ) -> tuple[NewtonState, float]:
        """Return the state at the end of a step, halved until that can be evaluated."""
        on_face = any_rank(self._load_case.torn.nodes.comm, step.face.held)
        while True:
            try:
                displacement = last.displacement + length * increment
                # forces that are all unknown are those at the end of the step
                multipliers = step.multipliers(length if on_face else 1.0)
                return self._state_after(last, displacement, multipliers, length), length
            except (InputError, NotConverged) as error:
                length *= 0.5
                if length < _SHORTEST:
                    raise NotConverged(
                        f"{self._free()}Newton's method cannot go on: already after "
                        f"{2.0 * length:.1g} of the step {error}. {SMALLER}"
                    ) from None

    def _state_after(
        self, last: NewtonState, displacement: Vector, multipliers: Multipliers, part: float
    ) -> NewtonState:
        """Return the state at the end of a part of a step."""
        return self._load_case.state_at(
            displacement, multipliers, last.bodies, self._least, last.rows
        )

    def _not_converged(self, state: NewtonState) -> str:
        end, report = state.equilibrium, self.solution.report
        unfinished = (
            ""
            if report.converged
            else f", and the last linearised problem is not solved: {report.reason}"
        )
        return (
            f"{self._free()}{self._alternation(state.rows.surface_nodes)}"
            f"no equilibrium after {len(self.steps)} steps of Newton's method (newton_max_it): "
            f"residual {end.residual:.1e}, the largest at {end.place}, penetration "
            f"{end.penetration:.1e} and separation {end.separation:.1e} of the largest "
            f"displacement, law of friction broken by {end.friction:.1e}; newton_rtol is "
            f"{self._options.newton_rtol:g}{self._course()}{self._worst_contact(state)}"
            f"{unfinished}. {SMALLER}"
        )

    def _course(self) -> str:
        """Say in which step the residual was least, if not in the last one."""
        residuals = [step.residual for step in self.steps]
        least = int(np.argmin(residuals))
        if least == len(residuals) - 1:
            return ", and the residual still falls: raise newton_max_it"
        return f"; the residual was least in step {least + 1}, {residuals[least]:.1e}"

    def _worst_contact(self, state: NewtonState) -> str:
        """Name the contact whose surfaces are farthest from touching, if any. Collective."""
        rows, names = state.rows, state.rows.contact_set.names
        pressing = state.multipliers.normal[rows.place] != 0.0
        distance = rows.distances_under(state.multipliers)
        distance = np.where(pressing, np.abs(distance), -distance)
        is_wrong = np.isfinite(distance)
        number = rows.contacts.contact[is_wrong]
        comm = self._load_case.torn.nodes.comm
        misfit = largest_of_groups(comm, distance[is_wrong], number, len(names), 0.0)
        worst = int(misfit.argmax()) if len(names) else 0
        return f"; surfaces are farthest from touching at {names[worst]}" if misfit.any() else ""

    def _free(self) -> str:
        """Say which motions nothing resists, if there are any. Collective."""
        motions = first_few(self.described_solution().report.free_motions, 3, "free motions")
        if not motions:
            return ""
        return f"hold what supports and pressing contacts leave free ({'; '.join(motions)}): "

    def _alternation(self, surface_nodes: Numbers) -> str:
        """Say at which nodes contact opens and closes in turn, if at any. Collective."""
        nodes = self._load_case.torn.nodes
        alternating = np.unique(surface_nodes[self._alternating]) - nodes.first
        places = [format_point(x) for x in nodes.coordinates[alternating[:1]]]
        count = nodes.comm.allreduce(alternating.size)
        if not count:
            return ""
        first = next(place for part in nodes.comm.allgather(places) for place in part)
        return f"contact at {count} nodes opens and closes in turn, the first at {first}; "

"""Newton's method for bodies in contact: a contact problem for the increment in each step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
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
from fenics_tfeti.fem.contact.conditions.friction import SlipOrigin
from fenics_tfeti.fem.contact.conditions.pairing import SlaveValues
from fenics_tfeti.fem.contact.contact_set import ContactSet
from fenics_tfeti.fem.contact.rigid.frames import RigidBodies
from fenics_tfeti.fem.contact.surfaces.tagged import extremes
from fenics_tfeti.fem.displacement import fill_displacement, fill_owned, owned_values
from fenics_tfeti.fem.gradients import CellGradients
from fenics_tfeti.fem.newton.equilibrium import DeformedRows, Equilibrium, Multipliers
from fenics_tfeti.fem.newton.mixing import AndersonMixing, Iterate
from fenics_tfeti.fem.newton.rounding import Rounding
from fenics_tfeti.fem.torn_problem import TornProblem
from fenics_tfeti.feti import Timer, TornSolution, TornSolver, TornSystem, prepare_tangents
from fenics_tfeti.feti.coarse.free_motions import describe_free_motions
from fenics_tfeti.feti.tangents import has_small_strains
from fenics_tfeti.feti.tolerances import CERTIFIED
from fenics_tfeti.last_state import solution_at
from fenics_tfeti.options import NewtonOptions
from fenics_tfeti.parallel import any_rank, largest_of_ranks, print_on_first_rank
from fenics_tfeti.typing import Numbers, Vector

Monitor = Callable[[Any], None]

# residual below which steps are mixed: farther off, mixing has led beams astray
_MIXED_BELOW = 0.05
# accuracy of the linearised problem of a step with friction, relative to the error before
_FORCING = 0.1
# shortest part of a step that is tried
_SHORTEST = 1e-3
# the remedy for steps that fail
_SMALLER = "Take shorter load steps: problem.steps(set_load, begin, end) halves those that fail"


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
        Applications of F.
    mixed : bool
        Whether the step was combined with earlier ones.
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
    mixed: bool
    negative: int
    seconds: float

    def __str__(self) -> str:
        """Return the step as a line to read."""
        mixed = ", mixed" if self.mixed else ""
        return (
            f"residual {self.residual:.1e}, penetration {self.penetration:.1e}, separation "
            f"{self.separation:.1e}, friction {self.friction:.1e}, length {self.length:.2g}"
            f"{mixed}, {self.active} pressing, {self.products} products"
        )


@dataclass(frozen=True)
class NewtonState:
    """A displacement with the conditions, multipliers and residual there."""

    # at the degrees of freedom that this rank owns, and of rigid bodies' corners (rank 0) [m]
    displacement: Vector
    rows: DeformedRows
    multipliers: Multipliers
    equilibrium: Equilibrium
    internal: Vector  # (owned, gdim): internal forces less loads at the mesh's nodes [N]

    @property
    def bodies(self) -> RigidBodies:
        """The rigid bodies where they are."""
        return self.rows.conditions.bodies

    def solution(self, last: TornSolution) -> TornSolution:
        """Return the solution of the step that led here with the forces here. Collective."""
        u = self.displacement[: self.internal.size].reshape(self.internal.shape)
        return solution_at(self.rows, self.multipliers, self.internal, u, last)


@dataclass(frozen=True)
class LoadStep:
    """A load step: what does not change in its Newton steps."""

    torn: TornProblem
    u: Function
    origin: SlipOrigin
    gradients: CellGradients
    shear_over_bulk: float  # mu / kappa of the least compressible material
    rounding: Rounding

    def state_at(
        self,
        displacement: Vector,
        multipliers: Multipliers | SlaveValues,
        bodies: RigidBodies,
        least: float = 0.0,
        last: DeformedRows | None = None,
    ) -> NewtonState:
        """Fill u, and measure surfaces and residual there. Collective.

        Multipliers may be normal forces (k,) [N]. The bodies, and the last rows, are those before
        the last step. The residual is relative to a least force [N] or more.
        """
        size = self.torn.nodes.owned * self.torn.nodes.components
        fill_owned(self.u, displacement[:size])
        bodies = bodies.moved(bodies.from_vector(displacement[size:]))
        self.torn.fill(self.u, bodies, is_small=False)
        displacement = np.concatenate([owned_values(self.u), displacement[size:]])
        bodies = self.torn.loaded(bodies)
        ratio, place = self.gradients.smallest_volume_ratio(self.torn.nodes.values(self.u))
        if not ratio > 0.0:
            raise NotConverged(f"the cell at {place} is inverted, with det F = {ratio:.2g}")
        rows = DeformedRows.of(self._conditions(bodies, last), self.u, self.origin)
        if not isinstance(multipliers, Multipliers):
            multipliers = Multipliers.from_forces(rows, multipliers)
        internal = -self.torn.torn.load()
        if any_rank(self.torn.nodes.comm, ~np.isfinite(internal)):
            raise NotConverged("the residual F is NaN or infinite")
        equilibrium = Equilibrium.of(
            internal, rows, multipliers, displacement, least, self.rounding
        )
        return NewtonState(displacement, rows, multipliers, equilibrium, internal)

    def _conditions(self, bodies: RigidBodies, last: DeformedRows | None) -> ContactSet:
        """Return the conditions of the surfaces deformed by u, near the last ones. Collective."""
        before = None if last is None else last.conditions
        here = replace(bodies, from_here=True)
        conditions = self.torn.undeformed.deformed(self.u, here, before)[0]
        return conditions.with_friction(self.u).with_turned_ties(self.u)


class NewtonIteration:
    """Newton steps of one load step, from a state to equilibrium."""

    solution: TornSolution  # of the last step

    def __init__(
        self, load_step: LoadStep, options: NewtonOptions, timer: Timer, last: TornSolver | None
    ) -> None:
        self._load_step, self._options, self._timer = load_step, options, timer
        self.solver = last
        self.steps: list[NewtonStep] = []
        self._mixing = AndersonMixing(
            load_step.torn.nodes.comm, options.newton_anderson, options.solver.rtol
        )
        self._increment = Function(load_step.torn.space)
        self._least = 0.0  # force that residuals are relative to [N]
        # nodes whose contact changed in the last step, and also in the one before
        self._changed = self._alternating = np.zeros(0, dtype=bool)

    def run(self, state: NewtonState, monitor: Monitor | None) -> Iterator[NewtonState]:
        """Yield the state after each step, the last one in equilibrium."""
        comm, options = self._load_step.torn.nodes.comm, self._options
        first = state.equilibrium
        self._least = first.force * max(1.0, first.residual)
        while len(self.steps) < options.newton_max_it:
            state = self._step(state, monitor)
            self.steps.append(replace(self.steps.pop(), seconds=self._timer.lap(comm)))
            self._report(monitor)
            yield state
            if self._is_converged(state):
                return
        raise NotConverged(self._not_converged(state))

    def _report(self, monitor: Monitor | None) -> None:
        """Pass the last step on to the user."""
        number, step = len(self.steps), self.steps[-1]
        if self._options.solver.monitor:
            print_on_first_rank(self._load_step.torn.nodes.comm, f"Newton step {number}: {step}")
        if monitor is not None:
            monitor(step)

    def _is_converged(self, state: NewtonState) -> bool:
        is_whole = self.steps[-1].length == 1.0
        return is_whole and state.equilibrium.error <= self._options.newton_rtol

    def _step(self, state: NewtonState, monitor: Monitor | None) -> NewtonState:
        """Return the state after one step."""
        self.solution = solution = self._solve_linearised(state, monitor)
        multipliers = Multipliers.of(state.rows, solution)
        changed = (multipliers.normal > 0.0) != (state.multipliers.normal > 0.0)
        self._alternating = changed & self._changed if self._changed.size else changed & False
        self._changed = changed
        bodies, start = state.bodies, state.bodies.motions
        motions = state.rows.conditions.motions_after(solution.displacements)
        turned = [end - begin for end, begin in zip(motions, start, strict=True)]
        increment = np.concatenate([owned_values(self._increment), bodies.as_vector(turned)])
        step = Iterate(state.displacement, increment, multipliers.flat())
        length = self._allowed_length(turned)
        mixed = self._mixed(state, step) if length == 1.0 else None
        new, length = self._shortened(mixed or step, multipliers, length, state.rows)
        self.steps.append(
            NewtonStep(
                new.equilibrium.residual,
                new.equilibrium.penetration,
                new.equilibrium.separation,
                new.equilibrium.friction,
                length,
                solution.report.unknowns["active"],
                solution.report.products["total"],
                mixed is not None,
                solution.report.deflation["negative"],
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
        load_step, limit = self._load_step, self._options.newton_step_limit
        nodes = load_step.torn.nodes
        u, du = nodes.values(load_step.u), nodes.values(self._increment)
        size, trace = load_step.gradients.largest_increment(u, du)
        angles = [float(np.linalg.norm(motion[nodes.components :])) for motion in turned]
        of_volume = np.sqrt(0.5 * trace / load_step.shear_over_bulk)
        # in units of what is allowed
        excess = max([size / limit, of_volume, *np.divide(angles, limit)])
        return 1.0 if excess <= 1.0 else float(1.0 / excess)

    def _solve_linearised(self, state: NewtonState, monitor: Monitor | None) -> TornSolution:
        """Solve the contact problem for the increment, which is filled."""
        load_step, options = self._load_step, self._options
        if self.solver is not None:
            self.solver.release()
        system = load_step.torn.system_at(
            load_step.u, state.rows, state.multipliers, has_small_strains
        )
        rtol, solution = self._accuracy(state), None
        with suppress(UnstableTangent):
            solution = self._solve(prepare_tangents(system, options.tangent), rtol, monitor)
        if solution is None or (
            not solution.report.converged and solution.report.deflation["negative"]
        ):
            # positive semidefinite
            solution = self._solve(prepare_tangents(system, "projected"), rtol, monitor)
        parts = load_step.torn.torn.subdomains
        fill_displacement(self._increment, parts, solution.displacements)
        free = describe_free_motions(system, solution.active, solution.sticking)
        return replace(solution, report=replace(solution.report, free_motions=free))

    def _accuracy(self, state: NewtonState) -> float:
        """Return the accuracy of the next linearised problem. Collective.

        Newton's method corrects displacements; tangential forces are those of the last linearised
        problem alone, to which the law of friction is to hold with the accuracy of all steps.
        """
        options, friction = self._options, state.rows.friction
        if not any_rank(self._load_step.torn.nodes.comm, friction.row >= 0):
            return options.solver.rtol
        wanted = max(state.equilibrium.error, options.newton_rtol)
        return min(options.solver.rtol, max(_FORCING * wanted, CERTIFIED))

    def _solve(self, system: TornSystem, rtol: float, monitor: Monitor | None) -> TornSolution:
        options = replace(self._options.solver, rtol=rtol, error_if_not_converged=False)
        self.solver = TornSolver(system, options, self._timer, self.solver)
        return self.solver.solve(monitor)

    def _mixed(self, state: NewtonState, step: Iterate) -> Iterate | None:
        """Return the step combined with earlier ones near the end, while the same nodes press."""
        if any_rank(self._load_step.torn.nodes.comm, self._changed):
            self._mixing.forget()
        if self._options.newton_anderson == 0 or state.equilibrium.residual >= _MIXED_BELOW:
            return None
        mixed = self._mixing.mix(step)
        return None if mixed is None or self._is_far(state, mixed, step) else mixed

    def _is_far(self, state: NewtonState, mixed: Iterate, step: Iterate) -> bool:
        """Tell whether a mixed step goes farther than facets are long. Collective.

        Where hardly anything resists sliding, the steps to come are not known that far.
        """
        comm, pairings = self._load_step.torn.nodes.comm, state.rows.conditions.pairings
        sizes = [pairing.surface.size.max(initial=0.0) for pairing in pairings]
        farther = largest_of_ranks(comm, np.abs(mixed.increment - step.increment))
        return bool(pairings) and farther > largest_of_ranks(comm, sizes)

    def _shortened(
        self, step: Iterate, multipliers: Multipliers, length: float, last: DeformedRows
    ) -> tuple[NewtonState, float]:
        """Return the state at the end of a step, halved until that can be evaluated."""
        while True:
            try:
                displacement = step.displacement + length * step.increment
                new = multipliers.from_flat(step.multipliers)
                bodies = last.conditions.bodies
                state = self._load_step.state_at(displacement, new, bodies, self._least, last)
                return state, length
            except (InputError, NotConverged) as error:
                length *= 0.5
                if length < _SHORTEST:
                    raise NotConverged(
                        f"{self._free()}Newton's method cannot go on: already after "
                        f"{2.0 * length:.1g} of the step {error}. {_SMALLER}"
                    ) from None

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
            f"{unfinished}. {_SMALLER}"
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
        rows, names = state.rows, state.rows.conditions.names
        pressing = state.multipliers.normal[rows.place] > 0.0
        distance = np.where(pressing, np.abs(rows.distance), -rows.distance)
        is_wrong = np.isfinite(distance)
        number = rows.contacts.contact[is_wrong]
        comm = self._load_step.torn.nodes.comm
        misfit = extremes(comm, distance[is_wrong], number, len(names), 0.0)
        worst = int(misfit.argmax()) if len(names) else 0
        return f"; surfaces are farthest from touching at {names[worst]}" if misfit.any() else ""

    def _free(self) -> str:
        """Say which motions nothing resists, if there are any."""
        motions = first_few(self.solution.report.free_motions, 3, "free motions")
        if not motions:
            return ""
        return f"hold what supports and pressing contacts leave free ({'; '.join(motions)}): "

    def _alternation(self, surface_nodes: Numbers) -> str:
        """Say at which nodes contact opens and closes in turn, if at any. Collective."""
        nodes = self._load_step.torn.nodes
        alternating = np.unique(surface_nodes[self._alternating]) - nodes.first
        places = [format_point(x) for x in nodes.coordinates[alternating[:1]]]
        count = nodes.comm.allreduce(alternating.size)
        if not count:
            return ""
        first = next(place for part in nodes.comm.allgather(places) for place in part)
        return f"contact at {count} nodes opens and closes in turn, the first at {first}; "

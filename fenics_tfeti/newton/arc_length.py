"""Newton's method along a path of equilibria, whose load is an unknown with a row of its own.

At limit points of a load there is no equilibrium for more of it; along the path, displacements go
on. Besides the step for the present load, each step solves for the change with the load by the same
set-up, and takes as much of it as the row asks for (Riks; block elimination): the mean of a'(u -
u_0) over the nodes is the length of the step, along the direction a of the last one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.displacement import prescribed_values
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.feti import Timer, TornSolver
from fenics_tfeti.newton.equilibrium import Multipliers
from fenics_tfeti.newton.face import Change
from fenics_tfeti.newton.iteration import LinearisedStep, Monitor, NewtonIteration
from fenics_tfeti.newton.load_case import LoadCase, NewtonState
from fenics_tfeti.options import NewtonOptions
from fenics_tfeti.parallel import any_rank
from fenics_tfeti.typing import Vector

# change of the load by which its derivative is differenced, relative to it
_DIFFERENCE = 1e-5
# Newton steps after which a shorter step along the path is tried; 4 or 5 are usual
_MOST = 10


@dataclass(frozen=True)
class Arc:
    """A step along a path, from an equilibrium."""

    set_load: Callable[[float], Any]
    load: float
    displacement: Vector  # (n,): at owned degrees of freedom [m]
    length: float  # root of the mean square of nodal displacements [m]
    direction: Vector | None = None  # (n,), of length one; None towards larger loads

    def mean(self, nodes: NodeMap, a: Vector, b: Vector) -> float:
        """Return the mean of the products of displacements over the nodes. Collective."""
        return float(nodes.comm.allreduce(float(a @ b))) / nodes.total

    def followed_by(self, nodes: NodeMap, load: float, displacement: Vector) -> Arc:
        """Return the next step, as long, from the end of this one. Collective."""
        secant = displacement - self.displacement
        size = np.sqrt(self.mean(nodes, secant, secant))
        return replace(self, load=load, displacement=displacement, direction=secant / size)


class ArcIteration(NewtonIteration):
    """Newton steps to the equilibrium at the end of a step along a path."""

    _follows_path = True  # equilibria beyond a limit point are no minima

    def __init__(
        self,
        load_case: LoadCase,
        options: NewtonOptions,
        timer: Timer,
        last: TornSolver | None,
        arc: Arc,
    ) -> None:
        most = min(options.newton_max_it, _MOST)
        super().__init__(load_case, replace(options, newton_max_it=most), timer, last)
        self._arc, self.load = arc, arc.load
        self._change = 0.0  # of the load in the present step

    def _solve_linearised(self, state: NewtonState, monitor: Monitor | None) -> LinearisedStep:
        step, torn, arc = super()._solve_linearised(state, monitor), self._load_case.torn, self._arc
        rate = self._rate(state, step)
        along = torn.at_owned_nodes(rate.displacements)
        end = state.displacement[: along.size] - arc.displacement
        end = end + torn.at_owned_nodes(step.corrected.change.displacements)
        a = arc.direction
        if a is None:
            a = along / np.sqrt(arc.mean(torn.nodes, along, along))
        lacking = arc.length - arc.mean(torn.nodes, a, end)
        self._change = lacking / arc.mean(torn.nodes, a, along)
        change = step.corrected.change.plus(self._change, rate)
        return replace(step, corrected=replace(step.corrected, change=change))

    def _state_after(
        self, last: NewtonState, displacement: Vector, multipliers: Multipliers, part: float
    ) -> NewtonState:
        self._arc.set_load(self.load + part * self._change)
        state = super()._state_after(last, displacement, multipliers, part)
        self.load += part * self._change
        return state

    def _rate(self, state: NewtonState, step: LinearisedStep) -> Change:
        """Return the changes with the load, per unit of it. Collective."""
        load_case, face, used = self._load_case, step.face, self.set_up
        assert used is not None
        difference = _DIFFERENCE * (abs(self.load) or 1.0)
        before = state.rows.force(state.multipliers)
        self._arc.set_load(self.load + difference)
        rows = load_case.rows_at(state.displacement, state.bodies, state.rows)
        after, internal = rows.force(state.multipliers), -load_case.torn.torn.load()
        self._check_supports()
        self._arc.set_load(self.load)
        load = state.internal + before[0] - internal - after[0]
        load = load_case.at_free(load, face.rows)
        contacts, tied = face.contacts, face.rows.tied
        gap = face.distances_of(rows) - contacts.gap / contacts.length
        tied_gap = (rows.tied.gap - tied.gap) / tied.length
        parts = [load, np.nan_to_num(gap), tied_gap, before[1] - after[1]]
        if not any_rank(load_case.torn.nodes.comm, [np.any(part) for part in parts]):
            raise InputError(
                f"follow: nothing changes with the load at {self.load:g}: set_load has to change "
                "values of the forms, as those of a Constant, or obstacles"
            )
        hessian = used.hessian(load_case, state, face, self._spent)
        return hessian.response(*(part / difference for part in parts))

    def _check_supports(self) -> None:
        """Check that prescribed displacements are those before. Collective."""
        torn = self._load_case.torn
        known = torn.undeformed.prescribed.values
        now = prescribed_values(torn.space, torn.bcs).values
        if any_rank(torn.nodes.comm, [not np.array_equal(now, known)]):
            raise InputError(
                "follow: set_load changes prescribed displacements, which pass limit points by "
                "themselves: take steps(set_load, begin, end), or change a force"
            )

"""The change of a solution along a change of the data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import nnls

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.displacement import fill_owned, owned_values
from fenics_tfeti.feti.solution.linear import LinearData, LinearSolution
from fenics_tfeti.feti.system import RowValues
from fenics_tfeti.feti.tolerances import ZERO
from fenics_tfeti.parallel import (
    any_rank,
    concatenate_ranks,
    first_of_rank,
    raise_collectively,
)
from fenics_tfeti.sensitivities.forms import (
    check_parameter,
)
from fenics_tfeti.sensitivities.linear_solves import LinearSolves
from fenics_tfeti.sensitivities.state import (
    DifferentiatedState,
    SolvedState,
    sides_of_contact,
    weights_of_contact,
)
from fenics_tfeti.sensitivities.supports import prescribed_changes
from fenics_tfeti.typing import Vector


@dataclass(frozen=True)
class Change:
    """Changes of the data."""

    forces: Vector  # (n,): df - dK u at the degrees of freedom that this rank owns [N]
    prescribed: Vector  # (n,): changes of prescribed displacements, zero at free ones [m]
    gap: Vector  # (rows,) [m]
    bound: Vector  # (sites,): of slip bounds, at the normal forces that are there [N]

    @staticmethod
    def of(
        state: DifferentiatedState,
        data: Mapping[Any, Any],
        gaps: Mapping[str | int, Any],
        slip_bounds: Mapping[str | int, Any],
        coefficients: Mapping[str | int, Any],
    ) -> Change:
        """Return what changes of Functions and Constants, and of contacts, make. Collective."""
        contact_set, force = state.contact_set, state.normal_force
        gap, bound = np.zeros(force.size), np.zeros(state.friction.size)
        with raise_collectively(state.torn.nodes.comm):
            for m in data:
                check_parameter(m)
            for name, given in gaps.items():
                own, values = weights_of_contact(contact_set, name, given, (), f"gaps[{name!r}]")
                gap[own] += values
            for label, named, factor in (
                ("slip_bounds", slip_bounds, state.areas),
                ("coefficients", coefficients, force),
            ):
                for name, given in named.items():
                    own, values = weights_of_contact(
                        contact_set, name, given, (), f"{label}[{name!r}]"
                    )
                    bound[state.sites_of(name)] += values * factor[own]
        prescribed, in_forms = prescribed_changes(
            state.forms, state.torn.bcs, contact_set.prescribed, data
        )
        return Change(state.forms.change(in_forms), prescribed, gap, bound)


class Tangent:
    """Change of the solution along a change of the data; `ContactProblem.tangent` makes it.

    Attributes
    ----------
    u : Function
        Change of the displacement [m].
    linear_solves, kinks
        As of `Adjoint`.
    """

    def __init__(self, state: SolvedState, change: Change, one_sided: bool, rtol: float) -> None:
        self._state, self.kinks = state, state.kinks()
        self.linear_solves = LinearSolves(state, rtol)
        data = self._data(change)
        solution = self._with_friction(data, change.bound)
        if one_sided:
            solution = self._one_sided(data, solution, change)
        self._forces = solution.forces
        self.u, _ = state.displacement(solution, "du")
        fill_owned(self.u, owned_values(self.u) + change.prescribed)

    def nodal_normal_force(self, name: str | int) -> Vector:
        """Return the changes (k,) of the normal forces at the nodes of ``results[name]`` [N]."""
        return self._forces.normal[self._state.rows_of(name)]

    def friction_force(self, name: str | int) -> Vector:
        """Return the changes (k, gdim) of the friction forces on the slave there [N]."""
        state = self._state
        sites = state.sites_of(name)
        tangents = state.linear.system.friction.tangents[sites]
        along = np.einsum("kt,kta->ka", self._forces.tangential[sites], tangents)
        return -along * sides_of_contact(state.contact_set, name)[:, None]

    def _data(self, change: Change) -> LinearData:
        """Return loads and jumps, with prescribed displacements as data. Collective."""
        state, forces = self._state, change.forces
        jumps = replace(state.zeros(), normal=change.gap)
        if any_rank(state.torn.nodes.comm, change.prescribed != 0.0):
            lifted = fill_owned(Function(state.forms.u.function_space), change.prescribed)
            forces = forces - state.forms.internal_forces(lifted)
            of_lift = state.jumps(change.prescribed)
            jumps = RowValues(change.gap - of_lift.normal, -of_lift.tangential, -of_lift.tied)
        return LinearData(state.torn_loads(forces), jumps, state.zeros())

    def _with_friction(self, data: LinearData, bound: Vector) -> LinearSolution:
        """Solve with changes of bounds; those of Coulomb's law follow the normal forces."""
        state = self._state
        mu, direction, rows = state.coefficient, state.direction, state.rows

        def with_bounds(data: LinearData, change: Vector) -> LinearSolution:
            forces = replace(data.forces, tangential=direction * change[:, None])
            return self.linear_solves.solve(replace(data, forces=forces))

        solution = with_bounds(data, bound)
        if not state.has_coulomb():
            return solution
        none = LinearData([np.zeros_like(x) for x in data.loads], state.zeros(), state.zeros())

        def pressing(solution: LinearSolution) -> Vector:
            return np.where(mu > 0.0, solution.forces.normal[rows], 0.0)

        y = self.linear_solves.by_gmres(
            lambda y: y - pressing(with_bounds(none, mu * y)), pressing(solution)
        )
        return with_bounds(data, bound + mu * y)

    def _one_sided(
        self, data: LinearData, solution: LinearSolution, change: Change
    ) -> LinearSolution:
        """Return the derivative of one side: rows that touch without a force press, or open.

        Their forces solve 0 <= x, S x >= q, x'(S x - q) = 0, with S the compliance of these rows,
        and q how far the solution with all of them open closes them.
        """
        state, comm = self._state, self._state.torn.nodes.comm
        touching = np.flatnonzero(state.linear.kinks()[0])
        first, total = first_of_rank(comm, touching.size)
        if not total:
            return solution
        if any(found.law is not None for found in state.contact_set.contacts):
            raise InputError(
                "one_sided with a law of an interface: nodes that touch have another stiffness on "
                "each side. Leave one_sided out, or change the data a little"
            )
        if state.has_coulomb():
            raise InputError(
                "one_sided with sites that slip by Coulomb's law: the forces of nodes that touch "
                "are no minimum then. Leave one_sided out, or change the data a little"
            )
        none = LinearData([np.zeros_like(x) for x in data.loads], state.zeros(), state.zeros())

        def with_forces(data: LinearData, x: Vector, bound: Vector) -> LinearSolution:
            forces = state.zeros()
            forces.normal[touching] = x[first : first + touching.size]
            return self._with_friction(replace(data, forces=forces), bound)

        def closing(solution: LinearSolution, gap: Vector) -> Vector:
            return concatenate_ranks(comm, (solution.jumps.normal - gap)[touching])

        no_gap, no_bound = np.zeros_like(change.gap), np.zeros_like(change.bound)
        S = -np.column_stack(
            [closing(with_forces(none, unit, no_bound), no_gap) for unit in np.identity(total)]
        )
        q = closing(solution, data.jumps.normal)
        # with S = U'U the solution has the least |U x - U'^+ q|; rows may depend on each other
        values, vectors = np.linalg.eigh(0.5 * (S + S.T))
        kept = values > ZERO * values.max()
        roots, V = np.sqrt(values[kept]), vectors[:, kept]
        x = nnls(roots[:, None] * V.T, V.T @ q / roots)[0]
        return with_forces(data, x, change.bound)

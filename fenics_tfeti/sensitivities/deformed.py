"""Derivatives of solutions on deformed surfaces: with finite strains, and with exact gaps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.sparse as sp

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.contact_set import ContactSet
from fenics_tfeti.fem.displacement import fill_owned, owned_values
from fenics_tfeti.fem.torn_problem import TornProblem
from fenics_tfeti.feti.solution.linear import LinearData, LinearProblem
from fenics_tfeti.feti.system import Friction, RowValues
from fenics_tfeti.newton.equilibrium import DeformedRows, Multipliers
from fenics_tfeti.newton.face import Face
from fenics_tfeti.newton.frozen_setup import FrozenSetup
from fenics_tfeti.newton.iteration import NewtonIteration
from fenics_tfeti.newton.load_case import LoadCase, NewtonState
from fenics_tfeti.parallel import any_rank, largest_of_ranks
from fenics_tfeti.sensitivities.adjoint import Derivatives, Functional
from fenics_tfeti.sensitivities.contact_derivative import (
    ContactDerivative,
    HeldRows,
    Solve,
    SurfaceMatrices,
)
from fenics_tfeti.sensitivities.forms import FormsAtSolution
from fenics_tfeti.sensitivities.state import (
    DifferentiatedState,
    SolvedState,
    rows_of_contact,
)
from fenics_tfeti.sensitivities.tangent import Change
from fenics_tfeti.typing import Numbers, Vector

# accuracy of the linear solves that precondition GMRES
_INNER = 1e-3


@dataclass(frozen=True)
class DeformedState(DifferentiatedState):
    """A state of deformed surfaces with its derivative."""

    derivative: ContactDerivative
    rows_with: Callable[[ContactSet], DeformedRows]  # of other conditions of undeformed surfaces

    @staticmethod
    def with_finite_strains(
        load_case: LoadCase,
        state: NewtonState,
        iteration: NewtonIteration,
        forms: FormsAtSolution,
        is_current: Callable[[], bool],
    ) -> DeformedState:
        """Return the last state of Newton's method. Collective."""
        torn, contact_set = load_case.torn, state.rows.contact_set
        check_no_bodies(contact_set)
        face, set_up = iteration.linearised(state)
        held, unit = HeldRows(state.rows, state.multipliers), load_case.slip_stiffness
        still = np.zeros_like(state.displacement)

        def rows_at(change: Vector, undeformed: ContactSet | None = None) -> DeformedRows:
            u = state.displacement.copy()
            u[: change.size] += change
            return load_case.rows_at(u, state.bodies, state.rows, undeformed)

        derivative = ContactDerivative(
            torn,
            torn.tangents(contact_set),
            held,
            SurfaceMatrices.of(held, rows_at, unit),
            _on_face(load_case, face, set_up),
            unit,
        )
        return DeformedState(torn, forms, is_current, derivative, partial(rows_at, still))

    @staticmethod
    def with_exact_gaps(last: SolvedState, end: ContactSet) -> DeformedState:
        """Return the state where passes over the geometry have ended, with these surfaces.

        Collective.
        """
        check_no_bodies(end)
        torn, u, origin = last.torn, last.forms.u, last.origin
        values, bodies = owned_values(u), end.bodies
        before, rows = (DeformedRows.of(found, u, origin) for found in (last.contact_set, end))
        held = HeldRows(rows, Multipliers.of(before, last.solution))

        def rows_at(change: Vector, undeformed: ContactSet | None = None) -> DeformedRows:
            uh = fill_owned(Function(torn.space), values + change)
            found = (undeformed or end).deformed(uh, bodies, end)[0].with_friction(uh)
            return DeformedRows.of(found, uh, origin)

        largest = [s.stiffness.diagonal().max(initial=0.0) for s in torn.torn.subdomains]
        unit = largest_of_ranks(torn.nodes.comm, np.array(largest))
        derivative = ContactDerivative(
            torn,
            torn.torn.subdomains,
            held,
            SurfaceMatrices.of(held, rows_at, unit),
            _of_last_pass(torn, last.linear, before, rows),
            unit,
        )
        rows_with = partial(rows_at, np.zeros_like(values))
        return DeformedState(torn, last.forms, last.is_current, derivative, rows_with)

    @property
    def contact_set(self) -> ContactSet:
        """The conditions of contacts and ties."""
        return self.derivative.state.rows.contact_set

    @property
    def friction(self) -> Friction:
        """Friction at its sites."""
        return self.derivative.state.rows.friction

    @property
    def normal_force(self) -> Vector:
        """The normal forces (rows,) [N]."""
        state = self.derivative.state
        return state.rows.normal_forces(state.multipliers)


def is_as_solved(load_case: LoadCase, state: NewtonState) -> bool:
    """Tell whether forms and obstacles are as they were at a state, which u has. Collective."""
    rows = load_case.rows_at(state.displacement, state.bodies, state.rows)
    pairs = (
        (-load_case.torn.torn.load(), state.internal),
        (rows.contacts.gap, state.rows.contacts.gap),
    )
    differs = any(not np.array_equal(*pair) for pair in pairs)
    return not any_rank(load_case.torn.nodes.comm, [differs])


def check_no_bodies(contact_set: ContactSet) -> None:
    """Check that nothing but the nodes of the mesh moves."""
    if names := contact_set.added_names:
        raise InputError(
            "derivatives with deformed surfaces are those of deformable bodies: "
            f"{names[0]} has motions of its own, which they leave out"
        )


def _on_face(load_case: LoadCase, face: Face, set_up: FrozenSetup) -> Solve:
    """Return the linear problem of a set-up with the same conditions as a face."""
    torn, sticks, free = load_case.torn, face.sticks, face.free
    beyond = np.zeros_like(face.rows.force(face.multipliers)[1])

    def solve(load: Vector, jumps: RowValues) -> tuple[Vector, RowValues, int]:
        loads = torn.spread(set_up.used, load.reshape(-1, torn.nodes.components), beyond)
        none = RowValues.zeros(set_up.linear.system)
        normal = np.append(jumps.normal, jumps.tangential[sticks].ravel())
        of_face = RowValues(normal, jumps.tangential[free], jumps.tied)
        found = set_up.linear.approximate(LinearData(loads, of_face, none), _INNER)
        forces = face.forces_of(set_up.face.changes_of(found.forces))
        tangential = np.zeros_like(jumps.tangential)
        normal, of_sticking = np.split(forces.normal, [jumps.normal.size])
        tangential[free] = forces.tangential
        tangential[sticks] = of_sticking.reshape(-1, tangential.shape[1])
        d = torn.at_owned_nodes(found.displacements)
        return d, RowValues(normal, tangential, forces.tied), found.products

    return solve


def _of_last_pass(
    torn: TornProblem, linear: LinearProblem, before: DeformedRows, rows: DeformedRows
) -> Solve:
    """Return the linear problem of the rows with which a pass began, by rows where it ended."""
    nodes = torn.nodes
    normal = _correspondence(before.place, rows.place)
    sites = _correspondence(*(r.place[r.friction.row] for r in (before, rows)))

    def solve(load: Vector, jumps: RowValues) -> tuple[Vector, RowValues, int]:
        beyond = np.zeros((0, nodes.components))
        shape = load.reshape(-1, nodes.components)
        loads = torn.spread(linear.system.subdomains, shape, beyond)
        none = RowValues.zeros(linear.system)
        of_pass = RowValues(normal.T @ jumps.normal, sites.T @ jumps.tangential, jumps.tied)
        found = linear.approximate(LinearData(loads, of_pass, none), _INNER)
        forces = found.forces
        there = RowValues(normal @ forces.normal, sites @ forces.tangential, forces.tied)
        return torn.at_owned_nodes(found.displacements), there, found.products

    return solve


def _correspondence(before: Numbers, after: Numbers) -> sp.csr_matrix:
    """Return the matrix (after, before) of ones where places, each once, are the same."""
    _, at_before, at_after = np.intersect1d(before, after, return_indices=True)
    ones = np.ones(at_before.size)
    return sp.csr_matrix((ones, (at_after, at_before)), (after.size, before.size))


class DeformedTangent:
    """Change along a change of the data, on deformed surfaces; `tangent` of problems makes it.

    Attributes
    ----------
    u : Function
        Change of the displacement [m].
    products : int
        Applications of F.
    """

    def __init__(self, state: DeformedState, change: Change, rtol: float) -> None:
        derivative = state.derivative
        held, friction = derivative.state, state.friction
        sticking = np.zeros(friction.tangents.shape[:2]).ravel()
        gap = np.where(held.held, change.gap, 0.0)
        load = change.forces - derivative.forces_of_bounds(change.bound)
        right = np.concatenate([load, gap, sticking, np.zeros(held.rows.tied.size)])
        lift = np.concatenate([change.prescribed, np.zeros(derivative.rows)])
        x, self.products = derivative.solved(right - derivative.times(lift), rtol)
        d, p = derivative.split(x + lift)
        self.u = fill_owned(Function(state.torn.space, name="du"), d)
        self._contact_set = state.contact_set
        self._normal = derivative.as_row_values(p).normal + derivative.normal_forces_by(d)

    def nodal_normal_force(self, name: str | int) -> Vector:
        """Return the changes (k,) of the normal forces at the nodes of ``results[name]`` [N]."""
        return self._normal[rows_of_contact(self._contact_set, name)]


class DeformedAdjoint(Derivatives):
    """The adjoint of a functional, on deformed surfaces; `adjoint` of problems makes it.

    Attributes
    ----------
    z : Function
        As of `Derivatives`.
    products : int
        Applications of F.
    """

    _state: DeformedState

    def __init__(self, state: DeformedState, functional: Functional, rtol: float) -> None:
        derivative = state.derivative
        self._state, self._functional = state, functional
        self._right = derivative.functional(functional)
        self._x, self.products = derivative.solved(self._right, rtol, transposed=True)
        z, a = derivative.split(self._x)
        self._z, self._forces = z, derivative.as_row_values(a)
        self.z = fill_owned(Function(state.torn.space, name="z"), z)

    def _reactions(self) -> Vector:
        derivative = self._state.derivative
        return derivative.split(self._right - derivative.times(self._x, transposed=True))[0]

    def _by_bounds(self) -> Vector:
        return self._state.derivative.by_bounds(self._z, self._functional)

    def _of_rows(self, found: ContactSet) -> Vector:
        state = self._state
        state.check_kinds(found)
        return state.derivative.of_rows(state.rows_with(found), self._x, self._functional)

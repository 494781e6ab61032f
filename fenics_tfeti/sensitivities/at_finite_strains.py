"""Changes of a solution with finite strains along data, and adjoints of functionals of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dolfinx.fem import Constant, Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.contact_set import ContactSet
from fenics_tfeti.fem.displacement import fill_owned
from fenics_tfeti.feti.solution.linear import LinearData
from fenics_tfeti.feti.system import RowValues
from fenics_tfeti.newton.face import Face
from fenics_tfeti.newton.frozen_setup import FrozenSetup
from fenics_tfeti.newton.iteration import NewtonIteration
from fenics_tfeti.newton.load_case import LoadCase, NewtonState
from fenics_tfeti.parallel import any_rank, raise_collectively
from fenics_tfeti.sensitivities.adjoint import Functional
from fenics_tfeti.sensitivities.contact_derivative import (
    ContactDerivative,
    HeldRows,
    Solve,
    SurfaceMatrices,
)
from fenics_tfeti.sensitivities.forms import FormsAtSolution, check_parameter
from fenics_tfeti.sensitivities.state import rows_of_contact
from fenics_tfeti.sensitivities.supports import derivative_by, prescribed_changes
from fenics_tfeti.typing import Vector

# accuracy of the linear solves that precondition GMRES
_INNER = 1e-3


@dataclass(frozen=True)
class LastState:
    """The last state of Newton's method as its derivatives see it."""

    load_case: LoadCase
    state: NewtonState
    derivative: ContactDerivative
    is_last: Callable[[], bool]  # whether the problem was not solved since

    @staticmethod
    def of(
        load_case: LoadCase,
        state: NewtonState,
        iteration: NewtonIteration,
        is_last: Callable[[], bool],
    ) -> LastState:
        """Return it with its derivative. Collective."""
        torn, contact_set = load_case.torn, state.rows.contact_set
        check_no_bodies(contact_set)
        face, set_up = iteration.linearised(state)
        held, unit = HeldRows(state.rows, state.multipliers), load_case.slip_stiffness

        def rows_at(change: Vector) -> Any:
            return load_case.rows_at(state.displacement + change, state.bodies, state.rows)

        surfaces = SurfaceMatrices.of(held, rows_at, unit)
        solve = _preconditioner(load_case, face, set_up)
        subdomains = torn.tangents(contact_set)
        derivative = ContactDerivative(torn, subdomains, held, surfaces, solve, unit)
        return LastState(load_case, state, derivative, is_last)

    @property
    def contact_set(self) -> ContactSet:
        """The conditions of contacts and ties."""
        return self.state.rows.contact_set

    @property
    def supports(self) -> tuple[list[Any], Any]:
        """The Dirichlet conditions, and what they prescribe."""
        return self.load_case.torn.bcs, self.contact_set.prescribed

    def check_current(self) -> None:
        """Check that the problem is as it was solved. Collective."""
        check_as_solved(self.load_case, self.state, self.is_last())


def check_as_solved(load_case: LoadCase, state: NewtonState, is_last: bool = True) -> None:
    """Check that forms and obstacles are as they were at a state, which u has. Collective."""
    rows = load_case.rows_at(state.displacement, state.bodies, state.rows)
    pairs = (
        (-load_case.torn.torn.load(), state.internal),
        (rows.contacts.gap, state.rows.contacts.gap),
    )
    differs = any(not np.array_equal(*pair) for pair in pairs)
    if any_rank(load_case.torn.nodes.comm, [differs or not is_last]):
        raise InputError(
            "data, supports or contacts have changed since the last solve; call solve() first"
        )


def _preconditioner(load_case: LoadCase, face: Face, set_up: FrozenSetup) -> Solve:
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


class TangentAtFiniteStrains:
    """Change along a change of the data; `NonlinearContactProblem.tangent` makes it.

    Attributes
    ----------
    u : Function
        Change of the displacement [m].
    products : int
        Applications of F.
    """

    def __init__(
        self, forms: FormsAtSolution, last: LastState, data: Mapping[Any, Any], rtol: float
    ) -> None:
        torn, derivative = last.load_case.torn, last.derivative
        with raise_collectively(torn.nodes.comm):
            for m in data:
                check_parameter(m)
        lifted, in_forms = prescribed_changes(forms, *last.supports, data)
        none = np.zeros(derivative.rows)
        load = np.concatenate([forms.change(in_forms), none])
        lift = np.concatenate([lifted, none])
        x, self.products = derivative.solved(load - derivative.times(lift), rtol)
        d, p = derivative.split(x + lift)
        self.u = fill_owned(Function(torn.space, name="du"), d)
        self._contact_set = last.contact_set
        self._normal = derivative.as_row_values(p).normal + derivative.normal_forces_by(d)

    def nodal_normal_force(self, name: str | int) -> Vector:
        """Return the changes (k,) of the normal forces at the nodes of ``results[name]`` [N]."""
        return self._normal[rows_of_contact(self._contact_set, name)]


class AdjointAtFiniteStrains:
    """The adjoint of a functional; `NonlinearContactProblem.adjoint` makes it.

    Attributes
    ----------
    z : Function
        The adjoint displacement: the derivative of J by nodal forces.
    products : int
        Applications of F.
    """

    def __init__(
        self, forms: FormsAtSolution, last: LastState, functional: Functional, rtol: float
    ) -> None:
        derivative = last.derivative
        self._forms, self._last = forms, last
        self._by_displacements = derivative.functional(functional)
        x, self.products = derivative.solved(self._by_displacements, rtol, transposed=True)
        self._x = x
        z, a = derivative.split(x)
        self.z = fill_owned(Function(last.load_case.torn.space, name="z"), z)
        self._forces = derivative.as_row_values(a)

    def by(self, m: Function | Constant) -> Vector:
        """Return the derivative of J by a Function or Constant of F, supports or J. Collective.

        As `Adjoint.by`.
        """
        self._last.check_current()
        return derivative_by(m, self._forms, self.z, self._last.supports, self.by_supports)

    def by_supports(self) -> Vector:
        """Return the derivatives (n,) of J by all prescribed displacements. Collective.

        They are at the degrees of freedom that this rank owns, and rounding at free ones.
        """
        derivative = self._last.derivative
        left = self._by_displacements - derivative.times(self._x, transposed=True)
        return derivative.split(left)[0]

    def by_gap(self, name: str | int) -> Vector:
        """Return the derivatives (k,) of J by gaps at the nodes of ``results[name]``. Collective.

        Gaps are along the normals, positive where open.
        """
        self._last.check_current()
        return self._forces.normal[rows_of_contact(self._last.contact_set, name)]


def check_no_bodies(contact_set: ContactSet) -> None:
    """Check that nothing but the nodes of the mesh moves."""
    if names := contact_set.added_names:
        raise InputError(
            f"derivatives with finite strains are those of deformable bodies: {names[0]} has "
            "motions of its own, which they leave out"
        )

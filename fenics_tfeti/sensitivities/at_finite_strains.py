"""The change of a solution with finite strains along a change of the data.

With the tangent K of the bodies, the rows B that press, the forces P there and what contact adds to
the derivative (see `ContactHessian`),

    K d + E d + B'dP = dF,    B d + E_g d = 0,

by GMRES with the last set-up of Newton's method as the preconditioner. What is prescribed of d is
on the right-hand side.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.contact_set import ContactSet
from fenics_tfeti.fem.displacement import fill_owned
from fenics_tfeti.newton.contact_hessian import Spent
from fenics_tfeti.newton.equilibrium import Multipliers
from fenics_tfeti.newton.iteration import NewtonIteration
from fenics_tfeti.newton.load_case import LoadCase, NewtonState
from fenics_tfeti.parallel import any_rank, largest_of_ranks, raise_collectively
from fenics_tfeti.sensitivities.forms import FormsAtSolution, check_parameter
from fenics_tfeti.sensitivities.state import rows_of_contact
from fenics_tfeti.sensitivities.supports import prescribed_changes
from fenics_tfeti.typing import Vector

# of displacements by which areas are differenced, relative to the size of the mesh
_DIFFERENCE = 1e-6


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
        self,
        forms: FormsAtSolution,
        load_case: LoadCase,
        iteration: NewtonIteration,
        state: NewtonState,
        data: Mapping[Any, Any],
        rtol: float,
    ) -> None:
        torn, contact_set = load_case.torn, state.rows.contact_set
        with raise_collectively(torn.nodes.comm):
            for m in data:
                check_parameter(m)
            check_no_bodies(contact_set)
        check_as_solved(load_case, state)
        lifted, in_forms = prescribed_changes(forms, torn.bcs, contact_set.prescribed, data)
        face, set_up = iteration.linearised(state)
        spent = Spent()
        hessian = set_up.hessian(load_case, state, face, spent)
        force = forms.change(in_forms).reshape(state.internal.shape)
        none = np.zeros(face.contacts.size), np.zeros(face.rows.tied.size)
        beyond = np.zeros_like(face.rows.force(face.multipliers)[1])
        u = fill_owned(Function(torn.space), lifted)
        change = hessian.response(
            load_case.at_free(force, face.rows), *none, beyond, prescribed=u, rtol=rtol
        )
        d = lifted + torn.at_owned_nodes(change.displacements).ravel()
        self.u = fill_owned(Function(torn.space, name="du"), d)
        self.products, self._contact_set = spent.products, contact_set
        changes = set_up.face.changes_of(change.forces)
        self._normal = _normal_forces_along(load_case, state, d, changes)

    def nodal_normal_force(self, name: str | int) -> Vector:
        """Return the changes (k,) of the normal forces at the nodes of ``results[name]`` [N]."""
        return self._normal[rows_of_contact(self._contact_set, name)]


def _normal_forces_along(
    load_case: LoadCase, state: NewtonState, d: Vector, changes: Multipliers
) -> Vector:
    """Return the changes of normal forces [N], multipliers times areas that change. Collective."""
    ends, increment = [], np.zeros_like(state.displacement)
    increment[: d.size] = d
    largest = largest_of_ranks(load_case.torn.nodes.comm, np.abs(d)) or 1.0
    for eps in np.array([_DIFFERENCE, -_DIFFERENCE]) * load_case.rounding.extent / largest:
        rows = load_case.rows_at(state.displacement + eps * increment, state.bodies, state.rows)
        normal = state.multipliers.normal + eps * changes.normal
        at_nodes = np.zeros_like(normal)
        at_nodes[rows.place] = rows.normal_forces(replace(state.multipliers, normal=normal))
        ends.append(at_nodes[state.rows.place])
    return (ends[0] - ends[1]) / (2.0 * abs(eps))


def check_no_bodies(contact_set: ContactSet) -> None:
    """Check that nothing but the nodes of the mesh moves."""
    if names := contact_set.added_names:
        raise InputError(
            f"tangents with finite strains are those of deformable bodies: {names[0]} has motions "
            "of its own, which they leave out"
        )


def check_as_solved(load_case: LoadCase, state: NewtonState) -> None:
    """Check that forms and obstacles are as they were at a state, which u has. Collective."""
    rows = load_case.rows_at(state.displacement, state.bodies, state.rows)
    pairs = (
        (-load_case.torn.torn.load(), state.internal),
        (rows.contacts.gap, state.rows.contacts.gap),
    )
    if any_rank(load_case.torn.nodes.comm, [not np.array_equal(*pair) for pair in pairs]):
        raise InputError(
            "data, supports or contacts have changed since the last solve; call solve() first"
        )

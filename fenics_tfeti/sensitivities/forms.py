"""Derivatives of forms by coefficients, constants and nodes, at a solution and its adjoint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

import ufl
from dolfinx.fem import Constant, Function, FunctionSpace
from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.displacement import owned_values
from fenics_tfeti.typing import Vector

CHANGED = "data, supports or contacts have changed since the last solve; call solve() first"


@dataclass(frozen=True)
class FormsAtSolution:
    """The forms a(u, v) and L(v) of a problem, and a functional J(u) if there is one.

    Without a, L is all of the residual, with u in it.
    """

    a: ufl.Form | None
    L: ufl.Form
    J: ufl.Form | Function | None  # or its derivative by the values of u
    u: Function

    def work(self, z: Function) -> ufl.Form:
        """Return z'(f - K u) + J: what J changes by with the data of the forms."""
        work = self._residual(z)
        return work + self.J if isinstance(self.J, ufl.Form) else work

    def depend_on(self, m: Function | Constant) -> bool:
        """Tell whether a Function or a Constant stands in the forms or in J."""
        forms = [form for form in (self.a, self.L, self.J) if isinstance(form, ufl.Form)]
        return any(m is c for form in forms for c in (*form.coefficients(), *form.constants()))

    def derivative_of_J(self) -> Vector:
        """Return dJ/du at the degrees of freedom that this rank owns. Collective."""
        space = self.u.function_space
        if self.J is None:
            return np.zeros_like(owned_values(self.u))
        if isinstance(self.J, Function):
            return owned_values(self.J)
        test = ufl.TestFunction(space)
        return _compat.assembled(ufl.derivative(self.J, self.u, test), space)

    def internal_forces(self, z: Function) -> Vector:
        """Return K z at the degrees of freedom that this rank owns. Collective."""
        assert self.a is not None
        return _compat.assembled(
            ufl.replace(self.a, {self.a.arguments()[1]: z}), self.u.function_space
        )

    def change(self, changes: list[tuple[Function | Constant, Any]]) -> Vector:
        """Return df - dK u for changes of Functions and Constants, (n,) owned. Collective."""
        space = self.u.function_space
        v = ufl.TestFunction(space)
        total = np.zeros_like(owned_values(self.u))
        for m, dm in changes:
            total += _compat.assembled(_along(self._residual(v), m, dm, space.mesh), space)
        return total

    def _residual(self, v: Any) -> ufl.Form:
        """Return L(v) - a(u, v)."""
        load = ufl.replace(self.L, {self.L.arguments()[0]: v})
        if self.a is None:
            return load
        test, trial = self.a.arguments()
        return load - ufl.replace(self.a, {test: v, trial: self.u})


def by_function(work: ufl.Form, m: Function) -> Vector:
    """Return the derivative by the values of a Function that this rank owns. Collective."""
    test = ufl.TestFunction(m.function_space)
    return _compat.assembled(ufl.derivative(work, m, test), m.function_space)


def by_constant(work: ufl.Form, m: Constant, domain: Mesh) -> Vector:
    """Return the derivative by the values of a Constant, in its shape, on all ranks. Collective."""
    w, value = _constant_function(m, m.value, domain)
    derivative = by_function(ufl.replace(work, {m: value}), w)
    k = max(1, int(np.prod(m.ufl_shape, dtype=int)))
    sums = domain.comm.allreduce(derivative.reshape(-1, k).sum(axis=0))
    return np.asarray(sums).reshape(m.ufl_shape)


def by_places(work: ufl.Form, domain: Mesh) -> Vector:
    """Return the derivative by the places of nodes, on the space of `node_changes`. Collective.

    Functions move with the nodes.
    """
    space = places_space(domain)
    form = ufl.derivative(work, ufl.SpatialCoordinate(domain), ufl.TestFunction(space))
    return _compat.assembled(form, space)


def places_space(domain: Mesh) -> FunctionSpace:
    """Return the space of vectors at the mesh's nodes."""
    return _compat.lagrange_space(domain, _compat.geometry_degree(domain), domain.geometry.dim)


def node_changes(direction: Any, domain: Mesh) -> Vector:
    """Return the displacement (nodes, 3) of the mesh's nodes by a Function."""
    degree, gdim = _compat.geometry_degree(domain), domain.geometry.dim
    expected = f"vectors of Lagrange elements of degree {degree}, that of the mesh's cells"
    if not isinstance(direction, Function):
        raise InputError(
            f"direction is a {type(direction).__name__}; expected a Function of {expected}"
        )
    space = direction.function_space
    if space.mesh is not domain or _compat.element_facts(space) != ("Lagrange", degree, (gdim,)):
        raise InputError(f"direction is a Function on another mesh or space; expected {expected}")
    moves = np.zeros_like(domain.geometry.x)
    values = direction.x.array.reshape(-1, gdim)
    moves[_compat.geometry_cells(domain), :gdim] = values[_compat.cell_dofs(space)]
    return moves


def _along(form: ufl.Form, m: Function | Constant, dm: Any, domain: Mesh) -> ufl.Form:
    """Return the derivative of a form by a Function or Constant along a change of its values."""
    if isinstance(m, Function):
        change = Function(m.function_space)
        change.x.array[:] = dm.x.array if isinstance(dm, Function) else dm
        return ufl.derivative(form, m, change)
    w, value = _constant_function(m, m.value, domain)
    change = _constant_function(m, dm, domain)[0]
    return ufl.derivative(ufl.replace(form, {m: value}), w, change)


def _constant_function(m: Constant, values: Any, domain: Mesh) -> tuple[Function, Any]:
    """Return a Function of degree 0 with values of a Constant, and it in the Constant's shape.

    UFL has no derivative by a constant.
    """
    shape = m.ufl_shape
    k = int(np.prod(shape, dtype=int)) if shape else 0
    w = Function(_compat.lagrange_space(domain, 0, k, discontinuous=True))
    values = np.broadcast_to(np.asarray(values, dtype=float), shape).ravel()
    w.x.array[:] = np.tile(values, w.x.array.size // max(k, 1))
    if len(shape) <= 1:
        return w, w
    entries = np.array([w[i] for i in range(k)], dtype=object).reshape(shape)
    return w, ufl.as_tensor(entries.tolist())


def check_parameter(m: Any) -> None:
    """Check that a parameter is a Function or a Constant."""
    if not isinstance(m, Function | Constant):
        raise InputError(
            f"the parameter is a {type(m).__name__}; a Function or a Constant of dolfinx is "
            "expected. Gaps, slip bounds, coefficients of friction and obstacles have methods of "
            "their own"
        )


def check_dependence(m: Function | Constant, depends: bool) -> None:
    """Check that something depends on a parameter."""
    if not depends:
        name = f"'{m.name}'" if isinstance(m, Function) else "the Constant"
        raise InputError(
            f"{name} stands in no form, in no Dirichlet condition and not in J: nothing depends on "
            "it. Gaps, slip bounds, coefficients of friction and obstacles have methods of their "
            "own"
        )


def check_functional(J: Any, u: Function) -> None:
    """Check that J is a form of rank 0 that depends on the displacement u, or on its space."""
    if J is None:
        return
    if isinstance(J, Function):
        if J.function_space != u.function_space:
            raise InputError("J is a Function on another space than that of the displacement")
        return
    if not isinstance(J, ufl.Form) or J.arguments():
        kind = f"a form of rank {len(J.arguments())}" if isinstance(J, ufl.Form) else repr(J)
        raise InputError(f"J is {kind}; a form of rank 0, a number, is expected")
    if not any(c is u for c in J.coefficients()):
        raise InputError(
            "J does not depend on the displacement: write it with problem.u, the Function that "
            "solve() fills and returns"
        )

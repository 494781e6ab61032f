"""Arguments of `ContactProblem` as users give them: forms and lists; what is meant, or an error.

They are the same on all ranks, and so are the errors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

import ufl
from dolfinx.fem import Constant, Function, FunctionSpace

from fenics_tfeti.errors import InputError, wrong_type
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.descriptions.contacts import (
    Contact,
    ContactPair,
    Deformed,
)
from fenics_tfeti.fem.contact.descriptions.friction import is_elastic
from fenics_tfeti.fem.contact.descriptions.laws import Cohesive, SoftContact, needs_passes
from fenics_tfeti.fem.contact.descriptions.rigid_body import RigidBody
from fenics_tfeti.fem.contact.descriptions.surfaces import contact_name
from fenics_tfeti.fem.contact.descriptions.ties import Tie, TiedPair


def as_forms(a: Any, L: Any) -> tuple[ufl.Form, ufl.Form]:
    """Return the forms; no load, as L = 0, is a form that vanishes."""
    _check_form(a, "the bilinear form a")
    if _is_zero(L):
        return a, _no_load(a)
    _check_form(L, "the linear form L")
    return a, L


def as_residual(F: Any, u: Any, J: Any) -> tuple[ufl.Form, ufl.Form]:
    """Return the tangent and minus the residual; the tangent is by default the derivative."""
    _check_form(F, "the residual F")
    if not isinstance(u, Function):
        raise wrong_type("u", u, "the dolfinx.fem.Function of the residual F")
    if len(F.arguments()) != 1:
        raise InputError(
            f"F has {len(F.arguments())} arguments; a residual has one, its test function: "
            "ufl.derivative(energy, u, ufl.TestFunction(V))"
        )
    if u not in F.coefficients():
        raise InputError(
            "F does not depend on u: write the residual with the Function u, not with a trial "
            "function"
        )
    if F.arguments()[0].ufl_function_space() != u.function_space:
        raise InputError("u is not on the function space of the test function of F; use one space")
    if J is None:
        J = ufl.derivative(F, u, ufl.TrialFunction(u.function_space))
    _check_form(J, "the tangent J")
    return J, -F


def as_displacement(u: Any, space: FunctionSpace) -> Function:
    """Return the function that solves fill, by default a new one."""
    if u is None:
        return Function(space, name="displacement")
    if not isinstance(u, Function):
        raise wrong_type("u", u, "a dolfinx.fem.Function on the space of the forms")
    if u.function_space != space:
        raise InputError("u is not on the function space of the forms; make it by Function(V)")
    return u


def as_conditions(bcs: Any) -> list[Any]:
    """Return the Dirichlet conditions as a list: none for None, one for a single condition."""
    names = ("bcs", "Dirichlet conditions", "Dirichlet condition")
    return _listed(bcs, _is_condition, names, "a condition as returned by dolfinx.fem.dirichletbc")


def as_gaps(gaps: Any) -> Deformed | None:
    """Return on which surfaces gaps are measured; None for the undeformed ones."""
    if gaps is None or isinstance(gaps, Deformed):
        return gaps
    raise InputError(
        f"gaps is {gaps!r}; Deformed() is expected, or None for the undeformed surfaces"
    )


def as_rigid_bodies(rigid_bodies: Any) -> dict[int, RigidBody]:
    """Return the rigid bodies by the tags of their cells: none for None."""
    if rigid_bodies is None:
        return {}
    if not isinstance(rigid_bodies, Mapping):
        raise wrong_type("rigid_bodies", rigid_bodies, "a dict of RigidBody by tags of cells")
    for tag, body in rigid_bodies.items():
        if isinstance(tag, bool) or not isinstance(tag, int | np.integer):
            raise InputError(f"rigid_bodies: {tag!r} is no tag of cells; an integer is expected")
        if not isinstance(body, RigidBody):
            raise wrong_type(f"rigid_bodies: the body with tag {tag}", body, "a RigidBody")
    return {int(tag): body for tag, body in rigid_bodies.items()}


def as_contacts(contacts: Any, exact: str = "", may_be_soft: bool = False) -> list[Contact | Tie]:
    """Return the contacts and ties as a list: none for None, one for a single one.

    `exact` names for messages what measures gaps on the deformed mesh, if anything does; contact
    may be soft there, or not.
    """
    kinds = (
        "ContactPair, RigidObstacle, SelfContact, TiedPair, PeriodicPair, BoltPreload or LinearRows"
    )
    if isinstance(contacts, str):
        raise InputError(
            f"contacts is {contacts!r}; a list of {kinds} is expected, or 'auto' where the "
            "problem is made (later: find_contacts)"
        )
    names = ("contacts", kinds, "contact")
    listed = _listed(contacts, lambda thing: isinstance(thing, Contact | Tie), names, kinds)
    _check_kinds_of_passes(listed)
    for number, contact in enumerate(listed if exact else []):
        _check_hard(contact, contact_name(contact, number), exact, may_be_soft)
        if isinstance(contact, ContactPair) and contact.initial_gap != "geometric":
            raise InputError(
                f"{contact_name(contact, number)}: initial_gap={contact.initial_gap!r} replaces "
                f"the gap of the mesh, but {exact} measures gaps on the deformed mesh. "
                "Leave out one of them"
            )
    return listed


def _check_kinds_of_passes(listed: Sequence[Contact | Tie]) -> None:
    """Check that laws that need several solves are of one kind."""
    first = ""
    for number, contact in enumerate(listed):
        law = getattr(contact, "law", None)
        if not needs_passes(law):
            continue
        kind = type(law).__name__
        if first and kind != first:
            raise InputError(
                f"{contact_name(contact, number)}: {first} and {kind} need solves of their own: "
                "not both in one problem. Take SoftContact in place of RoughContact, Adhesive "
                "without an energy, or the same kind of bond for both"
            )
        first = kind


def _check_hard(contact: Any, name: str, exact: str, may_be_soft: bool) -> None:
    """Check that a contact has no law that is for undeformed surfaces alone."""
    law = getattr(contact, "law", None)
    may_be = may_be_soft and not isinstance(contact, TiedPair)
    if isinstance(law, Cohesive):
        may_be &= getattr(contact, "rigid_body", None) is None
    if law is not None and not (may_be and isinstance(law, SoftContact | Cohesive)):
        raise InputError(
            f"{name}: law={contact.law!r} is for small strains on undeformed surfaces, but {exact} "
            "moves them. Leave out one of them"
        )
    if is_elastic(getattr(contact, "friction", None)):
        raise InputError(
            f"{name}: elastic_slip is for small strains on undeformed surfaces, but {exact} moves "
            "them. Leave out one of them"
        )


def check_hard_or_soft(contacts: Sequence[Contact | Tie], what: str) -> None:
    """Check that no contact has another law or elastic slip, as not everything is for these."""
    for number, contact in enumerate(contacts):
        friction, law = (getattr(contact, data, None) for data in ("friction", "law"))
        if not isinstance(law, SoftContact | None) or is_elastic(friction):
            raise InputError(
                f"{contact_name(contact, number)}: {what} of hard or soft contact without "
                "elastic slip alone. Leave out law and elastic_slip"
            )


def _is_condition(thing: Any) -> bool:
    return hasattr(thing, "function_space") and hasattr(_compat.cpp_object(thing), "dof_indices")


def _listed(
    value: Any, is_item: Callable[[Any], bool], names: tuple[str, str, str], expected: str
) -> list[Any]:
    """Return items as a list and check each; names of the argument, of items and of one item."""
    argument, items, item = names
    if value is None:
        return []
    if is_item(value):
        return [value]
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise wrong_type(argument, value, f"a list of {items}")
    listed = list(value)
    for number, thing in enumerate(listed):
        if not is_item(thing):
            raise wrong_type(f"{item} {number}", thing, expected)
    return listed


def _check_form(form: Any, what: str) -> None:
    if isinstance(form, ufl.Form):
        return
    if hasattr(_compat.cpp_object(form), "function_spaces"):
        raise InputError(
            f"{what} is compiled: pass the form of UFL itself, without dolfinx.fem.form, since it "
            "is assembled on the subdomains"
        )
    raise InputError(
        f"{what} is a {type(form).__name__}; a form of UFL is expected, such as "
        "ufl.inner(f, v) * ufl.dx"
    )


def _is_zero(L: Any) -> bool:
    """Tell whether a load vanishes: 0, a form without integrals, or the zero form of new UFL."""
    if isinstance(L, int | float | np.number):
        return bool(L == 0)
    zero = getattr(ufl, "ZeroBaseForm", None)
    if zero is not None and isinstance(L, zero):
        return True
    return isinstance(L, ufl.Form) and L.empty()


def _no_load(a: ufl.Form) -> ufl.Form:
    """Return a linear form that vanishes, on the test function of a."""
    if len(a.arguments()) != 2:
        return ufl.Form([])
    v = a.arguments()[0]
    mesh = v.ufl_function_space().mesh
    return ufl.inner(Constant(mesh, np.zeros(v.ufl_shape)), v) * ufl.dx(domain=mesh)

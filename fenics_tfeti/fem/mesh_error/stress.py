"""The stress in a state, read off the forms.

The integrand of a(w, v) - L(v) over cells is T : grad v + S . v. The test function v = e_i gives
S_i, and v = x_j e_i gives T_ij + x_j S_i. Weights of the integral, such as 2 pi r, are in T, and
what L has of stresses, such as those of a temperature. In a state with finite strains L alone has
them, the residual of the equilibrium with its sign changed.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import ufl
from dolfinx.fem import Function
from ufl.algorithms import extract_arguments
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives
from ufl.argument import Argument
from ufl.corealg.traversal import unique_pre_traversal
from ufl.differentiation import Grad

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.forms import PreparedForm
from fenics_tfeti.typing import Indices, Mask, Vector


class CellStress:
    """T at points of the reference cell, compiled once; making it is collective."""

    def __init__(self, a: PreparedForm, L: PreparedForm, w: Function, points: Vector) -> None:
        self._domain = w.function_space.mesh
        self._points, self._dim = len(points), self._domain.geometry.dim
        v, u = a.form.arguments()
        of_forms = [
            (a, ufl.replace(a.form, {u: w}), v, 1.0),
            (L, L.form, L.form.arguments()[0], -1.0),
        ]
        self._parts = [
            (form, sign, _tags(integral), _compat.expression_at(T, points, self._domain))
            for form, integrals, v, sign in of_forms
            for integral, T in _stresses(integrals, v)
        ]

    def at(self, cells: Indices) -> Vector:
        """Return T (k, q, d, d) at the points in some of this rank's cells."""
        total = np.zeros((cells.size, self._points, self._dim, self._dim))
        for form, sign, tags, compiled in self._parts:
            values = _compat.evaluate_expression(compiled, self._domain, cells)
            values = sign * values.reshape(total.shape)
            total += values if tags is None else values * _column(form.has_tag("cell", cells, tags))
        # on the axis of rotation the hoop strain is u_r / r, and its factor r
        return total if np.isfinite(total).all() else np.nan_to_num(total)


def _column(mask: Mask) -> Mask:
    return mask[:, None, None, None]


def has_stress(form: ufl.Form) -> bool:
    """Tell whether a linear form has gradients of its test function."""
    (v,) = form.arguments()
    return any(_has_gradient(integral.integrand(), v) for integral in form.integrals())


def _stresses(form: ufl.Form, v: Argument) -> list[tuple[Any, Any]]:
    """Return the integrals over cells that have gradients of v, with the stress in each."""
    dim, x = len(v), ufl.SpatialCoordinate(form.ufl_domain())
    zero = 0 * x[0]

    def tested(integrand: Any, i: int, factor: Any) -> Any:
        """Return the integrand for the test function factor e_i."""
        test = ufl.as_vector([factor if k == i else zero for k in range(dim)])
        return apply_derivatives(apply_algebra_lowering(ufl.replace(integrand, {v: test})))

    stresses = []
    for integral in form.integrals():
        f = integral.integrand()
        if integral.integral_type() != "cell" or not _has_gradient(f, v):
            continue
        S = [tested(f, i, 1 + zero) for i in range(dim)]
        T = [tested(f, i, x[j]) - x[j] * S[i] for i in range(dim) for j in range(dim)]
        stresses.append((integral, ufl.as_vector(T)))
    return stresses


def _has_gradient(integrand: Any, v: Argument) -> bool:
    """Tell whether gradients of v stand in an integrand."""
    lowered = apply_derivatives(apply_algebra_lowering(integrand))
    return any(
        isinstance(e, Grad) and v in extract_arguments(e) for e in unique_pre_traversal(lowered)
    )


def _tags(integral: Any) -> list[int] | None:
    """Return the tags that an integral is limited to, if it is."""
    tags = integral.subdomain_id()
    return None if tags in ("everywhere", "otherwise") else np.atleast_1d(tags).tolist()

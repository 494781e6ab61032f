"""Constants in place of numbers in forms: FFCx compiles forms that differ in numbers only once."""

from __future__ import annotations

from typing import Any

from dolfinx import fem
from dolfinx.mesh import Mesh
from ufl.algorithms.map_integrands import map_integrand_dags
from ufl.classes import FloatValue, Power


def with_constants(form: Any, domain: Mesh) -> Any:
    """Return a form or expression with constants on a mesh in place of its real numbers.

    Exponents stay, by which the quadrature degree is chosen, and integers, as in ``2 * mu``.
    """
    constants: dict[float, fem.Constant] = {}

    def replaced(expression: Any, *operands: Any) -> Any:
        if isinstance(expression, FloatValue):
            value = float(expression)
            return constants.setdefault(value, fem.Constant(domain, value))
        if isinstance(expression, Power):
            operands = operands[0], expression.ufl_operands[1]
        if all(new is old for new, old in zip(operands, expression.ufl_operands, strict=True)):
            return expression
        return expression._ufl_expr_reconstruct_(*operands)

    return map_integrand_dags(replaced, form)

"""The weight of the surface measure, such as 2 pi r in an axisymmetric form."""

from __future__ import annotations

from typing import Any

import numpy as np

from dolfinx.fem import Constant
from dolfinx.mesh import Mesh
from ufl.algorithms import extract_arguments
from ufl.core.expr import Expr
from ufl.corealg.traversal import traverse_unique_terminals
from ufl.domain import extract_domains

from fenics_tfeti.errors import InputError


def as_ufl_weight(domain: Mesh, weight: Any) -> Any:
    """Return the weight of the measure as an expression of UFL, checked; None for none.

    Errors are the same on all ranks.
    """
    if weight is None:
        return None
    if isinstance(weight, int | float | np.number) and not isinstance(weight, bool):
        # a Constant: for each number in the expression, code would be compiled anew
        return Constant(domain, float(weight))
    if not isinstance(weight, Expr):
        raise InputError(
            f"measure_weight is a {type(weight).__name__}; a scalar expression of UFL or a number "
            "is expected, such as 2 * ufl.pi * ufl.SpatialCoordinate(mesh)[0]"
        )
    if weight.ufl_shape or weight.ufl_free_indices:
        raise InputError(
            f"measure_weight has shape {weight.ufl_shape}; a scalar is expected, by which ds is "
            "multiplied in the forms"
        )
    if extract_arguments(weight):
        raise InputError(
            "measure_weight contains a test or trial function; give the factor of ds in the forms "
            "alone"
        )
    mesh_domain = domain.ufl_domain()
    for terminal in traverse_unique_terminals(weight):
        if any(part != mesh_domain for part in extract_domains(terminal)):
            raise InputError("measure_weight is on another mesh than the displacement")
    return weight

"""Laws of friction as users give them, and their values at the nodes of a contact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dolfinx.fem import Function, FunctionSpace

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.surfaces.initial_gap import scalars_at
from fenics_tfeti.fem.messages import raise_where
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import vertex_nodes
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Vector

# or a Function
NodalValue = float | Callable[[Vector], ArrayLike] | Any


@dataclass(frozen=True)
class Tresca:
    """Friction with a given bound: the tangential traction is at most the slip bound.

    It acts at all nodes that may touch, whether they are pressed or not.

    Attributes
    ----------
    slip_bound : float, callable or dolfinx.fem.Function
        Largest tangential traction [Pa]: a number, a function of x (3, n) [m] that returns (n,), or
        values at the nodes: a scalar Function of degree 1 on the mesh. With the `measure_weight` of
        the contact it becomes the largest nodal force.

    Examples
    --------
    >>> Tresca(slip_bound=2e6)
    Tresca(slip_bound=2000000.0)
    """

    slip_bound: NodalValue


@dataclass(frozen=True)
class Coulomb:
    """Coulomb's law: the tangential traction is at most the coefficient times the pressure.

    Attributes
    ----------
    coefficient : float, callable or dolfinx.fem.Function
        Coefficient of friction: a number, a function of x (3, n) [m] that returns (n,), or values
        at the nodes: a scalar Function of degree 1 on the mesh.

    Examples
    --------
    >>> Coulomb(coefficient=0.3)
    Coulomb(coefficient=0.3)
    """

    coefficient: NodalValue


FrictionLaw: TypeAlias = Tresca | Coulomb


def check_friction(law: Any, name: str) -> None:
    """Check a law of friction, as far as its numbers do not depend on the mesh."""
    if law is None:
        return
    if not isinstance(law, FrictionLaw):
        raise InputError(
            f"{name}: friction is a {type(law).__name__}; Tresca(slip_bound), "
            "Coulomb(coefficient) or None is expected"
        )
    label, value = _value(law)
    if callable(value) or isinstance(value, Function):
        return
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not number or not 0.0 <= float(value) < np.inf:
        raise InputError(
            f"{name}: {label} is {value!r}; a finite number, at least 0, a function x (3, n) -> "
            "(n,) or a scalar Function of degree 1 is expected"
        )


def values_at_nodes(
    space: FunctionSpace, law: FrictionLaw, nodes: NDArray[np.int64], points: Vector, name: str
) -> Vector:
    """Return a law's bound or coefficient (k,), at least 0, at nodes of this rank. Collective.

    The law has passed `check_friction`; the nodes (k,) are global ones, at vertices.
    """
    label, value = _value(law)
    label = f"{name}: {label}"
    with raise_collectively(space.mesh.comm):
        if isinstance(value, Function):
            values = _nodal_values(space, value, nodes, label)
        elif callable(value):
            values = scalars_at(value, points, label)
        else:
            values = np.full(nodes.size, float(value))
    raise_where(
        space.mesh.comm,
        ~(np.isfinite(values) & (values >= 0.0)),
        points[:, : space.dofmap.index_map_bs],
        lambda number, place: (
            f"{label} is negative, NaN or infinite at {number} nodes, the first at {place}"
        ),
    )
    return values


def _value(law: FrictionLaw) -> tuple[str, Any]:
    """Return name and value of a law's bound or coefficient."""
    if isinstance(law, Tresca):
        return "slip_bound", law.slip_bound
    return "coefficient", law.coefficient


def _nodal_values(
    space: FunctionSpace, function: Function, nodes: NDArray[np.int64], label: str
) -> Vector:
    source = function.function_space
    if source.mesh is not space.mesh:
        raise InputError(f"{label} is a Function on another mesh than the displacement")
    family, degree, shape = _compat.element_facts(source)
    if (family, degree) != ("Lagrange", 1) or shape:
        raise InputError(
            f"{label} is a Function of {family} elements of degree {degree} and shape {shape}; a "
            "scalar one of Lagrange elements of degree 1 is expected"
        )
    # the two spaces may number their nodes differently
    dofs = np.zeros(int(_compat.cell_dofs(space).max(initial=-1)) + 1, dtype=np.int64)
    dofs[vertex_nodes(space)] = vertex_nodes(source)
    values: Vector = function.x.array[dofs[nodes - NodeMap(space).first]]
    return values

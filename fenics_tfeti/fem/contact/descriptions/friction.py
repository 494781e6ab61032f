"""Laws of friction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

from dolfinx.fem import Function

from fenics_tfeti.errors import check_value, wrong_type
from fenics_tfeti.fem.user_data import ScalarField, is_function, is_number

NodalValue: TypeAlias = ScalarField | Any  # or a Function


@dataclass(frozen=True)
class Tresca:
    """Friction with a given bound: the tangential traction is at most the slip bound.

    It acts at all nodes that may touch, whether they are pressed or not.

    Attributes
    ----------
    slip_bound : float, callable or dolfinx.fem.Function
        Largest tangential traction [Pa]: a number, a function of the undeformed nodes x (3, n) [m]
        of the slave that returns (n,), or values at the nodes: a scalar Function of degree 1 on the
        mesh. Times the area of `ContactResult`, which is that of the deformed surface with
        ``Deformed()`` and finite strains, it becomes the largest nodal force.
    elastic_slip : float, callable or dolfinx.fem.Function
        Slip over tangential traction below the bound [m/Pa], which goes back with the traction: 0
        by default, then the surfaces stick. With small strains on undeformed surfaces only.

    Examples
    --------
    >>> Tresca(slip_bound=2e6).slip_bound
    2000000.0
    """

    slip_bound: NodalValue
    elastic_slip: NodalValue = 0.0

    def __post_init__(self) -> None:
        check_nodal_value(self.slip_bound, "Tresca: the slip_bound")
        check_nodal_value(self.elastic_slip, "Tresca: the elastic_slip")


@dataclass(frozen=True)
class Coulomb:
    """Coulomb's law: the tangential traction is at most the coefficient times the pressure.

    Attributes
    ----------
    coefficient : float, callable or dolfinx.fem.Function
        Coefficient of friction: a number, a function of the undeformed nodes x (3, n) [m] of the
        slave that returns (n,), or values at the nodes: a scalar Function of degree 1 on the mesh.
    elastic_slip : float, callable or dolfinx.fem.Function
        As that of `Tresca`.

    Examples
    --------
    >>> Coulomb(coefficient=0.3).elastic_slip
    0.0
    """

    coefficient: NodalValue
    elastic_slip: NodalValue = 0.0

    def __post_init__(self) -> None:
        check_nodal_value(self.coefficient, "Coulomb: the coefficient")
        check_nodal_value(self.elastic_slip, "Coulomb: the elastic_slip")


FrictionLaw: TypeAlias = Tresca | Coulomb


def is_elastic(law: FrictionLaw | None) -> bool:
    """Tell whether a law of friction has elastic slip."""
    slip = None if law is None else law.elastic_slip
    return slip is not None and not (is_number(slip) and slip == 0.0)


def check_friction(law: Any, label: str) -> None:
    """Check that there is a law of friction, or none."""
    if law is not None and not isinstance(law, FrictionLaw):
        expected = "Tresca(slip_bound), Coulomb(coefficient) or None"
        raise wrong_type(f"{label}: friction", law, expected)


def check_nodal_value(value: Any, label: str, positive: bool = False) -> None:
    """Check a number, at least 0 or positive, a function of x or a Function."""
    interpolated = (
        ", or interpolate it into a scalar Function of degree 1: f = Function(functionspace(mesh, "
        "('Lagrange', 1))), f.interpolate(Expression(...))"
    )
    check_value(
        isinstance(value, Function)
        or is_function(value, label, interpolated)
        or (is_number(value) and (value > 0.0 if positive else value >= 0.0)),
        label,
        value,
        f"a {'positive' if positive else 'finite'} number{'' if positive else ', at least 0'}, a "
        "function x (3, n) -> (n,) or a scalar Function of degree 1",
    )

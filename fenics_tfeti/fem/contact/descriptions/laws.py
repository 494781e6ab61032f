"""Laws of interfaces: what surfaces exert on each other across a gap, beside hard contact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

from fenics_tfeti.errors import wrong_type
from fenics_tfeti.fem.contact.descriptions.friction import NodalValue, check_nodal_value


@dataclass(frozen=True)
class SoftContact:
    """Contact that gives way: the pressure is the stiffness times the penetration.

    It is that of rough surfaces, or of a thin soft layer: of a layer of thickness h that is held
    sideways the stiffness is its modulus of uniaxial strain over h. Surfaces come apart freely.
    Solves take as many products as with hard contact, whatever the stiffness, unless it is much
    less than that of a node.

    Attributes
    ----------
    stiffness : float, callable or dolfinx.fem.Function
        Pressure over penetration [Pa/m]: a positive number, a function of the undeformed nodes x
        (3, n) [m] of the slave that returns (n,), or values at the nodes: a scalar Function of
        degree 1 on the mesh.

    Examples
    --------
    >>> SoftContact(stiffness=1e12)
    SoftContact(stiffness=1000000000000.0)
    """

    stiffness: NodalValue

    def __post_init__(self) -> None:
        check_nodal_value(self.stiffness, "SoftContact: the stiffness", positive=True)


@dataclass(frozen=True)
class Adhesive:
    """Contact that pulls: closed surfaces come apart where they would pull by more.

    The traction is the same on surfaces that have come apart, however far: the energy that it takes
    is the traction times the opening. Coulomb's bound of friction counts the pressure together with
    the traction (Derjaguin).

    Attributes
    ----------
    traction : float, callable or dolfinx.fem.Function
        Largest traction across the surfaces [Pa]: a number, a function of the undeformed nodes x
        (3, n) [m] of the slave that returns (n,), or values at the nodes: a scalar Function of
        degree 1 on the mesh.

    Examples
    --------
    >>> Adhesive(traction=1e5)
    Adhesive(traction=100000.0)
    """

    traction: NodalValue

    def __post_init__(self) -> None:
        check_nodal_value(self.traction, "Adhesive: the traction")


@dataclass(frozen=True)
class ElasticBond:
    """Surfaces that springs hold together: the traction is the stiffness times the opening.

    Closed surfaces press as in hard contact, however soft the springs are. Along the surfaces the
    elastic slip of a law of friction is the same. Where the stiffness is zero there is contact
    alone: a bond that a script weakens between solves, node by node, is one that breaks.

    Attributes
    ----------
    stiffness : float, callable or dolfinx.fem.Function
        Traction over opening [Pa/m]: a number, at least 0, a function of the undeformed nodes x
        (3, n) [m] of the slave that returns (n,), or values at the nodes: a scalar Function of
        degree 1 on the mesh. Openings are gaps: springs are unstrained where the gap is zero.

    Examples
    --------
    >>> ElasticBond(stiffness=1e12)
    ElasticBond(stiffness=1000000000000.0)
    """

    stiffness: NodalValue

    def __post_init__(self) -> None:
        check_nodal_value(self.stiffness, "ElasticBond: the stiffness")


InterfaceLaw: TypeAlias = SoftContact | Adhesive | ElasticBond


def check_law(law: Any, label: str) -> None:
    """Check that there is a law of the interface, or none."""
    if law is not None and not isinstance(law, InterfaceLaw):
        expected = "SoftContact(stiffness), Adhesive(traction), ElasticBond(stiffness) or None"
        raise wrong_type(f"{label}: law", law, expected)

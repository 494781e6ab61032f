"""Laws of interfaces: what surfaces exert on each other across a gap, beside hard contact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

from fenics_tfeti.errors import InputError, check_value, wrong_type
from fenics_tfeti.fem.contact.descriptions.friction import NodalValue, check_nodal_value
from fenics_tfeti.fem.user_data import check_positive, is_number
from fenics_tfeti.typing import Vector


@dataclass(frozen=True)
class SoftContact:
    """Contact that gives way: the pressure is the stiffness times the penetration.

    It is that of rough surfaces, or of a thin soft layer: of a layer of thickness h that is held
    sideways the stiffness is its modulus of uniaxial strain over h. Surfaces come apart freely.
    Solves take as many products as with hard contact, whatever the stiffness, unless it is much
    less than that of a node. At finite strains the penetration and the area are those of the
    deformed surfaces.

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
class RoughContact:
    """Contact whose pressure grows with the approach of the surfaces, as that of rough ones.

    The approach is the penetration: less than zero where surfaces are apart, which may press
    already. Each solve linearises the law anew, until pressures follow it to 1e-6 of the largest
    one; solves renew no factor, coarse problem or preconditioner.

    Attributes
    ----------
    pressure : callable
        Returns pressures (n,) [Pa] at approaches d (n,) [m]. It grows with d, by more and more
        where it is positive, and goes to zero where surfaces are apart.
    stiffness : callable
        Returns the derivatives (n,) of the pressure [Pa/m].

    Examples
    --------
    >>> import numpy as np
    >>> law = RoughContact(lambda d: 1e19 * d.clip(0) ** 2, lambda d: 2e19 * d.clip(0))
    >>> law.pressure(np.array([-1e-6, 2e-6])).tolist()
    [0.0, 40000000.0]
    """

    pressure: Callable[[Vector], Vector]
    stiffness: Callable[[Vector], Vector]

    def __post_init__(self) -> None:
        for name in ("pressure", "stiffness"):
            value = getattr(self, name)
            expected = "a function of approaches d (n,) [m] that returns (n,)"
            check_value(callable(value), f"RoughContact: the {name}", value, expected)


@dataclass(frozen=True)
class Adhesive:
    """Contact that pulls: closed surfaces come apart where they would pull by more.

    The traction is the same on surfaces that have come apart: the energy that it takes is the
    traction times the opening. By default it pulls however far they are. With an energy it ends at
    the opening energy / traction (Dugdale, Maugis), and contact is left: as the damage of
    `Cohesive`, this is that of load steps, which `ContactProblem.advance` accepts, and never heals.
    Coulomb's bound of friction counts the pressure together with the traction (Derjaguin).

    Attributes
    ----------
    traction : float, callable or dolfinx.fem.Function
        Largest traction across the surfaces [Pa]: a number, a function of the undeformed nodes x
        (3, n) [m] of the slave that returns (n,), or values at the nodes: a scalar Function of
        degree 1 on the mesh.
    energy : float, callable or dolfinx.fem.Function, optional
        Energy that it takes to separate an area [J/m^2]; by default it has no limit. Surfaces that
        are farther apart than energy / traction in the first load step do not adhere.

    Examples
    --------
    >>> Adhesive(traction=1e5)
    Adhesive(traction=100000.0, energy=None)
    """

    traction: NodalValue
    energy: NodalValue | None = None

    def __post_init__(self) -> None:
        check_nodal_value(self.traction, "Adhesive: the traction")
        if self.energy is not None:
            check_nodal_value(self.energy, "Adhesive: the energy", positive=True)


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


@dataclass(frozen=True)
class ElasticLayer:
    """A thin elastic layer that joins surfaces: tractions in proportion to the jump.

    It carries pressure, tension and shear: across the surfaces the stiffness times the opening,
    which is negative where the layer is pressed, along them the shear stiffness times the slip. Of
    a layer of thickness h that is held sideways by the bodies they are its modulus of uniaxial
    strain over h, and its shear modulus over h.

    Attributes
    ----------
    stiffness : float, callable or dolfinx.fem.Function
        Traction over opening [Pa/m]: a positive number, a function of the undeformed nodes x (3, n)
        [m] of the slave that returns (n,), or values at the nodes: a scalar Function of degree 1 on
        the mesh.
    shear_stiffness : float, callable or dolfinx.fem.Function, optional
        Traction over slip [Pa/m], at least 0; by default the stiffness. Where it is zero the
        surfaces are free to slide.

    Examples
    --------
    >>> ElasticLayer(stiffness=2e12, shear_stiffness=1e12).shear_stiffness
    1000000000000.0
    """

    stiffness: NodalValue
    shear_stiffness: NodalValue | None = None

    def __post_init__(self) -> None:
        check_nodal_value(self.stiffness, "ElasticLayer: the stiffness", positive=True)
        if self.shear_stiffness is not None:
            check_nodal_value(self.shear_stiffness, "ElasticLayer: the shear_stiffness")

    @property
    def holds_along(self) -> bool:
        """Whether there may be a shear stiffness."""
        return not (is_number(self.shear_stiffness) and self.shear_stiffness == 0.0)


@dataclass(frozen=True)
class Cohesive:
    """A bond that breaks: the traction rises with the jump, then falls, and contact is left.

    The jump is the opening of the surfaces and their slip along each other. Up to the strength the
    traction is the stiffness times the jump; then damage takes it down to
    zero along a line, over which the energy is dissipated (bilinear law). Damage never heals:
    unloading is along a line to zero. Closed surfaces press as in hard contact, whatever the
    damage; what has failed is contact, with the friction of the contact.

    Damage is that of the load step: `ContactProblem.advance` accepts it. Where it grows, a solve
    walks by steps of equal dissipated energy to the present loads, and finds the first equilibrium
    there, whatever the loads do on the way; `ContactReport.damage` tells it.

    At finite strains bonds join what was opposite each other in the undeformed state, over
    undeformed areas, with openings and slips across and along the present surface of the slave. All
    passes are at the present loads: damage should grow by few rows of nodes in a load step.

    Attributes
    ----------
    strength : float, callable or dolfinx.fem.Function
        Largest traction [Pa]: a number, a function of the undeformed nodes x (3, n) [m] of the
        slave that returns (n,), or values at the nodes: a scalar Function of degree 1 on the mesh.
        Where it is zero nothing is bonded, and there is contact.
    energy : float, callable or dolfinx.fem.Function
        Energy that the failure of an area takes [J/m^2], the area below the line of the traction.
    stiffness : float, callable or dolfinx.fem.Function, optional
        Traction over opening, and over slip, without damage [Pa/m]; by default 10 strength^2 /
        energy, the larger one of opening and shear: a tenth of the opening at failure is elastic.
        As closed surfaces are hard in any case, it does not have to be large; stiffer bonds take
        more solves. Openings are gaps: bonds are unstrained where the gap is zero.
    shear_strength, shear_energy : float, callable or dolfinx.fem.Function, optional
        Strength [Pa] and energy [J/m^2] where the surfaces slide along each other, by default those
        of opening. A bond of no shear strength leaves its surfaces free to slide, or to friction,
        as on a plane of symmetry.
    exponent : float
        Of the law of Benzeggagh and Kenane, by which energies and squares of strengths go over from
        opening to shear with the share of shear, the square of its part of the jump.

    Examples
    --------
    >>> Cohesive(strength=57e6, energy=280.0).exponent
    2.0
    """

    strength: NodalValue
    energy: NodalValue
    stiffness: NodalValue | None = None
    shear_strength: NodalValue | None = None
    shear_energy: NodalValue | None = None
    exponent: float = 2.0

    def __post_init__(self) -> None:
        for name in ("strength", "shear_strength"):
            if (value := getattr(self, name)) is not None:
                check_nodal_value(value, f"Cohesive: the {name}")
        for name in ("energy", "stiffness", "shear_energy"):
            if (value := getattr(self, name)) is not None or name == "energy":
                check_nodal_value(value, f"Cohesive: the {name}", positive=True)
        check_positive(self.exponent, "Cohesive: the exponent", "no unit")

    @property
    def holds_along(self) -> bool:
        """Whether there may be a shear strength."""
        return not (is_number(self.shear_strength) and self.shear_strength == 0.0)


# laws of surfaces that are one at first
BondLaw: TypeAlias = ElasticLayer | Cohesive
InterfaceLaw: TypeAlias = SoftContact | RoughContact | Adhesive | ElasticBond | BondLaw


def check_law(law: Any, label: str, friction: Any = None) -> None:
    """Check that there is a law of the interface that agrees with the friction, or none."""
    if law is not None and not isinstance(law, InterfaceLaw):
        expected = (
            "SoftContact(stiffness), RoughContact(pressure, stiffness), Adhesive(traction), "
            "ElasticBond(stiffness), ElasticLayer(stiffness), Cohesive(strength, energy) or None"
        )
        raise wrong_type(f"{label}: law", law, expected)
    if isinstance(law, ElasticLayer) and friction is not None:
        raise InputError(
            f"{label}: an ElasticLayer holds along the surfaces: leave friction out. Its "
            "shear_stiffness=0 leaves them free to slide"
        )


def check_bond_law(law: Any, label: str) -> None:
    """Check that there is a law of surfaces that are one at first, or none."""
    if law is not None and not isinstance(law, BondLaw):
        expected = "Cohesive(strength, energy), ElasticLayer(stiffness) or None"
        raise wrong_type(f"{label}: law", law, expected)


def needs_passes(law: Any) -> bool:
    """Tell whether a law takes several solves: with tangents of it, or with another damage."""
    ends = isinstance(law, Adhesive) and law.energy is not None
    return ends or isinstance(law, RoughContact | Cohesive)

"""Laws of interfaces at the conditions of contacts: compliances and adhesion of their rows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.bonds import DEFAULT_STIFFNESS, Bonds
from fenics_tfeti.fem.contact.conditions.contact_conditions import ContactConditions
from fenics_tfeti.fem.contact.conditions.friction import nodal_values
from fenics_tfeti.fem.contact.descriptions.contacts import Contact, ContactPair, RigidObstacle
from fenics_tfeti.fem.contact.descriptions.laws import (
    Adhesive,
    Cohesive,
    ElasticBond,
    ElasticLayer,
    RoughContact,
)
from fenics_tfeti.fem.messages import first_wrong
from fenics_tfeti.typing import Mask, Vector


@dataclass(frozen=True)
class NodalLaw:
    """The law at the k conditions of one contact, this rank's part."""

    compliance: Vector  # (k, 2): as `ContactRows.compliance` [m/N]
    adhesion: Vector  # (k,) [N]
    touching: Vector | None = None  # gaps (k,) from which on rows press, by default 0 [m]
    bonds: Bonds | None = None  # those that can break
    reach: Vector | None = None  # openings (k,) at which adhesion ends [m]
    along: Vector | None = None  # stiffness (k,) of a layer along the surface [N/m]
    damage: Vector | None = None  # (k,) of bonds that can break, 1 where adhesion has ended

    @staticmethod
    def soft(stiffness: Vector, touching: Vector | None = None) -> NodalLaw:
        """Return the law of springs (k,) that press [N/m]."""
        compliance = np.column_stack([1.0 / stiffness, np.full_like(stiffness, np.inf)])
        return NodalLaw(compliance, np.zeros_like(stiffness), touching)

    @staticmethod
    def of_bonds(bonds: Bonds) -> NodalLaw:
        """Return the law of bonds that nothing has loaded."""
        k = bonds.area.size
        law = NodalLaw(np.tile([0.0, np.inf], (k, 1)), np.zeros(k), bonds=bonds)
        return law.damaged(bonds.intact())

    def damaged(self, damage: Vector) -> NodalLaw:
        """Return the law with a damage (k,) of its bonds, which are rigid where they are closed."""
        assert self.bonds is not None
        compliance, stiffness = self.compliance.copy(), self.bonds.stiffness_at(damage)
        compliance[:, 1] = np.divide(
            1.0, stiffness, out=np.full_like(stiffness, np.inf), where=stiffness > 0.0
        )
        return replace(self, compliance=compliance, damage=damage)

    def is_beyond(self, opening: Vector) -> Mask:
        """Tell where openings (k,) are larger than adhesion reaches."""
        assert self.reach is not None
        return np.asarray(opening > self.reach)

    def ended(self, where: Mask) -> NodalLaw:
        """Return the law without adhesion at some of the nodes (k,)."""
        return replace(
            self, adhesion=np.where(where, 0.0, self.adhesion), damage=where.astype(np.float64)
        )

    @property
    def stiffness_along(self) -> Vector | None:
        """The stiffness (k,) of bonds or a layer along the surface [N/m]; None without these."""
        if self.bonds is None or self.damage is None:
            return self.along
        return self.bonds.stiffness_along(self.damage)


def nodal_law(contact: Contact, conditions: ContactConditions) -> NodalLaw | None:
    """Evaluate the law of a contact at its conditions; None without one. Collective.

    It belongs to the slave's surface and is asked at the undeformed nodes.
    """
    law = contact.law if isinstance(contact, ContactPair | RigidObstacle) else None
    if law is None:
        return None
    if isinstance(law, Cohesive):
        return NodalLaw.of_bonds(_bonds(law, conditions))
    if isinstance(law, RoughContact):
        # hard until its tangents are known
        return None
    if isinstance(law, Adhesive):
        return _adhesion(law, conditions)
    if isinstance(law, ElasticLayer):
        return _layer(law, conditions)
    area = conditions.area
    ((label, value),) = vars(law).items()
    values = nodal_values(value, label, conditions)
    compliance = np.tile([0.0, np.inf], (area.size, 1))
    if isinstance(law, ElasticBond):
        bonded = (values > 0.0) & np.isfinite(conditions.gap)
        compliance[bonded, 1] = 1.0 / (values * area)[bonded]
        return NodalLaw(compliance, np.zeros_like(area))
    _check_positive(conditions, values, "soft contact")
    return NodalLaw.soft(values * area)


def _layer(law: ElasticLayer, conditions: ContactConditions) -> NodalLaw:
    """Evaluate the springs of a layer at conditions. Collective."""
    area = conditions.area
    stiffness = nodal_values(law.stiffness, "stiffness", conditions)
    _check_positive(conditions, stiffness, "an elastic layer")
    along = stiffness
    if law.shear_stiffness is not None:
        along = nodal_values(law.shear_stiffness, "shear_stiffness", conditions)
    is_there = np.isfinite(conditions.gap)
    across = 1.0 / (stiffness * area)
    compliance = np.column_stack([across, np.where(is_there, across, np.inf)])
    return NodalLaw(compliance, np.zeros_like(area), along=np.where(is_there, along * area, 0.0))


def _check_positive(conditions: ContactConditions, stiffness: Vector, what: str) -> None:
    """Check stiffnesses (k,) of springs that are pressed. Collective."""
    if bad := first_wrong(conditions.surface.comm, ~(stiffness > 0.0), conditions.coordinates):
        raise InputError(
            f"{conditions.name}: the stiffness of {what} is not positive at {bad.number} "
            f"nodes, the first at {bad.place}. Take such nodes out of the surface"
        )


def _adhesion(law: Adhesive, conditions: ContactConditions) -> NodalLaw:
    """Evaluate adhesion at conditions. Collective."""
    area = conditions.area
    traction = nodal_values(law.traction, "traction", conditions)
    traction = np.where(np.isfinite(conditions.gap), traction, 0.0)
    adhesion = NodalLaw(np.tile([0.0, np.inf], (area.size, 1)), traction * area)
    if law.energy is None:
        return adhesion
    energy, adheres = nodal_values(law.energy, "energy", conditions), traction > 0.0
    _check(conditions, adheres & ~(energy > 0.0), "has no energy", "Give it one", "traction")
    reach = np.divide(energy, traction, out=np.full_like(energy, np.inf), where=adheres)
    return replace(adhesion, reach=reach).ended(~adheres)


def _bonds(law: Cohesive, conditions: ContactConditions) -> Bonds:
    """Evaluate the law of bonds at conditions. Collective."""
    strength = nodal_values(law.strength, "strength", conditions)
    energy = nodal_values(law.energy, "energy", conditions)
    bonded = (strength > 0.0) & np.isfinite(conditions.gap)
    strength = np.where(bonded, strength, 0.0)
    _check(conditions, bonded & ~(energy > 0.0), "has no energy", "Give it one")
    shear_strength, shear_energy = strength, energy
    if law.shear_strength is not None:
        shear_strength = nodal_values(law.shear_strength, "shear_strength", conditions)
        shear_strength = np.where(bonded, shear_strength, 0.0)
    if law.shear_energy is not None:
        shear_energy = nodal_values(law.shear_energy, "shear_energy", conditions)
    along = shear_strength > 0.0
    _check(conditions, along & ~(shear_energy > 0.0), "has no shear_energy", "Give it one")
    if law.stiffness is None:
        # that of the mode with the larger one: bonds have one stiffness
        across, of_shear = (
            np.divide(s**2, g, out=np.zeros_like(s), where=s > 0.0)
            for s, g in ((strength, energy), (shear_strength, shear_energy))
        )
        stiffness = DEFAULT_STIFFNESS * np.maximum(across, of_shear)
    else:
        stiffness = nodal_values(law.stiffness, "stiffness", conditions)
        _check(conditions, bonded & ~(stiffness > 0.0), "has no stiffness", "Leave it out")
    _check(
        conditions,
        bonded & ~(2.0 * stiffness * energy > strength**2),
        "stores more up to its strength than the energy of its failure",
        "The stiffness has to be larger than strength^2 / (2 energy): leave it out",
    )
    _check(
        conditions,
        along & ~(2.0 * stiffness * shear_energy > shear_strength**2),
        "stores more up to its shear strength than the shear energy of its failure",
        "The stiffness has to be larger than shear_strength^2 / (2 shear_energy)",
    )
    exponent = np.full_like(strength, law.exponent)
    data = (strength, energy, shear_strength, shear_energy)
    return Bonds(conditions.area, stiffness, *data, exponent)


def _check(
    conditions: ContactConditions, wrong: Mask, what: str, remedy: str, zero: str = "strength"
) -> None:
    """Check data of bonds at nodes of a strength, or of adhesion. Collective."""
    if bad := first_wrong(conditions.surface.comm, wrong, conditions.coordinates):
        raise InputError(
            f"{conditions.name}: the bond {what} at {bad.number} nodes, the first at {bad.place}. "
            f"{remedy}, or set the {zero} to zero there: nothing is bonded then"
        )

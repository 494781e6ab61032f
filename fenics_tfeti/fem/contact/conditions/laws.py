"""Laws of interfaces at the conditions of contacts: compliances and adhesion of their rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.contact_conditions import ContactConditions
from fenics_tfeti.fem.contact.conditions.friction import nodal_values
from fenics_tfeti.fem.contact.descriptions.contacts import Contact, ContactPair, RigidObstacle
from fenics_tfeti.fem.contact.descriptions.laws import Adhesive, ElasticBond
from fenics_tfeti.fem.messages import first_wrong
from fenics_tfeti.typing import Vector


@dataclass(frozen=True)
class NodalLaw:
    """The law at the k conditions of one contact, this rank's part."""

    compliance: Vector  # (k, 2): as `ContactRows.compliance` [m/N]
    adhesion: Vector  # (k,) [N]


def nodal_law(contact: Contact, conditions: ContactConditions) -> NodalLaw | None:
    """Evaluate the law of a contact at its conditions; None without one. Collective.

    It belongs to the slave's surface and is asked at the undeformed nodes.
    """
    law = contact.law if isinstance(contact, ContactPair | RigidObstacle) else None
    if law is None:
        return None
    area, comm = conditions.area, conditions.surface.comm
    ((label, value),) = vars(law).items()
    values = nodal_values(value, label, conditions)
    compliance = np.tile([0.0, np.inf], (area.size, 1))
    if isinstance(law, Adhesive):
        return NodalLaw(compliance, np.where(np.isfinite(conditions.gap), values * area, 0.0))
    if isinstance(law, ElasticBond):
        bonded = (values > 0.0) & np.isfinite(conditions.gap)
        compliance[bonded, 1] = 1.0 / (values * area)[bonded]
        return NodalLaw(compliance, np.zeros_like(area))
    if bad := first_wrong(comm, ~(values > 0.0), conditions.coordinates):
        raise InputError(
            f"{conditions.name}: the stiffness of soft contact is not positive at {bad.number} "
            f"nodes, the first at {bad.place}. Take such nodes out of the surface"
        )
    compliance[:, 0] = 1.0 / (values * area)
    return NodalLaw(compliance, np.zeros_like(area))

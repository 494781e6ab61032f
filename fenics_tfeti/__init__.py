"""Scalable contact mechanics with Total FETI on FEniCSx.

The public names are loaded when they are first asked for, so that ``fenics_tfeti.feti`` and
``fenics_tfeti.qp`` can be used where dolfinx is not installed.
"""

from __future__ import annotations

import logging
from importlib import import_module
from typing import Any

from fenics_tfeti.errors import (
    ContactError,
    FactorizationError,
    InputError,
    Interrupted,
    NotConverged,
    UnresistedMotion,
    UnstableTangent,
    needs_fenicsx,
)

_LAZY = {
    "Along": "fenics_tfeti.fem.contact.description",
    "BoltPreload": "fenics_tfeti.fem.contact.description",
    "BoltResult": "fenics_tfeti.fem.contact.result",
    "ContactPair": "fenics_tfeti.fem.contact.description",
    "ContactProblem": "fenics_tfeti.problem",
    "ContactResult": "fenics_tfeti.fem.contact.result",
    "Coulomb": "fenics_tfeti.fem.contact.description",
    "Cylinder": "fenics_tfeti.fem.contact.obstacles.shapes",
    "Exact": "fenics_tfeti.fem.contact.description",
    "FacetedObstacle": "fenics_tfeti.fem.contact.obstacles.faceted",
    "FrictionResult": "fenics_tfeti.fem.contact.result",
    "LinearRows": "fenics_tfeti.fem.contact.description",
    "Mapped": "fenics_tfeti.fem.contact.description",
    "Nearest": "fenics_tfeti.fem.contact.description",
    "NonlinearContactProblem": "fenics_tfeti.nonlinear",
    "PeriodicPair": "fenics_tfeti.fem.contact.description",
    "Plane": "fenics_tfeti.fem.contact.obstacles.shapes",
    "Points": "fenics_tfeti.fem.contact.description",
    "Results": "fenics_tfeti.fem.contact.result",
    "RigidBody": "fenics_tfeti.fem.contact.obstacles.rigid_body",
    "RigidBodyResult": "fenics_tfeti.fem.contact.obstacles.rigid_body",
    "RigidObstacle": "fenics_tfeti.fem.contact.description",
    "Sphere": "fenics_tfeti.fem.contact.obstacles.shapes",
    "TiedPair": "fenics_tfeti.fem.contact.description",
    "TiedResult": "fenics_tfeti.fem.contact.result",
    "Tresca": "fenics_tfeti.fem.contact.description",
    "find_contacts": "fenics_tfeti.fem.contact.automatic",
}

__all__ = [
    "Along",
    "BoltPreload",
    "BoltResult",
    "ContactError",
    "ContactPair",
    "ContactProblem",
    "ContactResult",
    "Coulomb",
    "Cylinder",
    "Exact",
    "FactorizationError",
    "FacetedObstacle",
    "FrictionResult",
    "InputError",
    "Interrupted",
    "LinearRows",
    "Mapped",
    "Nearest",
    "NonlinearContactProblem",
    "NotConverged",
    "PeriodicPair",
    "Plane",
    "Points",
    "Results",
    "RigidBody",
    "RigidBodyResult",
    "RigidObstacle",
    "Sphere",
    "TiedPair",
    "TiedResult",
    "Tresca",
    "UnresistedMotion",
    "UnstableTangent",
    "find_contacts",
]

logging.getLogger(__name__).addHandler(logging.NullHandler())


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with needs_fenicsx(f"fenics_tfeti.{name}"):
        return getattr(import_module(_LAZY[name]), name)

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
    "ContactPair": "fenics_tfeti.fem.contact.description",
    "ContactProblem": "fenics_tfeti.problem",
    "ContactResult": "fenics_tfeti.fem.contact.result",
    "Coulomb": "fenics_tfeti.fem.contact.description",
    "Cylinder": "fenics_tfeti.fem.contact.obstacles",
    "Exact": "fenics_tfeti.fem.contact.description",
    "FrictionResult": "fenics_tfeti.fem.contact.result",
    "Mapped": "fenics_tfeti.fem.contact.description",
    "Nearest": "fenics_tfeti.fem.contact.description",
    "NonlinearContactProblem": "fenics_tfeti.nonlinear",
    "Plane": "fenics_tfeti.fem.contact.obstacles",
    "Points": "fenics_tfeti.fem.contact.description",
    "Results": "fenics_tfeti.fem.contact.result",
    "RigidObstacle": "fenics_tfeti.fem.contact.description",
    "Sphere": "fenics_tfeti.fem.contact.obstacles",
    "TiedPair": "fenics_tfeti.fem.contact.description",
    "TiedResult": "fenics_tfeti.fem.contact.result",
    "Tresca": "fenics_tfeti.fem.contact.description",
    "find_contacts": "fenics_tfeti.fem.contact.automatic",
}

__all__ = [
    "Along",
    "ContactError",
    "ContactPair",
    "ContactProblem",
    "ContactResult",
    "Coulomb",
    "Cylinder",
    "Exact",
    "FactorizationError",
    "FrictionResult",
    "InputError",
    "Interrupted",
    "Mapped",
    "Nearest",
    "NonlinearContactProblem",
    "NotConverged",
    "Plane",
    "Points",
    "Results",
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

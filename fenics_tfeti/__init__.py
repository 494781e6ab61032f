"""Scalable contact mechanics with Total FETI on FEniCSx.

The public names are loaded when they are first asked for, so that ``fenics_tfeti.feti`` and
``fenics_tfeti.qp`` can be used where dolfinx is not installed.
"""

from __future__ import annotations

import logging
from contextlib import suppress
from importlib import import_module
from typing import Any

from fenics_tfeti.errors import (
    ContactError,
    DamageNotFound,
    FactorizationError,
    InputError,
    Interrupted,
    NotConverged,
    OutOfMemory,
    UnresistedMotion,
    UnstableTangent,
    needs_fenicsx,
)

# the public names of modules that need FEniCSx
_LAZY = {
    name: f"fenics_tfeti.{module}"
    for module, names in {
        "fem.contact.descriptions.contacts": "ContactPair Deformed RigidObstacle SelfContact",
        "fem.contact.descriptions.friction": "Coulomb Tresca",
        "fem.contact.descriptions.laws": "Adhesive Cohesive ElasticBond ElasticLayer "
        "RoughContact SoftContact",
        "fem.contact.descriptions.partners": "Along Mapped Mortar Nearest Points",
        "fem.contact.descriptions.rigid_body": "RigidBody",
        "fem.contact.descriptions.shapes": "Cylinder FacetedObstacle Plane Sphere",
        "fem.contact.descriptions.ties": "BoltPreload LinearRows PeriodicPair TiedPair",
        "fem.contact.search.automatic": "find_contacts",
        "fem.contact.solution.results": "BoltResult ContactEntry ContactResult FrictionResult "
        "Results RigidBodyResult TiedResult",
        "adaptive": "Adapted MeshLevel adapt",
        "fem.mesh_error.estimate": "BodyMeshError ContactMeshError MeshError MeshErrorEntry",
        "newton.iteration": "NewtonStep",
        "nonlinear": "NonlinearContactProblem NonlinearReport",
        "options": "ContactOptions NewtonOptions",
        "problem": "ContactProblem",
        "report": "ContactReport DamageEntry DamageStep",
        "sensitivities.adjoint": "Adjoint",
        "sensitivities.deformed": "DeformedAdjoint DeformedTangent",
        "sensitivities.linear_solves": "LinearSolves",
        "sensitivities.tangent": "Tangent",
    }.items()
    for name in names.split()
}

__all__ = [
    "ContactError",
    "DamageNotFound",
    "FactorizationError",
    "OutOfMemory",
    "InputError",
    "Interrupted",
    "NotConverged",
    "UnresistedMotion",
    "UnstableTangent",
    *_LAZY,
]

logging.getLogger(__name__).addHandler(logging.NullHandler())
# it loads the MPI library that the wheels of petsc4py and dolfinx look for; `qp` does without
with suppress(ModuleNotFoundError):
    import_module("mpi4py.MPI")


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with needs_fenicsx(f"fenics_tfeti.{name}"):
        return getattr(import_module(_LAZY[name]), name)

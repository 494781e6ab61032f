"""Whether an equilibrium is stable, where Newton's method has met tangents that are not.

Torn subdomains may buckle where the bodies do not, and contact that turns with the surfaces adds to
the energy: only the whole tangent on the face says it. Inverse iteration finds its eigenvector with
the smallest eigenvalue, by solutions with the set-up of the last step. That may be of the state
before the load step: a state that becomes unstable in it is then told by the next one.
"""

from __future__ import annotations

import numpy as np

from fenics_tfeti.errors import format_point
from fenics_tfeti.newton.contact_hessian import Spent
from fenics_tfeti.newton.frozen_setup import FrozenSetup
from fenics_tfeti.newton.load_case import LoadCase, NewtonState
from fenics_tfeti.typing import Vector

# steps of inverse iteration, which tell the sign of an eigenvalue
_STEPS = 5


def instability(load_case: LoadCase, state: NewtonState, set_up: FrozenSetup) -> list[str]:
    """Return a sentence if the energy falls along an eigenvector on the face. Collective.

    Pressing rows hold along it. Where others press than in the set-up, nothing is said.
    """
    face, torn = load_case.face_of(state), load_case.torn
    if not set_up.serves(load_case, face):
        return []
    hessian = set_up.hessian(load_case, state, face, Spent())
    nodes = torn.nodes
    no_gap, no_tied = np.zeros(face.contacts.size), np.zeros(face.rows.tied.size)
    beyond = np.zeros_like(face.rows.force(face.multipliers)[1])
    x, energy = _some_field(nodes.coordinates), 0.0
    for _ in range(_STEPS):
        force = load_case.at_free(x / np.sqrt(nodes.comm.allreduce((x**2).sum())), face.rows)
        change = hessian.response(force, no_gap, no_tied, beyond)
        x = torn.at_owned_nodes(change.displacements).reshape(force.shape)
        energy = nodes.comm.allreduce((x * force).sum())
    if energy >= 0.0:
        return []
    size = np.linalg.norm(x, axis=1)
    at = int(size.argmax()) if size.size else 0
    place = format_point(nodes.coordinates[at]) if size.size else ""
    _, place = max(nodes.comm.allgather((float(size.max(initial=0.0)), place)))
    return [
        "the equilibrium is not stable: the energy falls along a displacement that is largest at "
        f"{place}, while what presses stays in contact. A buckling load is near, and has been "
        "passed: disturb the bodies by a small load or an imperfection, and they buckle"
    ]


def _some_field(x: Vector) -> Vector:
    """Return a field (n, gdim) with a part along any motion, the same on any number of ranks."""
    phases = np.arange(1.0, x.shape[1] + 1.0)
    waves = x @ np.array([1.7, 2.3, 3.1])[: x.shape[1]]
    return np.asarray(1.0 + np.sin(np.outer(waves, phases) + phases))

"""Friction at the conditions of contacts: tangents, bounds, coefficients, and the origin of slip.

Slip is the tangential displacement of the slave relative to the master or obstacle since the last
load step. With the tangential row T of a condition and the displacement u_0 at the end of that step
it is T(u - u_0), less what the obstacle has moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.conditions.contact_conditions import (
    ContactConditions,
    SlaveValues,
    row_values,
)
from fenics_tfeti.fem.contact.descriptions.contacts import Contact, RigidObstacle
from fenics_tfeti.fem.contact.descriptions.friction import NodalValue, Tresca
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.fem.displacement import owned_values
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import nodes_in
from fenics_tfeti.fem.user_data import scalars_at, vectors_at
from fenics_tfeti.feti.system import ContactRows, Friction
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class SlipOrigin:
    """The state from which slip is counted: the end of the last load step."""

    displacement: Vector  # (n,): at the degrees of freedom that this rank owns [m]
    obstacles: SlaveValues  # displacements (k, gdim) of obstacles [m]

    @staticmethod
    def at(uh: Function) -> SlipOrigin:
        """Return the state with a displacement; obstacles have not moved."""
        none = SlaveValues(shape=(uh.function_space.dofmap.index_map_bs,))
        return SlipOrigin(owned_values(uh), none)


@dataclass(frozen=True)
class NodalFriction:
    """Friction at the k conditions of one contact, this rank's part."""

    tangents: Vector  # (k, gdim - 1, gdim), orthonormal
    bound: Vector  # slip bounds (k,) [N]; 0 with Coulomb's law
    coefficient: Vector  # of friction (k,); 0 with Tresca's law
    obstacle_displacement: Vector  # displacement of the obstacle (k, gdim) [m]; zero for pairs
    compliance: Vector  # elastic slip over force (k,) [m/N]

    def bonded(self, stiffness: Vector) -> NodalFriction:
        """Return springs along the surface where a stiffness (k,) [N/m] is positive."""
        held = stiffness > 0.0
        return replace(
            self,
            bound=np.where(held, np.inf, self.bound),
            coefficient=np.where(held, 0.0, self.coefficient),
            compliance=np.divide(1.0, stiffness, out=self.compliance.copy(), where=held),
        )

    def elastic_slip(self, force: Vector) -> Vector:
        """Return the elastic slips (k, gdim - 1) of tangential forces."""
        return self.compliance[:, None] * force


def tangents(normal: Vector, prescribed: Mask) -> Vector:
    """Return orthonormal tangents (k, gdim - 1, gdim) at nodes with unit normals (k, gdim).

    Where components are prescribed, one tangent is along the tangential part of such a direction: a
    plane of symmetry then decides the slip along one tangent and leaves the other free.

    Examples
    --------
    >>> normal = np.array([[0.0, 0.0, -1.0]])
    >>> np.abs(tangents(normal, np.array([[False, True, False]])))[0].tolist()
    [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    """
    k, gdim = normal.shape
    if gdim == 2:
        tangent: Vector = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
        return tangent[:, None, :]
    along2 = 1.0 - normal**2
    # but for rounding, a direction has a tangential part
    axis = np.argmax(along2 + 2.0 * (prescribed & (along2 > 1e-12)), axis=1)
    first = np.identity(3)[axis] - normal[np.arange(k), axis][:, None] * normal
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(normal, first)], axis=1)


def nodal_friction(
    contact: Contact,
    conditions: ContactConditions,
    fixed: Mask,
    boundary: MeshBoundary,
    has_sites: bool = False,
) -> NodalFriction | None:
    """Evaluate the friction of a contact at its conditions; None without friction. Collective.

    The law belongs to the slave's surface and is asked at the undeformed nodes; the displacement of
    an obstacle where they are on the boundary now, for degree 2 in the mean around them. Where
    there have to be sites in any case, they may have no friction.
    """
    law, surface = contact.friction, conditions.surface
    if law is None and not has_sites:
        return None
    law = law or Tresca(0.0)
    is_tresca = isinstance(law, Tresca)
    label = "slip_bound" if is_tresca else "coefficient"
    values = nodal_values(getattr(law, label), label, conditions)
    elastic = nodal_values(law.elastic_slip, "elastic_slip", conditions)
    compliance = np.divide(
        elastic, conditions.area, out=np.zeros_like(elastic), where=conditions.area > 0.0
    )
    moved = np.zeros_like(conditions.normal)
    if isinstance(contact, RigidObstacle) and contact.displacement is not None:
        label = f"{conditions.name}: the obstacle's displacement"
        x = conditions.relative(boundary.coordinates)
        moved = vectors_at(surface.comm, contact.displacement, x, moved.shape[1], label)
    return NodalFriction(
        tangents(conditions.normal, fixed[surface.local][conditions.on_surface]),
        np.where(is_tresca, values * conditions.area, 0.0),
        np.where(is_tresca, 0.0, values),
        moved,
        compliance,
    )


def nodal_values(value: NodalValue, label: str, conditions: ContactConditions) -> Vector:
    """Return data of a law (k,), at least 0, at the conditions. Collective."""
    label, nodes = f"{conditions.name}: {label}", conditions.surface.boundary.nodes
    space = nodes.space
    with raise_collectively(nodes.comm):
        if isinstance(value, Function):
            source = value.function_space
            if source.mesh is not space.mesh:
                raise InputError(f"{label} is a Function on another mesh than the displacement")
            family, degree, shape = _compat.element_facts(source)
            if (family, degree) != ("Lagrange", 1) or shape:
                raise InputError(
                    f"{label} is a Function of {family} elements of degree {degree} and shape "
                    f"{shape}; a scalar one of Lagrange elements of degree 1 is expected"
                )
            value = value.x.array[nodes_in(source, space)[conditions.slave - nodes.first]]
    gdim = nodes.components
    return scalars_at(nodes.comm, value, conditions.coordinates, gdim, label, lowest=0.0)


def friction_rows(
    nodes: NodeMap,
    rows: ContactRows,
    sites: Sequence[tuple[Numbers, NodalFriction, Vector]],
    origin: Vector,
) -> Friction:
    """Return where contact rows have friction, and from where slip is counted. Collective.

    Of each contact with friction, the sites are positions among the rows (k,), the friction there,
    and what the obstacle has moved (k, gdim) since the displacement of the origin (n,) [m].
    """
    gdim = nodes.components
    new = Friction(
        np.concatenate([numbers for numbers, _, _ in sites]),
        np.concatenate([friction.tangents for _, friction, _ in sites]),
        np.concatenate([friction.bound for _, friction, _ in sites]),
        coefficient=np.concatenate([friction.coefficient for _, friction, _ in sites]),
        compliance=np.concatenate([friction.compliance for _, friction, _ in sites]),
    )
    tangential = new.tangential_rows(rows)
    slip = row_values(nodes, tangential, origin).reshape(-1, gdim - 1)
    slip /= tangential.length.reshape(-1, gdim - 1)
    moved = np.concatenate([moved for _, _, moved in sites])
    return replace(new, slip=slip + np.einsum("kta,ka->kt", new.tangents, moved))

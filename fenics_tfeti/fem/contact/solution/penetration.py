"""Depth in the other body of nodes that no mortar condition speaks of.

They are nodes of the slave without a condition, and nodes at the border of the master's surface,
such as corners of a foot, which may lie anywhere between the places of the conditions.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import format_point, warn_user
from fenics_tfeti.fem.contact.conditions.contact_conditions import ContactConditions
from fenics_tfeti.fem.contact.conditions.surface_pairs import user_gaps
from fenics_tfeti.fem.contact.descriptions.contacts import ContactPair
from fenics_tfeti.fem.contact.surfaces.nearby import gather_nearby
from fenics_tfeti.fem.contact.surfaces.tagged import Surface, surface_of
from fenics_tfeti.fem.geometry.vectors import unit
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING, VISIBLE_PENETRATION
from fenics_tfeti.parallel import concatenate_ranks
from fenics_tfeti.typing import Mask, Numbers, Vector


def whole_surfaces(parts: Sequence[ContactConditions]) -> list[Surface]:
    """Return the surfaces of slave and master of all parts of a contact. Collective."""
    sides = zip(*(part.surfaces for part in parts), strict=True)
    return [_joined(surfaces) for surfaces in sides]


def _joined(surfaces: Sequence[Surface]) -> Surface:
    first = surfaces[0]
    if len(surfaces) == 1:
        return first
    facets = np.unique(np.concatenate([part.facet_nodes for part in surfaces]), axis=0)
    return surface_of(first.boundary, facets, first.names, first.role)


def measured_penetration(
    contact: ContactPair,
    conditions: ContactConditions,
    whole: Sequence[Surface],
    conditioned: Numbers,
    uh: Function,
) -> float:
    """Return the largest depth in the other body [m] of nodes without a condition. Collective.

    They are those of a part of a contact: the slave's but for `conditioned` ones (k,) of this rank,
    and those at the border of the master, such as its sharp edges. Depths are in the surfaces of
    the `whole` contact: one side of a wedge has no inside. One that counts beside the deformation
    of the slave's surface is told. Gaps are those between the deformed surfaces; initial gaps of
    the user replace those of the mesh.
    """
    slave, master = conditions.surfaces
    boundary, deformed = slave.boundary, slave.boundary.deformed(uh)
    chosen = [~np.isin(slave.nodes, conditioned), _on_border(master)]
    depths, places = [], []
    for surface, other, nodes in zip((slave, master), whole[::-1], chosen, strict=True):
        gap, _ = _gaps_to(surface.on(deformed), other.on(deformed), nodes)
        if surface.depth is not None:
            # what is deeper is the other side of the node's own wall
            gap[gap < surface.max_of_facets(-surface.depth)[nodes]] = np.inf
        if contact.initial_gap != "geometric":
            of_mesh, x = _gaps_to(surface, other, nodes)
            if surface is slave:
                x = surface.coordinates[nodes]
            of_user = np.maximum(of_mesh, 0.0)
            if not isinstance(contact.initial_gap, str):
                of_user = user_gaps(surface.comm, contact.initial_gap, x, conditions.name)
            is_opposite = np.isfinite(of_mesh) & np.isfinite(gap)
            gap[is_opposite] += (of_user - of_mesh)[is_opposite]
        depths.append(-surface.without_rounding(gap, surface.contact[nodes]))
        places.append(surface.points[nodes])
    depth, x = np.concatenate(depths), np.concatenate(places)
    # the motion of the whole surface does not count
    u = concatenate_ranks(slave.comm, boundary.nodes.values(uh)[slave.local])
    if not len(u):
        return 0.0
    size = float(np.linalg.norm(u - u.mean(axis=0), axis=1).max())
    deepest = int(depth.argmax()) if depth.size else 0
    own = (float(depth[deepest]), tuple(x[deepest])) if depth.size else (0.0, ())
    largest, place = max(slave.comm.allgather(own))
    if largest > VISIBLE_PENETRATION * size:
        warn_user(
            f"{conditions.name}: a node at {format_point(place, float(np.abs(place).max()))} is "
            f"inside the other body, by more than {VISIBLE_PENETRATION:.0%} of the deformation "
            "of the slave's surface (contacts[...].penetration in the report): the slave's facets "
            "are too large for conditions of their own there. Refine them, give bodies side by "
            "side contacts of their own, or exchange slave and master"
        )
    return max(largest, 0.0)


def _on_border(surface: Surface) -> Mask:
    """Tell which nodes (k,) are on an edge of one facet alone, in 2D at one end. Collective."""
    facets = gather_nearby(surface, surface)
    corners = facets.facets.corners
    sides = corners[:, :, None]
    if corners.shape[1] > 2:
        sides = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=2), axis=2)
    distinct, number = np.unique(sides.reshape(-1, sides.shape[2]), axis=0, return_counts=True)
    return np.isin(surface.nodes, facets.nodes[distinct[number == 1]])


def _gaps_to(surface: Surface, other: Surface, chosen: Mask) -> tuple[Vector, Vector]:
    """Return the gaps (q,) of chosen nodes and the points (q, 3) opposite them. Collective.

    The gaps are infinite at nodes that are beside the other surface or face away from it.
    """
    own, near = gather_nearby(surface, surface), gather_nearby(other, surface)
    x, gdim = surface.points[chosen], surface.points.shape[1]
    gap, opposite = np.full(len(x), np.inf), np.zeros((len(x), 3))
    if not (len(x) and len(near.facets)):
        return gap, opposite
    normals = near.from_corners(near.normal)
    found = near.interpolate(np.column_stack([near.points, normals]), x)
    point, normal = found[:, :gdim], unit(found[:, gdim:])
    offset = x - point
    height = np.sum(offset * normal, axis=1)
    beside = np.linalg.norm(offset - height[:, None] * normal, axis=1)
    of_node = own.normal[np.searchsorted(own.nodes, surface.nodes[chosen])]
    # near an edge, the normals of a curved surface and the offset differ
    opposed = beside <= 0.5 * np.abs(height) + RELATIVE_ROUNDING * surface.size[chosen]
    opposed &= np.sum(of_node * normal, axis=1) < 0.0
    gap[opposed] = height[opposed]
    opposite[:, :gdim] = point
    return gap, opposite

"""Conditions of a surface at a rigid obstacle: node by node, for degree 2 in the mean around nodes.

On the undeformed surface, and on the deformed one for exact non-penetration.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.fem.contact.contact import ContactPairing, Terms
from fenics_tfeti.fem.contact.description import RigidObstacle
from fenics_tfeti.fem.contact.mortar.conditions import one_sided_conditions
from fenics_tfeti.fem.contact.obstacles.shapes import gap_and_normal
from fenics_tfeti.fem.contact.pairing_summary import angles_between, pairing_summary
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, Surface, tagged_surface
from fenics_tfeti.typing import Vector


def match_obstacle(
    boundary: MeshBoundary,
    name: str,
    contact: RigidObstacle,
    earlier: ContactPairing | None,
    displacement: Function | None = None,
) -> ContactPairing:
    """Find the slave's nodes, the obstacle's normals and the gaps, this rank's part. Collective.

    The surface of an earlier result is used again. With a displacement the obstacle is evaluated on
    the deformed surface alone.
    """
    tags, tag = contact.facet_tags, contact.slave
    slave = earlier.surface if earlier else tagged_surface(boundary, tags, tag, f"slave of {name}")
    if displacement is not None:
        return _match_deformed(name, contact, slave, displacement)
    if boundary.degree > 1:
        return _match_means(name, contact, slave)
    comm, covered = slave.comm, np.ones(len(slave.facet_nodes), dtype=bool)
    gap, outward = gap_and_normal(comm, contact.obstacle, slave.coordinates, slave.normal, name)
    gap = slave.without_rounding(gap)
    normal = -outward  # u'n <= gap with n pointing into the obstacle
    angle = angles_between(slave.normal, normal)
    return ContactPairing(
        Terms.of_nodes(slave.nodes),
        normal,
        gap,
        slave.areas(covered, name),
        name,
        pairing_summary(comm, name, "obstacle", gap, angle, slave.nodes.size, area=slave.area),
        slave,
        covered,
    )


def _match_means(name: str, contact: RigidObstacle, slave: Surface) -> ContactPairing:
    """Return the conditions for degree 2, on the facets that have an obstacle at all nodes."""
    comm, all_nodes = slave.comm, slave.boundary.nodes
    facets = slave.oriented_part()
    normals = facets.from_corners(facets.normal)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    nodal_gap, _ = gap_and_normal(comm, contact.obstacle, _padded(facets.points), normals, name)
    covered = np.isfinite(nodal_gap)[facets.facets.nodes].all(axis=1)
    nodes, terms = one_sided_conditions(slave, facets, covered)
    rows = np.searchsorted(slave.nodes, nodes)
    if facets.weight is not None:
        slave.check_weight(terms.scale, rows, name)
    # the nodes of a condition may be on facets of several ranks
    at_owners = all_nodes.sum_at_owners(facets.nodes, nodal_gap, np.maximum)
    mean = _mean_gap(terms, all_nodes.values_at(at_owners, terms.nodes))
    gap = slave.without_rounding(mean)
    _, outward = gap_and_normal(
        comm, contact.obstacle, slave.coordinates[rows], slave.normal[rows], name
    )
    angle = angles_between(slave.normal[rows], -outward)
    summary = pairing_summary(
        comm, name, "obstacle", gap, angle, slave.nodes.size, area=terms.scale
    )
    return ContactPairing(terms, -outward, gap, terms.scale, name, summary, slave, covered)


def _match_deformed(
    name: str, contact: RigidObstacle, slave: Surface, displacement: Function
) -> ContactPairing:
    """Return conditions on all facets, wherever they may meet the obstacle later."""
    covered = np.ones(len(slave.facet_nodes), dtype=bool)
    if slave.boundary.degree > 1:
        nodes, terms = one_sided_conditions(slave, slave.oriented_part(), covered)
        area = terms.scale
    else:
        nodes, terms, area = slave.nodes, Terms.of_nodes(slave.nodes), slave.areas(covered, name)
    rows = np.searchsorted(slave.nodes, nodes)
    gap = np.full(nodes.size, np.inf)
    pairing = ContactPairing(terms, slave.normal[rows], gap, area, name, {}, slave, covered)
    displacement.x.scatter_forward()
    normal, _, distance = deformed_gaps(contact, pairing, displacement)
    gap = slave.without_rounding(distance)
    deformed = slave.gathered(displacement)
    angle = angles_between(deformed.normal[np.searchsorted(deformed.nodes, nodes)], normal)
    summary = pairing_summary(
        slave.comm, name, "obstacle", gap, angle, slave.nodes.size, area=slave.area
    )
    return replace(pairing, normal=normal, gap=gap, summary=summary)


def _mean_gap(terms: Terms, gap: Vector) -> Vector:
    """Return the mean gaps (k,) of conditions; infinite where a node (t,) has no obstacle."""
    finite = np.isfinite(gap)
    mean = terms.means(np.where(finite, gap, 0.0)[:, None])[:, 0]
    is_open = np.zeros(mean.size, dtype=bool)
    is_open[terms.row[~finite]] = True
    return np.where(is_open, np.inf, mean)


def deformed_gaps(
    contact: RigidObstacle, pairing: ContactPairing, displacement: Function
) -> tuple[Vector, Vector, Vector]:
    """Return the conditions at an obstacle in the deformed state. Collective.

    Returned are normals (k, gdim) into the obstacle, gaps (k,) in terms of the total displacement,
    and distances (k,) from the obstacle [m], for degree 2 the means around the nodes. The ghosts of
    the displacement are up to date.
    """
    comm, name, terms = pairing.surface.comm, pairing.name, pairing.terms
    slave = pairing.surface.gathered(displacement)
    slave.check_not_folded(name)
    nodes, inverse = np.unique(terms.nodes, return_inverse=True)
    rows = np.searchsorted(slave.nodes, nodes)
    places, normals = _padded(slave.points[rows]), slave.normal[rows]
    nodal, outward = gap_and_normal(comm, contact.obstacle, places, normals, name)
    distance = _mean_gap(terms, nodal[inverse])
    motion = terms.means(slave.displacement[rows[inverse]])
    outward = outward[np.searchsorted(nodes, pairing.slave)]
    return -outward, distance - np.sum(motion * outward, axis=1), distance


def _padded(points: Vector) -> Vector:
    """Return points (k, gdim) as rows of three coordinates."""
    return np.pad(points, ((0, 0), (0, 3 - points.shape[1])))

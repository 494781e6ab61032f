"""Contact of surfaces whose meshes need not match: mortar conditions with normals and gaps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.fem.contact.contact import ContactPairing
from fenics_tfeti.fem.contact.description import ContactPair
from fenics_tfeti.fem.contact.mortar.checks import check_covered, check_folds
from fenics_tfeti.fem.contact.mortar.conditions import (
    MortarConditions,
    SlaveFacets,
    mortar_conditions,
)
from fenics_tfeti.fem.contact.pairing_summary import pairing_summary
from fenics_tfeti.fem.contact.surfaces.gathered import GatheredSurface
from fenics_tfeti.fem.contact.surfaces.initial_gap import initial_gap
from fenics_tfeti.fem.contact.surfaces.measure_weight import check_weighted_areas
from fenics_tfeti.fem.contact.surfaces.nearby import gather_nearby
from fenics_tfeti.fem.contact.surfaces.symmetry_planes import normals_in_symmetry_planes
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, Surface
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Mask, Numbers, Vector


def match_by_mortar(
    boundary: MeshBoundary,
    name: str,
    contact: ContactPair,
    slave: Surface,
    master: GatheredSurface,
    shared: Numbers,
    prescribed: Mask,
) -> ContactPairing:
    """Return the mortar conditions of a pair, this rank's part. Collective.

    The master is what is near this rank's slave facets, not deformed. Nodes of both surfaces,
    `shared`, stay free; `prescribed` (s, gdim) are the components prescribed at the slave's nodes.
    """
    comm, gdim = boundary.nodes.comm, slave.normal.shape[1]
    points = boundary.coordinates[:, :gdim]
    oriented = replace(slave, normal=_normals(contact, slave, prescribed))
    facets = slave_facets(oriented, points)
    check_folds(comm, facets, name)
    with raise_collectively(comm):
        normals = master.normals(name)
    conditions = mortar_conditions(comm, facets, slave.nodes, master, normals, shared)
    check_covered(comm, conditions, slave, name)
    rows = np.searchsorted(slave.nodes, conditions.slave)
    if facets.weight is not None:
        label = f"slave of {name}"
        check_weighted_areas(comm, conditions.area, slave.area[rows], slave.points[rows], label)
    gap = np.sum(conditions.gap * conditions.normal, axis=1)
    gap = slave.without_rounding(gap)
    gap = initial_gap(
        comm, contact.initial_gap, gap, conditions.chord, slave.coordinates[rows], name
    )
    deviation = slave.without_rounding(conditions.deviation)
    summary = pairing_summary(
        comm,
        name,
        "mortar",
        gap,
        conditions.angle,
        slave.nodes.size,
        area=conditions.area,
        covered_area=conditions.covered_area,
        deviation=deviation if contact.initial_gap == "geometric" else None,
    )
    return _pairing(name, conditions, slave, gap, summary, prescribed)


def match_deformed(
    boundary: MeshBoundary,
    contact: ContactPair,
    pairing: ContactPairing,
    displacement: Function,
) -> tuple[ContactPairing, Vector]:
    """Return the mortar conditions of a pair on its deformed surfaces. Collective.

    The gaps are in terms of the total displacement, whose ghosts are up to date. The second result
    are the mean distances (k,) between the deformed surfaces [m], negative inside.
    """
    name, comm, gdim = pairing.name, boundary.nodes.comm, boundary.nodes.components
    surface, tags = pairing.surface, contact.facet_tags
    slave, master = (
        gather_nearby(boundary, tags, tag, contact.slave, surface.nodes, displacement)
        for tag in (contact.slave, contact.master)
    )
    with raise_collectively(comm):
        rows = np.searchsorted(slave.nodes, surface.nodes)
        normal = surface.normal if contact.normal is not None else slave.normals(name)[rows]
        master_normals = master.normals(name)
    prescribed = pairing.prescribed
    if prescribed is None:
        prescribed = np.zeros_like(normal, dtype=bool)
    deformed = replace(surface, normal=normal)
    deformed = replace(deformed, normal=_normals(contact, deformed, prescribed))
    points = boundary.coordinates[:, :gdim] + boundary.nodes.values(displacement)
    facets = slave_facets(deformed, points)
    shared = np.intersect1d(slave.nodes, master.nodes)
    conditions = mortar_conditions(comm, facets, surface.nodes, master, master_normals, shared)
    check_covered(comm, conditions, surface, name)
    distance = np.sum(conditions.gap * conditions.normal, axis=1)
    new = _pairing(name, conditions, surface, distance, pairing.summary, prescribed)
    relative = new.relative(boundary.nodes, boundary.nodes.values(displacement))
    gap = distance + np.sum(relative * conditions.normal, axis=1)
    return replace(new, gap=gap, master_surface=pairing.master_surface), distance


def _pairing(
    name: str,
    conditions: MortarConditions,
    slave: Surface,
    gap: Vector,
    summary: dict[str, Any],
    prescribed: Mask,
) -> ContactPairing:
    return ContactPairing(
        conditions.terms,
        conditions.normal,
        gap,
        conditions.area,
        name,
        summary,
        slave,
        conditions.covered,
        conditions.coverage,
        prescribed,
    )


def slave_facets(slave: Surface, points: Vector) -> SlaveFacets:
    """Return this rank's facets of a slave, with normals and weights. Collective.

    The points (nodes, gdim) are all local nodes of the space, undeformed or deformed [m].
    """
    return SlaveFacets.of(slave, points, slave.boundary.nodal_weight())


def _normals(contact: ContactPair, slave: Surface, prescribed: Mask) -> Vector:
    """Return the user's normals, or the surface's with regard to planes of symmetry."""
    if contact.normal is not None:
        return slave.normal
    return normals_in_symmetry_planes(slave, prescribed)

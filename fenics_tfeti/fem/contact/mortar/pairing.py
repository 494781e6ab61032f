"""Contact of surfaces whose meshes need not match: mortar conditions with normals and gaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.contact import ContactPairing
from fenics_tfeti.fem.contact.description import ContactPair
from fenics_tfeti.fem.contact.mortar.conditions import MortarConditions, mortar_conditions
from fenics_tfeti.fem.contact.mortar.facets import Planes
from fenics_tfeti.fem.contact.pairing_summary import pairing_summary
from fenics_tfeti.fem.contact.surfaces.initial_gap import initial_gap
from fenics_tfeti.fem.contact.surfaces.nearby import gather_nearby
from fenics_tfeti.fem.contact.surfaces.normals import normals_in_symmetry_planes
from fenics_tfeti.fem.contact.surfaces.surface_facets import SurfaceFacets
from fenics_tfeti.fem.contact.surfaces.tagged import Surface
from fenics_tfeti.fem.messages import first_wrong
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Mask, Numbers, Vector


def match_by_mortar(
    name: str,
    contact: ContactPair,
    slave: Surface,
    tagged_master: Surface,
    master: SurfaceFacets,
    shared: Numbers,
    prescribed: Mask,
) -> ContactPairing:
    """Return the mortar conditions of a pair, this rank's part. Collective.

    The master is what is near this rank's slave facets, not deformed. Nodes of both surfaces,
    `shared`, stay free; `prescribed` (s, gdim) are the components prescribed at the slave's nodes.
    """
    oriented = replace(slave, normal=_normals(contact, slave, prescribed))
    facets = oriented.oriented_part()
    check_folds(slave.boundary.nodes, facets, name)
    conditions = mortar_conditions(slave, facets, master, shared, prescribed)
    check_covered(conditions, slave, name)
    rows = np.searchsorted(slave.nodes, conditions.terms.slave)
    if facets.weight is not None:
        slave.check_weight(conditions.area, rows, name)
    gap = np.sum(conditions.gap * conditions.normal, axis=1)
    gap = slave.without_rounding(gap)
    gap = initial_gap(
        slave.comm, contact.initial_gap, gap, conditions.chord, slave.coordinates[rows], name
    )
    deviation = slave.without_rounding(conditions.deviation)
    summary = pairing_summary(
        slave.comm,
        name,
        "mortar",
        gap,
        conditions.angle,
        slave.nodes.size,
        area=conditions.area,
        covered_area=conditions.covered_area,
        deviation=deviation if contact.initial_gap == "geometric" else None,
    )
    summary = {**summary, "slave": contact.slave, "master": contact.master}
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
        tagged_master,
    )


def match_deformed(
    contact: ContactPair, pairing: ContactPairing, displacement: Function
) -> tuple[ContactPairing, Vector]:
    """Return the mortar conditions of a pair on its deformed surfaces. Collective.

    The gaps are in terms of the total displacement, whose ghosts are up to date. The second result
    are the mean distances (k,) between the deformed surfaces [m], negative inside.
    """
    name, surface, tagged_master = pairing.name, pairing.surface, pairing.master_surface
    prescribed = pairing.prescribed
    assert tagged_master is not None and prescribed is not None
    nodes = surface.boundary.nodes
    slave, master = (
        gather_nearby(other, surface, displacement) for other in (surface, tagged_master)
    )
    normal = surface.normal
    with raise_collectively(surface.comm):
        if contact.normal is None:
            slave.check_not_folded(name)
            normal = slave.normal[np.searchsorted(slave.nodes, surface.nodes)]
        master.check_not_folded(name)
    deformed = replace(surface, normal=normal)
    deformed = replace(deformed, normal=_normals(contact, deformed, prescribed))
    facets = deformed.oriented_part(displacement)
    shared = np.intersect1d(slave.nodes, master.nodes)
    conditions = mortar_conditions(surface, facets, master, shared, prescribed)
    check_covered(conditions, surface, name)
    distance = np.sum(conditions.gap * conditions.normal, axis=1)
    new = replace(
        pairing,
        terms=conditions.terms,
        normal=conditions.normal,
        area=conditions.area,
        covered=conditions.covered,
        coverage=conditions.coverage,
    )
    relative = new.relative(nodes, nodes.values(displacement))
    return replace(new, gap=distance + np.sum(relative * conditions.normal, axis=1)), distance


def _normals(contact: ContactPair, slave: Surface, prescribed: Mask) -> Vector:
    """Return the user's normals, or the surface's with regard to planes of symmetry."""
    if contact.normal is not None:
        return slave.normal
    return normals_in_symmetry_planes(slave, prescribed)


def check_covered(conditions: MortarConditions, slave: Surface, name: str) -> None:
    """Check that the master covers a part of the slave, and more than slivers. Collective."""
    facets, rows = slave.comm.allreduce(
        np.array([int(conditions.covered.sum()), conditions.terms.slave.size])
    ).tolist()
    if not facets:
        raise InputError(
            f"{name}: no facet of the slave has a facet of the master opposite it: along the "
            "normals the surfaces never meet, or they face away from each other. Surfaces that "
            "touch face each other: is one of the tags on the far side of its body, or on another "
            "body?"
        )
    everywhere = np.ones(slave.nodes.size, dtype=bool)
    if not rows and (bad := first_wrong(slave.comm, everywhere, slave.points)):
        raise InputError(
            f"{name}: the master covers slivers of {facets} slave facets only, too little for any "
            f"of the {bad.number} slave nodes, the first at {bad.place}. Tag surfaces that lie "
            "over each other, not ones that meet at an edge"
        )


def check_folds(all_nodes: NodeMap, slave: SurfaceFacets, name: str) -> None:
    """Check that neighbouring facets of the slave are folded by 90 degrees at most. Collective."""
    corners, points = slave.facets.pieces, slave.points
    normal = Planes.of(slave.facets.coordinates()).normal
    v, gdim = corners.shape[1], points.shape[1]
    ends = np.stack([corners, corners if v == 2 else np.roll(corners, -1, axis=1)], axis=2)
    middle = points[ends].mean(axis=2).reshape(-1, gdim)
    edges = np.sort(slave.nodes[ends.reshape(-1, 2)], axis=1)
    low, high, middle, normal = all_nodes.to_owners(
        edges[:, 0], edges[:, 1], middle, np.repeat(normal, v, axis=0)
    )
    order = np.lexsort((high, low))
    low, high, middle, normal = low[order], high[order], middle[order], normal[order]
    same = (low[1:] == low[:-1]) & (high[1:] == high[:-1])
    folded = same & (np.sum(normal[1:] * normal[:-1], axis=1) < -RELATIVE_ROUNDING)
    if bad := first_wrong(all_nodes.comm, folded, middle[1:]):
        raise InputError(
            f"{name}: the slave's surface is folded by more than 90 degrees at {bad.number} edges, "
            f"the first at {bad.place}. Tag the two sides of a sharp edge as surfaces of two "
            "contacts, or make the other surface the slave"
        )

"""Contacts whose surfaces are opposite each other nowhere, and those that can never meet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.checks import points_away
from fenics_tfeti.fem.contact.conditions.obstacle import gap_and_normal
from fenics_tfeti.fem.contact.contact_set import ContactSet, FoundContact
from fenics_tfeti.fem.contact.descriptions.contacts import RigidObstacle
from fenics_tfeti.fem.contact.surfaces.faceted import unit
from fenics_tfeti.fem.contact.surfaces.nearby import gather_nearby
from fenics_tfeti.fem.contact.surfaces.tagged import Surface
from fenics_tfeti.parallel import any_rank
from fenics_tfeti.typing import Vector

# cosine of the angle from which on surfaces look the same way; those with less of one, as the side
# of a block below a die, may turn until they meet
_SAME_WAY = 0.1


def contacts_apart(conditions: ContactSet, uh: Function) -> list[list[FoundContact]]:
    """Return the parts of contacts whose displaced surfaces are opposite nothing. Collective.

    Pairs have no conditions then, obstacles face no node.
    """
    contacts: dict[int, list[FoundContact]] = {}
    for found in conditions.contacts:
        contacts.setdefault(found.number, []).append(found)
    counts = [sum(_opposite(part, conditions, uh) for part in parts) for parts in contacts.values()]
    counts = conditions.boundary.nodes.comm.allreduce(np.array(counts, dtype=np.int64)).tolist()
    return [parts for parts, count in zip(contacts.values(), counts, strict=True) if not count]


def wrong_side(conditions: ContactSet, uh: Function) -> InputError | None:
    """Return the error that displaced surfaces are apart and look the same way. Collective.

    At all nodes, that is: no small turn of either surface lets them meet.
    """
    comm = conditions.boundary.nodes.comm
    for parts in contacts_apart(conditions, uh):
        along = np.concatenate([_along_normals(part, conditions, uh) for part in parts])
        nodes, name = comm.allreduce(along.size), parts[0].pairing.name
        if not nodes or any_rank(comm, along < _SAME_WAY):
            continue
        if parts[0].pairing.master_surface is None:
            return points_away(name, nodes)
        return InputError(
            f"{name}: slave and master have not met, and look the same way at all {nodes} slave "
            "nodes: the outward normals of surfaces that touch point against each other. Is one of "
            "the tags on the far side of its body, or on another body?"
        )
    return None


def _opposite(found: FoundContact, conditions: ContactSet, uh: Function) -> int:
    """Return the number of this rank's nodes with something opposite. Collective."""
    if found.pairing.master_surface is not None:
        return found.pairing.gap.size
    return int((_along_normals(found, conditions, uh) < 0.0).sum())


def _along_normals(found: FoundContact, conditions: ContactSet, uh: Function) -> Vector:
    """Return cosines (k,) of this rank's normals and those of what is nearest. Collective.

    Nodes without an obstacle have none.
    """
    slave, *masters = (_displaced(surface, uh) for surface in found.pairing.surfaces)
    if not masters:
        contact = found.contact_at(conditions.bodies)
        assert isinstance(contact, RigidObstacle)
        gap, normal = gap_and_normal(slave, contact.obstacle, slave.coordinates, slave.normal)
        return np.sum(slave.normal * normal, axis=1)[np.isfinite(gap)]
    near = gather_nearby(masters[0], slave)
    if not slave.nodes.size:
        return np.zeros(0)
    normal = unit(near.interpolate(near.from_corners(near.normal), slave.points))
    return np.sum(slave.normal * normal, axis=1)


def _displaced(surface: Surface, uh: Function) -> Surface:
    """Return a surface where it is displaced, with its normals there. Collective."""
    uh.x.scatter_forward()
    surface = surface.on(surface.boundary.deformed(uh))
    facets = gather_nearby(surface, surface)
    rows = np.searchsorted(facets.nodes, surface.nodes)
    return replace(surface, normal=facets.normal[rows])

"""Contacts whose surfaces are opposite each other nowhere, and those that can never meet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem.contact.conditions.checks import points_away
from fenics_tfeti.fem.contact.conditions.obstacle import gap_and_normal
from fenics_tfeti.fem.contact.contact_set import ContactSet, FoundContact
from fenics_tfeti.fem.contact.descriptions.contacts import Contact, Patch, RigidObstacle
from fenics_tfeti.fem.contact.descriptions.ties import Tie
from fenics_tfeti.fem.contact.surfaces.nearby import gather_nearby
from fenics_tfeti.fem.contact.surfaces.oriented import oriented_facets, owned_facets
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, Surface
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.geometry.faceted import FacetedSurface
from fenics_tfeti.fem.geometry.facets import Facets
from fenics_tfeti.fem.geometry.vectors import unit
from fenics_tfeti.fem.topology import cells_of_facets
from fenics_tfeti.parallel import any_rank, concatenate_ranks
from fenics_tfeti.typing import Vector

# depth of nodes inside another body, relative to facets, that is more than rounding
_DEPTH = 1e-3
# cosine of the angle from which on surfaces look the same way; those with less of one, as the side
# of a block below a die, may turn until they meet
_SAME_WAY = 0.1


def contacts_apart(contact_set: ContactSet, uh: Function) -> list[list[FoundContact]]:
    """Return the parts of contacts whose displaced surfaces are opposite nothing. Collective.

    Pairs have no conditions then, obstacles face no node.
    """
    contacts: dict[int, list[FoundContact]] = {}
    for found in contact_set.contacts:
        contacts.setdefault(found.number, []).append(found)
    counts = [
        sum(_opposite(part, contact_set, uh) for part in parts) for parts in contacts.values()
    ]
    counts = contact_set.boundary.nodes.comm.allreduce(np.array(counts, dtype=np.int64)).tolist()
    return [parts for parts, count in zip(contacts.values(), counts, strict=True) if not count]


def wrong_side(contact_set: ContactSet, uh: Function, bodies: Bodies) -> InputError | None:
    """Return the error that displaced surfaces are apart, and never meet. Collective.

    They look the same way at all nodes: no small turn of either surface lets them meet. Or the
    bodies are inside each other, and no other contact is between them.
    """
    comm = contact_set.boundary.nodes.comm
    for parts in contacts_apart(contact_set, uh):
        if isinstance(parts[0].contact, Patch):
            continue
        along = np.concatenate([_along_normals(part, contact_set, uh) for part in parts])
        nodes, name = comm.allreduce(along.size), parts[0].conditions.name
        is_pair = parts[0].conditions.master_surface is not None
        if nodes and not any_rank(comm, along < _SAME_WAY):
            if not is_pair:
                return points_away(name, nodes)
            return InputError(
                f"{name}: slave and master have not met, and look the same way at all {nodes} "
                "slave nodes: the outward normals of surfaces that touch point against each other. "
                "Is one of the tags on the far side of its body, or on another body?"
            )
        if is_pair and (place := _place_inside(parts[0], contact_set, uh, bodies)):
            return InputError(
                f"{name}: slave and master have not met, and one of the bodies is inside the other "
                f"at {place}. Is one of the tags on another side of its body? Bodies are kept "
                "apart where surfaces with the tags are opposite each other"
            )
    return None


def _place_inside(
    found: FoundContact, contact_set: ContactSet, uh: Function, bodies: Bodies
) -> str:
    """Return a place of a surface inside the other body, or an empty text. Collective.

    Bodies that other contacts, or ties, keep apart or together may be inside each other a little.
    """
    boundary = contact_set.boundary.deformed(uh)
    sides = _bodies_of(found.contact, contact_set, bodies)
    others: list[Contact | Tie] = [entry.tie for entry in contact_set.ties]
    others += [entry.contact for entry in contact_set.contacts if entry.number != found.number]
    joined = [_bodies_of(other, contact_set, bodies) for other in others]
    between = any(sides[0] & x[k] and sides[1] & x[1 - k] for x in joined for k in (0, 1))
    if sides[0] & sides[1] or between:
        return ""
    surfaces = [surface.on(boundary) for surface in found.conditions.surfaces]
    for surface, other in zip(surfaces, sides[::-1], strict=True):
        x, size = (concatenate_ranks(surface.comm, each) for each in (surface.points, surface.size))
        distance = _boundary_of(boundary, bodies, other).distance(x).signed
        if (distance < -_DEPTH * size).any():
            return format_point(x[distance.argmin()])
    return ""


def _opposite(found: FoundContact, contact_set: ContactSet, uh: Function) -> int:
    """Return the number of this rank's nodes with something opposite. Collective."""
    if found.conditions.master_surface is not None:
        return found.conditions.gap.size
    return int((_along_normals(found, contact_set, uh) < 0.0).sum())


def _along_normals(found: FoundContact, contact_set: ContactSet, uh: Function) -> Vector:
    """Return cosines (k,) of this rank's normals and those of what is nearest. Collective.

    Nodes without an obstacle have none.
    """
    slave, *masters = (_displaced(surface, uh) for surface in found.conditions.surfaces)
    if not masters:
        contact = found.contact_at(contact_set.bodies)
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


def _bodies_of(
    user: Contact | Tie, contact_set: ContactSet, bodies: Bodies
) -> tuple[set[int], set[int]]:
    """Return the bodies on both sides of a contact or tie of tagged surfaces. Collective."""
    domain = contact_set.boundary.space.mesh
    sides = list[set[int]]()
    for name in ("slave", "master"):
        found = np.zeros(0, dtype=np.int64)
        if hasattr(user, "facet_tags") and hasattr(user, name):
            facets = owned_facets(domain, user.facet_tags, getattr(user, name))
            cells = cells_of_facets(domain, facets)[0]
            found = bodies.of_cell[cells[cells < bodies.of_cell.size]]
        sides.append(set(concatenate_ranks(domain.comm, np.unique(found)).tolist()))
    return sides[0], sides[1]


def _boundary_of(boundary: MeshBoundary, bodies: Bodies, chosen: set[int]) -> FacetedSurface:
    """Return all facets around some bodies. Collective."""
    domain, nodes = boundary.space.mesh, boundary.nodes
    facets = np.flatnonzero(boundary.exterior).astype(np.int32)
    cells = cells_of_facets(domain, facets)[0]
    is_own = cells < bodies.of_cell.size
    facets, cells = facets[is_own], cells[is_own]
    facets = facets[np.isin(bodies.of_cell[cells], list(chosen))]
    rows = oriented_facets(boundary.space, facets)
    x = boundary.coordinates[rows.ravel(), : domain.geometry.dim]
    numbers, points = (concatenate_ranks(domain.comm, part) for part in (nodes.to_global(rows), x))
    _, first, inverse = np.unique(numbers, return_index=True, return_inverse=True)
    return FacetedSurface.of(Facets(points[first], inverse.reshape(numbers.shape)))

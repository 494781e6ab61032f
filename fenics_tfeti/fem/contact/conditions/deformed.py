"""Contact conditions in the deformed state, for exact non-penetration (sec. 11.1, 11.11.2).

The linearised condition (11.1) is exact if its normals are those of the deformed state and the
partners are opposite each other in it. Here normals and gaps are measured on the deformed surfaces,
between their facets, and nodes that slid get new partners. A pass has the misfit of a solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.contact_conditions import ContactConditions, Terms
from fenics_tfeti.fem.contact.conditions.obstacle import conditions_at_obstacles
from fenics_tfeti.fem.contact.conditions.surface_pairs import MortarPairs
from fenics_tfeti.fem.contact.descriptions.contacts import Contact, ContactPair, RigidObstacle
from fenics_tfeti.fem.contact.surfaces.normals import without_axial_tilt
from fenics_tfeti.fem.contact.surfaces.rotations import SurfaceRotations, carried
from fenics_tfeti.fem.contact.surfaces.surface_facets import SurfaceFacets
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, Surface, gather_surfaces
from fenics_tfeti.fem.displacement import owned_values
from fenics_tfeti.fem.geometry.faceted import FacetedSurface
from fenics_tfeti.fem.geometry.vectors import tangential_part
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Numbers, Vector

# joined pairs with the positions of their contacts among all of them
MortarsByNormals: TypeAlias = list[tuple[MortarPairs, list[int]]]


@dataclass(frozen=True)
class DeformedContact:
    """A contact in the deformed state, at the k slave nodes of its conditions before."""

    # with the conditions of the deformed surfaces, whose gaps are bounds of the total displacement:
    # between nodes with the partners that are opposite now, of mortars at other nodes perhaps
    conditions: ContactConditions
    before: ContactConditions
    gap: Vector  # distance from the master or obstacle at the new conditions; negative inside [m]
    # depth in the master body or obstacle at the new conditions; 0 outside [m]
    penetration: Vector
    boundary: MeshBoundary  # deformed

    @cached_property
    def normal(self) -> Vector:
        """Deformed outward unit normals (k, gdim); those before without new condition."""
        normal, (old_rows, new_rows) = self.before.normal.copy(), self._common_rows
        normal[old_rows] = self.conditions.normal[new_rows]
        return normal

    @cached_property
    def distance(self) -> Vector:
        """Distance (k,) from the master or obstacle along the normal; negative inside [m].

        A node that slid off the master or obstacle is as far from it as its facets are large.
        """
        distance, (old_rows, new_rows) = self._facet_size, self._common_rows
        distance[old_rows] = self.gap[new_rows]
        return distance

    @cached_property
    def slip(self) -> Vector | None:
        """Distance (k,) along the surface, relative to the facets' size; None without mortars.

        It is that between the parts of the master that the conditions before and the new ones
        couple. The first time collective.
        """
        if not self.before.is_mortar:
            return None
        size, (old_rows, new_rows) = self._facet_size, self._common_rows
        # mean places on the slave, less those on the master
        x = self.boundary.coordinates[:, : self.boundary.nodes.components]
        offset = self.before.relative(x)[old_rows] - self.conditions.relative(x)[new_rows]
        offset = tangential_part(offset, self.normal[old_rows])
        slip = np.ones_like(size)
        slip[old_rows] = np.linalg.norm(offset, axis=1) / size[old_rows]
        return slip

    @property
    def _facet_size(self) -> Vector:
        return self.before.surface.size[self.before.on_surface]

    @cached_property
    def _common_rows(self) -> tuple[Numbers, Numbers]:
        """The rows before and now of nodes that have conditions in both."""
        slaves = self.before.slave, self.conditions.slave
        _, old_rows, new_rows = np.intersect1d(*slaves, return_indices=True)
        return old_rows, new_rows


def deformed_contacts(
    contacts: Sequence[tuple[Contact, ContactConditions]],
    displacement: Function,
    turns_normals: bool = True,
    mortars: MortarsByNormals | None = None,
) -> list[DeformedContact]:
    """Measure normals, gaps and penetration in the deformed state; update ghosts. Collective.

    The normal at a node is the integral of the deformed facets' normal times the node's shape
    function, or the user's, turned with the facets or as it is. The gap to a master is along it,
    see `FacetedSurface.gap_along`; that to an obstacle is what the obstacle returns. The joined
    surfaces of mortar conditions may be known.
    """
    with raise_collectively(displacement.function_space.mesh.comm):
        if not np.isfinite(owned_values(displacement)).all():
            raise InputError("the displacement is NaN or infinite at some nodes")
    displacement.x.scatter_forward()
    if not contacts:
        return []
    boundary = contacts[0][1].surface.boundary.deformed(displacement)
    turned = [
        _turned(contact, conditions, boundary, turns_normals) for contact, conditions in contacts
    ]
    normals, axes = zip(*turned, strict=True)
    found = dict[int, tuple[ContactConditions, Vector]]()
    for joined, members in mortars_by_normals(contacts) if mortars is None else mortars:
        before = [contacts[k][1] for k in members]
        user_normals = [x for x in (normals[k] for k in members) if x is not None] or None
        for k, new in zip(members, joined.at(boundary, before, user_normals), strict=True):
            found[k] = new.across(axes[k]), np.maximum(-new.gap, 0.0)
    # pairs of nodes have partners on any rank
    masters = {
        k: conditions.master_surface.on(boundary)
        for k, (_, conditions) in enumerate(contacts)
        if conditions.master_surface is not None and k not in found
    }
    whole = dict(zip(masters, gather_surfaces([*masters.values()]), strict=True))
    u = boundary.nodes.values(displacement)
    measured = []
    for k, (contact, conditions) in enumerate(contacts):
        surface = conditions.surface
        new, depth = found.get(k) or _deformed(
            contact, conditions, *turned[k], whole.get(k), boundary
        )
        moved = np.sum(new.relative(u) * new.normal, axis=1)
        distance, depth, gap = map(surface.without_rounding, (new.gap, depth, new.gap + moved))
        total = replace(new, gap=gap, made_on=boundary)
        measured.append(DeformedContact(total, conditions, distance, depth, boundary))
    return measured


def mortars_by_normals(
    contacts: Sequence[tuple[Contact, ContactConditions]],
) -> MortarsByNormals:
    """Join the surfaces of mortar conditions, without and with normals of the user. Collective.

    With them are the positions of the contacts.
    """
    joined = []
    for has_normal in (False, True):
        pairs = {
            k: (contact, conditions)
            for k, (contact, conditions) in enumerate(contacts)
            if isinstance(contact, ContactPair)
            and conditions.is_mortar
            and (contact.normal is not None) == has_normal
        }
        if pairs:
            joined.append((MortarPairs.of([*pairs.values()]), [*pairs]))
    return joined


def _turned(
    contact: Contact, conditions: ContactConditions, boundary: MeshBoundary, turns_normals: bool
) -> tuple[Vector | None, Vector | None]:
    """Return the user's normals, and axes of a round surface, on a deformed boundary. Collective.

    They are (s, gdim) at the surface's nodes, if there are any, turned with the facets. Normals may
    be as they are.
    """
    surface, axes = conditions.surface, conditions.axes
    normal = None
    if isinstance(contact, ContactPair) and contact.normal is not None:
        normal = surface.normal
        if turns_normals:
            normal = SurfaceRotations.of(surface, boundary).turned(normal)
    return normal, None if axes is None else carried(surface, boundary, axes)


def _deformed(
    contact: Contact,
    conditions: ContactConditions,
    user_normal: Vector | None,
    axes: Vector | None,
    master: SurfaceFacets | None,
    boundary: MeshBoundary,
) -> tuple[ContactConditions, Vector]:
    """Return new conditions node by node, and depths of penetration there. Collective.

    The gaps are distances of the deformed surfaces, from all of the master's.
    """
    surface = conditions.surface
    if user_normal is None:
        surface = surface.on(boundary).with_present_normals()
    else:
        surface = surface.on(boundary, user_normal)
    if master is None:
        assert isinstance(contact, RigidObstacle)
        new = replace(conditions, **vars(conditions_at_obstacles(surface, [contact.obstacle])))
        return new, np.maximum(-new.gap, 0.0)
    if user_normal is None:
        surface = surface.with_normals_of(conditions.covered)
    if axes is not None:
        surface = replace(surface, normal=without_axial_tilt(surface.normal, axes))
    return _deformed_pairs(conditions, surface, master)


def _deformed_pairs(
    conditions: ContactConditions, surface: Surface, master: SurfaceFacets
) -> tuple[ContactConditions, Vector]:
    """Return new pairs of nodes and depths, with the slave's deformed surface. Collective."""
    rows, partner = conditions.on_surface, np.searchsorted(master.nodes, conditions.master)
    x, normal = surface.points[rows], surface.normal[rows]
    distance, signed = FacetedSurface.of(master.facets).gap_along(x, normal)
    # a partner is kept unless its distance from where the normal meets the master is more than 1.5
    # times that of the nearest node: otherwise the passes could alternate between two nodes
    foot = x + distance[:, None] * normal
    closest, nearest = cKDTree(master.points).query(foot)
    current = np.linalg.norm(master.points[partner] - foot, axis=1)
    partner = np.where(current > 1.5 * closest, nearest, partner)
    terms = Terms.of_nodes(conditions.slave, master.nodes[partner])
    area = surface.areas(conditions.covered)[rows]
    new = replace(conditions, terms=terms, normal=normal, gap=distance, area=area)
    return new, np.maximum(-signed, 0.0)

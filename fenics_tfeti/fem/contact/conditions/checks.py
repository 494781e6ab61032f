"""Checks of contacts that join the same surfaces, or whose surfaces are too deep."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np

from dolfinx.fem import FunctionSpace

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.contact_conditions import ContactConditions
from fenics_tfeti.fem.contact.conditions.surface_pairs import check_covered
from fenics_tfeti.fem.contact.descriptions.contacts import Contact, ContactPair
from fenics_tfeti.fem.contact.descriptions.surfaces import surface_key, surface_tags
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.messages import first_wrong
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import Tag, cell_vertices, each_tag
from fenics_tfeti.parallel import largest_of_groups, raise_collectively
from fenics_tfeti.typing import Vector


def check_different_surfaces(contacts: Sequence[Contact], comm: MPI.Intracomm) -> None:
    """Check that no two pairs join the same two surfaces, in either role."""
    pairs: dict[frozenset[tuple[int, Tag]], int] = {}
    with raise_collectively(comm):
        for number, contact in enumerate(contacts):
            if not isinstance(contact, ContactPair):
                continue
            tags = sorted(surface_tags(contact), key=each_tag)
            surfaces = frozenset(surface_key(contact.facet_tags, tag) for tag in tags)
            if surfaces in pairs:
                raise InputError(
                    f"contacts {pairs[surfaces]} and {number} join the same two surfaces, with "
                    f"slave and master {tags}: keep one of them"
                )
            pairs[surfaces] = number


def check_opposite(all_conditions: Sequence[Sequence[ContactConditions]]) -> None:
    """Check that surfaces have another one or an obstacle opposite them. Collective.

    The conditions are those of the parts of each contact.
    """
    mortars = [parts for parts in all_conditions if any(part.is_mortar for part in parts)]
    check_covered(
        [parts[0].surface for parts in mortars],
        [sum(int(part.covered.sum()) for part in parts) for parts in mortars],
        [sum(part.gap.size for part in parts) for parts in mortars],
    )
    for conditions in (
        part for parts in all_conditions for part in parts if part.master_surface is None
    ):
        near = np.isfinite(conditions.gap)
        facing = (
            np.sum(conditions.normal * conditions.surface.normal[conditions.on_surface], axis=1)
            > 0.0
        )
        counts = np.array([near.sum(), (near & facing).sum()])
        total, faced = conditions.surface.comm.allreduce(counts).tolist()
        if total and not faced:
            raise points_away(conditions.name, total)


def points_away(name: str, nodes: int) -> InputError:
    """Return the error that an obstacle's normal points away from the body at all nodes."""
    return InputError(
        f"{name}: the obstacle's normal points away from the body at all {nodes} nodes. It has "
        "to point out of the obstacle, towards the body: change its sign (for a Sphere or "
        "Cylinder around the body, hollow=True)"
    )


def check_depth(
    space: FunctionSpace, bodies: Bodies, all_conditions: Sequence[ContactConditions]
) -> None:
    """Check that no slave node is deeper in its master than either body is thick. Collective.

    So deep are surfaces that lie back to back, each on the far side of its body. The thickness is
    that of the body's bounding box along the normal.
    """
    comm, gdim = space.mesh.comm, space.mesh.geometry.dim
    rows = [np.flatnonzero((p.master >= 0) & (p.gap < 0.0)) for p in all_conditions]
    contact = np.repeat(np.arange(len(rows)), [part.size for part in rows])
    if not comm.allreduce(contact.size):
        return
    slave, master, normal, gap, points = (
        np.concatenate(
            [getattr(p, name)[part] for p, part in zip(all_conditions, rows, strict=True)]
        )
        for name in ("slave", "master", "normal", "gap", "coordinates")
    )
    size = _sizes_of_bodies(space, bodies)
    nodes = NodeMap(space)
    body = nodes.reduced_over_cells(bodies.of_cell, np.maximum)
    of_ends = size[nodes.values_at(body, np.stack([slave, master]))]
    thickness = np.sum(np.abs(normal) * of_ends, axis=2).min(axis=0)
    names = [conditions.name for conditions in all_conditions]
    if bad := first_wrong(comm, -gap > thickness, points[:, :gdim], contact, names):
        deepest = -comm.allreduce(float(gap[contact == bad.contact].min(initial=0.0)), MPI.MIN)
        raise InputError(
            f"{bad.name}: {bad.number} slave nodes are deeper in the master than one of the bodies "
            f"is thick, by up to {deepest:.3g}, the first at {bad.place}. "
            "Surfaces that touch face each other: is one of the tags on the far side of its body?"
        )


def _sizes_of_bodies(space: FunctionSpace, bodies: Bodies) -> Vector:
    """Return the edges of the bodies' bounding boxes, (bodies, gdim). Collective."""
    cells = cell_vertices(space.mesh)[: bodies.of_cell.size]
    x = space.mesh.geometry.x[cells, : space.mesh.geometry.dim]
    ends = np.hstack([x.max(axis=1), -x.min(axis=1)])
    largest = largest_of_groups(space.mesh.comm, ends, bodies.of_cell, len(bodies.names), -np.inf)
    return np.add(*np.split(largest, 2, axis=1))

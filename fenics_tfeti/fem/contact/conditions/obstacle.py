"""Conditions of a surface at a rigid obstacle: node by node, for degree 2 in the mean around nodes.

On the undeformed surface, and on the deformed one for exact non-penetration.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

from mpi4py import MPI

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.contact_conditions import (
    ContactConditions,
    ObstacleConditions,
    Terms,
    separated,
)
from fenics_tfeti.fem.contact.conditions.mortars import one_sided_conditions
from fenics_tfeti.fem.contact.conditions.summary import matching_summaries
from fenics_tfeti.fem.contact.descriptions.contacts import RigidObstacle
from fenics_tfeti.fem.contact.descriptions.shapes import (
    Cylinder,
    FacetedObstacle,
    Obstacle,
    Plane,
    Sphere,
)
from fenics_tfeti.fem.contact.descriptions.surfaces import surface_tags
from fenics_tfeti.fem.contact.surfaces.tagged import (
    MeshBoundary,
    Surface,
    joined_surfaces,
    tagged_surfaces,
)
from fenics_tfeti.fem.geometry.vectors import angles_between, tangential_part, unit
from fenics_tfeti.fem.messages import first_wrong
from fenics_tfeti.fem.tolerances import NO_OBSTACLE, NOT_GRADIENT, UNIT_LENGTH
from fenics_tfeti.fem.user_data import evaluate
from fenics_tfeti.parallel import raise_collectively, warn_on_first_rank
from fenics_tfeti.typing import Numbers, Vector

# step of the differences by which gradients of gaps are found, relative to the facets' edges
_STEP = 1e-4


def match_obstacles(
    boundary: MeshBoundary,
    contacts: Sequence[tuple[str, RigidObstacle]],
    earlier: Sequence[ContactConditions | None],
    deformed: MeshBoundary | None = None,
) -> list[ContactConditions]:
    """Find the slaves' nodes, the obstacles' normals and the gaps, this rank's part. Collective.

    The contacts have names. The surfaces of earlier results are used again. With a deformed
    boundary the obstacles are evaluated on the surfaces there alone.
    """
    if not contacts:
        return []
    slaves = _slaves(boundary, contacts, earlier)
    slave = surface = joined_surfaces(boundary, slaves)
    if deformed is not None:
        surface = slave.on(slave.boundary.moved_as(deformed)).with_present_normals()
    obstacles = [contact.obstacle for _, contact in contacts]
    found = conditions_at_obstacles(surface, obstacles)
    for single, obstacle, last in zip(slaves, obstacles, earlier, strict=True):
        if last is None:
            _warn_of_normals(single, obstacle, deformed or boundary)
    rows = slave.rows_of(found.terms.slave)
    of_rows, angle = slave.contact[rows], angles_between(surface.normal[rows], found.normal)
    gap = slave.without_rounding(found.gap, of_rows)
    summaries = matching_summaries(
        slave.comm, slave.names, "obstacle", of_rows, gap, angle, slave.contact, area=found.area
    )
    parts = separated(boundary, slave, found, gap)
    return [
        ContactConditions(summary=summary, surface=single, **part)
        for summary, single, part in zip(summaries, slaves, parts, strict=True)
    ]


def _slaves(
    boundary: MeshBoundary,
    contacts: Sequence[tuple[str, RigidObstacle]],
    earlier: Sequence[ContactConditions | None],
) -> list[Surface]:
    """Return the surface of each contact, that of an earlier result if there is one. Collective."""
    tagged = [
        (contact.facet_tags, *surface_tags(contact), name)
        for (name, contact), last in zip(contacts, earlier, strict=True)
        if last is None
    ]
    new = iter(tagged_surfaces(boundary, tagged, "slave"))
    return [
        # a contact without name is called by its number, which may be another one
        next(new) if last is None else replace(last.surface, names=[name])
        for (name, _), last in zip(contacts, earlier, strict=True)
    ]


def conditions_at_obstacles(surface: Surface, obstacles: Sequence[Obstacle]) -> ObstacleConditions:
    """Return the conditions of surfaces with their normals, deformed or not. Collective.

    There is an obstacle for each contact of the surface. Conditions of degree 2 are means over the
    facets that are opposite it.
    """
    places, nodes = surface.coordinates, surface.boundary.nodes
    if surface.boundary.degree == 1:
        gap, outward = gaps_and_normals(surface, obstacles, places, surface.normal, surface.contact)
        terms, covered = Terms.of_nodes(surface.nodes), surface.whole
        area, coverage = surface.areas(covered), np.ones_like(gap)
        return ObstacleConditions(terms, -outward, gap, area, coverage, covered)
    facets = surface.oriented_part()
    normals = unit(facets.from_corners(facets.normal))
    contact = facets.facets.contact_of(np.arange(len(facets.nodes)))
    nodal, _ = gaps_and_normals(surface, obstacles, _padded(facets.points), normals, contact)
    covered = np.isfinite(nodal)[facets.facets.nodes].all(axis=1)
    terms = one_sided_conditions(surface, facets, covered)
    rows = surface.rows_of(terms.slave)
    if facets.weight is not None:
        surface.check_weight(terms.scale, rows)
    _, outward = gaps_and_normals(
        surface, obstacles, places[rows], surface.normal[rows], surface.contact[rows]
    )
    # the nodes of a condition may be on facets of several ranks
    at_owners = nodes.reduce_at_owners(facets.nodes, nodal, np.maximum)
    gap = terms.means(nodes.values_at(at_owners, terms.nodes)[:, None])[:, 0]
    coverage = np.ones_like(gap)
    return ObstacleConditions(terms, -outward, gap, terms.scale, coverage, covered)


def _warn_of_normals(slave: Surface, obstacle: Obstacle, boundary: MeshBoundary) -> None:
    """Warn where a user's normal has not the direction of the gap's gradient. Collective.

    That is where the gap is least. Of the differences forwards and backwards the better one counts:
    the gap may have kinks.
    """
    if isinstance(obstacle, Plane | Sphere | Cylinder | FacetedObstacle):
        return
    # without a normal of the user there is none to check
    places, outward = slave.on(boundary).coordinates, np.full_like(slave.normal, np.nan)
    gradient, gap = np.zeros_like(outward), np.full(len(places), np.inf)
    with suppress(InputError), np.errstate(invalid="ignore"):
        # what may fail beside the surface alone says nothing
        gap, outward = _evaluate_obstacle(obstacle, places, outward, slave.names[0])
        for axis, slope in enumerate(gradient.T):
            step = np.zeros_like(places)
            step[:, axis] = _STEP * slave.size
            forwards, backwards = (
                (_evaluate_obstacle(obstacle, places + x, outward, slave.names[0])[0] - gap)
                / x[:, axis]
                for x in (step, -step)
            )
            is_nearer = np.abs(forwards - outward[:, axis]) < np.abs(backwards - outward[:, axis])
            slope[:] = np.where(is_nearer, forwards, backwards)
    least = slave.comm.allreduce(gap.min(initial=np.inf), MPI.MIN)
    with np.errstate(invalid="ignore"):
        across = np.linalg.norm(tangential_part(gradient, outward), axis=1)
        tilted = across > NOT_GRADIENT * np.maximum(1.0, np.linalg.norm(gradient, axis=1))
        wrong = (gap - least <= slave.size) & tilted
    messages = []
    if bad := slave.first_wrong(wrong):
        messages = [
            f"{slave.names[0]}: the obstacle's normal is not the gradient of its gap at "
            f"{bad.number} nodes, the first at {bad.place}. Forces act along the normal, in which "
            "the distance has to grow fastest"
        ]
    warn_on_first_rank(slave.comm, *messages)


def _padded(points: Vector) -> Vector:
    """Return points (k, gdim) as rows of three coordinates."""
    return np.pad(points, ((0, 0), (0, 3 - points.shape[1])))


def gap_and_normal(
    surface: Surface, obstacle: Obstacle, points: Vector, normal: Vector
) -> tuple[Vector, Vector]:
    """Return the gaps (k,) to an obstacle and its unit normals (k, gdim), checked. Collective.

    The normal is the body's (k, gdim). Where there is no obstacle, the distance is infinite and the
    obstacle's normal the opposite of the body's.
    """
    contact = np.zeros(len(points), dtype=np.int64)
    return gaps_and_normals(surface, [obstacle], points, normal, contact)


def gaps_and_normals(
    surface: Surface,
    obstacles: Sequence[Obstacle],
    points: Vector,
    normal: Vector,
    contact: Numbers,
) -> tuple[Vector, Vector]:
    """Return the same for points of several contacts (k,), each with its obstacle. Collective."""
    comm, names, gdim = surface.comm, surface.names, normal.shape[1]
    gap, outward = np.zeros(len(points)), np.zeros_like(normal)
    order = np.argsort(contact, kind="stable")
    ends = np.searchsorted(contact[order], np.arange(1, len(obstacles)))
    with raise_collectively(comm):
        for obstacle, name, rows in zip(obstacles, names, np.split(order, ends), strict=True):
            gap[rows], outward[rows] = _evaluate_obstacle(
                obstacle, points[rows], normal[rows], name
            )
    nothing = gap >= NO_OBSTACLE
    gap = np.where(nothing, np.inf, gap)
    outward = np.where(nothing[:, None], -normal, outward)
    wrong = ~((np.isfinite(gap) | nothing) & np.isfinite(outward).all(axis=1))
    if bad := first_wrong(comm, wrong, points[:, :gdim], contact, names):
        raise InputError(
            f"{bad.name}: the obstacle's gap is NaN or -inf, or its normal is NaN or infinite, at "
            f"{bad.number} points, the first at {bad.place}. Only the gap may be +inf, where there "
            "is no obstacle"
        )
    length = np.linalg.norm(outward, axis=1)
    wrong = np.abs(length - 1.0) > UNIT_LENGTH
    if bad := first_wrong(comm, wrong, points[:, :gdim], contact, names):
        raise InputError(
            f"{bad.name}: the obstacle's normal is not a unit vector in {gdim} dimensions at "
            f"{bad.number} points, the first at {bad.place}. Divide it by its length"
        )
    return gap, outward / length[:, None]


def _evaluate_obstacle(
    obstacle: Obstacle, points: Vector, normal: Vector, name: str
) -> tuple[Vector, Vector]:
    """Return gap (k,) and normal (k, gdim) from the user's function."""
    k, gdim = normal.shape
    if k == 0:  # a user's function may fail for no points
        return np.zeros(0), np.zeros((0, gdim))
    values = evaluate(obstacle, points, f"{name}: the obstacle")
    try:
        is_pair = isinstance(values, tuple | list) and len(values) == 2 and np.ndim(values[1]) > 0
        gap, outward = (
            np.asarray(part, dtype=float) for part in (values if is_pair else (values, -normal.T))
        )
    except (TypeError, ValueError):
        raise InputError(
            f"{name}: the obstacle has to return (gap, normal), or the gap alone"
        ) from None
    if gap.shape != (k,) or outward.shape not in ((gdim, k), (3, k)):
        raise InputError(
            f"{name}: for points of shape (3, {k}) the obstacle returned a gap of shape "
            f"{gap.shape} and a normal of shape {outward.shape}; expected ({k},) and ({gdim}, {k})"
        )
    return gap, outward[:gdim].T

"""Contacts in the error of the mesh: their facets, and the work of pressures over open gaps."""

from __future__ import annotations

import numpy as np

from fenics_tfeti.errors import first_few
from fenics_tfeti.fem.contact.conditions.obstacle import gap_and_normal
from fenics_tfeti.fem.contact.contact_set import FoundContact, FoundTie
from fenics_tfeti.fem.contact.descriptions.contacts import ContactPair, RigidObstacle
from fenics_tfeti.fem.contact.descriptions.surfaces import surface_tags
from fenics_tfeti.fem.contact.solution.results import ContactResult
from fenics_tfeti.fem.contact.solution.solved import SolvedContacts
from fenics_tfeti.fem.geometry.reference_cells import shape_values
from fenics_tfeti.fem.mesh_error.faces import CellFaces, FacetRule
from fenics_tfeti.fem.mesh_error.tractions import over_ranks
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import Tag, dense_tags, each_tag
from fenics_tfeti.parallel import any_rank
from fenics_tfeti.typing import Mask, Numbers, Vector

# deviation of an obstacle's gap from a quadratic function, relative to the size of a facet, that is
# a jump
_JUMP = 0.05
# angle by which normals turn inside facets of curved surfaces [rad]
_TURN = 0.01
# contacts that a remark names
_NAMES = 4


def facets_of(faces: CellFaces, nodes: NodeMap, entry: FoundContact | FoundTie) -> Mask:
    """Tell which facets (k, f) are on the surfaces of a contact or tie. Collective.

    Conditions without surfaces are on the facets all of whose nodes they are at.
    """
    user = entry.contact if isinstance(entry, FoundContact) else entry.tie
    if hasattr(user, "facet_tags"):
        return tagged(faces, user.facet_tags, surface_tags(user))
    assert isinstance(entry, FoundTie)
    numbers = np.unique(entry.conditions.rows.nodes)
    marks = nodes.reduce_at_owners(
        numbers[numbers < nodes.total], np.ones(numbers.size, dtype=bool)
    )
    mask = np.zeros(nodes.size, dtype=bool)
    mask[: nodes.owned] = marks > 0
    is_at = over_ranks(nodes, mask, np.logical_or)[faces.nodes]
    return np.stack([is_at[:, closure].all(axis=1) for closure in faces.closure], axis=1)


def tagged(faces: CellFaces, facet_tags: object, tags: list[Tag]) -> Mask:
    """Tell which facets (k, f) have one of some tags."""
    index_map = faces.space.mesh.topology.index_map(faces.dim - 1)
    dense = dense_tags(facet_tags, index_map.size_local + index_map.num_ghosts)
    return np.isin(dense[faces.facets], [t for tag in tags for t in each_tag(tag)])


def gap_energies(
    faces: CellFaces, nodes: NodeMap, solved: SolvedContacts, is_exact: bool
) -> Vector:
    """Return the integrals 2 p (gap - u_n)_+ over the slave's facets, by cell (k, 2) [J].

    Soft contact with an obstacle has in place of it twice what its energy and that of the pressure
    are more than the work of this. First over all facets with a pressure, second over those alone
    all of whose vertices have one. The pressure p, over undeformed areas, is linear between nodes.
    Gaps are `is_exact` those of the deformed surfaces. Collective.
    """
    total = np.zeros((faces.size, 2))
    weight = solved.contact_set.boundary.nodal_weight()
    for found, result in zip(solved.contact_set.contacts, solved.contacts, strict=True):
        assert isinstance(found.contact, ContactPair | RigidObstacle)
        pressure = at_local_nodes(nodes, result.dofs, np.maximum(result.nominal_pressure, 0.0))
        on_slave = tagged(faces, found.contact.facet_tags, surface_tags(found.contact)[:1])
        k, f = _touching(faces, on_slave, pressure > 0.0)
        corners, at_points = pressure[faces.corners_at((k, f))], _linear(faces)[f]
        p = np.einsum("kqv,kv->kq", at_points, corners)
        weighted = faces.weighted_normals(k)[np.arange(k.size), f]
        size = np.linalg.norm(weighted, axis=2)
        if isinstance(found.contact, RigidObstacle):
            gap, _ = distances_to_obstacle(
                faces, found, solved, (k, f), weighted / size[..., None], is_exact
            )
        else:
            gap = _gaps_between_nodes(faces, nodes, result, (k, f))
        if weight is not None:
            size = size * np.einsum("kqv,kv->kq", at_points, weight[faces.corners_at((k, f))])
        soft = np.einsum("kqv,kv->kq", at_points, _softness(faces, nodes, found, result, (k, f)))
        values = np.sum(_work(p, np.where(np.isfinite(gap), gap, 0.0), soft) * size, axis=1)
        np.add.at(total[:, 0], k, values)
        np.add.at(total[:, 1], k, np.where((corners > 0.0).all(axis=1), values, 0.0))
    return total


def _softness(
    faces: CellFaces,
    nodes: NodeMap,
    found: FoundContact,
    result: ContactResult,
    facets: tuple[Numbers, Numbers],
) -> Vector:
    """Return penetrations over pressures at the corners of facets (k, v) [m/Pa]. Collective.

    Gaps between surfaces are known at nodes alone, where penetrations follow from the pressures.
    """
    if found.law is None or not isinstance(found.contact, RigidObstacle):
        return np.zeros(faces.corners_at(facets).shape)
    softness = found.law.compliance[:, 0] * found.conditions.area
    return at_local_nodes(nodes, result.dofs, softness)[faces.corners_at(facets)]


def _work(p: Vector, gap: Vector, soft: Vector) -> Vector:
    """Return what pressures over gaps add to the square of the error [J/m^2], where these are soft.

    It is zero for penetrations `soft` * p, and for larger ones, as it is with hard contact.
    """
    positive = np.where(soft > 0.0, soft, 1.0)
    penetrating = np.maximum(soft * p + gap, 0.0) ** 2 / positive
    apart = soft * p**2 + 2.0 * p * np.maximum(gap, 0.0)
    return np.where((soft > 0.0) & (gap < 0.0), penetrating, apart)


def remarks(faces: CellFaces, nodes: NodeMap, solved: SolvedContacts, is_exact: bool) -> list[str]:
    """Say at which contacts estimates of degree 2 are too small. Collective.

    Conditions are means over facets there: they do not see where a gap jumps inside a facet, or how
    surfaces curve between nodes.
    """
    if faces.degree == 1:
        return []
    jumps, curved = list[str](), list[str]()
    for found, result in zip(solved.contact_set.contacts, solved.contacts, strict=True):
        assert isinstance(found.contact, ContactPair | RigidObstacle)
        on_slave = tagged(faces, found.contact.facet_tags, surface_tags(found.contact)[:1])
        pressure = at_local_nodes(nodes, result.dofs, result.pressure)
        facets = _around(faces, nodes, on_slave, pressure > 0.0)
        is_obstacle = isinstance(found.contact, RigidObstacle)
        marks = (
            _jumps(faces, found, solved, facets, is_exact)
            if is_obstacle
            else _is_curved(faces, facets)
        )
        if any_rank(nodes.comm, marks):
            (jumps if is_obstacle else curved).append(repr(found.conditions.name))
    told = []
    if jumps:
        told.append(f"too small at {_listed(jumps)}, where the gap jumps: take degree 1")
    if curved:
        told.append(f"half of the error or more at the curved surfaces of {_listed(curved)}")
    return told


def _listed(names: list[str]) -> str:
    return ", ".join(first_few(list(dict.fromkeys(names)), _NAMES, "contacts"))


def _around(
    faces: CellFaces, nodes: NodeMap, on_slave: Mask, pressed: Mask
) -> tuple[Numbers, Numbers]:
    """Return the facets at nodes that are pressed, and their neighbours. Collective."""
    near = pressed
    for _ in range(2):
        facets = _touching(faces, on_slave, near)
        near = np.zeros(nodes.size, dtype=bool)
        near[faces.nodes_at(facets).ravel()] = True
        near = over_ranks(nodes, near, np.logical_or)
    return facets


def _touching(faces: CellFaces, on_slave: Mask, chosen: Mask) -> tuple[Numbers, Numbers]:
    """Return the facets on a slave that have a vertex among some nodes."""
    k, f = np.nonzero(on_slave)
    touching = chosen[faces.corners_at((k, f))].any(axis=1)
    return k[touching], f[touching]


def _jumps(
    faces: CellFaces,
    found: FoundContact,
    solved: SolvedContacts,
    facets: tuple[Numbers, Numbers],
    is_exact: bool,
) -> Mask:
    """Tell at which facets (k,) an obstacle's gap is far from its quadratic fit. Collective."""
    k, f = facets
    gaps = []
    for rule in (faces.rule, faces.node_rule):
        weighted = faces.weighted_normals(k, rule)[np.arange(k.size), f]
        size = np.linalg.norm(weighted, axis=2, keepdims=True)
        gap, _ = distances_to_obstacle(
            faces, found, solved, facets, weighted / size, is_exact, rule
        )
        gaps.append(gap)
    length = size.mean(axis=(1, 2)) ** (1.0 / (faces.dim - 1))
    finite = np.isfinite(np.hstack(gaps))
    inside, at_nodes = (np.where(np.isfinite(gap), gap, length[:, None]) for gap in gaps)
    # the points of all facets are at the same places of the reference facet
    traces = faces.rule.traces[0]
    nodal = inside @ np.linalg.pinv(traces).T
    far = np.abs(np.hstack([inside - nodal @ traces.T, at_nodes - nodal])).max(axis=1, initial=0.0)
    return np.asarray((far > _JUMP * length) & finite.any(axis=1))


def _is_curved(faces: CellFaces, facets: tuple[Numbers, Numbers]) -> Mask:
    """Tell whose normals turn inside facets."""
    k, f = facets
    weighted = faces.weighted_normals(k)[np.arange(k.size), f]
    normals = weighted / np.linalg.norm(weighted, axis=2, keepdims=True)
    turned = np.linalg.norm(normals - normals[:, :1], axis=2)
    return np.asarray(turned.max(axis=1, initial=0.0) > _TURN)


def at_local_nodes(nodes: NodeMap, dofs: Numbers, values: Vector) -> Vector:
    """Return values of owned nodes at all local nodes, zero where there are none. Collective."""
    local = np.zeros(nodes.size)
    local[dofs] = values
    return over_ranks(nodes, local)


def _linear(faces: CellFaces) -> Vector:
    """Return the linear shape functions (f, q, v) of the corners of facets."""
    name = faces.kind.name
    return np.array(
        [
            shape_values(name, 1, points)[:, corners]
            for points, corners in zip(faces.rule.points, faces.corners, strict=True)
        ]
    )


def distances_to_obstacle(
    faces: CellFaces,
    found: FoundContact,
    solved: SolvedContacts,
    facets: tuple[Numbers, Numbers],
    normal: Vector,
    is_exact: bool,
    rule: FacetRule | None = None,
) -> tuple[Vector, Vector]:
    """Return the distances (k, q) of points on facets to an obstacle [m], and its normals.

    Where there is none, they are infinite. Collective.
    """
    (k, f), d, rule = facets, faces.dim, rule or faces.rule
    shape = k.size, normal.shape[1], d
    x, u = np.zeros(shape), np.zeros(shape)
    nodal = solved.displacement.x.array.reshape(-1, d)[faces.nodes_at((k, f))]
    for number, points in enumerate(rule.points):
        on = f == number
        x[on] = faces.points(points, k[on])
        u[on] = rule.traces[number] @ nodal[on]
    bodies, surface = solved.bodies, found.conditions.surface
    contact = found.contact_at(bodies) if is_exact else found.contact
    assert isinstance(contact, RigidObstacle)
    places = (x + u if is_exact else x).reshape(-1, d)
    padded = np.pad(places, ((0, 0), (0, 3 - d)))
    gap, outward = gap_and_normal(surface, contact.obstacle, padded, normal.reshape(-1, d))
    if not is_exact:
        moved = u.reshape(-1, d)
        if contact.rigid_body is not None:
            frame = bodies.frame_of(contact.rigid_body)
            on_body = places - outward * np.where(np.isfinite(gap), gap, 0.0)[:, None]
            moved = moved - frame.displacements(frame.motion, on_body)
        gap = gap + np.sum(outward * moved, axis=1)
    return gap.reshape(shape[:2]), outward.reshape(shape)


def _gaps_between_nodes(
    faces: CellFaces, nodes: NodeMap, result: ContactResult, facets: tuple[Numbers, Numbers]
) -> Vector:
    """Return the openings (k, q) at points on facets, by those at nodes [m]. Collective."""
    finite = np.where(np.isfinite(result.opening), result.opening, 0.0)
    opening, (k, f) = at_local_nodes(nodes, result.dofs, finite), facets
    at_nodes = opening[faces.nodes_at((k, f))]
    return np.einsum("kqt,kt->kq", faces.rule.traces[f], at_nodes)

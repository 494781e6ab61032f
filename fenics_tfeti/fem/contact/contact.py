"""Contact surfaces: facet tags to matched nodes, normals and gaps (sec. 11.1, 11.5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.matching import (
    Match,
    along_direction,
    at_images,
    by_coordinates,
    nearest,
)
from fenics_tfeti.fem.contact.obstacles import Cylinder, Obstacle, Plane, Sphere, gap_and_normal
from fenics_tfeti.fem.contact.pairing import (
    angles_between,
    check_not_crossed,
    check_one_to_one,
    check_partners,
    pairing_entry,
)
from fenics_tfeti.fem.contact.surfaces import (
    GivenNormal,
    MasterNodes,
    MeshBoundary,
    Surface,
    area_of_facets,
    gather_master,
    tagged_surface,
    values_on_facets,
)
from fenics_tfeti.fem.contact.user_data import refuse_where
from fenics_tfeti.feti import ContactRows
from fenics_tfeti.parallel import concatenate_ranks, raise_collectively

__all__ = [
    "Contact",
    "ContactPair",
    "ContactResult",
    "Cylinder",
    "MatchedContact",
    "Plane",
    "RigidObstacle",
    "Sphere",
    "contact_name",
    "contact_rows",
    "match_contact",
    "match_contacts",
]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
VectorField = ArrayLike | Callable[[Vector], ArrayLike]

# of coordinates, relative to the largest one of the surface
_ROUNDING = 1e-13
# normals of one node in two contacts that are closer than this say the same [degrees]; others meet
# at an edge of the body
_EDGE_ANGLE = 45.0


@dataclass(frozen=True)
class ContactPair:
    """Two tagged surfaces that may touch but not penetrate each other.

    Each slave node meets one master node: the nearest one, unless `direction`, `mapping` or `pairs`
    says how to find it. The grids have to match up to `tolerance`. Where nobody meshed the surfaces
    alike, let the finer one, about twice as fine, be the master and raise the tolerance to 0.8;
    what still has no partner, over the rim of the master, can stay free by `partial`.

    Attributes
    ----------
    facet_tags : MeshTags
        Tags of facets.
    slave, master : int
        Tag of the slave's and of the master's surface.
    name : str
        For messages and the report.
    tolerance : float
        How far a master node may be from where its slave node looks for it, relative to the edges
        of the slave's facets there. The distance is along the surface to the nearest node, across
        the `direction`, from the `mapping`'s image, or from the points of `pairs` to the nodes.
    direction : (gdim,) array-like or callable, optional
        Partners are sought along this line, forwards and backwards, among the master nodes whose
        normals point against the slave's. A callable gets x (3, n) [m] and returns (gdim, n).
    mapping : callable, optional
        chi of sec. 11.1: x (3, n) -> (3, n), where the partner of each slave node is expected [m].
    pairs : (slave points, master points), optional
        Arrays (k, 3) of coordinates [m]: the pairs one by one. The same on all ranks.
    normal : (gdim,) array-like or callable, optional
        Outward normals of the slave, of any length; a callable gets x (3, n) and returns (gdim, n).
        By default the area-weighted average of the facets' normals at each node.
    partial : bool
        Whether slave nodes without partner, and those that belong to the master as well, stay free
        instead of being an error. They are counted in the report.
    """

    facet_tags: Any
    slave: int
    master: int
    name: str = ""
    tolerance: float = 0.1
    direction: VectorField | None = None
    mapping: Callable[[Vector], ArrayLike] | None = None
    pairs: tuple[ArrayLike, ArrayLike] | None = None
    normal: GivenNormal = None
    partial: bool = False


@dataclass(frozen=True)
class RigidObstacle:
    """A tagged surface that may touch but not penetrate a rigid obstacle.

    Attributes
    ----------
    facet_tags : MeshTags
        Tags of facets.
    slave : int
        Tag of the surface.
    obstacle : callable
        x -> (gap, normal) for points x of shape (3, n): the distance (n,) to the obstacle [m] and
        the unit normal (gdim, n) that points from the obstacle to the body. Or x -> gap, the
        distance along the surface's own outward normal. `Plane`, `Sphere` and `Cylinder` are such.
    name : str
        For messages and the report.
    """

    facet_tags: Any
    slave: int
    obstacle: Obstacle
    name: str = ""


Contact = ContactPair | RigidObstacle


@dataclass(frozen=True)
class MatchedContact:
    """The slave nodes that this rank owns, matched.

    Attributes
    ----------
    name : str
        Name of the contact.
    slave : (k,) integer array
        Global nodes of the displacement's space.
    master : (k,) integer array
        Their partners; -1 for an obstacle.
    coordinates : (k, 3) array
        Slave nodes [m].
    normal : (k, gdim) array
        Outward unit normals of the slave.
    gap : (k,) array
        (chi(x) - x)'n (11.7) [m].
    area : (k,) array
        Area of the surface (length in 2D) that belongs to the node [m^2 or m]; in a partial contact
        that of facets whose nodes all have partners, where the node has such facets.
    pairing : dict
        The contact's entry of `Report.pairing`.
    surface : Surface
        All of the slave's surface.
    """

    name: str
    slave: Numbers
    master: Numbers
    coordinates: Vector
    normal: Vector
    gap: Vector
    area: Vector
    pairing: dict[str, Any]
    surface: Surface


@dataclass(frozen=True)
class ContactResult:
    """What happened at the slave nodes that this rank owns.

    Attributes
    ----------
    name : str
        Name of the contact.
    nodes : (k,) integer array
        Global nodes of the displacement's space.
    coordinates : (k, 3) array
        [m].
    gap : (k,) array
        Gap before the deformation [m].
    normal : (k, gdim) array
        Outward unit normals of the slave.
    normal_force : (k,) array
        [N]; [N/m] in 2D.
    pressure : (k,) array
        Normal force over the area that belongs to the node [Pa].
    active : (k,) bool array
        Whether the node presses.
    comm : MPI.Intracomm
        The ranks.
    """

    name: str
    nodes: Numbers
    coordinates: Vector
    gap: Vector
    normal: Vector
    normal_force: Vector
    pressure: Vector
    active: NDArray[np.bool_]
    comm: MPI.Intracomm = field(default_factory=lambda: MPI.COMM_SELF, repr=False)

    def gather(self) -> ContactResult:
        """Return the nodes of all ranks, by node number, on every rank."""
        names = ("nodes", "coordinates", "gap", "normal", "normal_force", "pressure", "active")
        columns = [concatenate_ranks(self.comm, getattr(self, name)) for name in names]
        order = np.argsort(columns[0])
        whole: dict[str, Any] = {n: c[order] for n, c in zip(names, columns, strict=True)}
        return replace(self, comm=MPI.COMM_SELF, **whole)


def match_contacts(
    boundary: MeshBoundary,
    contacts: Sequence[Contact],
    known: Sequence[tuple[Contact, MatchedContact]] = (),
) -> list[MatchedContact]:
    """Match all contacts, and check that no two of them say the same thing.

    Parameters
    ----------
    boundary : MeshBoundary
        Of the displacement's mesh.
    contacts : sequence of ContactPair or RigidObstacle
        What may touch.
    known : sequence of (contact, match)
        Matched before: pairs among them are taken as they are, obstacles are evaluated anew.

    Returns
    -------
    list of MatchedContact
        This rank's part.

    Raises
    ------
    InputError
        As `match_contact`; two contacts of the same surfaces, or of the same node with the same.
    """
    comm = boundary.space.mesh.comm
    _check_different_surfaces(contacts, comm)
    before = {id(contact): match for contact, match in known}
    matched = [
        match_contact(boundary, contact, i, before.get(id(contact)))
        for i, contact in enumerate(contacts)
    ]
    _check_different_nodes(contacts, matched, comm)
    return matched


def match_contact(
    boundary: MeshBoundary, contact: Contact, number: int, before: MatchedContact | None = None
) -> MatchedContact:
    """Find the slave's nodes, normals, partners and gaps.

    The master's surface nodes are gathered on all ranks: their number grows with the surface.

    Parameters
    ----------
    boundary : MeshBoundary
        Of the displacement's mesh.
    contact : ContactPair or RigidObstacle
        What may touch.
    number : int
        Its number, for a name.
    before : MatchedContact, optional
        What was found for it before: pairs are not searched again, of obstacles only the surface is
        kept.

    Returns
    -------
    MatchedContact
        This rank's part.

    Raises
    ------
    InputError
        Tags on no facet or on interior ones, slave nodes without a partner, shared nodes, pairs
        that cross or are not one to one, wrong normals.
    """
    name = contact_name(contact, number)
    if isinstance(contact, RigidObstacle):
        return _match_obstacle(boundary, name, contact, before)
    return before or _match_pair(boundary, name, contact)


def contact_name(contact: Contact, number: int) -> str:
    """Return a contact's name, by default from its number and kind."""
    kind = "pair" if isinstance(contact, ContactPair) else "obstacle"
    return contact.name or f"contact {number} ({kind})"


def contact_rows(matched: Sequence[MatchedContact], gdim: int) -> ContactRows:
    """Put the contacts' nodes one behind the other."""
    if not matched:
        return ContactRows.none(gdim)
    return ContactRows(
        slave=np.concatenate([m.slave for m in matched]),
        master=np.concatenate([m.master for m in matched]),
        normal=np.concatenate([m.normal for m in matched]),
        gap=np.concatenate([m.gap for m in matched]),
        contact=np.repeat(np.arange(len(matched)), [m.slave.size for m in matched]),
    )


def _match_obstacle(
    boundary: MeshBoundary, name: str, contact: RigidObstacle, before: MatchedContact | None
) -> MatchedContact:
    comm = boundary.space.mesh.comm
    slave = (
        before.surface
        if before
        else tagged_surface(boundary, contact.facet_tags, contact.slave, f"slave of {name}")
    )
    gap, outward = gap_and_normal(comm, contact.obstacle, slave.coordinates, slave.normal, name)
    gap = _without_rounding(gap, slave)
    normal = -outward  # u'n <= gap with n pointing into the obstacle
    return MatchedContact(
        name,
        slave.nodes,
        np.full(slave.nodes.size, -1, dtype=np.int64),
        slave.coordinates,
        normal,
        gap,
        slave.area,
        pairing_entry(comm, name, gap, angles_between(slave.normal, normal), slave.nodes.size),
        slave,
    )


def _match_pair(boundary: MeshBoundary, name: str, contact: ContactPair) -> MatchedContact:
    comm = boundary.space.mesh.comm
    with raise_collectively(comm):
        _check_arguments(contact, name)
    tags = contact.facet_tags
    slave = tagged_surface(boundary, tags, contact.slave, f"slave of {name}", contact.normal)
    other = tagged_surface(boundary, tags, contact.master, f"master of {name}")
    master = gather_master(comm, other)
    shared = _shared_nodes(comm, name, slave, master, contact.partial)
    match = _search(comm, contact, slave, master.without(shared), name)
    match.distance[np.isin(slave.nodes, shared)] = np.inf
    limit = contact.tolerance * slave.size
    check_partners(comm, slave, match, limit, contact.partial, name)

    master = master.without(shared)
    found = match.distance <= limit
    check_one_to_one(comm, slave, master, match, found, contact.partial, name)
    partner = master.points[match.partner[found]]
    covered = _facets_with_partners(boundary, slave, found, partner, name)
    area = _area_with_partners(boundary, slave, covered) if contact.partial else slave.area

    normal = slave.normal[found]
    gap = _without_rounding(np.sum((partner - slave.points[found]) * normal, axis=1), slave)
    distance = _without_rounding(match.distance[found], slave)
    entry = pairing_entry(
        comm,
        name,
        gap,
        angles_between(normal, -master.normal[match.partner[found]]),
        slave.nodes.size,
        distance,
        distance / slave.size[found],
    )
    return MatchedContact(
        name,
        slave.nodes[found],
        master.nodes[match.partner[found]],
        slave.coordinates[found],
        normal,
        gap,
        area[found],
        entry,
        slave,
    )


def _search(
    comm: MPI.Intracomm, contact: ContactPair, slave: Surface, master: MasterNodes, name: str
) -> Match:
    if contact.direction is not None:
        return along_direction(comm, slave, master, contact.direction, contact.tolerance, name)
    if contact.mapping is not None:
        return at_images(comm, slave, master, contact.mapping, name)
    if contact.pairs is not None:
        return by_coordinates(comm, slave, master, contact.pairs, contact.tolerance, name)
    return nearest(slave, master)


def _check_arguments(contact: ContactPair, name: str) -> None:
    if contact.slave == contact.master:
        raise InputError(f"{name}: slave and master have the same tag {contact.slave}")
    ways = [way for way in ("direction", "mapping", "pairs") if getattr(contact, way) is not None]
    if len(ways) > 1:
        raise InputError(
            f"{name}: {' and '.join(ways)} are given; partners can be found in one way only"
        )
    if contact.mapping is not None and not callable(contact.mapping):
        raise InputError(f"{name}: the mapping has to be a function x (3, n) -> (3, n)")
    try:
        positive = 0.0 < float(contact.tolerance) < np.inf
    except (TypeError, ValueError):
        positive = False
    if not positive:
        raise InputError(
            f"{name}: the tolerance is {contact.tolerance!r}; a positive number is expected, "
            "relative to the size of the slave's facets"
        )


def _shared_nodes(
    comm: MPI.Intracomm, name: str, slave: Surface, master: MasterNodes, partial: bool
) -> Numbers:
    """Return the nodes that are slave and master, such as the tip of a crack; partial only."""
    at = np.isin(slave.nodes, master.nodes)
    shared = concatenate_ranks(comm, slave.nodes[at])
    refuse_where(
        comm,
        at if not partial or shared.size == len(master.nodes) else np.zeros_like(at),
        slave.points,
        lambda number, place: (
            f"{name}: slave and master share {number} nodes, the first at {place}. The surfaces "
            "overlap or the bodies are one: each body needs nodes of its own. (Where two faces of "
            "one body meet, such as at the tip of a crack, partial=True leaves the shared nodes "
            "free)"
        ),
    )
    return shared


def _facets_with_partners(
    boundary: MeshBoundary, slave: Surface, found: NDArray[np.bool_], partner: Vector, name: str
) -> NDArray[np.bool_]:
    """Tell which of this rank's facets have partners at all nodes; check that pairs don't cross."""
    images = np.full_like(slave.points, np.nan)
    images[found] = partner
    space = boundary.space
    images = values_on_facets(space, slave, images)
    normals = values_on_facets(space, slave, slave.normal)
    corners = boundary.coordinates[slave.vertices, : slave.points.shape[1]]
    check_not_crossed(space.mesh.comm, slave, corners, normals, images, name)
    covered: NDArray[np.bool_] = np.isfinite(images).all(axis=(1, 2))
    return covered


def _area_with_partners(
    boundary: MeshBoundary, slave: Surface, covered: NDArray[np.bool_]
) -> Vector:
    """Return the area that contact forces of a node stand for, for pressures."""
    area = area_of_facets(boundary, slave, covered)
    return np.where(area > _ROUNDING * slave.area, area, slave.area)


def _without_rounding(lengths: Vector, slave: Surface) -> Vector:
    """Set lengths to zero that are no more than the rounding of coordinates."""
    return np.where(np.abs(lengths) <= _ROUNDING * slave.extent, 0.0, lengths)


def _check_different_surfaces(contacts: Sequence[Contact], comm: MPI.Intracomm) -> None:
    pairs: dict[tuple[int, frozenset[int]], int] = {}
    with raise_collectively(comm):
        for number, contact in enumerate(contacts):
            if not isinstance(contact, ContactPair):
                continue
            tags = frozenset((contact.slave, contact.master))
            key = (id(_compat.cpp_object(contact.facet_tags)), tags)
            if key in pairs:
                raise InputError(
                    f"contacts {pairs[key]} and {number} join the same two surfaces, with slave "
                    f"and master {sorted(tags)}: keep one of them"
                )
            pairs[key] = number


def _check_different_nodes(
    contacts: Sequence[Contact], matched: Sequence[MatchedContact], comm: MPI.Intracomm
) -> None:
    """Check that no slave node meets the same surface or obstacle in two contacts."""
    for (one, a), (other, b) in combinations(zip(contacts, matched, strict=True), 2):
        if _same_master(one, other):
            _check_common_nodes(comm, a, b)


def _check_common_nodes(comm: MPI.Intracomm, a: MatchedContact, b: MatchedContact) -> None:
    _, at_a, at_b = np.intersect1d(a.slave, b.slave, return_indices=True)
    refuse_where(
        comm,
        # at an edge of the body a node is in the way twice, in two directions
        angles_between(a.normal[at_a], b.normal[at_b]) < _EDGE_ANGLE,
        a.coordinates[at_a, : a.normal.shape[1]],
        lambda number, place: (
            f"{a.name} and {b.name} match {number} slave nodes twice with the same master surface "
            f"or obstacle, the first at {place}: join the two slave surfaces under one tag, or "
            "separate them"
        ),
    )


def _same_master(one: Contact, other: Contact) -> bool:
    if isinstance(one, ContactPair) and isinstance(other, ContactPair):
        tags = (_compat.cpp_object(c.facet_tags) for c in (one, other))
        return one.master == other.master and next(tags) is next(tags)
    if isinstance(one, RigidObstacle) and isinstance(other, RigidObstacle):
        return one.obstacle is other.obstacle
    return False

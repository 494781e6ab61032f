"""Contact surfaces: facet tags to matched nodes, normals and gaps (sec. 11.1, 11.5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

import ufl
from dolfinx import fem
from dolfinx.fem import FunctionSpace
from dolfinx.mesh import exterior_facet_indices, meshtags

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.feti import ContactRows
from fenics_tfeti.feti.exchange import concatenate_ranks, together

__all__ = [
    "Contact",
    "ContactPair",
    "ContactResult",
    "MatchedContact",
    "Plane",
    "RigidObstacle",
    "check_contacts",
    "contact_rows",
    "match_contact",
]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
Obstacle = Callable[[Vector], tuple[ArrayLike, ArrayLike]]

# a nodal normal whose facets' normals cancel to less than this part of their area
_VANISHING_NORMAL = 1e-3
# of coordinates, relative to the largest one of the surface
_ROUNDING = 1e-13


@dataclass(frozen=True)
class ContactPair:
    """Two tagged surfaces that may touch but not penetrate each other.

    Each slave node meets the nearest master node; the grids have to match up to `tolerance`.

    Attributes
    ----------
    facet_tags : MeshTags
        Tags of facets.
    slave, master : int
        Tag of the slave's and of the master's surface.
    name : str
        For messages and the report.
    tolerance : float
        How far, along the surface, a master node may be from its slave node, relative to the local
        size of the slave's facets.
    """

    facet_tags: Any
    slave: int
    master: int
    name: str = ""
    tolerance: float = 0.1


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
        the unit normal (gdim, n) that points from the obstacle to the body. `Plane` is one.
    name : str
        For messages and the report.
    """

    facet_tags: Any
    slave: int
    obstacle: Obstacle
    name: str = ""


Contact = ContactPair | RigidObstacle


@dataclass(frozen=True)
class Plane:
    """A rigid half space.

    Attributes
    ----------
    point : sequence of float
        A point of its boundary [m].
    normal : sequence of float
        Normal of the boundary that points out of the obstacle, at the body; of any length.

    Examples
    --------
    >>> import numpy as np
    >>> gap, normal = Plane(point=(0, 0, 0), normal=(0, 0, 2))(np.array([[0.0], [0.0], [0.5]]))
    >>> gap.tolist(), normal.ravel().tolist()
    ([0.5], [0.0, 0.0, 1.0])
    """

    point: Sequence[float]
    normal: Sequence[float]

    def __call__(self, x: Vector) -> tuple[Vector, Vector]:
        """Return the distances and normals at points x of shape (3, n)."""
        normal = np.asarray(self.normal, dtype=float)
        length = np.linalg.norm(normal)
        if not length > 0.0:
            raise InputError(f"the plane's normal is {self.normal}: it has no direction")
        unit, gdim = normal / length, normal.size
        gap = unit @ (x[:gdim] - np.asarray(self.point, dtype=float)[:gdim, None])
        return gap, np.tile(unit[:, None], (1, x.shape[1]))


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
        Area of the surface (length in 2D) that belongs to the node [m^2 or m].
    """

    name: str
    slave: Numbers
    master: Numbers
    coordinates: Vector
    normal: Vector
    gap: Vector
    area: Vector


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


@dataclass(frozen=True)
class _Surface:
    """The nodes of a tagged surface that this rank owns."""

    nodes: Numbers
    coordinates: Vector
    normal: Vector
    area: Vector


def match_contact(space: FunctionSpace, contact: Contact, number: int) -> MatchedContact:
    """Find the slave's nodes, normals, partners and gaps.

    The master's surface nodes are gathered on all ranks: their number grows with the surface.

    Parameters
    ----------
    space : FunctionSpace
        The displacement's space.
    contact : ContactPair or RigidObstacle
        What may touch.
    number : int
        Its number, for a name.

    Returns
    -------
    MatchedContact
        This rank's part.

    Raises
    ------
    InputError
        Tags on no facet or on interior ones, slave nodes without a partner, shared nodes.
    """
    kind = "pair" if isinstance(contact, ContactPair) else "obstacle"
    name = contact.name or f"contact {number} ({kind})"
    slave = _surface(space, contact.facet_tags, contact.slave, f"slave of {name}")
    if isinstance(contact, RigidObstacle):
        with together(space.mesh.comm):
            matched = _match_obstacle(name, slave, contact)
        gap = _without_rounding(space.mesh.comm, matched.gap, slave.coordinates)
        return replace(matched, gap=gap)
    with together(space.mesh.comm):
        if contact.slave == contact.master:
            raise InputError(f"{name}: slave and master have the same tag {contact.slave}")
    master = _surface(space, contact.facet_tags, contact.master, f"master of {name}")
    return _match_pair(space.mesh.comm, name, slave, master, contact.tolerance)


def check_contacts(contacts: Sequence[Contact], comm: MPI.Intracomm) -> None:
    """Check that no two contacts say the same thing twice.

    Raises
    ------
    InputError
        If two pairs join the same surfaces.
    """
    pairs: dict[frozenset[int], int] = {}
    with together(comm):
        for number, contact in enumerate(contacts):
            if not isinstance(contact, ContactPair):
                continue
            tags = frozenset((contact.slave, contact.master))
            if tags in pairs:
                raise InputError(
                    f"contacts {pairs[tags]} and {number} join the same two surfaces, with slave "
                    f"and master {sorted(tags)}: keep one of them"
                )
            pairs[tags] = number


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


def _surface(space: FunctionSpace, facet_tags: Any, tag: int, what: str) -> _Surface:
    """Find the owned nodes of a tagged surface, with area-weighted normals."""
    domain, dim = space.mesh, space.mesh.topology.dim
    with together(domain.comm):
        if not _compat.tags_are_on(facet_tags, domain):
            raise InputError(f"{what}: facet_tags belong to another mesh than the displacement")
        if facet_tags.dim != dim - 1:
            raise InputError(
                f"{what}: facet_tags are on entities of dimension {facet_tags.dim}, facets have "
                f"dimension {dim - 1}"
            )
    domain.topology.create_connectivity(dim - 1, dim)
    owned = domain.topology.index_map(dim - 1).size_local
    facets = facet_tags.find(tag)
    facets = np.sort(facets[facets < owned])
    _check_facets(domain, facet_tags, tag, facets, what)

    ours = meshtags(domain, dim - 1, facets, np.ones(facets.size, dtype=np.int32))
    ds = ufl.Measure("ds", domain=domain, subdomain_data=ours)
    # the integral of the normal times a node's shape function: direction, and the area that turns
    # a uniform pressure into the node's normal force
    weight = ufl.inner(ufl.FacetNormal(domain), ufl.TestFunction(space)) * ds(1)
    gdim = space.dofmap.index_map_bs
    normal = _compat.assemble_distributed(weight).reshape(-1, gdim)

    nodes = np.asarray(fem.locate_dofs_topological(space, dim - 1, facets), dtype=np.int32)
    nodes = np.sort(nodes[nodes < space.dofmap.index_map.size_local])
    area = np.linalg.norm(normal[nodes], axis=1)
    coordinates = space.tabulate_dof_coordinates()[nodes]
    with together(domain.comm):
        _check_area(area, coordinates, what)
    return _Surface(
        np.asarray(space.dofmap.index_map.local_to_global(nodes), dtype=np.int64),
        coordinates,
        normal[nodes] / area[:, None],
        area,
    )


def _check_facets(
    domain: Any, facet_tags: Any, tag: int, facets: NDArray[np.int32], what: str
) -> None:
    comm = domain.comm
    inside = np.setdiff1d(facets, exterior_facet_indices(domain.topology)).size
    number, interior = comm.allreduce(facets.size), comm.allreduce(inside)
    if number == 0:
        there = np.unique(concatenate_ranks(comm, np.unique(facet_tags.values))).tolist()
        raise InputError(f"{what}: tag {tag} is on no facet; the tags there are {there}")
    if interior:
        raise InputError(
            f"{what}: {interior} of the {number} facets with tag {tag} are inside a body: only "
            "facets on the boundary can touch. Do the bodies share nodes where they should not?"
        )


def _check_area(area: Vector, coordinates: Vector, what: str) -> None:
    vanishing = np.flatnonzero(area <= _VANISHING_NORMAL * np.median(area)) if area.size else area
    if vanishing.size:
        raise InputError(
            f"{what}: the normals of the facets around {vanishing.size} nodes cancel, the first at "
            f"{coordinates[int(vanishing[0])]}: tag one side of an edge only"
        )


def _match_obstacle(name: str, slave: _Surface, contact: RigidObstacle) -> MatchedContact:
    k, gdim = slave.normal.shape
    values = contact.obstacle(np.ascontiguousarray(slave.coordinates.T))
    try:
        gap, outward = (np.asarray(value, dtype=float) for value in values)
    except (TypeError, ValueError):
        raise InputError(f"{name}: the obstacle has to return (gap, normal)") from None
    if gap.shape != (k,) or outward.shape not in ((gdim, k), (3, k)):
        raise InputError(
            f"{name}: for points of shape (3, {k}) the obstacle returned a gap of shape "
            f"{gap.shape} and a normal of shape {outward.shape}; expected ({k},) and ({gdim}, {k})"
        )
    if not (np.isfinite(gap).all() and np.isfinite(outward).all()):
        raise InputError(f"{name}: the obstacle's gap or normal is NaN or infinite at some points")
    length = np.linalg.norm(outward[:gdim], axis=0)
    if np.any(np.abs(length - 1.0) > 1e-6):
        worst = int(np.argmax(np.abs(length - 1.0)))
        raise InputError(
            f"{name}: the obstacle's normal at {slave.coordinates[worst]} has length "
            f"{length[worst]:g} in {gdim} dimensions, expected 1"
        )
    none = np.full(k, -1, dtype=np.int64)
    # u'n <= gap with n pointing into the obstacle
    normal = -outward[:gdim].T
    return MatchedContact(name, slave.nodes, none, slave.coordinates, normal, gap, slave.area)


def _match_pair(
    comm: MPI.Intracomm, name: str, slave: _Surface, master: _Surface, tolerance: float
) -> MatchedContact:
    nodes = concatenate_ranks(comm, master.nodes)
    points = concatenate_ranks(comm, master.coordinates)
    with together(comm):
        _check_shared_nodes(name, slave, nodes)

    gdim = slave.normal.shape[1]
    nearest = cKDTree(points).query(slave.coordinates)[1] if slave.nodes.size else np.zeros(0, int)
    offset = points[nearest][:, :gdim] - slave.coordinates[:, :gdim]
    gap = _without_rounding(comm, np.sum(offset * slave.normal, axis=1), slave.coordinates)
    along = np.linalg.norm(offset - gap[:, None] * slave.normal, axis=1)
    _check_partners(comm, name, slave, along, tolerance * _facet_size(slave, gdim))
    _check_one_to_one(comm, name, nodes[nearest])
    return MatchedContact(
        name, slave.nodes, nodes[nearest], slave.coordinates, slave.normal, gap, slave.area
    )


def _without_rounding(comm: MPI.Intracomm, gap: Vector, coordinates: Vector) -> Vector:
    """Set gaps to zero that are no more than the rounding of coordinates."""
    largest = comm.allreduce(float(np.abs(coordinates).max(initial=0.0)), MPI.MAX)
    return np.where(np.abs(gap) <= _ROUNDING * largest, 0.0, gap)


def _facet_size(surface: _Surface, gdim: int) -> Vector:
    size: Vector = surface.area ** (1.0 / (gdim - 1))
    return size


def _check_shared_nodes(name: str, slave: _Surface, master_nodes: Numbers) -> None:
    shared = np.flatnonzero(np.isin(slave.nodes, master_nodes))
    if shared.size:
        raise InputError(
            f"{name}: slave and master share {shared.size} nodes, the first at "
            f"{slave.coordinates[shared[0]]}. The surfaces overlap or the bodies are one: each "
            "body needs nodes of its own"
        )


def _check_partners(
    comm: MPI.Intracomm, name: str, slave: _Surface, along: Vector, limit: Vector
) -> None:
    far = along > limit
    columns = (slave.coordinates[far], along[far], limit[far])
    points, distances, limits = (concatenate_ranks(comm, column) for column in columns)
    total = comm.allreduce(slave.nodes.size)
    if len(points):
        first = "; ".join(
            f"{point} at distance {distance:.3g} (tolerance {most:.3g})"
            for point, distance, most in list(zip(points, distances, limits, strict=True))[:3]
        )
        raise InputError(
            f"{name}: {len(points)} of {total} slave nodes have no partner: {first}. Distances are "
            "along the surface to the nearest master node. Mesh the two surfaces alike, tag only "
            "where they face each other, or raise the pair's tolerance"
        )


def _check_one_to_one(comm: MPI.Intracomm, name: str, partners: Numbers) -> None:
    together_, counts = np.unique(concatenate_ranks(comm, partners), return_counts=True)
    twice = together_[counts > 1]
    if twice.size:
        raise InputError(
            f"{name}: {twice.size} master nodes are the nearest of several slave nodes each; the "
            "mapping has to be one to one. Exchange slave and master, or mesh the surfaces alike"
        )

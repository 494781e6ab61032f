"""Contacts: what the user describes, what the search finds, what the solution is (sec. 11.1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.obstacles import Obstacle
from fenics_tfeti.fem.contact.surfaces import GivenNormal, Surface
from fenics_tfeti.parallel import concatenate_ranks

__all__ = [
    "Contact",
    "ContactPair",
    "ContactPairing",
    "ContactResult",
    "RigidObstacle",
    "contact_name",
]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
VectorField = ArrayLike | Callable[[Vector], ArrayLike]


@dataclass(frozen=True)
class ContactPair:
    """Two tagged surfaces that may touch but not penetrate each other.

    Each slave node is paired with one master node: the nearest one, unless `direction`, `mapping`
    or `pairs` says how to find it. The meshes of the two surfaces have to match up to `tolerance`.
    For meshes that do not match, make the finer surface, with elements about half as large, the
    master, raise the tolerance to 0.8, and leave slave nodes that find no partner, beyond the edge
    of the master, free by `partial`.

    Attributes
    ----------
    facet_tags : MeshTags
        Tags of facets.
    slave, master : int
        Tag of the slave's and of the master's surface.
    name : str
        For messages and the report.
    tolerance : float
        Largest distance of a master node from the place where the slave node looks for it, relative
        to the edges of the slave's facets there. The distance is measured along the surface to the
        nearest node, across the `direction`, from the image by `mapping`, or from the points of
        `pairs` to the nodes.
    direction : (gdim,) array-like or callable, optional
        Partners are sought along this line, forwards and backwards, among the master nodes whose
        normals point against the slave's. A callable gets x (3, n) [m] and returns (gdim, n).
    mapping : callable, optional
        chi of sec. 11.1: x (3, n) -> (3, n), the expected place of each slave node's partner [m].
    pairs : (slave points, master points), optional
        Arrays (k, 3) of coordinates [m], one row for each pair. The same on all ranks.
    normal : (gdim,) array-like or callable, optional
        Outward normals of the slave, of any length; a callable gets x (3, n) and returns (gdim, n).
        By default the area-weighted average of the facets' normals at each node.
    partial : bool
        Whether slave nodes without partner, and nodes that belong to slave and master, stay free
        instead of being an error. The report has their number.
    measure_weight : UFL expression or number, optional
        Factor of ``ds`` in the forms, by which nodal forces become pressures: ``2 * pi * r`` or
        ``r``, with ``r = SpatialCoordinate(mesh)[0]``, in axisymmetric forms, the thickness in
        forms of a thin sheet. By default 1.
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
    measure_weight: Any = None


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
        the unit normal (gdim, n) that points from the obstacle to the body. Or x -> gap alone, the
        distance along the surface's own outward normal. Where there is no obstacle, the gap is
        +inf and the normal is not used. `Plane`, `Sphere` and `Cylinder` are such callables.
    name : str
        For messages and the report.
    measure_weight : UFL expression or number, optional
        Factor of ``ds`` in the forms, see `ContactPair`. By default 1.
    """

    facet_tags: Any
    slave: int
    obstacle: Obstacle
    name: str = ""
    measure_weight: Any = None


Contact = ContactPair | RigidObstacle


def contact_name(contact: Contact, number: int) -> str:
    """Return a contact's name, by default from its number and kind."""
    kind = "pair" if isinstance(contact, ContactPair) else "obstacle"
    return contact.name or f"contact {number} ({kind})"


@dataclass(frozen=True)
class ContactPairing:
    """The slave nodes that this rank owns and that have a contact condition.

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
        (chi(x) - x)'n (11.7) [m]; infinite where there is no obstacle.
    area : (k,) array
        Area of the surface (length in 2D) that belongs to the node [m^2 or m]; in a partial contact
        that of the facets whose nodes all have partners, where the node has such facets. It is
        multiplied by the contact's `measure_weight`.
    summary : dict
        The contact's entry of `Report.pairing`.
    surface : Surface
        All of the slave's surface.
    covered : (f,) bool array
        Which of the surface's facets have partners at all nodes.
    weighted_form : CompiledForm or None
        The form of the areas with the weight; None without one.
    """

    name: str
    slave: Numbers
    master: Numbers
    coordinates: Vector
    normal: Vector
    gap: Vector
    area: Vector
    summary: dict[str, Any]
    surface: Surface
    covered: NDArray[np.bool_]
    weighted_form: _compat.CompiledForm | None


@dataclass(frozen=True)
class ContactResult:
    """The solution at the slave nodes that this rank owns.

    Attributes
    ----------
    name : str
        Name of the contact.
    nodes : (k,) integer array
        Global nodes of the displacement's space.
    coordinates : (k, 3) array
        [m].
    gap : (k,) array
        Gap in the undeformed state [m]; infinite where there is no obstacle.
    normal : (k, gdim) array
        Outward unit normals of the slave.
    normal_force : (k,) array
        [N]; [N/m] in plane problems; in axisymmetric ones [N] if the forms have the factor
        2 pi r, [N/rad] if they have r.
    pressure : (k,) array
        Normal force over the area that belongs to the node, which has the contact's
        `measure_weight` [Pa].
    active : (k,) bool array
        Whether the normal force is positive.
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
        """Return the nodes of all ranks, by node number, on every rank. Collective."""
        names = ("nodes", "coordinates", "gap", "normal", "normal_force", "pressure", "active")
        columns = [concatenate_ranks(self.comm, getattr(self, name)) for name in names]
        order = np.argsort(columns[0])
        whole: dict[str, Any] = {n: c[order] for n, c in zip(names, columns, strict=True)}
        return replace(self, comm=MPI.COMM_SELF, **whole)

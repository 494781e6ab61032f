"""Contact geometry in the deformed state, for exact non-penetration (sec. 11.1, 11.11.2).

The linearized condition (11.1) is exact if the normals are those of the deformed state and the
partners are opposite each other in it. Here normals and gaps are measured anew on the surfaces that
the last displacement has moved, between their facets, and nodes that slid get new partners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dolfinx.fem import Function, FunctionSpace

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.contact import (
    Contact,
    ContactPair,
    ContactResult,
    MatchedContact,
    RigidObstacle,
)
from fenics_tfeti.fem.contact.faceted_surface import FacetedSurface, facet_normals
from fenics_tfeti.fem.contact.obstacles import gap_and_normal
from fenics_tfeti.parallel import concatenate_ranks, raise_collectively

__all__ = [
    "DeformedContact",
    "MovedSurface",
    "deformed_contact",
    "gather_surface",
    "geometry_pass",
]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]

# a nodal normal whose facets' normals cancel to less than this part of their area
_VANISHING_NORMAL = 1e-3
# ratio of distances at which another node takes a partner's place
_CLEARLY_NEARER = 1.5
_CORNERS = {"triangle": 2, "quadrilateral": 2, "tetrahedron": 3, "hexahedron": 4}
# corners in an order that turns the facet round
_TURNED = {2: [1, 0], 3: [0, 2, 1], 4: [0, 2, 1, 3]}


@dataclass(frozen=True)
class GeometryPass:
    """Penetration and separation of the deformed surfaces after one solution.

    Attributes
    ----------
    penetration : float
        How deep a node is in the other body at most [m].
    separation : float
        How far a node that presses is from the other body's surface at most [m].
    error : float
        The larger of both relative to the largest displacement.
    products : int
        Applications of F that the solution cost.
    """

    penetration: float
    separation: float
    error: float
    products: int


@dataclass(frozen=True)
class DeformedContact:
    """A contact's geometry after a displacement, at the slave nodes that this rank owns.

    Attributes
    ----------
    master : (k,) integer array
        Global node of the partner: that of `MatchedContact`, or the master's node that is now
        opposite, where the surfaces slid; -1 for an obstacle.
    normal : (k, gdim) array
        Outward unit normals of the slave in the deformed state.
    gap : (k,) array
        Bound c of the row (u_slave - u_partner)'n <= c, in terms of the total displacement [m].
    distance : (k,) array
        How far the deformed slave node is from the deformed master or obstacle, along the normal;
        negative inside [m].
    penetration : (k,) array
        How deep the deformed slave node is in the deformed master body or in the obstacle; 0
        outside [m].
    partner_penetration : (k,) array
        How deep its deformed partner is in the slave's body; 0 for obstacles [m]. The rows do not
        forbid it: between curved surfaces with different nodes it stays as large as facets differ
        from arcs, and decreases with the square of their size.
    """

    master: Numbers
    normal: Vector
    gap: Vector
    distance: Vector
    penetration: Vector
    partner_penetration: Vector


def deformed_contact(
    space: FunctionSpace,
    contact: Contact,
    matched: MatchedContact,
    displacement: Function,
    keep_normal: bool = False,
) -> DeformedContact:
    """Measure normals, gaps and penetration after a displacement.

    Collective. The facets and nodes of a pair's two surfaces are gathered on all ranks: their
    number grows with the surface. Facets stay as flat as they are: a quadrilateral is four
    triangles around its middle, which is on the bilinear facet.

    The normal at a node is the integral of the deformed facets' normal times the node's shape
    function, as that of `match_contact`. The gap to a master is measured along it, see
    `FacetedSurface.gap_along`; to an obstacle it is what the obstacle says.

    Parameters
    ----------
    space : FunctionSpace
        The displacement's space.
    contact : ContactPair or RigidObstacle
        What may touch. An obstacle returns (gap, normal), or the gap alone: then it counts along
        the slave's deformed normal.
    matched : MatchedContact
        The contact's nodes and partners.
    displacement : Function
        On the space [m]; its ghosts are updated.
    keep_normal : bool
        Keep the slave's normals of a pair as they were matched, because the user gave them.

    Returns
    -------
    DeformedContact
        This rank's part.

    Raises
    ------
    InputError
        A displacement on another space or not finite, an obstacle that returns something else,
        facets that the displacement has folded so that they have no normal at a node.
    """
    _check_displacement(space, displacement)
    displacement.x.scatter_forward()
    if isinstance(contact, RigidObstacle):
        return _at_obstacle(space, contact, matched, displacement)
    return _at_master(space, contact, matched, displacement, keep_normal)


def geometry_pass(
    deformed: Sequence[DeformedContact],
    results: Sequence[ContactResult],
    displacement: Function,
    products: int,
) -> GeometryPass:
    """Sum up how far the deformed surfaces are from touching without penetration.

    Parameters
    ----------
    deformed : sequence of DeformedContact
        All contacts, this rank's parts.
    results : sequence of ContactResult
        Who presses.
    displacement : Function
        Which deformed them [m].
    products : int
        What it cost.
    """
    pressing = [
        np.abs(new.distance[result.active]) for new, result in zip(deformed, results, strict=True)
    ]
    largest = np.array(
        [
            max((float(new.penetration.max(initial=0.0)) for new in deformed), default=0.0),
            max((float(distance.max(initial=0.0)) for distance in pressing), default=0.0),
            float(np.abs(displacement.x.array).max(initial=0.0)),
        ]
    )
    displacement.function_space.mesh.comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
    penetration, separation, size = largest.tolist()
    error = max(penetration, separation) / size if size > 0.0 else 0.0
    return GeometryPass(penetration, separation, error, products)


@dataclass(frozen=True)
class MovedSurface:
    """A surface of all ranks after the displacement, on every rank.

    Attributes
    ----------
    nodes : (n,) integer array
        Global nodes of the displacement's space, ascending.
    points : (n, gdim) array
        Where they are now [m].
    displacement : (n, gdim) array
        How they came there [m].
    facets : (m, v) integer array
        Rows of `nodes`, oriented outwards: the corners of segments and triangles in the order of
        `facet_normals`, of quadrilaterals such that those from corner 0 to 1 and 2 are.
    """

    nodes: Numbers
    points: Vector
    displacement: Vector
    facets: Numbers

    def surface(self) -> FacetedSurface:
        """Return segments or triangles, four around the middle of each quadrilateral."""
        return FacetedSurface(self._with_middles(self.points), self._triangles())

    def interpolate(self, values: Vector, x: Vector) -> Vector:
        """Return values at the points of the undeformed surface that are closest to others.

        Parameters
        ----------
        values : (n, v) array
            At the nodes; linear on segments and triangles.
        x : (k, gdim) array
            Points [m].

        Returns
        -------
        (k, v) array
            At the points.
        """
        triangles = self._triangles()
        undeformed = FacetedSurface(self._with_middles(self.points - self.displacement), triangles)
        facet, weights = undeformed.closest(x)
        corners = self._with_middles(values)[triangles[facet]]
        interpolated: Vector = np.einsum("kc,kcv->kv", weights, corners)
        return interpolated

    def _triangles(self) -> Numbers:
        if self.facets.shape[1] != 4:
            return self.facets
        middle = len(self.points) + np.arange(len(self.facets))
        circle = self.facets[:, [0, 1, 3, 2]]
        triangles = [
            np.column_stack([start, end, middle])
            for start, end in zip(circle.T, np.roll(circle, -1, axis=1).T, strict=True)
        ]
        return np.concatenate(triangles)

    def _with_middles(self, values: Vector) -> Vector:
        """Return values at nodes, followed by those in the middle of quadrilaterals."""
        if self.facets.shape[1] != 4:
            return values
        return np.concatenate([values, values[self.facets].mean(axis=1)])

    def normals(self, name: str) -> Vector:
        """Return the unit normals at all nodes, by the integral with the shape functions."""
        shares = _normal_shares(self.points[self.facets])
        total, size = np.zeros_like(self.points), np.zeros(len(self.nodes))
        np.add.at(total, self.facets, shares)
        np.add.at(size, self.facets, np.linalg.norm(shares, axis=2))
        length = np.linalg.norm(total, axis=1)
        folded = np.flatnonzero(length <= _VANISHING_NORMAL * size)
        if folded.size:
            # the same on every rank
            raise InputError(
                f"{name}: the displacement has folded the slave's facets around {folded.size} "
                f"nodes, the first now at {self.points[folded[0]]}: they have no normal. Are the "
                "loads right, and the displacements small enough for linear elasticity?"
            )
        units: Vector = total / length[:, None]
        return units


def _check_displacement(space: FunctionSpace, displacement: Function) -> None:
    with raise_collectively(space.mesh.comm):
        if displacement.function_space != space:
            raise InputError(
                "the displacement is on another function space than the contact's nodes; solve "
                "and measure on one space"
            )
        owned = space.dofmap.index_map.size_local * space.dofmap.index_map_bs
        if not np.isfinite(displacement.x.array[:owned]).all():
            raise InputError("the displacement is NaN or infinite at some nodes")


def _at_master(
    space: FunctionSpace,
    contact: ContactPair,
    matched: MatchedContact,
    displacement: Function,
    keep_normal: bool,
) -> DeformedContact:
    slave = gather_surface(space, contact.facet_tags, contact.slave, displacement)
    master = gather_surface(space, contact.facet_tags, contact.master, displacement)
    here = np.searchsorted(slave.nodes, matched.slave)
    partner = np.searchsorted(master.nodes, matched.master)
    normal = matched.normal if keep_normal else slave.normals(matched.name)[here]
    free_way, signed = master.surface().gap_along(slave.points[here], normal)
    partner = _opposite(master, partner, slave.points[here] + free_way[:, None] * normal)
    relative = slave.displacement[here] - master.displacement[partner]
    inside = slave.surface().distance(master.points[partner]).signed
    return DeformedContact(
        master.nodes[partner],
        normal,
        free_way + np.sum(relative * normal, axis=1),
        free_way,
        np.maximum(-signed, 0.0),
        np.maximum(-inside, 0.0),
    )


def _opposite(master: MovedSurface, partner: Numbers, foot: Vector) -> Numbers:
    """Return the master's nodes next to the points that the slave's nodes face.

    A partner stays where another node is not clearly nearer: the passes shall not alternate.
    """
    distance, nearest = cKDTree(master.points).query(foot) if len(foot) else (foot[:, 0], partner)
    present = np.linalg.norm(master.points[partner] - foot, axis=1)
    return np.where(present > _CLEARLY_NEARER * distance, nearest, partner)


def _at_obstacle(
    space: FunctionSpace,
    contact: RigidObstacle,
    matched: MatchedContact,
    displacement: Function,
) -> DeformedContact:
    gdim = space.dofmap.index_map_bs
    slave = gather_surface(space, contact.facet_tags, contact.slave, displacement)
    here = np.searchsorted(slave.nodes, matched.slave)
    points = np.pad(slave.points[here], ((0, 0), (0, 3 - gdim)))
    body_normal = slave.normals(matched.name)[here]
    gap, outward = gap_and_normal(
        space.mesh.comm, contact.obstacle, points, body_normal, matched.name
    )
    bound = gap - np.sum(slave.displacement[here] * outward, axis=1)
    return DeformedContact(
        matched.master, -outward, bound, gap, np.maximum(-gap, 0.0), np.zeros(gap.size)
    )


def gather_surface(
    space: FunctionSpace, facet_tags: Any, tag: int, displacement: Function
) -> MovedSurface:
    """Gather a tagged surface from all ranks, moved. Collective.

    Parameters
    ----------
    space : FunctionSpace
        The displacement's space.
    facet_tags : MeshTags
        Tags of facets.
    tag : int
        The surface's tag.
    displacement : Function
        On the space [m]; its ghosts are updated.
    """
    comm, gdim = space.mesh.comm, space.dofmap.index_map_bs
    facets = _oriented_facets(space, facet_tags, tag)
    local = np.unique(facets)
    numbers = np.asarray(space.dofmap.index_map.local_to_global(local), dtype=np.int64)
    points = space.tabulate_dof_coordinates()[local][:, :gdim]
    moves = displacement.x.array.reshape(-1, gdim)[local]
    rows = numbers[np.searchsorted(local, facets)]
    numbers, points, moves, rows = (
        concatenate_ranks(comm, column) for column in (numbers, points, moves, rows)
    )
    nodes, first = np.unique(numbers, return_index=True)
    return MovedSurface(
        nodes, points[first] + moves[first], moves[first], np.searchsorted(nodes, rows)
    )


def _oriented_facets(space: FunctionSpace, facet_tags: Any, tag: int) -> NDArray[np.int32]:
    """Return the local nodes of the facets that this rank owns, oriented outwards."""
    domain, dim = space.mesh, space.mesh.topology.dim
    domain.topology.create_connectivity(dim - 1, dim)
    found = facet_tags.find(tag)
    found = np.sort(found[found < domain.topology.index_map(dim - 1).size_local]).astype(np.int32)
    corners = _CORNERS[_compat.cell_name(domain)]
    rows = _compat.entity_nodes(domain, dim - 1, found).reshape(-1, corners)
    to_cell = domain.topology.connectivity(dim - 1, dim)
    cells = np.asarray(to_cell.array)[np.asarray(to_cell.offsets)[found]]

    # at degree 1, cells list their nodes and their vertices in the same order
    of_cell, x = _compat.geometry_cells(domain), domain.geometry.x[:, :dim]
    node = np.zeros(len(x), dtype=np.int32)
    node[of_cell] = _compat.cell_dofs(space)
    outward = x[rows].mean(axis=1) - x[of_cell[cells]].mean(axis=1)
    inverted = np.sum(_normal_shares(x[rows]).sum(axis=1) * outward, axis=1) < 0.0
    oriented = np.where(inverted[:, None], rows[:, _TURNED[corners]], rows)
    return np.asarray(node[oriented], dtype=np.int32)


def _normal_shares(corners: Vector) -> Vector:
    """Return the integrals over facets of the normal times the shape function of each corner.

    Parameters
    ----------
    corners : (m, v, gdim) array
        Corners of segments, triangles or bilinear quadrilaterals.

    Returns
    -------
    (m, v, gdim) array
        Exact also for warped quadrilaterals: the cross product of their tangents is linear.
    """
    v = corners.shape[1]
    if v < 4:
        return np.repeat(facet_normals(corners)[:, None, :] / v, v, axis=1)
    one = corners[:, [1, 1, 3, 3]] - corners[:, [0, 0, 2, 2]]
    other = corners[:, [2, 3, 2, 3]] - corners[:, [0, 1, 0, 1]]
    line = np.array([[2.0, 1.0], [1.0, 2.0]]) / 6.0
    shares: Vector = np.einsum("ij,mjk->mik", np.kron(line, line), np.cross(one, other))
    return shares

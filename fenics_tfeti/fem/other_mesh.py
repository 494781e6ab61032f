"""A displacement of another mesh, interpolated at the nodes of this one.

Cells are cut into simplices at their vertices, on which the place in the reference cell is linear:
exact where cells are parallelograms, else a start for iterations. Outside of all cells that of the
relatively nearest simplex goes on.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from mpi4py import MPI

import numpy as np
from scipy.spatial import cKDTree

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.geometry.reference_cells import lagrange_points, reference_cell, shape_values
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import cell_type, cell_vertices, owned_cells
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Array, Numbers, Vector

# radius, relative to that of the simplex, within which points are looked for around its centre
_REACH = 1.01
# part of the way to the middle of a node's cell at which the node is looked for: nodes of surfaces
# that touch, and of both lips of a crack, are in a cell of their own side
_INWARD = 1e-3
_SIMPLICES = {2: "triangle", 3: "tetrahedron"}


def interpolated(coarse: Function, coarse_bodies: Bodies, fine: Function, bodies: Bodies) -> Vector:
    """Return a displacement of another mesh at the degrees of freedom of this rank. Collective.

    Bodies are told by their places: each is the one in which most middles of its cells are.

    Raises
    ------
    InputError
        On all ranks, if the other mesh has nothing where a body is.
    """
    simplices = _Simplices.of(coarse, coarse_bodies)
    # of a mesh that each rank has for itself all ranks find the same
    comm = max(
        coarse.function_space.mesh.comm, fine.function_space.mesh.comm, key=MPI.Comm.Get_size
    )
    nodes, mesh = NodeMap(fine.function_space), fine.function_space.mesh
    x = fine.function_space.tabulate_dof_coordinates()[:, : mesh.geometry.dim]
    middles = mesh.geometry.x[cell_vertices(mesh)][:, :, : mesh.geometry.dim].mean(axis=1)
    owned = middles[: owned_cells(mesh)]
    inside, there, _ = simplices.searched(comm, owned, owned, np.full(len(owned), -1))
    partner = _partners(mesh.comm, bodies, inside >= 0.0, there, len(coarse_bodies.names))
    cell_dofs = _compat.cell_dofs(fine.function_space)[: len(owned)]
    cell_of = np.zeros(nodes.size, dtype=np.int64)
    cell_of[cell_dofs] = np.arange(len(owned))[:, None]
    # a rank may own nodes of cells that it does not own: their cells' ranks look for them
    local = np.unique(cell_dofs)
    cell = cell_of[local]
    near = x[local] + _INWARD * (middles[cell] - x[local])
    values = simplices.searched(comm, near, x[local], partner[bodies.of_cell[cell]])[2]
    ones = np.ones((local.size, 1))
    sums = nodes.reduce_at_owners(nodes.to_global(local), np.hstack([values, ones]))
    return (sums[:, :-1] / sums[:, -1:]).ravel()


def _partners(
    comm: MPI.Intracomm, bodies: Bodies, is_inside: Array, there: Numbers, count: int
) -> Numbers:
    """Return the other mesh's body in which most cells of each body are. Collective."""
    votes = np.zeros((len(bodies.names), count))
    np.add.at(votes, (bodies.of_cell[is_inside], there[is_inside]), 1.0)
    votes = comm.allreduce(votes)
    with raise_collectively(comm):
        for name in np.array(bodies.names)[votes.sum(axis=1) == 0.0]:
            raise InputError(
                f"the coarse problem has no cells where {name} is: both meshes have to be of the "
                "same bodies in the same places"
            )
    return votes.argmax(axis=1)


@dataclass(frozen=True)
class _Simplices:
    """The cells of this rank, cut into simplices, with a displacement."""

    corners: Vector  # (m, gdim + 1, gdim) [m]
    places: Vector  # (m, gdim + 1, gdim): of the corners in the reference cell
    cell: Numbers  # (m,)
    body: Numbers  # (m,)
    displacement: Function

    @staticmethod
    def of(uh: Function, bodies: Bodies) -> _Simplices:
        """Cut the cells that this rank owns."""
        domain = uh.function_space.mesh
        type_, owned, gdim = cell_type(domain), owned_cells(domain), domain.geometry.dim
        block = reference_cell(_SIMPLICES[gdim]).grid_cut
        cuts = np.array([range(gdim + 1)] if type_.is_simplex else block)
        uh.x.scatter_forward()
        x = domain.geometry.x[cell_vertices(domain)[:owned], :gdim]
        places = np.tile(lagrange_points(type_.name, 1)[cuts], (owned, 1, 1))
        cell = np.repeat(np.arange(owned), len(cuts))
        corners = x[:, cuts].reshape(-1, gdim + 1, gdim)
        return _Simplices(corners, places, cell, bodies.of_cell[cell], uh)

    @cached_property
    def _centres(self) -> Vector:
        return np.asarray(self.corners.mean(axis=1))

    @cached_property
    def _inverses(self) -> Vector:
        """The inverses (m, gdim, gdim) of the edges from the first corner."""
        return np.asarray(np.linalg.inv(self.corners[:, 1:] - self.corners[:, :1]))

    def searched(
        self, comm: MPI.Intracomm, near: Vector, points: Vector, body: Numbers
    ) -> tuple[Vector, Numbers, Vector]:
        """Find points (k, gdim) of this rank in the cells of all ranks. Collective.

        Returned are how far inside the best simplex their places `near` are, in barycentric
        coordinates; its body; and the displacement at the points. They may be in a body (k,), or in
        any where that is -1.
        """
        result = None
        for rank in range(comm.size):
            query = comm.bcast((near, points, body), rank)
            answers = comm.gather(self._found(*query), rank)
            if answers is not None:
                best = np.argmax([answer[0] for answer in answers], axis=0)
                rows = np.arange(best.size)
                result = tuple(
                    np.array(column)[best, rows] for column in zip(*answers, strict=True)
                )
        assert result is not None
        inside, there, values = result
        return inside, there, values

    def _found(self, near: Vector, points: Vector, body: Numbers) -> tuple[Vector, Numbers, Vector]:
        """Return what this rank has of `searched`; minus infinity where it has nothing."""
        count, gdim = points.shape
        inside, there = np.full(count, -np.inf), np.zeros(count, dtype=np.int64)
        values = np.zeros((count, gdim))
        if not (count and len(self.corners)):
            return inside, there, values
        place, simplex = self._candidates(near, body)
        depth = self._barycentric(near[place], simplex).min(axis=1)
        depth[(body[place] >= 0) & (self.body[simplex] != body[place])] = -np.inf
        order = np.lexsort((depth, place))
        last = order[np.append(np.diff(place[order]) > 0, True)]
        found, simplex = place[last], simplex[last]
        inside[found], there[found] = depth[last], self.body[simplex]
        values[found] = self._values(points[found], simplex)
        return inside, there, values

    def _values(self, x: Vector, simplex: Numbers) -> Vector:
        """Return the displacement (k, gdim) at points in simplices."""
        space = self.displacement.function_space
        weights = self._barycentric(x, simplex)
        places = np.einsum("kc,kca->ka", weights, self.places[simplex])
        shapes = shape_values(cell_type(space.mesh).name, _compat.element_facts(space)[1], places)
        nodal = self.displacement.x.array.reshape(-1, x.shape[1])
        nodes = _compat.cell_dofs(space)[self.cell[simplex]]
        return np.asarray(np.einsum("kn,kna->ka", shapes, nodal[nodes]))

    def _candidates(self, near: Vector, body: Numbers) -> tuple[Numbers, Numbers]:
        """Return pairs of points and simplices: in the ball around it, or nearest in the body."""
        radius = np.linalg.norm(self.corners - self._centres[:, None], axis=2).max(axis=1)
        lists = cKDTree(near).query_ball_point(self._centres, _REACH * radius)
        places = [np.array(found, dtype=np.int64) for found in lists]
        simplices = [np.repeat(np.arange(len(lists)), [len(found) for found in lists])]
        for number in np.unique(body):
            chosen = np.flatnonzero((self.body == number) | (number < 0))
            of_body = np.flatnonzero(body == number)
            if chosen.size:
                places.append(of_body)
                nearest = cKDTree(self._centres[chosen]).query(near[of_body])[1]
                simplices.append(chosen[nearest])
        return np.concatenate(places), np.concatenate(simplices)

    def _barycentric(self, x: Vector, simplex: Numbers) -> Vector:
        """Return the barycentric coordinates (k, gdim + 1) of points in simplices."""
        rest = np.einsum("kb,kba->ka", x - self.corners[simplex, 0], self._inverses[simplex])
        return np.column_stack([1.0 - rest.sum(axis=1), rest])

"""Deformation gradients in the cells: the size of a Newton step, and cells that it inverts."""

from __future__ import annotations

from collections.abc import Callable

from mpi4py import MPI

import numpy as np

from dolfinx.fem import FunctionSpace

from fenics_tfeti.errors import format_point
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.topology import batches, owned_cells
from fenics_tfeti.typing import Vector

# cells at once
_CELLS = 2**13


class CellGradients:
    """Displacement gradients at points of each cell that this rank owns: midpoints, or nodes."""

    def __init__(self, space: FunctionSpace) -> None:
        self._space = space
        cell = _compat.cell_name(space.mesh)
        _, degree, _ = _compat.element_facts(space)
        geometry = _compat.geometry_degree(space.mesh)
        nodes = _compat.lagrange_points(cell, degree)
        self._at_nodes, self._at_midpoint = (
            [_compat.shape_gradients(cell, d, points) for d in (geometry, degree)]
            for points in (nodes, nodes.mean(axis=0, keepdims=True))
        )

    def largest_increment(self, u: Vector, du: Vector) -> float:
        """Return the largest |grad du F^-1| at midpoints, F = I + grad u. Collective.

        That is the strain and rotation of a step from the deformed state. The displacements (nodes,
        gdim) are those at all nodes of this rank.
        """

        def size(gradients: Vector) -> Vector:
            F = np.eye(u.shape[1]) + gradients[0]
            values: Vector = np.linalg.norm(gradients[1] @ np.linalg.inv(F), axis=(2, 3))
            return values

        largest = max((float(v.max()) for v, _ in self._over_cells(size, u, du)), default=0.0)
        return float(self._space.mesh.comm.allreduce(largest, MPI.MAX))

    def smallest_volume_ratio(self, u: Vector) -> tuple[float, str]:
        """Return the smallest det(I + grad u) at nodes of cells, and where it is. Collective."""

        def determinant(gradients: Vector) -> Vector:
            values: Vector = np.linalg.det(np.eye(u.shape[1]) + gradients[0])
            return values

        smallest, place = np.inf, ""
        for values, x in self._over_cells(determinant, u):
            cell, point = np.unravel_index(np.argmin(values), values.shape)
            if values[cell, point] < smallest:
                smallest, place = float(values[cell, point]), format_point(x[cell].mean(axis=0))
        lowest: tuple[float, str] = min(self._space.mesh.comm.allgather((smallest, place)))
        return lowest

    def _over_cells(
        self, measure: Callable[[Vector], Vector], *fields: Vector
    ) -> list[tuple[Vector, Vector]]:
        """Return a measure (cells, points) of gradients, with the cells' nodes, by batches.

        Gradients of one field are at the nodes of cells, of two at midpoints.
        """
        space = self._space
        domain, gdim = space.mesh, space.dofmap.index_map_bs
        shapes = self._at_nodes if len(fields) == 1 else self._at_midpoint
        nodes, vertices = _compat.cell_dofs(space), _compat.geometry_cells(domain)
        results = []
        for batch in batches(owned_cells(domain), _CELLS):
            x = domain.geometry.x[vertices[batch], :gdim]
            inverse = np.linalg.inv(np.einsum("dpn,cna->cpad", shapes[0], x))
            gradients = [
                np.einsum("dpn,cna->cpad", shapes[1], u[nodes[batch]]) @ inverse for u in fields
            ]
            results.append((measure(np.array(gradients)), x))
        return results

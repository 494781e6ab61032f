"""Displacement gradients in the cells of a mesh, with what they say of strains and rotations."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np

from dolfinx.fem import FunctionSpace

from fenics_tfeti.errors import format_point
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.reference_cells import lagrange_points, shape_gradients
from fenics_tfeti.fem.topology import batches, owned_cells
from fenics_tfeti.typing import Vector

# cells at once
_CELLS = 2**13


@dataclass(frozen=True)
class GradientBatch:
    """Gradients at p points of each of k cells; derivatives of a component are in a row."""

    fields: list[Vector]  # one (k, p, gdim, gdim) for each field
    scale: Vector  # |det J| (k, p) [m^gdim]: the volume is its integral over the reference cell
    nodes: Vector  # coordinates (k, n, gdim) [m]


class CellGradients:
    """Gradients of displacements in each cell that this rank owns, at its midpoint or nodes."""

    def __init__(self, space: FunctionSpace) -> None:
        self._space = space
        cell = _compat.cell_name(space.mesh)
        _, degree, _ = _compat.element_facts(space)
        geometry = _compat.geometry_degree(space.mesh)
        nodes = lagrange_points(cell, degree)
        self._at_nodes, self._at_midpoint = (
            [shape_gradients(cell, d, points) for d in (geometry, degree)]
            for points in (nodes, nodes.mean(axis=0, keepdims=True))
        )

    def at_midpoints(self, *fields: Vector) -> Iterator[GradientBatch]:
        """Yield gradients of fields (nodes, gdim) at all nodes of this rank, by batches."""
        return self._over_cells(self._at_midpoint, *fields)

    def largest_increment(self, u: Vector, du: Vector) -> float:
        """Return the largest |grad du F^-1| at midpoints, F = I + grad u. Collective.

        That is the strain and rotation of a step from the deformed state. The displacements (nodes,
        gdim) are those at all nodes of this rank.
        """
        largest = 0.0
        for batch in self.at_midpoints(u, du):
            present, increment = batch.fields
            turned = increment @ np.linalg.inv(np.eye(u.shape[1]) + present)
            largest = max(largest, float(np.linalg.norm(turned, axis=(2, 3)).max(initial=0.0)))
        return float(self._space.mesh.comm.allreduce(largest, MPI.MAX))

    def smallest_volume_ratio(self, u: Vector) -> tuple[float, str]:
        """Return the smallest det(I + grad u) at nodes of cells, and where it is. Collective."""
        smallest, place = np.inf, ""
        for batch in self._over_cells(self._at_nodes, u):
            ratios = np.linalg.det(np.eye(u.shape[1]) + batch.fields[0])
            cell, point = np.unravel_index(np.argmin(ratios), ratios.shape)
            if ratios[cell, point] < smallest:
                smallest = float(ratios[cell, point])
                place = format_point(batch.nodes[cell].mean(axis=0))
        lowest: tuple[float, str] = min(self._space.mesh.comm.allgather((smallest, place)))
        return lowest

    def _over_cells(self, shapes: list[Vector], *fields: Vector) -> Iterator[GradientBatch]:
        """Yield gradients at the points of shape functions of the geometry and the field."""
        space = self._space
        domain, gdim = space.mesh, space.dofmap.index_map_bs
        nodes, vertices = _compat.cell_dofs(space), _compat.geometry_cells(domain)
        for batch in batches(owned_cells(domain), _CELLS):
            x = domain.geometry.x[vertices[batch], :gdim]
            jacobian = np.einsum("dpn,cna->cpad", shapes[0], x)
            inverse = np.linalg.inv(jacobian)
            gradients = [
                np.einsum("dpn,cna->cpad", shapes[1], u[nodes[batch]]) @ inverse for u in fields
            ]
            yield GradientBatch(gradients, np.abs(np.linalg.det(jacobian)), x)

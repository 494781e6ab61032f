"""Displacement gradients in the cells of a mesh, with what they say of strains and rotations."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function, FunctionSpace

from fenics_tfeti.errors import format_point
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.solution.results import RigidBodyResult
from fenics_tfeti.fem.contact.surfaces.tagged import extremes
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.reference_cells import lagrange_points, shape_gradients
from fenics_tfeti.fem.topology import batches, owned_cells
from fenics_tfeti.parallel import warn_on_first_rank
from fenics_tfeti.typing import Vector

# cells at once
_CELLS = 2**13
# |grad u| from which on its square, which linear elasticity leaves out, is no small part of it
_LARGE = 0.1
# share of the strain energy that is more than that of corners and point loads
_SHARE = 0.1


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

    def largest_increment(self, u: Vector, du: Vector) -> tuple[float, float]:
        """Return the largest |A| and |tr(A^2)|, A = grad du F^-1 at midpoints. Collective.

        Values are at all nodes. Half of the trace is what ln det F changes by beside tr(A).
        """
        largest = np.zeros(2)
        for batch in self.at_midpoints(u, du):
            present, increment = batch.fields
            A = increment @ np.linalg.inv(np.eye(u.shape[1]) + present)
            traces = np.abs(np.trace(A @ A, axis1=2, axis2=3))
            sizes = [np.linalg.norm(A, axis=(2, 3)).max(initial=0.0), traces.max(initial=0.0)]
            largest = np.maximum(largest, sizes)
        self._space.mesh.comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
        return float(largest[0]), float(largest[1])

    def smallest_volume_ratio(self, u: Vector) -> tuple[float, str]:
        """Return the smallest det(I + grad u) at nodes of cells, and where it is. Collective."""
        smallest, place = np.inf, ""
        for batch in self._over_cells(self._at_nodes, u):
            ratios = determinants(np.transpose(np.eye(u.shape[1]) + batch.fields[0], (2, 3, 0, 1)))
            cell, point = np.unravel_index(np.argmin(ratios), ratios.shape)
            if ratios[cell, point] < smallest:
                smallest = float(ratios[cell, point])
                place = format_point(batch.nodes[cell].mean(axis=0))
        return min(self._space.mesh.comm.allgather((smallest, place)))

    def _over_cells(self, shapes: list[Vector], *fields: Vector) -> Iterator[GradientBatch]:
        """Yield gradients at the points of shape functions of the geometry and the field."""
        space = self._space
        domain, gdim = space.mesh, space.dofmap.index_map_bs
        nodes, vertices = _compat.cell_dofs(space), _compat.geometry_cells(domain)
        for batch in batches(owned_cells(domain), _CELLS):
            x = domain.geometry.x[vertices[batch], :gdim]
            inverse, determinant = _inverse(_derivatives(shapes[0], x))
            derivatives = (_derivatives(shapes[1], u[nodes[batch]]) for u in fields)
            gradients = [np.transpose(_product(D, inverse), (3, 2, 0, 1)) for D in derivatives]
            yield GradientBatch(gradients, np.abs(determinant).T, x)


def warn_of_large_gradients(uh: Function, bodies: Bodies, energy: Sequence[float]) -> bool:
    """Warn, on rank 0, if displacement gradients are large in cells that carry load. Collective.

    They are those at the midpoints. Bodies without strain energy [J] may turn as far as they like.
    Return on all ranks whether there was a warning.
    """
    comm = uh.function_space.mesh.comm
    size, strain2 = _cell_measures(uh)
    large, count = size > _LARGE, len(energy)
    energies = [np.bincount(bodies.of_cell, values, count) for values in (strain2, strain2 * large)]
    whole, in_large = comm.allreduce(np.array(energies))
    largest = extremes(comm, size, bodies.of_cell, count, 0.0)
    # the strain energy in large cells, as a share of that of all bodies
    share = np.divide(in_large, whole, out=np.zeros_like(whole), where=whole > 0.0)
    share *= np.asarray(energy) / max(sum(energy), np.finfo(float).tiny)
    if share.sum() <= _SHARE:
        return False
    worst = int(share.argmax())
    warn_on_first_rank(
        comm,
        f"|grad u| is as large as {largest[worst]:.2g} in {bodies.names[worst]}, and above "
        f"{_LARGE:g} in cells with {share.sum():.0%} of the strain energy; linear elasticity and "
        "the contact conditions are right for |grad u| much smaller than 1 only. Do the units "
        "fit, such as E in Pa with lengths in m, or in MPa with mm?",
    )
    return True


def warn_of_large_rotations(comm: MPI.Intracomm, bodies: Iterable[RigidBodyResult]) -> bool:
    """Warn, on rank 0, of rigid bodies whose rotation is not small; True if so. Collective."""
    angles = {body.name: float(np.linalg.norm(body.rotation)) for body in bodies}
    large = [
        f"{name} turns by {angle:.2g} rad, but rotations are small here: its points move along "
        "straight lines, and normals stay as they are. geometry=Exact() turns it by any angle"
        for name, angle in angles.items()
        if angle > _LARGE
    ]
    warn_on_first_rank(comm, *large)
    return bool(large)


def _cell_measures(uh: Function) -> tuple[Vector, Vector]:
    """Return |grad u| and |strain|^2 times the volume of the cells that this rank owns."""
    space = uh.function_space
    u = uh.x.array.reshape(-1, space.dofmap.index_map_bs)
    size, strain2 = [np.zeros(0)], [np.zeros(0)]
    for batch in CellGradients(space).at_midpoints(u):
        gradient = batch.fields[0][:, 0]
        strain = 0.5 * (gradient + gradient.transpose(0, 2, 1))
        size.append(np.linalg.norm(gradient, axis=(1, 2)))
        strain2.append(np.sum(strain**2, axis=(1, 2)) * batch.scale[:, 0])
    return np.concatenate(size), np.concatenate(strain2)


def _derivatives(shapes: Vector, values: Vector) -> Vector:
    """Return derivatives (a, d, p, k) of shape functions (d, p, n) with node values (k, n, a)."""
    derivatives: Vector = np.tensordot(shapes, values.transpose(1, 2, 0), (2, 0))
    return derivatives.transpose(2, 0, 1, 3)


def _product(A: Vector, B: Vector) -> Vector:
    """Return AB of small matrices (d, d, p, k), entry by entry for all of them at once."""
    return np.sum([A[:, i, None] * B[None, i] for i in range(len(B))], axis=0)


def _inverse(A: Vector) -> tuple[Vector, Vector]:
    """Return the inverses of (d, d, p, k) matrices, d = 2 or 3, and their determinants (p, k)."""
    if len(A) == 2:
        adjugate = np.array([[A[1, 1], -A[0, 1]], [-A[1, 0], A[0, 0]]])
    else:
        adjugate = np.stack([np.cross(A[i - 2], A[i - 1], axis=0) for i in range(3)], axis=1)
    determinant = np.sum(A[0] * adjugate[:, 0], axis=0)
    return adjugate / determinant, determinant


def determinants(A: Vector) -> Vector:
    """Return the determinants (...) of matrices (d, d, ...), d = 2 or 3, of all at once."""
    if len(A) == 2:
        return np.asarray(A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0])
    return np.asarray(np.sum(A[0] * np.cross(A[1], A[2], axis=0), axis=0))

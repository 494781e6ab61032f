"""Displacement gradients in the cells of a mesh, with what they say of strains and rotations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function, FunctionSpace

from fenics_tfeti.errors import format_point
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.geometry.batches import batches
from fenics_tfeti.fem.geometry.reference_cells import lagrange_points, shape_gradients
from fenics_tfeti.fem.topology import owned_cells
from fenics_tfeti.parallel import largest_of_groups
from fenics_tfeti.typing import Mask, Vector

# cells at once
_CELLS = 2**13
# |grad u| from which on its square, which linear elasticity leaves out, is no small part of it
LARGE_GRADIENT = 0.1
# share of the strain energy that is more than that of corners and point loads
_SHARE = 0.1
# rotation over strain from which on a body swings about what holds it
_SWINGS = 10.0


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


@dataclass(frozen=True)
class CellStrains:
    """Strains and rotations at the midpoints of the m cells that this rank owns."""

    gradient: Vector  # |grad u|
    strain: Vector  # |strain|, the root of the sum of squares
    rotation: Vector  # angle of the skew part of grad u [rad]
    squares: Vector  # |strain|^2 times the volume [m^gdim]

    @staticmethod
    def of(uh: Function, is_finite: bool = False) -> CellStrains:
        """Measure a displacement; finite strains are those of Green and Lagrange."""
        space = uh.function_space
        u = uh.x.array.reshape(-1, space.dofmap.index_map_bs)
        columns = [np.zeros((0, 4))]
        for batch in CellGradients(space).at_midpoints(u):
            G = batch.fields[0][:, 0]
            transposed = G.transpose(0, 2, 1)
            strain, skew = 0.5 * (G + transposed), 0.5 * (G - transposed)
            if is_finite:
                strain += 0.5 * transposed @ G
            sizes = [np.linalg.norm(A, axis=(1, 2)) for A in (G, strain, skew)]
            sizes += [sizes[1] ** 2 * batch.scale[:, 0]]
            columns.append(np.column_stack(sizes))
        gradient, size, skew_size, squares = np.concatenate(columns).T
        return CellStrains(gradient, size, skew_size / np.sqrt(2.0), squares)


def large_gradients(
    comm: MPI.Intracomm,
    strains: CellStrains,
    bodies: Bodies,
    energy: Sequence[float],
    weak_motions: Sequence[str] = (),
) -> list[str]:
    """Say if displacement gradients are large in cells that carry load. Collective.

    Bodies without strain energy [J] may turn as far as they like. Where strains are small, it is a
    rotation: of a body that only tilted normals hold, or of one that bends or swings.
    """
    count = len(energy)

    def share(is_large: Mask) -> Vector:
        """Return the strain energy in some cells of each body, as a share of that of all."""
        weights = (strains.squares, strains.squares * is_large)
        whole, part = comm.allreduce(
            np.array([np.bincount(bodies.of_cell, values, count) for values in weights])
        )
        of_body = np.divide(part, whole, out=np.zeros_like(whole), where=whole > 0.0)
        return of_body * np.asarray(energy) / max(sum(energy), np.finfo(float).tiny)

    large = share(strains.gradient > LARGE_GRADIENT)
    if large.sum() <= _SHARE:
        return []
    worst = int(large.argmax())
    columns = np.column_stack([strains.gradient, strains.rotation, strains.strain])
    of_bodies = largest_of_groups(comm, columns, bodies.of_cell, count, 0.0)
    name, (gradient, rotation, strain) = bodies.names[worst], of_bodies[worst]
    weak = [motion for motion in weak_motions if f"{name}: " in motion]
    # strains of a linear problem grow with the angle of a motion that next to nothing resists
    swings = bool(weak) and rotation > _SWINGS * strain
    if share(strains.strain > LARGE_GRADIENT).sum() > _SHARE and not swings:
        return [
            f"|grad u| is as large as {gradient:.2g} in {name}, and above {LARGE_GRADIENT:g} in "
            f"cells with {large.sum():.0%} of the strain energy; linear elasticity and the contact "
            "conditions are right for |grad u| much smaller than 1 only. Do the units fit, such as "
            "E in Pa with lengths in m, or in MPa with mm?"
        ]
    why = (
        f"nothing but facets holds it ({weak[0]}): add a support or a soft spring"
        if weak
        else "add a support, or take NonlinearContactProblem if it is meant to turn"
    )
    return [
        f"{name} turns by {np.degrees(rotation):.2g} degrees, with strains up to {strain:.2g}. "
        f"Linear elasticity and the contact conditions are right for small rotations only; {why}"
    ]


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

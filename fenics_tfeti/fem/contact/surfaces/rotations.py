"""Rotations of a deformed surface around its nodes: those of the facets there, by least squares.

The rotation R at a node maximises tr(R'H), H = sum of x a', with the places x of the corners of the
facets around it and their arms a, from the middle of each undeformed facet. H = RS with a symmetric
S, and displacements du turn it by (tr(V) I - V)^-1 times the sum of Ra x du, where V = RSR'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, Surface
from fenics_tfeti.fem.geometry.vectors import cross, nearest_rotation, unit
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.typing import Numbers, Vector

# height of a patch of facets, relative to its extent and squared, up to which it is plane
_PLANE = 1e-2


@dataclass(frozen=True)
class SurfaceRotations:
    """The rotations R (k, gdim, gdim) at the nodes of a surface that this rank owns."""

    R: Vector
    # of terms (t,), the corners of the facets around the nodes: the node's position, the global
    # number of the corner, and its turned arm (t, gdim) [m]
    row: Numbers
    nodes: Numbers
    arms: Vector
    flexibility: Vector  # (k, 3, 3): (tr(V) I - V)^-1, in 2D for rotations about z [1/m^2]

    @staticmethod
    def of(surface: Surface, boundary: MeshBoundary) -> SurfaceRotations:
        """Find the rotations from the surface to its nodes' places on a boundary. Collective."""
        nodes, gdim = boundary.nodes, boundary.nodes.components
        row, corners, arms = _arms(surface)
        x = nodes.values_at(boundary.coordinates[:, :gdim], corners)
        H = np.zeros((surface.nodes.size, gdim, gdim))
        np.add.at(H, row, x[:, :, None] * arms[:, None, :])
        R = nearest_rotation(H)
        V = np.zeros((len(R), 3, 3))
        V[:, :gdim, :gdim] = H @ R.transpose(0, 2, 1)
        trace = np.trace(V, axis1=1, axis2=2)
        inertia = trace[:, None, None] * np.identity(3) - 0.5 * (V + V.transpose(0, 2, 1))
        turned = np.einsum("tab,tb->ta", R[row], arms)
        return SurfaceRotations(
            R, row, corners, turned, np.linalg.pinv(inertia, rcond=1e-12, hermitian=True)
        )

    def turned(self, vectors: Vector, positions: Numbers | slice = slice(None)) -> Vector:
        """Return vectors (q, gdim) as they are after the rotation at nodes (q,) by position."""
        return np.einsum("qab,qb->qa", self.R[positions], vectors)

    def terms(self, moments: Vector, positions: Numbers) -> tuple[Numbers, Numbers, Vector]:
        """Return the sums m'w, w the further small rotation at nodes (q,) by position, as rows.

        The moments m are (q, 3) and zero but for the last component in 2D. Returned are the rows
        (t,) of terms, their global nodes, and the coefficients (t, gdim) of displacements there.
        """
        ends = np.searchsorted(self.row, np.arange(len(self.R) + 1))
        number = np.diff(ends)[positions]
        row = np.repeat(np.arange(positions.size), number)
        first = np.cumsum(number) - number
        term = np.arange(row.size) + np.repeat(ends[positions] - first, number)
        spins = np.einsum("qab,qb->qa", self.flexibility[positions], moments)
        gdim = self.arms.shape[1]
        arms = np.pad(self.arms[term], ((0, 0), (0, 3 - gdim)))
        return row, self.nodes[term], cross(spins[row], arms)[:, :gdim]


def carried(surface: Surface, boundary: MeshBoundary, vectors: Vector) -> Vector:
    """Return unit vectors along a surface as lines of its material have them. Collective.

    The vectors (k, gdim) are at the nodes of the surface on this rank. Their places on a boundary
    tell a deformation gradient F = H S^-1, S being the H of the undeformed facets. What facets in
    one plane do not tell about F is that of the rotation.
    """
    nodes, gdim = boundary.nodes, boundary.nodes.components
    row, corners, arms = _arms(surface)
    S, H = (np.zeros((surface.nodes.size, gdim, gdim)) for _ in range(2))
    for matrices, x in ((S, surface.boundary.coordinates), (H, boundary.coordinates)):
        places = nodes.values_at(x[:, :gdim], corners)
        np.add.at(matrices, row, places[:, :, None] * arms[:, None, :])
    R = nearest_rotation(H)
    along = np.einsum("kab,kb->ka", np.linalg.pinv(S, rcond=_PLANE, hermitian=True), vectors)
    turned = np.einsum("kab,kb->ka", R, vectors) + np.einsum("kab,kb->ka", H - R @ S, along)
    return unit(turned)


def _arms(surface: Surface) -> tuple[Numbers, Numbers, Vector]:
    """Return positions of nodes (t,), ascending, corners and arms as of rotations. Collective."""
    nodes: NodeMap = surface.boundary.nodes
    x = surface.corners
    numbers = nodes.to_global(surface.vertices)
    v, gdim = x.shape[1:]
    arms = np.broadcast_to((x - x.mean(axis=1, keepdims=True))[:, None], (len(x), v, v, gdim))
    around = np.repeat(numbers, v, axis=1).ravel()
    local, corner, arm = nodes.to_owners(
        around, np.tile(numbers, (1, v)).ravel(), arms.reshape(-1, gdim)
    )
    row = np.searchsorted(surface.local, local)
    # by node and corner, the sum of arms does not depend on the order in which they arrive
    order = np.lexsort((*arm.T, corner, row))
    row, corner, arm = row[order], corner[order], arm[order]
    first = np.flatnonzero(np.diff(row, prepend=-1) | np.diff(corner, prepend=-1))
    if first.size:
        arm = np.add.reduceat(arm, first, axis=0)
    return row[first], corner[first], arm

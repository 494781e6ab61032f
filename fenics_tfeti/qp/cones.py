"""Sets of normal and tangential forces with friction: n >= 0 and |t| <= r + m n.

With m = 0 the bound of the tangential force is given; with r = 0 the set is a second-order cone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class FrictionCones:
    """The x with ``n >= 0`` for all normal components, and ``|t| <= r + m n`` with friction.

    All other components are free.

    Attributes
    ----------
    below : (b,) integer array
        Normal components without friction.
    normal : (k,) integer array
        Normal components n with friction, each once and none of `below`.
    tangential : (k, d) integer array
        The tangential components t of each, d = 1 or 2.
    radius, slope : (k,) arrays
        r and m, at least 0.

    Examples
    --------
    >>> import numpy as np
    >>> none = np.zeros(0, dtype=np.int64)
    >>> cone = FrictionCones(none, np.array([0]), np.array([[1]]), np.zeros(1), np.ones(1))
    >>> cone.project(np.array([0.0, 2.0])).round(12).tolist()
    [1.0, 1.0]
    >>> (cone.project(np.array([-3.0, 2.0])) + 0.0).tolist()
    [0.0, 0.0]
    """

    below: Numbers
    normal: Numbers
    tangential: Numbers
    radius: Vector
    slope: Vector

    def project(self, x: Vector) -> Vector:
        """Project x in place onto the set and return it."""
        n, size, _, on_cone = self._places(x)
        pressed = np.where(on_cone, self._along(n, size), np.maximum(n, 0.0))
        bound = self.radius + self.slope * pressed
        factor = np.divide(bound, size, out=np.ones_like(size), where=size > bound)
        x[self.tangential] *= factor[:, None]
        x[self.normal] = pressed
        x[self.below] = np.maximum(x[self.below], 0.0)
        return x

    def derivative_times(self, x: Vector, columns: Vector) -> Vector:
        """Return P'(x) columns for any x and columns (n, r); a generalized derivative at edges."""
        n, size, direction, on_cone = self._places(x)
        moved = columns.copy()
        moved[self.below[x[self.below] < 0.0]] = 0.0
        pressed = np.where(on_cone, self._along(n, size), np.maximum(n, 0.0))
        bound = self.radius + self.slope * pressed
        outside = size > bound
        dn, dt = columns[self.normal], columns[self.tangential]
        outwards = np.einsum("kd,kdr->kr", direction, dt)
        m = self.slope[:, None]
        ds = np.where(n[:, None] > 0.0, dn, 0.0)
        ds = np.where(on_cone[:, None], (dn + m * outwards) / (1.0 + m**2), ds)
        shrunk = np.divide(bound, size, out=np.ones_like(size), where=outside)[:, None, None]
        across = dt - direction[:, :, None] * outwards[:, None, :]
        turned = shrunk * across + direction[:, :, None] * (m * ds)[:, None, :]
        moved[self.normal] = ds
        moved[self.tangential] = np.where(outside[:, None, None], turned, dt)
        return moved

    def derivative(self, x: Vector) -> sp.csr_matrix:
        """Return P'(x) as a sparse matrix, see `derivative_times`."""
        # the blocks do not overlap: one product for each place in a block has all of their columns
        blocks = np.column_stack([self.normal, self.tangential])
        size = blocks.shape[1]
        alone = np.setdiff1d(np.arange(x.size), blocks)
        columns = np.zeros((x.size, size + 1))
        columns[alone, size] = 1.0
        for j in range(size):
            columns[blocks[:, j], j] = 1.0
        moved = self.derivative_times(x, columns)
        rows, at = np.repeat(blocks, size, axis=1), np.tile(blocks, (1, size))
        entries = np.concatenate([moved[blocks, :size].ravel(), moved[alone, size]])
        places = np.append(rows.ravel(), alone), np.append(at.ravel(), alone)
        return sp.csr_matrix((entries, places), (x.size, x.size))

    def scaled(self, factor: float) -> FrictionCones:
        """Return the set with r and m multiplied by a positive factor."""
        return FrictionCones(
            self.below, self.normal, self.tangential, factor * self.radius, factor * self.slope
        )

    def _places(self, x: Vector) -> tuple[Vector, Vector, Vector, Mask]:
        """Return n, |t|, t / |t|, and whether the projection is on the cone's side, n' > 0."""
        n, t = x[self.normal], x[self.tangential]
        size = np.linalg.norm(t, axis=1)
        direction = np.divide(t, size[:, None], out=np.zeros_like(t), where=size[:, None] > 0.0)
        outside = size > self.radius + self.slope * np.maximum(n, 0.0)
        return n, size, direction, outside & (self._along(n, size) > 0.0)

    def _along(self, n: Vector, size: Vector) -> Vector:
        """Return n' of the nearest point of the line |t| = r + m n."""
        along: Vector = (n + self.slope * (size - self.radius)) / (1.0 + self.slope**2)
        return along

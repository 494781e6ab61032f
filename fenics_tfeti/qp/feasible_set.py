"""Feasible sets given by lower bounds, and the free and chopped gradient."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.qp.space import Space

__all__ = ["Bounds", "Split"]

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Split:
    """The parts of a gradient g at a feasible x, and their squared norms over all ranks.

    Attributes
    ----------
    free : (n,) array
        The free gradient phi: g without the components at active bounds.
    chopped : (bounds,) array
        The chopped gradient beta on the bounded components: min(g, 0) at active bounds.
    free2, chopped2 : float
        ||phi||^2 and ||beta||^2.
    reduced_free : float
        phi~'phi with the reduced free gradient phi~.
    constraint2 : float
        ||Qx||^2 = ||Gx||^2, zero without equality constraints. (x'Qx is the same number, but loses
        half of the digits when x is large.)
    conjugation : float
        phi'Ap with the last direction p, zero without one.
    """

    free: Vector
    chopped: Vector
    free2: float
    chopped2: float
    reduced_free: float
    constraint2: float
    conjugation: float

    @property
    def projected_norm(self) -> float:
        """Norm of the projected gradient g^P = phi + beta."""
        return float(np.sqrt(self.free2 + self.chopped2))

    @property
    def constraint_norm(self) -> float:
        """||Gx||."""
        return float(np.sqrt(self.constraint2))


@dataclass(frozen=True)
class Bounds:
    """The feasible set {x : x[indices] >= lower}.

    Attributes
    ----------
    indices : (bounds,) integer array
        The bounded components, ascending.
    lower : (bounds,) array
        Their lower bounds l.

    Examples
    --------
    >>> import numpy as np
    >>> bounds = Bounds.from_vector(np.array([-np.inf, 0.0, 1.0]))
    >>> bounds.project(np.array([-5.0, -5.0, 5.0]))
    array([-5.,  0.,  5.])
    """

    indices: NDArray[np.int64]
    lower: Vector

    @staticmethod
    def from_vector(lower: Vector) -> Bounds:
        """Return the bounds of a vector that is -inf where there is none."""
        indices = np.flatnonzero(lower > -np.inf)
        return Bounds(indices, lower[indices])

    def project(self, x: Vector) -> Vector:
        """Project x in place onto the feasible set and return it."""
        x[self.indices] = np.maximum(x[self.indices], self.lower)
        return x

    def active(self, x: Vector) -> NDArray[np.bool_]:
        """Tell which bounds hold with equality; exact, since `project` assigns them."""
        mask: NDArray[np.bool_] = x[self.indices] <= self.lower
        return mask

    def longest_step(self, x: Vector, p: Vector) -> float:
        """Return the largest a for which this rank's part of x - a p is feasible."""
        downwards = p[self.indices] > 0.0
        towards = self.indices[downwards]
        if towards.size == 0:
            return np.inf
        return float(np.min((x[towards] - self.lower[downwards]) / p[towards]))

    def split(
        self,
        x: Vector,
        g: Vector,
        step_length: float,
        space: Space,
        Qx: Vector | None = None,
        Ap: Vector | None = None,
    ) -> Split:
        """Split the gradient g at x; one reduction over the ranks.

        Parameters
        ----------
        x, g : (n,) array
            Feasible point and gradient there.
        step_length : float
            The fixed step length in the reduced free gradient.
        space : Space
            The inner product.
        Qx : (n,) array, optional
            G'Gx with orthonormal rows of G, for ||Gx||.
        Ap : (n,) array, optional
            Product with the last direction, for phi'Ap.

        Returns
        -------
        Split
            The parts and their norms.
        """
        g_bounded = g[self.indices]
        active = self.active(x)
        chopped = np.where(active, np.minimum(g_bounded, 0.0), 0.0)
        phi_bounded = np.where(active, 0.0, g_bounded)
        reduced = np.minimum((x[self.indices] - self.lower) / step_length, phi_bounded)
        free = g.copy()
        free[self.indices] = phi_bounded

        owned = None if space.owned is None else int(np.searchsorted(self.indices, space.owned))
        free2 = space.partial(free, free)
        cut = float(phi_bounded[:owned] @ (phi_bounded - reduced)[:owned])
        free2, chopped2, reduced_free, constraint2, conjugation = space.sums(
            free2,
            float(chopped[:owned] @ chopped[:owned]),
            free2 - cut,
            0.0 if Qx is None else space.partial(Qx, Qx),
            0.0 if Ap is None else space.partial(free, Ap),
        )
        return Split(free, chopped, free2, chopped2, reduced_free, constraint2, conjugation)

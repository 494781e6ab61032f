"""Feasible sets that are products of lines, half-lines, intervals and discs.

All that the algorithms ask of a feasible set: the projection onto it, the components on its
boundary, the longest feasible step, and the parts of a gradient (`Split`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fenics_tfeti.qp.space import Space
from fenics_tfeti.typing import Mask, Numbers, Vector

# distance from a circle, relative to its radius and the coordinates of its centre, that is rounding
_ON_CIRCLE = 1e-14


@dataclass(frozen=True)
class Split:
    """The parts of a gradient g at a feasible x, and their squared norms over all ranks.

    Attributes
    ----------
    free : (n,) array
        The free gradient phi: g without the components on the boundary of the set.
    gradient2 : float
        Square of the norm that vanishes exactly at the solution, for stopping tests: of the
        projected gradient g^P = phi + beta where the set is given by `Bounds`, of the reduced
        gradient g~ where it has discs.
    boundary2 : float
        The same of the part on the boundary: ||beta||^2 with the chopped gradient beta, or
        ||beta~||^2 with the part of g~ on the boundary.
    reduced_free : float
        phi~'phi with the reduced free gradient phi~.
    constraint2 : float
        ||Qx||^2 = ||Gx||^2, zero without equality constraints. (x'Qx is the same number, but loses
        half of the digits when x is large.)
    conjugation : float
        phi'Ap with the last direction p, zero without one.
    """

    free: Vector
    gradient2: float
    boundary2: float
    reduced_free: float
    constraint2: float
    conjugation: float

    @property
    def gradient_norm(self) -> float:
        """Norm of the projected or the reduced gradient."""
        return float(np.sqrt(self.gradient2))

    @property
    def constraint_norm(self) -> float:
        """||Gx||."""
        return float(np.sqrt(self.constraint2))


@dataclass(frozen=True)
class Bounds:
    """The feasible set {x : lower <= x[indices] <= upper}.

    Attributes
    ----------
    indices : (bounded,) integer array
        The bounded components, ascending.
    lower, upper : (bounded,) array
        Their bounds l <= u, infinite where there is none.

    Examples
    --------
    >>> import numpy as np
    >>> bounds = Bounds.from_vector(np.array([-np.inf, 0.0, 1.0]), np.array([np.inf, np.inf, 2.0]))
    >>> bounds.project(np.array([-5.0, -5.0, 5.0]))
    array([-5.,  0.,  2.])
    """

    indices: Numbers
    lower: Vector
    upper: Vector

    @staticmethod
    def from_vector(lower: Vector, upper: Vector | None = None) -> Bounds:
        """Return the bounds of vectors that are infinite where there is none."""
        upper = np.full(lower.size, np.inf) if upper is None else upper
        indices = np.flatnonzero((lower > -np.inf) | (upper < np.inf))
        return Bounds(indices, lower[indices], upper[indices])

    @staticmethod
    def from_below(indices: Numbers, lower: Vector) -> Bounds:
        """Return the lower bounds of some components, ascending."""
        return Bounds(indices, lower, np.full(lower.size, np.inf))

    @staticmethod
    def none() -> Bounds:
        """Return no bounds."""
        return Bounds.from_below(np.zeros(0, dtype=np.int64), np.zeros(0))

    def project(self, x: Vector) -> Vector:
        """Project x in place onto the feasible set and return it."""
        x[self.indices] = np.minimum(np.maximum(x[self.indices], self.lower), self.upper)
        return x

    def scaled(self, factor: float) -> Bounds:
        """Return the set with all finite bounds multiplied by a positive factor."""
        return Bounds(self.indices, factor * self.lower, factor * self.upper)

    def derivative_times(self, x: Vector, columns: Vector) -> Vector:
        """Return the bounded rows of P'(x) columns, for any x; at a bound a generalized derivative.

        Parameters
        ----------
        x : (n,) array
            Any point.
        columns : (n, r) array
            Directions.
        """
        bounded = x[self.indices]
        inside = (bounded > self.lower) & (bounded < self.upper)
        return np.where(inside[:, None], columns[self.indices], 0.0)

    def active(self, x: Vector) -> Mask:
        """Tell which components are at a bound; exact, since `project` assigns it."""
        bounded = x[self.indices]
        mask: Mask = (bounded <= self.lower) | (bounded >= self.upper)
        return mask

    def on_boundary(self, x: Vector) -> Numbers:
        """Return the components at a bound, ascending."""
        components: Numbers = self.indices[self.active(x)]
        return components

    def longest_step(self, x: Vector, p: Vector) -> float:
        """Return the largest a for which this rank's part of x - a p is feasible."""
        bounded, speed = x[self.indices], p[self.indices]
        moving = speed != 0.0
        way = np.where(speed > 0.0, bounded - self.lower, bounded - self.upper)[moving]
        return float(np.min(way / speed[moving], initial=np.inf))

    def chopped_gradient(self, x: Vector, g: Vector) -> Vector:
        """Return beta on the bounded components: g at active bounds where -g leaves the bound."""
        bounded, g_bounded = x[self.indices], g[self.indices]
        at_lower, at_upper = bounded <= self.lower, bounded >= self.upper
        inwards = (at_lower & (g_bounded < 0.0)) | (at_upper & (g_bounded > 0.0))
        # between equal bounds no direction is feasible
        return np.where(inwards & ~(at_lower & at_upper), g_bounded, 0.0)

    def reduced_gradient(self, x: Vector, g: Vector, step_length: float) -> Vector:
        """Return (x - P(x - a g)) / a on the bounded components, a the step length."""
        bounded = x[self.indices]
        largest = (bounded - self.lower) / step_length
        smallest = (bounded - self.upper) / step_length
        return np.maximum(np.minimum(g[self.indices], largest), smallest)

    def split(
        self,
        x: Vector,
        g: Vector,
        step_length: float,
        space: Space,
        Qx: Vector | None = None,
        Ap: Vector | None = None,
    ) -> Split:
        """Split the gradient g at x into phi and beta; one reduction over the ranks.

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
        free = g.copy()
        free[self.on_boundary(x)] = 0.0
        phi, beta = free[self.indices], self.chopped_gradient(x, g)
        cut = phi - self.reduced_gradient(x, free, step_length)

        owned = None if space.owned is None else int(np.searchsorted(self.indices, space.owned))
        free2 = space.partial(free, free)
        beta2 = float(beta[:owned] @ beta[:owned])
        gradient2, beta2, reduced_free, constraint2, conjugation = space.sums(
            free2 + beta2,
            beta2,
            free2 - float(phi[:owned] @ cut[:owned]),
            0.0 if Qx is None else space.partial(Qx, Qx),
            0.0 if Ap is None else space.partial(free, Ap),
        )
        return Split(free, gradient2, beta2, reduced_free, constraint2, conjugation)


@dataclass(frozen=True)
class Discs:
    """The feasible set of the x with ``|x[indices[k]] - centre[k]| <= radius[k]`` for all k.

    Attributes
    ----------
    indices : (discs, 2) integer array
        The two components of each disc; a rank that holds or owns one of them does so with both.
    centre : (discs, 2) array
        The centres.
    radius : (discs,) array
        The radii r >= 0.

    Examples
    --------
    >>> import numpy as np
    >>> unit = Discs(np.array([[0, 1]]), np.zeros((1, 2)), np.ones(1))
    >>> unit.project(np.array([3.0, 4.0]))
    array([0.6, 0.8])
    """

    indices: Numbers
    centre: Vector
    radius: Vector

    @staticmethod
    def none() -> Discs:
        """Return no discs."""
        return Discs(np.zeros((0, 2), dtype=np.int64), np.zeros((0, 2)), np.zeros(0))

    def project(self, x: Vector) -> Vector:
        """Project x in place onto the feasible set and return it."""
        y, distance = self._from_centre(x)
        outside = distance > self.radius
        factor = self.radius[outside] / distance[outside]
        x[self.indices[outside]] = self.centre[outside] + factor[:, None] * y[outside]
        return x

    def scaled(self, factor: float) -> Discs:
        """Return the set with centres and radii multiplied by a positive factor."""
        return Discs(self.indices, factor * self.centre, factor * self.radius)

    def derivative_times(self, x: Vector, columns: Vector) -> Vector:
        """Return the rows (discs, 2, r) of P'(x) columns of the discs, for any x.

        Outside of a disc the derivative is r / |y| times the projection on the tangent.
        """
        y, distance = self._from_centre(x)
        moved = columns[self.indices]
        outside = distance > self.radius
        n = y[outside] / distance[outside, None]
        tangential = moved[outside]
        tangential -= n[:, :, None] * np.sum(n[:, :, None] * tangential, axis=1, keepdims=True)
        moved[outside] = (self.radius[outside] / distance[outside])[:, None, None] * tangential
        return moved

    def on_circle(self, x: Vector) -> Mask:
        """Tell of which discs the point is on the boundary, up to rounding of the projection."""
        distance = self._from_centre(x)[1]
        rounding = _ON_CIRCLE * (self.radius + np.abs(self.centre).sum(axis=1))
        mask: Mask = distance >= self.radius - rounding
        return mask

    def on_boundary(self, x: Vector) -> Numbers:
        """Return the components of the discs whose boundary the point is on."""
        return self.indices[self.on_circle(x)].ravel()

    def longest_step(self, x: Vector, p: Vector) -> float:
        """Return the largest a for which this rank's part of x - a p is feasible."""
        speed = p[self.indices]
        moving = speed.any(axis=1)
        y, distance = self._from_centre(x)
        y, speed, distance = y[moving], speed[moving], distance[moving]
        # the positive root of |y - a p|^2 = r^2, without cancellation for either sign of y'p
        pp, yp = np.sum(speed**2, axis=1), np.sum(y * speed, axis=1)
        room = np.maximum((self.radius[moving] - distance) * (self.radius[moving] + distance), 0.0)
        root = np.sqrt(yp**2 + pp * room)
        inwards = yp > 0.0
        far = np.divide(yp + root, pp, out=np.zeros_like(pp), where=inwards)
        near = np.divide(room, root - yp, out=np.zeros_like(pp), where=~inwards & (room > 0.0))
        return float(np.min(np.where(inwards, far, near), initial=np.inf))

    def reduced_gradient(self, x: Vector, g: Vector, step_length: float) -> Vector:
        """Return (x - P(x - a g)) / a on the discs, (discs, 2), a the step length."""
        y, distance = self._from_centre(x)
        reduced = g[self.indices]
        # y - r (y - a g) / |y - a g| by the difference (|y - a g|^2 - r^2) / a, not of the lengths,
        # which are almost equal
        room = (self.radius - distance) * (self.radius + distance)
        room[self.on_circle(x)] = 0.0
        difference = step_length * np.sum(reduced**2, axis=1) - 2.0 * np.sum(y * reduced, axis=1)
        difference -= room / step_length
        outside = difference > 0.0
        y, g, r = y[outside], reduced[outside], self.radius[outside]
        length = np.linalg.norm(y - step_length * g, axis=1)
        excess = difference[outside] / (length + r)
        reduced[outside] = (excess[:, None] * y + r[:, None] * g) / length[:, None]
        return reduced

    def _from_centre(self, x: Vector) -> tuple[Vector, Vector]:
        """Return x - centre, and its length."""
        y = x[self.indices] - self.centre
        return y, np.linalg.norm(y, axis=1)


@dataclass(frozen=True)
class ProductSet:
    """The product of half-lines and intervals, of discs, and of lines for all other components.

    Attributes
    ----------
    bounds : Bounds
        The half-lines and intervals.
    discs : Discs
        The discs, of components without bounds.

    Examples
    --------
    >>> import numpy as np
    >>> unit = Discs(np.array([[1, 2]]), np.zeros((1, 2)), np.ones(1))
    >>> feasible = ProductSet(Bounds.from_below(np.array([0]), np.zeros(1)), unit)
    >>> feasible.project(np.array([-2.0, 3.0, 4.0, 5.0]))
    array([0. , 0.6, 0.8, 5. ])
    """

    bounds: Bounds = field(default_factory=Bounds.none)
    discs: Discs = field(default_factory=Discs.none)

    def project(self, x: Vector) -> Vector:
        """Project x in place onto the feasible set and return it."""
        return self.discs.project(self.bounds.project(x))

    def scaled(self, factor: float) -> ProductSet:
        """Return the set with all finite bounds, centres and radii times a positive factor."""
        return ProductSet(self.bounds.scaled(factor), self.discs.scaled(factor))

    def derivative_times(self, x: Vector, columns: Vector) -> Vector:
        """Return P'(x) columns for any x and columns (n, r); a generalized derivative at edges."""
        moved = columns.copy()
        moved[self.bounds.indices] = self.bounds.derivative_times(x, columns)
        moved[self.discs.indices] = self.discs.derivative_times(x, columns)
        return moved

    def on_boundary(self, x: Vector) -> Numbers:
        """Return the components at a bound or on the boundary of their disc, ascending."""
        parts = self.bounds.on_boundary(x), self.discs.on_boundary(x)
        return np.sort(np.concatenate(parts))

    def longest_step(self, x: Vector, p: Vector) -> float:
        """Return the largest a for which this rank's part of x - a p is feasible."""
        return min(self.bounds.longest_step(x, p), self.discs.longest_step(x, p))

    def reduced_gradient(self, x: Vector, g: Vector, step_length: float) -> Vector:
        """Return g~ = (x - P(x - a g)) / a, a the step length; g on components without bounds."""
        reduced = g.copy()
        reduced[self.bounds.indices] = self.bounds.reduced_gradient(x, g, step_length)
        reduced[self.discs.indices] = self.discs.reduced_gradient(x, g, step_length)
        return reduced

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

        A block is in the interior or on the boundary of its factor of the set, so g~ consists of
        phi~ on the one and beta~ on the other.

        Parameters
        ----------
        x, g, step_length, space, Qx, Ap
            As in `Bounds.split`.

        Returns
        -------
        Split
            The parts and their norms.
        """
        free, interior = g.copy(), self.reduced_gradient(x, g, step_length)
        on_boundary = self.on_boundary(x)
        boundary = np.zeros_like(g)
        boundary[on_boundary] = interior[on_boundary]
        free[on_boundary] = interior[on_boundary] = 0.0
        interior2, boundary2 = space.partial(interior, interior), space.partial(boundary, boundary)
        gradient2, boundary2, reduced_free, constraint2, conjugation = space.sums(
            interior2 + boundary2,
            boundary2,
            space.partial(interior, free),
            0.0 if Qx is None else space.partial(Qx, Qx),
            0.0 if Ap is None else space.partial(free, Ap),
        )
        return Split(free, gradient2, boundary2, reduced_free, constraint2, conjugation)


FeasibleSet = Bounds | ProductSet

"""Feasible sets: products of lines, half-lines, intervals, discs and friction cones.

`ProductSet` has all that the algorithms ask of a feasible set: the projection and its derivative,
the components on the boundary, the longest feasible step, and the parts of a gradient (`Split`).
Its factors `Bounds`, `Discs` and `FrictionCones` compute them for their own components.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.qp import balls
from fenics_tfeti.qp.space import Space
from fenics_tfeti.typing import Mask, Numbers, Vector

# distance from a curved boundary, relative to its size and the coordinates of its centre, that is
# rounding
_ON_BOUNDARY = 1e-14


@dataclass(frozen=True)
class Split:
    """The parts of a gradient g at a feasible x, and their squared norms over all ranks.

    Attributes
    ----------
    free : (n,) array
        The free gradient phi: g without the components on the boundary of the set.
    boundary : (n,) array
        The gradient beta on the boundary, zero in the interior: the reduced gradient
        g~ = (x - P(x - a g)) / a with the step length a. On half-lines it is the chopped gradient.
    gradient2 : float
        ||phi||^2 + ||beta||^2, which vanishes exactly at the solution, for stopping tests. On
        half-lines phi + beta is the projected gradient g^P.
    boundary2 : float
        ||beta||^2.
    reduced_free : float
        phi~'phi with the reduced free gradient phi~.
    constraint2 : float
        ||Qx||^2 = ||Gx||^2, zero without equality constraints. (x'Qx is the same number, but loses
        half of the digits when x is large.)
    conjugation : float
        phi'Ap with the last direction p, zero without one.
    """

    free: Vector
    boundary: Vector
    gradient2: float
    boundary2: float
    reduced_free: float
    constraint2: float
    conjugation: float

    @property
    def gradient_norm(self) -> float:
        """Norm of phi + beta."""
        return float(np.sqrt(self.gradient2))

    @property
    def constraint_norm(self) -> float:
        """||Gx||."""
        return float(np.sqrt(self.constraint2))


@dataclass(frozen=True)
class Bounds:
    """The factor of the x with lower <= x[indices] <= upper.

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

    def scaled(self, factor: float) -> Bounds:
        """Return the set with all finite bounds multiplied by a positive factor."""
        return Bounds(self.indices, factor * self.lower, factor * self.upper)

    def project(self, x: Vector) -> Vector:
        """Project x in place onto the feasible set and return it."""
        x[self.indices] = np.minimum(np.maximum(x[self.indices], self.lower), self.upper)
        return x

    def derivative(self, x: Vector) -> Vector:
        """Return P'(x) of each component, (bounded, 1, 1): 1 between the bounds and at them."""
        bounded = x[self.indices]
        inside = (bounded >= self.lower) & (bounded <= self.upper) & (self.lower < self.upper)
        return inside.astype(float)[:, None, None]

    def on_boundary(self, x: Vector) -> Numbers:
        """Return the components at a bound; exact, since `project` assigns it."""
        bounded = x[self.indices]
        return self.indices[(bounded <= self.lower) | (bounded >= self.upper)]

    def longest_step(self, x: Vector, p: Vector) -> float:
        """Return the largest a for which this rank's part of x - a p is feasible."""
        bounded, speed = x[self.indices], p[self.indices]
        moving = speed != 0.0
        way = np.where(speed > 0.0, bounded - self.lower, bounded - self.upper)[moving]
        return float(np.min(way / speed[moving], initial=np.inf))

    def reduced_gradient(self, x: Vector, g: Vector, step_length: float) -> Vector:
        """Return (x - P(x - a g)) / a on the bounded components, a the step length."""
        bounded = x[self.indices]
        largest = (bounded - self.lower) / step_length
        smallest = (bounded - self.upper) / step_length
        return np.maximum(np.minimum(g[self.indices], largest), smallest)


@dataclass(frozen=True)
class Discs:
    """The factor of the x with ``|x[indices[k]] - centre[k]| <= radius[k]`` for all k.

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

    def scaled(self, factor: float) -> Discs:
        """Return the set with centres and radii multiplied by a positive factor."""
        return Discs(self.indices, factor * self.centre, factor * self.radius)

    def project(self, x: Vector) -> Vector:
        """Project x in place onto the feasible set and return it."""
        y, distance = self._from_centre(x)
        outside = distance > self.radius
        factor = self.radius[outside] / distance[outside]
        x[self.indices[outside]] = self.centre[outside] + factor[:, None] * y[outside]
        return x

    def derivative(self, x: Vector) -> Vector:
        """Return P'(x) of each disc, (discs, 2, 2).

        Outside of a disc it is r / |y| times the projection on the tangent.
        """
        y, distance = self._from_centre(x)
        blocks = np.tile(np.identity(2), (self.radius.size, 1, 1))
        outside = distance > self.radius
        tangent = balls.tangents(y[outside] / distance[outside, None])
        factor = (self.radius[outside] / distance[outside])[:, None, None]
        blocks[outside] = factor * tangent[:, :, None] * tangent[:, None, :]
        return blocks

    def on_circle(self, x: Vector) -> Mask:
        """Tell of which discs the point is on the boundary, up to rounding of the projection."""
        distance = self._from_centre(x)[1]
        rounding = _ON_BOUNDARY * (self.radius + np.abs(self.centre).sum(axis=1))
        return distance >= self.radius - rounding

    def on_boundary(self, x: Vector) -> Numbers:
        """Return the components of the discs whose boundary the point is on."""
        return self.indices[self.on_circle(x)].ravel()

    def longest_step(self, x: Vector, p: Vector) -> float:
        """Return the largest a for which this rank's part of x - a p is feasible."""
        speed, (y, distance) = p[self.indices], self._from_centre(x)
        room = (self.radius - distance) * (self.radius + distance)
        steps = balls.longest_steps(np.sum(speed**2, axis=1), np.sum(y * speed, axis=1), room)
        return float(steps.min(initial=np.inf))

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
class FrictionCones:
    """The factor of normal forces n >= 0 and tangential forces with ``|t| <= r + m n``.

    With m = 0 the bound of the tangential force is given; with r = 0 the set is a second-order
    cone.

    Attributes
    ----------
    indices : (k, 1 + d) integer array
        The components n, t of each, d = 1 or 2; a rank holds and owns all of them or none.
    radius, slope : (k,) arrays
        r and m, at least 0.

    Examples
    --------
    >>> import numpy as np
    >>> cone = FrictionCones(np.array([[0, 1]]), np.zeros(1), np.ones(1))
    >>> cone.project(np.array([0.0, 2.0])).round(12).tolist()
    [1.0, 1.0]
    >>> (cone.project(np.array([-3.0, 2.0])) + 0.0).tolist()
    [0.0, 0.0]
    """

    indices: Numbers
    radius: Vector
    slope: Vector

    def scaled(self, factor: float) -> FrictionCones:
        """Return the set with r and m multiplied by a positive factor."""
        return FrictionCones(self.indices, factor * self.radius, factor * self.slope)

    def project(self, x: Vector) -> Vector:
        """Project x in place onto the set and return it."""
        x[self.indices] = self._nearest(x[self.indices])
        return x

    def derivative(self, x: Vector) -> Vector:
        """Return P'(x) of each cone, (k, 1 + d, 1 + d)."""
        y, m = x[self.indices], self.slope[:, None]
        n, size, on_side = self._places(y)
        direction = balls.directions(y[:, 1:])
        # the derivative of the normal force n' of the projection
        normal = np.zeros(y.shape)
        normal[:, 0] = n > 0.0
        side = np.column_stack([np.ones(n.size), m * direction]) / (1.0 + m**2)
        normal = np.where(on_side[:, None], side, normal)
        # the tangential force is t where |t| <= b = r + m n', and b t / |t| elsewhere
        bound = self.radius + self.slope * self._pressed(n, size, on_side)
        outside = size > bound
        blocks = np.tile(np.identity(y.shape[1]), (n.size, 1, 1))
        blocks[:, 1:, 1:] -= outside[:, None, None] * direction[:, :, None] * direction[:, None, :]
        blocks[outside] *= (bound[outside] / size[outside])[:, None, None]
        blocks[:, 1:] += (outside[:, None] * m * direction)[:, :, None] * normal[:, None, :]
        blocks[:, 0] = normal
        return blocks

    def on_boundary(self, x: Vector) -> Numbers:
        """Return the components of the cones whose boundary the point is on, up to rounding."""
        n, size, _ = self._places(x[self.indices])
        bound = self.radius + self.slope * n
        return self.indices[(n <= 0.0) | (size >= (1.0 - _ON_BOUNDARY) * bound)].ravel()

    def longest_step(self, x: Vector, p: Vector) -> float:
        """Return the largest a for which this rank's part of x - a p is feasible."""
        y, v = x[self.indices], p[self.indices]
        bound, slower = self.radius + self.slope * y[:, 0], self.slope * v[:, 0]
        side = balls.longest_steps(
            np.sum(v[:, 1:] ** 2, axis=1) - slower**2,
            np.sum(y[:, 1:] * v[:, 1:], axis=1) - slower * bound,
            bound**2 - np.sum(y[:, 1:] ** 2, axis=1),
        )
        pressed = v[:, 0] > 0.0
        return float(np.min(y[pressed, 0] / v[pressed, 0], initial=side.min(initial=np.inf)))

    def reduced_gradient(self, x: Vector, g: Vector, step_length: float) -> Vector:
        """Return (x - P(x - a g)) / a on the cones, (k, 1 + d), a the step length."""
        y = x[self.indices]
        return (y - self._nearest(y - step_length * g[self.indices])) / step_length

    def _nearest(self, y: Vector) -> Vector:
        """Return the nearest points of blocks (k, 1 + d)."""
        n = self._pressed(*self._places(y))
        return np.column_stack([n, balls.project(y[:, 1:], self.radius + self.slope * n)])

    def _places(self, y: Vector) -> tuple[Vector, Vector, Mask]:
        """Return n, |t|, and whether the projection is on the cone's side, n' > 0."""
        n, size = y[:, 0], np.linalg.norm(y[:, 1:], axis=1)
        outside = size > self.radius + self.slope * np.maximum(n, 0.0)
        return n, size, outside & (self._along(n, size) > 0.0)

    def _pressed(self, n: Vector, size: Vector, on_side: Mask) -> Vector:
        """Return the normal force of the projection."""
        return np.where(on_side, self._along(n, size), np.maximum(n, 0.0))

    def _along(self, n: Vector, size: Vector) -> Vector:
        """Return n' of the nearest point of the line |t| = r + m n."""
        return (n + self.slope * (size - self.radius)) / (1.0 + self.slope**2)


@dataclass(frozen=True)
class ProductSet:
    """The product of bounds, discs and friction cones, and of lines for all other components.

    Attributes
    ----------
    bounds : Bounds
        The half-lines and intervals.
    discs : Discs or None
        The discs, of components without bounds; None where no rank has one.
    cones : FrictionCones or None
        The cones, of other components; None where no rank has one.

    Examples
    --------
    >>> import numpy as np
    >>> unit = Discs(np.array([[1, 2]]), np.zeros((1, 2)), np.ones(1))
    >>> feasible = ProductSet(Bounds.from_below(np.array([0]), np.zeros(1)), unit)
    >>> feasible.project(np.array([-2.0, 3.0, 4.0, 5.0]))
    array([0. , 0.6, 0.8, 5. ])
    """

    bounds: Bounds = field(default_factory=Bounds.none)
    discs: Discs | None = None
    cones: FrictionCones | None = None

    @property
    def factors(self) -> list[Bounds | Discs | FrictionCones]:
        """The factors, the same kinds on all ranks."""
        return [factor for factor in (self.bounds, self.discs, self.cones) if factor is not None]

    @property
    def curved(self) -> bool:
        """Whether there are other factors than bounds, on any rank."""
        return len(self.factors) > 1

    def scaled(self, factor: float) -> ProductSet:
        """Return the set with finite bounds, centres, radii and slopes times a positive factor."""
        return ProductSet(
            self.bounds.scaled(factor),
            None if self.discs is None else self.discs.scaled(factor),
            None if self.cones is None else self.cones.scaled(factor),
        )

    def project(self, x: Vector) -> Vector:
        """Project x in place onto the feasible set and return it."""
        for factor in self.factors:
            factor.project(x)
        return x

    def derivative(self, x: Vector) -> sp.csr_matrix:
        """Return P'(x), (n, n), for any x; on the boundary a generalized derivative."""
        lines = np.ones(x.size, dtype=bool)
        parts: list[tuple[Vector, Numbers, Numbers]] = []
        for factor in self.factors:
            blocks = factor.derivative(x)
            indices = factor.indices.reshape(blocks.shape[:2])
            lines[indices] = False
            rows, columns = np.broadcast_arrays(indices[:, :, None], indices[:, None, :])
            parts.append((blocks.ravel(), rows.ravel(), columns.ravel()))
        free = np.flatnonzero(lines)
        parts.append((np.ones(free.size), free, free))
        entries, row, column = (np.concatenate(part) for part in zip(*parts, strict=True))
        kept = entries != 0.0
        return sp.csr_matrix((entries[kept], (row[kept], column[kept])), (x.size, x.size))

    def on_boundary(self, x: Vector) -> Numbers:
        """Return the components of blocks on the boundary of their factor, ascending."""
        return np.sort(np.concatenate([factor.on_boundary(x) for factor in self.factors]))

    def longest_step(self, x: Vector, p: Vector) -> float:
        """Return the largest a for which this rank's part of x - a p is feasible."""
        return min(factor.longest_step(x, p) for factor in self.factors)

    def reduced_gradient(self, x: Vector, g: Vector, step_length: float) -> Vector:
        """Return g~ = (x - P(x - a g)) / a, a the step length; g on lines."""
        reduced = g.copy()
        for factor in self.factors:
            reduced[factor.indices] = factor.reduced_gradient(x, g, step_length)
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

        A block is in the interior or on the boundary of its factor of the set.

        Parameters
        ----------
        x, g : (n,) array
            Feasible point and gradient there.
        step_length : float
            The fixed step length in the reduced gradient.
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
        free, boundary = g.copy(), np.zeros_like(g)
        reduced, on_boundary = self.reduced_gradient(x, g, step_length), self.on_boundary(x)
        free[on_boundary] = 0.0
        boundary[on_boundary] = reduced[on_boundary]
        free2, boundary2 = space.partial(free, free), space.partial(boundary, boundary)
        gradient2, boundary2, reduced_free, constraint2, conjugation = space.sums(
            free2 + boundary2,
            boundary2,
            space.partial(reduced, free),
            0.0 if Qx is None else space.partial(Qx, Qx),
            0.0 if Ap is None else space.partial(free, Ap),
        )
        return Split(free, boundary, gradient2, boundary2, reduced_free, constraint2, conjugation)

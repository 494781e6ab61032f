"""MPRGP: modified proportioning with reduced gradient projections (algorithm 8.2)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fenics_tfeti.qp.feasible_set import Bounds, Split
from fenics_tfeti.qp.proportioning import (
    Hessian,
    Products,
    Proportioning,
    ProportioningOptions,
    ProportioningResult,
    Unbounded,
)
from fenics_tfeti.qp.space import Space
from fenics_tfeti.typing import Numbers, Vector


def mprgp(
    hessian: Hessian,
    b: Vector,
    bounds: Bounds,
    x: Vector,
    stop: Callable[[Split], bool],
    *,
    options: ProportioningOptions | None = None,
    space: Space | None = None,
    gradient: tuple[Vector, Vector | None] | None = None,
    precondition: Callable[[Vector, Numbers], Vector] | None = None,
    products: Products | None = None,
) -> ProportioningResult:
    """Minimise 1/2 x'Ax - b'x subject to bounds by MPRGP (algorithm 8.2).

    Parameters
    ----------
    hessian : callable
        x -> (Ax, Qx): the product with the symmetric positive definite A, and a second linear
        function of x that is updated by the same recurrences, or None.
    b : (n,) array
        Right-hand side.
    bounds : Bounds
        Bounded components and their bounds.
    x : (n,) array
        Start; projected to the feasible set.
    stop : callable
        Stopping test, a function of the `Split` of the gradient.
    options : ProportioningOptions, optional
        Parameters of the method.
    space : Space, optional
        The inner product; by default that of vectors on one rank.
    gradient : (array, array or None), optional
        Ax - b and Qx at a feasible x, where known: saves the first product.
    precondition : callable, optional
        phi, on_bounds -> M^{-1} phi in the face, with the indices of the active bounds; components
        there are set to zero afterwards.
    products : Products, optional
        Counter to add to.

    Returns
    -------
    ProportioningResult
        Last iterate, its gradient, and whether the stopping test was met.

    Raises
    ------
    Unbounded
        If the cost has no lower bound on the feasible set.

    Examples
    --------
    A string of two nodes over an obstacle; the first node touches it.

    >>> import numpy as np
    >>> A = np.array([[2.0, -1.0], [-1.0, 2.0]])
    >>> b = np.array([-3.0, 0.0])
    >>> bounds = Bounds.from_vector(np.array([-1.0, -1.0]))
    >>> result = mprgp(
    ...     lambda x: (A @ x, None),
    ...     b,
    ...     bounds,
    ...     np.zeros(2),
    ...     lambda split: split.gradient_norm < 1e-12,
    ...     options=ProportioningOptions(step_length=1.9 / 3.0),
    ... )
    >>> result.x.round(12).tolist()
    [-1.0, -0.5]
    """
    method = Proportioning(
        hessian,
        b,
        bounds,
        options or ProportioningOptions(),
        space or Space(),
        precondition,
        Products() if products is None else products,
    )
    method.start(x, gradient)
    return method.run(stop, lambda: _proportioning_step(method, bounds))


def _proportioning_step(method: Proportioning, bounds: Bounds) -> None:
    """Step 2: x -= (g'd / d'Ad) d along the chopped gradient d = beta, no farther than feasible."""
    d = np.zeros_like(method.x)
    d[bounds.indices] = bounds.chopped_gradient(method.x, method.g)
    Ad, Qd = method.product(d, "proportioning")
    # lower bounds cannot be hit, but the opposite ends of intervals can
    gd, curvature, longest = method.space.dots_and_min(
        (method.g, d), (d, Ad), value=bounds.longest_step(method.x, d)
    )
    if curvature <= 0.0 and not np.isfinite(longest):
        raise Unbounded(
            "the cost function falls without limit when a bound is released: the Hessian is "
            "not positive definite there; add the missing constraints or regularise"
        )
    length = gd / curvature if curvature > 0.0 else np.inf
    method.move(min(length, longest), d, Ad, Qd)
    method.new_face()

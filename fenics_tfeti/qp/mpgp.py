"""MPGP: modified proportioning with gradient projections, for sets with curved boundaries.

The face is left by a projected step along the whole gradient. Along its part tangential to the
boundary alone, a step of the same length would increase the cost where the normal gradient divided
by the radius exceeds 2 / step_length.
"""

from __future__ import annotations

from collections.abc import Callable

from fenics_tfeti.qp.feasible_set import FeasibleSet, ProductSet, Split
from fenics_tfeti.qp.proportioning import (
    Hessian,
    Products,
    Proportioning,
    ProportioningOptions,
    ProportioningResult,
)
from fenics_tfeti.qp.space import Space
from fenics_tfeti.typing import Numbers, Vector


def mpgp(
    hessian: Hessian,
    b: Vector,
    feasible: FeasibleSet,
    x: Vector,
    stop: Callable[[Split], bool],
    *,
    options: ProportioningOptions | None = None,
    space: Space | None = None,
    gradient: tuple[Vector, Vector | None] | None = None,
    precondition: Callable[[Vector, Numbers], Vector] | None = None,
    products: Products | None = None,
) -> ProportioningResult:
    """Minimise 1/2 x'Ax - b'x on a product of lines, half-lines, intervals and discs by MPGP.

    Blocks in the interior of their factor of the set have phi = g. On the boundary phi = 0, and the
    gradient counts as far as a projected step moves the block. The stopping quantity is the
    reduced gradient g~ = (x - P(x - a g)) / a with the step length a, since the projected gradient
    does not tend to zero continuously at curved boundaries.

    Parameters
    ----------
    hessian : callable
        x -> (Ax, Qx), see `mprgp`.
    b : (n,) array
        Right-hand side.
    feasible : FeasibleSet
        The set, with or without discs.
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
        phi, on_boundary -> M^{-1} phi in the face, with the indices of the components on the
        boundary; components there are set to zero afterwards.
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
    The point of the unit disc that is nearest to (3, 4).

    >>> import numpy as np
    >>> from fenics_tfeti.qp import Discs, ProductSet
    >>> unit = ProductSet(discs=Discs(np.array([[0, 1]]), np.zeros((1, 2)), np.ones(1)))
    >>> result = mpgp(
    ...     lambda x: (x, None),
    ...     np.array([3.0, 4.0]),
    ...     unit,
    ...     np.zeros(2),
    ...     lambda split: split.gradient_norm < 1e-12,
    ... )
    >>> result.x.round(12).tolist()
    [0.6, 0.8]
    """
    method = Proportioning(
        hessian,
        b,
        feasible if isinstance(feasible, ProductSet) else ProductSet(feasible),
        options or ProportioningOptions(),
        space or Space(),
        precondition,
        Products() if products is None else products,
    )
    method.start(x, gradient)
    return method.run(stop, lambda: _gradient_projection_step(method))


def _gradient_projection_step(method: Proportioning) -> None:
    """Step 2: x = P(x - a g) with the fixed step length a."""
    method.x = method.feasible.project(method.x - method.options.step_length * method.g)
    method.recompute_gradient("proportioning")
    method.new_face()

"""SMALBE-M: semimonotonic augmented Lagrangians for product sets and equalities (algorithm 9.2).

For problems of the form (11.43), as (11.40) is; steps and tests as in theorem 11.2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from fenics_tfeti.qp.feasible_set import ProductSet, Split
from fenics_tfeti.qp.proportioning import (
    Hessian,
    Products,
    ProportioningOptions,
    proportioning,
)
from fenics_tfeti.qp.space import Space
from fenics_tfeti.typing import Numbers, Vector

Reason = Literal["converged", "slow", "max_it", "max_products"]

# lower limit of the inner tolerance, relative to that of the final test: below it the increase of
# the Lagrangian is rounding, and M would be reduced without need
_INNER_FLOOR = 0.1


@dataclass(frozen=True)
class SMALBEOptions:
    """Parameters of SMALBE-M, named as in theorem 11.2.

    Attributes
    ----------
    rtol : float
        eps in the stopping test (11.47), relative to ||b||.
    rho : float
        Penalty parameter, part of the Hessian that `smalbe` is given; constant.
    M0 : float
        Initial balance parameter M_0 > 0 of gradient and equality residual, (11.46).
    beta : float
        Factor in (0, 1) by which M is multiplied if the Lagrangian increases too little.
    eta : float
        Upper limit of the inner gradient, relative to ||b||, in (0, 1].
    max_it : int
        Limit on outer iterations.
    patience : int
        Outer iterations in a row that do not halve the smallest ||Gx||, after which the iterations
        end as slow: so many updates mu += rho Gx are as good as one.
    inner : ProportioningOptions
        Parameters of the inner solver; its ``max_products`` limits the sum over all calls.
    """

    rtol: float = 1e-6
    rho: float = 1.0
    M0: float = 1.0
    beta: float = 0.5
    eta: float = 0.1
    max_it: int = 200
    patience: int = 200
    inner: ProportioningOptions = field(default_factory=ProportioningOptions)


@dataclass(frozen=True)
class OuterIteration:
    """The end of the k-th outer iteration.

    Attributes
    ----------
    number : int
        k, from 0.
    products : int
        Products with the Hessian so far.
    gradient, constraint : float
        ||g^P|| (see `Split`) and ||Gx||, relative to ||b||.
    M : float
        The balance parameter M_k.
    active : int
        Number of components on the boundary of the feasible set, over all ranks.
    """

    number: int
    products: int
    gradient: float
    constraint: float
    M: float
    active: int


@dataclass
class SMALBEState:
    """An iterate, from which a later call may continue.

    Attributes
    ----------
    x : (n,) array
        Feasible iterate.
    q : (n,) array
        G'mu, the equality multipliers' part of the gradient.
    M : float or None
        The balance parameter M_k; None for M_0.
    """

    x: Vector
    q: Vector
    M: float | None = None


@dataclass(frozen=True)
class SMALBEResult:
    """Result of SMALBE-M.

    Attributes
    ----------
    state : SMALBEState
        The last iterate x and G'mu.
    gradient : (n,) array
        Gradient of the augmented Lagrangian at x.
    converged : bool
        Whether (11.47) holds.
    reason : {"converged", "slow", "max_it", "max_products"}
        The stopping test held, ||Gx|| decreases too slowly, or the limit that ended the iterations.
    history : list of OuterIteration
        One entry for each outer iteration.
    """

    state: SMALBEState
    gradient: Vector
    converged: bool
    reason: Reason
    history: list[OuterIteration]


def smalbe(
    hessian: Hessian,
    b: Vector,
    feasible: ProductSet,
    start: SMALBEState,
    *,
    norm_b: float | None = None,
    options: SMALBEOptions | None = None,
    space: Space | None = None,
    precondition: Callable[[Vector, Numbers], Vector] | None = None,
    products: Products | None = None,
    monitor: Callable[[OuterIteration], None] | None = None,
) -> SMALBEResult:
    """Minimise 1/2 x'Ax - b'x subject to Gx = o on a product set by SMALBE-M (algorithm 9.2).

    The inner solver is that of `proportioning` for the set: MPRGP where it has bounds alone.

    Parameters
    ----------
    hessian : callable
        x -> ((A + rho Q)x, Qx) with Q = G'G, the rows of G orthonormal. G itself is not needed, and
        an outer iteration costs no product.
    b : (n,) array
        Right-hand side.
    feasible : ProductSet
        The set.
    start : SMALBEState
        First iterate and multipliers; zeros for theorem 11.2.
    norm_b : float, optional
        Scale of the relative tolerances; ||b|| by default.
    options : SMALBEOptions, optional
        Parameters of the method.
    space : Space, optional
        The inner product.
    precondition : callable, optional
        Preconditioner in the face, see `proportioning`.
    products : Products, optional
        Counter to add to.
    monitor : callable, optional
        Called with every `OuterIteration`.

    Returns
    -------
    SMALBEResult
        Last iterate, multipliers, and why the iterations ended.

    Examples
    --------
    Minimise 1/2 ||x||^2 - x_1 - 2 x_2 subject to x_1 = x_2 and x >= o.

    >>> import numpy as np
    >>> from fenics_tfeti.qp import Bounds, ProductSet
    >>> Q = 0.5 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    >>> result = smalbe(
    ...     lambda x: (x + Q @ x, Q @ x),
    ...     np.array([1.0, 2.0]),
    ...     ProductSet(Bounds.from_vector(np.zeros(2))),
    ...     SMALBEState(np.zeros(2), np.zeros(2)),
    ...     options=SMALBEOptions(rtol=1e-10, inner=ProportioningOptions(step_length=0.9)),
    ... )
    >>> result.state.x.round(8).tolist()
    [1.5, 1.5]
    """
    options = options or SMALBEOptions()
    space = space or Space()
    products = Products() if products is None else products
    norm_b = space.norm(b) if norm_b is None else norm_b
    tolerance = options.rtol * norm_b

    def solved(split: Split) -> bool:  # (11.47)
        return max(split.gradient_norm, split.constraint_norm) <= tolerance

    x, q = feasible.project(start.x.copy()), start.q
    M = options.M0 if start.M is None else start.M
    gradient = _first_gradient(hessian, b, x, q, space, products)
    history: list[OuterIteration] = []
    # ||Gx||^2 at the last update of mu; before the first one any increase is enough
    before = np.inf
    smallest, since = np.inf, 0
    for k in range(options.max_it):

        def balanced(split: Split, M: float = M) -> bool:  # (11.46)
            wanted = max(M * split.constraint_norm, _INNER_FLOOR * tolerance)
            return split.gradient_norm <= min(wanted, options.eta * norm_b)

        # Step 1: inner iterations until ||g^P(x, mu, rho)|| <= min(M_k ||Gx||, eta), or (11.47)
        inner = proportioning(
            hessian,
            b - q,
            feasible,
            x,
            lambda split: solved(split) or balanced(split),  # noqa: B023 - used in this pass only
            options=options.inner,
            space=space,
            gradient=gradient,
            precondition=precondition,
            products=products,
        )
        moved, x, split = inner.x - x, inner.x, inner.split
        history.append(
            OuterIteration(
                k,
                products.total,
                split.gradient_norm / norm_b if norm_b > 0.0 else 0.0,
                split.constraint_norm / norm_b if norm_b > 0.0 else 0.0,
                M,
                _count_active(feasible, x, space),
            )
        )
        if monitor is not None:
            monitor(history[-1])
        # Step 2: stop if ||g^P|| <= eps ||b|| and ||Gx|| <= eps ||b||
        if solved(split) or not inner.converged:
            reason: Reason = "converged" if solved(split) else "max_products"
            return SMALBEResult(
                SMALBEState(x, q, M), inner.gradient, solved(split), reason, history
            )
        if split.constraint_norm <= 0.5 * smallest:
            smallest, since = split.constraint_norm, k
        elif k - since >= options.patience:
            return SMALBEResult(SMALBEState(x, q, M), inner.gradient, False, "slow", history)
        # Step 4: M_{k+1} = beta M_k if L increased by less than rho/2 ||Gx||^2: by rho ||Gx||^2 in
        # the last update of mu, then by the change at constant mu. The difference of the values of
        # L would be rounding where ||Gx||^2 is below it, and a large M then repeats two iterates
        change = 0.5 * space.dots((moved, inner.gradient + gradient[0]))[0]
        increase = options.rho * before + change
        if increase < 0.5 * options.rho * split.constraint2:
            M *= options.beta
        before = split.constraint2
        # Step 3: mu += rho Gx, with q = G'mu
        assert inner.Qx is not None
        q = q + options.rho * inner.Qx
        gradient = inner.gradient + options.rho * inner.Qx, inner.Qx
    return SMALBEResult(SMALBEState(x, q, M), gradient[0], False, "max_it", history)


def _first_gradient(
    hessian: Hessian, b: Vector, x: Vector, q: Vector, space: Space, products: Products
) -> tuple[Vector, Vector | None]:
    """Return the gradient and Qx at the start, without a product where x = o."""
    if space.norm(x) == 0.0:
        return q - b, np.zeros_like(x)
    products.cg += 1
    Ax, Qx = hessian(x)
    return Ax - b + q, Qx


def _count_active(feasible: ProductSet, x: Vector, space: Space) -> int:
    on_boundary = feasible.on_boundary(x)
    owned = on_boundary.size if space.owned is None else np.searchsorted(on_boundary, space.owned)
    return int(space.sums(float(owned))[0])

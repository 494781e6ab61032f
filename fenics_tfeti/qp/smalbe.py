"""SMALBE-M: semimonotonic augmented Lagrangians for product sets and equalities (algorithm 9.2).

For problems of the form (11.43), as (11.40) is; steps and tests as in theorem 11.2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np

from fenics_tfeti.qp.feasible_set import ProductSet, Split
from fenics_tfeti.qp.proportioning import (
    Hessian,
    Products,
    ProportioningOptions,
    ProportioningResult,
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
    tests = _Tests(options.rtol * norm_b, options.eta * norm_b, options.patience)
    x, q = feasible.project(start.x.copy()), start.q
    M = options.M0 if start.M is None else start.M
    gradient = _first_gradient(hessian, b, x, q, space, products)
    history: list[OuterIteration] = []
    # ||Gx||^2 at the last update of mu; before the first one any increase is enough
    before = np.inf
    for k in range(options.max_it):
        # Step 1: inner iterations until ||g^P(x, mu, rho)|| <= min(M_k ||Gx||, eta), or (11.47)
        inner = proportioning(
            hessian,
            b - q,
            feasible,
            x,
            partial(tests.end_inner, M=M),
            options=options.inner,
            space=space,
            gradient=gradient,
            precondition=precondition,
            products=products,
        )
        moved, x, split = inner.x - x, inner.x, inner.split
        active = _count_active(feasible, x, space)
        history.append(_outer_iteration(k, products, split, norm_b, M, active))
        if monitor is not None:
            monitor(history[-1])
        # Step 2: stop if ||g^P|| <= eps ||b|| and ||Gx|| <= eps ||b||
        reason = tests.end(inner, k)
        if reason is not None:
            state = SMALBEState(x, q, M)
            return SMALBEResult(state, inner.gradient, reason == "converged", reason, history)
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


@dataclass
class _Tests:
    """The tests that end inner and outer iterations.

    `smallest` is the smallest ||Gx|| that was half of the one before, `since` its iteration.
    """

    tolerance: float
    eta: float
    patience: int
    smallest: float = np.inf
    since: int = 0

    def solved(self, split: Split) -> bool:
        """Tell whether (11.47) holds."""
        return max(split.gradient_norm, split.constraint_norm) <= self.tolerance

    def end_inner(self, split: Split, M: float) -> bool:
        """Tell whether (11.46) or (11.47) holds."""
        limit = min(max(M * split.constraint_norm, _INNER_FLOOR * self.tolerance), self.eta)
        return self.solved(split) or split.gradient_norm <= limit

    def end(self, inner: ProportioningResult, k: int) -> Reason | None:
        """Return why the outer iterations end, if they do."""
        if self.solved(inner.split):
            return "converged"
        if not inner.converged:
            return "max_products"
        if inner.split.constraint_norm <= 0.5 * self.smallest:
            self.smallest, self.since = inner.split.constraint_norm, k
        return "slow" if k - self.since >= self.patience else None


def _outer_iteration(
    k: int, products: Products, split: Split, norm_b: float, M: float, active: int
) -> OuterIteration:
    scale = 1.0 / norm_b if norm_b > 0.0 else 0.0
    gradient, constraint = scale * split.gradient_norm, scale * split.constraint_norm
    return OuterIteration(k, products.total, gradient, constraint, M, active)


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

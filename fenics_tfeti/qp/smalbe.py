"""SMALBE-M: semimonotonic augmented Lagrangians for bounds and equalities (algorithm 9.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.qp.feasible_set import Bounds, Split
from fenics_tfeti.qp.mprgp import Hessian, MPRGPOptions, Products, mprgp
from fenics_tfeti.qp.space import Space

__all__ = ["OuterIteration", "SMALBEOptions", "SMALBEResult", "SMALBEState", "smalbe"]

Vector = NDArray[np.float64]
Reason = Literal["converged", "max_it", "max_products"]

# the inner gradient need not be smaller than this part of what the final test wants: near the end
# the growth of the Lagrangian drowns in rounding, and M falls without need
_INNER_FLOOR = 0.1


@dataclass(frozen=True)
class SMALBEOptions:
    """Parameters of SMALBE-M, named as in theorem 11.2.

    Attributes
    ----------
    rtol : float
        eps in the stopping test (11.47), relative to ||b||.
    rho : float
        Penalty, already inside the Hessian that `smalbe` is given; never changed.
    M0 : float
        Initial balance M_0 > 0 between the gradient and the violated equalities, (11.46).
    beta : float
        Factor in (0, 1) by which M is reduced when the Lagrangian grows too little.
    eta : float
        Upper limit of the inner gradient, relative to ||b||, in (0, 1].
    max_it : int
        Limit on outer iterations.
    inner : MPRGPOptions
        Parameters of the inner solver; its ``max_products`` limits the sum over all calls.
    """

    rtol: float = 1e-6
    rho: float = 1.0
    M0: float = 1.0
    beta: float = 0.5
    eta: float = 0.1
    max_it: int = 200
    inner: MPRGPOptions = field(default_factory=MPRGPOptions)


@dataclass(frozen=True)
class OuterIteration:
    """One line of the history: where the k-th outer iteration ended.

    Attributes
    ----------
    number : int
        k, from 0.
    products : int
        Products with the Hessian so far.
    gradient, constraint : float
        ||g^P|| and ||Gx||, relative to ||b||.
    M : float
        The balance M_k that was used.
    active : int
        Active bounds, over all processes.
    """

    number: int
    products: int
    gradient: float
    constraint: float
    M: float
    active: int


@dataclass
class SMALBEState:
    """What a later call needs to go on where an earlier one stopped.

    Attributes
    ----------
    x : (n,) array
        Feasible iterate.
    q : (n,) array
        G'mu, the equality multipliers' part of the gradient.
    M : float or None
        The balance M_k; None starts with M_0.
    """

    x: Vector
    q: Vector
    M: float | None = None


@dataclass(frozen=True)
class SMALBEResult:
    """What SMALBE-M returns.

    Attributes
    ----------
    state : SMALBEState
        The last iterate x and G'mu.
    gradient : (n,) array
        Gradient of the augmented Lagrangian at x.
    converged : bool
        Whether (11.47) holds.
    reason : {"converged", "max_it", "max_products"}
        The stopping test held, or the limit that ended the iterations.
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
    bounds: Bounds,
    start: SMALBEState,
    *,
    norm_b: float | None = None,
    options: SMALBEOptions | None = None,
    space: Space | None = None,
    precondition: Callable[[Vector], Vector] | None = None,
    products: Products | None = None,
    monitor: Callable[[OuterIteration], None] | None = None,
) -> SMALBEResult:
    """Minimise 1/2 x'Ax - b'x subject to Gx = o and lower bounds by SMALBE-M (algorithm 9.2).

    Parameters
    ----------
    hessian : callable
        x -> ((A + rho Q)x, Qx) with Q = G'G, the rows of G orthonormal. As only Q is needed, G is
        never formed, and an outer iteration costs no product.
    b : (n,) array
        Right-hand side.
    bounds : Bounds
        Bounded components and their bounds.
    start : SMALBEState
        First iterate and multipliers; zeros for theorem 11.2.
    norm_b : float, optional
        ||b||, where another scale than the norm of `b` is meant by the relative tolerances.
    options : SMALBEOptions, optional
        Parameters of the method.
    space : Space, optional
        The inner product.
    precondition : callable, optional
        Preconditioner in the face, see `mprgp`.
    products : Products, optional
        Counter to add to.
    monitor : callable, optional
        Called with every `OuterIteration`.

    Returns
    -------
    SMALBEResult
        Iterate, multipliers, whether it converged and why it stopped.

    Examples
    --------
    Minimise 1/2 ||x||^2 - x_1 - 2 x_2 subject to x_1 = x_2 and x >= o.

    >>> import numpy as np
    >>> Q = 0.5 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    >>> result = smalbe(
    ...     lambda x: (x + Q @ x, Q @ x),
    ...     np.array([1.0, 2.0]),
    ...     Bounds.from_vector(np.zeros(2)),
    ...     SMALBEState(np.zeros(2), np.zeros(2)),
    ...     options=SMALBEOptions(rtol=1e-10, inner=MPRGPOptions(step_length=0.9)),
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
        return max(split.projected_norm, split.constraint_norm) <= tolerance

    x, q = bounds.project(start.x.copy()), start.q
    M = options.M0 if start.M is None else start.M
    gradient = _first_gradient(hessian, b, x, q, space, products)
    history: list[OuterIteration] = []
    previous_lagrangian = -np.inf
    for k in range(options.max_it):

        def balanced(split: Split, M: float = M) -> bool:  # (11.46)
            wanted = max(M * split.constraint_norm, _INNER_FLOOR * tolerance)
            return split.projected_norm <= min(wanted, options.eta * norm_b)

        # Step 1
        inner = mprgp(
            hessian,
            b - q,
            bounds,
            x,
            lambda split: solved(split) or balanced(split),  # noqa: B023 - used in this pass only
            options=options.inner,
            space=space,
            gradient=gradient,
            precondition=precondition,
            products=products,
        )
        x, split = inner.x, inner.split
        history.append(
            OuterIteration(
                k,
                products.total,
                split.projected_norm / norm_b if norm_b > 0.0 else 0.0,
                split.constraint_norm / norm_b if norm_b > 0.0 else 0.0,
                M,
                _count_active(bounds, x, space),
            )
        )
        if monitor is not None:
            monitor(history[-1])
        if solved(split) or not inner.converged:
            reason: Reason = "converged" if solved(split) else "max_products"
            return SMALBEResult(
                SMALBEState(x, q, M), inner.gradient, solved(split), reason, history
            )
        # Step 2, and the Lagrangian L(x, mu, rho) = 1/2 x'(g - b + q) with the mu of Step 1
        lagrangian = 0.5 * space.dots((x, inner.gradient - b + q))[0]
        assert inner.Qx is not None
        q = q + options.rho * inner.Qx
        gradient = inner.gradient + options.rho * inner.Qx, inner.Qx
        # Step 3
        if lagrangian < previous_lagrangian + 0.5 * options.rho * split.constraint2:
            M *= options.beta
        previous_lagrangian = lagrangian
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


def _count_active(bounds: Bounds, x: Vector, space: Space) -> int:
    owned = None if space.owned is None else int(np.searchsorted(bounds.indices, space.owned))
    return int(space.sums(float(np.count_nonzero(bounds.active(x)[:owned])))[0])

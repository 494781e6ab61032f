"""MPRGP: modified proportioning with reduced gradient projections (algorithm 8.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.qp.feasible_set import Bounds, Split
from fenics_tfeti.qp.space import Space

__all__ = ["Hessian", "MPRGPOptions", "MPRGPResult", "Products", "Unbounded", "mprgp"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
Hessian = Callable[[Vector], tuple[Vector, Vector | None]]
Expansion = Literal["standard", "projected_cg"]

# curvature of a direction relative to ||A|| that counts as none
_NO_CURVATURE = 1e-15


class Unbounded(ValueError):
    """The cost has no lower bound on the feasible set, or rounding hides its curvature."""


@dataclass
class Products:
    """Number of products with the Hessian by kind of step, and of preconditioner applications.

    Products of an expansion step that is undone count as expansion, those that recompute the
    gradient after `MPRGPOptions.refresh` recurrences as cg.
    """

    cg: int = 0
    expansion: int = 0
    proportioning: int = 0
    preconditioner: int = 0

    @property
    def total(self) -> int:
        """Number of products with the Hessian."""
        return self.cg + self.expansion + self.proportioning


@dataclass(frozen=True)
class MPRGPOptions:
    """Parameters of MPRGP.

    Attributes
    ----------
    Gamma : float
        Proportioning constant Gamma > 0: the face is left when ||beta|| > Gamma ||phi~||.
    step_length : float
        Fixed step length of expansion, in (0, 2/||A||).
    expansion : {"standard", "projected_cg"}
        Half step and fixed step of the algorithm, or the projected conjugate gradient step
        (MPPCG), which is undone and replaced by the standard one if the cost rises.
    max_products : int
        Limit on the products with the Hessian.
    refresh : int
        Number of recurrences after which the gradient is recomputed from its definition.
    """

    Gamma: float = 1.0
    step_length: float = 1.9
    expansion: Expansion = "standard"
    max_products: int = 10_000
    refresh: int = 50


@dataclass(frozen=True)
class MPRGPResult:
    """Result of MPRGP.

    Attributes
    ----------
    x, gradient : (n,) array
        The last iterate and the gradient Ax - b there.
    Qx : (n,) array or None
        The second result of the Hessian at x, kept by the same recurrences.
    split : Split
        The parts of the gradient at x.
    converged : bool
        Whether the stopping test was met; otherwise the limit on products was.
    """

    x: Vector
    gradient: Vector
    Qx: Vector | None
    split: Split
    converged: bool


def mprgp(
    hessian: Hessian,
    b: Vector,
    bounds: Bounds,
    x: Vector,
    stop: Callable[[Split], bool],
    *,
    options: MPRGPOptions | None = None,
    space: Space | None = None,
    gradient: tuple[Vector, Vector | None] | None = None,
    precondition: Callable[[Vector, Numbers], Vector] | None = None,
    products: Products | None = None,
) -> MPRGPResult:
    """Minimise 1/2 x'Ax - b'x subject to lower bounds by MPRGP (algorithm 8.2).

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
    options : MPRGPOptions, optional
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
    MPRGPResult
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
    ...     lambda split: split.projected_norm < 1e-12,
    ...     options=MPRGPOptions(step_length=1.9 / 3.0),
    ... )
    >>> result.x.round(12).tolist()
    [-1.0, -0.5]
    """
    method = _Iteration(
        hessian,
        b,
        bounds,
        options or MPRGPOptions(),
        space or Space(),
        precondition,
        Products() if products is None else products,
    )
    method.start(x, gradient)
    while not stop(method.split):
        if method.products.total >= method.options.max_products:
            return method.result(converged=False)
        method.step()
    return method.result(converged=True)


@dataclass
class _Iteration:
    """The state of the iteration; `step` is one pass of algorithm 8.2."""

    hessian: Hessian
    b: Vector
    bounds: Bounds
    options: MPRGPOptions
    space: Space
    precondition: Callable[[Vector, Numbers], Vector] | None
    products: Products
    x: Vector = field(init=False)
    g: Vector = field(init=False)
    Qx: Vector | None = field(init=False)
    split: Split = field(init=False)
    p: Vector | None = field(init=False)  # None: the preconditioned free gradient
    recurrences: int = field(init=False, default=0)

    def start(self, x: Vector, gradient: tuple[Vector, Vector | None] | None) -> None:
        self.x = self.bounds.project(x.copy())
        if gradient is None:
            self.recompute_gradient("cg")
        else:
            self.g = gradient[0].copy()
            self.Qx = None if gradient[1] is None else gradient[1].copy()
        self.new_face()

    def result(self, converged: bool) -> MPRGPResult:
        return MPRGPResult(self.x, self.g, self.Qx, self.split, converged)

    def step(self) -> None:
        strictly_proportional = (
            self.split.chopped2 <= self.options.Gamma**2 * self.split.reduced_free
        )
        # Step 1: ||beta||^2 <= Gamma^2 phi~'phi
        if strictly_proportional:
            self.conjugate_gradient_step()
        # Step 2: otherwise
        else:
            self.proportioning_step()

    def conjugate_gradient_step(self) -> None:
        """Take a conjugate gradient step, or an expansion step if that leaves the feasible set."""
        p = self.preconditioned_free_gradient() if self.p is None else self.p
        Ap, Qp = self.product(p, "cg")
        gp, curvature, pp, longest = self.space.dots_and_min(
            (self.g, p), (p, Ap), (p, p), value=self.bounds.longest_step(self.x, p)
        )
        # 1 / step_length stands for ||A||: no curvature but that of rounding
        flat = curvature <= _NO_CURVATURE * pp / self.options.step_length
        if flat and not np.isfinite(longest):
            raise Unbounded(
                "the cost function falls without limit along a feasible direction: the Hessian is "
                "not positive definite there; add the missing constraints or regularise"
            )
        # Step 1: alpha_cg = g'p / p'Ap against alpha_f, the longest feasible step
        length = np.inf if flat else gp / curvature
        if length <= longest:
            # Step 1.a: x -= alpha_cg p, g -= alpha_cg Ap, p = z - (z'Ap / p'Ap) p
            self.move(length, p, Ap, Qp)
            if self.recurrences >= self.options.refresh:
                self.recompute_gradient("cg")
                self.new_face()
                return
            self.update_split(Ap)
            z = self.preconditioned_free_gradient()
            # without preconditioner z'Ap = phi'Ap, which is part of the split
            alone = self.precondition is None
            zAp = self.split.conjugation if alone else self.space.dots((z, Ap))[0]
            self.p = z - zAp / curvature * p
        elif self.options.expansion == "projected_cg" and not flat:
            self.projected_step(length, longest, p, Ap, Qp)
        else:
            self.expansion_step(longest, p, Ap, Qp)

    def expansion_step(self, longest: float, p: Vector, Ap: Vector, Qp: Vector | None) -> None:
        """Step 1.b: the step to the nearest bound, then a projected step of fixed length."""
        self.products.cg -= 1
        self.products.expansion += 1
        self.move(longest, p, Ap, Qp)
        free = self.g.copy()
        on_bounds = self.bounds.indices[self.bounds.active(self.x)]
        free[on_bounds] = 0.0
        self.x -= self.options.step_length * free
        self.bounds.project(self.x)
        self.recompute_gradient("expansion")
        self.new_face()

    def projected_step(
        self, length: float, longest: float, p: Vector, Ap: Vector, Qp: Vector | None
    ) -> None:
        """Step 1.b of MPPCG: the projected conjugate gradient step, undone if the cost rises."""
        before = self.x, self.g, self.Qx, self.cost()
        self.x = self.bounds.project(self.x - length * p)
        self.recompute_gradient("expansion")
        if self.cost() <= before[3]:
            self.products.cg -= 1
            self.products.expansion += 1
            self.new_face()
        else:
            self.x, self.g, self.Qx = before[:3]
            self.expansion_step(longest, p, Ap, Qp)

    def proportioning_step(self) -> None:
        """Step 2: x -= (g'd / d'Ad) d along the chopped gradient d = beta."""
        d = np.zeros_like(self.x)
        d[self.bounds.indices] = self.split.chopped
        Ad, Qd = self.product(d, "proportioning")
        gd, curvature = self.space.dots((self.g, d), (d, Ad))
        if curvature <= 0.0:
            raise Unbounded(
                "the cost function falls without limit when a bound is released: the Hessian is "
                "not positive definite there; add the missing constraints or regularise"
            )
        self.move(gd / curvature, d, Ad, Qd)
        self.new_face()

    def product(self, x: Vector, kind: str) -> tuple[Vector, Vector | None]:
        setattr(self.products, kind, getattr(self.products, kind) + 1)
        return self.hessian(x)

    def recompute_gradient(self, kind: str) -> None:
        Ax, self.Qx = self.product(self.x, kind)
        self.g = Ax - self.b
        self.recurrences = 0

    def move(self, length: float, p: Vector, Ap: Vector, Qp: Vector | None) -> None:
        # the step is feasible but for rounding; the projection makes active bounds exact
        self.x = self.bounds.project(self.x - length * p)
        self.g = self.g - length * Ap
        if Qp is not None and self.Qx is not None:
            self.Qx = self.Qx - length * Qp
        self.recurrences += 1

    def cost(self) -> float:
        return 0.5 * self.space.sums(self.space.partial(self.x, self.g - self.b))[0]

    def update_split(self, Ap: Vector | None = None) -> None:
        self.split = self.bounds.split(
            self.x, self.g, self.options.step_length, self.space, self.Qx, Ap
        )

    def new_face(self) -> None:
        """Restart the conjugate gradients from the (preconditioned) free gradient."""
        self.update_split()
        self.p = None

    def preconditioned_free_gradient(self) -> Vector:
        if self.precondition is None:
            return self.split.free
        self.products.preconditioner += 1
        on_bounds = self.bounds.indices[self.bounds.active(self.x)]
        z = self.precondition(self.split.free, on_bounds)
        z[on_bounds] = 0.0
        return z

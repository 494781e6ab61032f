"""Modified proportioning: MPRGP (algorithm 8.2) for bounds, MPGP for sets with curved boundaries.

Conjugate gradient steps in the face of the iterate while the gradient on the boundary of the
feasible set is small against the rest; such a step that would leave the set expands the face. Where
it is not small the face is left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from fenics_tfeti.qp.feasible_set import ProductSet, Split
from fenics_tfeti.qp.space import Space
from fenics_tfeti.typing import Numbers, Vector

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
    gradient after `ProportioningOptions.refresh` recurrences as cg.
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
class ProportioningOptions:
    """Parameters of MPRGP and MPGP.

    Attributes
    ----------
    Gamma : float
        Proportioning constant Gamma > 0: the face is left when the gradient on the boundary is
        longer than Gamma ||phi~||.
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
class ProportioningResult:
    """Result of MPRGP or MPGP.

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


def proportioning(
    hessian: Hessian,
    b: Vector,
    feasible: ProductSet,
    x: Vector,
    stop: Callable[[Split], bool],
    *,
    options: ProportioningOptions | None = None,
    space: Space | None = None,
    gradient: tuple[Vector, Vector | None] | None = None,
    precondition: Callable[[Vector, Numbers], Vector] | None = None,
    products: Products | None = None,
) -> ProportioningResult:
    """Minimise 1/2 x'Ax - b'x on a product set by MPRGP or MPGP.

    With the parts phi, phi~ and beta of the gradient (see `Split`):

    1. Where ||beta||^2 <= Gamma^2 phi~'phi, a conjugate gradient step in the face. If it leaves the
       set, an expansion step instead.
    2. Otherwise a step that leaves the face.

    The two methods differ in step 2. Where the set has bounds alone it is the proportioning step of
    MPRGP (algorithm 8.2), to the minimum along beta but no farther than feasible. Boundaries of
    discs and cones are curved, and MPGP takes the projected gradient step x = P(x - a g) of fixed
    length a. (A step along the part of g tangential to the boundary would increase the cost where
    the normal gradient divided by the radius exceeds 2 / a.)

    Parameters
    ----------
    hessian : callable
        x -> (Ax, Qx): the product with the symmetric positive definite A, and a second linear
        function of x that is updated by the same recurrences, or None.
    b : (n,) array
        Right-hand side.
    feasible : ProductSet
        The set.
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
    A string of two nodes over an obstacle; the first node touches it.

    >>> import numpy as np
    >>> from fenics_tfeti.qp import Bounds, Discs, ProductSet
    >>> A = np.array([[2.0, -1.0], [-1.0, 2.0]])
    >>> result = proportioning(
    ...     lambda x: (A @ x, None),
    ...     np.array([-3.0, 0.0]),
    ...     ProductSet(Bounds.from_vector(np.array([-1.0, -1.0]))),
    ...     np.zeros(2),
    ...     lambda split: split.gradient_norm < 1e-12,
    ...     options=ProportioningOptions(step_length=1.9 / 3.0),
    ... )
    >>> result.x.round(12).tolist()
    [-1.0, -0.5]

    The point of the unit disc that is nearest to (3, 4).

    >>> result = proportioning(
    ...     lambda x: (x, None),
    ...     np.array([3.0, 4.0]),
    ...     ProductSet(discs=Discs(np.array([[0, 1]]), np.zeros((1, 2)), np.ones(1))),
    ...     np.zeros(2),
    ...     lambda split: split.gradient_norm < 1e-12,
    ... )
    >>> result.x.round(12).tolist()
    [0.6, 0.8]
    """
    method = Proportioning(
        hessian,
        b,
        feasible,
        options or ProportioningOptions(),
        space or Space(),
        precondition,
        Products() if products is None else products,
    )
    method.start(x, gradient)
    return method.run(stop)


@dataclass
class Proportioning:
    """The state of the iteration, and the steps that change it.

    x, g and Qx are the iterate, the gradient Ax - b and the second result of the Hessian; `split`
    the parts of g. The conjugate direction p is None for the preconditioned free gradient, and
    `recurrences` counts the updates of g since it was computed from its definition.
    """

    hessian: Hessian
    b: Vector
    feasible: ProductSet
    options: ProportioningOptions
    space: Space
    precondition: Callable[[Vector, Numbers], Vector] | None
    products: Products
    x: Vector = field(init=False)
    g: Vector = field(init=False)
    Qx: Vector | None = field(init=False)
    split: Split = field(init=False)
    p: Vector | None = field(init=False)
    recurrences: int = field(init=False, default=0)

    def start(self, x: Vector, gradient: tuple[Vector, Vector | None] | None) -> None:
        """Begin at the projection of x; at a feasible x the gradient may be known."""
        self.x = self.feasible.project(x.copy())
        if gradient is None:
            self.recompute_gradient("cg")
        else:
            self.g = gradient[0].copy()
            self.Qx = None if gradient[1] is None else gradient[1].copy()
        self.new_face()

    def run(self, stop: Callable[[Split], bool]) -> ProportioningResult:
        """Step until the stopping test holds or the limit on products is met."""
        while not (converged := stop(self.split)):
            if self.products.total >= self.options.max_products:
                break
            if self.split.boundary2 <= self.options.Gamma**2 * self.split.reduced_free:
                self.conjugate_gradient_step()
            elif self.feasible.curved:
                self.gradient_projection_step()
            else:
                self.proportioning_step()
        return ProportioningResult(self.x, self.g, self.Qx, self.split, converged)

    def proportioning_step(self) -> None:
        """Step 2 of MPRGP: x -= (g'd / d'Ad) d along d = beta, no farther than feasible."""
        d = self.split.boundary
        Ad, Qd = self.product(d, "proportioning")
        # lower bounds cannot be hit, but the opposite ends of intervals can
        gd, curvature, dd, longest = self.space.dots_and_min(
            (self.g, d), (d, Ad), (d, d), value=self.feasible.longest_step(self.x, d)
        )
        flat = self.is_flat(curvature, dd)
        if flat and not np.isfinite(longest):
            raise Unbounded(
                "the cost function falls without limit when a bound is released: the Hessian is "
                "not positive definite there; add the missing constraints or regularise"
            )
        length = np.inf if flat else gd / curvature
        self.move(min(length, longest), d, Ad, Qd)
        self.new_face()

    def gradient_projection_step(self) -> None:
        """Step 2 of MPGP: x = P(x - a g) with the fixed step length a."""
        self.x = self.feasible.project(self.x - self.options.step_length * self.g)
        self.recompute_gradient("proportioning")
        self.new_face()

    def conjugate_gradient_step(self) -> None:
        """Take a conjugate gradient step, or an expansion step if that leaves the feasible set."""
        p = self.preconditioned_free_gradient() if self.p is None else self.p
        Ap, Qp = self.product(p, "cg")
        gp, curvature, pp, longest = self.space.dots_and_min(
            (self.g, p), (p, Ap), (p, p), value=self.feasible.longest_step(self.x, p)
        )
        flat = self.is_flat(curvature, pp)
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
        """Step 1.b: the step to the boundary, then a projected step of fixed length."""
        self.products.cg -= 1
        self.products.expansion += 1
        self.move(longest, p, Ap, Qp)
        free = self.g.copy()
        free[self.feasible.on_boundary(self.x)] = 0.0
        self.x -= self.options.step_length * free
        self.feasible.project(self.x)
        self.recompute_gradient("expansion")
        self.new_face()

    def projected_step(
        self, length: float, longest: float, p: Vector, Ap: Vector, Qp: Vector | None
    ) -> None:
        """Step 1.b of MPPCG: the projected conjugate gradient step, undone if the cost rises."""
        before = self.x, self.g, self.Qx, self.cost()
        self.x = self.feasible.project(self.x - length * p)
        self.recompute_gradient("expansion")
        if self.cost() <= before[3]:
            self.products.cg -= 1
            self.products.expansion += 1
            self.new_face()
        else:
            self.x, self.g, self.Qx = before[:3]
            self.expansion_step(longest, p, Ap, Qp)

    def is_flat(self, curvature: float, square: float) -> bool:
        """Tell whether a direction with d'Ad and d'd has no curvature but that of rounding."""
        # 1 / step_length stands for ||A||
        return curvature <= _NO_CURVATURE * square / self.options.step_length

    def product(self, x: Vector, kind: str) -> tuple[Vector, Vector | None]:
        """Return Ax and Qx, counted."""
        setattr(self.products, kind, getattr(self.products, kind) + 1)
        return self.hessian(x)

    def recompute_gradient(self, kind: str) -> None:
        """Compute the gradient from its definition."""
        Ax, self.Qx = self.product(self.x, kind)
        self.g = Ax - self.b
        self.recurrences = 0

    def move(self, length: float, p: Vector, Ap: Vector, Qp: Vector | None) -> None:
        """Go to x - length p, and update the gradient by recurrence."""
        # the step is feasible but for rounding; the projection makes the boundary exact
        self.x = self.feasible.project(self.x - length * p)
        self.g = self.g - length * Ap
        if Qp is not None and self.Qx is not None:
            self.Qx = self.Qx - length * Qp
        self.recurrences += 1

    def cost(self) -> float:
        """Return 1/2 x'Ax - b'x = 1/2 x'(g - b)."""
        return 0.5 * self.space.sums(self.space.partial(self.x, self.g - self.b))[0]

    def update_split(self, Ap: Vector | None = None) -> None:
        """Split the gradient at x."""
        self.split = self.feasible.split(
            self.x, self.g, self.options.step_length, self.space, self.Qx, Ap
        )

    def new_face(self) -> None:
        """Restart the conjugate gradients from the (preconditioned) free gradient."""
        self.update_split()
        self.p = None

    def preconditioned_free_gradient(self) -> Vector:
        """Return M^{-1} phi, zero on the boundary."""
        if self.precondition is None:
            return self.split.free
        self.products.preconditioner += 1
        on_boundary = self.feasible.on_boundary(self.x)
        z = self.precondition(self.split.free, on_boundary)
        z[on_boundary] = 0.0
        return z

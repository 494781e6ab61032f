"""Iterates of the dual problem, and what the methods for it have in common.

Each method is a function (problem, iterate, turn) -> iterate. It starts from its own memory, which
the iterate keeps for it, or from the multipliers. `solution.strategy` has the order of the methods.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

from fenics_tfeti.feti.dual.pcpg import PCPGIterate
from fenics_tfeti.feti.options import Options
from fenics_tfeti.qp import OuterIteration, Products
from fenics_tfeti.typing import Mask, Vector


class SolveStatus(Enum):
    """How the solution of the dual problem has ended, in words with the names of options."""

    NOT_STARTED = "nothing was solved"
    SOLVED = "converged"
    STALLED = "the method makes no more progress, or its share of the products is spent"
    INEXACT = "the method makes no more progress, but its solution is accurate enough"
    CENTRED = "a proximal problem is solved, the next one has its solution as centre"
    AT_ROUNDING = "rounding has ended the conjugate gradients"
    FLAT = (
        "SMALBE-M found no curvature along a direction: the contact conditions contradict each "
        "other, or rounding hides it"
    )
    OUT_OF_STEPS = "limit of {smalbe_max_it} outer iterations (smalbe_max_it)"
    OUT_OF_PRODUCTS = "limit of {max_products} products (max_products)"
    AT_LIMIT = "the accuracy is at the limit of rounding: more iterations do not change it"
    INTERRUPTED = "interrupted"

    def describe(self, options: Options) -> str:
        """Return the sentence with the values of the options."""
        return self.value.format(**vars(options))


class Method(Enum):
    """The methods for the dual problem."""

    ACTIVE_SET = "active_set"
    GRADIENTS = "gradients"
    NEWTON = "newton"
    SMALBE = "smalbe"

    @property
    def words(self) -> str:
        """The name in a sentence."""
        return _WORDS[self]


_WORDS = {
    Method.ACTIVE_SET: "the active set method",
    Method.GRADIENTS: "the method of projected gradients",
    Method.NEWTON: "Newton's method on proximal problems",
    Method.SMALBE: "SMALBE-M",
}


@dataclass(frozen=True)
class Iterate:
    """An iterate of the dual problem."""

    multipliers: Vector  # (m,): lambda, feasible on contact and tangential rows
    method: Method = Method.ACTIVE_SET  # the one that made it, and that goes on first
    status: SolveStatus = SolveStatus.NOT_STARTED
    on_face: PCPGIterate | None = None  # iterate on a face, with these multipliers
    # what a method goes on from in its next turn, which only that method reads
    memory: Mapping[Method, Any] = field(default_factory=dict)
    radius: Vector | None = None  # (k,): slip bounds that have followed the forces
    # (i,): set to start from; None for the rows with positive multipliers
    active: Mask | None = None
    # (k, gdim - 1): slips of sites to start from, scaled as the rows; None if not known
    slips: Vector | None = None
    is_direct: bool = False  # of a start: whether faces are solved directly from it on

    def remembering(self, method: Method, state: Any) -> Iterate:
        """Return the iterate with another memory of a method."""
        return replace(self, memory={**self.memory, method: state})

    def at_multipliers(self, slips: Vector) -> Iterate:
        """Return the iterate to start from its multipliers, active set and slips alone.

        Rounding has added up in the recurrences of its residual.
        """
        active = self.active if self.on_face is None else self.on_face.face.active
        iterate = self.remembering(Method.GRADIENTS, None)
        return replace(iterate, on_face=None, active=active, slips=slips)


@dataclass(frozen=True)
class ActiveSetStep:
    """One face of the primal-dual active set method, or one step of Newton's method.

    Attributes
    ----------
    products : int
        Products so far.
    residual : float
        Norm of the projected residual on the face [m].
    active : int
        Active contact rows of the face.
    changed : int
        Rows that enter or leave the set after it, and sites of friction that stick or slip
        after it.
    """

    products: int
    residual: float
    active: int
    changed: int


@dataclass(frozen=True)
class Turn:
    """Tolerance and limits of a method in its turn."""

    tolerance: float  # of the energy of the residual [sqrt(J)]
    max_products: int  # limit on `products`
    products: Products
    monitor: Callable[[ActiveSetStep | OuterIteration], None]
    options: Options = field(default_factory=Options)
    max_outer: int = 200  # limit on outer iterations of SMALBE-M
    patience: int = 200  # outer iterations in a row that may fail to halve ||Gx||

    @property
    def is_spent(self) -> bool:
        """Tell whether the limit on products is met."""
        return self.products.total >= self.max_products

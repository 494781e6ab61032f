"""Data, candidates, outcome and counters of one solve."""

from __future__ import annotations

from dataclasses import dataclass, field

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.friction import SlipBound
from fenics_tfeti.feti.constraints.springs import Springs
from fenics_tfeti.feti.dual.iterate import ActiveSetStep, Iterate, Method, SolveStatus
from fenics_tfeti.feti.solution.certificate import Certificate
from fenics_tfeti.feti.solution.recovery import Recovered
from fenics_tfeti.qp import OuterIteration, Products
from fenics_tfeti.typing import Vector


@dataclass(frozen=True)
class ContactData:
    """The data of one solve: loads and right-hand sides."""

    load: Vector  # (n,) f of this rank's subdomains [N]
    c: Vector  # (m,)
    e: Vector  # (coarse,) R'f
    e_size: Vector  # (coarse,) |R|'|f|, which the rounding of e is relative to
    feasible: Vector  # (m,) lambda~ with G lambda~ = e, lambda~_I >= o and |lambda~_T| <= r
    bound: SlipBound  # the law of friction
    own_bound: SlipBound  # its parts at the contact rows that this rank gave
    radius: Vector  # (k,) r: slip bounds in units of multipliers, Coulomb's for some normal forces
    motion: Vector | None = None  # (coarse,) rigid motions a that were taken out of c
    springs: Springs | None = None  # of contact rows
    # (m,) a of rows that adhere: multipliers here are lambda + a, and the load has B'a
    adhesion: Vector | None = None
    removed: Vector | float = 0.0  # (m,) B R a of those of them that supports prescribe

    def without_adhesion(self, multipliers: Vector) -> Vector:
        """Return the multipliers lambda (m,) of contact that adheres."""
        return multipliers if self.adhesion is None else multipliers - self.adhesion


@dataclass(frozen=True)
class Candidate:
    """A solution with its certificate; the `free` motions of its face are undetermined."""

    recovered: Recovered
    multipliers: Vector  # (m,) lambda
    certificate: Certificate
    energy: float  # 1/2 u'Ku - f'u, with springs, and with friction the sum of r |s| [J]
    projector: Projector  # of the face: contact rows with a force, and sites that stick
    slips: Vector  # (k, gdim - 1) s at the sites of friction, scaled as the rows
    radius: Vector  # (k,) r


@dataclass(frozen=True)
class Outcome:
    """Result of the outer loop: the last candidate, or the best one if none is certified."""

    candidate: Candidate  # the best one has the smallest certificate
    iterate: Iterate
    status: SolveStatus  # SOLVED if the certificate holds
    reason: str  # the status in words
    tolerance: float  # of the dual problem in the last pass [sqrt(J)]

    @property
    def converged(self) -> bool:
        """True if the certificate holds."""
        return self.status is SolveStatus.SOLVED

    @property
    def start(self) -> Iterate:
        """Where a later solve may start."""
        return Iterate(self.iterate.multipliers)


@dataclass(frozen=True)
class SlipBoundStep:
    """A step of the fixed point on the slip bounds of Coulomb's law.

    Attributes
    ----------
    products : int
        Applications of F in the solution with the bounds of this step.
    change : float
        Difference between the friction forces and the bounds that the normal forces make, relative
        to these.
    ratio : float or None
        The change over that of the step before: the contraction.
    rtol : float
        Tolerance of the solution.
    """

    products: int
    change: float
    ratio: float | None
    rtol: float


Step = ActiveSetStep | OuterIteration | SlipBoundStep


@dataclass
class History:
    """Counters and histories of one solve."""

    products: Products = field(default_factory=Products)  # with F, by kind of step
    outer: list[OuterIteration] = field(default_factory=list)  # of SMALBE-M
    faces: list[ActiveSetStep] = field(default_factory=list)  # of the active set method
    slip_bounds: list[SlipBoundStep] = field(default_factory=list)  # of Coulomb's law
    spent: dict[Method, int] = field(default_factory=dict)  # products by method
    norm_products_before: int = 0  # products for ||PFP|| that were spent before
    deflation_solves: int = 0  # solves with K_i^+ of this rank that the set-up of deflation took

    def append(self, step: Step) -> int:
        """Add a step to those of its kind, and return its number among them."""
        if isinstance(step, ActiveSetStep):
            self.faces.append(step)
            return len(self.faces) - 1
        if isinstance(step, SlipBoundStep):
            self.slip_bounds.append(step)
            return len(self.slip_bounds) - 1
        self.outer.append(step)
        return len(self.outer) - 1

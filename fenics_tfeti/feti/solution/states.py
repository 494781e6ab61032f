"""Data, candidates, outcome and counters of one solve."""

from __future__ import annotations

from dataclasses import dataclass, field

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.friction import SlipBound
from fenics_tfeti.feti.dual.iterate import ActiveSetStep, Iterate, SolveStatus
from fenics_tfeti.feti.solution.certificate import Certificate
from fenics_tfeti.feti.solution.recovery import Recovered
from fenics_tfeti.qp import OuterIteration, Products
from fenics_tfeti.typing import Vector


@dataclass(frozen=True)
class ContactData:
    """The data of one solve: loads and right-hand sides.

    Attributes
    ----------
    load : (n,) array
        f of this rank's subdomains [N].
    c : (m,) array
        Right-hand sides of the constraints.
    e : (coarse,) array
        R'f.
    e_size : (coarse,) array
        |R|'|f|, which the rounding of e is relative to.
    feasible : (m,) array
        lambda~ with G lambda~ = e, lambda~_I >= o and |lambda~_T| <= r.
    bound : SlipBound
        The law of friction.
    radius : (k,) array
        r of each site of friction: its slip bound in units of multipliers, with Coulomb's law that
        of some normal forces.
    removed : (m,) array or float
        B R a of prescribed motions that were taken out of c.
    """

    load: Vector
    c: Vector
    e: Vector
    e_size: Vector
    feasible: Vector
    bound: SlipBound
    radius: Vector
    removed: Vector | float = 0.0


@dataclass(frozen=True)
class Candidate:
    """A solution with its certificate.

    Attributes
    ----------
    recovered : Recovered
        Displacements.
    multipliers : (m,) array
        lambda.
    certificate : Certificate
        How well they solve (11.21).
    energy : float
        1/2 u'Ku - f'u, with friction and the sum of r |s| [J].
    face : Projector
        That of the equality rows, the contact rows with a force and the sites that stick; its
        ``free`` motions are undetermined.
    slips : (k, gdim - 1) array
        s at the sites of friction, scaled as the rows.
    radius : (k,) array
        r of each site of friction.
    """

    recovered: Recovered
    multipliers: Vector
    certificate: Certificate
    energy: float
    face: Projector
    slips: Vector
    radius: Vector


@dataclass(frozen=True)
class Outcome:
    """Result of the outer loop.

    Attributes
    ----------
    candidate : Candidate
        The last candidate, or the one with the smallest certificate if none is certified.
    iterate : Iterate
        The last or best one.
    status : SolveStatus
        How the iterations ended: SOLVED if the certificate holds.
    reason : str
        The same in words.
    tolerance : float
        Tolerance of the dual problem in the last pass [sqrt(J)].
    """

    candidate: Candidate
    iterate: Iterate
    status: SolveStatus
    reason: str
    tolerance: float

    @property
    def converged(self) -> bool:
        """Whether the certificate holds."""
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
    """Counters and histories of one solve.

    Attributes
    ----------
    products : Products
        Products with F by kind of step.
    outer : list of OuterIteration
        One entry for each outer iteration of SMALBE-M.
    faces : list of ActiveSetStep
        One entry for each face of the active set method.
    slip_bounds : list of SlipBoundStep
        One entry for each step of Coulomb's law.
    norm_products_before : int
        Products for ||PFP|| that were spent before.
    deflation_solves : int
        Solves with K_i^+ of this rank that the set-up of deflation took.
    """

    products: Products = field(default_factory=Products)
    outer: list[OuterIteration] = field(default_factory=list)
    faces: list[ActiveSetStep] = field(default_factory=list)
    slip_bounds: list[SlipBoundStep] = field(default_factory=list)
    norm_products_before: int = 0
    deflation_solves: int = 0

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

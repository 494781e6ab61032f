"""Quadratic programmes on products of simple sets with equalities, given by an operator.

Independent of finite elements and domain decomposition: intervals, discs and friction cones, MPRGP
(algorithm 8.2), MPGP for sets with curved boundaries, SMALBE-M (algorithm 9.2) and a Lanczos bound
of the spectrum.
"""

from fenics_tfeti.qp import balls
from fenics_tfeti.qp.bounded_springs import (
    bounded_springs,
    least_norm,
    smallest_factor,
)
from fenics_tfeti.qp.feasible_set import Bounds, Discs, FrictionCones, ProductSet, Split
from fenics_tfeti.qp.proportioning import (
    Hessian,
    Products,
    ProportioningOptions,
    ProportioningResult,
    Unbounded,
    proportioning,
)
from fenics_tfeti.qp.smalbe import OuterIteration, SMALBEOptions, SMALBEResult, SMALBEState, smalbe
from fenics_tfeti.qp.space import Space
from fenics_tfeti.qp.spectrum import lanczos_estimate

__all__ = [
    "Bounds",
    "Discs",
    "FrictionCones",
    "Hessian",
    "OuterIteration",
    "ProductSet",
    "Products",
    "ProportioningOptions",
    "ProportioningResult",
    "SMALBEOptions",
    "SMALBEResult",
    "SMALBEState",
    "Space",
    "Split",
    "Unbounded",
    "balls",
    "lanczos_estimate",
    "least_norm",
    "bounded_springs",
    "proportioning",
    "smalbe",
    "smallest_factor",
]

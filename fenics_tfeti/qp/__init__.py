"""Quadratic programmes on products of intervals and discs with equalities, given by an operator.

Independent of finite elements and domain decomposition: MPRGP (algorithm 8.2), MPGP for sets with
curved boundaries, SMALBE-M (algorithm 9.2) and a Lanczos bound of the spectrum.
"""

from fenics_tfeti.qp.cones import FrictionCones
from fenics_tfeti.qp.feasible_set import Bounds, Discs, FeasibleSet, ProductSet, Split
from fenics_tfeti.qp.mpgp import mpgp
from fenics_tfeti.qp.mprgp import mprgp
from fenics_tfeti.qp.projected_newton import (
    HalfLines,
    least_norm,
    projected_newton,
    smallest_factor,
)
from fenics_tfeti.qp.proportioning import (
    Hessian,
    Products,
    ProportioningOptions,
    ProportioningResult,
    Unbounded,
)
from fenics_tfeti.qp.smalbe import OuterIteration, SMALBEOptions, SMALBEResult, SMALBEState, smalbe
from fenics_tfeti.qp.space import Space
from fenics_tfeti.qp.spectrum import lanczos_upper_bound

__all__ = [
    "Bounds",
    "Discs",
    "FeasibleSet",
    "FrictionCones",
    "HalfLines",
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
    "lanczos_upper_bound",
    "least_norm",
    "mpgp",
    "mprgp",
    "projected_newton",
    "smalbe",
    "smallest_factor",
]

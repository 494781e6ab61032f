"""Bound- and equality-constrained quadratic programmes, given as an operator and vectors.

Independent of finite elements and domain decomposition: MPRGP (algorithm 8.2), SMALBE-M
(algorithm 9.2) and a Lanczos bound of the spectrum.
"""

from fenics_tfeti.qp.feasible_set import Bounds
from fenics_tfeti.qp.least_squares import (
    least_distance,
    least_norm_nonnegative,
    least_norm_partly_nonnegative,
    nonnegative_least_squares,
)
from fenics_tfeti.qp.mprgp import MPRGPOptions, MPRGPResult, Products, Unbounded, mprgp
from fenics_tfeti.qp.smalbe import OuterIteration, SMALBEOptions, SMALBEResult, SMALBEState, smalbe
from fenics_tfeti.qp.space import Space
from fenics_tfeti.qp.spectrum import lanczos_upper_bound

__all__ = [
    "Bounds",
    "MPRGPOptions",
    "MPRGPResult",
    "OuterIteration",
    "Products",
    "SMALBEOptions",
    "SMALBEResult",
    "SMALBEState",
    "Space",
    "Unbounded",
    "lanczos_upper_bound",
    "least_distance",
    "least_norm_nonnegative",
    "least_norm_partly_nonnegative",
    "mprgp",
    "nonnegative_least_squares",
    "smalbe",
]

"""SMALBE-M on the dual problem with projector preconditioning, (11.40).

    minimise 1/2 x'(PFP + rho Q)x - x'Pd_0  subject to  Gx = o,  x_I >= -lambda~_I,

and |lambda~_T + x_T| <= r where there is friction, with lambda = lambda~ + x, the feasible lambda~
of (11.37) and d_0 = d - F lambda~. F is scaled by ||PFP||, so that ||PFP + rho Q|| = max(1, rho).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fenics_tfeti.feti import interruption
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.feti.options import Options
from fenics_tfeti.qp import (
    OuterIteration,
    Products,
    ProportioningOptions,
    SMALBEOptions,
    SMALBEResult,
    SMALBEState,
    smalbe,
)
from fenics_tfeti.typing import Numbers, Vector


class Stopped(Exception):  # noqa: N818 - no error
    """SMALBE-M was interrupted, on all ranks."""


def solve_by_smalbe(
    problem: DualProblem,
    feasible: Vector,
    d: Vector,
    start: SMALBEState,
    *,
    rtol: float,
    norm_b: float,
    options: Options,
    outer_so_far: int,
    patience: int,
    products: Products,
    monitor: Callable[[OuterIteration], None],
) -> SMALBEResult:
    """Run SMALBE-M on (11.40).

    Parameters
    ----------
    problem : DualProblem
        (11.36), with an upper bound of ||PFP|| as its norm.
    feasible, d : (m,) array
        lambda~ and d_0.
    start : SMALBEState
        First x, and the equality multipliers' part of the gradient [m].
    rtol, norm_b : float
        eps of (11.47) and the norm that it is relative to [m].
    options : Options
        Parameters of SMALBE-M and MPRGP.
    outer_so_far : int
        Outer iterations of earlier calls.
    patience : int
        Outer iterations in a row that may fail to halve ||Gx||.
    products : Products
        Counter to add to.
    monitor : callable
        Called with every `OuterIteration`.

    Returns
    -------
    SMALBEResult
        With the gradient's part in units of [m] again.

    Raises
    ------
    Stopped
        If a rank was interrupted.
    """
    norm = problem.norm
    result = smalbe(
        _until_interrupted(augmented_hessian(problem, options.smalbe_rho)),
        problem.projector.P(d) / norm,
        problem.multiplier_set(feasible),
        replace(start, q=start.q / norm),
        norm_b=norm_b / norm,
        options=_smalbe_options(options, rtol, outer_so_far, patience),
        space=problem.space,
        precondition=_augmented_preconditioner(problem, options.smalbe_rho),
        products=products,
        monitor=monitor,
    )
    return replace(result, state=replace(result.state, q=norm * result.state.q))


def _until_interrupted(
    hessian: Callable[[Vector], tuple[Vector, Vector]],
) -> Callable[[Vector], tuple[Vector, Vector]]:
    def apply(x: Vector) -> tuple[Vector, Vector]:
        if interruption.agreed():
            raise Stopped
        return hessian(x)

    return apply


def augmented_hessian(
    problem: DualProblem, rho: float
) -> Callable[[Vector], tuple[Vector, Vector]]:
    """Return x -> (PFP / ||PFP|| + rho Q)x, Qx, the Hessian of (11.40)."""
    projector, layout = problem.projector, problem.constraints.layout

    def apply(x: Vector) -> tuple[Vector, Vector]:
        part, Qx = projector.part_of_Q(x)
        y = projector.part_of_P(problem.F(x - Qx)) / problem.norm
        product, Qx = layout.sum(np.column_stack([y + rho * part, part])).T.copy()
        return product, Qx

    return apply


def _augmented_preconditioner(
    problem: DualProblem, rho: float
) -> Callable[[Vector, Numbers], Vector] | None:
    """Return M^{-1} = ||PFP|| P B_D S B_D' P + Q / rho, for the Hessian of (11.40).

    B_D is that of the rows whose multipliers are free. Where these depend on each other the cost
    falls without curvature, until one of them meets its bound; M^{-1} is the identity there.
    """
    preconditioner, projector = problem.preconditioner, problem.projector
    if preconditioner is None:
        return None

    def apply(x: Vector, on_bounds: Numbers) -> Vector:
        free = np.ones(x.size, dtype=bool)
        free[on_bounds] = False
        part, Qx = projector.part_of_Q(x)
        y = projector.part_of_P(preconditioner.on_face(free)(x - Qx))
        z = problem.constraints.layout.sum(problem.norm * y + part / rho)
        return z + preconditioner.kernel_part(x, free)

    return apply


def _smalbe_options(
    options: Options, rtol: float, outer_so_far: int, patience: int
) -> SMALBEOptions:
    inner = ProportioningOptions(
        Gamma=options.mprgp_gamma,
        step_length=options.mprgp_alpha / max(1.0, options.smalbe_rho),
        expansion=options.mprgp_expansion,
        max_products=options.max_products,
    )
    return SMALBEOptions(
        rtol=rtol,
        rho=options.smalbe_rho,
        M0=options.smalbe_M0,
        beta=options.smalbe_beta,
        eta=options.smalbe_eta,
        max_it=max(1, options.smalbe_max_it - outer_so_far),
        patience=patience,
        inner=inner,
    )

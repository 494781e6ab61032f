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
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.dual.face_operators import FaceOperators
from fenics_tfeti.feti.dual.iterate import Iterate, Method, SolveStatus, Turn
from fenics_tfeti.feti.dual.pcpg import first_iterate
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.qp import (
    ProportioningOptions,
    SMALBEOptions,
    SMALBEState,
    Unbounded,
    smalbe,
)
from fenics_tfeti.typing import Numbers, Vector


class _Stopped(Exception):  # noqa: N818 - no error
    """SMALBE-M was interrupted, on all ranks."""


def solve_by_smalbe(problem: DualProblem, start: Iterate, turn: Turn) -> Iterate:
    """Run SMALBE-M on (11.40).

    The norm of the problem has to be an upper bound of ||PFP||. Returns the start where SMALBE-M is
    interrupted or finds no curvature.
    """
    norm, options = problem.norm, turn.options
    start = replace(start, method=Method.SMALBE)
    state = _first_state(problem, start, turn)
    norm_b = problem.energy_norm * np.sqrt(norm)
    try:
        result = smalbe(
            _until_interrupted(augmented_hessian(problem, options.smalbe_rho)),
            problem.projector.P(problem.d_0) / norm,
            problem.multiplier_set(problem.feasible),
            replace(state, q=state.q / norm),
            norm_b=norm_b / norm,
            options=_smalbe_options(turn, turn.tolerance / (problem.energy_norm or 1.0)),
            space=problem.space,
            precondition=_augmented_preconditioner(problem, options.smalbe_rho),
            products=turn.products,
            monitor=turn.monitor,
        )
    except Unbounded:
        return replace(start, status=SolveStatus.FLAT)
    except _Stopped:
        return replace(start, status=SolveStatus.INTERRUPTED)
    state = replace(result.state, q=norm * result.state.q)
    if result.converged:
        # a balance parameter that the smaller tolerance of the next pass starts anew
        state = replace(state, M=None)
    return replace(
        start.remembering(Method.SMALBE, state),
        multipliers=problem.feasible + state.x,
        status=_STATUS[result.reason],
        on_face=None,
    )


_STATUS = {
    "converged": SolveStatus.SOLVED,
    "slow": SolveStatus.STALLED,
    "max_products": SolveStatus.STALLED,
    "max_it": SolveStatus.OUT_OF_STEPS,
}


def _first_state(problem: DualProblem, start: Iterate, turn: Turn) -> SMALBEState:
    """Return the first x, and G'mu = Q(Fl - d) + G'a, which costs a product where it is unknown."""
    known: SMALBEState | None = start.memory.get(Method.SMALBE)
    if known is not None:
        return known
    x, on_face = start.multipliers - problem.feasible, start.on_face
    if on_face is None and problem.space.norm(start.multipliers) > 0.0:
        face = problem.face_of(start.multipliers, start.active)
        operators = FaceOperators.build(problem, Projector.build(problem.coarse_space, face))
        on_face = first_iterate(problem, operators, start.multipliers, turn.products)
    q = np.zeros_like(x) if on_face is None else problem.projector.Q(on_face.gradient)
    return SMALBEState(x, q)


def _until_interrupted(
    hessian: Callable[[Vector], tuple[Vector, Vector]],
) -> Callable[[Vector], tuple[Vector, Vector]]:
    def apply(x: Vector) -> tuple[Vector, Vector]:
        if interruption.agreed():
            raise _Stopped
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
        rows = np.ones(x.size, dtype=bool)
        rows[on_bounds] = False
        free = Face.of_rows(problem.constraints, rows)
        part, Qx = projector.part_of_Q(x)
        y = projector.part_of_P(preconditioner.on(free)(x - Qx))
        z = problem.constraints.layout.sum(problem.norm * y + part / rho)
        return z + preconditioner.kernel_part(x, free)

    return apply


def _smalbe_options(turn: Turn, rtol: float) -> SMALBEOptions:
    options = turn.options
    inner = ProportioningOptions(
        Gamma=options.mprgp_gamma,
        step_length=options.mprgp_alpha / max(1.0, options.smalbe_rho),
        expansion=options.mprgp_expansion,
        max_products=turn.max_products,
    )
    return SMALBEOptions(
        rtol=rtol,
        rho=options.smalbe_rho,
        M0=options.smalbe_M0,
        beta=options.smalbe_beta,
        eta=options.smalbe_eta,
        max_it=max(1, turn.max_outer),
        patience=turn.patience,
        inner=inner,
    )

"""PCPG: preconditioned conjugate projected gradients on a face of the dual feasible set.

On a face (see `fenics_tfeti.feti.constraints.face`)

    minimise 1/2 l'Fl - d'l  subject to  Gl = e,  l = fixed + E'El,

with G and the projector P of the face, and further terms of the cost where forces of friction turn,
or with a proximal term. The gradient of the cost without these terms is kept on all rows, as
g = Fl - d + G'a with the rigid motions a of the face: where l = o it is the gap that is left, whose
sign tells whether the face is the right one.

With the lumped preconditioner M = B_D K B_D' the number r'Mr is the squared energy of B_D'r, with
B_D = W^{-1} B D^{-1} of the rows on the face: the displacement that closes the jumps r. So
sqrt(r'z) bounds the error of the displacement in the energy norm, see
`fenics_tfeti.feti.solution.certificate`. So it does with the Dirichlet preconditioner.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fenics_tfeti.feti import interruption
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.dual.face_operators import FaceOperators
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.qp import Products, balls
from fenics_tfeti.typing import Vector

# r'z above this multiple of its smallest value: the residual is rounding, and the recurrences of
# conjugate gradients amplify it (r'z of a regular problem may rise by its condition number)
_DIVERGED = 1e12
# after r'z has grown by this factor, the true residual is computed before a new best iterate is
# accepted; the two r'z agree up to the ratio
_RISEN, _SAME = 1e4, 4.0
# where the first step on a face raises the residual by this factor, the start without it is tried
_OVERSHOT = 1e3
# the iterations stop as limited by rounding if r'z was not halved in 200 steps and in three times
# the steps before
_PATIENCE, _PATIENCE_FACTOR = 200, 3
# p'Fp below this part of r'z, which it is about equal to with a good preconditioner, is rounding:
# P leaves nothing of F
_NO_CURVATURE = 64 * 2.0**-52
# stiffness of a slip against a friction force, relative to that of a weight of 1. 1 / ||PFP||, that
# of the whole body, is much too small where the body is thin: directions of forces then follow
# those of slips too slowly
_SLIP_STIFFNESS = 0.03


@dataclass(frozen=True)
class PCPGIterate:
    """An iterate on a face, with what the next step needs."""

    face: Face
    multipliers: Vector  # (m,): l, with Gl = e and the fixed ones off the face
    gradient: Vector  # (m,): Fl - d + G'a
    residual: float  # ||P(d - Fl)|| on the face [m]
    violation: float  # norm of what violates the signs, see `_norms`
    direction: Vector  # (m,): the last search direction
    rz_of_direction: float  # r'z of the residual from which the direction was made
    step_lengths: tuple[float, ...]  # of the conjugate gradients
    preconditioned: Vector | None = None  # (m,): z = PMr, once it is known
    rz: float = np.inf  # r'z, the squared energy of the residual [J]; infinite while z is not known
    at_limit: bool = False  # whether the residual is rounding: more steps do not reduce it
    is_direct: bool = False  # whether a direct solver made z, or the direction

    @property
    def energy(self) -> float:
        """sqrt(r'z) [sqrt(J)]."""
        return float(np.sqrt(max(self.rz, 0.0))) if self.residual > 0.0 else 0.0

    @property
    def step_length(self) -> float:
        """A typical step length."""
        return float(np.median(self.step_lengths)) if self.step_lengths else 0.0


def pcpg(
    problem: DualProblem,
    operators: FaceOperators,
    start: Vector | PCPGIterate,
    *,
    tolerance: float,
    sign_factor: float,
    max_products: int,
    products: Products,
    resume: bool = False,
    accurate: float = 0.0,
) -> PCPGIterate:
    """Minimise on a face until its signs are known well enough.

    The iterations end when the residual is below `sign_factor` times the violation of the signs
    (more accuracy would be spent on the wrong face), or below `accurate` [m], or its energy
    sqrt(r'z) below `tolerance` [sqrt(J)]; the signs are tested each time the residual has halved.
    `start` is the multipliers, or the last iterate on another face; with `resume` its conjugate
    gradients are continued on the same face. Where rounding ends the iterations, the iterate with
    the smallest energy, up to a factor of two, is returned.
    """
    if not (resume and isinstance(start, PCPGIterate)):
        iterate = first_iterate(problem, operators, start, products)
    else:
        iterate = start if start.is_direct == operators.is_direct else _restarted(start)
    test_below, best, peak, steps = 0.5 * iterate.residual, iterate, 0.0, 0
    while iterate.residual > 0.0 and products.total < max_products:
        if interruption.agreed():
            return iterate
        if iterate.residual <= test_below:
            iterate = _at_least_penetration(problem, operators, iterate)
            if iterate.residual <= max(sign_factor * iterate.violation, accurate):
                return iterate
            test_below = 0.5 * iterate.residual
        iterate = _with_preconditioned_residual(problem, operators, iterate, products)
        peak = max(peak, iterate.rz)
        # where r'z has risen far above its smallest value, rounding may have taken the multipliers
        # off Gl = e, which the residual of the recurrences does not show
        if _improves(iterate, best, tolerance) and peak > _RISEN * best.rz:
            true = _true_iterate(problem, operators, iterate, products)
            if not _improves(true, best, tolerance):
                return _at_least_penetration(problem, operators, replace(best, at_limit=True))
            iterate = iterate if true.rz <= _SAME * iterate.rz else true
        if iterate.energy <= tolerance:
            break
        if _improves(iterate, best, tolerance):
            best, peak = iterate, iterate.rz
        following = (
            None if _is_rounding(iterate, best) else _step(problem, operators, iterate, products)
        )
        if following is None:
            return _at_least_penetration(problem, operators, replace(best, at_limit=True))
        iterate, steps = following, steps + 1
        kind = problem.preconditioner
        if kind is not None and kind.becomes_direct(steps):
            operators, iterate = operators.direct(problem), _restarted(iterate)
            best, peak = iterate, 0.0
    return _at_least_penetration(problem, operators, iterate)


def _restarted(iterate: PCPGIterate) -> PCPGIterate:
    """Return the iterate without what another preconditioner has made."""
    none = np.zeros_like(iterate.gradient)
    return replace(iterate, direction=none, rz_of_direction=1.0, preconditioned=None, rz=np.inf)


def _at_least_penetration(
    problem: DualProblem, operators: FaceOperators, iterate: PCPGIterate
) -> PCPGIterate:
    """Return the iterate with the gaps that remain at the least penetration of loose bodies."""
    if operators.loose is None:
        return iterate
    gradient = operators.loose.at_least_penetration(iterate.gradient)
    _, violation = _norms(problem, operators.face, iterate.multipliers, gradient)
    return replace(iterate, gradient=gradient, violation=violation)


def _improves(iterate: PCPGIterate, best: PCPGIterate, tolerance: float) -> bool:
    """Tell whether r'z is half of the smallest so far, or within the tolerance."""
    return iterate.rz <= 0.5 * best.rz or iterate.energy <= tolerance


def _true_iterate(
    problem: DualProblem, operators: FaceOperators, iterate: PCPGIterate, products: Products
) -> PCPGIterate:
    """Return the iterate moved onto Gl = e, with its true residual and no direction; a product."""
    l = _nearest_on_face(problem, operators, iterate.multipliers)
    lengths = iterate.step_lengths
    true = _iterate_at(problem, operators, l, np.zeros_like(l), -problem.d, lengths, products)
    return _with_preconditioned_residual(problem, operators, true, products)


def _is_rounding(iterate: PCPGIterate, best: PCPGIterate) -> bool:
    """Tell whether r'z has risen, or has not been halved, for so long that it is rounding."""
    steps = len(best.step_lengths)
    waited = len(iterate.step_lengths) - steps
    return waited > max(_PATIENCE, _PATIENCE_FACTOR * steps) or iterate.rz > _DIVERGED * best.rz


def _step(
    problem: DualProblem, operators: FaceOperators, iterate: PCPGIterate, products: Products
) -> PCPGIterate | None:
    """Take one step of PCPG; return None where the curvature is not more than rounding."""
    # 1. z = PMr of the residual r = -g on the face
    l, g, z, rz = iterate.multipliers, iterate.gradient, iterate.preconditioned, iterate.rz
    assert z is not None
    # 2. direction: p = z + (r'z / r'z of the last step) p
    p = z + rz / iterate.rz_of_direction * iterate.direction
    # 3. product: PFp on the face, off it what the gaps change by; p'Fp
    curvature_gradient: Vector | float = 0.0
    part = _product(problem, p, products)
    if operators.face.has_terms:
        curvature_gradient = operators.face.curved(p)
        part = part + problem.constraints.layout.owned_part(curvature_gradient)
    change, curvature = operators.projector.remove_rigid_motion(part, p)
    if curvature <= _NO_CURVATURE * rz:
        return None
    # 4. step: l += alpha p, g += alpha PFp with alpha = r'z / p'Fp
    alpha = rz / curvature
    l, g = l + alpha * p, g + alpha * (change - curvature_gradient)
    lengths = (*iterate.step_lengths, alpha)
    norms, direct = _norms(problem, operators.face, l, g), operators.is_direct
    return PCPGIterate(operators.face, l, g, *norms, p, rz, lengths, is_direct=direct)


def _with_preconditioned_residual(
    problem: DualProblem, operators: FaceOperators, iterate: PCPGIterate, products: Products
) -> PCPGIterate:
    """Return the iterate with z = PMr and r'z of its residual r = -g on the face."""
    if iterate.preconditioned is not None:
        return iterate
    face = operators.face
    gradient = iterate.gradient
    if face.has_terms:
        gradient = gradient + face.gradient_of_terms(iterate.multipliers)
    z, rz = _precondition(operators, -face.part(gradient), products)
    if rz is None:
        # without preconditioner z = r in units of ||PFP||, so that r'z is an energy
        z, rz = z / problem.norm, iterate.residual**2 / problem.norm
    return replace(iterate, preconditioned=z, rz=rz, is_direct=operators.is_direct)


def iterate_on(
    problem: DualProblem,
    operators: FaceOperators,
    multipliers: Vector,
    gradient: Vector,
    step_lengths: tuple[float, ...],
    products: Products,
) -> PCPGIterate:
    """Return the iterate of multipliers with a known gradient on a face, with its energy."""
    norms, none = _norms(problem, operators.face, multipliers, gradient), np.zeros_like(gradient)
    iterate = PCPGIterate(operators.face, multipliers, gradient, *norms, none, 1.0, step_lengths)
    return _with_preconditioned_residual(problem, operators, iterate, products)


def first_iterate(
    problem: DualProblem, operators: FaceOperators, start: Vector | PCPGIterate, products: Products
) -> PCPGIterate:
    """Return the iterate nearest to the start with Gl = e and nothing off the face.

    It takes a product, and a second one where the step from another face is much too long.
    """
    if not isinstance(start, PCPGIterate):
        l = _nearest_on_face(problem, operators, start)
        return _iterate_at(problem, operators, l, np.zeros_like(l), -problem.d, (), products)
    l = _nearest_on_face(problem, operators, start.multipliers)

    def at(l: Vector, step_lengths: tuple[float, ...]) -> PCPGIterate:
        known_at, known = start.multipliers, start.gradient
        if operators.projector.free.shape[1]:
            known_at, known = np.zeros_like(l), -problem.d
        # gradients of faces without free motions differ by G'a, which the projection removes
        return _iterate_at(problem, operators, l, known_at, known, step_lengths, products)

    if operators.is_direct:
        return at(l, ())
    # from another face, with a preconditioned step by the residual there: no product of its own
    gaps = start.gradient + operators.face.closed_by_springs(l)
    alpha, r = start.step_length, operators.projector.P(-operators.face.part(gaps))
    if operators.projector.soft is not None:
        part = problem.constraints.layout.owned_part(-gaps)
        r = operators.face.part(operators.projector.remove_rigid_motion(part, r)[0])
    z, rz = _precondition(operators, r, products)
    iterate = at(l + alpha * (z / problem.norm if rz is None else z), (alpha,))
    # which is much too long where contact rows have joined at which stiff parts end
    if not alpha or iterate.residual <= _OVERSHOT * problem.space.norm(r):
        return iterate
    return min(iterate, at(l, ()), key=lambda i: i.residual)


def _iterate_at(
    problem: DualProblem,
    operators: FaceOperators,
    l: Vector,
    known_at: Vector,
    known: Vector,
    step_lengths: tuple[float, ...],
    products: Products,
) -> PCPGIterate:
    """Return the iterate at l, from the known gradient at other multipliers; one product."""
    part = _product(problem, l - known_at, products)
    curvature_gradient = operators.face.gradient_of_terms(l)
    part = part + problem.constraints.layout.owned_part(known + curvature_gradient)
    g = operators.projector.remove_rigid_motion(part, l)[0] - curvature_gradient
    none = np.zeros_like(l)
    return PCPGIterate(
        operators.face, l, g, *_norms(problem, operators.face, l, g), none, 1.0, step_lengths
    )


def _nearest_on_face(problem: DualProblem, operators: FaceOperators, multipliers: Vector) -> Vector:
    """Return the nearest multipliers with Gl = e and the fixed ones off the face."""
    l = operators.face.part(multipliers) + operators.face.fixed
    missing = problem.e - problem.coarse_space.restrict(l)
    return l + operators.projector.least_norm(missing)


def _product(problem: DualProblem, x: Vector, products: Products) -> Vector:
    products.cg += 1
    return problem.F(x)


def _precondition(
    operators: FaceOperators, r: Vector, products: Products
) -> tuple[Vector, float | None]:
    """Return z = PMr and r'z; None for the latter where it would cost a reduction."""
    if operators.precondition is None:
        return r, None
    products.preconditioner += 1
    return operators.projector.P_of_sum(operators.precondition(r), r)


def plastic_slip(problem: DualProblem, multipliers: Vector, gradient: Vector) -> Vector:
    """Return g_T + C l_T, minus the slips beyond the elastic ones, (k, gdim - 1)."""
    friction, springs = problem.constraints.friction, problem.springs
    slip = friction.at_sites(gradient)
    if springs is None:
        return slip
    return -springs.plastic(-slip, friction.at_sites(multipliers))


def friction_step(
    problem: DualProblem, face: Face, multipliers: Vector, gradient: Vector
) -> Vector:
    """Return the friction forces that the slips of an iterate ask for, (k, gdim - 1).

    These are the projections of l - k g onto the discs, with a stiffness k. On the face g is a
    residual that vanishes, and is left out. Slip against the force does not turn it round: the
    site sticks first.
    """
    friction = problem.constraints.friction
    sticking = face.sticking
    along = face.directions
    slip = np.where(sticking[:, None], 0.0, plastic_slip(problem, multipliers, gradient))
    step = friction.at_sites(multipliers) - _SLIP_STIFFNESS * problem.unit * slip
    back = np.where(sticking, 0.0, np.minimum(np.sum(step * along, axis=1), 0.0))
    step -= back[:, None] * along
    return balls.project(step, problem.radius)


def _norms(
    problem: DualProblem, face: Face, multipliers: Vector, gradient: Vector
) -> tuple[float, float]:
    """Return the norms of the residual and of what violates the signs; one reduction.

    The signs are violated by negative forces (times ||PFP||) on the face and negative gaps off it;
    where springs pull, by forces with the sign of the other branch; with friction also by forces
    above the bound, and by changes of forces that a slip asks for.
    """
    rows, springs = problem.constraints.inequality, face.springs
    wrong = np.zeros_like(gradient)
    force = problem.norm * multipliers[rows]
    wrong[rows] = np.minimum(np.where(face.active, force, gradient[rows]), 0.0)
    if springs is not None:
        # the gap differs from that of the other branch by no more than the compliances do
        length = np.minimum(problem.norm, np.abs(springs.pulled - springs.pressed))
        of_branch = length * multipliers[rows] * np.where(face.active, 1.0, -1.0)
        wrong[rows] = np.where(springs.pulling, np.minimum(of_branch, 0.0), wrong[rows])
    friction = problem.constraints.friction
    if friction.size:
        forces = friction_step(problem, face, multipliers, gradient)
        change = (friction.at_sites(multipliers) - forces) / (_SLIP_STIFFNESS * problem.unit)
        wrong += friction.spread(change, wrong.size)
    if face.has_terms:
        gradient = gradient + face.gradient_of_terms(multipliers)
    residual = face.part(gradient)
    squares = problem.space.dots((residual, residual), (wrong, wrong))
    return float(np.sqrt(squares[0])), float(np.sqrt(squares[1]))

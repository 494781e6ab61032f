"""PCPG: preconditioned conjugate projected gradients on a face of the dual feasible set.

On a face the active contact rows are equalities and the multipliers of the others vanish:

    minimise 1/2 l'Fl - d'l  subject to  Gl = e,  l = o off the face,

with G and the projector P of the rows on the face. With friction the tangential rows of sites that
stick are on the face. Where a site slips, its force turns on the circle |l_T| = r: to first order
it moves along the tangent, with the curvature |slip| / r of the cost. A proximal term
|l - centre|^2 / (2 rho) of the rows with bounds may be added to the cost. The gradient of the cost
without these terms is kept on all rows, as
g = Fl - d + G'a with the rigid motions a of the face: where l = o it is the gap that is left, whose
sign tells whether the face is the right one.

With the lumped preconditioner M = B_D K B_D' the number r'Mr is the squared energy of B_D'r, with
B_D = W^{-1} B D^{-1} of the rows on the face: the displacement that closes the jumps r. So
sqrt(r'z) bounds the error of the displacement in the energy norm, see
`fenics_tfeti.feti.solution.certificate`. So it does with the Dirichlet preconditioner, unless stiff
modes are capped (`stiff_modes`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fenics_tfeti.feti import interruption
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.dual.loose_bodies import LooseBodies
from fenics_tfeti.feti.dual.preconditioner import Preconditioner
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.qp import Products, balls
from fenics_tfeti.typing import Mask, Vector

# r'z above this multiple of its smallest value: the residual is rounding, and the recurrences of
# conjugate gradients amplify it (r'z of a regular problem may rise by its condition number)
_DIVERGED = 1e12
# rise of r'z after which a smaller r'z is checked by the true residual; ratio of the two r'z up to
# which they agree
_RISEN, _SAME = 1e4, 4.0
# rise of the residual by the first step on a face from which on it is tried without
_OVERSHOT = 1e3
# steps, and multiples of all steps before, that may fail to halve r'z: then it is rounding, too
_PATIENCE, _PATIENCE_FACTOR = 200, 3
# p'Fp relative to r'z, about 1 with a good preconditioner, that is rounding: P leaves nothing of F
_NO_CURVATURE = 64 * 2.0**-52
# stiffness of a slip against a friction force, relative to that of a weight of 1. 1 / ||PFP||, that
# of the whole body, is much too small where the body is thin: directions of forces then follow
# those of slips too slowly
_SLIP_STIFFNESS = 0.03


@dataclass(frozen=True)
class Proximal:
    """The proximal term |l - centre|^2 / (2 stiffness) on the rows with bounds."""

    centre: Vector  # (m,): feasible multipliers; zero on equality rows
    stiffness: float  # rho [N/m]

    def wanted(self, gradient: Vector) -> Vector:
        """Return centre + rho v for the jumps v = -gradient; its projection are the forces."""
        return self.centre - self.stiffness * gradient


@dataclass(frozen=True)
class ContactState:
    """Conditions of contact and friction that hold with equality: the choice of a face."""

    active: Mask  # (i,): contact rows that are closed
    sticking: Mask  # (k,): sites of friction that do not slip
    # (m,): friction forces of the sites that slip, as multipliers; others do not matter
    forces: Vector
    # (k,): slip along the force / r, the second derivative of the cost for a force that turns
    curvature: Vector
    proximal: Proximal | None = None  # added to the cost

    @staticmethod
    def of(
        problem: DualProblem,
        multipliers: Vector,
        active: Mask | None = None,
        slips: Vector | None = None,
    ) -> ContactState:
        """Return those of multipliers, with forces of sites that slip at the bound.

        Without `slips` (k, gdim - 1) the forces may turn freely.
        """
        constraints = problem.constraints
        friction = constraints.friction
        if active is None:
            active = multipliers[constraints.inequality] > 0.0
        forces = problem.multiplier_set(np.zeros_like(multipliers)).project(multipliers.copy())
        forces = friction.at_bound(forces, problem.radius)
        at_sites = friction.at_sites(forces)
        sticking = balls.inside(at_sites, problem.radius)
        curvature = np.zeros(friction.size)
        if slips is not None:
            slipping = np.where(sticking, 0.0, 1.0)
            curvature = slipping * balls.curvature(at_sites, slips, problem.radius)
        return ContactState(active, sticking, forces, curvature)


@dataclass(frozen=True)
class Face:
    """A face of the dual feasible set."""

    contact_state: ContactState  # rows on the face; its forces are the multipliers off the face
    projector: Projector  # P and Q of the rows on the face, and of the tangents of sites that slip
    # x -> this rank's part of B_D S B_D'x on the face, scaled where forces turn
    precondition: Callable[[Vector], Vector] | None
    loose: LooseBodies | None  # bodies whose position the rows on the face do not determine
    is_direct: bool = False  # whether `precondition` is a direct solver of the face

    @staticmethod
    def build(problem: DualProblem, contact_state: ContactState, projector: Projector) -> Face:
        """Make the preconditioner of a face. Collective."""
        kind, friction = problem.preconditioner, problem.constraints.friction
        fixed = friction.off_face(contact_state.sticking, contact_state.forces)
        contact_state, loose = replace(contact_state, forces=fixed), LooseBodies.on_face(projector)
        face = Face(contact_state, projector, None, loose)
        if kind is None:
            return face
        return face.direct(problem) if kind.is_direct else face._iterative(problem, kind)

    def direct(self, problem: DualProblem) -> Face:
        """Return the face with a direct solver as its preconditioner. Collective."""
        kind, curvature = problem.preconditioner, self.contact_state.curvature
        assert kind is not None and kind.direct is not None
        solve = kind.direct.on_face(self.projector, curvature, self._compliance)
        return replace(self, precondition=solve, is_direct=True)

    def _iterative(self, problem: DualProblem, kind: Preconditioner) -> Face:
        """Return the face with the preconditioner of a kind. Collective."""
        rows, tangent = self.projector.rows, self.projector.across
        friction, curvature = problem.constraints.friction, self.contact_state.curvature
        if tangent is not None:
            rows = rows | friction.on_rows(tangent.any(axis=1), rows.size)
        precondition = kind.on_face(rows)
        if tangent is not None:
            precondition = _scaled(problem, precondition, curvature, tangent)
        kernel = kind.on_kernel(rows, tangent, curvature, self._compliance)
        return replace(
            self, precondition=precondition if kernel is None else _sum_of(precondition, kernel)
        )

    @property
    def _compliance(self) -> float:
        proximal = self.contact_state.proximal
        return 0.0 if proximal is None else 1.0 / proximal.stiffness

    def curvature_gradient(self, x: Vector) -> Vector:
        """Return Cx on the face, C the second derivative of the terms beside 1/2 l'Fl."""
        derivative = np.zeros_like(x)
        if self.contact_state.proximal is not None:
            derivative = self._bounded(x) / self.contact_state.proximal.stiffness
        tangent = self.projector.across
        if tangent is not None:
            friction = self.projector.coarse_space.constraints.friction
            size = self.contact_state.curvature * np.sum(friction.at_sites(x) * tangent, axis=1)
            derivative += friction.spread(size[:, None] * tangent, x.size)
        return derivative

    def derivative(self, multipliers: Vector) -> Vector:
        """Return the gradient on the face of the terms beside 1/2 l'Fl - d'l."""
        proximal, derivative = self.contact_state.proximal, self.curvature_gradient(multipliers)
        if proximal is None:
            return derivative
        pull = self.projector.on_rows(proximal.centre) / proximal.stiffness
        return derivative - pull

    def _bounded(self, x: Vector) -> Vector:
        """Return x on the rows of the face that have bounds."""
        equality = self.projector.coarse_space.constraints.equality
        return np.where(self.projector.rows & ~equality, x, 0.0)


def _scaled(
    problem: DualProblem, apply: Callable[[Vector], Vector], curvature: Vector, tangent: Vector
) -> Callable[[Vector], Vector]:
    """Return the preconditioner with forces that turn scaled for their curvature.

    Where F has an inverse m, which is about the unit of stiffness for rows of length 1, the inverse
    of F + curvature is m / (1 + curvature m).
    """
    friction = problem.constraints.friction
    less = 1.0 - 1.0 / np.sqrt(1.0 + problem.unit * curvature)

    def scale(x: Vector) -> Vector:
        size = less * np.sum(friction.at_sites(x) * tangent, axis=1)
        return x - friction.spread(size[:, None] * tangent, x.size)

    return lambda x: scale(apply(scale(x)))


def _sum_of(*parts: Callable[[Vector], Vector]) -> Callable[[Vector], Vector]:
    """Return the sum of operators."""
    return lambda x: np.sum([apply(x) for apply in parts], axis=0)


@dataclass(frozen=True)
class PCPGIterate:
    """An iterate on a face, with what the next step needs."""

    contact_state: ContactState
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
    face: Face,
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
        iterate = first_iterate(problem, face, start, products)
    else:
        iterate = start if start.is_direct == face.is_direct else _restarted(start)
    test_below, best, peak, steps = 0.5 * iterate.residual, iterate, 0.0, 0
    while iterate.residual > 0.0 and products.total < max_products:
        if interruption.agreed():
            return iterate
        if iterate.residual <= test_below:
            iterate = _at_least_penetration(problem, face, iterate)
            if iterate.residual <= max(sign_factor * iterate.violation, accurate):
                return iterate
            test_below = 0.5 * iterate.residual
        iterate = _with_preconditioned_residual(problem, face, iterate, products)
        peak = max(peak, iterate.rz)
        # where r'z has risen far above its smallest value, rounding may have taken the multipliers
        # off Gl = e, which the residual of the recurrences does not show
        if _improves(iterate, best, tolerance) and peak > _RISEN * best.rz:
            true = _true_iterate(problem, face, iterate, products)
            if not _improves(true, best, tolerance):
                return _at_least_penetration(problem, face, replace(best, at_limit=True))
            iterate = iterate if true.rz <= _SAME * iterate.rz else true
        if iterate.energy <= tolerance:
            break
        if _improves(iterate, best, tolerance):
            best, peak = iterate, iterate.rz
        following = None if _is_rounding(iterate, best) else _step(problem, face, iterate, products)
        if following is None:
            return _at_least_penetration(problem, face, replace(best, at_limit=True))
        iterate, steps = following, steps + 1
        kind = problem.preconditioner
        if kind is not None and kind.becomes_direct(steps):
            face, iterate = face.direct(problem), _restarted(iterate)
            best, peak = iterate, 0.0
    return _at_least_penetration(problem, face, iterate)


def _restarted(iterate: PCPGIterate) -> PCPGIterate:
    """Return the iterate without what another preconditioner has made."""
    none = np.zeros_like(iterate.gradient)
    return replace(iterate, direction=none, rz_of_direction=1.0, preconditioned=None, rz=np.inf)


def _at_least_penetration(problem: DualProblem, face: Face, iterate: PCPGIterate) -> PCPGIterate:
    """Return the iterate with the gaps that remain at the least penetration of loose bodies."""
    if face.loose is None:
        return iterate
    gradient = face.loose.at_least_penetration(iterate.gradient)
    _, violation = _norms(problem, face, iterate.multipliers, gradient)
    return replace(iterate, gradient=gradient, violation=violation)


def _improves(iterate: PCPGIterate, best: PCPGIterate, tolerance: float) -> bool:
    """Tell whether r'z is half of the smallest so far, or within the tolerance."""
    return iterate.rz <= 0.5 * best.rz or iterate.energy <= tolerance


def _true_iterate(
    problem: DualProblem, face: Face, iterate: PCPGIterate, products: Products
) -> PCPGIterate:
    """Return the iterate moved onto Gl = e, with its true residual and no direction; a product."""
    l = _nearest_on_face(problem, face, iterate.multipliers)
    lengths = iterate.step_lengths
    true = _iterate_at(problem, face, l, np.zeros_like(l), -problem.d, lengths, products)
    return _with_preconditioned_residual(problem, face, true, products)


def _is_rounding(iterate: PCPGIterate, best: PCPGIterate) -> bool:
    """Tell whether r'z has risen, or has not been halved, for so long that it is rounding."""
    steps = len(best.step_lengths)
    waited = len(iterate.step_lengths) - steps
    return waited > max(_PATIENCE, _PATIENCE_FACTOR * steps) or iterate.rz > _DIVERGED * best.rz


def _step(
    problem: DualProblem, face: Face, iterate: PCPGIterate, products: Products
) -> PCPGIterate | None:
    """Take one step of PCPG; return None where the curvature is not more than rounding."""
    # 1. z = PMr of the residual r = -g on the face
    l, g, z, rz = iterate.multipliers, iterate.gradient, iterate.preconditioned, iterate.rz
    assert z is not None
    # 2. direction: p = z + (r'z / r'z of the last step) p
    p = z + rz / iterate.rz_of_direction * iterate.direction
    # 3. product: PFp on the face, off it what the gaps change by; p'Fp
    curvature_gradient = face.curvature_gradient(p)
    part = _product(problem, p, products) + problem.constraints.layout.owned_part(
        curvature_gradient
    )
    change, curvature = face.projector.remove_rigid_motion(part, p)
    if curvature <= _NO_CURVATURE * rz:
        return None
    # 4. step: l += alpha p, g += alpha PFp with alpha = r'z / p'Fp
    alpha = rz / curvature
    l, g = l + alpha * p, g + alpha * (change - curvature_gradient)
    lengths = (*iterate.step_lengths, alpha)
    norms, direct = _norms(problem, face, l, g), face.is_direct
    return PCPGIterate(face.contact_state, l, g, *norms, p, rz, lengths, is_direct=direct)


def _with_preconditioned_residual(
    problem: DualProblem, face: Face, iterate: PCPGIterate, products: Products
) -> PCPGIterate:
    """Return the iterate with z = PMr and r'z of its residual r = -g on the face."""
    if iterate.preconditioned is not None:
        return iterate
    gradient = iterate.gradient + face.derivative(iterate.multipliers)
    z, rz = _precondition(face, -face.projector.on_rows(gradient), products)
    if rz is None:
        # without preconditioner z = r in units of ||PFP||, so that r'z is an energy
        z, rz = z / problem.norm, iterate.residual**2 / problem.norm
    return replace(iterate, preconditioned=z, rz=rz, is_direct=face.is_direct)


def iterate_on(
    problem: DualProblem,
    face: Face,
    multipliers: Vector,
    gradient: Vector,
    step_lengths: tuple[float, ...],
    products: Products,
) -> PCPGIterate:
    """Return the iterate of multipliers with a known gradient on a face, with its energy."""
    norms, none = _norms(problem, face, multipliers, gradient), np.zeros_like(gradient)
    iterate = PCPGIterate(
        face.contact_state, multipliers, gradient, *norms, none, 1.0, step_lengths
    )
    return _with_preconditioned_residual(problem, face, iterate, products)


def first_iterate(
    problem: DualProblem, face: Face, start: Vector | PCPGIterate, products: Products
) -> PCPGIterate:
    """Return the iterate nearest to the start with Gl = e and nothing off the face.

    It takes a product, and a second one where the step from another face is much too long.
    """
    if not isinstance(start, PCPGIterate):
        l = _nearest_on_face(problem, face, start)
        return _iterate_at(problem, face, l, np.zeros_like(l), -problem.d, (), products)
    l = _nearest_on_face(problem, face, start.multipliers)

    def at(l: Vector, step_lengths: tuple[float, ...]) -> PCPGIterate:
        known_at, known = start.multipliers, start.gradient
        if face.projector.free.shape[1]:
            known_at, known = np.zeros_like(l), -problem.d
        # gradients of faces without free motions differ by G'a, which the projection removes
        return _iterate_at(problem, face, l, known_at, known, step_lengths, products)

    if face.is_direct:
        return at(l, ())
    # from another face, with a preconditioned step by the residual there: no product of its own
    alpha, r = start.step_length, -face.projector.on_rows(start.gradient)
    r = face.projector.P(r)
    z, rz = _precondition(face, r, products)
    iterate = at(l + alpha * (z / problem.norm if rz is None else z), (alpha,))
    # which is much too long where contact rows have joined at which stiff parts end
    if not alpha or iterate.residual <= _OVERSHOT * problem.space.norm(r):
        return iterate
    return min(iterate, at(l, ()), key=lambda i: i.residual)


def _iterate_at(
    problem: DualProblem,
    face: Face,
    l: Vector,
    known_at: Vector,
    known: Vector,
    step_lengths: tuple[float, ...],
    products: Products,
) -> PCPGIterate:
    """Return the iterate at l, from the known gradient at other multipliers; one product."""
    part = _product(problem, l - known_at, products)
    curvature_gradient = face.derivative(l)
    part = part + problem.constraints.layout.owned_part(known + curvature_gradient)
    g = face.projector.remove_rigid_motion(part, l)[0] - curvature_gradient
    none = np.zeros_like(l)
    return PCPGIterate(
        face.contact_state, l, g, *_norms(problem, face, l, g), none, 1.0, step_lengths
    )


def _nearest_on_face(problem: DualProblem, face: Face, multipliers: Vector) -> Vector:
    """Return the nearest multipliers with Gl = e and the fixed ones off the face."""
    projector = face.projector
    l = projector.on_rows(multipliers) + face.contact_state.forces
    missing = problem.e - problem.coarse_space.restrict(l)
    return l + projector.least_norm(missing)


def _product(problem: DualProblem, x: Vector, products: Products) -> Vector:
    products.cg += 1
    return problem.F(x)


def _precondition(face: Face, r: Vector, products: Products) -> tuple[Vector, float | None]:
    """Return z = PMr and r'z; None for the latter where it would cost a reduction."""
    if face.precondition is None:
        return r, None
    products.preconditioner += 1
    return face.projector.P_of_sum(face.precondition(r), r)


def friction_step(
    problem: DualProblem, face: Face, multipliers: Vector, gradient: Vector
) -> Vector:
    """Return the friction forces that the slips of an iterate ask for, (k, gdim - 1).

    These are the projections of l - k g onto the discs, with a stiffness k. On the face g is a
    residual that vanishes, and is left out. Slip against the force does not turn it round: the
    site sticks first.
    """
    friction = problem.constraints.friction
    sticking = face.contact_state.sticking
    along = balls.directions(friction.at_sites(face.contact_state.forces))
    slip = np.where(sticking[:, None], 0.0, friction.at_sites(gradient))
    step = friction.at_sites(multipliers) - _SLIP_STIFFNESS * problem.unit * slip
    back = np.where(sticking, 0.0, np.minimum(np.sum(step * along, axis=1), 0.0))
    step -= back[:, None] * along
    return balls.project(step, problem.radius)


def _norms(
    problem: DualProblem, face: Face, multipliers: Vector, gradient: Vector
) -> tuple[float, float]:
    """Return the norms of the residual and of what violates the signs; one reduction.

    The signs are violated by negative forces (times ||PFP||) on the face and negative gaps off it;
    with friction also by forces above the bound, and by changes of forces that a slip asks for.
    """
    rows = problem.constraints.inequality
    wrong = np.zeros_like(gradient)
    force = problem.norm * multipliers[rows]
    wrong[rows] = np.minimum(np.where(face.contact_state.active, force, gradient[rows]), 0.0)
    friction = problem.constraints.friction
    forces = friction_step(problem, face, multipliers, gradient)
    change = (friction.at_sites(multipliers) - forces) / (_SLIP_STIFFNESS * problem.unit)
    wrong += friction.spread(change, wrong.size)
    residual = face.projector.on_rows(gradient + face.derivative(multipliers))
    squares = problem.space.dots((residual, residual), (wrong, wrong))
    return float(np.sqrt(squares[0])), float(np.sqrt(squares[1]))

"""The linear problem on the face where a solve has ended.

What is closed stays closed, what is open stays open, and what sticks sticks under small changes of
the data, but where a row touches without a force or a site is at the edge of slip. The solution
changes by the u and lambda of

    K u + B'lambda = f,   B u - C lambda = c on the face,   lambda = o off it,

with the glued, supported and tied rows, the contact rows with a force, and the tangential rows of
sites that stick; C is the compliance of springs. Where a site slips in three dimensions its force
turns: the combination of its rows across the force is on the face, and C is slip over force there.
The matrix is symmetric: the adjoint of the solution solves the same problem. Set-up, coarse space,
deflation and preconditioner are those of the solve.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fenics_tfeti.errors import NotConverged
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.unresisted import raise_unresisted
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.constraints.row_table import GivenRows
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.dual.face_operators import FaceOperators
from fenics_tfeti.feti.dual.pcpg import first_iterate, iterate_on, pcpg
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.feti.options import Options
from fenics_tfeti.feti.solution.scale import ROUGH_LANCZOS_STEPS
from fenics_tfeti.feti.solution.setup import DualSetup
from fenics_tfeti.feti.solution.states import Candidate
from fenics_tfeti.feti.system import RowValues, TornSystem
from fenics_tfeti.feti.tolerances import MANY, ZERO, rounding
from fenics_tfeti.parallel import largest_of_ranks
from fenics_tfeti.qp import Products
from fenics_tfeti.typing import Mask, Vector


@dataclass(frozen=True)
class LinearData:
    """Loads and right-hand sides; those of conditions are in the order in which ranks gave them.

    A row on the face has a jump, one off it a force; the other number does not matter.
    """

    loads: Sequence[Vector]  # (n_i,) of this rank's subdomains [N]
    jumps: RowValues  # [m]
    forces: RowValues  # [N]


@dataclass(frozen=True)
class LinearSolution:
    """The solution of a linear problem, in the order of a `TornSolution`."""

    displacements: list[Vector]  # (n_i,), equal at all copies of a node [m]
    forces: RowValues  # [N]
    jumps: RowValues  # N u, T u and tied sums of u [m]; zero for no row of B
    products: int  # with F
    residual: float  # energy norm of the residual, relative to that of no displacement


@dataclass(frozen=True)
class LinearProblem:
    """The linear problem on a face, for any number of right-hand sides."""

    system: TornSystem
    setup: DualSetup
    candidate: Candidate
    operators: FaceOperators  # of the face
    dual: DualProblem  # without data
    options: Options
    shares: Vector  # (sites given,): part of the force of each site that this contact has

    @staticmethod
    def build(
        system: TornSystem,
        setup: DualSetup,
        candidate: Candidate,
        options: Options,
        shares: Vector,
    ) -> LinearProblem:
        """Return the problem on the face of a candidate. Collective."""
        constraints, coarse_space = setup.constraints, setup.projector.coarse_space
        none, zero = np.zeros(constraints.size), np.zeros(coarse_space.size)
        dual = DualProblem(
            setup.part,
            none,
            zero,
            zero,
            none,
            setup.projector,
            setup.norm(ROUGH_LANCZOS_STEPS),
            setup.preconditioner,
            candidate.radius,
            setup.local.unit,
            none,
            none,
            1.0,
            candidate.recovered.face.springs,
        )
        projector = Projector.build(coarse_space, _face_of(constraints, candidate))
        operators = FaceOperators.build(dual, projector)
        return LinearProblem(system, setup, candidate, operators, dual, options, shares)

    @property
    def active(self) -> Mask:
        """The contact rows on the face, (contact rows,)."""
        return np.append(self.operators.face.rows, False)[self._contacts.own_rows]

    @property
    def sticking(self) -> Mask:
        """The sites on the face, (sites,)."""
        friction = self.setup.constraints.friction
        on_face = self.operators.face.sticking
        return friction.given(on_face.astype(float)) > 0.0

    def kinks(self) -> tuple[Mask, Mask]:
        """Return rows that touch without a force, and sites at the edge of slip. Collective.

        Distances are relative to the largest displacement, or rounding of coordinates, forces to
        their bounds.
        """
        constraints, candidate = self.setup.constraints, self.candidate
        contacts, friction, comm = self._contacts, constraints.friction, constraints.layout.comm
        largest, reach = (
            largest_of_ranks(comm, np.abs(x))
            for x in (candidate.recovered.displacement, self.system.coordinates)
        )
        size = max(ZERO * largest, rounding(reach, MANY))
        gap = np.append(candidate.recovered.jumps, np.inf)[contacts.own_rows] / contacts.scale
        touching = ~self.active & (contacts.own_rows >= 0) & (np.abs(gap) <= size)
        force = np.linalg.norm(friction.at_sites(candidate.multipliers), axis=1)
        slips, springs = candidate.slips, candidate.recovered.face.springs
        if springs is not None:
            slips = springs.plastic(slips, friction.at_sites(candidate.multipliers))
        slip = np.linalg.norm(slips, axis=1) / friction.scale
        at_bound = (force > (1.0 - ZERO) * candidate.radius) & (candidate.radius > 0.0)
        edge = at_bound & (slip <= size)
        return touching, friction.given(edge.astype(float)) > 0.0

    @property
    def _contacts(self) -> GivenRows:
        return self.setup.constraints.contacts

    def solve(self, data: LinearData, rtol: float) -> LinearSolution:
        """Solve by conjugate gradients. Collective.

        Raises
        ------
        UnresistedMotion
            The loads do work on a motion that the face does not resist.
        NotConverged
            The tolerance was not reached.
        """
        self._check(data)
        solution = self.approximate(data, rtol)
        if solution.residual > rtol:
            limit = self.options.max_products
            why = "rounding" if solution.products < limit else f"max_products={limit}"
            raise NotConverged(
                f"the linear problem on the last face is not solved to rtol {rtol:g}: {why} leaves "
                f"a residual of {solution.residual:.1e}",
                None,
                None,
            )
        return solution

    def approximate(self, data: LinearData, rtol: float) -> LinearSolution:
        """Return the solution as far as it gets; loads that nothing resists are left. Collective.

        Its residual tells how far that is.
        """
        setup, unknowns = self.setup, self.setup.local.unknowns
        fixed = self._fixed_multipliers(data.forces)
        load = self._load(data, fixed)
        dual, d = self._with_data(load, self._right_hand_sides(data.jumps))
        multipliers, products, residual = self._minimise(dual, rtol)
        if setup.deflation is not None:
            multipliers = setup.deflation.completed(multipliers, d, np.zeros_like(d))
        displacement = self._recovered(load, dual.c, multipliers)
        return LinearSolution(
            unknowns.split(displacement),
            self._forces(multipliers + fixed),
            self._jumps(setup.F.jumps(displacement)),
            products,
            residual,
        )

    def _right_hand_sides(self, jumps: RowValues) -> Vector:
        """Return c (m,) on the face: `_forces` transposed. Collective."""
        constraints = self.setup.constraints
        c = self._of_surfaces(jumps, lambda rows: rows.share * rows.scale)
        c += self._of_sites(self.shares[:, None] * jumps.tangential, constraints.friction.scale)
        return self.operators.face.part(c)

    def _fixed_multipliers(self, forces: RowValues) -> Vector:
        """Return multipliers (m,) off the face with the forces. Collective."""
        scale = self.setup.constraints.friction.scale
        fixed = self._of_surfaces(forces, lambda rows: np.sign(rows.share) / rows.scale)
        fixed += self._of_sites(forces.tangential, 1.0 / scale)
        return fixed - self.operators.face.part(fixed)

    def _of_surfaces(self, values: RowValues, factor: Callable[[GivenRows], Vector]) -> Vector:
        """Return sums (m,) of values times factors at contact and tied rows. Collective."""
        constraints = self.setup.constraints
        total = np.zeros(constraints.size)
        for rows, given in (
            (constraints.contacts, values.normal),
            (constraints.tied, values.tied),
        ):
            here = rows.own_rows >= 0
            np.add.at(total, rows.own_rows[here], (factor(rows) * given)[here])
        return constraints.layout.sum(total)

    def _of_sites(self, values: Vector, factor: Vector) -> Vector:
        """Return sums (m,) of values (sites, gdim - 1) times factors of sites. Collective."""
        constraints = self.setup.constraints
        friction = constraints.friction
        if not friction.anywhere:
            return np.zeros(constraints.size)
        sums = [friction.from_given(column, constraints.layout) for column in values.T]
        return friction.spread(factor[:, None] * np.stack(sums, axis=1), constraints.size)

    def _forces(self, multipliers: Vector) -> RowValues:
        constraints = self.setup.constraints
        friction = constraints.friction
        at_sites = friction.scale[:, None] * friction.at_sites(multipliers)
        return RowValues(
            constraints.contacts.forces(multipliers),
            self.shares[:, None] * friction.given(at_sites),
            constraints.tied.forces(multipliers),
        )

    def _jumps(self, jumps: Vector) -> RowValues:
        constraints = self.setup.constraints
        friction, with_none = constraints.friction, np.append(jumps, 0.0)
        normal, tied = (
            np.sign(rows.share) * with_none[rows.own_rows] / rows.scale
            for rows in (constraints.contacts, constraints.tied)
        )
        slips = friction.given(friction.at_sites(jumps) / friction.scale[:, None])
        return RowValues(normal, slips, tied)

    def _load(self, data: LinearData, fixed: Vector) -> Vector:
        """Return the load (n,) with the forces off the face."""
        load = self.setup.local.unknowns.with_ground(np.concatenate([np.zeros(0), *data.loads]))
        return load - self.setup.F.constraint_forces(fixed)

    def _check(self, data: LinearData) -> None:
        """Raise if the face does not hold the load. Collective."""
        projector, load = (
            self.operators.projector,
            self._load(data, self._fixed_multipliers(data.forces)),
        )
        coarse_space = projector.coarse_space
        e, size = coarse_space.coarse_load(load), coarse_space.coarse_load_size(load)
        if projector.unresisted(e, size).any():
            free = projector.free_bodies
            raise_unresisted(
                self.system, coarse_space, free @ (free.T @ (coarse_space.bodies.basis.T @ e))
            )

    def _with_data(self, load: Vector, c: Vector) -> tuple[DualProblem, Vector]:
        """Return the dual problem and d without deflation."""
        setup, coarse_space = self.setup, self.operators.projector.coarse_space
        e, size = coarse_space.coarse_load(load), coarse_space.coarse_load_size(load)
        d = setup.F.load(load, c)
        return replace(self.dual, d=setup.reduced(d), e=e, e_size=size, c=c), d

    def _minimise(self, dual: DualProblem, rtol: float) -> tuple[Vector, int, float]:
        """Return multipliers, products with F, and the residual that is left."""
        operators, none, products = self.operators, np.zeros_like(dual.c), Products()
        first = first_iterate(dual, operators, none, products)
        first = iterate_on(dual, operators, first.multipliers, first.gradient, (), products)
        scale = first.energy
        limit = self.options.max_products
        last = pcpg(
            dual,
            operators,
            first,
            tolerance=rtol * scale,
            sign_factor=0.0,
            max_products=limit,
            products=products,
            resume=True,
        )
        residual = last.energy / scale if scale > 0.0 else 0.0
        if last.at_limit:
            # of a rigid motion the projection leaves rounding from the first residual
            given = float(np.sqrt(dual.space.dots((operators.face.part(dual.d),) * 2)[0]))
            residual = min(residual, last.residual / given)
        return last.multipliers, products.total, residual

    def _recovered(self, load: Vector, c: Vector, multipliers: Vector) -> Vector:
        """Return the nearest displacement that is glued and fulfils the rows of the face."""
        F, projector, constraints = self.setup.F, self.operators.projector, self.setup.constraints
        rows = projector.face.rows
        coarse_space = projector.coarse_space
        forces = coarse_space.without_rigid_motion(load - F.constraint_forces(multipliers))
        strained = coarse_space.without_rigid_motion(F.generalized_inverse(forces))
        prescribed = c + self.operators.face.curved(multipliers)
        torn = strained + coarse_space.rigid_motion(
            projector.coefficients(prescribed - F.jumps(strained))
        )
        jump = F.jumps(torn) - prescribed
        correction = np.where(rows, jump, 0.0)
        coupling = constraints.coupling
        if coupling.numbers.size:
            jumps, on_face = coupling.gather(jump, rows.astype(float))
            closed = coupling.inverse(on_face > 0.0).solve(jumps)
            correction[coupling.rows] = closed[coupling.positions]
        u: Vector = torn - F.constraint_forces(correction) / constraints.weights
        return u


def _face_of(constraints: Constraints, candidate: Candidate) -> Face:
    """Return the face of a candidate, without rows whose force is rounding. Collective.

    A row that touches without a force is where the solution has a kink: rounding would decide.
    """
    multipliers = candidate.multipliers
    normal = multipliers[constraints.inequality]
    largest = largest_of_ranks(constraints.layout.comm, np.maximum(normal, 0.0))
    active = normal > ZERO * largest
    radius, slips = candidate.radius, candidate.slips
    springs = candidate.recovered.face.springs
    face = Face.of_multipliers(constraints, multipliers, radius, active, slips, springs)
    # of changes: what is fixed does not change
    return replace(face.with_turning_forces(), forces=np.zeros_like(multipliers))

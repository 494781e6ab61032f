"""Further loads and gaps on a face that was found: a linear problem with the operators there are.

All rows of the face hold with equality and all other multipliers vanish, so that nothing is left to
decide: no certificate, no active set, no slip bounds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.dual.pcpg import ContactState, Face, first_iterate, iterate_on, pcpg
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.feti.solution.recovery import recover_displacement
from fenics_tfeti.feti.solution.scale import ROUGH_LANCZOS_STEPS
from fenics_tfeti.feti.solution.setup import DualSetup
from fenics_tfeti.qp import Products
from fenics_tfeti.typing import Vector


@dataclass(frozen=True)
class FaceSolution:
    """Displacements and forces on a face; those of several loads may be combined.

    Attributes
    ----------
    displacements : list of (n_i,) arrays
        u_i of this rank's subdomains, equal at all copies of a node [m].
    normal_force, tied_force, tangential_force : arrays
        As those of a `TornSolution` [N].
    """

    displacements: list[Vector]
    normal_force: Vector
    tied_force: Vector
    tangential_force: Vector

    def plus(self, factor: float, other: FaceSolution) -> FaceSolution:
        """Return the sum with a multiple of another one."""
        return FaceSolution(
            [x + factor * y for x, y in zip(self.displacements, other.displacements, strict=True)],
            self.normal_force + factor * other.normal_force,
            self.tied_force + factor * other.tied_force,
            self.tangential_force + factor * other.tangential_force,
        )


def gaps_of_rows(constraints: Constraints, contacts: Vector, tied: Vector) -> Vector:
    """Return c (m,) of gaps [m] of the contact and tied rows that this rank gave. Collective."""
    scale, part = np.zeros(constraints.size), np.zeros(constraints.size)
    for rows, gap in (
        (constraints.contacts, contacts),
        (constraints.held, contacts),
        (constraints.tied, tied),
    ):
        scale[rows.rows] = rows.scale
        given = rows.own_rows >= 0
        np.add.at(part, rows.own_rows[given], (rows.share * gap)[given])
    return scale * constraints.layout.sum(part)


def solve_on_face(
    setup: DualSetup,
    face: Projector,
    load: Vector,
    c: Vector,
    *,
    rtol: float,
    most: int,
    products: Products,
) -> tuple[Vector, Vector]:
    """Return the multipliers (m,) and displacements (n,) on a face. Collective.

    The energy of the residual falls by `rtol`, with at most so many products in all.
    """
    F, coarse_space, constraints = setup.F, setup.projector.coarse_space, setup.constraints
    none, sites = np.zeros(constraints.size), np.zeros(constraints.friction.size)
    c = np.where(face.rows, c, 0.0)
    d = F.load(load, c)
    problem = DualProblem(
        setup.part,
        setup.reduced(d),
        coarse_space.coarse_load(load),
        coarse_space.coarse_load_size(load),
        c,
        setup.projector,
        setup.norm(ROUGH_LANCZOS_STEPS),
        setup.preconditioner,
        sites,
        setup.local.unit,
        none,
        none,
        0.0,
    )
    sticking = constraints.friction.within(face.rows)
    state = ContactState(face.rows[constraints.inequality], sticking, none, sites)
    on_face = Face.build(problem, state, face)
    start = first_iterate(problem, on_face, none, products)
    first = iterate_on(problem, on_face, start.multipliers, start.gradient, (), products)
    iterate = pcpg(
        problem,
        on_face,
        first,
        tolerance=rtol * first.energy,
        sign_factor=0.0,
        max_products=most,
        products=products,
        resume=True,
    )
    multipliers = iterate.multipliers
    if setup.deflation is not None:
        multipliers = setup.deflation.completed(multipliers, d, none)
    recovered = recover_displacement(F, face, load, c, multipliers, setup.local.unit)
    return multipliers, recovered.displacement

"""The dual problem (11.36), with F, G and e neither scaled nor orthonormalised as in (11.30).

Its d is printed d~ in (11.36). The d printed in (11.39), after the transformation to Gx = o, is
called d_0 = d - F lambda~ here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.constraints.springs import Springs, pushing_rows
from fenics_tfeti.feti.dual.preconditioner import Preconditioner
from fenics_tfeti.qp import ProductSet, Space
from fenics_tfeti.typing import Mask, Vector


@dataclass(frozen=True)
class DualProblem:
    """Minimise 1/2 l'Fl - d'l subject to Gl = e, l_I >= o and |l_T| <= r, (11.36) with friction.

    Rows with springs add C l^2 / 2 to the cost, and those that may pull have no bound.
    """

    F: Callable[[Vector], Vector]  # x -> this rank's part of Fx, F the dual operator
    d: Vector  # (m,): BK^+f - c
    e: Vector  # (coarse,): R'f of all subdomains
    e_size: Vector  # (coarse,): |R|'|f|, which the rounding of e is relative to
    c: Vector  # (m,): prescribed displacements and gaps, scaled as the rows
    projector: Projector  # P and Q of all rows
    norm: float  # ||PFP||: scale of gaps against forces, for SMALBE-M an upper bound [m/N]
    preconditioner: Preconditioner | None  # B_D S B_D' on faces
    radius: Vector  # (k,): r of each site of friction
    unit: float  # stiffness that a weight of 1 stands for [N/m]
    feasible: Vector  # (m,): lambda~ with G lambda~ = e and feasible forces: those of rigid bodies
    d_0: Vector  # (m,): d - F lambda~, the d of (11.39)
    energy_norm: float  # an energy norm as large as the solution's, or larger [sqrt(J)]
    springs: Springs | None = None  # of contact rows

    @property
    def coarse_space(self) -> CoarseSpace:
        """G."""
        return self.projector.coarse_space

    @property
    def constraints(self) -> Constraints:
        """B."""
        return self.projector.coarse_space.constraints

    def face_of(
        self, multipliers: Vector, active: Mask | None = None, slips: Vector | None = None
    ) -> Face:
        """Return the face of multipliers (m,), with forces of sites that slip at the bound.

        Contact rows (i,) that are active press by default. Without `slips` (k, gdim - 1) the
        cost has no curvature.
        """
        constraints = self.constraints
        if active is None:
            active = multipliers[constraints.inequality] > 0.0
        forces = self.multiplier_set(np.zeros_like(multipliers)).project(multipliers.copy())
        forces = constraints.friction.at_bound(forces, self.radius)
        return Face.of_multipliers(constraints, forces, self.radius, active, slips, self.springs)

    def multiplier_set(self, shift: Vector) -> ProductSet:
        """Return {x : shift + x is feasible}, without regard to Gl = e."""
        constraints = self.constraints
        pushing = pushing_rows(constraints, self.springs)
        return constraints.friction.multiplier_set(pushing, shift, self.radius)

    @property
    def space(self) -> Space:
        """The inner product of multipliers."""
        return self.constraints.layout.space

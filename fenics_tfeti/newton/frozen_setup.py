"""A set-up that serves further Newton steps while the same conditions hold.

Factors, coarse problem and deflation are those of the tangents and rows of an earlier step. GMRES
has what these lack of the present ones, as it has the Hessian of contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fenics_tfeti.feti import Subdomain, TornSolution
from fenics_tfeti.feti.solution.linear import LinearProblem
from fenics_tfeti.newton.contact_hessian import ContactHessian, Correction, Spent
from fenics_tfeti.newton.face import Change, Face
from fenics_tfeti.newton.load_case import LoadCase, NewtonState
from fenics_tfeti.parallel import any_rank


@dataclass(frozen=True)
class FrozenSetup:
    """The linear problem on the face of an earlier step of the same load step."""

    face: Face
    linear: LinearProblem
    used: Sequence[Subdomain]  # with the tangents of the factors
    solution: TornSolution  # of the step

    def serves(self, load_case: LoadCase, face: Face) -> bool:
        """Tell whether the same conditions hold, and no other force is unknown. Collective."""
        is_unknown = any_rank(load_case.torn.nodes.comm, face.friction.bound > 0.0)
        return self.has_conditions_of(load_case, face) and not is_unknown

    def has_conditions_of(self, load_case: LoadCase, face: Face) -> bool:
        """Tell whether the same conditions hold, also where friction may turn. Collective."""
        contacts = self.face.held.size
        is_other = not self.face.is_that_of(face)
        is_other = is_other or not np.array_equal(self.linear.active[:contacts], self.face.held)
        return not any_rank(load_case.torn.nodes.comm, [is_other])

    def hessian(
        self, load_case: LoadCase, state: NewtonState, face: Face, spent: Spent
    ) -> ContactHessian:
        """Return the derivative on the face of a state, with this set-up as M. Collective."""
        exact = load_case.torn.tangents(face.rows.contact_set)
        base = self.face, self.linear, self.used
        return ContactHessian(load_case, state.displacement, face, exact, *base, spent)

    def corrected(
        self,
        load_case: LoadCase,
        state: NewtonState,
        face: Face,
        accuracy: tuple[float, float, float],
        spent: Spent,
    ) -> Correction | None:
        """Solve the linearised problem of a state with the same face. Collective.

        The accuracy is that of the first solution, the part of its residual that may be left, and
        negligible forces [N]. None where other conditions would hold after the step, or where the
        energy has a maximum along what GMRES adds, as at equilibria that are not stable.
        """
        first_rtol, rtol, negligible = accuracy
        balance = load_case.out_of_balance(state, face)
        hessian = self.hessian(load_case, state, face, spent)
        # gaps of the size of rounding of coordinates are closed
        depth = load_case.negligible_length(state)
        first = hessian.first(balance, first_rtol)
        # which mostly tells already that other conditions would hold
        if not self._is_on_face(hessian, self._at_rows(face, first), depth):
            return None
        corrected = hessian.corrected(first, balance, rtol, negligible)
        change = self._at_rows(face, corrected.change)
        if corrected.curvature < 0.0 or not self._is_on_face(hessian, change, depth):
            return None
        return replace(corrected, change=change, solves=1 + corrected.solves)

    def _at_rows(self, face: Face, change: Change) -> Change:
        """Return a change with forces at the rows of the present face."""
        return replace(change, forces=face.forces_of(self.face.changes_of(change.forces)))

    @staticmethod
    def _is_on_face(hessian: ContactHessian, change: Change, depth: float) -> bool:
        """Tell whether the same conditions hold after a change, to a depth [m]. Collective."""
        face = hessian.face
        closed = hessian.gaps_after(change) < -depth
        differ = (closed & ~face.held) | face.pulling(change.forces.normal)
        return not any_rank(face.rows.contact_set.boundary.nodes.comm, differ)

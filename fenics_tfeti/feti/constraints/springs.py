"""Springs between surfaces: the compliance of rows, beside the flexibility F of the bodies.

A contact row with a spring has the closing v = Bu - c = C l of its multiplier l, with one C >= 0
where it presses and another where it pulls. Zero is rigid; where surfaces come apart C is infinite
for l < 0, so that l >= 0. The dual cost of a row is C l^2 / 2: no matrix changes with it.

A site of friction with elastic slip has the slip C l_T below its bound, and at it the slip beyond
that is along the force.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.feti.tolerances import GIVEN, rounding
from fenics_tfeti.parallel import any_rank
from fenics_tfeti.qp import balls
from fenics_tfeti.typing import Mask, Numbers, Vector

# compliance, relative to that of a node, from which on springs have no part in removing rigid
# motions
_SOFT = 100.0


@dataclass(frozen=True)
class Springs:
    """The compliances of contact rows and sites that this rank holds, in units of rows [m/N]."""

    pressed: Vector  # (i,): C where l > 0; zero is rigid
    pulled: Vector  # (i,): C where l < 0; infinite where surfaces come apart
    sticking: Vector  # (k,): C of sites of friction below their bound
    soft: float  # C from which on a spring holds no body [m/N]

    @staticmethod
    def build(system: TornSystem, constraints: Constraints, unit: float) -> Springs | None:
        """Collect those of all ranks; None, on all of them, without any. Collective.

        A weight of 1 stands for the stiffness `unit` [N/m]. What is rounding beside that is no
        spring: 1 - d of a damage d that is nearly 1.
        """
        given, layout, friction = constraints.contacts, constraints.layout, constraints.friction
        elastic = np.asarray(system.friction.compliance)
        if not any_rank(layout.comm, system.contacts.has_springs.any() or elastic.any()):
            return None
        sticking = friction.from_given(elastic, layout) * friction.scale**2
        here = (given.own_rows >= 0) & system.contacts.has_springs
        rows, scale = given.own_rows[here], given.scale[here]
        compliance = np.asarray(system.contacts.compliance)[here] * scale[:, None] ** 2
        # 1 / C of pulls, which vanishes for rows without a spring
        part = np.zeros((constraints.size, 2))
        part[rows, 0] = compliance[:, 0]
        with np.errstate(divide="ignore"):
            part[rows, 1] = 1.0 / compliance[:, 1]
            pressed, stiffness = layout.sum(part)[constraints.inequality].T
            least = rounding(unit, GIVEN)
            pulled = np.where(stiffness < least, np.inf, 1.0 / stiffness)
            most = 1.0 / least
            return Springs(
                np.minimum(pressed, most), pulled, np.minimum(sticking, most), _SOFT / unit
            )

    @property
    def pulling(self) -> Mask:
        """The rows (i,) that may pull: they are on every face."""
        return np.isfinite(self.pulled)

    def at(self, active: Mask) -> Vector:
        """Return C (i,) of rows that press where they are active, and pull or are open if not."""
        return np.where(active, self.pressed, np.where(self.pulling, self.pulled, 0.0))

    def of(self, forces: Vector) -> Vector:
        """Return C (i,) at the multipliers (i,) of contact rows."""
        return self.at(forces > 0.0)

    def energies(self, forces: Vector, closing: Vector) -> tuple[Vector, Vector]:
        """Return the energies of the rows (i,), and what forces and closings lack to the law.

        The energy phi of a closing v is v^2 / (2C), zero where the surfaces are apart; closings of
        rigid rows have none. With the dual phi* = C l^2 / 2 the lack is phi(v) + phi*(l) - l v,
        which is zero for v = C l and positive for others.
        """
        pressed = closing > 0.0
        C = np.where(pressed, self.pressed, self.pulled)
        energy = np.divide(
            closing**2, 2.0 * C, out=np.zeros_like(closing), where=(C > 0.0) & np.isfinite(C)
        )
        of_force = self.of(forces)
        same = (forces > 0.0) == pressed
        soft = same & (of_force > 0.0)
        lack = energy + 0.5 * of_force * forces**2 - forces * closing
        # without cancellation
        np.divide((closing - of_force * forces) ** 2, 2.0 * of_force, out=lack, where=soft)
        return energy, np.maximum(lack, 0.0)

    def elastic(self, forces: Vector) -> Vector:
        """Return the elastic slips of forces of sites (k, gdim - 1)."""
        return self.sticking[:, None] * forces

    def plastic(self, slips: Vector, forces: Vector) -> Vector:
        """Return slips without the elastic ones, all of sites (k, gdim - 1)."""
        return slips - self.elastic(forces)

    def site_energies(self, forces: Vector, slips: Vector, radius: Vector) -> tuple[Vector, Vector]:
        """Return the energies of the sites (k,), and what forces and slips lack to the law.

        Both are (k, gdim - 1). The energy of a slip s is |s|^2 / (2C) where it is elastic, and
        beyond it r |s| - C r^2 / 2; with C = 0 it is r |s| alone.
        """
        C, size, force = self.sticking, *(np.linalg.norm(x, axis=1) for x in (slips, forces))
        elastic = (C > 0.0) & (size <= C * radius)
        safe = np.where(elastic, C, 1.0)
        energy = np.where(elastic, size**2 / (2.0 * safe), radius * (size - 0.5 * C * radius))
        lack = force * balls.misalignment(slips, balls.directions(forces))
        lack += (radius - force) * (size - 0.5 * C * (radius + force))
        squares = np.sum(self.plastic(slips, forces) ** 2, axis=1)
        return energy, np.maximum(np.where(elastic, squares / (2.0 * safe), lack), 0.0)


def adhesion(system: TornSystem, constraints: Constraints) -> Vector | None:
    """Return the multipliers a (m,) of adhesion; None, on all ranks, without any. Collective.

    With l' = l + a >= o, and the load f + B'a that pulls the surfaces together, contact that
    adheres is contact: f - B'l = f + B'a - B'l'.
    """
    given, layout = constraints.contacts, constraints.layout
    forces = np.where(given.own_rows >= 0, np.asarray(system.contacts.adhesion), 0.0)
    if not any_rank(layout.comm, forces):
        return None
    part, here = np.zeros(constraints.size), np.flatnonzero(forces)
    part[given.own_rows[here]] = forces[here] / given.scale[here]
    return layout.sum(part)


def pushing_rows(constraints: Constraints, springs: Springs | None) -> Numbers:
    """Return the contact rows whose multipliers are not negative, local positions, ascending."""
    rows = constraints.inequality
    return rows if springs is None else rows[~springs.pulling]

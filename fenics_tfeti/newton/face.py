"""The face of a Newton step: contact rows that press, or pull by bonds, hold with equality.

Where nodes press, the row holds whatever the change of its force; where friction holds them, too,
so do the tangential rows. Where they slip, friction forces are loads; in three dimensions they may
turn, and have the bounds of the last forces in the contact problem, as have those of all nodes
while slip spreads. Rows that do not press stay inequalities, with friction as of the contact
problem, so that contact may grow. Unknowns are the changes of forces: the tolerance of a linear
problem is then relative to what is out of balance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fenics_tfeti.feti import TornSolution
from fenics_tfeti.feti.system import ContactRows, Friction, RowValues
from fenics_tfeti.newton.equilibrium import DeformedRows, Multipliers
from fenics_tfeti.parallel import any_rank
from fenics_tfeti.typing import Mask, Vector


@dataclass(frozen=True)
class Change:
    """Displacements of subdomains and changes of forces on a face."""

    displacements: Sequence[Vector]  # (n_i,) of this rank's subdomains [m]
    forces: RowValues  # at contacts, free sites and ties of the face [N]

    @staticmethod
    def of(solution: TornSolution) -> Change:
        """Return that of a contact problem."""
        forces = solution.normal_force, solution.tangential_force, solution.tied_force
        return Change(solution.displacements, RowValues(*forces))

    def plus(self, factor: float, other: Change) -> Change:
        """Return the sum with a multiple of another one."""
        pairs = zip(self.displacements, other.displacements, strict=True)
        displacements = [x + factor * y for x, y in pairs]
        return Change(displacements, self.forces.plus(factor, other.forces))


@dataclass(frozen=True)
class Face:
    """The rows of a state that hold with equality, and how the rest is posed."""

    rows: DeformedRows
    multipliers: Multipliers
    held: Mask  # (contact rows,)
    sticks: Mask  # (sites,): at held rows
    free: Mask  # (sites,): at other rows, and where forces at their bound may turn

    @staticmethod
    def of(
        rows: DeformedRows, multipliers: Multipliers, negligible: float, has_settled: bool = False
    ) -> Face:
        """Hold the rows that press; nodes that slid against their forces stick. Collective.

        Where the nodes that press have settled, and slip spreads, friction forces at nodes that
        stick are unknown up to their bounds: else it would reach one node in each step.
        """
        friction, place = rows.friction, rows.place
        held = multipliers.normal[place] != 0.0
        forces = rows.friction_forces(multipliers)
        back, size = np.sum(forces * rows.slip, axis=1), np.linalg.norm(forces, axis=1)
        at = place[friction.row]
        returns = multipliers.slid[at] & (back < -negligible * size)
        slips = multipliers.slipping[at] & ~returns & np.isfinite(friction.bound)
        sites = held[friction.row]
        turns = sites & slips & (friction.tangents.shape[1] > 1)
        slid, begins = multipliers.slid[at], slips & ~multipliers.slid[at]
        comm = rows.contact_set.boundary.nodes.comm
        spreads = any_rank(comm, sites & begins) and any_rank(comm, sites & slid)
        if has_settled and spreads:
            turns |= sites & ~slips
        slipping, tangential = multipliers.slipping.copy(), multipliers.tangential.copy()
        slipping[at], tangential[at[turns]] = slips, 0.0
        multipliers = replace(multipliers, slipping=slipping, tangential=tangential)
        return Face(rows, multipliers, held, sites & ~slips & ~turns, ~sites | turns)

    def without(self, released: Mask) -> Face:
        """Return the face where some contact rows are inequalities, with all forces as unknowns."""
        place, sites = self.rows.place[released], released[self.rows.friction.row]
        normal, tangential = self.multipliers.normal.copy(), self.multipliers.tangential.copy()
        normal[place], tangential[place] = 0.0, 0.0
        multipliers = replace(self.multipliers, normal=normal, tangential=tangential)
        held, sticks, free = self.held & ~released, self.sticks & ~sites, self.free | sites
        return Face(self.rows, multipliers, held, sticks, free)

    def with_free_forces(self, forces: RowValues, sticking: Mask) -> Face:
        """Return the face with the forces that are all unknown, of a solution."""
        rows, multipliers = self.rows, self.multipliers
        before, slipping = rows.normal_forces(multipliers), multipliers.slipping[rows.place]
        normal = np.where(self.held, before, forces.normal[: before.size])
        tangential, slipping = rows.friction_forces(multipliers), slipping[rows.friction.row]
        tangential[self.free], slipping[self.free] = forces.tangential, ~sticking
        known = Multipliers.at_rows(rows, normal, tangential, multipliers.tied, slipping)
        return replace(self, multipliers=known)

    def is_that_of(self, other: Face) -> bool:
        """Tell whether another state has the same rows, and the same of them hold; on this rank."""
        pairs = [
            (face.rows.place, face.rows.friction.row, face.held, face.sticks, face.free)
            for face in (self, other)
        ]
        return all(map(np.array_equal, *pairs)) and self.rows.tied.size == other.rows.tied.size

    def changes_of(self, forces: RowValues) -> Multipliers:
        """Return changes of the forces at `contacts`, free sites and ties, at their nodes."""
        rows, shape = self.rows, self.rows.friction.tangents.shape[:2]
        normal, of_sticking = np.split(forces.normal, [rows.contacts.size])
        tangential = np.zeros(shape)
        tangential[self.free] = forces.tangential
        tangential[self.sticks] = of_sticking.reshape(-1, shape[1])
        no = np.zeros(rows.friction.size, dtype=bool)
        return Multipliers.at_rows(rows, normal, tangential, forces.tied, no)

    def forces_of(self, changes: Multipliers) -> RowValues:
        """Return the forces at `contacts`, free sites and ties of changes at their nodes."""
        tangential = self.rows.friction_forces(changes)
        normal = self.rows.normal_forces(changes)
        normal = np.append(normal, tangential[self.sticks].ravel())
        return RowValues(normal, tangential[self.free], changes.tied)

    def pulling(self, changes: Vector) -> Mask:
        """Tell which held rows would pull after changes of the forces at `contacts`.

        With them are bonds that would press, which are rigid then.
        """
        before = self.rows.normal_forces(self.multipliers)
        forces = before + changes[: self.held.size]
        return self.held & np.where(before < 0.0, forces > 0.0, forces < 0.0)

    @property
    def soft(self) -> Mask:
        """The held rows (contact rows,) with springs, whose forces may change by either sign."""
        return self.held & (self.rows.compliance(self.multipliers) > 0.0)

    @cached_property
    def held_forces(self) -> Multipliers:
        """The multipliers of held rows alone."""
        normal = np.zeros_like(self.multipliers.normal)
        place = self.rows.place[self.held]
        normal[place] = self.multipliers.normal[place]
        return replace(self.multipliers, normal=normal)

    @cached_property
    def contacts(self) -> ContactRows:
        """The contact rows, and after them the tangential rows that hold.

        Gaps are without what springs have given way by already.
        """
        contacts, compliance = self.rows.contacts, np.array(self.rows.contacts.compliance)
        compliance[self.soft] = self.rows.compliance(self.multipliers)[self.soft, None]
        compliance[self.held & ~self.soft] = 0.0, np.inf
        contacts = replace(
            contacts,
            gap=contacts.gap + contacts.length * self.rows.given_way(self.held_forces),
            held=self.held & ~self.soft,
            compliance=compliance,
        )
        if not self.sticks.any():
            return contacts
        left = self.rows.slips_left(self.multipliers)[self.sticks]
        sticking = replace(self._friction(self.sticks), slip=left)
        tangential = sticking.tangential_rows(contacts)
        elastic = np.repeat(np.asarray(sticking.compliance), left.shape[1])
        springs = np.where(elastic[:, None] > 0.0, elastic[:, None], [0.0, np.inf])
        tangential = replace(tangential, held=elastic == 0.0, compliance=springs)
        return ContactRows.concatenate([contacts, tangential])

    @cached_property
    def friction(self) -> Friction:
        """Friction where forces are all unknown; at rows that hold with the bounds there are."""
        friction = self._friction(self.free)
        at_held = self.held[friction.row]
        bound = np.where(
            at_held, self.rows.slip_bounds(self.multipliers)[self.free], friction.bound
        )
        return replace(
            friction,
            bound=bound,
            coefficient=np.where(at_held, 0.0, np.asarray(friction.coefficient)),
        )

    def distances_of(self, rows: DeformedRows) -> Vector:
        """Return the distances of other rows at the nodes of `contacts`, NaN where there are none.

        Springs give way by the forces of held rows. At tangential rows distances are slips as
        `Friction.slip` [m].
        """
        distance = np.full(self.multipliers.normal.size, np.nan)
        slip = np.full((distance.size, rows.friction.tangents.shape[1]), np.nan)
        distance[rows.place] = rows.distances_under(self.held_forces)
        slip[rows.place[rows.friction.row]] = rows.slips_left(self.multipliers)
        at_sites = self.rows.place[self.rows.friction.row[self.sticks]]
        return np.append(distance[self.rows.place], slip[at_sites].ravel())

    def _friction(self, sites: Mask) -> Friction:
        friction = self.rows.friction
        return Friction(*(np.asarray(column)[sites] for column in vars(friction).values()))

    def after(self, changes: RowValues, part: float, has_row: Mask, sticking: Mask) -> Multipliers:
        """Return the forces after a part of the changes.

        Held rows that are no rows of the problem lose their forces, as do those that would pull.
        """
        rows, before = self.rows, self.multipliers
        normal, of_sticking = np.split(part * changes.normal, [rows.contacts.size])
        kept = self.held & (self.soft | has_row[: rows.contacts.size])
        kept = np.where(kept, rows.normal_forces(before), 0.0)
        pressing = rows.possible(kept + normal)
        forces, slipping = rows.friction_forces(before), np.zeros(rows.friction.size, dtype=bool)
        forces[self.free], slipping[self.free] = part * changes.tangential, ~sticking
        forces[self.sticks] += of_sticking.reshape(-1, forces.shape[1])
        tied = before.tied + part * changes.tied
        changed = Multipliers.at_rows(rows, pressing, forces, tied, slipping)
        bound, size = rows.slip_bounds(changed), np.linalg.norm(forces, axis=1)
        slides = ~(self.sticks | self.free)
        slides |= self.sticks & (size > bound)
        slides &= np.isfinite(bound)
        scale = np.divide(bound, size, out=np.zeros_like(size), where=slides & (size > 0.0))
        forces = np.where(slides[:, None], scale[:, None] * forces, forces)
        after = Multipliers.at_rows(rows, pressing, forces, changed.tied, slipping | slides)
        # one that has only begun to slip has no direction of slip yet
        slid = np.zeros_like(after.slipping)
        slid[rows.place[rows.friction.row]] = ~(self.sticks | self.free)
        return replace(after, slid=slid)

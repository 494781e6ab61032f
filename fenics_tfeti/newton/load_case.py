"""A load step of Newton's method: states at displacements, and what its steps share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import NotConverged
from fenics_tfeti.fem.contact.conditions.contact_conditions import SlaveValues
from fenics_tfeti.fem.contact.conditions.friction import SlipOrigin
from fenics_tfeti.fem.contact.contact_set import ContactSet
from fenics_tfeti.fem.contact.rigid.frames import RigidBodies
from fenics_tfeti.fem.displacement import fill_owned, owned_values, prescribed_components
from fenics_tfeti.fem.gradients import CellGradients
from fenics_tfeti.fem.torn_problem import TornProblem
from fenics_tfeti.feti.system import Subdomain, TornSystem
from fenics_tfeti.newton.equilibrium import (
    DeformedRows,
    Equilibrium,
    Multipliers,
    out_of_balance,
)
from fenics_tfeti.newton.face import Face
from fenics_tfeti.newton.rounding import Rounding
from fenics_tfeti.parallel import any_rank, largest_of_ranks
from fenics_tfeti.typing import Vector


@dataclass(frozen=True)
class NewtonState:
    """A displacement with the conditions, multipliers and residual there."""

    # at the degrees of freedom that this rank owns, and of rigid bodies' corners (rank 0) [m]
    displacement: Vector
    rows: DeformedRows
    multipliers: Multipliers
    equilibrium: Equilibrium
    internal: Vector  # (owned, gdim): internal forces less loads at the mesh's nodes [N]

    @property
    def bodies(self) -> RigidBodies:
        """The rigid bodies where they are."""
        return self.rows.contact_set.bodies

    @property
    def nodal_displacement(self) -> Vector:
        """The displacement (owned, gdim) of the nodes that this rank owns [m]."""
        return self.displacement[: self.internal.size].reshape(self.internal.shape)


@dataclass(frozen=True)
class LoadCase:
    """A load step: what does not change in its Newton steps."""

    torn: TornProblem
    u: Function
    origin: SlipOrigin
    gradients: CellGradients
    shear_over_bulk: float  # mu / kappa of the least compressible material
    rounding: Rounding
    damage: SlaveValues  # (k,) of bonds

    def state_at(
        self,
        displacement: Vector,
        multipliers: Multipliers | SlaveValues,
        bodies: RigidBodies,
        least: float = 0.0,
        last: DeformedRows | None = None,
    ) -> NewtonState:
        """Fill u, and measure surfaces and residual there. Collective.

        Multipliers may be normal forces (k,) [N]. The bodies, and the last rows, are those before
        the last step. The residual is relative to a least force [N] or more.
        """
        size = self.torn.nodes.owned * self.torn.nodes.components
        bodies = self._fill(self.u, displacement, bodies)
        displacement = np.concatenate([owned_values(self.u), displacement[size:]])
        bodies = self.torn.loaded(bodies)
        ratio, place = self.gradients.smallest_volume_ratio(self.torn.nodes.values(self.u))
        if not ratio > 0.0:
            raise NotConverged(f"the cell at {place} is inverted, with det F = {ratio:.2g}")
        rows = self._rows(self.u, bodies, last)
        if not isinstance(multipliers, Multipliers):
            multipliers = Multipliers.from_forces(rows, multipliers)
        multipliers = rows.at_bounds(multipliers)
        internal = -self.torn.torn.load()
        if any_rank(self.torn.nodes.comm, ~np.isfinite(internal)):
            raise NotConverged("the residual F is NaN or infinite")
        equilibrium = Equilibrium.of(
            internal, rows, multipliers, displacement, least, self.rounding
        )
        return NewtonState(displacement, rows, multipliers, equilibrium, internal)

    def rows_at(
        self,
        displacement: Vector,
        bodies: RigidBodies,
        last: DeformedRows,
        undeformed: ContactSet | None = None,
    ) -> DeformedRows:
        """Return the rows at another displacement, near the last ones; u stays. Collective.

        The conditions of undeformed surfaces may be others.
        """
        scratch = Function(self.torn.space)
        return self._rows(scratch, self._fill(scratch, displacement, bodies), last, undeformed)

    def _fill(self, uh: Function, displacement: Vector, bodies: RigidBodies) -> RigidBodies:
        """Fill a displacement, and return the bodies there. Collective."""
        size = self.torn.nodes.owned * self.torn.nodes.components
        fill_owned(uh, displacement[:size])
        bodies = bodies.moved(bodies.from_vector(displacement[size:]))
        self.torn.fill(uh, bodies, is_small=False)
        return bodies

    def _rows(
        self,
        uh: Function,
        bodies: RigidBodies,
        last: DeformedRows | None,
        undeformed: ContactSet | None = None,
    ) -> DeformedRows:
        """Return the rows of the surfaces deformed by a displacement, near the last ones."""
        before = None if last is None else last.contact_set
        here = replace(bodies, from_here=True)
        contact_set = (undeformed or self.torn.undeformed).deformed(uh, here, before)[0]
        contact_set = contact_set.with_friction(uh).damaged(self.damage).with_turned_ties(uh)
        return DeformedRows.of(contact_set, uh, self.origin)

    @cached_property
    def slip_stiffness(self) -> float:
        """The stiffness of nodes: forces of slips, and of gaps, of a length of one [N/m]."""
        return largest_of_ranks(self.torn.nodes.comm, self.rounding.stiffness)

    def face_of(self, state: NewtonState, has_settled: bool = False) -> Face:
        """Return the face of a state, whose pressing nodes may have settled. Collective."""
        return Face.of(state.rows, state.multipliers, self.negligible_length(state), has_settled)

    def negligible_length(self, state: NewtonState) -> float:
        """Return the distance that rounding of coordinates leaves [m]. Collective."""
        return self.rounding.length(self._size(state))

    def out_of_balance(self, state: NewtonState, face: Face) -> tuple[Vector, Vector]:
        """Return the forces (owned, gdim) and beyond the mesh that a step balances. Collective."""
        force, beyond = face.rows.force(face.multipliers)
        left = state.internal + force
        return -out_of_balance(left, face.rows, self._size(state), self.rounding), -beyond

    def system_at(self, face: Face, has_small_strains: Callable[[Subdomain], bool]) -> TornSystem:
        """Return the system for an increment of u, without loads on the mesh. Collective.

        The coordinates are the deformed ones, and stiffness matrices are tangents there.
        """
        torn, contacts = self.torn, face.rows.contact_set
        values, nodes, prescribed = torn.nodes.values(self.u), torn.nodes, contacts.prescribed
        subdomains = torn.torn.assemble()
        deformed = [
            replace(s, coordinates=s.coordinates + values[nodes.to_local(s.nodes)])
            for s in subdomains
        ]
        # a body whose strains are small has the undeformed ones; those of its subdomains that were
        # only shifted would do with both
        large, fixed = np.zeros((2, torn.bodies.deformable), dtype=bool)
        for s, moved in zip(subdomains, deformed, strict=True):
            is_small = has_small_strains(s)
            large[s.body] |= not is_small
            fixed[s.body] |= is_small and not has_small_strains(moved)
        for flags in large, fixed:
            nodes.comm.Allreduce(MPI.IN_PLACE, flags, MPI.LOR)
        is_linear = fixed & ~large
        subdomains = [
            s if is_linear[s.body] else moved for s, moved in zip(subdomains, deformed, strict=True)
        ]
        subdomains += contacts.added_subdomains(torn.bodies.deformable)
        local = nodes.to_local(prescribed.nodes)
        increment = prescribed.values - values[local, prescribed.components]
        prescribed = replace(prescribed, values=increment)
        rows = face.contacts, face.rows.tied, face.friction
        return torn.system_of(contacts, subdomains, prescribed, *rows)

    def at_free(self, force: Vector, rows: DeformedRows) -> Vector:
        """Return nodal forces (owned, gdim), zero where displacements are prescribed [N]."""
        nodes = self.torn.nodes
        fixed = prescribed_components(nodes, rows.contact_set.prescribed)[: nodes.owned]
        return np.where(fixed, 0.0, force)

    def _size(self, state: NewtonState) -> float:
        return largest_of_ranks(self.torn.nodes.comm, np.abs(state.displacement))

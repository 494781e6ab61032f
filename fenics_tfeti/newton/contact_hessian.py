"""The Hessian of contact in a Newton step: what the tangents of the bodies and the rows lack.

On the face of a step the derivative of equilibrium and of the gaps is

    K d + B'dP + E d = -r,    B d + E_g d = gap,    E d = d(B'P)/du d,

where E has the forces that turn with the surfaces and move along them, and friction that follows
its normal force. It couples the bodies, so no subdomain can have it. What the subdomains' tangents
lack is in E, too: the skew part of those with pressures that follow the surface. Total FETI without
E is the preconditioner M of flexible GMRES; vectors are forces at the surfaces, and gaps. E d is a
difference of rows at u + eps d, of any kind of contact. Products are those of the state, so M may
be that of projected tangents, or of an earlier step with the same face.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fenics_tfeti.fem.contact.conditions.contact_conditions import row_values
from fenics_tfeti.fem.contact.rigid.frames import RigidBodies
from fenics_tfeti.feti import Subdomain
from fenics_tfeti.feti.solution.linear import LinearData, LinearProblem
from fenics_tfeti.feti.system import RowValues
from fenics_tfeti.newton.equilibrium import DeformedRows, Multipliers
from fenics_tfeti.newton.face import Change, Face
from fenics_tfeti.newton.load_case import LoadCase
from fenics_tfeti.parallel import largest_of_ranks
from fenics_tfeti.qp import Space
from fenics_tfeti.qp.gmres import gmres
from fenics_tfeti.typing import Vector

# displacements by which rows are differenced, relative to the size of the mesh: those of the step
# within these limits, as coverage has kinks where edges of surfaces lie on each other
_SHORTEST, _LONGEST = 1e-9, 1e-7
# accuracy of the face solves that precondition GMRES
_INNER = 1e-3
# face solves of a step
_MOST = 12
# part of a change of loads and gaps that the response to it leaves
_ALONG = 1e-4


@dataclass
class Spent:
    """Applications of F in a step, also for solutions that are not taken."""

    products: int = 0


@dataclass(frozen=True)
class Correction:
    """The solution of a step with the Hessian of contact."""

    change: Change
    solves: int = 0
    left: float = 0.0  # part of the residual
    added: Change | None = None  # by GMRES to the solution without the Hessian
    curvature: float = 0.0  # of the energy along that, at the most [J]

    def downhill(self) -> Correction:
        """Return it with what was added reversed, if the energy has a maximum along that.

        An equilibrium that is not stable on the face is a saddle; the energy falls away from it.
        """
        if self.added is None or self.curvature >= 0.0:
            return self
        return replace(self, change=self.change.plus(-2.0, self.added))


@dataclass(frozen=True)
class ContactHessian:
    """The derivative on the face of a state, with M as the preconditioner of GMRES."""

    load_case: LoadCase
    displacement: Vector  # as of `NewtonState` [m]
    face: Face
    exact: Sequence[Subdomain]
    base: Face  # of M
    linear: LinearProblem  # M
    used: Sequence[Subdomain]  # of M
    spent: Spent

    @cached_property
    def _force(self) -> tuple[Vector, Vector]:
        return self.face.rows.force(self.face.multipliers)

    def times(
        self,
        change: Change,
        normal: Vector,
        begin: Sequence[Vector],
        length: float,
        beyond: Vector,
    ) -> Vector:
        """Return K d + B'dP + E d and B d + E_g d as one vector, by rows at a distance [m].

        Friction at its bound follows the changes of normal forces that are given. Without
        displacement the bodies begin at their motions. Beyond the nodes of the mesh the forces that
        M balances are given, to which E is added. Collective.
        """
        load_case, face, nodes = self.load_case, self.face, self.load_case.torn.nodes
        bodies = face.rows.contact_set.bodies
        end = face.rows.contact_set.motions_after(change.displacements)
        motions = [b - a for a, b in zip(begin, end, strict=True)]
        d = load_case.torn.at_owned_nodes(change.displacements)
        increment = np.concatenate([d, bodies.as_vector(motions)])
        largest = largest_of_ranks(nodes.comm, np.abs(increment))
        # without displacement there is no difference, either
        eps = length / (largest or 1.0)
        rows = load_case.rows_at(self.displacement + eps * increment, bodies, face.rows)
        forces = rows.force(self._multipliers_in(rows, eps * normal))
        turned, turned_beyond = (
            (new - old) / eps for new, old in zip(forces, self._force, strict=True)
        )
        pressed, lacking = self._of_changes(change.forces)
        parts = [
            s.stiffness_times(u) for s, u in zip(self.exact, change.displacements, strict=True)
        ]
        force = load_case.torn.sum_at_nodes(self.exact, parts) + pressed + turned
        gap = _difference(self._gap, face.distances_of(rows)) / eps
        compliance = face.rows.compliance(face.multipliers)
        gap[: face.held.size] -= compliance * self._normal_of_changes(change.forces)
        tangential = face.rows.friction_forces(self.base.changes_of(change.forces))
        gap[face.held.size :] -= face.rows.elastic_slip(tangential)[face.sticks].ravel()
        tied_gap = _difference(self._tied_gap, rows.tied.gap / rows.tied.length) / eps
        tied_gap += self._shortened(change)
        force = load_case.at_free(force, face.rows)
        return self._flat(force, gap, tied_gap, beyond + turned_beyond + lacking)

    def _shortened(self, change: Change) -> Vector:
        """Return the jumps of tied rows [m] by bolts that shorten, which no state has. Collective.

        A step has all of the shortening as its unknown.
        """
        nodes, tied = self.load_case.torn.nodes, self.face.rows.tied
        bolts = self.face.rows.contact_set.bolt_displacements(change.displacements)
        still = np.zeros(nodes.owned * nodes.components)
        return row_values(nodes, tied, still, bolts) / tied.length

    def _moved(self, motions: Sequence[Vector]) -> RigidBodies:
        """Return the bodies with other motions, and rotations as they are."""
        bodies = self.face.rows.contact_set.bodies
        frames = [replace(f, motion=m) for f, m in zip(bodies.frames, motions, strict=True)]
        return replace(bodies, frames=frames)

    def _multipliers_in(self, rows: DeformedRows, normal: Vector) -> Multipliers:
        """Return multipliers in other rows, with friction after changes of normal forces."""
        face, multipliers = self.face, self.face.multipliers
        changed = multipliers.normal.copy()
        changed[face.rows.place] += normal / self.base.rows.contacts.length
        at_bounds = rows.at_bounds(replace(multipliers, normal=changed))
        return replace(at_bounds, normal=multipliers.normal)

    def _normal_of_changes(self, forces: RowValues) -> Vector:
        """Return the changes of the normal forces (k,) of the contact rows [N]."""
        return self.face.rows.normal_forces(self.base.changes_of(forces))

    def _of_changes(self, forces: RowValues) -> tuple[Vector, Vector]:
        """Return B'dP at the mesh's nodes, and beyond them what it has more than that of M."""
        changes = self.base.changes_of(forces)
        force, beyond = self.face.rows.force(changes)
        if self.face.rows is self.base.rows:
            return force, np.zeros_like(beyond)
        return force, beyond - self.base.rows.force(changes)[1]

    @cached_property
    def _gap(self) -> Vector:
        """The distances of the rows of the face; slips where friction holds [m]."""
        return self.face.contacts.gap / self.face.contacts.length

    @cached_property
    def _tied_gap(self) -> Vector:
        """The jumps of tied rows [m]."""
        return self.face.rows.tied.gap / self.face.rows.tied.length

    def _flat(self, force: Vector, gap: Vector, tied_gap: Vector, beyond: Vector) -> Vector:
        """Return one vector, with gaps as forces; of gaps those of the face."""
        gap = np.where(self.linear.active & np.isfinite(gap), gap, 0.0)
        tied_gap = np.where(np.isfinite(tied_gap), tied_gap, 0.0)
        unit = self.load_case.slip_stiffness
        return np.concatenate([force.ravel(), unit * gap, unit * tied_gap, beyond.ravel()])

    @cached_property
    def _sizes(self) -> list[int]:
        """The sizes of the parts of a vector."""
        force, beyond = self._force
        return [force.size, self._gap.size, self.face.rows.tied.size, beyond.size]

    @cached_property
    def _space(self) -> Space:
        """The inner product; forces beyond the nodes of the mesh are the same on all ranks."""
        comm = self.load_case.torn.nodes.comm
        return Space(sum(self._sizes[: 4 if comm.rank == 0 else 3]), comm.allreduce)

    def corrected(
        self, first: Change, balance: tuple[Vector, Vector], rtol: float, negligible: float
    ) -> Correction:
        """Return the solution with E. Collective.

        `first` is that of M. Its residual is reduced to `rtol` of the right-hand side at the mesh's
        nodes, or to negligible forces [N]. What is left of it is relative to the larger of its
        first value and that right-hand side, with the forces at nodes and beyond that the step
        balances.
        """
        right = self._flat(balance[0], self._gap, self._tied_gap, balance[1])
        # what bodies carry is mostly balanced by their loads and supports, and jumps at bolts by
        # their shortening
        jumps = self._tied_gap - self._shortened(first)
        at_nodes = self._flat(balance[0], self._gap, jumps, np.zeros_like(balance[1]))
        size = self._space.norm(at_nodes)
        begin = self.face.rows.contact_set.bodies.motions
        return self._improved(first, right, balance[1], begin, (rtol, size, negligible))

    def response(self, load: Vector, gap: Vector, tied_gap: Vector, beyond: Vector) -> Change:
        """Return the changes along changes of loads and gaps. Collective.

        Loads (owned, gdim) are at the mesh's nodes, those beyond them at bodies; gaps are those of
        the face's `contacts` and ties. GMRES leaves a small part of the right-hand side, or what it
        can.
        """
        right = self._flat(load, gap, tied_gap, beyond)
        first = self._solution(self._data(right)[0], _INNER)
        accuracy = (_ALONG, self._space.norm(right), 0.0)
        return self._improved(first, right, beyond, self._at_rest, accuracy).change

    @property
    def _at_rest(self) -> list[Vector]:
        """The motions of bodies without displacement."""
        return self.face.rows.contact_set.motions_after([np.zeros(s.size) for s in self.used])

    def _improved(
        self,
        first: Change,
        right: Vector,
        beyond: Vector,
        begin: Sequence[Vector],
        accuracy: tuple[float, float, float],
    ) -> Correction:
        """Return the solution of a right-hand side by GMRES, from a first one. Collective.

        Bodies begin at their motions. The accuracy is that of `corrected`, relative to a force [N].
        """
        torn, (rtol, size, negligible) = self.load_case.torn, accuracy
        largest = np.abs(torn.at_owned_nodes(first.displacements))
        longest, extent = largest_of_ranks(torn.nodes.comm, largest), self.load_case.rounding.extent
        length = min(max(longest, _SHORTEST * extent), _LONGEST * extent)
        at_rest = self._at_rest
        # the forces of other rows are those of `first` already
        rows = self.face.held.size
        changes = np.where(self.face.held, first.forces.normal[:rows], 0.0)
        residual = right - self.times(first, changes, begin, length, beyond)

        def step(v: Vector) -> tuple[tuple[Change, Vector], Vector]:
            data, beyond = self._data(v)
            change = self._solution(data, _INNER)
            normal = change.forces.normal[:rows]
            return (change, v), self.times(change, normal, at_rest, length, beyond)

        beta, tolerance = self._space.norm(residual), max(rtol * size, negligible)
        parts, y, left = gmres(step, residual, self._space, tolerance=tolerance, max_it=_MOST)
        if not parts:
            return Correction(first)
        added, given = parts[0][0].plus(float(y[0]) - 1.0, parts[0][0]), y[0] * parts[0][1]
        for factor, (change, v) in zip(y[1:], parts[1:], strict=True):
            added, given = added.plus(float(factor), change), given + factor * v
        left /= max(beta, size, negligible)
        curvature = self._curvature(residual, given, added)
        return Correction(first.plus(1.0, added), len(parts), left, added, curvature)

    def _curvature(self, right: Vector, given: Vector, added: Change) -> float:
        """Return d'(K + E)d of an addition d, at the most [J]. Collective.

        It is the work of the forces that GMRES balances, less that of the forces of rows along the
        distances which their solutions are given. Without these d is in the null space of the rows,
        where alone the sign says something; so their work counts as positive.
        """
        jumps, forces = self._data(given)[0].jumps, added.forces
        pairs = zip(self._data(right)[0].loads, added.displacements, strict=True)
        work = sum(float(load @ d) for load, d in pairs)
        of_rows = float(jumps.normal @ forces.normal + jumps.tied @ forces.tied)
        comm = self.load_case.torn.nodes.comm
        work, of_rows = comm.allreduce(np.array([work, of_rows])).tolist()
        return work + abs(of_rows)

    def _solution(self, data: LinearData, rtol: float) -> Change:
        """Return the solution of M. Collective."""
        solution = self.linear.approximate(data, rtol)
        self.spent.products += solution.products
        return Change(solution.displacements, solution.forces)

    def first(self, balance: tuple[Vector, Vector], rtol: float) -> Change:
        """Return the solution of M of the present loads and gaps. Collective."""
        data, _ = self._data(self._flat(balance[0], self._gap, self._tied_gap, balance[1]))
        total = self.load_case.torn.nodes.total
        loads = [
            load if s.nodes[0] < total else load + s.load
            for s, load in zip(self.exact, data.loads, strict=True)
        ]
        return self._solution(replace(data, loads=loads), rtol)

    def gaps_after(self, change: Change) -> Vector:
        """Return the gaps (k,) of the contact rows after a change, to first order. Collective."""
        contact_set, nodes = self.face.rows.contact_set, self.load_case.torn.nodes
        d = self.load_case.torn.at_owned_nodes(change.displacements)
        pairs = zip(
            contact_set.bodies.motions, contact_set.motions_after(change.displacements), strict=True
        )
        moved = self._moved([end - begin for begin, end in pairs])
        rows, free = self.face.rows.contacts, moved.free_displacements(nodes.total)
        return (rows.gap - row_values(nodes, rows, d, free)) / rows.length

    def _data(self, v: Vector) -> tuple[LinearData, Vector]:
        """Return loads and jumps of a vector, and forces beyond the mesh. Collective."""
        torn, unit = self.load_case.torn, self.load_case.slip_stiffness
        force, gap, tied_gap, beyond = np.split(v, np.cumsum(self._sizes[:-1]))
        shape = -1, torn.nodes.components
        beyond = beyond.reshape(shape)
        loads = torn.spread(self.used, force.reshape(shape), beyond)
        none = RowValues.zeros(self.linear.system)
        jumps = replace(none, normal=gap / unit, tied=tied_gap / unit)
        return LinearData(loads, jumps, none), beyond


def _difference(before: Vector, after: Vector) -> Vector:
    """Return the difference, zero where there is no row and where nothing is opposite."""
    is_known = np.isfinite(before) & np.isfinite(after)
    return np.subtract(before, after, out=np.zeros_like(before), where=is_known)

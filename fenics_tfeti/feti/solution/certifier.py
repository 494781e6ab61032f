"""The primal problem (11.21), and how well displacements and multipliers solve it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

from mpi4py import MPI

import numpy as np

from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.constraints.row_table import Kind
from fenics_tfeti.feti.constraints.springs import Springs
from fenics_tfeti.feti.local.congruence import times_rows
from fenics_tfeti.feti.solution.certificate import BodyError, Certificate, GroupError
from fenics_tfeti.feti.solution.recovery import Recovered
from fenics_tfeti.feti.solution.setup import DualSetup
from fenics_tfeti.feti.solution.states import ContactData
from fenics_tfeti.feti.tolerances import FEW, HARDLY_DEFORMED, MANY, UNDEFORMED, ZERO, rounding
from fenics_tfeti.parallel import largest_of_ranks
from fenics_tfeti.qp import balls
from fenics_tfeti.typing import Mask, Numbers, Vector

# rounding of motions that were taken out of the data, relative to that of motions in the iterations
_ROUNDED_ONCE = 1e-3


@dataclass(frozen=True)
class _Sums:
    """Sums over the unknowns of each subdomain, or of each body over all ranks."""

    error2: Vector  # ||u - u_t||_K^2, and twice what friction and springs lack to their laws [J]
    strain2: Vector  # ||u_t||_K^2, and twice the energy of springs [J]
    residual2: Vector  # ||Ku_t - f + B'lambda||^2 [N^2]
    force2: Vector  # ||f||^2 + ||B'lambda||^2 [N^2]
    flexibility: Vector  # f'D^{-1}f and the same of B'lambda, D the diagonal of K [J]
    energy: Vector  # 1/2 u'Ku - f'u, with springs, with friction and r |s| [J]

    @staticmethod
    def zeros(size: int) -> _Sums:
        """Return sums of nothing."""
        return _Sums(*np.zeros((len(fields(_Sums)), size)))


@dataclass(frozen=True)
class _BodyMeasures:
    """Errors of each body, and their scales."""

    error2: Vector  # ||u - u_t||_K^2 [J]; infinite where G lambda = e does not hold
    strain2: Vector  # ||u_t||_K^2, with springs [J]
    equilibrium: Vector  # ||Ku_t - f + B'lambda||, relative to the forces
    rounding2: float  # what rounding may leave in an energy of any body [J]
    deformed: Mask  # whether the strains are more than rounding
    deformation: Vector  # largest displacement without rigid motions of subdomains [m]


@dataclass(frozen=True)
class Certifier:
    """Measures solutions by K, f, B and c of (11.21) on this rank."""

    setup: DualSetup  # K and B
    data: ContactData  # f, c and r
    body_names: Sequence[str]

    def certify(
        self, recovered: Recovered, multipliers: Vector, coarse_space: CoarseSpace
    ) -> tuple[Certificate, float]:
        """Measure how well displacements and multipliers solve the primal problem. Collective.

        The multipliers have lambda_I >= o, and G lambda = e but for motions that their face leaves
        free. Returned beside the certificate: 1/2 u'Ku - f'u, with springs, and with friction and
        the sum of r |s| [J].
        """
        sums = self._sums(recovered, multipliers)
        measures = self._body_measures(sums, recovered, multipliers, coarse_space)
        groups, bodies = self._errors(measures, recovered)
        bound, norm = np.sqrt([measures.error2.sum(), measures.strain2.sum()]).tolist()
        # all strains may be rounding
        largest = max((group.error for group in groups), default=0.0)
        certificate = Certificate(
            bound=bound,
            error=bound / norm if measures.deformed.any() else largest,
            groups=groups,
            bodies=bodies,
            equilibrium=float(measures.equilibrium.max(initial=0.0)),
            guaranteed=not self.setup.negative,
            **self._contact_errors(recovered, multipliers, measures.deformation),
            **self._friction_errors(recovered, multipliers, measures.deformation),
        )
        return certificate, float(sums.energy.sum())

    def slips(self, recovered: Recovered) -> Vector:
        """Return s = B_T u - c_T at the sites of friction, (k, gdim - 1), scaled as the rows.

        It is zero where the rows were closed without elastic slip, and where it is no more than the
        rounding of its terms: times the bound, whose energy is of first order, even that would show
        in the error. Collective.
        """
        slips, sticking = (
            self.setup.constraints.friction.at_sites(recovered.jumps),
            recovered.face.sticking,
        )
        if self.data.springs is not None:
            sticking = sticking & (self.data.springs.sticking == 0.0)
        slips[sticking | self._slips_are_rounding(recovered.displacement, slips)] = 0.0
        return slips

    def _slips_are_rounding(self, displacement: Vector, slips: Vector) -> Mask:
        """Tell where slips (k, gdim - 1) are rounding. Collective.

        The sum of n terms and a shift is accurate to (n + 1) eps / 2 of their magnitudes, and so is
        the shift that another displacement has made.
        """
        constraints = self.setup.constraints
        if not constraints.friction.anywhere:
            return np.zeros(len(slips), dtype=bool)
        friction = constraints.friction
        B = constraints.matrix[friction.flat]
        magnitudes, terms = np.zeros((2, constraints.size))
        magnitudes[friction.flat] = abs(B) @ np.abs(displacement)
        terms[friction.flat] = np.diff(B.indptr)
        magnitudes, terms = map(constraints.layout.sum, (magnitudes, terms))
        magnitudes += np.abs(self.data.c) + np.abs(self.data.removed)
        size = friction.at_sites(magnitudes * (terms + 1.0))
        return (np.abs(slips) <= rounding(size)).all(axis=1)

    @property
    def _comm(self) -> MPI.Intracomm:
        return self.setup.constraints.layout.comm

    def _errors(
        self, measures: _BodyMeasures, recovered: Recovered
    ) -> tuple[list[GroupError], list[BodyError]]:
        """Return the errors of groups and of bodies, each relative to its own scale."""
        row_bodies = self.setup.row_bodies
        group = row_bodies.groups(self._comm, recovered.closed, self.data.radius > 0.0)
        names = [
            self.body_names[b] if b < len(self.body_names) else f"body {b}"
            for b in range(row_bodies.bodies)
        ]
        size = np.bincount(group)
        error2, strain2 = (np.bincount(group, x) for x in (measures.error2, measures.strain2))
        rounding2 = measures.rounding2 * size
        groups = [
            GroupError(
                [names[b] for b in np.flatnonzero(group == g)],
                float(np.sqrt(strain2[g])),
                _relative(error2[g], strain2[g], rounding2[g]),
            )
            for g in range(size.size)
        ]
        scale2 = np.maximum(measures.strain2, HARDLY_DEFORMED**2 * strain2[group])
        bodies = [
            BodyError(
                name,
                float(np.sqrt(measures.strain2[b])),
                _relative(measures.error2[b], scale2[b], rounding2[group[b]]),
                float(np.sqrt(scale2[b])),
            )
            for b, name in enumerate(names)
        ]
        return groups, bodies

    def _sums(self, recovered: Recovered, multipliers: Vector) -> _Sums:
        """Return the sums of each body. Collective."""
        row_bodies, friction = self.setup.row_bodies, self.setup.constraints.friction
        of_subdomain, number = row_bodies.of_subdomain, row_bodies.bodies
        parts = vars(self._subdomain_sums(recovered, multipliers)).values()
        # bincount of nothing makes integers, which ranks without subdomains would send
        sums = np.array([np.bincount(of_subdomain, part, number) for part in parts], dtype=float)
        own = _Sums(*sums)
        slips, along = self.slips(recovered), balls.directions(friction.at_sites(multipliers))
        sites = np.flatnonzero(self.setup.constraints.owned_sites)
        body, radius = row_bodies.of_sites(friction.size)[sites], self.data.radius[sites]
        if self.data.springs is None:
            lack = (self.data.radius * balls.misalignment(slips, along))[sites]
            energy = radius * np.linalg.norm(slips, axis=1)[sites]
        else:
            energy, lack = self._site_energies(slips, recovered, multipliers, self.data.springs)
            energy, lack = energy[sites], lack[sites]
        np.add.at(own.error2, body, 2.0 * lack)
        np.add.at(own.energy, body, energy)
        self._add_springs(own, recovered, multipliers)
        self._comm.Allreduce(MPI.IN_PLACE, sums)
        return own

    def _add_springs(self, sums: _Sums, recovered: Recovered, multipliers: Vector) -> None:
        """Add what springs lack to their law, and their energies, to the sums of bodies."""
        springs, constraints = self.data.springs, self.setup.constraints
        if springs is None:
            return
        force, closing = self._spring_states(recovered, multipliers, springs)
        energy, lack = springs.energies(force, closing)
        owned = constraints.owned_inequalities
        body = self.setup.row_bodies.of_rows(force.size)[:owned]
        np.add.at(sums.error2, body, 2.0 * lack[:owned])
        np.add.at(sums.strain2, body, (springs.of(force) * force**2)[:owned])
        np.add.at(sums.energy, body, energy[:owned])

        sites = np.flatnonzero(constraints.owned_sites)
        tangential = constraints.friction.at_sites(multipliers)
        twice = (springs.sticking * np.sum(tangential**2, axis=1))[sites]
        np.add.at(sums.strain2, self.setup.row_bodies.of_sites(tangential.shape[0])[sites], twice)

    def _site_energies(
        self, slips: Vector, recovered: Recovered, multipliers: Vector, springs: Springs
    ) -> tuple[Vector, Vector]:
        """Return the energies of slips of sites (k,), and what they lack to the law. Collective."""
        forces = self.setup.constraints.friction.at_sites(multipliers)
        slips = self._without_rounding(slips, recovered, springs.elastic(forces))
        return springs.site_energies(forces, slips, self.data.radius)

    def _without_rounding(self, slips: Vector, recovered: Recovered, elastic: Vector) -> Vector:
        """Return slips of sites that stick as elastic ones where they differ by rounding.

        All are (k, gdim - 1). Collective.
        """
        size = largest_of_ranks(self._comm, np.abs(recovered.displacement))
        same = (np.abs(slips - elastic) <= rounding(size, MANY)).all(axis=1)
        return np.where((recovered.face.sticking & same)[:, None], elastic, slips)

    def _spring_states(
        self, recovered: Recovered, multipliers: Vector, springs: Springs
    ) -> tuple[Vector, Vector]:
        """Return forces and closings v = Bu - c of the contact rows (i,). Collective.

        Those that are closed are v = C lambda where they differ by rounding of displacements, whose
        energy in stiff springs would show in the error.
        """
        constraints = self.setup.constraints
        rows = constraints.inequality
        force, closing = multipliers[rows], recovered.jumps[rows]
        by_springs = springs.of(force) * force
        size = np.abs(self.data.c[rows])
        size = size + largest_of_ranks(self._comm, np.abs(recovered.displacement))
        same = recovered.closed & (np.abs(closing - by_springs) <= rounding(size, MANY))
        return force, np.where(same, by_springs, closing)

    def _subdomain_sums(self, recovered: Recovered, multipliers: Vector) -> _Sums:
        """Return the sums of each subdomain, without friction."""
        setup = self.setup
        constraint_forces = setup.F.constraint_forces(multipliers)
        sums = _Sums.zeros(setup.row_bodies.of_subdomain.size)
        for congruent, K in zip(setup.F.interface.classes, setup.local.stiffness, strict=True):
            for batch in congruent.batches():
                load, pull = batch.rows(self.data.load), batch.rows(constraint_forces)
                strained, u = batch.rows(recovered.strained), batch.rows(recovered.displacement)
                forces, difference = load - pull, u - batch.rows(recovered.torn)
                # the rigid motions have no part in K u_t
                of_strained, of_difference = times_rows(K, strained), times_rows(K, difference)
                if not K.nnz:
                    # what keeps a body rigid balances all but resultant and moment
                    R = setup.local.kernels[congruent.first]
                    of_strained += forces - (forces @ R) @ R.T
                applied, members = load**2 + pull**2, batch.members
                error2 = np.sum(difference * of_difference, axis=1)
                sums.error2[members] = np.abs(error2) if self.setup.negative else error2
                sums.strain2[members] = np.sum(strained * forces, axis=1)
                sums.residual2[members] = np.sum((of_strained - forces) ** 2, axis=1)
                sums.force2[members] = np.sum(applied, axis=1)
                # neither rigid bodies nor the ground of pressures have any
                d = K.diagonal()
                sums.flexibility[members] = applied @ np.divide(
                    1.0, d, out=np.zeros_like(d), where=d > 0.0
                )
                work = u * (0.5 * (of_strained + of_difference) - load)
                sums.energy[members] = np.sum(work, axis=1)
        return sums

    def _body_measures(
        self, sums: _Sums, recovered: Recovered, multipliers: Vector, coarse_space: CoarseSpace
    ) -> _BodyMeasures:
        """Return errors and scales of each body. Collective."""
        error2, strain2 = np.maximum(sums.error2, 0.0), np.maximum(sums.strain2, 0.0)
        # the coarse problem spreads rounding errors over all bodies
        energy2 = sums.flexibility.sum() + self._energy_of_motions(recovered)
        rounding2 = float(np.finfo(float).eps ** 2 * energy2)
        # where G lambda = e does not hold, there is no bound
        error2[self._unbalanced(multipliers, coarse_space, rounding2)] = np.inf
        deformed = strain2 > UNDEFORMED**2 * rounding2
        equilibrium = np.sqrt(sums.residual2 / np.where(deformed, sums.force2, np.inf))
        deformation = np.where(deformed, self._deformation(recovered.strained), 0.0)
        return _BodyMeasures(error2, strain2, equilibrium, rounding2, deformed, deformation)

    def _unbalanced(self, multipliers: Vector, coarse_space: CoarseSpace, rounding2: float) -> Mask:
        """Tell on which bodies G lambda = e does not hold up to rounding. Collective.

        Rounding is that of the forces, and that of the springs that close the jumps.
        """
        load, body = self.data.load, coarse_space.bodies.of_coarse
        pull = self.setup.F.constraint_forces(multipliers)
        size = coarse_space.coarse_load_size(load) + coarse_space.coarse_load_size(pull)
        missing = coarse_space.coarse_load(np.subtract(load, pull, out=pull))
        bodies = self.setup.row_bodies.bodies
        missing, size = (np.sqrt(np.bincount(body, x**2, bodies)) for x in (missing, size))
        of_springs = FEW * np.sqrt(self.setup.local.unit * rounding2)
        of_forces = rounding(float(np.linalg.norm(size)), FEW)
        return missing > ZERO * size + of_forces + of_springs

    def _energy_of_motions(self, recovered: Recovered) -> float:
        """Return the energy of the rigid motions that close jumps, if rows were springs."""
        constraints, closing = self.setup.constraints, self.data.c.copy()
        rows = constraints.inequality
        closing[rows] = np.where(recovered.closed, closing[rows], np.minimum(closing[rows], 0.0))
        closing[constraints.friction.on_rows(~recovered.face.sticking, closing.size)] = 0.0
        removed = np.broadcast_to(self.data.removed, closing.shape)
        closed2, removed2 = constraints.layout.space.dots((closing, closing), (removed, removed))
        return self.setup.local.unit * float(closed2 + _ROUNDED_ONCE**2 * removed2)

    def _deformation(self, strained: Vector) -> Vector:
        """Return the size of each body's displacement without rigid motions of subdomains [m]."""
        row_bodies = self.setup.row_bodies
        size = np.zeros(row_bodies.bodies)
        starts = self.setup.local.unknowns.ends[:-1]
        if starts.size:
            of_subdomain = np.maximum.reduceat(np.abs(strained), starts)
            np.maximum.at(size, row_bodies.of_subdomain, of_subdomain)
        self._comm.Allreduce(MPI.IN_PLACE, size, MPI.MAX)
        return size

    def _contact_errors(
        self, recovered: Recovered, multipliers: Vector, deformation: Vector
    ) -> dict[str, float]:
        """Return penetration, smallest force and complementarity, as in `Certificate`."""
        constraints, row_bodies = self.setup.constraints, self.setup.row_bodies
        rows = constraints.inequality
        contacts = constraints.rows.of(Kind.CONTACT)
        scale = row_bodies.largest(deformation, rows.size)
        distance = recovered.jumps[rows].copy()
        limit, pushing = np.zeros(rows.size), np.ones(rows.size, dtype=bool)
        if self.data.springs is not None:
            # of springs the distance from what their force closes them by
            forces, closing = self._spring_states(recovered, multipliers, self.data.springs)
            by_springs = self.data.springs.of(forces) * forces
            limit = np.where(by_springs < 0.0, -by_springs, 0.0)
            distance, pushing = closing - by_springs, ~self.data.springs.pulling
            scale = np.maximum(scale, np.abs(by_springs) / contacts.scale)
        distance, limit = (
            x / contacts.scale / np.where(scale > 0.0, scale, np.inf) for x in (distance, limit)
        )
        force = multipliers[rows] * contacts.scale
        force /= self._largest_of_contact(contacts.contact, np.abs(force))
        largest = self._largest(
            penetration=np.maximum(distance - limit, 0.0),
            smallest_force=-force[pushing],
            complementarity=np.abs(force * distance),
        )
        return largest | {"smallest_force": -largest["smallest_force"]}

    def _friction_errors(
        self, recovered: Recovered, multipliers: Vector, deformation: Vector
    ) -> dict[str, float]:
        """Return excess over the bound, slip below it and across the force, as in `Certificate`."""
        friction, radius = self.setup.constraints.friction, self.data.radius
        scale = self.setup.row_bodies.largest_at_sites(deformation, friction.size)
        slip = friction.at_sites(recovered.jumps)
        forces = friction.at_sites(multipliers)
        if self.data.springs is not None:
            elastic = self.data.springs.elastic(forces)
            slip = self._without_rounding(slip, recovered, elastic) - elastic
            scale = np.maximum(scale, np.linalg.norm(elastic, axis=1) / friction.scale)
        slip = slip / friction.scale[:, None]
        slip /= np.where(scale > 0.0, scale, np.inf)[:, None]
        along = balls.directions(forces)
        forwards = np.maximum(np.sum(slip * along, axis=1, keepdims=True), 0.0)
        weight = friction.scale / self._largest_of_contact(
            friction.contact, friction.scale * self.data.bound.limited(radius)
        )
        excess = weight * (np.linalg.norm(forces, axis=1) - radius)
        # of small forces the direction matters little
        across = weight * radius * np.linalg.norm(slip - forwards * along, axis=1)
        slipping = ~recovered.face.sticking & (radius > 0.0)
        return self._largest(
            friction_excess=np.maximum(excess, 0.0),
            slip_below_bound=np.linalg.norm(slip, axis=1)[recovered.face.sticking],
            slip_across_force=across[slipping],
        )

    def _largest_of_contact(self, contact: Numbers, values: Vector) -> Vector:
        """Return for each row the largest value of its contact, or 1 if none is positive."""
        largest = np.zeros(self.setup.row_bodies.contacts)
        np.maximum.at(largest, contact, values)
        self._comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
        return np.where(largest > 0.0, largest, 1.0)[contact]

    def _largest(self, **values: Vector) -> dict[str, float]:
        """Return the largest of some values over all ranks, 0 where there are none. Collective."""
        largest = np.array([x.max(initial=-np.inf) for x in values.values()])
        self._comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
        return {
            name: 0.0 if x == -np.inf else x
            for name, x in zip(values, largest.tolist(), strict=True)
        }


def _relative(error2: float, scale2: float, rounding2: float) -> float:
    """Return an error relative to its scale; zero where both are rounding."""
    negligible2 = UNDEFORMED**2 * rounding2
    if scale2 <= negligible2:
        return 0.0 if error2 <= negligible2 else float(np.sqrt(error2 / negligible2))
    return float(np.sqrt(error2 / scale2))

"""The certificate: a guaranteed bound of the error, and how well the conditions of (11.21) hold.

For a displacement u on which all constraints hold, multipliers with lambda_I >= o and
G lambda = e, and their torn displacement u_t = K^+(f - B'lambda) + R alpha, the primal energy of u
minus the dual value of lambda is

    J(u) - D(lambda) = 1/2 ||u - u_t||_K^2 + lambda_I'(c - B_I u),

the last term zero where the contacts that press are closed. As J(u) >= J(u*) >= D(lambda), the
error of u in the energy norm is at most ||u - u_t||_K (Prager and Synge, on the discrete problem).
With friction J includes r |s| of the slips s = B_T u - c_T, and twice r |s| - lambda_T's is added
to the square of the bound: zero where nothing slips, or the slip is along a force of size r.

Soft elastic supports are a part of K, with their ground as unknowns that equality rows hold
(`local.elastic_supports`): u is on y = o, u_t moves the ground a little, and the bound is the same.

Bodies that do not press on each other decouple: the same holds for each *group* of bodies that are
connected by closed contacts or tied. The share of a single body in ||u - u_t||_K is an estimate of
its error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.dual.operator import DualOperator
from fenics_tfeti.feti.local.congruence import times_rows
from fenics_tfeti.feti.solution.recovery import Recovered
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.feti.tolerances import HARDLY_DEFORMED, NEARLY_IDLE, UNDEFORMED
from fenics_tfeti.parallel import Directory, concatenate_buffers
from fenics_tfeti.qp import balls
from fenics_tfeti.typing import Mask, Numbers, Vector

# rounding of motions that were taken out of the data, relative to that of motions in the iterations
_ROUNDED_ONCE = 1e-3


@dataclass(frozen=True)
class BodyError:
    """The error of one body.

    Attributes
    ----------
    body : str
        Its name.
    energy_norm : float
        ||u||_K of the body [sqrt(J)].
    error : float
        The body's share of ||u - u_t||_K, relative to its energy norm, or to a thousandth of its
        group's where the body hardly deforms.
    scale : float
        What it is relative to [sqrt(J)].
    """

    body: str
    energy_norm: float
    error: float
    scale: float


@dataclass(frozen=True)
class GroupError:
    """The error of a group of bodies that press on each other.

    Attributes
    ----------
    bodies : list of str
        Their names.
    energy_norm : float
        ||u||_K of the group [sqrt(J)].
    error : float
        Bound of ||u - u*||_K / ||u||_K; zero where the strains of the group are rounding.
    """

    bodies: list[str]
    energy_norm: float
    error: float

    @property
    def scale(self) -> float:
        """What the error is relative to: the energy norm [sqrt(J)]."""
        return self.energy_norm


@dataclass(frozen=True)
class Certificate:
    """How well displacements and multipliers solve (11.21), from K, f, B and c alone.

    All numbers are relative to scales of the body or contact concerned; all are zero for an exact
    solution. A rigid motion of any size changes none of them.

    Attributes
    ----------
    bound : float
        Bound of ||u - u*||_K, u* the exact solution [sqrt(J)].
    error : float
        The same relative to ||u||_K.
    groups : list of GroupError
        The same for each group of bodies that press on each other.
    bodies : list of BodyError
        The share of each body.
    equilibrium : float
        Largest ||Ku_t - f + B'lambda|| of a body, relative to its forces.
    penetration : float
        Largest violation of (u_slave - u_master)'n <= gap, in rows whose slave's sum has
        length 1, relative to the deformation of the bodies that touch there.
    smallest_force : float
        Smallest contact force, relative to the largest of the same contact; negative numbers pull.
    complementarity : float
        Largest product of force and distance, relative to the largest force of the contact and the
        deformation of its bodies.
    friction_excess : float
        Largest excess of a tangential force over its bound, relative to the largest bound of the
        contact.
    slip_below_bound : float
        Largest slip where the tangential force is below its bound, relative to the deformation of
        the bodies that touch there.
    slip_across_force : float
        Largest part of a slip that is not along the tangential force, relative to the same.
    slip_bound_error : float
        With Coulomb's law, difference between the friction forces and the bounds that the normal
        forces make, as root of the sum of squares, relative to the bounds.
    """

    bound: float
    error: float
    groups: list[GroupError]
    bodies: list[BodyError]
    equilibrium: float
    penetration: float
    smallest_force: float
    complementarity: float
    friction_excess: float = 0.0
    slip_below_bound: float = 0.0
    slip_across_force: float = 0.0
    slip_bound_error: float = 0.0

    def numbers(self) -> dict[str, float]:
        """Return what the tolerance limits, by name; of groups and bodies the largest error."""
        return {
            "error": self.error,
            "error of a group": max((group.error for group in self.groups), default=0.0),
            "error of a body": max((body.error for body in self.bodies), default=0.0),
            "equilibrium": self.equilibrium,
            "penetration": self.penetration,
            "negative force": max(0.0, -self.smallest_force),
            "complementarity": self.complementarity,
            "friction above its bound": self.friction_excess,
            "slip below the bound": self.slip_below_bound,
            "slip across the force": self.slip_across_force,
            "slip bound": self.slip_bound_error,
        }

    @property
    def energy_norm(self) -> float:
        """||u||_K [sqrt(J)]."""
        return float(np.sqrt(sum(group.energy_norm**2 for group in self.groups)))

    @property
    def worst(self) -> float:
        """The largest of all numbers."""
        return max(self.numbers().values())

    @property
    def worst_name(self) -> str:
        """The name of the largest number."""
        numbers = self.numbers()
        return max(numbers, key=numbers.__getitem__)

    def with_idle_bodies(self) -> Certificate:
        """Return the certificate with errors of nearly idle bodies and groups bounded absolutely.

        They are relative to a small part of the energy norm of all, if their own is less.
        """
        least = NEARLY_IDLE * self.energy_norm

        def bounded(own: BodyError | GroupError) -> float:
            return own.error * min(1.0, own.scale / least) if least > 0.0 else own.error

        return replace(
            self,
            groups=[replace(group, error=bounded(group)) for group in self.groups],
            bodies=[replace(body, error=bounded(body)) for body in self.bodies],
        )


@dataclass(frozen=True)
class RowBodies:
    """The bodies that contact and tied rows connect.

    Attributes
    ----------
    bodies, contacts : int
        Numbers of bodies and of contacts over all ranks.
    of_subdomain, of_unknown : (subdomains,), (n,) integer arrays
        The body of each of this rank's subdomains and torn unknowns.
    row, body : (p,) integer arrays
        The bodies of each inequality row that this rank holds, (row, body) in ascending order; all
        bodies of a row, whichever rank has them.
    tied : (2, q) integer array
        Pairs of bodies that tied rows of this rank connect.
    site, site_body : (p,) integer arrays
        The bodies of each site of friction that this rank holds, as those of inequality rows.
    """

    bodies: int
    contacts: int
    of_subdomain: Numbers
    of_unknown: Numbers
    row: Numbers
    body: Numbers
    tied: Numbers
    site: Numbers
    site_body: Numbers

    @staticmethod
    def build(system: TornSystem, constraints: Constraints, ends: Numbers) -> RowBodies:
        """Find the bodies of contact and tied rows. Collective.

        Parameters
        ----------
        system : TornSystem
            For the body of each subdomain.
        constraints : Constraints
            B.
        ends : (subdomains + 1,) integer array
            First torn unknown of each subdomain, and the end of the last.
        """
        of_subdomain = np.array([s.body for s in system.subdomains], dtype=np.int64)
        count = system.comm.allreduce(int(of_subdomain.max(initial=-1)), MPI.MAX) + 1
        of_unknown = np.repeat(of_subdomain, np.diff(ends))
        row, body = _bodies_of_rows(constraints, constraints.inequality, of_unknown)
        pairs = _pairs(*_bodies_of_rows(constraints, constraints.tied.rows, of_unknown))
        numbers = np.append(constraints.contact, constraints.friction.contact)
        contacts = system.comm.allreduce(int(numbers.max(initial=-1)), MPI.MAX) + 1
        sites = _bodies_of_rows(constraints, constraints.friction.rows.max(axis=1), of_unknown)
        return RowBodies(count, contacts, of_subdomain, of_unknown, row, body, pairs, *sites)

    def groups(self, comm: MPI.Intracomm, closed: Mask, rubbing: Mask) -> Numbers:
        """Return the group of each body. Collective.

        Parameters
        ----------
        comm : MPI.Intracomm
            The ranks.
        closed : (i,) bool array
            The contact rows that are closed.
        rubbing : (k,) bool array
            The sites of friction that may have a force.
        """
        chosen, rubs = closed[self.row], rubbing[self.site]
        pairs = np.hstack(
            [
                _pairs(self.row[chosen], self.body[chosen]),
                _pairs(self.site[rubs], self.site_body[rubs]),
                self.tied,
            ]
        )
        first, last = concatenate_buffers(comm, *pairs)
        graph = sp.coo_matrix(
            (np.ones(first.size), (first, last)), shape=(self.bodies, self.bodies)
        )
        group: Numbers = connected_components(graph, directed=False)[1].astype(np.int64)
        return group

    def largest(self, of_body: Vector, rows: int) -> Vector:
        """Return the largest value among the bodies of each inequality row, of `rows` rows."""
        largest = np.zeros(rows)
        np.maximum.at(largest, self.row, of_body[self.body])
        return largest

    def largest_at_sites(self, of_body: Vector, sites: int) -> Vector:
        """Return the largest value among the bodies of each of `sites` sites of friction."""
        largest = np.zeros(sites)
        np.maximum.at(largest, self.site, of_body[self.site_body])
        return largest


def _bodies_of_rows(
    constraints: Constraints, rows: Numbers, of_unknown: Numbers
) -> tuple[Numbers, Numbers]:
    """Return the positions in `rows`, ascending, and the bodies of each, of all ranks."""
    numbers = constraints.layout.numbers[rows]
    entries = constraints.matrix[rows].tocoo()
    own = np.unique(np.stack([numbers[entries.row], of_unknown[entries.col]]), axis=1)
    directory = Directory(constraints.layout.comm, numbers)
    number, body = np.unique(np.stack(directory.forward(*own)), axis=1)
    order = np.argsort(numbers, kind="stable")
    row = order[np.searchsorted(numbers[order], number)]
    by_row = np.lexsort((body, row))
    return row[by_row], body[by_row]


def _pairs(row: Numbers, body: Numbers) -> Numbers:
    """Return the distinct pairs (2, q) of the first body of a row and each of its bodies."""
    first = body[np.searchsorted(row, row)]
    pairs: Numbers = np.unique(np.stack([first, body]), axis=1)
    return pairs


@dataclass(frozen=True)
class PrimalProblem:
    """K, f, B and c of (11.21) on this rank.

    Attributes
    ----------
    stiffness : list of (n_i, n_i) scipy.sparse.csr_matrix
        K_i of each class of congruent subdomains [N/m].
    load : (n,) array
        f [N].
    c : (m,) array
        Right-hand sides of the constraints.
    removed : (m,) array
        What prescribed motions were in c: its rounding is in c still.
    F : DualOperator
        For B.
    row_bodies : RowBodies
        Bodies of the subdomains and of the contact rows.
    body_names : sequence of str
        Names of the bodies.
    unit : float
        The stiffness that a weight of 1 stands for [N/m].
    radius : (k,) array
        r of each site of friction.
    """

    stiffness: list[sp.csr_matrix]
    load: Vector
    c: Vector
    removed: Vector
    F: DualOperator
    row_bodies: RowBodies
    body_names: Sequence[str]
    unit: float
    radius: Vector

    def certify(
        self, recovered: Recovered, multipliers: Vector, face: Projector
    ) -> tuple[Certificate, float]:
        """Measure how well displacements and multipliers solve the primal problem. Collective.

        Parameters
        ----------
        recovered : Recovered
            Displacements.
        multipliers : (m,) array
            lambda, with lambda_I >= o, and G lambda = e but for motions that the face leaves free.
        face : Projector
            That of the equality rows and the contact rows with a force.

        Returns
        -------
        Certificate, float
            The certificate; 1/2 u'Ku - f'u, with friction and the sum of r |s| [J].
        """
        measures, energy = self._body_measures(recovered, multipliers, face)
        group = self.row_bodies.groups(self._comm, recovered.closed, self.radius > 0.0)
        groups, bodies = self._errors(measures, group)
        bound, norm = np.sqrt([measures.error2.sum(), measures.energy2.sum()]).tolist()
        moved = measures.energy2 > UNDEFORMED**2 * measures.rounding2
        equilibrium = np.sqrt(measures.residual2 / np.where(moved, measures.force2, np.inf))
        deformation = np.where(moved, measures.deformation, 0.0)
        penetration, smallest, complementarity = self._contact_measures(
            recovered, multipliers, deformation
        )
        excess, below, across = self._friction_measures(recovered, multipliers, deformation)
        certificate = Certificate(
            bound=bound,
            error=bound / norm if moved.any() else max((g.error for g in groups), default=0.0),
            groups=groups,
            bodies=bodies,
            equilibrium=float(equilibrium.max(initial=0.0)),
            penetration=penetration,
            smallest_force=smallest,
            complementarity=complementarity,
            friction_excess=excess,
            slip_below_bound=below,
            slip_across_force=across,
        )
        return certificate, energy

    @property
    def _comm(self) -> MPI.Intracomm:
        return self.F.constraints.layout.comm

    def _errors(
        self, measures: _BodyMeasures, group: Numbers
    ) -> tuple[list[GroupError], list[BodyError]]:
        number = int(group.max(initial=-1)) + 1
        error2, energy2, rounding2 = (
            np.bincount(group, weights=values, minlength=number)
            for values in (measures.error2, measures.energy2, measures.rounding2)
        )
        groups = [
            GroupError(
                [self._name(b) for b in np.flatnonzero(group == g)],
                float(np.sqrt(energy2[g])),
                _relative(error2[g], energy2[g], rounding2[g]),
            )
            for g in range(number)
        ]
        scale2 = np.maximum(measures.energy2, HARDLY_DEFORMED**2 * energy2[group])
        bodies = [
            BodyError(
                self._name(b),
                float(np.sqrt(measures.energy2[b])),
                _relative(measures.error2[b], scale2[b], rounding2[group[b]]),
                float(np.sqrt(scale2[b])),
            )
            for b in range(self.row_bodies.bodies)
        ]
        return groups, bodies

    def _name(self, body: int) -> str:
        return self.body_names[body] if body < len(self.body_names) else f"body {body}"

    def _body_measures(
        self, recovered: Recovered, multipliers: Vector, face: Projector
    ) -> tuple[_BodyMeasures, float]:
        """Return energies, forces and sizes of each body, and the energy of all."""
        of_subdomain = self._subdomain_measures(recovered, multipliers)
        sums = np.zeros((len(of_subdomain), self.row_bodies.bodies))
        np.add.at(sums.T, self.row_bodies.of_subdomain, of_subdomain.T)
        np.add.at(sums[0], *self._unused_friction(recovered, multipliers))
        np.add.at(sums[-1], *self._lost_to_friction(recovered))
        self._comm.Allreduce(MPI.IN_PLACE, sums)
        error2, energy2, residual2, force2, rounding2 = np.maximum(sums[:-1], 0.0)
        # where G lambda = e does not hold, there is no bound
        coarse_space = face.coarse_space
        size = coarse_space.coarse_load_size(self.load)
        unbalanced = face.unresisted(coarse_space.coarse_load(self.load), size) != 0.0
        error2[coarse_space.bodies.of_coarse[unbalanced]] = np.inf
        # of forces, and of the rigid motions that close jumps; the coarse problem spreads rounding
        # errors over all bodies
        constraints, closing = self.F.constraints, self.c.copy()
        rows = constraints.inequality
        closing[rows] = np.where(recovered.closed, closing[rows], np.minimum(closing[rows], 0.0))
        closing[constraints.friction.on_rows(~recovered.sticking, closing.size)] = 0.0
        space = constraints.layout.space
        closed2, removed2 = space.dots((closing, closing), (self.removed, self.removed))
        motions2 = self.unit * (closed2 + _ROUNDED_ONCE**2 * removed2)
        rounding2[:] = np.finfo(float).eps ** 2 * (rounding2.sum() + motions2)
        measures = _BodyMeasures(
            error2, energy2, residual2, force2, rounding2, self._deformation(recovered.strained)
        )
        return measures, float(sums[-1].sum())

    def _subdomain_measures(self, recovered: Recovered, multipliers: Vector) -> Vector:
        """Return the first five of `_BodyMeasures` and the energy of each subdomain, (6, s)."""
        constraint_forces = self.F.constraint_forces(multipliers)
        measures = np.zeros((6, self.row_bodies.of_subdomain.size))
        for congruent, K in zip(self.F.interface.classes, self.stiffness, strict=True):
            flexibility = 1.0 / K.diagonal()
            for batch in congruent.batches():
                load, pull = batch.rows(self.load), batch.rows(constraint_forces)
                strained, u = batch.rows(recovered.strained), batch.rows(recovered.displacement)
                forces, difference = load - pull, u - batch.rows(recovered.torn)
                # the rigid motions have no part in K u_t
                of_strained, of_difference = times_rows(K, strained), times_rows(K, difference)
                applied = load**2 + pull**2
                measures[:, batch.members] = (
                    np.sum(difference * of_difference, axis=1),
                    np.sum(strained * forces, axis=1),
                    np.sum((of_strained - forces) ** 2, axis=1),
                    np.sum(applied, axis=1),
                    applied @ flexibility,
                    np.sum(u * (0.5 * (of_strained + of_difference) - load), axis=1),
                )
        return measures

    def _starts(self) -> Numbers:
        classes = self.F.interface.classes
        starts = np.zeros(self.row_bodies.of_subdomain.size, dtype=np.int64)
        for congruent in classes:
            starts[congruent.members] = congruent.starts
        return starts

    def _deformation(self, strained: Vector) -> Vector:
        """Return the size of each body's displacement without rigid motions of subdomains [m]."""
        size = np.zeros(self.row_bodies.bodies)
        starts = self._starts()
        if starts.size:
            largest = np.maximum.reduceat(np.abs(strained), starts)
            np.maximum.at(size, self.row_bodies.of_subdomain, largest)
        self._comm.Allreduce(MPI.IN_PLACE, size, MPI.MAX)
        return size

    def _contact_measures(
        self, recovered: Recovered, multipliers: Vector, deformation: Vector
    ) -> tuple[float, float, float]:
        """Return penetration, smallest force and complementarity, each relative."""
        constraints, bodies = self.F.constraints, self.row_bodies
        rows = constraints.inequality
        jump = recovered.jumps[rows] / constraints.scale
        force = multipliers[rows] * constraints.scale
        largest = np.zeros(bodies.contacts)
        np.maximum.at(largest, constraints.contact, force)
        self._comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
        scale = bodies.largest(deformation, rows.size)
        scale = np.where(scale > 0.0, scale, np.inf)
        relative = force / np.where(largest > 0.0, largest, 1.0)[constraints.contact]
        numbers = np.array(
            [
                (jump / scale).max(initial=0.0),
                (-relative).max(initial=-np.inf),
                np.abs(relative * jump / scale).max(initial=0.0),
            ]
        )
        self._comm.Allreduce(MPI.IN_PLACE, numbers, MPI.MAX)
        smallest = -float(numbers[1]) if np.isfinite(numbers[1]) else 0.0
        return float(numbers[0]), smallest, float(numbers[2])

    def slips(self, recovered: Recovered) -> Vector:
        """Return s = B_T u - c_T at the sites of friction, (k, gdim - 1), scaled as the rows.

        It is zero where the rows were closed.
        """
        slips = self.F.constraints.friction.at_sites(recovered.jumps)
        slips[recovered.sticking] = 0.0
        return slips

    def _unused_friction(self, recovered: Recovered, multipliers: Vector) -> tuple[Numbers, Vector]:
        """Return 2 (r |s| - lambda_T's) of each owned site, with one of its bodies [J]."""
        friction = self.F.constraints.friction
        along = balls.directions(friction.at_sites(multipliers))
        unused = balls.misalignment(self.slips(recovered), along)
        return self._at_owned_sites(2.0 * self.radius * unused)

    def _lost_to_friction(self, recovered: Recovered) -> tuple[Numbers, Vector]:
        """Return r |s| of each owned site, with one of its bodies [J]."""
        return self._at_owned_sites(self.radius * np.linalg.norm(self.slips(recovered), axis=1))

    def _at_owned_sites(self, values: Vector) -> tuple[Numbers, Vector]:
        """Return one of the bodies of each owned site of friction, and its value."""
        constraints = self.F.constraints
        mine = constraints.friction.owned(constraints.layout.owned)
        site, first = np.unique(self.row_bodies.site, return_index=True)
        body = np.zeros(values.size, dtype=np.int64)
        body[site] = self.row_bodies.site_body[first]
        return body[mine], values[mine]

    def _friction_measures(
        self, recovered: Recovered, multipliers: Vector, deformation: Vector
    ) -> tuple[float, float, float]:
        """Return excess over the bound, slip below it and slip across the force, relative."""
        friction, bodies = self.F.constraints.friction, self.row_bodies
        slip = friction.at_sites(recovered.jumps) / friction.scale[:, None]
        forces = friction.at_sites(multipliers)
        largest = np.zeros(bodies.contacts)
        np.maximum.at(largest, friction.contact, friction.scale * self.radius)
        self._comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
        bound = largest[friction.contact]
        scale = bodies.largest_at_sites(deformation, friction.size)
        scale = np.where(scale > 0.0, scale, np.inf)
        along = balls.directions(forces)
        forwards = np.maximum(np.sum(slip * along, axis=1, keepdims=True), 0.0)
        across = np.linalg.norm(slip - forwards * along, axis=1) / scale
        slipping = ~recovered.sticking & (self.radius > 0.0)
        bound = np.where(bound > 0.0, bound, 1.0)
        # of small forces the direction matters little
        across *= friction.scale * self.radius / bound
        excess = friction.scale * (np.linalg.norm(forces, axis=1) - self.radius) / bound
        below = np.linalg.norm(slip, axis=1) / scale
        numbers = np.array(
            [
                excess.max(initial=0.0),
                below[recovered.sticking].max(initial=0.0),
                across[slipping].max(initial=0.0),
            ]
        )
        self._comm.Allreduce(MPI.IN_PLACE, numbers, MPI.MAX)
        return float(numbers[0]), float(numbers[1]), float(numbers[2])


@dataclass(frozen=True)
class _BodyMeasures:
    """Sums over the unknowns of each body, over all ranks."""

    error2: Vector  # ||u - u_t||_K^2 [J]
    energy2: Vector  # ||u_t||_K^2 [J]
    residual2: Vector  # ||Ku_t - f + B'lambda||^2 [N^2]
    force2: Vector  # ||f||^2 + ||B'lambda||^2 [N^2]
    rounding2: Vector  # what rounding may leave in an energy, the same for all bodies [J]
    deformation: Vector  # largest displacement without rigid motions of subdomains [m]


def _relative(error2: float, scale2: float, rounding2: float) -> float:
    """Return an error relative to its scale; zero where both are rounding."""
    negligible2 = UNDEFORMED**2 * rounding2
    if scale2 <= negligible2:
        return 0.0 if error2 <= negligible2 else float(np.sqrt(error2 / negligible2))
    return float(np.sqrt(error2 / scale2))

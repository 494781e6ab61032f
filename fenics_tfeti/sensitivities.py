"""Derivatives of a solved ContactProblem on the face where the solve has ended.

With l and t the normal and friction forces, N and T the rows of unit length, and dJ the change of
a functional J(u, l, t) with the data,

    K z + N'a + T'b + D'rho = dJ/du,  N z = dJ/dl,  T z = dJ/dt where sites stick,  D z = o

on the closed rows N, and b = C T z where sites slip, with C = bound / |slip| across the force. Then

    dJ = z'(df - dK u) + a'dg + b'ds + rho'dv - (T z)'direction d(bound) + what J itself changes by.

With Coulomb's law the bound follows the normal force: N z + mu direction'T z = dJ/dl at sites that
slip, by GMRES with a linear solve a step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import nnls

from dolfinx.fem import Constant, Function
from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError, UnresistedMotion
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.conditions.friction import SlipOrigin
from fenics_tfeti.fem.contact.conditions.pairing import row_values
from fenics_tfeti.fem.contact.conditions.ties import TiedPairing
from fenics_tfeti.fem.contact.contact_set import (
    ContactSet,
    FoundContact,
    FoundTie,
    consecutive,
)
from fenics_tfeti.fem.contact.descriptions.contacts import (
    Contact,
    ContactPair,
    RigidObstacle,
)
from fenics_tfeti.fem.contact.descriptions.partners import Nearest
from fenics_tfeti.fem.contact.descriptions.ties import BoltPreload, PeriodicPair, Tie
from fenics_tfeti.fem.contact.rigid.frames import RigidBodies
from fenics_tfeti.fem.contact.solution.solved import SolvedContacts
from fenics_tfeti.fem.displacement import fill_displacement, fill_owned, owned_values
from fenics_tfeti.fem.sensitivity.forms import (
    FormsAtSolution,
    by_constant,
    by_function,
    by_places,
    check_dependence,
    check_parameter,
    node_changes,
    places_space,
)
from fenics_tfeti.fem.sensitivity.row_supports import (
    derivative_by_places,
    largest_distortion,
)
from fenics_tfeti.fem.sensitivity.supports import prescribed_entries
from fenics_tfeti.fem.torn_problem import TornProblem
from fenics_tfeti.feti.solution.linear import LinearData, LinearProblem, LinearSolution
from fenics_tfeti.feti.solver import TornSolution
from fenics_tfeti.feti.system import Friction, RowValues, TornSystem
from fenics_tfeti.feti.tolerances import ZERO
from fenics_tfeti.parallel import (
    any_rank,
    concatenate_ranks,
    first_of_rank,
    largest_of_ranks,
    raise_collectively,
)
from fenics_tfeti.qp import Space
from fenics_tfeti.qp.gmres import gmres
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class SolvedState:
    """A solved problem as its derivatives see it."""

    torn: TornProblem
    forms: FormsAtSolution
    solved: SolvedContacts
    solution: TornSolution
    linear: LinearProblem
    origin: SlipOrigin
    is_current: Callable[[], bool]  # whether the problem is as it was solved, on all ranks

    @property
    def conditions(self) -> ContactSet:
        """The conditions of contacts and ties."""
        return self.solved.conditions

    @property
    def rows(self) -> Numbers:
        """The contact row of each site of friction."""
        return self.linear.system.friction.row

    @property
    def coefficient(self) -> Vector:
        """Coulomb's coefficient at sites that slip, (sites,); 0 elsewhere."""
        return np.where(self.slipping, np.asarray(self.linear.system.friction.coefficient), 0.0)

    def has_coulomb(self) -> bool:
        """Tell whether any rank has a site that slips with Coulomb's law. Collective."""
        return any_rank(self.torn.nodes.comm, self.coefficient > 0.0)

    @property
    def slipping(self) -> Mask:
        """Which sites slip."""
        return ~self.linear.sticking & (self.solution.slip_bound > 0.0)

    @property
    def direction(self) -> Vector:
        """Unit vectors along the friction forces of sites that slip, (sites, gdim - 1)."""
        force = self.solution.tangential_force
        size = np.linalg.norm(force, axis=1, keepdims=True)
        along = np.divide(force, size, out=np.zeros_like(force), where=size > 0.0)
        return np.where(self.slipping[:, None], along, 0.0)

    def size_of_mesh(self) -> float:
        """Return the longest edge of the box around the mesh [m]. Collective."""
        x, comm = self.torn.nodes.coordinates, self.torn.nodes.comm
        return max(
            largest_of_ranks(comm, column) + largest_of_ranks(comm, -column) for column in x.T
        )

    def used(self, contact: Contact | Tie, keep_pairs: bool = False) -> Contact | Tie:
        """Return a contact in the roles in which it is used, which stay; maybe with its partners.

        Pairs of nodes become mortar conditions where nodes of one side alone move, by default.
        """
        for found in self.conditions.contacts:
            if found.roles.given is contact and isinstance(found.contact, ContactPair):
                partners = found.contact.partners
                if keep_pairs and partners is None and not found.pairing.is_mortar:
                    partners = Nearest()
                return replace(found.contact, roles="given", partners=partners)
        return contact

    @property
    def matched_ties(self) -> dict[int, TiedPairing]:
        """The ties, by number, of nodes that match: one alone cannot move."""
        return {
            found.number: found.pairing
            for found in self.conditions.ties
            if isinstance(found.tie, PeriodicPair | BoltPreload)
        }

    def prescribed_changes(
        self, data: Mapping[Any, Any]
    ) -> tuple[Vector, list[tuple[Function | Constant, Any]]]:
        """Return changes (n,) of prescribed displacements, and the data that stand in forms."""
        space = self.forms.u.function_space
        size = space.dofmap.index_map.size_local * space.dofmap.index_map_bs
        prescribed, in_forms = np.zeros(size), []
        for m, dm in data.items():
            at, entries = prescribed_entries(
                space, self.torn.data.bcs, self.conditions.prescribed, m
            )
            values = np.ravel(dm.x.array if isinstance(dm, Function) else dm)
            values = np.broadcast_to(
                values, np.size(m.value if isinstance(m, Constant) else m.x.array)
            )
            own = at < size
            prescribed[at[own]] = values[entries[own]]
            stands = self.forms.depend_on(m)
            check_dependence(m, any_rank(space.mesh.comm, [at.size > 0]) or stands)
            if stands:
                in_forms.append((m, dm))
        return prescribed, in_forms

    def parts_of(self, name: str | int) -> list[tuple[FoundContact, Numbers]]:
        """Return the parts of a contact, by name or number, in order, with their rows."""
        found = self.conditions.contacts
        parts = [
            (contact, own)
            for contact, own in zip(found, self.conditions.positions, strict=True)
            if name in (contact.number, contact.pairing.name)
        ]
        if not parts:
            names = sorted({contact.pairing.name for contact in found})
            raise InputError(f"there is no contact {name!r}; there are {names}")
        return parts

    def rows_of(self, name: str | int) -> Numbers:
        """Return the rows of a contact."""
        return np.concatenate([own for _, own in self.parts_of(name)])

    def tie_of(self, name: str | int) -> tuple[FoundTie, Numbers] | None:
        """Return a tie, by name or number, with its rows among those of all ties; None for none."""
        sizes = [found.pairing.rows.size for found in self.conditions.ties]
        for found, own in zip(self.conditions.ties, consecutive(sizes), strict=True):
            if name in (found.number, found.pairing.name):
                return found, own
        return None

    def sides(self, name: str | int) -> Vector:
        """Return 1 for each row of a contact; -1 where slave and master were exchanged."""
        return np.concatenate(
            [
                np.full(own.size, 1.0 if contact.roles.used is contact.roles.given else -1.0)
                for contact, own in self.parts_of(name)
            ]
        )

    def sites_of(self, name: str | int) -> Numbers:
        """Return the sites of friction of a contact's rows."""
        if any(contact.friction is None for contact, _ in self.parts_of(name)):
            raise InputError(f"contact {name!r} has no friction")
        site = np.full(self.zeros().normal.size, -1)
        site[self.rows] = np.arange(self.rows.size)
        return site[self.rows_of(name)]

    def weights(
        self, name: str | int, given: Any, shape: tuple[int, ...], label: str
    ) -> tuple[Numbers, Vector]:
        """Return the rows of a contact, and values (k, ...) given for them or one for all."""
        own = self.rows_of(name)
        weights, whole = np.asarray(given, dtype=float), (own.size, *shape)
        if weights.shape not in (whole, shape):
            raise InputError(f"{label} has the shape {weights.shape}; {whole} or {shape} expected")
        return own, np.broadcast_to(weights, whole)

    def has_kinds_of(self, found: ContactSet) -> bool:
        """Tell whether this rank's conditions are of the kinds and numbers of others."""

        def kinds(conditions: ContactSet) -> list[tuple[bool, int]]:
            contacts = [(p.is_mortar, p.gap.size) for p in conditions.pairings]
            return contacts + [(t.pairing.is_mortar, t.pairing.rows.size) for t in conditions.ties]

        return kinds(found) == kinds(self.conditions)

    def zeros(self) -> RowValues:
        """Return zeros at all conditions."""
        return RowValues.zeros(self.linear.system)

    def kinks(self) -> dict[str, tuple[int, int]]:
        """Return numbers of nodes that touch without a force, and of sites at the edge of slip.

        By contact, without those that have none. Collective.
        """
        touching, at_edge = self.linear.kinks()
        at_row = np.zeros(touching.size, dtype=bool)
        at_row[self.rows] = at_edge
        found, names = self.conditions, self.conditions.names
        counts = np.zeros((len(names), 2), dtype=np.int64)
        for contact, own in zip(found.contacts, found.positions, strict=True):
            counts[contact.number] += [np.count_nonzero(x[own]) for x in (touching, at_row)]
        counts = self.torn.nodes.comm.allreduce(counts)
        return {
            name: (int(nodes), int(sites))
            for name, (nodes, sites) in zip(names, counts, strict=True)
            if nodes or sites
        }

    def torn_loads(self, values: Vector) -> list[Vector]:
        """Return nodal forces (n,) at one copy of each node, and on rigid bodies. Collective."""
        nodes, bodies = self.torn.nodes, self.conditions.bodies
        forces, loads = values.reshape(-1, nodes.components), []
        given = np.zeros(nodes.size, dtype=bool)
        given[nodes.owned :] = True
        for subdomain in self.torn.torn.subdomains:
            local = nodes.to_local(subdomain.nodes)
            load = np.zeros((local.size, nodes.components))
            new = ~given[local]
            load[new] = forces[local[new]]
            given[local] = True
            loads.append(load.ravel())
        of_bodies = self.torn.resultants(values, bodies)
        loaded, unloaded = (
            bodies.loaded(x).subdomains() for x in (of_bodies, np.zeros_like(of_bodies))
        )
        loads += [s.load - t.load for s, t in zip(loaded, unloaded, strict=True)]
        return loads + [np.zeros_like(s.load) for s in self.linear.system.subdomains[len(loads) :]]

    def jumps(self, values: Vector, bodies: RigidBodies | None = None) -> RowValues:
        """Return N u, T u and tied sums of nodal values (n,). Collective.

        Rigid bodies are where they are, by default at rest.
        """
        system, nodes = self.linear.system, self.torn.nodes
        moved = None if bodies is None else bodies.free_displacements(nodes.total)
        normal, tied = (
            row_values(nodes, rows, values, moved) / rows.length
            for rows in (system.contacts, system.tied)
        )
        tangential = np.zeros((self.rows.size, system.gdim - 1))
        if any_rank(nodes.comm, [self.rows.size > 0]):
            rows = system.friction.tangential_rows(system.contacts)
            tangential = (row_values(nodes, rows, values, moved) / rows.length).reshape(
                tangential.shape
            )
        return RowValues(normal, tangential, tied)

    def nodal_forces(self, system: TornSystem, forces: RowValues) -> Vector:
        """Return N'a + T'b and those of ties (n,) at nodes that this rank owns. Collective."""
        nodes = self.torn.nodes
        total = np.zeros((nodes.owned, nodes.components))
        for numbers, terms in self._terms(system, forces):
            in_mesh = numbers < nodes.total
            total += nodes.sum_at_owners(numbers[in_mesh], terms[in_mesh])
        return total.ravel()

    def body_forces(self, system: TornSystem, forces: RowValues) -> Vector:
        """Return N'a + T'b (b, gdim) at the nodes beyond those of the mesh. Collective."""
        nodes, bodies = self.torn.nodes, self.conditions.bodies
        total = np.zeros_like(bodies.free_displacements(nodes.total))
        for numbers, terms in self._terms(system, forces):
            beyond = (numbers >= nodes.total) & (numbers < nodes.total + len(total))
            np.add.at(total, numbers[beyond] - nodes.total, terms[beyond])
        return np.asarray(nodes.comm.allreduce(total))

    def _terms(self, system: TornSystem, forces: RowValues) -> list[tuple[Numbers, Vector]]:
        """Return nodes (t,) and their forces (t, gdim) by contact, tied and friction rows."""
        parts = [(system.contacts, forces.normal), (system.tied, forces.tied)]
        # sums of them are collective, also for ranks without sites
        if any_rank(self.torn.nodes.comm, [system.friction.size > 0]):
            tangential = system.friction.tangential_rows(system.contacts)
            parts.append((tangential, forces.tangential.ravel()))
        return [
            (rows.nodes, (values / rows.length)[rows.row][:, None] * rows.coefficients)
            for rows, values in parts
        ]

    def displacement(self, solution: LinearSolution, name: str) -> tuple[Function, list[Vector]]:
        """Return the displacement of a linear solution, and the motions of rigid bodies."""
        u = Function(self.forms.u.function_space, name=name)
        fill_displacement(u, self.torn.torn.subdomains, solution.displacements)
        bodies, none = self.conditions.bodies, [np.zeros_like(x) for x in solution.displacements]
        after, before = (self.conditions.motions_after(x) for x in (solution.displacements, none))
        motions = [x - y for x, y in zip(after, before, strict=True)]
        return self.torn.fill(u, bodies.moved(motions), is_small=True), motions


@dataclass(frozen=True)
class Functional:
    """J(u) of a form, and weighted sums of contact forces."""

    u: Vector  # (n,): dJ/du at the degrees of freedom that this rank owns
    normal: Vector  # (rows,): weights of normal forces
    force: Vector  # (rows, gdim): weights of forces against normal and tangents

    @staticmethod
    def of(
        state: SolvedState, forces: Mapping[str | int, Any], normal_forces: Mapping[str | int, Any]
    ) -> Functional:
        """Return that of the state's J and of weighted forces by contact. Collective."""
        gdim = state.torn.nodes.components
        normal = state.zeros().normal
        force = np.zeros((normal.size, gdim))
        with raise_collectively(state.torn.nodes.comm):
            for name, given in normal_forces.items():
                own, weights = state.weights(name, given, (), f"normal_forces[{name!r}]")
                normal[own] += weights
            for name, given in forces.items():
                own, weights = state.weights(name, given, (gdim,), f"forces[{name!r}]")
                # the rows' forces are against the normals and tangents of the slave that is used
                force[own] -= weights * state.sides(name)[:, None]
        return Functional(state.forms.derivative_of_J(), normal, force)

    def by_forces(self, normals: Vector, friction: Friction) -> RowValues:
        """Return dJ by normal forces and by friction forces along the tangents."""
        by_normal = self.normal + np.sum(normals * self.force, axis=1)
        by_friction = np.einsum("kta,ka->kt", friction.tangents, self.force[friction.row])
        return RowValues(by_normal, by_friction, np.zeros(0))


class _Derivatives:
    """Linear solves on the last face, and how many there were."""

    def __init__(self, state: SolvedState, rtol: float) -> None:
        self._state, self._rtol = state, rtol
        self.products, self.solves, self.residual = 0, 0, 0.0
        self.kinks = state.kinks()

    def _solve(self, data: LinearData) -> LinearSolution:
        solution = self._state.linear.solve(data, self._rtol)
        self.products += solution.products
        self.solves += 1
        self.residual = max(self.residual, solution.residual)
        return solution

    def _check_current(self) -> None:
        if not self._state.is_current():
            raise InputError(
                "the problem was solved again, or its data have changed, since these derivatives "
                "were made: take them anew after solve()"
            )

    def _solve_by_gmres(self, apply: Callable[[Vector], Vector], b: Vector) -> Vector:
        """Solve apply(y) = b for numbers at sites, of which each rank has a part. Collective."""
        space = Space(sum_over_ranks=self._state.torn.nodes.comm.allreduce)
        norm, (_, size) = space.norm(b), first_of_rank(self._state.torn.nodes.comm, b.size)
        vectors, y, left = gmres(
            lambda v: (v, apply(v)), b, space, tolerance=self._rtol * norm, max_it=size
        )
        self.residual = max(self.residual, left / norm if norm > 0.0 else 0.0)
        total: Vector = sum((c * v for c, v in zip(y, vectors, strict=True)), np.zeros_like(b))
        return total


class Adjoint(_Derivatives):
    """The adjoint of a functional; `ContactProblem.adjoint` makes it.

    Attributes
    ----------
    z : Function
        The adjoint displacement: the derivative of J by nodal forces.
    products, solves : int
        Applications of F, and linear solves.
    residual : float
        Energy norm of the residual, relative to that of no displacement.
    kinks : dict
        By name of the contact, how many nodes touch without a force, and how many sites are at the
        edge of slip. J has derivatives of one side only there, see `ContactProblem.tangent`.
    """

    def __init__(self, state: SolvedState, functional: Functional, rtol: float) -> None:
        super().__init__(state, rtol)
        self._functional = functional
        try:
            solution = self._solved()
        except UnresistedMotion as error:
            raise UnresistedMotion(
                "J changes by a motion that no closed contact and no support resists: its "
                f"derivatives are infinite. Of dJ/du as a load: {error}"
            ) from None
        self.z, self._motions = state.displacement(solution, "z")
        self._shortenings = state.conditions.shortenings(solution.displacements)
        self._solution = solution

    def _solved(self) -> LinearSolution:
        """Solve; with Coulomb's law the jumps at sites that slip follow the slips of z."""
        state = self._state
        loads, by_forces = state.torn_loads(self._functional.u), self._by_forces
        mu, direction, rows = state.coefficient, state.direction, state.rows
        along = np.sum(direction * by_forces.tangential, axis=1)
        normal = by_forces.normal.copy()
        np.add.at(normal, rows, mu * along)
        across = by_forces.tangential - along[:, None] * direction
        jumps = RowValues(normal, across, state.zeros().tied)
        solution = self._solve(LinearData(loads, jumps, state.zeros()))
        if not state.has_coulomb():
            return solution

        def with_normal(loads: list[Vector], jumps: RowValues, y: Vector) -> LinearSolution:
            normal = jumps.normal.copy()
            np.add.at(normal, rows, y)
            return self._solve(LinearData(loads, replace(jumps, normal=normal), state.zeros()))

        def friction(z: LinearSolution) -> Vector:
            return mu * np.sum(direction * z.jumps.tangential, axis=1)

        none = [np.zeros_like(load) for load in loads]
        y = self._solve_by_gmres(
            lambda y: y + friction(with_normal(none, state.zeros(), np.where(mu > 0.0, y, 0.0))),
            friction(solution),
        )
        return with_normal(loads, jumps, -y)

    @property
    def _by_forces(self) -> RowValues:
        system = self._state.linear.system
        return self._functional.by_forces(system.contacts.normal, system.friction)

    # -- derivatives -------------------------------------------------------------------------------

    def by(self, m: Function | Constant) -> Vector:
        """Return the derivative of J by a Function or Constant of forms, supports or J. Collective.

        Parameters
        ----------
        m : Function or Constant
            It stands in `a`, in `L`, in J, or is the value of a Dirichlet condition.

        Returns
        -------
        array
            Of a Function the derivatives by the values that this rank owns; of a Constant those by
            its values, in its shape, on all ranks.

        Raises
        ------
        InputError
            If nothing depends on m, or the problem has changed since.
        """
        self._check_current()
        state, space = self._state, self._state.forms.u.function_space
        check_parameter(m)
        bcs = state.torn.data.bcs
        dofs, entries = prescribed_entries(space, bcs, state.conditions.prescribed, m)
        is_support = any_rank(space.mesh.comm, [dofs.size > 0])
        check_dependence(m, is_support or state.forms.depend_on(m))
        reaction = self.by_supports() if is_support else np.zeros(0)
        values = np.zeros(m.value.size if isinstance(m, Constant) else m.x.array.size)
        own = dofs < reaction.size
        np.add.at(values, entries[own], reaction[dofs[own]])
        work, stands = state.forms.work(self.z), state.forms.depend_on(m)
        total: Vector
        if isinstance(m, Constant):
            total = space.mesh.comm.allreduce(values).reshape(m.ufl_shape)
            return total + by_constant(work, m, space.mesh) if stands else total
        total = _compat.summed_at_owners(values, m.function_space)
        return total + by_function(work, m) if stands else total

    def by_supports(self) -> Vector:
        """Return the derivatives (n,) of J by all prescribed displacements. Collective.

        They are at the degrees of freedom that this rank owns, and rounding at free ones.
        """
        state = self._state
        left = self._functional.u - state.forms.internal_forces(self.z)
        return left - state.nodal_forces(state.linear.system, self._solution.forces)

    def by_gap(self, name: str | int) -> Vector:
        """Return the derivatives of J by gaps at the nodes of ``results[name]``. Collective.

        Of a contact they are (k,), by the gap along the normal, positive where open, also with
        rigid bodies and obstacles. Of a tie they are (k, gdim), by what the displacement of the
        slave's nodes, of mortar conditions the mean, is more than that of the master: by the jump
        of a `PeriodicPair`.
        """
        self._check_current()
        forces = self._solution.forces
        if tie := self._state.tie_of(name):
            found, own = tie
            return -found.pairing.forces(forces.tied[own])
        return forces.normal[self._state.rows_of(name)]

    def by_preload(self, name: str | int) -> float:
        """Return the derivative of J by the force or the shortening of a bolt. Collective.

        It is by the one that `BoltPreload` was given [N] or [m].
        """
        self._check_current()
        tie, comm = self._state.tie_of(name), self._state.torn.nodes.comm
        preload = tie[0].pairing.preload if tie else None
        if preload is None:
            raise InputError(f"contact {name!r} is no bolt, a BoltPreload")
        if preload.body is None:
            return float(comm.allreduce(self.by_gap(name).sum(axis=0)) @ preload.axis)
        assert tie is not None
        return self._shortenings[tie[0].number]

    def by_slip_bound(self, name: str | int) -> Vector:
        """Return the derivatives (k,) of J by slip bounds at the nodes of ``results[name]``.

        Collective. The bound is that of `Tresca` [Pa]. At nodes that stick it is zero.
        """
        self._check_current()
        own = self._state.rows_of(name)
        areas = np.concatenate([np.zeros(0), *(p.area for p in self._state.conditions.pairings)])
        return self._by_bound(name) * areas[own]

    def by_coefficient(self, name: str | int) -> Vector:
        """Return the derivatives (k,) of J by Coulomb's coefficient there. Collective."""
        self._check_current()
        own = self._state.rows_of(name)
        return self._by_bound(name) * self._state.solution.normal_force[own]

    def _by_bound(self, name: str | int) -> Vector:
        """Return the derivatives by the friction forces of sites that slip, along themselves."""
        state = self._state
        sites = state.sites_of(name)
        change = self._by_forces.tangential - self._solution.jumps.tangential
        return np.sum(change * state.direction, axis=1)[sites]

    def by_load(self, body: str | int) -> Vector:
        """Return the derivatives (modes,) of J by force and moment on a rigid body. Collective.

        In 2D they are two of the force and one of the moment, in 3D three and three; zero for
        components whose motion is prescribed.
        """
        self._check_current()
        return self._motions[self._number_of(body)]

    def by_motion(self, body: str | int) -> Vector:
        """Return the derivatives (modes,) of J by the motion of a rigid body. Collective.

        They are by prescribed translations [m] and small rotations [rad] in the components of
        `by_load`, and rounding for components that are free.
        """
        self._check_current()
        state, number = self._state, self._number_of(body)
        bodies = state.conditions.bodies
        frame, first = bodies.frames[number], state.torn.nodes.total
        at_corners = state.body_forces(state.linear.system, self._solution.forces)
        work = frame.work(at_corners[frame.nodes - first])
        given = state.torn.resultants(self._functional.u, bodies)
        on_cells = given[number] if number < len(given) else 0.0
        return on_cells - frame.body.stiffness @ self._motions[number] - work

    def _number_of(self, body: str | int) -> int:
        names = self._state.conditions.bodies.names
        if body not in names and body not in range(len(names)):
            raise InputError(f"there is no rigid body {body!r}; there are {names}")
        return names.index(body) if body in names else int(body)

    def by_obstacle(
        self, name: str | int, change: Callable[[float], Contact] | None = None, step: float = 1e-5
    ) -> Any:
        """Return the derivative of J by the place, or the shape, of a rigid obstacle. Collective.

        Gaps and normals are differentiated by central differences.

        Parameters
        ----------
        name : str or int
            The contact.
        change : callable, optional
            s -> the contact, as a `RigidObstacle` that is at s = 0 the present one.
        step : float
            Of the differences, in units of s; without `change` relative to the size of the mesh.

        Returns
        -------
        float, or (gdim,) array without `change`
            The derivative by s at 0, or by translations of the obstacle [1/m].
        """
        self._check_current()
        contact = self._obstacle(name)
        if change is not None:
            ends = [self._with_contact(contact, change(s)) for s in (step, -step)]
            return self._difference(ends, step)
        gdim, size = self._state.torn.nodes.components, step * self._state.size_of_mesh()
        slopes = []
        for unit in np.identity(3)[:gdim]:
            shift = (size * unit, -size * unit)
            ends = [self._with_contact(contact, _translated(contact, e)) for e in shift]
            slopes.append(self._difference(ends, size))
        return np.array(slopes)

    def by_mesh(self, direction: Function | None = None, step: float = 3e-5) -> Any:
        """Return the derivative of J by the places of the nodes of the mesh. Collective.

        Functions in the forms and in J move with the nodes. Rows of contacts and ties are
        differentiated by central differences: along a direction by one, by all nodes by one for
        each component and group of nodes that no row depends on two of. By all nodes, pairs of
        nodes stay pairs, and the rows of bolts and periodic pairs stay as they are: the turn of a
        bolt's axis is in derivatives along directions that move both sides of the cut alike.

        Parameters
        ----------
        direction : Function, optional
            On vectors of Lagrange elements of the degree of the mesh's cells [m]: the derivative
            along a displacement of the nodes.
        step : float
            Of the differences: the largest change of an edge relative to it, of moves with less
            change than that the largest move relative to the size of the mesh.

        Returns
        -------
        float, or Function without a direction
            On the space of directions, with the derivatives by the coordinates of nodes [1/m].

        Raises
        ------
        InputError
            The conditions of a contact are others on the moved nodes, such as pairs of nodes that
            become mortar conditions along a direction: name them by `partners`.

        Warns
        -----
        UserWarning
            The derivatives by all nodes disagree with that along a direction, as at kinks: where
            nodes are on the borders of both surfaces.
        """
        self._check_current()
        domain = self._state.forms.u.function_space.mesh
        if direction is None:
            return self._by_all_nodes(domain, step)
        return self._along_moves(direction, node_changes(direction, domain), step)

    def _by_all_nodes(self, domain: Mesh, step: float) -> Function:
        state, space = self._state, places_space(domain)
        rows_at = self._rows_on_moved_nodes(one_by_one=True)
        of_rows = derivative_by_places(state.conditions, space, rows_at, step)
        of_forms = by_places(state.forms.work(self.z), domain)
        return fill_owned(Function(space, name="dJ/dx"), of_forms + of_rows.ravel())

    def _along_moves(self, direction: Function, moves: Vector, step: float) -> float:
        state, domain = self._state, direction.function_space.mesh
        move = largest_of_ranks(domain.comm, np.abs(moves)) / state.size_of_mesh()
        size = step / (max(move, largest_distortion(domain, moves)) or 1.0)
        rows_at = self._rows_on_moved_nodes()
        change, ends = Function(direction.function_space), []
        for s in (size, -size):
            change.x.array[:] = s * direction.x.array
            ends.append(rows_at(change))
        slope = (ends[0] - ends[1]).sum() / (2.0 * size)
        slope += by_places(state.forms.work(self.z), domain) @ owned_values(direction)
        return float(domain.comm.allreduce(slope))

    def _rows_on_moved_nodes(self, one_by_one: bool = False) -> Callable[[Function], Vector]:
        """Return `_of_rows` as a function of a displacement of the mesh's nodes.

        Where nodes move one by one, pairs of them stay pairs.
        """
        state, domain = self._state, self._state.forms.u.function_space.mesh
        x = domain.geometry.x.copy()
        contacts = [state.used(contact, one_by_one) for contact in state.torn.data.contacts]
        kept = state.matched_ties if one_by_one else None

        def rows_at(change: Function) -> Vector:
            try:
                domain.geometry.x[:] = x + node_changes(change, domain)
                return self._of_rows(state.torn.found_anew(contacts, kept))
            finally:
                domain.geometry.x[:] = x

        return rows_at

    def _obstacle(self, name: str | int) -> RigidObstacle:
        found, _ = self._state.parts_of(name)[0]
        contact = self._state.torn.data.contacts[found.number]
        if not isinstance(contact, RigidObstacle) or contact.body is not None:
            raise InputError(f"contact {name!r} is none with a rigid obstacle that is held")
        return contact

    def _with_contact(self, contact: Contact, other: Contact) -> ContactSet:
        """Return the conditions with another contact in place of one."""
        contacts = self._state.torn.data.contacts
        return self._state.torn.found_anew([other if c is contact else c for c in contacts])

    def _difference(self, ends: Sequence[ContactSet], size: float) -> float:
        """Return the derivative of what rows do, from those of two ends."""
        up, down = (self._of_rows(found).sum() for found in ends)
        comm = self._state.torn.nodes.comm
        return float(comm.allreduce(up - down)) / (2.0 * size)

    def _of_rows(self, found: ContactSet) -> Vector:
        """Return what J changes by with each row, its gap and bound: of contacts, then of ties.

        That is a'(g - N u) + b'(s - T u) - l'N z - t'T z, and what J has of the forces itself.
        """
        state, adjoint = self._state, self._solution.forces
        contacts, tied = found.rows(), found.tied_rows()
        friction = _along_old_tangents(
            found.friction_rows(state.origin), contacts.normal, state.linear.system.friction
        )
        if any_rank(state.torn.nodes.comm, [not state.has_kinds_of(found)]):
            raise InputError(
                "the conditions of contacts or ties are others after the change, so J jumps there: "
                "name the kind of conditions by partners, or take a smaller step"
            )
        other = replace(
            state,
            linear=replace(
                state.linear,
                system=replace(
                    state.linear.system, contacts=contacts, tied=tied, friction=friction
                ),
            ),
        )
        of_z = state.conditions.bodies.moved(self._motions)
        u = other.jumps(owned_values(state.forms.u), state.solved.bodies)
        z = other.jumps(owned_values(self.z), of_z)
        origin, on = np.asarray(friction.slip), state.linear.active
        gap = np.where(on, contacts.gap / contacts.length, 0.0)
        force = np.where(on, state.solution.normal_force, 0.0)
        bound = state.solution.slip_bound + friction.bound - state.linear.system.friction.bound
        turning = state.direction * bound[:, None]
        tangential = np.where(state.slipping[:, None], turning, state.solution.tangential_force)
        # also where a force turns: b follows the slip there
        rubs = (state.linear.sticking | state.slipping)[:, None]
        slip = np.where(rubs, origin - u.tangential, 0.0)
        by_forces = self._functional.by_forces(contacts.normal, friction)
        of_contacts = np.where(on, adjoint.normal * (gap - u.normal) - force * z.normal, 0.0)
        of_contacts += by_forces.normal * force
        of_sites = adjoint.tangential * slip + tangential * (by_forces.tangential - z.tangential)
        np.add.at(of_contacts, friction.row, of_sites.sum(axis=1))
        of_ties = adjoint.tied * (tied.gap / tied.length - u.tied)
        return np.concatenate([of_contacts, of_ties - state.solution.tied_force * z.tied])


def _along_old_tangents(new: Friction, normal: Vector, old: Friction) -> Friction:
    """Return friction with tangents as near to the old ones as the normals allow.

    In three dimensions the first tangent is along an axis, which may be another one.
    """
    if new.size != old.size or old.tangents.shape[1:] != (2, 3):
        return new
    n = normal[new.row]
    first = old.tangents[:, 0] - np.sum(old.tangents[:, 0] * n, axis=1, keepdims=True) * n
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    tangents = np.stack([first, np.cross(n, first)], axis=1)
    vectors = np.einsum("kba,kb->ka", new.tangents, np.asarray(new.slip))
    slip = np.einsum("kta,ka->kt", tangents, vectors)
    return replace(new, tangents=tangents, slip=slip)


def _translated(contact: RigidObstacle, shift: Vector) -> RigidObstacle:
    """Return an obstacle after a translation (3,)."""

    def moved(x: Vector) -> Any:
        return contact.obstacle(np.asarray(x) - shift[:, None])

    return replace(contact, obstacle=moved)


@dataclass(frozen=True)
class Change:
    """Changes of the data."""

    forces: Vector  # (n,): df - dK u at the degrees of freedom that this rank owns [N]
    prescribed: Vector  # (n,): changes of prescribed displacements, zero at free ones [m]
    gap: Vector  # (rows,) [m]
    bound: Vector  # (sites,): of slip bounds, at the normal forces that are there [N]

    @staticmethod
    def of(
        state: SolvedState,
        data: Mapping[Any, Any],
        gaps: Mapping[str | int, Any],
        slip_bounds: Mapping[str | int, Any],
        coefficients: Mapping[str | int, Any],
    ) -> Change:
        """Return what changes of Functions and Constants, and of contacts, make. Collective."""
        gap, bound = state.zeros().normal, np.zeros(state.rows.size)
        areas = np.concatenate([np.zeros(0), *(p.area for p in state.conditions.pairings)])
        force = state.solution.normal_force
        with raise_collectively(state.torn.nodes.comm):
            for m in data:
                check_parameter(m)
            for name, given in gaps.items():
                own, values = state.weights(name, given, (), f"gaps[{name!r}]")
                gap[own] += values
            for label, named, factor in (
                ("slip_bounds", slip_bounds, areas),
                ("coefficients", coefficients, force),
            ):
                for name, given in named.items():
                    own, values = state.weights(name, given, (), f"{label}[{name!r}]")
                    bound[state.sites_of(name)] += values * factor[own]
        prescribed, in_forms = state.prescribed_changes(data)
        return Change(state.forms.change(in_forms), prescribed, gap, bound)


class Tangent(_Derivatives):
    """Change of the solution along a change of the data; `ContactProblem.tangent` makes it.

    Attributes
    ----------
    u : Function
        Change of the displacement [m].
    products, solves, residual, kinks
        As of `Adjoint`.
    """

    def __init__(self, state: SolvedState, change: Change, one_sided: bool, rtol: float) -> None:
        super().__init__(state, rtol)
        data = self._data(change)
        solution = self._with_friction(data, change.bound)
        if one_sided:
            solution = self._one_sided(data, solution, change)
        self._forces = solution.forces
        self.u, _ = state.displacement(solution, "du")
        fill_owned(self.u, owned_values(self.u) + change.prescribed)

    def normal_force(self, name: str | int) -> Vector:
        """Return the changes (k,) of the normal forces at the nodes of ``results[name]`` [N]."""
        return self._forces.normal[self._state.rows_of(name)]

    def friction_force(self, name: str | int) -> Vector:
        """Return the changes (k, gdim) of the friction forces on the slave there [N]."""
        state = self._state
        sites = state.sites_of(name)
        tangents = state.linear.system.friction.tangents[sites]
        along = np.einsum("kt,kta->ka", self._forces.tangential[sites], tangents)
        return -along * state.sides(name)[:, None]

    def _data(self, change: Change) -> LinearData:
        """Return loads and jumps, with prescribed displacements as data. Collective."""
        state, forces = self._state, change.forces
        jumps = replace(state.zeros(), normal=change.gap)
        if any_rank(state.torn.nodes.comm, change.prescribed != 0.0):
            lifted = fill_owned(Function(state.forms.u.function_space), change.prescribed)
            forces = forces - state.forms.internal_forces(lifted)
            of_lift = state.jumps(change.prescribed)
            jumps = RowValues(change.gap - of_lift.normal, -of_lift.tangential, -of_lift.tied)
        return LinearData(state.torn_loads(forces), jumps, state.zeros())

    def _with_friction(self, data: LinearData, bound: Vector) -> LinearSolution:
        """Solve with changes of bounds; those of Coulomb's law follow the normal forces."""
        state = self._state
        mu, direction, rows = state.coefficient, state.direction, state.rows

        def with_bounds(data: LinearData, change: Vector) -> LinearSolution:
            forces = replace(data.forces, tangential=direction * change[:, None])
            return self._solve(replace(data, forces=forces))

        solution = with_bounds(data, bound)
        if not state.has_coulomb():
            return solution
        none = LinearData([np.zeros_like(x) for x in data.loads], state.zeros(), state.zeros())

        def pressing(solution: LinearSolution) -> Vector:
            return np.where(mu > 0.0, solution.forces.normal[rows], 0.0)

        y = self._solve_by_gmres(
            lambda y: y - pressing(with_bounds(none, mu * y)), pressing(solution)
        )
        return with_bounds(data, bound + mu * y)

    def _one_sided(
        self, data: LinearData, solution: LinearSolution, change: Change
    ) -> LinearSolution:
        """Return the derivative of one side: rows that touch without a force press, or open.

        Their forces solve 0 <= x, S x >= q, x'(S x - q) = 0, with S the compliance of these rows,
        and q how far the solution with all of them open closes them.
        """
        state, comm = self._state, self._state.torn.nodes.comm
        touching = np.flatnonzero(state.linear.kinks()[0])
        first, total = first_of_rank(comm, touching.size)
        if not total:
            return solution
        if state.has_coulomb():
            raise InputError(
                "one_sided with sites that slip by Coulomb's law: the forces of nodes that touch "
                "are no minimum then. Leave one_sided out, or change the data a little"
            )
        none = LinearData([np.zeros_like(x) for x in data.loads], state.zeros(), state.zeros())

        def with_forces(data: LinearData, x: Vector, bound: Vector) -> LinearSolution:
            forces = state.zeros()
            forces.normal[touching] = x[first : first + touching.size]
            return self._with_friction(replace(data, forces=forces), bound)

        def closing(solution: LinearSolution, gap: Vector) -> Vector:
            return concatenate_ranks(comm, (solution.jumps.normal - gap)[touching])

        no_gap, no_bound = np.zeros_like(change.gap), np.zeros_like(change.bound)
        S = -np.column_stack(
            [closing(with_forces(none, unit, no_bound), no_gap) for unit in np.identity(total)]
        )
        q = closing(solution, data.jumps.normal)
        # with S = U'U the solution has the least |U x - U'^+ q|; rows may depend on each other
        values, vectors = np.linalg.eigh(0.5 * (S + S.T))
        kept = values > ZERO * values.max()
        roots, V = np.sqrt(values[kept]), vectors[:, kept]
        x = nnls(roots[:, None] * V.T, V.T @ q / roots)[0]
        return with_forces(data, x, change.bound)

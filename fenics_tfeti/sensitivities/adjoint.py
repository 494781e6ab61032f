"""The adjoint of a functional, and its derivatives by all data."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp

import ufl
from dolfinx.fem import Constant, Function
from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError, UnresistedMotion
from fenics_tfeti.fem.contact.contact_set import (
    ContactSet,
)
from fenics_tfeti.fem.contact.descriptions.contacts import (
    Contact,
    RigidObstacle,
)
from fenics_tfeti.fem.displacement import fill_owned, owned_values
from fenics_tfeti.feti.solution.linear import LinearData, LinearSolution
from fenics_tfeti.feti.system import ContactRows, Friction, RowValues
from fenics_tfeti.parallel import (
    largest_of_ranks,
    raise_collectively,
)
from fenics_tfeti.sensitivities.forms import (
    FormsAtSolution,
    by_places,
    node_changes,
    places_space,
)
from fenics_tfeti.sensitivities.linear_solves import LinearSolves
from fenics_tfeti.sensitivities.row_supports import (
    derivative_by_places,
    largest_distortion,
)
from fenics_tfeti.sensitivities.state import (
    DifferentiatedState,
    SolvedState,
    sides_of_contact,
    weights_of_contact,
)
from fenics_tfeti.sensitivities.supports import derivative_by
from fenics_tfeti.typing import Mask, Vector


@dataclass(frozen=True)
class Functional:
    """J(u) of a form, and weighted sums of contact forces."""

    u: Vector  # (n,): dJ/du at the degrees of freedom that this rank owns
    normal: Vector  # (rows,): weights of normal forces
    force: Vector  # (rows, gdim): weights of forces against normal and tangents

    @staticmethod
    def of(
        forms: FormsAtSolution,
        contact_set: ContactSet,
        forces: Mapping[str | int, Any],
        normal_forces: Mapping[str | int, Any],
    ) -> Functional:
        """Return that of the J of forms and of weighted forces by contact. Collective."""
        nodes, rows = contact_set.boundary.nodes, sum(map(len, contact_set.positions))
        normal, force = np.zeros(rows), np.zeros((rows, nodes.components))
        with raise_collectively(nodes.comm):
            for name, given in normal_forces.items():
                label = f"normal_forces[{name!r}]"
                own, weights = weights_of_contact(contact_set, name, given, (), label)
                normal[own] += weights
            for name, given in forces.items():
                label, shape = f"forces[{name!r}]", (nodes.components,)
                own, weights = weights_of_contact(contact_set, name, given, shape, label)
                # the rows' forces are against the normals and tangents of the slave that is used
                force[own] -= weights * sides_of_contact(contact_set, name)[:, None]
        return Functional(forms.derivative_of_J(), normal, force)

    def by_forces(self, normals: Vector, friction: Friction) -> RowValues:
        """Return dJ by normal forces and by friction forces along the tangents."""
        by_normal = self.normal + np.sum(normals * self.force, axis=1)
        by_friction = np.einsum("kta,ka->kt", friction.tangents, self.force[friction.row])
        return RowValues(by_normal, by_friction, np.zeros(0))


def form_and_forces(
    J: ufl.Form | Function | Mapping[str | int, Any] | None,
    forces: Mapping[str | int, Any] | None,
) -> tuple[ufl.Form | Function | None, dict[str | int, Any]]:
    """Return a form or its derivative, and forces by contact, of a J that may be any of them."""
    given = dict(forces or {})
    if isinstance(J, Mapping):
        return None, given | dict(J)
    return J, given


class Derivatives(ABC):
    """The derivatives of a functional by data, of a solution and its adjoint z.

    Attributes
    ----------
    z : Function
        The adjoint displacement: the derivative of J by nodal forces.
    """

    z: Function
    _state: DifferentiatedState
    _forces: RowValues  # adjoint forces of the rows of contacts, sites and ties

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
        self._state.check_current()
        state = self._state
        supports = state.torn.bcs, state.contact_set.prescribed
        return derivative_by(m, state.forms, self.z, supports, self._reactions)

    def by_supports(self) -> Vector:
        """Return the derivatives (n,) of J by all prescribed displacements. Collective.

        They are at the degrees of freedom that this rank owns, and rounding at free ones.
        """
        self._state.check_current()
        return self._reactions()

    @abstractmethod
    def _reactions(self) -> Vector:
        """Return the derivatives (n,) by prescribed displacements, at this rank's unknowns."""

    @abstractmethod
    def _by_bounds(self) -> Vector:
        """Return the derivatives (sites,) by friction forces of sites that slip, along them."""

    @abstractmethod
    def _of_rows(self, found: ContactSet) -> Vector:
        """Return what J changes by with each row of other conditions, of contacts, then of ties.

        Collective.
        """

    def by_gap(self, name: str | int) -> Vector:
        """Return the derivatives of J by gaps at the nodes of ``results[name]``. Collective.

        Of a contact they are (k,), by the gap along the normal, positive where open, also with
        rigid bodies and obstacles. Of a tie they are (k, gdim), by what the displacement of the
        slave's nodes, of mortar conditions the mean, is more than that of the master: by the jump
        of a `PeriodicPair`.
        """
        self._state.check_current()
        forces = self._forces
        if tie := self._state.tie_of(name):
            found, own = tie
            return -found.conditions.forces(forces.tied[own])
        return forces.normal[self._state.rows_of(name)]

    def by_slip_bound(self, name: str | int) -> Vector:
        """Return the derivatives (k,) of J by slip bounds at the nodes of ``results[name]``.

        Collective. The bound is that of `Tresca` [Pa]. At nodes that stick it is zero.
        """
        self._state.check_current()
        own = self._state.rows_of(name)
        return self._by_bound(name) * self._state.areas[own]

    def by_coefficient(self, name: str | int) -> Vector:
        """Return the derivatives (k,) of J by Coulomb's coefficient there. Collective."""
        self._state.check_current()
        own = self._state.rows_of(name)
        return self._by_bound(name) * self._state.normal_force[own]

    def _by_bound(self, name: str | int) -> Vector:
        """Return the derivatives by the friction forces of sites that slip, along themselves."""
        return self._by_bounds()[self._state.sites_of(name)]

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
        self._state.check_current()
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
        self._state.check_current()
        domain = self._state.forms.u.function_space.mesh
        if direction is None:
            return self._by_all_nodes(domain, step)
        return self._along_moves(direction, node_changes(direction, domain), step)

    def _by_all_nodes(self, domain: Mesh, step: float) -> Function:
        state, space = self._state, places_space(domain)
        rows_at = self._rows_on_moved_nodes(one_by_one=True)
        of_rows = derivative_by_places(
            state.contact_set, space, lambda change: sp.csr_matrix(rows_at(change)[:, None]), step
        )
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
        contacts = [state.used(contact, one_by_one) for contact in state.torn.contacts]
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
        contact = self._state.torn.contacts[found.number]
        if not isinstance(contact, RigidObstacle) or contact.rigid_body is not None:
            raise InputError(f"contact {name!r} is none with a rigid obstacle that is held")
        return contact

    def _with_contact(self, contact: Contact, other: Contact) -> ContactSet:
        """Return the conditions with another contact in place of one."""
        contacts = self._state.torn.contacts
        return self._state.torn.found_anew([other if c is contact else c for c in contacts])

    def _difference(self, ends: Sequence[ContactSet], size: float) -> float:
        """Return the derivative of what rows do, from those of two ends."""
        up, down = (self._of_rows(found).sum() for found in ends)
        comm = self._state.torn.nodes.comm
        return float(comm.allreduce(up - down)) / (2.0 * size)


class Adjoint(Derivatives):
    """The adjoint of a functional; `ContactProblem.adjoint` makes it.

    Attributes
    ----------
    z : Function
        As of `Derivatives`.
    linear_solves : LinearSolves
        Numbers of products with F and of linear solves, and their residual.
    kinks : dict
        By name of the contact, how many nodes touch without a force, and how many sites are at the
        edge of slip. J has derivatives of one side only there, see `ContactProblem.tangent`.
    """

    _state: SolvedState

    def __init__(self, state: SolvedState, functional: Functional, rtol: float) -> None:
        self._state, self.kinks = state, state.kinks()
        self.linear_solves = LinearSolves(state, rtol)
        self._functional = functional
        try:
            solution = self._solved()
        except UnresistedMotion as error:
            raise UnresistedMotion(
                "J changes by a motion that no closed contact and no support resists: its "
                f"derivatives are infinite. Of dJ/du as a load: {error}"
            ) from None
        self.z, self._motions = state.displacement(solution, "z")
        self._shortenings = state.contact_set.shortenings(solution.displacements)
        self._solution, self._forces = solution, solution.forces

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
        solution = self.linear_solves.solve(LinearData(loads, jumps, state.zeros()))
        if not state.has_coulomb():
            return solution

        def with_normal(loads: list[Vector], jumps: RowValues, y: Vector) -> LinearSolution:
            normal = jumps.normal.copy()
            np.add.at(normal, rows, y)
            return self.linear_solves.solve(
                LinearData(loads, replace(jumps, normal=normal), state.zeros())
            )

        def friction(z: LinearSolution) -> Vector:
            return mu * np.sum(direction * z.jumps.tangential, axis=1)

        none = [np.zeros_like(load) for load in loads]
        y = self.linear_solves.by_gmres(
            lambda y: y + friction(with_normal(none, state.zeros(), np.where(mu > 0.0, y, 0.0))),
            friction(solution),
        )
        return with_normal(loads, jumps, -y)

    @property
    def _by_forces(self) -> RowValues:
        system = self._state.linear.system
        return self._functional.by_forces(system.contacts.normal, system.friction)

    def _reactions(self) -> Vector:
        state = self._state
        left = self._functional.u - state.forms.internal_forces(self.z)
        return left - state.nodal_forces(state.linear.system, self._solution.forces)

    def by_preload(self, name: str | int) -> float:
        """Return the derivative of J by the force or the shortening of a bolt. Collective.

        It is by the one that `BoltPreload` was given [N] or [m].
        """
        self._state.check_current()
        tie, comm = self._state.tie_of(name), self._state.torn.nodes.comm
        preload = tie[0].conditions.preload if tie else None
        if preload is None:
            raise InputError(f"contact {name!r} is no bolt, a BoltPreload")
        if preload.body is None:
            return float(comm.allreduce(self.by_gap(name).sum(axis=0)) @ preload.axis)
        assert tie is not None
        return self._shortenings[tie[0].number]

    def _by_bounds(self) -> Vector:
        change = self._by_forces.tangential - self._solution.jumps.tangential
        return np.asarray(np.sum(change * self._state.direction, axis=1))

    def by_law(self, name: str | int) -> Vector:
        """Return the derivatives (k,) of J by the law of an interface. Collective.

        They are by the stiffness [Pa/m] of `SoftContact` or `ElasticBond`, or by the traction [Pa]
        of `Adhesive`, at the nodes of ``results[name]``.
        """
        self._state.check_current()
        state, own = self._state, self._state.rows_of(name)
        laws = [found.law for found, _ in state.parts_of(name)]
        if any(law is None or law.touching is not None for law in laws):
            raise InputError(f"contact {name!r} has no law with a number at each node")
        contacts, on = state.linear.system.contacts, state.linear.active
        areas, force = state.areas, state.normal_force
        # with the stiffness k the compliance is C = 1 / (k area)
        C = compliance_at(contacts, force, on)
        by_stiffness = -self._forces.normal * force * C**2 * areas
        apart = ~on & (np.asarray(contacts.adhesion) > 0.0)
        by_traction = (self._solution.jumps.normal - self._by_forces.normal) * areas
        return (by_stiffness + np.where(apart, by_traction, 0.0))[own]

    def by_elastic_slip(self, name: str | int) -> Vector:
        """Return the derivatives (k,) of J by the `elastic_slip` of friction there [m/Pa].

        Collective.
        """
        self._state.check_current()
        state, sites = self._state, self._state.sites_of(name)
        work = np.sum(self._forces.tangential * state.solution.tangential_force, axis=1)
        return work[sites] / state.areas[state.rows_of(name)]

    def by_load(self, body: str | int) -> Vector:
        """Return the derivatives (modes,) of J by force and moment on a rigid body. Collective.

        In 2D they are two of the force and one of the moment, in 3D three and three; zero for
        components whose motion is prescribed.
        """
        self._state.check_current()
        return self._motions[self._number_of(body)]

    def by_motion(self, body: str | int) -> Vector:
        """Return the derivatives (modes,) of J by the motion of a rigid body. Collective.

        They are by prescribed translations [m] and small rotations [rad] in the components of
        `by_load`, and rounding for components that are free.
        """
        self._state.check_current()
        state, number = self._state, self._number_of(body)
        bodies = state.contact_set.bodies
        frame, first = bodies.frames[number], state.torn.nodes.total
        at_corners = state.body_forces(state.linear.system, self._solution.forces)
        work = frame.work(at_corners[frame.nodes - first])
        given = state.torn.resultants(self._functional.u, bodies)
        on_cells = given[number] if number < len(given) else 0.0
        return on_cells - frame.body.stiffness @ self._motions[number] - work

    def _number_of(self, body: str | int) -> int:
        names = self._state.contact_set.bodies.names
        if body not in names and body not in range(len(names)):
            raise InputError(f"there is no rigid body {body!r}; there are {names}")
        return names.index(body) if body in names else int(body)

    def _of_rows(self, found: ContactSet) -> Vector:
        # a'(g - N u) + b'(s - T u) - l'N z - t'T z, and what J has of the forces itself
        state, adjoint = self._state, self._solution.forces
        state.check_kinds(found)
        contacts, tied = found.rows(), found.tied_rows()
        friction = _along_old_tangents(
            found.friction_rows(state.origin), contacts.normal, state.linear.system.friction
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
        of_z = state.contact_set.bodies.moved(self._motions)
        u = other.jumps(owned_values(state.forms.u), state.solved.bodies)
        z = other.jumps(owned_values(self.z), of_z)
        origin, on = np.asarray(friction.slip), state.linear.active
        # surfaces that are apart may adhere
        force = np.where(on, state.normal_force, -np.asarray(contacts.adhesion))
        gap = np.where(on, contacts.gap / contacts.length, 0.0)
        gap += compliance_at(contacts, state.normal_force, on) * force
        bound = state.solution.slip_bound + friction.bound - state.linear.system.friction.bound
        turning = state.direction * bound[:, None]
        tangential = np.where(state.slipping[:, None], turning, state.solution.tangential_force)
        # also where a force turns: b follows the slip there
        rubs = (state.linear.sticking | state.slipping)[:, None]
        elastic = np.asarray(friction.compliance)[:, None] * tangential
        slip = np.where(rubs, origin + elastic - u.tangential, 0.0)
        by_forces = self._functional.by_forces(contacts.normal, friction)
        of_contacts = np.where(on, adjoint.normal * (gap - u.normal), 0.0)
        of_contacts += (by_forces.normal - z.normal) * force
        of_sites = adjoint.tangential * slip + tangential * (by_forces.tangential - z.tangential)
        np.add.at(of_contacts, friction.row, of_sites.sum(axis=1))
        of_ties = adjoint.tied * (tied.gap / tied.length - u.tied)
        return np.concatenate([of_contacts, of_ties - state.solution.tied_force * z.tied])


def compliance_at(contacts: ContactRows, force: Vector, on: Mask) -> Vector:
    """Return the compliances (rows,) of rows on the face at their forces; zero for rigid ones."""
    pressed, pulled = np.asarray(contacts.compliance).T
    compliance = np.where(force > 0.0, pressed, pulled)
    return np.where(on & np.isfinite(compliance), compliance, 0.0)


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

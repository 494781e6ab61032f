"""Forces, gaps and slips of a solution at contacts: at the slave nodes, and summed up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

from mpi4py import MPI

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.summary import joined_summary
from fenics_tfeti.fem.contact.rigid.frames import BodyFrame
from fenics_tfeti.feti.report.resultants import ContactForces
from fenics_tfeti.parallel import concatenate_ranks, first_of_rank, meet
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class ContactEntry(ContactForces):
    """A contact or tied pair in the report; slave and master are those that the user gave.

    Attributes
    ----------
    matching : dict
        The ``discretisation`` ("node_to_node", "mortar", "obstacle", "tied",
        "periodic", "bolt" or "rows"), the numbers of
        ``pairs`` (conditions) and ``unmatched`` slave nodes, ``largest_distance`` [m] (what the
        tolerance limits; None but for pairs of nodes) and ``largest_relative_distance`` (to the
        size of the facets), ``largest_angle`` between the slave's normal and the opposite of the
        master's [degrees], ``smallest_gap``, ``largest_gap`` and ``mean_gap`` [m], of mortar
        conditions those of their means, and the ``covered_area`` of the slave [m^2; m in 2D] (None
        for obstacles), undeformed and without `measure_weight`. Nodes at which an obstacle's gap is
        infinite are unmatched. Of mortar conditions whose gaps are those of the mesh also
        ``deviation``, the largest distance of the facets of both surfaces from curved surfaces
        through their nodes [m], and ``blurred``, the share of the area with gaps smaller than it
        (None for others). Mortar conditions have the tags of ``slave`` and ``master`` as well.
    roles_ratio : float or None
        Of mortar conditions E / h of the slave over that of the master, which is better below 20.
    roles : str or None
        Whether slave and master were exchanged, and why, or why not; None where the given ones are
        good.
    penetration : float or None
        Of mortar conditions the largest depth in the other body, after the solve, of slave nodes
        without a condition and of nodes at the border of the master's surface [m]; None of soft
        contact.
    tension, shortening : float or None
        Of a bolt: force in the shank along its axis [N], and by how much it is shortened [m].
    largest_pressure : float or None
        The largest contact pressure at a node [Pa]; None of tied pairs.
    pressing : int
        How many nodes press.
    """

    matching: dict[str, Any]
    roles_ratio: float | None = None
    roles: str | None = None
    penetration: float | None = None
    tension: float | None = None
    shortening: float | None = None
    largest_pressure: float | None = None
    pressing: int = 0

    def seen_from_master(self) -> ContactEntry:
        """Return the entry with the forces on slave and master exchanged."""
        return replace(
            self,
            force=self.force_on_master,
            moment=self.moment_on_master,
            force_on_master=self.force,
            moment_on_master=self.moment,
        )


class _SurfaceResult:
    """The solution at nodes of a surface, and its sums there; see `ContactEntry`."""

    entry: ContactEntry
    nodes: Numbers
    dofs: Numbers
    comm: MPI.Intracomm

    @property
    def force(self) -> Vector:
        """Sum of the forces on the slave, (gdim,) [N]."""
        return np.array(self.entry.force)

    @property
    def moment(self) -> Vector:
        """Moment of the forces on the slave about the origin, (3,) [N m], in 2D (1,) [N]."""
        return np.array(self.entry.moment)

    @property
    def friction_work(self) -> float:
        """Work that friction dissipates [J]."""
        return self.entry.friction_work

    def gather(self) -> Self:
        """Return the nodes of all ranks, by node number, on every rank. Collective.

        The `dofs` of nodes of other ranks are -1.
        """
        meet(self.comm, "gather()")
        order = np.argsort(concatenate_ranks(self.comm, self.nodes))
        first, total = first_of_rank(self.comm, self.dofs.size)
        dofs: Numbers = np.full(total, -1)
        dofs[first : first + self.dofs.size] = self.dofs
        return replace(_gathered(self, self.comm, order), dofs=dofs[order], comm=MPI.COMM_SELF)


@dataclass(frozen=True)
class FrictionResult:
    """Friction at the nodes of a `ContactResult`.

    Attributes
    ----------
    force : (k, gdim) array
        Friction force on the slave, in the units of the normal force [N].
    traction : (k, gdim) array
        The force over the area that belongs to the node, see `ContactResult`, a mean where the
        pressure is one [Pa].
    bound : (k,) array
        Slip bound: the force at which the node slips [N].
    slip : (k, gdim) array
        Tangential displacement of the slave relative to the master or obstacle since the last
        step, in the direction opposite to the force [m]; zero where it sticks. With elastic slip
        that of the force is a part of it, also where it sticks.
    sticking : (k,) bool array
        Whether the force is below its bound.
    work : (k,) array
        Work that friction dissipates since the last step: force times slip beyond the elastic one
        [J].

    Examples
    --------
    >>> friction = problem.results["joint"].friction  # doctest: +SKIP
    >>> friction.sticking.sum(), friction.slip  # doctest: +SKIP
    """

    force: Vector
    traction: Vector
    bound: Vector
    slip: Vector
    sticking: Mask
    work: Vector

    @property
    def state(self) -> Numbers:
        """1 where a node sticks, 2 where it slips, 0 where friction has no force, (k,)."""
        slipping = ~self.sticking & (self.bound > 0.0) & self.force.any(axis=1)
        return self.sticking + 2 * slipping.astype(np.int64)


@dataclass(frozen=True)
class ContactResult(_SurfaceResult):
    """The solution at the slave nodes that this rank owns, and its sums over the surface.

    Attributes
    ----------
    name : str
        Name of the contact.
    entry : ContactEntry
        The contact's sums and matching in the report; `force` and `moment` on the slave and
        `friction_work` are properties too.
    nodes, dofs : (k,) integer array
        Global nodes of the displacement's space, and their numbers on this rank: the blocks of
        degrees of freedom. After `gather` those of other ranks are -1.
    coordinates : (k, 3) array
        [m].
    gap : (k,) array
        Gap in the undeformed state [m]; infinite where there is no obstacle. With mortar conditions
        the mean around the node.
    opening : (k,) array
        Gap after the solve [m]: zero where the contact is closed, negative where it is soft and
        pressed, infinite where there is no obstacle. It is the gap less the approach along the
        normal, with exact non-penetration of the surfaces of the last pass.
    normal : (k, gdim) array
        Outward unit normals of the slave.
    nodal_normal_force : (k,) array
        [N]; [N/m] in plane problems; in axisymmetric ones [N] if the forms have the factor
        2 pi r, [N/rad] if they have r. With mortar conditions beside a node of both surfaces, as
        the tip of a crack, what acts on this node from both sides is part of it.
    pressure : (k,) array
        Normal force over the area that belongs to the node, negative where adhesion pulls [Pa].
        With mortar conditions, nodes that are covered by less than 0.4 are taken together with
        their neighbours that are covered better, and have the mean of these' pressures: the force
        at the rim of a contact is over next to no area.
    nominal_pressure : (k,) array
        Normal force over undeformed area: the pressure times the ratio of the present to the
        undeformed area of the surface around the node [Pa].
    active : (k,) bool array
        Whether the normal force is positive; of surfaces that adhere whether they are closed.
    area : (k,) array
        The area that belongs to the node, with the problem's `measure_weight` [m^2; m in 2D]: with
        `NonlinearContactProblem` and ``gaps=Deformed()`` that of the deformed surface, with the
        weight at deformed places, otherwise that of the undeformed one. It is the node's share of
        the facets around it; in a partial contact of pairs of nodes, of those whose nodes all have
        partners or are on both surfaces. With mortar conditions it is that of the covered part of
        the surface around the node: the areas add up to what is covered, and the sum of
        ``pressure * area`` is the contact force.
    coverage : (k,) array
        The share of the slave's area around the node that the master covers, up to 1: less at the
        rim of the contact. With mortar conditions, nodes around which next to nothing is covered
        have no condition of their own, and are not among the nodes: what is covered belongs to
        their neighbours that are covered better.
    friction : FrictionResult or None
        Friction forces and slips; None for a contact without friction.
    damage : (k,) array or None
        Of bonds that can break: from 0 to 1, where nothing is left, and where nothing was bonded;
        None of other contacts.
    on_master : bool
        Whether the nodes are those of the master, because ``roles="auto"`` has exchanged slave and
        master. Normals, forces and slips are those of the slave there.
    comm : MPI.Intracomm
        The ranks.

    Examples
    --------
    >>> joint = problem.results["joint"]  # doctest: +SKIP
    >>> joint.pressure.max(), joint.active.sum(), joint.force  # doctest: +SKIP
    >>> whole = joint.gather()  # the nodes of all ranks, on all ranks  # doctest: +SKIP
    """

    name: str
    entry: ContactEntry
    nodes: Numbers
    dofs: Numbers
    coordinates: Vector
    gap: Vector
    opening: Vector
    normal: Vector
    nodal_normal_force: Vector
    pressure: Vector
    nominal_pressure: Vector
    active: Mask
    area: Vector
    coverage: Vector
    friction: FrictionResult | None = None
    damage: Vector | None = None
    on_master: bool = False
    comm: MPI.Intracomm = field(default_factory=lambda: MPI.COMM_SELF, repr=False)

    @staticmethod
    def joined(parts: Sequence[ContactResult]) -> ContactResult:
        """Return the result of a contact from those of its parts, each with all sums."""
        first = parts[0]
        if len(parts) == 1:
            return first
        friction = None
        if first.friction is not None:
            friction = _concatenated([part.friction for part in parts])
        summary = joined_summary([part.entry.matching for part in parts])
        depths = [part.entry.penetration for part in parts if part.entry.penetration is not None]
        entry = replace(first.entry, matching=summary, penetration=max(depths, default=None))
        return replace(_concatenated(parts), entry=entry, friction=friction)

    def seen_from_master(self) -> ContactResult:
        """Return the result with all directions as on the other surface."""
        friction = self.friction
        if friction is not None:
            friction = replace(
                friction, force=-friction.force, traction=-friction.traction, slip=-friction.slip
            )
        return replace(
            self,
            entry=self.entry.seen_from_master(),
            normal=-self.normal,
            friction=friction,
            on_master=not self.on_master,
        )


@dataclass(frozen=True)
class TiedResult(_SurfaceResult):
    """The solution of a tie at the slave nodes that this rank owns.

    A tie is a TiedPair, PeriodicPair, BoltPreload or LinearRows.

    Attributes
    ----------
    name : str
        Name of the pair.
    entry : ContactEntry
        The pair's sums and matching in the report; `force` and `moment` on the slave are properties
        too.
    nodes, dofs : (k,) integer array
        Global nodes of the displacement's space, and their numbers on this rank.
    coordinates : (k, 3) array
        [m].
    nodal_force : (k, gdim) array
        Force of the master on the slave [N]; zero for components that are prescribed. Not unique
        where the conditions of several ties or contacts depend on each other.
    traction : (k, gdim) array
        The force over the area that belongs to the node [Pa]; at the rim of mortar conditions a
        mean, as the pressure of contacts.
    area : (k,) array
        The undeformed area around the node that the master covers [m^2; m in 2D]. NaN for
        LinearRows, and of surfaces of degree 2 that match at nodes that are no vertices.
    comm : MPI.Intracomm
        The ranks.

    Examples
    --------
    >>> problem.results["glue"].traction  # doctest: +SKIP
    """

    name: str
    entry: ContactEntry
    nodes: Numbers
    dofs: Numbers
    coordinates: Vector
    nodal_force: Vector
    traction: Vector
    area: Vector
    comm: MPI.Intracomm = field(default_factory=lambda: MPI.COMM_SELF, repr=False)


class BoltResult(TiedResult):
    """The solution at the cut through a bolt, as a `TiedResult`."""

    @property
    def tension(self) -> float:
        """Force in the shank along its axis, given or found [N]; [N/m] in plane problems."""
        assert self.entry.tension is not None
        return self.entry.tension

    @property
    def shortening(self) -> float:
        """By how much the shank is shortened, given or found [m]."""
        assert self.entry.shortening is not None
        return self.entry.shortening


@dataclass(frozen=True)
class RigidBodyResult:
    """The motion of a rigid body and the forces on it; equal on all ranks.

    Attributes
    ----------
    name : str
        Name of the body.
    translation : list of float
        Displacement of the reference point, (gdim,) [m].
    rotation : list of float
        Axis times angle (3,), in 2D the angle (1,) [rad].
    force, moment : list of float
        Sum of the contact forces on the body (gdim,) [N], and their moment about the reference
        point (3,) [N m], in 2D (1,).
    reaction, reaction_moment : list of float
        The same of what holds the body: of prescribed components of the motion and of the spring.
    """

    name: str
    translation: list[float]
    rotation: list[float]
    force: list[float]
    moment: list[float]
    reaction: list[float]
    reaction_moment: list[float]

    @staticmethod
    def of(frame: BodyFrame, force: Vector, moment: Vector) -> RigidBodyResult:
        """Return the result for contact forces and their moment about the origin."""
        body, gdim = frame.body, frame.body.gdim
        r = body.point
        arm = np.cross(r, force) if gdim == 3 else np.array([r[0] * force[1] - r[1] * force[0]])
        contact = np.append(force, moment - arm)
        held = 0.0 - (frame.load + contact)
        return RigidBodyResult(
            frame.name,
            frame.motion[:gdim].tolist(),
            frame.rotation.tolist(),
            contact[:gdim].tolist(),
            contact[gdim:].tolist(),
            held[:gdim].tolist(),
            held[gdim:].tolist(),
        )


class Results(tuple[Any, ...]):
    """Results of contacts or of rigid bodies, by number or by name; they cannot be changed.

    Parameters
    ----------
    results : sequence of ContactResult or TiedResult, or of RigidBodyResult
        In the order in which the contacts or bodies were given.

    Examples
    --------
    >>> problem.results["joint"].force  # doctest: +SKIP
    >>> [result.name for result in problem.results]  # doctest: +SKIP
    """

    __slots__ = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the contacts."""
        return tuple(result.name for result in self)

    def __getitem__(self, key: Any) -> Any:
        """Return the result of a contact, by number or name, or those of some numbers."""
        if not self and not isinstance(key, slice):
            raise InputError("there are no results: solve the problem first, and give it contacts")
        if isinstance(key, int) and not -len(self) <= key < len(self):
            raise InputError(f"there is no result {key}: there are {len(self)}, counted from 0")
        if not isinstance(key, str):
            return super().__getitem__(key)
        named = [result for result in self if result.name == key]
        if not named:
            raise InputError(f"no contact has the name {key!r}; the names are {list(self.names)}")
        if len(named) > 1:
            raise InputError(f"more than one contact has the name {key!r}: take their numbers")
        return named[0]

    def __contains__(self, key: object) -> bool:
        """Tell whether a contact has a name, or whether a result is one of these."""
        return key in self.names or any(key is result for result in self)

    def __repr__(self) -> str:
        return f"Results({', '.join(map(repr, self.names))})"


def _concatenated(parts: Sequence[Any]) -> Any:
    """Return the first of some results with the arrays of all of them."""
    arrays = {
        column.name: np.concatenate([getattr(part, column.name) for part in parts])
        for column in fields(parts[0])
        if isinstance(getattr(parts[0], column.name), np.ndarray)
    }
    return replace(parts[0], **arrays)


def _gathered(result: Any, comm: MPI.Intracomm, order: Numbers) -> Any:
    """Return a result with the arrays of all ranks, in an order. Collective."""
    arrays = dict[str, Any]()
    for column in fields(result):
        value = getattr(result, column.name)
        if isinstance(value, np.ndarray):
            arrays[column.name] = concatenate_ranks(comm, value)[order]
        elif isinstance(value, FrictionResult):
            arrays[column.name] = _gathered(value, comm, order)
    return replace(result, **arrays)

"""Contacts and ties as users describe them: surfaces, partners of nodes, laws of friction.

Each description checks itself when it is made, so that the error is at the line that the user
wrote. What depends on the mesh is checked when the problem is posed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.obstacles.rigid_body import RigidBody
from fenics_tfeti.fem.contact.obstacles.shapes import Obstacle
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.fem.user_data import (
    ScalarField,
    VectorField,
    as_array,
    as_coordinates,
    as_direction,
    as_points,
    is_number,
)
from fenics_tfeti.typing import Numbers, Vector

NodalValue: TypeAlias = ScalarField | Any  # or a Function
InitialGap: TypeAlias = Literal["geometric", "touching"] | ScalarField


@dataclass(frozen=True)
class Tresca:
    """Friction with a given bound: the tangential traction is at most the slip bound.

    It acts at all nodes that may touch, whether they are pressed or not.

    Attributes
    ----------
    slip_bound : float, callable or dolfinx.fem.Function
        Largest tangential traction [Pa]: a number, a function of x (3, n) [m] that returns (n,), or
        values at the nodes: a scalar Function of degree 1 on the mesh. With the `measure_weight` of
        the problem it becomes the largest nodal force.

    Examples
    --------
    >>> Tresca(slip_bound=2e6)
    Tresca(slip_bound=2000000.0)
    """

    slip_bound: NodalValue

    def __post_init__(self) -> None:
        """Check the data."""
        _check_nodal_value(self.slip_bound, "slip_bound")


@dataclass(frozen=True)
class Coulomb:
    """Coulomb's law: the tangential traction is at most the coefficient times the pressure.

    Attributes
    ----------
    coefficient : float, callable or dolfinx.fem.Function
        Coefficient of friction: a number, a function of x (3, n) [m] that returns (n,), or values
        at the nodes: a scalar Function of degree 1 on the mesh.

    Examples
    --------
    >>> Coulomb(coefficient=0.3)
    Coulomb(coefficient=0.3)
    """

    coefficient: NodalValue

    def __post_init__(self) -> None:
        """Check the data."""
        _check_nodal_value(self.coefficient, "coefficient")


FrictionLaw: TypeAlias = Tresca | Coulomb


@dataclass(frozen=True)
class Nearest:
    """Conditions between each slave node and the nearest master node.

    Attributes
    ----------
    tolerance : float
        Largest distance of the two along the surface, relative to the mean edge of the smallest of
        the slave's facets there.

    Examples
    --------
    >>> Nearest(tolerance=0.3)
    Nearest(tolerance=0.3)
    """

    tolerance: float = 0.1

    def __post_init__(self) -> None:
        """Check the data."""
        _check_tolerance(self)


@dataclass(frozen=True)
class Along:
    """Conditions between each slave node and a master node on a line through it.

    Attributes
    ----------
    direction : (gdim,) array-like or callable
        Direction of the line, of any length and either sense; a callable gets x (3, n) [m] and
        returns (gdim, n). Of the master nodes on the line, those are candidates whose normals point
        against the slave node's.
    tolerance : float
        Largest distance of the master node from the line, relative to the mean edge of the smallest
        of the slave's facets there.

    Examples
    --------
    >>> Along((0, 0, 1))
    Along(direction=(0, 0, 1), tolerance=0.1)
    """

    direction: VectorField
    tolerance: float = 0.1

    def __post_init__(self) -> None:
        """Check the data."""
        if not callable(self.direction):
            as_direction(self.direction, "Along: the direction")
        _check_tolerance(self)


@dataclass(frozen=True)
class Mapped:
    """Conditions between each slave node and the master node nearest to its image.

    Attributes
    ----------
    mapping : callable
        chi of sec. 11.1: x (3, n) -> (3, n), the expected places of the slave nodes' partners [m].
    tolerance : float
        Largest distance of the master node from the image, relative to the mean edge of the
        smallest of the slave's facets there.

    Examples
    --------
    The partners of the nodes at x = 1 are at x = 3.

    >>> shift = Mapped(lambda x: x + np.array([[2.0], [0.0], [0.0]]))
    >>> shift.mapping(np.array([[1.0], [0.5], [0.0]])).ravel().tolist()
    [3.0, 0.5, 0.0]
    """

    mapping: Callable[[Vector], ArrayLike]
    tolerance: float = 0.1

    def __post_init__(self) -> None:
        """Check the data."""
        if not callable(self.mapping):
            raise InputError(
                f"Mapped: the mapping is {self.mapping!r}; a function x (3, n) -> (3, n) is "
                "expected"
            )
        _check_tolerance(self)


@dataclass(frozen=True, eq=False)
class Points:
    """Conditions between pairs of nodes at given places, the same on all ranks.

    Attributes
    ----------
    slave, master : (k, gdim) or (k, 3) array-like
        Coordinates of the slave node and of the master node of each pair [m].
    tolerance : float
        Largest distance of the nodes from these places, relative to the mean edge of the smallest
        of the facets there.

    Examples
    --------
    >>> pairs = Points(slave=[(0, 1), (1, 1)], master=[(0, 1), (1.02, 1)])
    >>> ContactPair(facet_tags, 5, 6, partners=pairs)  # doctest: +SKIP
    """

    slave: ArrayLike
    master: ArrayLike
    tolerance: float = 0.1

    def __post_init__(self) -> None:
        """Check the data."""
        slave = as_points(self.slave, "Points: the slave points")
        master = as_points(self.master, "Points: the master points")
        if len(slave) != len(master):
            raise InputError(
                f"Points: {len(slave)} slave points and {len(master)} master points are given; "
                "give one master point for each slave point"
            )
        _check_tolerance(self)


NodePartners: TypeAlias = Nearest | Along | Mapped | Points


@dataclass(frozen=True)
class _SurfacePair:
    """Two tagged surfaces."""

    facet_tags: Any
    slave: int
    master: int
    _: KW_ONLY
    name: str = ""

    def _checked(
        self, remedy: str = "fenics_tfeti.io.split_interfaces makes two of one inside a body"
    ) -> str:
        """Check the surfaces, and return how messages call the pair."""
        label = _label(self)
        _check_surfaces(self.facet_tags, {"slave": self.slave, "master": self.master}, label)
        if self.slave == self.master:
            raise InputError(
                f"{label}: slave and master have the same tag {self.slave}; each surface needs one "
                f"of its own. {remedy}"
            )
        return label


@dataclass(frozen=True, kw_only=True)
class ContactPair(_SurfacePair):
    """Two tagged surfaces that may touch but not penetrate each other.

    Their meshes need not match, and each surface may extend beyond the other. :doc:`/surfaces` says
    what to choose.

    Attributes
    ----------
    facet_tags : MeshTags
        Tags of facets.
    slave, master : int
        Tag of the slave's and of the master's surface.
    name : str
        For messages and the report.
    friction : Tresca or Coulomb, optional
        The law of friction; by default there is none.
    initial_gap : "geometric", "touching", float or callable
        The gap between the undeformed surfaces. By default it is that of the mesh. "touching" sets
        gaps to zero that are no larger than the distance of the facets from the curved surface. A
        number or a function of x (3, n) that returns (n,) is a clearance (> 0) or an interference
        (< 0) at the slave's nodes [m].
    normal : (gdim,) array-like or callable, optional
        Outward normals of the slave, of any length; a callable gets x (3, n) and returns (gdim, n).
        By default the mean of the facets' normals at each node.
    partial : bool
        Whether nodes that belong to slave and master, and slave nodes without partner, stay free
        instead of being an error. Mortar conditions leave slave nodes free in any case that the
        master does not cover.
    roles : {"auto", "given"}
        Whether `slave` and `master` are exchanged where mortar conditions are much better the other
        way round, or are as given.
    partners : Nearest, Along, Mapped, Points or "mortar", optional
        Whether conditions are between pairs of nodes, and how these are found, or mortar
        conditions. By default they are between nodes where the meshes match, and mortar conditions
        elsewhere.

    Examples
    --------
    >>> ContactPair(facet_tags, slave=5, master=6, name="joint")  # doctest: +SKIP
    >>> ContactPair(facet_tags, 5, 6, friction=Coulomb(0.3))  # doctest: +SKIP
    >>> ContactPair(facet_tags, 5, 6, initial_gap=-0.05e-3)  # a shrink fit  # doctest: +SKIP
    """

    friction: FrictionLaw | None = None
    initial_gap: InitialGap = "geometric"
    normal: VectorField | None = None
    partial: bool = False
    roles: Literal["auto", "given"] = "auto"
    partners: NodePartners | Literal["mortar"] | None = None

    def __post_init__(self) -> None:
        """Check the data."""
        label = self._checked(
            "Where it is one surface between two bodies that share its nodes, "
            "fenics_tfeti.io.split_interfaces makes two of it"
        )
        _check_friction(self.friction, label)
        gap = self.initial_gap
        is_word = isinstance(gap, str) and gap in ("geometric", "touching")
        if not (is_word or callable(gap) or is_number(gap)):
            raise InputError(
                f"{label}: initial_gap is {gap!r}; 'geometric', 'touching', a number [m] or a "
                "function x (3, n) -> (n,) is expected"
            )
        if self.normal is not None and not callable(self.normal):
            as_direction(self.normal, f"{label}: the normal")
        if not isinstance(self.partial, bool):
            raise InputError(f"{label}: partial is {self.partial!r}; True or False is expected")
        if self.roles not in ("auto", "given"):
            raise InputError(f"{label}: roles is {self.roles!r}; 'auto' or 'given' is expected")
        is_mortar = isinstance(self.partners, str) and self.partners == "mortar"
        if not (is_mortar or self.partners is None or isinstance(self.partners, NodePartners)):
            raise InputError(
                f"{label}: partners is {self.partners!r}; Nearest(), Along(direction), "
                "Mapped(mapping), Points(slave, master), 'mortar' or None is expected"
            )


@dataclass(frozen=True)
class RigidObstacle:
    """A tagged surface that may touch but not penetrate a rigid obstacle.

    Attributes
    ----------
    facet_tags : MeshTags
        Tags of facets.
    slave : int
        Tag of the surface.
    obstacle : callable
        x -> (gap, normal) for points x of shape (3, n): the distance (n,) to the obstacle [m] and
        the unit normal (gdim, n) that points from the obstacle to the body. Or x -> gap alone, the
        distance along the surface's own outward normal. Where there is no obstacle, the gap is
        +inf and the normal is not used. `Plane`, `Sphere` and `Cylinder` are such callables.
    name : str
        For messages and the report.
    friction : Tresca or Coulomb, optional
        The law of friction; by default there is none.
    displacement : (gdim,) array-like or callable, optional
        How far the obstacle has moved at each point since the undeformed state [m], for friction:
        slip is relative to the obstacle. A callable gets x (3, n) and returns (gdim, n). By default
        the obstacle is at rest. Where it moves along its normal, `obstacle` has to say so too.
    body : RigidBody, optional
        The rigid body with the shape of `obstacle`, moved by its contacts and loads. By default the
        obstacle is held.

    Examples
    --------
    >>> ground = Plane(point=(0, 0, 0), normal=(0, 0, 1))  # doctest: +SKIP
    >>> RigidObstacle(facet_tags, 7, ground, friction=Coulomb(0.2))  # doctest: +SKIP
    >>> RigidObstacle(facet_tags, 7, lambda x: x[2] - 0.1 * x[0] ** 2)  # doctest: +SKIP
    """

    facet_tags: Any
    slave: int
    obstacle: Obstacle
    _: KW_ONLY
    name: str = ""
    friction: FrictionLaw | None = None
    displacement: VectorField | None = None
    body: RigidBody | None = None

    def __post_init__(self) -> None:
        """Check the data."""
        label = _label(self)
        _check_surfaces(self.facet_tags, {"slave": self.slave}, label)
        if self.body is not None and not isinstance(self.body, RigidBody):
            raise InputError(
                f"{label}: body is a {type(self.body).__name__}; a RigidBody or None is expected"
            )
        if self.body is not None and self.displacement is not None:
            raise InputError(
                f"{label}: the obstacle has a body, which moves it: leave its displacement out. "
                "Prescribed components are the body's translation and rotation"
            )
        if not callable(self.obstacle):
            raise InputError(
                f"{label}: the obstacle is a {type(self.obstacle).__name__}; a function of x that "
                "returns (gap, normal) or the gap is expected, such as Plane(point, normal)"
            )
        _check_friction(self.friction, label)
        if self.displacement is not None and self.friction is None:
            raise InputError(
                f"{label}: the obstacle's displacement has no effect without friction: leave it "
                "out, or give it friction. Gaps to a moving obstacle are those that its function "
                "returns"
            )
        if self.displacement is not None and not callable(self.displacement):
            as_coordinates(self.displacement, f"{label}: the obstacle's displacement")


@dataclass(frozen=True, kw_only=True)
class TiedPair(_SurfacePair):
    """Two tagged surfaces that stay together where they face each other.

    They may be meshed apart, as a coarse and a fine part of one body are: mortar conditions hold
    their displacements together in the mean around each slave node, exactly for linear ones. What
    one surface has beyond the other stays free.

    Attributes
    ----------
    facet_tags : MeshTags
        Tags of facets.
    slave, master : int
        Tag of the slave's and of the master's surface. The slave should be the softer
        surface and, of two equally stiff ones, that with the larger facets.
    name : str
        For messages and the report.

    Examples
    --------
    >>> TiedPair(facet_tags, slave=5, master=6, name="glue")  # doctest: +SKIP
    """

    def __post_init__(self) -> None:
        """Check the data."""
        self._checked("Bodies that share the nodes of a surface are tied already")


@dataclass(frozen=True, kw_only=True)
class PeriodicPair(_SurfacePair):
    """Two tagged surfaces that match, of which one moves as the other does.

    Each node x' of the slave is the image x' = Q x + t of a node x of the master, and the
    displacements are u(x') = Q u(x) + c: of periodic cells, and of sectors of cyclic bodies. A
    periodic cell with the mean strain E has ``jump=E @ translation``.

    Attributes
    ----------
    facet_tags : MeshTags
        Tags of facets.
    slave, master : int
        Tag of the slave's and of the master's surface; their meshes have to match.
    translation : (gdim,) array-like, optional
        t [m]; by default 0.
    rotation : (gdim, gdim) array-like, optional
        Q, an orthogonal matrix; by default there is no rotation.
    jump : (gdim,) array-like or callable, optional
        c [m]; a callable gets x' (3, n) and returns (gdim, n). By default 0.
    name : str
        For messages and the report.

    Examples
    --------
    A sector of 30 degrees around the origin, from the surface 5 to the surface 6:

    >>> c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    >>> PeriodicPair(tags, slave=6, master=5, rotation=[[c, -s], [s, c]])  # doctest: +SKIP
    """

    translation: ArrayLike | None = None
    rotation: ArrayLike | None = None
    jump: VectorField | None = None

    def __post_init__(self) -> None:
        """Check the data."""
        label = self._checked()
        if self.translation is None and self.rotation is None:
            raise InputError(
                f"{label}: neither a translation nor a rotation from the master to the slave is "
                "given. Surfaces at the same place are held together by TiedPair"
            )
        if self.translation is not None:
            as_coordinates(self.translation, f"{label}: the translation")
        if self.rotation is not None:
            _check_rotation(self.rotation, label)
        if self.jump is not None and not callable(self.jump):
            as_coordinates(self.jump, f"{label}: the jump")


@dataclass(frozen=True, kw_only=True)
class BoltPreload(_SurfacePair):
    """A cut through the shank of a bolt, which is shortened or loaded along its axis.

    The two sides of the cut have nodes of their own at the same places, as
    `fenics_tfeti.io.split_interfaces` makes them. They stay together across the axis; along it they
    overlap by the shortening, as if so much of the shank were taken out. Either it is given, or the
    force. A bolt that was tightened by its force is locked for the steps that follow by `locked`.

    Attributes
    ----------
    facet_tags : MeshTags
        Tags of facets.
    slave, master : int
        Tags of the two sides of the cut.
    force : float, optional
        Tension of the shank [N]; [N/m] in plane problems.
    shortening : float, optional
        [m]
    axis : (gdim,) array-like, optional
        Direction of the axis, of any length and either sense. By default the normal of the cut,
        which has to be plane.
    name : str
        For messages and the report.

    Examples
    --------
    >>> bolt = BoltPreload(tags, slave=11, master=12, force=50e3, name="bolt")  # doctest: +SKIP
    >>> problem = ContactProblem(a, L, bcs=bcs, contacts=[joint, bolt])  # doctest: +SKIP
    >>> problem.solve()  # doctest: +SKIP
    >>> problem.contacts[1] = bolt.locked(problem.results["bolt"])  # doctest: +SKIP
    """

    force: float | None = None
    shortening: float | None = None
    axis: ArrayLike | None = None

    def __post_init__(self) -> None:
        """Check the data."""
        label = self._checked()
        if (self.force is None) == (self.shortening is None):
            raise InputError(f"{label}: give the force or the shortening, one of the two")
        for what in ("force", "shortening"):
            value = getattr(self, what)
            if value is not None and not is_number(value):
                raise InputError(f"{label}: the {what} is {value!r}; a finite number is expected")
        if self.axis is not None:
            as_direction(self.axis, f"{label}: the axis")

    def locked(self, result: Any) -> BoltPreload:
        """Return the bolt with the shortening of a result in place of its force."""
        return replace(self, force=None, shortening=float(result.shortening))


@dataclass(frozen=True, eq=False)
class LinearRows:
    """Any linear conditions u_i = sum_j a_j u_j + value between degrees of freedom.

    Each rank gives the conditions of slaves that it owns. The arrays are those that
    ``dolfinx_mpc.MultiPointConstraint.add_constraint`` takes.

    Attributes
    ----------
    slaves : (k,) integer array-like
        Degrees of freedom i on this rank: ``gdim * node + component`` with local nodes of the
        displacement's space.
    masters : (t,) integer array-like
        Degrees of freedom j of any ranks, with global nodes.
    coefficients : (t,) array-like
        a_j.
    offsets : (k + 1,) integer array-like
        The masters of condition i are those from ``offsets[i]`` up to ``offsets[i + 1]``.
    values : (k,) array-like or float
        [m]
    name : str
        For messages and the report.
    """

    slaves: ArrayLike
    masters: ArrayLike
    coefficients: ArrayLike
    offsets: ArrayLike
    _: KW_ONLY
    values: ArrayLike = 0.0
    name: str = ""

    def __post_init__(self) -> None:
        """Check the data."""
        label = _label(self)
        slaves, masters, offsets = (
            _as_integers(getattr(self, what), f"{label}: {what}")
            for what in ("slaves", "masters", "offsets")
        )
        ascends = offsets.size == slaves.size + 1 and (np.diff(offsets) >= 0).all()
        if not (ascends and offsets[0] == 0 and offsets[-1] == masters.size):
            raise InputError(
                f"{label}: offsets are positions among the masters, {slaves.size + 1} that ascend "
                f"from 0 to {masters.size}"
            )
        for what, size in (("coefficients", masters.size), ("values", slaves.size)):
            numbers = _as_numbers(getattr(self, what), f"{label}: {what}")
            if numbers.shape != (size,) and not (what == "values" and numbers.ndim == 0):
                raise InputError(f"{label}: {what} has shape {numbers.shape}, expected ({size},)")
        if np.unique(slaves).size != slaves.size:
            raise InputError(f"{label}: a degree of freedom is the slave of two conditions")

    @staticmethod
    def from_mpc(mpc: Any, name: str = "") -> LinearRows:
        """Return the conditions of a finalized ``dolfinx_mpc.MultiPointConstraint``."""
        coefficients, offsets = (np.asarray(part) for part in mpc.coefficients())
        slaves = np.asarray(mpc.slaves)[: mpc.num_local_slaves]
        counts = np.diff(offsets)[slaves]
        ends = np.append(0, np.cumsum(counts))
        terms = np.repeat(offsets[slaves] - ends[:-1], counts) + np.arange(ends[-1])
        # masters that this rank does not own are ghosts of the constraint's own space
        dofmap = mpc.function_space.dofmap
        block, component = np.divmod(np.asarray(mpc.masters.array)[terms], dofmap.index_map_bs)
        nodes = np.asarray(dofmap.index_map.local_to_global(block.astype(np.int32)))
        masters = dofmap.index_map_bs * nodes.astype(np.int64) + component
        return LinearRows(slaves, masters, coefficients[terms], ends, name=name)


Contact: TypeAlias = ContactPair | RigidObstacle
Tie: TypeAlias = TiedPair | PeriodicPair | BoltPreload | LinearRows


@dataclass(frozen=True)
class Exact:
    """Contact conditions that are corrected until the deformed surfaces touch.

    Each pass solves with the normals and gaps of the surfaces that the last one has deformed.

    Attributes
    ----------
    tolerance : float
        Penetration and separation of the deformed surfaces that count as none, relative to the
        largest displacement; also the angle between contact forces and deformed normals.
    max_passes : int
        Limit on the number of passes.

    Examples
    --------
    >>> Exact(tolerance=1e-4)
    Exact(tolerance=0.0001, max_passes=20)
    """

    tolerance: float = 1e-3
    max_passes: int = 20

    def __post_init__(self) -> None:
        """Check the data."""
        if not is_number(self.tolerance) or self.tolerance <= 0.0:
            raise InputError(
                f"Exact: the tolerance is {self.tolerance!r}; a positive number is expected, "
                "relative to the largest displacement"
            )
        count = self.max_passes
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
            raise InputError(f"Exact: max_passes is {count!r}; a positive integer is expected")


_DEFAULT_NAMES = {
    ContactPair: "contact {} (pair)",
    RigidObstacle: "contact {} (obstacle)",
    TiedPair: "tied pair {}",
    PeriodicPair: "periodic pair {}",
    BoltPreload: "bolt {}",
    LinearRows: "linear rows {}",
}


def contact_name(contact: Contact | Tie, number: int) -> str:
    """Return the name of a contact or tie, by default from its number and kind."""
    name = next(text for kind, text in _DEFAULT_NAMES.items() if isinstance(contact, kind))
    return contact.name or name.format(number)


def _label(contact: Any) -> str:
    """Return how messages call a contact that has no number yet; check that a name is a text."""
    if not isinstance(contact.name, str):
        raise InputError(f"{type(contact).__name__}: name is {contact.name!r}; a text is expected")
    return contact.name or type(contact).__name__


def _check_surfaces(facet_tags: Any, tags: dict[str, Any], label: str) -> None:
    """Check tags of facets, and the tag of each role."""
    if not (hasattr(facet_tags, "find") and hasattr(facet_tags, "dim")):
        raise InputError(
            f"{label}: facet_tags is a {type(facet_tags).__name__}; the mesh tags of the facets "
            "are expected, as returned by dolfinx.mesh.meshtags"
        )
    for role, tag in tags.items():
        if isinstance(tag, bool) or not isinstance(tag, int | np.integer):
            raise InputError(
                f"{label}: the tag of the {role} is {tag!r}; an integer is expected, one of the "
                "values of facet_tags. Surfaces have numbers, not names; to use several tags, "
                "join them under one"
            )


def _check_tolerance(partners: NodePartners) -> None:
    if not is_number(partners.tolerance) or partners.tolerance <= 0.0:
        raise InputError(
            f"{type(partners).__name__}: the tolerance is {partners.tolerance!r}; a positive "
            "number is expected, relative to the size of the slave's facets"
        )


def _check_friction(law: Any, label: str) -> None:
    if law is not None and not isinstance(law, FrictionLaw):
        raise InputError(
            f"{label}: friction is a {type(law).__name__}; Tresca(slip_bound), "
            "Coulomb(coefficient) or None is expected"
        )


def _check_nodal_value(value: Any, label: str) -> None:
    if callable(value) or isinstance(value, Function):
        return
    if not is_number(value) or value < 0.0:
        raise InputError(
            f"{label} is {value!r}; a finite number, at least 0, a function x (3, n) -> "
            "(n,) or a scalar Function of degree 1 is expected"
        )


def _check_rotation(rotation: ArrayLike, label: str) -> None:
    Q = _as_numbers(rotation, f"{label}: the rotation")
    if Q.shape not in ((2, 2), (3, 3)):
        raise InputError(f"{label}: the rotation has shape {Q.shape}, expected (gdim, gdim)")
    if np.abs(Q @ Q.T - np.identity(len(Q))).max() > RELATIVE_ROUNDING:
        raise InputError(f"{label}: the rotation is no orthogonal matrix: Q Q' is not the identity")


def _as_numbers(values: Any, what: str) -> Vector:
    numbers = as_array(values, what)
    if not np.isfinite(numbers).all():
        raise InputError(f"{what}: a number is NaN or infinite")
    return numbers


def _as_integers(values: Any, what: str) -> Numbers:
    numbers = _as_numbers(values, what)
    integers = numbers.astype(np.int64)
    if numbers.ndim != 1 or (integers != numbers).any():
        raise InputError(f"{what}: an array of integers is expected")
    return integers

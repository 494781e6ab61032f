"""Ties: periodic surfaces, bolts and any linear conditions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from fenics_tfeti.errors import InputError, check_value, wrong_type
from fenics_tfeti.fem.contact.descriptions.contacts import Contact, ContactPair
from fenics_tfeti.fem.contact.descriptions.laws import BondLaw, check_bond_law
from fenics_tfeti.fem.contact.descriptions.surfaces import SurfacePair, checked_label
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.fem.user_data import (
    VectorField,
    as_array,
    as_coordinates,
    as_direction,
    check_field,
    is_number,
)
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True, kw_only=True)
class TiedPair(SurfacePair):
    """Two tagged surfaces that stay together where they face each other.

    They may be meshed apart, as a coarse and a fine part of one body are: mortar conditions hold
    their displacements together in the mean around each slave node, exactly for linear ones. Gaps
    between them, as of facets along a curved surface, turn with the slave's facets. What one
    surface has beyond the other stays free.

    Attributes
    ----------
    facet_tags : MeshTags
        Tags of facets.
    slave, master : int or str, or list of these
        Tag or name of the slave's and of the master's surface. The slave should be the softer
        surface and, of two equally stiff ones, that with the larger facets.
    law : Cohesive or ElasticLayer, optional
        What the surfaces exert where they move apart or along each other; by default they do not. A
        `Cohesive` bond breaks, and leaves contact without friction. Surfaces are unstrained as they
        are meshed; results are those of a `ContactPair` with ``initial_gap=0``, which may have
        friction, too. With small strains on undeformed surfaces only.
    name : str
        For messages and the report.

    Examples
    --------
    >>> TiedPair(facet_tags, slave=5, master=6, name="glue")  # doctest: +SKIP
    >>> TiedPair(facet_tags, 5, 6, law=Cohesive(57e6, 280.0))  # doctest: +SKIP
    """

    default_name = "tied pair {}"
    remedy = "Bodies that share the nodes of a surface are tied already"
    law: BondLaw | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_bond_law(self.law, checked_label(self))

    @cached_property
    def bond(self) -> BondedPair | None:
        """The contact of surfaces with a law, which stands for this pair; None without."""
        if self.law is None:
            return None
        return BondedPair(
            facet_tags=self.facet_tags,
            slave=self.slave,
            master=self.master,
            name=self.name,
            law=self.law,
            initial_gap=0.0,
            partial=True,
        )


class BondedPair(ContactPair):
    """A contact that stands for a `TiedPair` with a law."""

    default_name = TiedPair.default_name


@dataclass(frozen=True, kw_only=True)
class PeriodicPair(SurfacePair):
    """Two tagged surfaces that match, of which one moves as the other does.

    Each node x' of the slave is the image x' = Q x + t of a node x of the master, and the
    displacements are u(x') = Q u(x) + c: of periodic cells, and of sectors of cyclic bodies. A
    periodic cell with the mean strain E has ``jump=E @ translation``.

    Attributes
    ----------
    facet_tags : MeshTags
        Tags of facets.
    slave, master : int or str, or list of these
        Tag or name of the slave's and of the master's surface; their meshes have to match.
    translation : (gdim,) array-like, optional
        t [m]; by default 0.
    rotation : (gdim, gdim) array-like, optional
        Q, an orthogonal matrix with det Q = 1; by default there is no rotation.
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

    default_name = "periodic pair {}"
    translation: ArrayLike | None = None
    rotation: ArrayLike | None = None
    jump: VectorField | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        label = checked_label(self)
        if self.translation is None and self.rotation is None:
            raise InputError(
                f"{label}: neither a translation nor a rotation from the master to the slave is "
                "given. Surfaces at the same place are held together by TiedPair"
            )
        if self.translation is not None:
            as_coordinates(self.translation, f"{label}: the translation")
        if self.rotation is not None:
            _check_rotation(self.rotation, label)
        check_field(self.jump, f"{label}: the jump")


@dataclass(frozen=True, kw_only=True)
class BoltPreload(SurfacePair):
    """A cut through the shank of a bolt, which is shortened or loaded along its axis.

    The two sides of the cut have nodes of their own at the same places, as
    `fenics_tfeti.io.split_interfaces` makes them. They stay together across the axis; along it they
    overlap by the shortening, as if so much of the shank were taken out. Either it is given, or the
    force. A bolt that was tightened by its force is locked for the steps that follow by `locked`.

    Attributes
    ----------
    facet_tags : MeshTags
        Tags of facets.
    slave, master : int or str, or list of these
        Tags or names of the two sides of the cut.
    force : float, optional
        Tension of the shank [N]; [N/m] in plane problems.
    shortening : float, optional
        [m]
    axis : (gdim,) array-like, optional
        Direction of the axis, of any length and either sense. By default the normal of the cut,
        which has to be plane.
    turns : bool
        Whether the axis turns with the cut in a `NonlinearContactProblem`. No displacements must be
        prescribed on the slave's side then. By default, and in a `ContactProblem`, whose rotations
        are small, the axis stays as it is.
    name : str
        For messages and the report.

    Examples
    --------
    >>> bolt = BoltPreload(tags, slave=11, master=12, force=50e3, name="bolt")  # doctest: +SKIP
    >>> problem = ContactProblem(a, L, bcs=bcs, contacts=[joint, bolt])  # doctest: +SKIP
    >>> problem.solve()  # doctest: +SKIP
    >>> problem.contacts[1] = bolt.locked(problem.results["bolt"])  # doctest: +SKIP
    """

    default_name = "bolt {}"
    force: float | None = None
    shortening: float | None = None
    axis: ArrayLike | None = None
    turns: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        label = checked_label(self)
        if (self.force is None) == (self.shortening is None):
            raise InputError(f"{label}: give the force or the shortening, one of the two")
        for what in ("force", "shortening"):
            value = getattr(self, what)
            fits = value is None or is_number(value)
            check_value(fits, f"{label}: the {what}", value, "a finite number")
        if self.axis is not None:
            as_direction(self.axis, f"{label}: the axis")

    def locked(self, result: Any) -> BoltPreload:
        """Return the bolt with the shortening of a result in place of its force."""
        if getattr(result, "shortening", None) is None:
            raise wrong_type(f"{checked_label(self)}.locked", result, "the result of a bolt")
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

    default_name = "linear rows {}"
    slaves: ArrayLike
    masters: ArrayLike
    coefficients: ArrayLike
    offsets: ArrayLike
    _: KW_ONLY
    values: ArrayLike = 0.0
    name: str = ""

    def __post_init__(self) -> None:
        label = checked_label(self)
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


Tie: TypeAlias = TiedPair | PeriodicPair | BoltPreload | LinearRows


def with_bonds(contacts: Sequence[Contact | Tie]) -> list[Contact | Tie]:
    """Return contacts and ties, with the contact of a tied pair with a law in its place."""
    return [(isinstance(tie, TiedPair) and tie.bond) or tie for tie in contacts]


def _check_rotation(rotation: ArrayLike, label: str) -> None:
    Q = _as_numbers(rotation, f"{label}: the rotation")
    if Q.shape not in ((2, 2), (3, 3)):
        raise InputError(f"{label}: the rotation has shape {Q.shape}, expected (gdim, gdim)")
    if np.abs(Q @ Q.T - np.identity(len(Q))).max() > RELATIVE_ROUNDING:
        raise InputError(f"{label}: the rotation is no orthogonal matrix: Q Q' is not the identity")
    if np.linalg.det(Q) < 0.0:
        raise InputError(
            f"{label}: the rotation is a reflection, with det Q = -1: a surface that is the mirror "
            "image of another one does not follow it. Give a matrix with det Q = 1"
        )


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

"""Contacts: pairs of surfaces, and surfaces at rigid obstacles."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field
from typing import Any, Literal, TypeAlias

import numpy as np

from fenics_tfeti.errors import InputError, check_value, wrong_type
from fenics_tfeti.fem.contact.descriptions.friction import FrictionLaw, check_friction
from fenics_tfeti.fem.contact.descriptions.laws import InterfaceLaw, check_law
from fenics_tfeti.fem.contact.descriptions.partners import Mortar, NodePartners
from fenics_tfeti.fem.contact.descriptions.rigid_body import RigidBody
from fenics_tfeti.fem.contact.descriptions.shapes import Obstacle
from fenics_tfeti.fem.contact.descriptions.surfaces import (
    SurfacePair,
    SurfaceTags,
    check_tags,
    checked_label,
)
from fenics_tfeti.fem.user_data import (
    ScalarField,
    VectorField,
    as_direction,
    check_field,
    check_positive,
    is_function,
    is_integer,
    is_number,
)
from fenics_tfeti.typing import Indices, Vector

InitialGap: TypeAlias = Literal["geometric", "touching"] | ScalarField


@dataclass(frozen=True, kw_only=True)
class ContactPair(SurfacePair):
    """Two tagged surfaces that may touch but not penetrate each other.

    Their meshes need not match, and each surface may extend beyond the other. :doc:`/surfaces` says
    what to choose.

    Attributes
    ----------
    facet_tags : MeshTags
        Tags of facets.
    slave, master : int or str, or list of these
        Tag of the slave's and of the master's surface, or its name where `facet_tags` carry names,
        as those of `read_msh` and `split_interfaces` do; it becomes the tag. A list joins surfaces.
    name : str
        For messages and the report.
    friction : Tresca or Coulomb, optional
        The law of friction; by default there is none.
    law : SoftContact, RoughContact, Adhesive, ElasticBond, ElasticLayer or Cohesive, optional
        What the surfaces exert across their gap; by default hard contact, that only presses. With
        small strains on undeformed surfaces; SoftContact and Cohesive at finite strains, too.
    initial_gap : "geometric", "touching", float or callable
        The gap between the undeformed surfaces. By default it is that of the mesh. "touching" sets
        gaps to zero that are no larger than the distance of the facets from the curved surface. A
        number or a function of x (3, n) that returns (n,) is a clearance (> 0) or an interference
        (< 0) at the slave's nodes [m].
    normal : (gdim,) array-like or callable, optional
        Outward normals of the slave, of any length; a callable gets x (3, n) and returns (gdim, n).
        By default the mean of the facets' normals at each node. At finite strains they turn with
        the facets; with small strains they are kept.
    partial : bool
        Whether nodes that belong to slave and master, and slave nodes without partner, stay free
        instead of being an error. Mortar conditions leave slave nodes free in any case that the
        master does not cover.
    roles : {"auto", "given"}
        Whether `slave` and `master` are exchanged where mortar conditions are much better the other
        way round, or are as given.
    partners : Nearest, Along, Mapped, Points or Mortar, optional
        Whether conditions are between pairs of nodes, and how these are found, or mortar
        conditions. By default they are between nodes where the meshes match, and mortar conditions
        elsewhere.

    Examples
    --------
    >>> ContactPair(facet_tags, slave=5, master=6, name="joint")  # doctest: +SKIP
    >>> ContactPair(facet_tags, 5, 6, friction=Coulomb(0.3))  # doctest: +SKIP
    >>> ContactPair(facet_tags, 5, 6, initial_gap=-0.05e-3)  # a shrink fit  # doctest: +SKIP
    """

    default_name = "contact {} (pair)"
    remedy = (
        "Where it is one surface between two bodies that share its nodes, "
        "fenics_tfeti.io.split_interfaces makes two of it"
    )
    friction: FrictionLaw | None = None
    law: InterfaceLaw | None = None
    initial_gap: InitialGap = "geometric"
    normal: VectorField | None = None
    partial: bool = False
    roles: Literal["auto", "given"] = "auto"
    partners: NodePartners | Mortar | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        label = checked_label(self)
        check_friction(self.friction, label)
        check_law(self.law, label, self.friction)
        gap = self.initial_gap
        is_word = isinstance(gap, str) and gap in ("geometric", "touching")
        check_value(
            is_word or is_function(gap, f"{label}: initial_gap") or is_number(gap),
            f"{label}: initial_gap",
            gap,
            "'geometric', 'touching', a number [m] or a function x (3, n) -> (n,)",
        )
        check_field(self.normal, f"{label}: the normal", as_direction)
        partial, roles, partners = self.partial, self.roles, self.partners
        check_value(isinstance(partial, bool), f"{label}: partial", partial, "True or False")
        check_value(roles in ("auto", "given"), f"{label}: roles", roles, "'auto' or 'given'")
        check_value(
            partners is None or isinstance(partners, NodePartners | Mortar),
            f"{label}: partners",
            partners,
            "Nearest(), Along(direction), Mapped(mapping), Points(slave, master), Mortar() or None",
        )


@dataclass(frozen=True)
class RigidObstacle:
    """A tagged surface that may touch but not penetrate a rigid obstacle.

    Attributes
    ----------
    facet_tags : MeshTags
        Tags of facets.
    slave : int or str, or list of these
        Tag or name of the surface, or of several.
    obstacle : callable
        x -> (gap, normal) for points x of shape (3, n): the distance (n,) to the obstacle [m] and
        the unit normal (gdim, n) that points from the obstacle to the body. Or x -> gap alone, the
        distance along the surface's own outward normal. Where there is no obstacle, the gap is
        +inf and the normal is not used. `Plane`, `Sphere` and `Cylinder` are such callables.
    name : str
        For messages and the report.
    friction : Tresca or Coulomb, optional
        The law of friction; by default there is none.
    law : SoftContact, RoughContact, Adhesive, ElasticBond, ElasticLayer or Cohesive, optional
        As that of a `ContactPair`.
    displacement : (gdim,) array-like or callable, optional
        How far what is at each point of the obstacle has moved since the undeformed state [m], for
        friction: slip is relative to the obstacle. A callable gets x (3, n), with exact
        non-penetration and finite strains the deformed places of the slave's nodes, and returns
        (gdim, n). By default the obstacle is at rest. Where it moves along its normal, `obstacle`
        has to say so too. An obstacle that turns by a large angle is one on a `rigid_body` with a
        prescribed rotation.
    rigid_body : RigidBody, optional
        The rigid body with the shape of `obstacle`, moved by its contacts and loads. By default the
        obstacle is held.

    Examples
    --------
    >>> ground = Plane(point=(0, 0, 0), normal=(0, 0, 1))  # doctest: +SKIP
    >>> RigidObstacle(facet_tags, 7, ground, friction=Coulomb(0.2))  # doctest: +SKIP
    >>> RigidObstacle(facet_tags, 7, lambda x: x[2] - 0.1 * x[0] ** 2)  # doctest: +SKIP
    """

    default_name = "contact {} (obstacle)"
    facet_tags: Any
    slave: SurfaceTags
    obstacle: Obstacle
    _: KW_ONLY
    name: str = ""
    friction: FrictionLaw | None = None
    law: InterfaceLaw | None = None
    displacement: VectorField | None = None
    rigid_body: RigidBody | None = None

    def __post_init__(self) -> None:
        label = checked_label(self)
        check_tags(self, label, "slave")
        if self.rigid_body is not None and not isinstance(self.rigid_body, RigidBody):
            raise wrong_type(f"{label}: rigid_body", self.rigid_body, "a RigidBody or None")
        if self.rigid_body is not None and self.displacement is not None:
            raise InputError(
                f"{label}: the obstacle has a rigid_body, which moves it: leave its displacement "
                "out. Prescribed components are the body's translation and rotation"
            )
        if not is_function(self.obstacle, f"{label}: the obstacle"):
            raise wrong_type(
                f"{label}: the obstacle",
                self.obstacle,
                "a function of x that returns (gap, normal) or the gap, such as Plane,",
            )
        check_friction(self.friction, label)
        check_law(self.law, label, self.friction)
        if self.displacement is not None and self.friction is None:
            raise InputError(
                f"{label}: the obstacle's displacement has no effect without friction: leave it "
                "out, or give it friction. Gaps to a moving obstacle are those that its function "
                "returns"
            )
        check_field(self.displacement, f"{label}: the obstacle's displacement")


@dataclass(frozen=True)
class SelfContact:
    """A surface that may touch itself, wherever that will be.

    The parts of it that face each other become patches, each with a slave and a master, which have
    mortar conditions. `NonlinearContactProblem` looks before and after each solve whether others
    have come near each other, and keeps patches, roles and forces while they do.

    Attributes
    ----------
    facet_tags : MeshTags, optional
        Tags of facets; by default the surface is the whole boundary of the mesh.
    surface : int or str, or list of these, optional
        Tag or name of the surface.
    distance : float, optional
        How far apart facets may be that are looked at together [m]: surfaces should not come nearer
        by more in a load step. By default it is ten of the longest facets, and with small strains
        the shortest edge of the facet.
    friction : Tresca or Coulomb, optional
        The law of friction; by default there is none. Its data are numbers.
    name : str
        For messages and the report.

    Examples
    --------
    >>> SelfContact(facet_tags, 3, name="bellows")  # doctest: +SKIP
    >>> SelfContact(friction=Coulomb(0.2))  # the whole boundary of the mesh  # doctest: +SKIP
    """

    default_name = "contact {} (self)"
    facet_tags: Any = None
    surface: SurfaceTags | None = None
    _: KW_ONLY
    distance: float | None = None
    friction: FrictionLaw | None = None
    name: str = ""

    def __post_init__(self) -> None:
        label = checked_label(self)
        if (self.facet_tags is None) != (self.surface is None):
            raise InputError(
                f"{label}: facet_tags and surface belong together: give the tags of facets and the "
                "tag of the surface, or neither for the whole boundary of the mesh"
            )
        if self.facet_tags is not None:
            check_tags(self, label, "surface")
        if self.distance is not None:
            check_positive(self.distance, f"{label}: the distance", "m")
        check_friction(self.friction, label)
        data = vars(self.friction).values() if self.friction is not None else ()
        if not all(map(is_number, data)):
            raise InputError(
                f"{label}: friction has data that vary over the slave, but which facets are of a "
                "slave changes: give it a number"
            )


@dataclass(frozen=True)
class Patch(ContactPair):
    """Two parts of a surface that face each other now, of a `SelfContact`."""

    # of the facets with tags: half the thickness of the wall behind each [m]
    depth: Vector = field(default_factory=lambda: np.zeros(0), compare=False)

    def depth_at(self, facets: Indices) -> Vector:
        """Return the depths (f,) of some of this rank's facets with tags [m]."""
        return self.depth[np.searchsorted(self.facet_tags.indices, facets)]


Contact: TypeAlias = ContactPair | RigidObstacle | SelfContact


@dataclass(frozen=True)
class Deformed:
    """Contact conditions that are corrected until the deformed surfaces touch.

    Each pass solves with the normals and gaps of the surfaces that the last one has deformed.

    Attributes
    ----------
    tolerance : float
        Penetration and separation of the deformed surfaces that count as none, relative to the
        largest displacement; also the angle between contact forces and deformed normals, and forces
        that leave rigid bodies out of balance or break the law of friction, relative to all.
    max_passes : int
        Limit on the number of passes.

    Examples
    --------
    >>> Deformed(tolerance=1e-4)
    Deformed(tolerance=0.0001, max_passes=20)
    """

    tolerance: float = 1e-3
    max_passes: int = 20

    def __post_init__(self) -> None:
        check_positive(self.tolerance, "Deformed: the tolerance", "the largest displacement")
        count = self.max_passes
        check_value(
            is_integer(count) and count > 0, "Deformed: max_passes", count, "a positive integer"
        )

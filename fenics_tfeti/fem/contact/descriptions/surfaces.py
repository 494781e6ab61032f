"""Names and tags of surfaces, which all descriptions have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from itertools import count
from typing import Any, TypeAlias

from fenics_tfeti.errors import InputError, check_value, wrong_type
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.topology import Tag, each_tag, tag_names
from fenics_tfeti.fem.user_data import is_integer

# a tag or a name, or several
SurfaceTags: TypeAlias = int | str | Sequence[int | str]


@dataclass(frozen=True)
class SurfacePair:
    """Two tagged surfaces."""

    # where both are one
    remedy = "fenics_tfeti.io.split_interfaces makes two of one inside a body"
    facet_tags: Any
    slave: SurfaceTags
    master: SurfaceTags
    _: KW_ONLY
    name: str = ""

    def __post_init__(self) -> None:
        label = checked_label(self)
        check_tags(self, label, "slave", "master")
        slave, master = (each_tag(tag) for tag in surface_tags(self))
        if both := [tag for tag in slave if tag in master]:
            raise InputError(
                f"{label}: slave and master have the same tag {both[0]}; each surface needs one of "
                f"its own. {self.remedy}"
            )


def surface_tags(contact: Any) -> list[Tag]:
    """Return the tag, or tags, of each surface of the mesh: the slave's, and a master's if any."""
    tags = (getattr(contact, role, None) for role in ("slave", "master", "surface"))
    return [tag for tag in tags if tag is not None]


def contact_name(contact: Any, number: int) -> str:
    """Return the name of a contact or tie, by default from its number and kind."""
    return contact.name or contact.default_name.format(number)


def surface_key(facet_tags: Any, tag: Tag) -> tuple[int, Tag]:
    """Return what tells the surfaces of the contacts in a list apart.

    Several objects of Python may stand for the same tags.
    """
    return id(_compat.cpp_object(facet_tags)), tag


def contact_keys(contacts: Sequence[Any], known: Sequence[tuple[Any, str]] = ()) -> list[str]:
    """Return by which keys the contacts of a list are known from step to step, and in files.

    A known contact keeps its key, a new one takes the first free key of its kind and name, without
    a name of its kind and surfaces: in place of another one it is known as that one.

    Examples
    --------
    >>> from fenics_tfeti import Plane, RigidObstacle
    >>> tags = dolfinx.mesh.meshtags(mesh, 1, facets, values)  # doctest: +SKIP
    >>> contact_keys([RigidObstacle(tags, 7, Plane((0, 0), (0, 1)))])  # doctest: +SKIP
    ['RigidObstacle of the surface 7']
    """
    kept = {id(contact): key for contact, key in known}
    keys = [kept.pop(id(contact), "") for contact in contacts]
    for k, contact in enumerate(contacts):
        keys[k] = keys[k] or free_key(_label(contact), keys)
    return keys


def free_key(label: str, taken: Sequence[str]) -> str:
    """Return a label, with a number after it if it is taken."""
    numbered = (label if n == 1 else f"{label} ({n})" for n in count(1))
    return next(key for key in numbered if key not in taken)


def _label(contact: Any) -> str:
    kind, body = type(contact).__name__, getattr(contact, "rigid_body", None)
    if contact.name:
        return f"{kind} {contact.name!r}"
    tags = " and ".join(map(str, surface_tags(contact))) or "of the mesh"
    at_body = f" at {body.name!r}" if body is not None and body.name else ""
    return f"{kind} of the surface {tags}{at_body}"


def checked_label(contact: Any) -> str:
    """Return how messages call what has no number yet; check that its name is a text."""
    kind, name = type(contact).__name__, contact.name
    check_value(isinstance(name, str), f"{kind}: name", name, "a text")
    return name or kind


def check_tags(contact: Any, label: str, *roles: str) -> None:
    """Check tags of facets, and those of each role; names become the tags they stand for."""
    facet_tags = contact.facet_tags
    if not (hasattr(facet_tags, "find") and hasattr(facet_tags, "dim")):
        expected = "a MeshTags of facets, as returned by dolfinx.mesh.meshtags,"
        raise wrong_type(f"{label}: facet_tags", facet_tags, expected)
    tags = {name: tag for tag, name in tag_names(facet_tags).items()}
    for role in roles:
        given = getattr(contact, role)
        several = given if isinstance(given, list | tuple) and given else [given]
        numbers = [tags.get(tag, tag) if isinstance(tag, str) else tag for tag in several]
        for tag in numbers:
            if not is_integer(tag):
                raise InputError(
                    f"{label}: the tag of the {role} is {tag!r}; an integer is expected, one of "
                    "the values of facet_tags, or a name that they carry. "
                    f"{_remedy(tag, sorted(tags))}"
                )
        distinct = tuple(sorted(set(map(int, numbers))))
        object.__setattr__(contact, role, distinct if len(distinct) > 1 else distinct[0])


def _remedy(tag: Any, names: Sequence[str]) -> str:
    """Return what to give in place of a tag; `names` are all names."""
    if not isinstance(tag, str):
        return "A list stands for several tags"
    if not names:
        return "These facet_tags carry no names; those of read_msh and split_interfaces do"
    return f"The names are {', '.join(map(repr, names))}"

"""Names and tags of surfaces, which all descriptions have."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Any

from fenics_tfeti.errors import InputError, check_value, wrong_type
from fenics_tfeti.fem.user_data import is_integer


@dataclass(frozen=True)
class SurfacePair:
    """Two tagged surfaces."""

    # where both are one
    remedy = "fenics_tfeti.io.split_interfaces makes two of one inside a body"
    facet_tags: Any
    slave: int
    master: int
    _: KW_ONLY
    name: str = ""

    def __post_init__(self) -> None:
        label = checked_label(self)
        check_tags(self, label, "slave", "master")
        if self.slave == self.master:
            raise InputError(
                f"{label}: slave and master have the same tag {self.slave}; each surface needs one "
                f"of its own. {self.remedy}"
            )


def surface_tags(contact: Any) -> list[int]:
    """Return the tags of the surfaces of the mesh: the slave's, and that of a master if any."""
    return [getattr(contact, role) for role in ("slave", "master") if hasattr(contact, role)]


def contact_name(contact: Any, number: int) -> str:
    """Return the name of a contact or tie, by default from its number and kind."""
    return contact.name or contact.default_name.format(number)


def checked_label(contact: Any) -> str:
    """Return how messages call what has no number yet; check that its name is a text."""
    kind, name = type(contact).__name__, contact.name
    check_value(isinstance(name, str), f"{kind}: name", name, "a text")
    return name or kind


def check_tags(contact: Any, label: str, *roles: str) -> None:
    """Check tags of facets, and the tag of each role."""
    facet_tags = contact.facet_tags
    if not (hasattr(facet_tags, "find") and hasattr(facet_tags, "dim")):
        expected = "a MeshTags of facets, as returned by dolfinx.mesh.meshtags,"
        raise wrong_type(f"{label}: facet_tags", facet_tags, expected)
    for role in roles:
        tag = getattr(contact, role)
        if not is_integer(tag):
            raise InputError(
                f"{label}: the tag of the {role} is {tag!r}; an integer is expected, one of the "
                "values of facet_tags. Surfaces have numbers, not names; to use several tags, "
                "join them under one"
            )

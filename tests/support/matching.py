"""Conditions of contacts that are searched alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fenics_tfeti.fem.contact.conditions.conditions import ContactPairing
from fenics_tfeti.fem.contact.search.contact_search import match_parts
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary


def match_contacts(
    boundary: MeshBoundary, contacts: Sequence[Any], *arguments: Any, **keywords: Any
) -> list[ContactPairing]:
    """Return all parts of the contacts, one after the other. Collective."""
    matched = match_parts(boundary, contacts, *arguments, **keywords)
    return [pairing for parts in matched for pairing in parts]

"""Conditions of contacts that are searched alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fenics_tfeti.fem.contact.conditions.contact_conditions import ContactConditions
from fenics_tfeti.fem.contact.search.contact_search import match_parts
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary


def match_contacts(
    boundary: MeshBoundary, contacts: Sequence[Any], *arguments: Any, **keywords: Any
) -> list[ContactConditions]:
    """Return all parts of the contacts, one after the other. Collective."""
    matched = match_parts(boundary, contacts, *arguments, **keywords)
    return [conditions for parts in matched for conditions in parts]

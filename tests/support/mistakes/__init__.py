"""Mistakes that a user may make, by subject, and what the error has to say about each."""

from __future__ import annotations

from mistakes import arguments, bodies, contacts, forms, meshes, pairing, supports
from mistakes.catalogue import MISTAKES, Mistake

__all__ = [
    "MISTAKES",
    "Mistake",
    "arguments",
    "bodies",
    "contacts",
    "forms",
    "meshes",
    "pairing",
    "supports",
]

"""Mistakes that a user may make, by subject, and what the error has to say about each."""

from __future__ import annotations

from mistakes import arguments, contacts, forms, meshes, pairing, supports
from mistakes.catalogue import MISTAKES, Mistake

__all__ = ["MISTAKES", "Mistake", "arguments", "contacts", "forms", "meshes", "pairing", "supports"]

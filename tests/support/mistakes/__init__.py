"""Mistakes that a user may make, by subject."""

from mistakes import arguments, bodies, contacts, forms, meshes, pairing, supports

# in the order of the page of errors
MISTAKES = [
    mistake
    for part in (forms, supports, meshes, contacts, pairing, bodies, arguments)
    for mistake in part.MISTAKES
]

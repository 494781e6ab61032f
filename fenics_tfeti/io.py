"""Mesh files, structured meshes, files of fields, pictures: the public names of `fem.io`.

Importing this module imports dolfinx.
"""

from fenics_tfeti.fem.io import (
    Box,
    TaggedMesh,
    boxes,
    contact_fields,
    displacement_space,
    draw_deformed,
    draw_profile,
    read_msh,
    tag_facets,
    von_mises,
    write_fields,
)

__all__ = [
    "Box",
    "TaggedMesh",
    "boxes",
    "contact_fields",
    "displacement_space",
    "draw_deformed",
    "draw_profile",
    "read_msh",
    "tag_facets",
    "von_mises",
    "write_fields",
]

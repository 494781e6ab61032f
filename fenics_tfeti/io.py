"""Mesh files, structured meshes, files of fields, pictures: the public names of `fem.io`.

Importing this module imports dolfinx.
"""

from fenics_tfeti.fem.io import (
    Box,
    Interface,
    TaggedMesh,
    boxes,
    contact_fields,
    displacement_space,
    draw_deformed,
    draw_profile,
    piecewise_constant,
    progress,
    read_msh,
    split_interfaces,
    tag_facets,
    von_mises,
    write_fields,
)

__all__ = [
    "Box",
    "Interface",
    "TaggedMesh",
    "boxes",
    "contact_fields",
    "displacement_space",
    "draw_deformed",
    "draw_profile",
    "piecewise_constant",
    "progress",
    "read_msh",
    "split_interfaces",
    "tag_facets",
    "von_mises",
    "write_fields",
]

"""Mesh files, structured meshes, files of fields, pictures: the public names of `fem.io`.

Importing this module imports dolfinx.
"""

from fenics_tfeti.fem.io.fields import (
    BondFields,
    ContactFields,
    FrictionFields,
    contact_fields,
    displacement_space,
    piecewise_constant,
    von_mises,
    write_fields,
)
from fenics_tfeti.fem.io.gmsh import read_msh
from fenics_tfeti.fem.io.interfaces import Interface, split_interfaces
from fenics_tfeti.fem.io.mesh_files import read_mesh
from fenics_tfeti.fem.io.pictures import draw_deformed, draw_profile, write_gif
from fenics_tfeti.fem.io.refinement import refine, set_mesh_sizes
from fenics_tfeti.fem.io.structured import Box, boxes, tag_facets
from fenics_tfeti.fem.io.tagged_mesh import TaggedMesh

__all__ = [
    "BondFields",
    "Box",
    "ContactFields",
    "FrictionFields",
    "Interface",
    "TaggedMesh",
    "boxes",
    "contact_fields",
    "displacement_space",
    "draw_deformed",
    "draw_profile",
    "piecewise_constant",
    "read_mesh",
    "read_msh",
    "refine",
    "set_mesh_sizes",
    "split_interfaces",
    "tag_facets",
    "von_mises",
    "write_fields",
    "write_gif",
]

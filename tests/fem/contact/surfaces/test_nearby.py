"""The part of a surface near another one: on one rank all of it; tests/mpi/test_nearby.py."""

from __future__ import annotations

import numpy as np
from mortar_blocks import LOWER, UPPER, Blocks
from scenes import vector_space

from fenics_tfeti.fem.contact.surfaces.gathered import gather_surface
from fenics_tfeti.fem.contact.surfaces.nearby import gather_nearby
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.io import tag_facets


def test_all_of_it_on_one_rank():
    shape = Blocks("triangle", 3, 4)
    beams = shape.mesh()
    tags = tag_facets(beams.mesh, shape.markers(), beams.cell_tags)
    V = vector_space(beams.mesh)
    boundary = MeshBoundary.of(V)
    near = gather_nearby(boundary, tags, UPPER, LOWER, np.arange(0))
    whole = gather_surface(boundary, tags, UPPER)
    for name in ("nodes", "points", "displacement", "facets"):
        np.testing.assert_array_equal(getattr(near, name), getattr(whole, name))

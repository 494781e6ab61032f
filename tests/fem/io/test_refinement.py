"""Refined meshes: conforming, with all tags, on any number of ranks."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scenes import at, dimension, integral

from dolfinx.mesh import meshtags

from fenics_tfeti import InputError
from fenics_tfeti.fem.topology import cell_vertices, exterior_facets, owned_cells
from fenics_tfeti.io import Box, TaggedMesh, boxes, refine, tag_facets

COMM = MPI.COMM_WORLD


def two_boxes(cell: str) -> TaggedMesh:
    """Return two boxes of different cells, with tags of some of their sides."""
    gdim = dimension(cell)
    low, high = [0.0] * gdim, [1.0] * gdim
    above = [*[0.0] * (gdim - 1), 1.0], [*[1.0] * (gdim - 1), 2.5]
    parts = [Box(low, high, [2] * gdim, "base"), Box(*above, [3] * gdim, "block")]
    tagged = boxes(COMM, parts, cell)
    marks = [(11, at(0, 0.0)), (12, at(gdim - 1, 1.0), 1), (13, at(gdim - 1, 1.0), 2)]
    tags = tag_facets(tagged.mesh, marks, tagged.cell_tags)
    return TaggedMesh(tagged.mesh, tagged.cell_tags, tags, tagged.names)


def measures(tagged: TaggedMesh) -> list[float]:
    """Return the volumes of the bodies and the areas of the tagged surfaces."""
    volumes = [integral(tagged.mesh, tagged.cell_tags, tag, "dx") for tag in (1, 2)]
    return volumes + [integral(tagged.mesh, tagged.facet_tags, tag) for tag in (11, 12, 13)]


def count(tagged: TaggedMesh) -> int:
    return COMM.allreduce(owned_cells(tagged.mesh))


def near_corner(tagged: TaggedMesh) -> np.ndarray:
    """Return the cells around the origin that this rank owns."""
    mesh = tagged.mesh
    x = mesh.geometry.x[cell_vertices(mesh)[: owned_cells(mesh)]]
    return np.flatnonzero((np.abs(x) < 1e-9).all(axis=2).any(axis=1))


@pytest.mark.ranks(1, 2, 3)
@pytest.mark.parametrize("cell", ("triangle", "tetrahedron"))
def test_tags_and_sizes_are_kept(cell):
    """A facet that did not conform would be on the boundary, and twice."""
    tagged = two_boxes(cell)
    before, surface = measures(tagged), boundary(tagged)
    for _ in range(3):
        finer = refine(tagged, near_corner(tagged))
        assert count(finer) > count(tagged)
        tagged = finer
        assert measures(tagged) == pytest.approx(before, rel=1e-12)
        assert boundary(tagged) == pytest.approx(surface, rel=1e-12)
    assert tagged.names == {"base": 1, "block": 2}


def boundary(tagged: TaggedMesh) -> float:
    """Return the area of all facets on the boundary."""
    mesh = tagged.mesh
    facets = np.flatnonzero(exterior_facets(mesh)).astype(np.int32)
    tags = meshtags(mesh, mesh.topology.dim - 1, facets, np.ones(facets.size, dtype=np.int32))
    return integral(mesh, tags, 1)


@pytest.mark.parametrize(("cell", "parts"), [("triangle", 4), ("tetrahedron", 8)])
def test_all_cells(cell, parts):
    tagged = two_boxes(cell)
    assert count(refine(tagged)) == parts * count(tagged)


@pytest.mark.parametrize("cell", ("triangle", "tetrahedron"))
def test_angles_are_bounded(cell):
    """Of cells that are refined at the same place again and again."""
    tagged = two_boxes(cell)
    worst = quality(tagged)
    for _ in range(6):
        tagged = refine(tagged, near_corner(tagged))
    assert quality(tagged) > 0.3 * worst


def quality(tagged: TaggedMesh) -> float:
    """Return the least volume of a cell, relative to the cube of its longest edge."""
    mesh = tagged.mesh
    gdim = mesh.geometry.dim
    x = mesh.geometry.x[cell_vertices(mesh)][..., :gdim]
    volume = np.abs(np.linalg.det(x[:, 1:] - x[:, :1]))
    longest = np.linalg.norm(x[:, :, None] - x[:, None], axis=3).max(axis=(1, 2))
    return float((volume / longest**gdim).min())


def test_quadrilaterals_are_told():
    with pytest.raises(InputError, match=r"refine: quadrilaterals cannot be refined.*sizes\(\)"):
        refine(two_boxes("quadrilateral"))


def test_numbers_of_cells_are_checked():
    with pytest.raises(InputError, match="refine: cells are numbers from 0 to 25"):
        refine(two_boxes("triangle"), np.array([26]))

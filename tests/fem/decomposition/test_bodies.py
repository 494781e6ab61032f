"""Bodies are the connected parts of the mesh, told apart by cell tags."""

from mpi4py import MPI

import numpy as np
import pytest
from mesh_arrays import grid, mesh_of, tags_of
from scenes import CELLS, dimension

from dolfinx.mesh import meshtags

from fenics_tfeti import InputError
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.io import Box, boxes

COMM = MPI.COMM_SELF


def two_boxes(cell):
    gdim = dimension(cell)
    low, high, up = np.zeros(gdim), np.ones(gdim), np.eye(gdim)[-1]
    parts = [Box(low, high, (2,) * gdim), Box(low + up, high + up, (2,) * gdim)]
    return boxes(COMM, parts, cell)


@pytest.mark.parametrize("cell", CELLS)
def test_boxes_that_touch_are_two_bodies(cell):
    tagged = two_boxes(cell)
    bodies = find_bodies(tagged.mesh, None)
    boxes_of_bodies = set(zip(bodies.of_cell, tagged.cell_tags.values, strict=True))
    assert len(boxes_of_bodies) == len(bodies.names) == 2


def test_untagged_bodies_have_no_tags():
    assert find_bodies(two_boxes("triangle").mesh, None).tags is None


def strip_of_tags(values):
    """Return the bodies of a strip of cells with these tags."""
    points, cells = grid((len(values), 1))
    domain = mesh_of(COMM, "quadrilateral", points, cells)
    return find_bodies(domain, tags_of(domain, values))


def test_tags_divide_a_connected_mesh():
    bodies = strip_of_tags([7, 7, 3, 3, 3])
    assert bodies.tags.tolist() == [3, 7]
    assert np.bincount(bodies.of_cell).tolist() == [3, 2]


def test_tag_on_two_pieces_gives_two_bodies():
    assert strip_of_tags([1, 2, 1]).tags.tolist() == [1, 1, 2]


def test_bodies_of_one_connected_part_know_it():
    assert np.unique(strip_of_tags([1, 2, 1]).part).size == 1


def test_names_have_tag_and_bounding_box():
    assert strip_of_tags([4, 4, 9]).names == [
        "body 0 (cell tag 4) in [0, 2] x [0, 1]",
        "body 1 (cell tag 9) in [2, 3] x [0, 1]",
    ]


def test_bounding_boxes_have_no_rounding_of_coordinates():
    points, cells = grid((2, 1))
    bodies = find_bodies(mesh_of(COMM, "quadrilateral", points - 1e-15, cells), None)
    assert bodies.names == ["body 0 in [0, 2] x [0, 1]"]


def test_names_of_tags_are_those_of_bodies():
    """Where a tag has one, in place of the tag."""
    parts = boxes(
        COMM, [Box((0, 0), (1, 1), (2, 2), "pin"), Box((0, 1), (1, 2), (2, 2))], "triangle"
    )
    assert find_bodies(parts.mesh, parts.cell_tags).labels == [
        "body 0 (pin)",
        "body 1 (cell tag 2)",
    ]


def test_facet_tags_are_refused():
    domain = two_boxes("triangle").mesh
    facets = meshtags(domain, 1, np.arange(3, dtype=np.int32), np.ones(3, dtype=np.int32))
    with pytest.raises(InputError, match="were the facet tags passed"):
        find_bodies(domain, facets)

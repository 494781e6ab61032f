"""Structured meshes of boxes and tags of their facets."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import CELLS, dimension, integral

import dolfinx
import ufl

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.io import Box, boxes, tag_facets

CELLS_PER_BLOCK = {"triangle": 2, "quadrilateral": 1, "tetrahedron": 6, "hexahedron": 1}


def two_boxes(cell, comm=MPI.COMM_WORLD):
    """Return a box of length 2, and another on the right half of its top; the height is last."""
    if dimension(cell) == 3:
        parts = [Box((0, 0, 0), (2, 1, 1), (4, 3, 2)), Box((1, 0, 1), (3, 1, 2), (4, 3, 2))]
    else:
        parts = [Box((0, 0), (2, 1), (4, 3)), Box((1, 1), (3, 2), (4, 3))]
    return boxes(comm, parts, cell)


@pytest.mark.ranks
@pytest.mark.parametrize("cell", CELLS)
def test_cells_of_boxes(cell):
    """Boxes that touch share no node, and cells are not twisted."""
    pair = two_boxes(cell)
    mesh = pair.mesh
    layers = 2 if dimension(cell) == 3 else 0
    assert mesh.topology.index_map(0).size_global == 2 * 5 * 4 * (layers + 1)
    cells = 4 * 3 * max(layers, 1) * CELLS_PER_BLOCK[cell]
    owned = np.arange(mesh.topology.index_map(dimension(cell)).size_local)
    own = [np.isin(pair.cell_tags.find(k), owned).sum() for k in (1, 2)]
    assert mesh.comm.allreduce(np.array(own)).tolist() == [cells, cells]
    assert [integral(mesh, pair.cell_tags, k, "dx") for k in (1, 2)] == pytest.approx([2, 2])
    det_squared = dolfinx.fem.form(ufl.JacobianDeterminant(mesh) ** 2 * ufl.dx)
    mean_square = mesh.comm.allreduce(dolfinx.fem.assemble_scalar(det_squared)) / 4
    # All cells are affine and of one size; in a wrong vertex order the determinant would vary.
    reference_volume = {"triangle": 1 / 2, "tetrahedron": 1 / 6}.get(cell, 1)
    assert mean_square == pytest.approx((2 / cells / reference_volume) ** 2)


@pytest.mark.ranks
def test_each_rank_makes_an_equal_share_of_cells_and_points(monkeypatch):
    counts, make = [], _compat.distributed_mesh

    def counted(comm, cells, points, *cell):
        counts.extend(comm.allgather((len(cells), len(points))))
        return make(comm, cells, points, *cell)

    monkeypatch.setattr(_compat, "distributed_mesh", counted)
    two_boxes("triangle")
    assert np.sum(counts, axis=0).tolist() == [48, 40]
    assert np.ptp(counts, axis=0).max() <= 1


def test_names_are_those_of_the_boxes():
    parts = [Box((0, 0), (1, 1), (1, 1)), Box((0, 1), (1, 2), (1, 1), name="punch")]
    assert boxes(MPI.COMM_SELF, parts, "triangle").names == {"punch": 2}


@pytest.mark.parametrize(
    ("part", "cell", "message"),
    [
        (Box((0, 0), (1, 1), (1, 1)), "hexahedron", "needs 3"),
        (Box((0, 0, 0), (1, 1, 1), (1, 1)), "hexahedron", "needs 3"),
        (Box((0, 0), (1, 0), (1, 1)), "triangle", "is empty"),
        (Box((0, 0), (1, 1), (1, 0)), "triangle", "at least 1"),
        (Box((0, 0), (1, 1), (1, 1)), "prism", "unknown cell"),
    ],
)
def test_wrong_box_is_refused(part, cell, message):
    with pytest.raises(InputError, match=message):
        boxes(MPI.COMM_SELF, [part], cell)


def test_two_boxes_of_one_name_are_refused():
    part = Box((0, 0), (1, 1), (1, 1), name="block")
    with pytest.raises(InputError, match="two boxes have the same name.*'block'"):
        boxes(MPI.COMM_SELF, [part, part], "triangle")


def test_no_box_is_refused():
    with pytest.raises(InputError, match="at least one box"):
        boxes(MPI.COMM_SELF, [])


@pytest.mark.ranks
@pytest.mark.parametrize("cell", CELLS)
def test_tagged_facets_have_the_area_of_the_marked_part(cell):
    pair = two_boxes(cell)
    height = dimension(cell) - 1
    tags = tag_facets(
        pair.mesh,
        [
            (5, lambda x: np.isclose(x[height], 1), 2),
            (6, lambda x: np.isclose(x[height], 1) & (x[0] > 1 - 1e-9), 1),
            (9, lambda x: np.isclose(x[0], 0)),
        ],
        pair.cell_tags,
    )
    assert [integral(pair.mesh, tags, tag) for tag in (5, 6, 9)] == pytest.approx([2, 1, 1])


def test_markers_can_be_a_dict():
    mesh = two_boxes("triangle").mesh
    tags = tag_facets(mesh, {3: lambda x: np.isclose(x[0], 0)})
    assert len(tags.find(3)) == 3


def test_tag_can_have_several_markers():
    mesh = two_boxes("triangle").mesh
    right = lambda x: np.isclose(x[0], 3)  # noqa: E731
    assert len(tag_facets(mesh, [(3, left), (3, right), (3, left)]).find(3)) == 6


def test_facets_inside_a_body_are_not_tagged():
    mesh = boxes(MPI.COMM_SELF, [Box((0, 0), (2, 1), (2, 1))], "quadrilateral").mesh
    assert len(tag_facets(mesh, {1: lambda x: x[0] > -1}).indices) == 6


def left(x):
    return np.isclose(x[0], 0)


def fails(x):
    """Be wrong on one rank."""
    return x[7] if MPI.COMM_WORLD.rank == MPI.COMM_WORLD.size - 1 else left(x)


@pytest.mark.ranks
@pytest.mark.parametrize(
    ("markers", "message"),
    [
        ({3: left, 8: lambda x: x[0] > 99}, r"no facet .* tags \[8\]"),
        ({3: left, 8: lambda x: x[0] < 1.1}, "several tags, 3 and 8"),
        ([(3, left, 1)], "pass the cell_tags"),
        ({3: fails}, "marker of facet tag 3 failed"),
        ({3: lambda x: True}, "marker of facet tag 3"),
        ({3: lambda x: x > 0}, "marker of facet tag 3"),
    ],
    ids=["none", "two", "body", "fails", "one", "shape"],
)
def test_markers_that_are_refused(markers, message):
    with pytest.raises(InputError, match=message):
        tag_facets(two_boxes("triangle").mesh, markers)

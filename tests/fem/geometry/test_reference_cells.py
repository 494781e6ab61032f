"""Reference cells against the geometry and the elements of basix."""

from itertools import pairwise

import numpy as np
import pytest

import basix

from fenics_tfeti.fem.geometry.reference_cells import MESH_CELLS, reference_cell

ALL = ("interval", *MESH_CELLS)
every_cell = pytest.mark.parametrize("name", ALL)
mesh_cell = pytest.mark.parametrize("name", MESH_CELLS)


def basix_cell(name):
    return getattr(basix.CellType, name)


def vertices_of(name):
    return basix.geometry(basix_cell(name))


@every_cell
def test_number_of_vertices_and_dimension(name):
    cell = reference_cell(name)
    assert vertices_of(name).shape == (cell.vertices, cell.dim)


def points_of_degree_2(name):
    """Return the nodes of the element of degree 2: the midpoints of vertices, edges, ..."""
    element = basix.create_element(
        basix.ElementFamily.P, basix_cell(name), 2, basix.LagrangeVariant.gll_warped
    )
    return element.points


@mesh_cell
def test_number_of_nodes_is_that_of_basix(name):
    cell = reference_cell(name)
    assert cell.nodes(1) == cell.vertices
    assert cell.nodes(2) == len(points_of_degree_2(name))


@mesh_cell
def test_nodes_of_facets_are_their_corners_and_what_is_between_them(name):
    x, cell = points_of_degree_2(name), reference_cell(name)
    for linear, nodes, facet in zip(
        cell.facet_nodes(1), cell.facet_nodes(2), cell.facets, strict=True
    ):
        v = len(linear)
        assert nodes[:v] == linear
        assert sorted(linear) == sorted(facet)
        corners = x[list(linear)]
        between = [(corners[k] + corners[(k + 1) % v]) / 2 for k in range(v if v > 2 else 1)]
        if v == 4:
            between.append(corners.mean(axis=0))
        np.testing.assert_allclose(x[list(nodes[v:])], between, atol=1e-15)


@mesh_cell
def test_facets_have_the_vertices_of_their_type(name):
    cell = reference_cell(name)
    assert {len(facet) for facet in cell.facets} == {cell.facet.vertices}
    assert cell.facet.dim == cell.dim - 1


@pytest.mark.parametrize("name", ["triangle", "quadrilateral"])
def test_vertices_go_anticlockwise_around_a_cell(name):
    x = vertices_of(name)[list(reference_cell(name).cycle)]
    around = np.concatenate([x, x[:1]])
    area = 0.5 * sum(a[0] * b[1] - a[1] * b[0] for a, b in pairwise(around))
    assert area == pytest.approx(0.5 if name == "triangle" else 1.0)


@pytest.mark.parametrize("name", ["triangle", "quadrilateral"])
def test_nodes_around_a_cell_are_those_of_a_facet(name):
    x, cell = points_of_degree_2(name), reference_cell(name)
    places = {
        "triangle": [(0, 0), (1, 0), (0, 1), (0.5, 0), (0.5, 0.5), (0, 0.5)],
        "quadrilateral": [
            *((0, 0), (1, 0), (1, 1), (0, 1)),
            *((0.5, 0), (1, 0.5), (0.5, 1), (0, 0.5), (0.5, 0.5)),
        ],
    }[name]
    np.testing.assert_allclose(x[list(cell.around(2))], places, atol=1e-15)
    assert cell.around(1) == cell.cycle


@every_cell
def test_cut_of_a_block_has_its_volume(name):
    """Cells of equal volumes; for tensor cells the block itself."""
    cell = reference_cell(name)
    corners = (np.arange(2**cell.dim)[:, None] >> np.arange(cell.dim)) & 1
    axes = sorted(b for a, b in cell.edges if a == 0)
    factorial = {1: 1, 2: 2, 3: 6}[cell.dim] if cell.is_simplex else 1
    volumes = [
        abs(np.linalg.det(corners[list(piece)][axes] - corners[piece[0]]))
        for piece in cell.grid_cut
    ]
    assert sum(volumes) / factorial == pytest.approx(1.0)
    assert min(volumes) > 0.0


@pytest.mark.parametrize("name", ["triangle", "tetrahedron"])
def test_simplices_of_a_block_share_the_long_diagonal(name):
    cell = reference_cell(name)
    assert all({0, 2**cell.dim - 1} <= set(piece) for piece in cell.grid_cut)


@pytest.mark.parametrize(
    ("name", "simplex"),
    [("triangle", True), ("quadrilateral", False), ("tetrahedron", True), ("hexahedron", False)],
)
def test_simplices(name, simplex):
    assert reference_cell(name).is_simplex is simplex

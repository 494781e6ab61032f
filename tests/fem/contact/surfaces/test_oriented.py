"""Facets oriented outwards, with their nodes one after the other around them."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import at, dimension

from fenics_tfeti.fem.contact.surfaces.oriented import oriented_facets, owned_facets
from fenics_tfeti.fem.geometry.normals import corner_normals, facet_normals
from fenics_tfeti.fem.topology import cell_type, exterior_facets
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets

CELLS = ["triangle", "quadrilateral", "tetrahedron", "hexahedron"]


def surface(cell, degree):
    """Return the coordinates (f, t, gdim) of the nodes of a distorted block's facets."""
    d = dimension(cell)
    domain = boxes(MPI.COMM_SELF, [Box((0.0,) * d, (2.0,) * d, (2,) * d)], cell).mesh
    domain.geometry.x[:, :d] += 0.1 * np.sin(7.0 * domain.geometry.x[:, :d][:, ::-1])
    space = displacement_space(domain, degree)
    facets = oriented_facets(space, np.flatnonzero(exterior_facets(domain)).astype(np.int32))
    return space.tabulate_dof_coordinates()[facets][..., :d], cell_type(domain).facet.vertices


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", CELLS)
def test_facets_of_a_body_point_outwards_and_close_it(cell, degree):
    x, v = surface(cell, degree)
    area = corner_normals(x[:, :v])
    outward = x[:, :v].mean(axis=1) - 1.0
    assert (np.sum(area.sum(axis=1) * outward, axis=1) > 0.0).all()
    np.testing.assert_allclose(area.sum(axis=(0, 1)), 0.0, atol=1e-13)


def test_owned_facets_have_the_tag_and_ascend():
    domain = boxes(MPI.COMM_SELF, [Box((0.0, 0.0), (1.0, 1.0), (3, 3))], "triangle").mesh
    tags = tag_facets(domain, {4: at(0, 0.0), 7: at(1, 1.0)})
    found = owned_facets(domain, tags, 7)
    np.testing.assert_array_equal(found, np.sort(tags.find(7)))
    assert found.size == 3
    assert owned_facets(domain, tags, 5).size == 0


@pytest.mark.parametrize("cell", CELLS)
def test_nodes_of_degree_2_are_between_the_corners(cell):
    x, v = surface(cell, 2)
    for k in range(v if v > 2 else 1):
        np.testing.assert_allclose(x[:, v + k], (x[:, k] + x[:, (k + 1) % v]) / 2, atol=1e-14)
    if v == 4:
        np.testing.assert_allclose(x[:, 8], x[:, :4].mean(axis=1), atol=1e-14)


@pytest.mark.parametrize("cell", CELLS)
def test_corner_normals_add_up_to_that_of_the_facet(cell):
    x, _ = surface(cell, 1)
    np.testing.assert_allclose(facet_normals(x), corner_normals(x).sum(axis=1), atol=1e-14)


@pytest.mark.parametrize("cell", CELLS)
def test_normals_along_an_axis_have_no_traces_of_rounding(cell):
    """Which would be entries of the constraints, three in place of one for each node."""
    x, _ = surface(cell, 1)
    x[..., 0] = 0.1
    assert not corner_normals(x)[..., 1:].any()


def test_corner_normals_of_a_warped_quadrilateral_are_exact():
    corners = np.array([[0.0, 0, 0], [1.2, 0, 0.3], [1.0, 1.1, -0.2], [-0.1, 0.9, 0.4]])
    points, weights = np.polynomial.legendre.leggauss(4)
    expected = np.zeros((4, 3))
    for r, wr in zip(0.5 + 0.5 * points, 0.5 * weights, strict=True):
        for s, ws in zip(0.5 + 0.5 * points, 0.5 * weights, strict=True):
            N = np.array([(1 - r) * (1 - s), r * (1 - s), r * s, (1 - r) * s])
            along_r = np.array([-(1 - s), 1 - s, s, -s]) @ corners
            along_s = np.array([-(1 - r), -r, r, 1 - r]) @ corners
            expected += wr * ws * N[:, None] * np.cross(along_r, along_s)
    np.testing.assert_allclose(corner_normals(corners[None])[0], expected, atol=1e-14)

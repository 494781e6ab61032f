"""Sound meshes pass all checks, whatever their shape, size and place."""

from mpi4py import MPI

import numpy as np
import pytest
from mesh_arrays import block, check_arrays, concatenated, grid, mesh_of, slit, tags_of
from scenes import CELLS

from dolfinx.mesh import CellType, create_unit_cube, create_unit_square

from fenics_tfeti import InputError
from fenics_tfeti.fem.checks.mesh import check_mesh
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.io import Box, boxes

COMM = MPI.COMM_WORLD

by_cell = pytest.mark.parametrize("cell", CELLS)


@pytest.mark.parametrize("name", CELLS)
def test_meshes_of_dolfinx(name):
    kind, comm = getattr(CellType, name), MPI.COMM_SELF
    dim = 3 if "hedron" in name else 2
    create = create_unit_cube if dim == 3 else create_unit_square
    domain = create(comm, *(3,) * dim, kind)
    check_mesh(domain, find_bodies(domain, None), [])


@by_cell
@pytest.mark.parametrize(
    "change",
    [
        lambda x: 1e-9 * x,
        lambda x: 1e9 * x,
        lambda x: x + 1e6,
        lambda x: -x,
        lambda x: x * [1.0, 1e-5, 1.0][: x.shape[1]],
        lambda x: x * [1.0, 2e-5, 2e-5][: x.shape[1]],
        lambda x: x + np.random.default_rng(0).uniform(-0.15, 0.15, x.shape),
        lambda x: x + 1.5 * np.sin(x[:, ::-1] / 2.0),
    ],
    ids=["small", "large", "far away", "mirrored", "plate", "rod", "irregular", "bent"],
)
def test_changes_of_coordinates(cell, change):
    points, cells = block(cell)
    check_arrays(cell, change(points), cells)


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_any_order_of_the_vertices_of_simplices(cell):
    points, cells = block(cell)
    check_arrays(cell, points, np.random.default_rng(0).permuted(cells, axis=1))


@by_cell
def test_bodies_that_touch_may_have_nodes_at_the_same_places(cell):
    points, cells = block(cell)
    shift = 3.0 * np.eye(points.shape[1])[0]
    both = concatenated((points, cells), (points + shift, cells))
    check_arrays(cell, *both)
    check_arrays(cell, *both, tags=np.repeat([1, 2], len(cells)))


def test_tags_of_glued_bodies():
    points, cells = grid((4, 2))
    check_arrays("quadrilateral", points, cells, tags=1 + (points[cells][:, 0, 0] > 1.5))


def test_tags_that_meet_in_a_vertex_within_a_connected_mesh():
    points, cells = grid((4, 4))
    x, y = points[cells].mean(axis=1).T
    check_arrays("quadrilateral", points, cells, tags=1 + (x > 2) + 2 * (y > 2))


def test_tags_without_cells_in_between():
    points, cells = concatenated(grid((2, 2)), grid((2, 2), (5.0, 0.0)))
    check_arrays("quadrilateral", points, cells, tags=np.repeat([-3, 100], 4))


def test_body_that_is_pinched_at_a_node():
    points, cells = grid((4, 4))
    x, y = points[cells].mean(axis=1).T
    check_arrays("quadrilateral", points, cells[~((x == y) & ((x == 1.5) | (x == 2.5)))])


def test_nodes_as_near_as_a_thin_gap_are_not_at_the_same_place():
    points, cells = slit()
    points[25:, 0] += 1e-4
    check_arrays("quadrilateral", points, cells)


@pytest.mark.ranks(2)
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_boxes_that_touch_are_sound(cell):
    gdim = 3 if "hedron" in cell else 2
    low, high = np.zeros(gdim), np.ones(gdim)
    up = np.eye(gdim)[-1]
    parts = [Box(low, high, (3,) * gdim), Box(low + up, high + up, (3,) * gdim)]
    pair = boxes(COMM, parts, cell)
    check_mesh(pair.mesh, find_bodies(pair.mesh, pair.cell_tags), [])


@pytest.mark.ranks(2)
def test_tags_that_meet_in_edges_within_a_connected_mesh_are_sound():
    """Of four blocks, two meet in an edge only, but the others hold them."""
    points, cells = grid((4, 4))
    middle = points[cells].mean(axis=1)
    domain = mesh_of(COMM, "quadrilateral", points, cells)
    tags = tags_of(domain, 1 + (middle[:, 0] > 2) + 2 * (middle[:, 1] > 2))
    check_mesh(domain, find_bodies(domain, tags), [])


@pytest.mark.ranks(2)
def test_crack_is_found_wherever_its_sides_are():
    domain = mesh_of(COMM, "quadrilateral", *slit(8))
    with pytest.raises(InputError, match=r"4 pairs of nodes .*\(4, 0\)"):
        check_mesh(domain, find_bodies(domain, None), [])


@pytest.mark.ranks(2)
def test_body_that_dolfinx_tears_apart_at_a_pinched_node_is_refused():
    points, cells = grid((4, 4))
    middle = points[cells].mean(axis=1)
    holes = np.all(middle == 1.5, axis=1) | np.all(middle == 2.5, axis=1)
    domain = mesh_of(COMM, "quadrilateral", points, cells[~holes])
    bodies = find_bodies(domain, None)
    if domain.topology.index_map(0).size_global == len(points):
        check_mesh(domain, bodies, [])
        return
    with pytest.raises(InputError, match=r"several nodes of 1 node \(at \(2, 2\)\)"):
        check_mesh(domain, bodies, [])

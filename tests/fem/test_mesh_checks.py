"""Sound meshes pass, however odd; what is wrong with others is found wherever it is."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from mesh_arrays import concatenated, grid, merged, mesh_of, slit, tags_of

from dolfinx.mesh import CellType, create_unit_cube, create_unit_square

from fenics_tfeti import ContactPair, InputError
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.fem.mesh_checks import check_mesh
from fenics_tfeti.io import tag_facets

CELLS = ["triangle", "quadrilateral", "tetrahedron", "hexahedron"]
by_cell = pytest.mark.parametrize("cell", CELLS)

# Kuhn's tetrahedra of a cube
TETRAHEDRA = [(0, 1, 3, 7), (0, 1, 5, 7), (0, 2, 3, 7), (0, 2, 6, 7), (0, 4, 5, 7), (0, 4, 6, 7)]


def block(cell: str, n: int = 3):
    """Return points and cells of a square or cube of n^2 or n^3 units."""
    points, cells = grid((n,) * (3 if "hedron" in cell else 2))
    if cell == "triangle":
        cells = np.concatenate([cells[:, [0, 1, 3]], cells[:, [0, 2, 3]]])
    if cell == "tetrahedron":
        cells = np.concatenate([cells[:, corners] for corners in TETRAHEDRA])
    return points, cells


def check(cell, points, cells, tags=None, contacts=()):
    domain = mesh_of(MPI.COMM_SELF, cell, points, cells)
    cell_tags = None if tags is None else tags_of(domain, tags)
    check_mesh(domain, find_bodies(domain, cell_tags), contacts)


# -- sound meshes ----------------------------------------------------------------------------------


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
    check(cell, change(points), cells)


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_any_order_of_the_vertices_of_simplices(cell):
    points, cells = block(cell)
    check(cell, points, np.random.default_rng(0).permuted(cells, axis=1))


@by_cell
def test_bodies_that_touch_may_have_nodes_at_the_same_places(cell):
    points, cells = block(cell)
    shift = 3.0 * np.eye(points.shape[1])[0]
    both = concatenated((points, cells), (points + shift, cells))
    check(cell, *both)
    check(cell, *both, tags=np.repeat([1, 2], len(cells)))


def test_tags_of_glued_bodies():
    points, cells = grid((4, 2))
    check("quadrilateral", points, cells, tags=1 + (points[cells][:, 0, 0] > 1.5))


def test_tags_that_meet_in_a_vertex_within_a_connected_mesh():
    points, cells = grid((4, 4))
    x, y = points[cells].mean(axis=1).T
    check("quadrilateral", points, cells, tags=1 + (x > 2) + 2 * (y > 2))


def test_tags_without_cells_in_between():
    points, cells = concatenated(grid((2, 2)), grid((2, 2), (5.0, 0.0)))
    check("quadrilateral", points, cells, tags=np.repeat([-3, 100], 4))


def test_body_that_is_pinched_at_a_node():
    points, cells = grid((4, 4))
    x, y = points[cells].mean(axis=1).T
    check("quadrilateral", points, cells[~((x == y) & ((x == 1.5) | (x == 2.5)))])


def test_nodes_as_near_as_a_thin_gap_are_not_at_the_same_place():
    points, cells = slit()
    points[25:, 0] += 1e-4
    check("quadrilateral", points, cells)


# -- cracks ----------------------------------------------------------------------------------------


def test_crack_is_refused():
    with pytest.raises(InputError, match=r"2 pairs of nodes at the same place .*at \(2, 0\)"):
        check("quadrilateral", *slit())


@by_cell
def test_crack_through_cells_of_all_shapes_is_refused(cell):
    """Two blocks glued at a part of a face: the rest of it is a crack."""
    points, cells = block(cell)
    shift = 3.0 * np.eye(points.shape[1])[0]
    points, cells = concatenated((points, cells), (points + shift, cells))
    glued = (points[:, 0] == 3.0) & (points[:, -1] <= 1.0)
    points, cells = merged(points, cells, np.flatnonzero(glued | (points[:, 0] != 3.0)))
    with pytest.raises(InputError, match=rf"{2 * 4 ** (points.shape[1] - 2)} pairs"):
        check(cell, points, cells)


@pytest.mark.parametrize("distance", [0.0, 1e-7, -3e-6])
def test_nodes_that_are_nearly_at_the_same_place(distance):
    points, cells = slit()
    points[25:, 0] += distance
    with pytest.raises(InputError, match="2 pairs of nodes"):
        check("quadrilateral", points, cells)


def test_collapsed_edge_is_refused():
    """Quadrilaterals bent to triangles have a volume, but two nodes where one was meant."""
    points, cells = grid((1, 2))
    points[5] = points[4]
    with pytest.raises(InputError, match=r"1 pair of nodes .*\(0, 2\)"):
        check("quadrilateral", points, cells)


def faces_of_the_slit(domain, tags):
    """Tag the left and the right face of the crack of six units at x = 3."""
    points, cells = slit(6)
    sides = tags_of(domain, 1 + (points[cells].mean(axis=1)[:, 0] > 3.0))

    def crack(x):
        return (x[0] == 3.0) & (x[1] <= 3.0)

    return tag_facets(domain, [(tag, crack, k) for k, tag in enumerate(tags, start=1)], sides)


def test_crack_between_the_faces_of_a_pair_is_meant():
    domain = mesh_of(MPI.COMM_SELF, "quadrilateral", *slit(6))
    pair = ContactPair(faces_of_the_slit(domain, (5, 6)), slave=5, master=6)
    check_mesh(domain, find_bodies(domain, None), [pair])


def test_crack_through_a_face_of_a_pair_is_not_meant():
    domain = mesh_of(MPI.COMM_SELF, "quadrilateral", *slit(6))
    pair = ContactPair(faces_of_the_slit(domain, (5, 5)), slave=5, master=6)
    with pytest.raises(InputError, match="3 pairs of nodes"):
        check_mesh(domain, find_bodies(domain, None), [pair])


# -- cells -----------------------------------------------------------------------------------------


@by_cell
def test_flat_cell_is_named(cell):
    points, cells = block(cell)
    lone = points[cells[-1]] + 7.0
    lone[:, -1] = 8.0
    points, cells = concatenated((points, cells), (lone, np.arange(len(lone))[None]))
    with pytest.raises(
        InputError, match=rf"without .*1 of {len(cells)} cells, .* in body . in .9,"
    ):
        check(cell, points, cells)


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_concave_cell_is_named(cell):
    points, cells = block(cell, 2)
    points[0] = 0.9
    with pytest.raises(InputError, match="twisted .*: 1 of"):
        check(cell, points, cells)


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_order_of_vertices_of_gmsh_and_vtk_is_not_that_of_dolfinx(cell):
    points, cells = block(cell, 2)
    with pytest.raises(InputError, match="twisted .* order of dolfinx"):
        check(cell, points, cells[:, [0, 1, 3, 2, 4, 5, 7, 6][: cells.shape[1]]])


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_simplex_turned_inside_out_is_found(cell):
    points, cells = block(cell)
    inner = np.all((points > 0.0) & (points < 3.0), axis=1)
    points[np.flatnonzero(inner)[0]] += 1.6
    with pytest.raises(InputError, match="overlap their neighbours"):
        check(cell, points, cells)

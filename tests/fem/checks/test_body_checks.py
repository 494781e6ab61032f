"""Bodies that are not connected through facets, and nodes at the same place, are refused."""

from mpi4py import MPI

import numpy as np
import pytest
from mesh_arrays import block, check_arrays, concatenated, grid, merged, mesh_of, slit, tags_of
from scenes import CELLS

from fenics_tfeti import ContactPair, InputError
from fenics_tfeti.fem.checks.mesh import check_mesh
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.io import tag_facets

by_cell = pytest.mark.parametrize("cell", CELLS)


@by_cell
def test_crack_through_cells_of_all_shapes_is_refused(cell):
    """Two blocks glued at a part of a face: the rest of it is a crack."""
    points, cells = block(cell)
    shift = 3.0 * np.eye(points.shape[1])[0]
    points, cells = concatenated((points, cells), (points + shift, cells))
    glued = (points[:, 0] == 3.0) & (points[:, -1] <= 1.0)
    points, cells = merged(points, cells, np.flatnonzero(glued | (points[:, 0] != 3.0)))
    with pytest.raises(InputError, match=rf"{2 * 4 ** (points.shape[1] - 2)} pairs"):
        check_arrays(cell, points, cells)


@pytest.mark.parametrize("distance", [0.0, 1e-7, -3e-6])
def test_nodes_that_are_nearly_at_the_same_place(distance):
    points, cells = slit()
    points[25:, 0] += distance
    with pytest.raises(InputError, match="2 pairs of nodes"):
        check_arrays("quadrilateral", points, cells)


def test_collapsed_edge_is_refused():
    """Quadrilaterals bent to triangles have a volume, but two nodes where one was meant."""
    points, cells = grid((1, 2))
    points[5] = points[4]
    with pytest.raises(InputError, match=r"1 pair of nodes .*\(0, 2\)"):
        check_arrays("quadrilateral", points, cells)


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

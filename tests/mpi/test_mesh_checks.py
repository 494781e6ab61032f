"""Sound meshes pass on any number of ranks; those that dolfinx tears apart do not."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from mesh_arrays import grid, mesh_of, slit, tags_of

from fenics_tfeti import InputError
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.fem.mesh_checks import check_mesh
from fenics_tfeti.io import Box, boxes

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_boxes_that_touch_are_sound(cell):
    gdim = 3 if "hedron" in cell else 2
    low, high = np.zeros(gdim), np.ones(gdim)
    up = np.eye(gdim)[-1]
    parts = [Box(low, high, (3,) * gdim), Box(low + up, high + up, (3,) * gdim)]
    pair = boxes(COMM, parts, cell)
    check_mesh(pair.mesh, find_bodies(pair.mesh, pair.cell_tags), [])


def test_tags_that_meet_in_edges_within_a_connected_mesh_are_sound():
    """Of four blocks, two meet in an edge only, but the others hold them."""
    points, cells = grid((4, 4))
    middle = points[cells].mean(axis=1)
    domain = mesh_of(COMM, "quadrilateral", points, cells)
    tags = tags_of(domain, 1 + (middle[:, 0] > 2) + 2 * (middle[:, 1] > 2))
    check_mesh(domain, find_bodies(domain, tags), [])


def test_crack_is_found_wherever_its_sides_are():
    domain = mesh_of(COMM, "quadrilateral", *slit(8))
    with pytest.raises(InputError, match=r"4 pairs of nodes .*\(4, 0\)"):
        check_mesh(domain, find_bodies(domain, None), [])


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

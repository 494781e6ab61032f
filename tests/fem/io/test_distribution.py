"""Meshes that rank 0 has, distributed body by body."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from mesh_arrays import block, grid

from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.fem.geometry.reference_cells import reference_cell
from fenics_tfeti.fem.io.tagged_mesh import WholeMesh, distribute
from fenics_tfeti.fem.topology import NO_TAG, owned_cells

pytestmark = pytest.mark.ranks(1, 2, 3)


def distributed(cell, nodes, x, tag):
    """Distribute cells that rank 0 makes."""
    comm, facets = MPI.COMM_WORLD, len(reference_cell(cell).facets)
    none = np.full((len(nodes), facets), NO_TAG)
    whole = WholeMesh(cell, 1, nodes, x, tag, none, {}, {})
    return distribute(comm, whole if comm.rank == 0 else None)


def test_bodies_are_on_one_rank_each():
    """As many equal bodies as ranks, of one tag or of several."""
    size = MPI.COMM_WORLD.size
    points, cells = grid((3, 2, 2))
    nodes = np.concatenate([cells + k * len(points) for k in range(size)])
    x = np.concatenate([points + [4.0 * k, 0, 0] for k in range(size)])
    for tag in (np.ones(len(nodes), dtype=int), 1 + np.arange(len(nodes)) // len(cells)):
        parts = distributed("hexahedron", nodes, x, tag)
        bodies = find_bodies(parts.mesh, parts.cell_tags)
        assert len(bodies.names) == size
        assert bodies.of_cell.size == len(cells) and np.ptp(bodies.of_cell) == 0


@pytest.mark.parametrize("number", [1, 3])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_ranks_share_nodes_and_facets_at_cuts(cell, number):
    """One body, and three of which one is cut on two ranks."""
    points, cells = block(cell, 4)
    nodes = np.concatenate([cells + k * len(points) for k in range(number)])
    x = np.concatenate([points + 5.0 * k for k in range(number)])
    mesh = distributed(cell, nodes, x, np.ones(len(nodes), dtype=int)).mesh
    dim = mesh.topology.dim
    mesh.topology.create_entities(dim - 1)
    facets = np.sort(nodes[:, np.array(reference_cell(cell).facets)], axis=2)
    expected = len(np.unique(facets.reshape(-1, facets.shape[2]), axis=0))
    assert mesh.topology.index_map(dim - 1).size_global == expected
    assert mesh.topology.index_map(0).size_global == len(x)
    assert mesh.geometry.index_map().size_global == len(x)
    assert mesh.topology.index_map(dim).size_global == len(nodes)
    assert owned_cells(mesh) > 0
    assert len(find_bodies(mesh, None).names) == number

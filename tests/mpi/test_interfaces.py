"""Bodies are separated at interfaces alike on any number of ranks."""

from mpi4py import MPI

import numpy as np
import pytest
from joined_bodies import (
    block,
    bolt_in_block,
    elasticity,
    halves,
    measure,
    middle,
    thirds,
    vertices,
)

from fenics_tfeti import ContactPair, ContactProblem, InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import cell_vertices, cells_of_facets, facet_corners, owned_cells
from fenics_tfeti.io import Interface, displacement_space, read_msh, split_interfaces
from fenics_tfeti.parallel import concatenate_ranks

COMM = MPI.COMM_WORLD
THREE = [Interface((1, 2), (11, 12)), Interface((1, 3), (11, 13)), Interface((2, 3), (14, 15))]


def corners(tagged):
    """Return tag and vertices of all cells, and tag and vertices of all tagged facets, sorted."""
    mesh, dim = tagged.mesh, tagged.mesh.topology.dim
    found = []
    for d, tags in ((dim, tagged.cell_tags), (dim - 1, tagged.facet_tags)):
        own = tags.indices < mesh.topology.index_map(d).size_local
        rows = tags.indices[own]
        on_facets = d < dim and cells_of_facets(mesh, rows)
        nodes = facet_corners(mesh, *on_facets) if on_facets else cell_vertices(mesh)[rows]
        places = mesh.geometry.x[nodes]
        centres = np.round(places.mean(axis=1), 9)
        rows = concatenate_ranks(mesh.comm, np.column_stack([tags.values[own], centres]))
        found.append(rows[np.lexsort(rows.T)])
    return found


@pytest.mark.parametrize(("cell", "interfaces"), [
    ("triangle", THREE),
    ("hexahedron", THREE),
    ("quadrilateral", THREE[:1]),
    ("tetrahedron", THREE[2:]),
])  # fmt: skip
def test_split_mesh_is_that_of_one_rank(cell, interfaces):
    here = split_interfaces(block(cell, thirds, COMM), interfaces)
    alone = split_interfaces(block(cell, thirds), interfaces)
    assert vertices(here) == vertices(alone)
    for mine, expected in zip(corners(here), corners(alone), strict=True):
        np.testing.assert_allclose(mine, expected, atol=1e-8)


@pytest.mark.ranks(2, 3)
def test_ranks_without_cells():
    two = block("triangle", lambda x: np.where(x[:, 0] > x[:, 1], 1, 2), COMM, n=1)
    parts = split_interfaces(two, [Interface((1, 2), (5, 6))])
    assert vertices(parts) == 6
    assert [measure(parts, "ds", tag) for tag in (5, 6)] == pytest.approx([np.sqrt(2.0)] * 2)


def test_nodes_are_joined_alike():
    """Cells around the tip and along the two sides share the nodes that they do on one rank."""
    here, alone = (
        split_interfaces(
            block("triangle", halves, comm, 6, lambda x: middle(x) & (x[:, 1] < 0.6)),
            [Interface((1, 2), (5, 6), facets=9)],
        ).mesh
        for comm in (COMM, MPI.COMM_SELF)
    )
    counts = []
    for mesh in (here, alone):
        nodes = _compat.geometry_cells(mesh)[: owned_cells(mesh)].ravel()
        numbers = np.asarray(mesh.geometry.input_global_indices, dtype=np.int64)[nodes]
        numbers, x = (
            concatenate_ranks(mesh.comm, part) for part in (numbers, mesh.geometry.x[nodes])
        )
        _, first, cells = np.unique(numbers, return_index=True, return_counts=True)
        rows = np.column_stack([np.round(x[first], 9), cells])
        counts.append(rows[np.lexsort(rows.T)])
    np.testing.assert_allclose(*counts, atol=1e-8)


def test_nodes_have_the_numbers_of_one_rank():
    """Those by which a checkpoint is read on any number of ranks."""
    rows = []
    for comm in (COMM, MPI.COMM_SELF):
        mesh = split_interfaces(
            block("tetrahedron", halves, comm), [Interface((1, 2), (5, 6))]
        ).mesh
        nodes = NodeMap(displacement_space(mesh))
        columns = np.column_stack([nodes.input_numbers, nodes.coordinates])
        whole = concatenate_ranks(comm, columns)
        rows.append(whole[np.argsort(whole[:, 0])])
    np.testing.assert_allclose(*rows, atol=1e-12)


def test_contact_after_the_split():
    parts = split_interfaces(block("triangle", halves, COMM), [Interface((1, 2), (5, 6))])
    contact = ContactPair(parts.facet_tags, 5, 6)
    a, L, bcs = elasticity(parts, 1e-3)
    problem = ContactProblem(a, L, bcs=bcs, contacts=[contact], options={"rtol": 1e-10})
    problem.solve()
    assert problem.results[0].gather().pressure == pytest.approx(1e-3, rel=1e-8)


def test_fragments_of_gmsh_on_all_ranks(tmp_path_factory):
    path = COMM.bcast(tmp_path_factory.mktemp("bolt") / "bolt.msh")
    if COMM.rank == 0:
        bolt_in_block(path, 3, order=2)
    COMM.barrier()
    shank = Interface(("bolt", "block"), ("shank", "wall"), facets="hole")
    here, alone = (read_msh(path, comm, 3, split=[shank]) for comm in (COMM, MPI.COMM_SELF))
    assert here.names == alone.names
    assert vertices(here) == vertices(alone)
    nodes = [tagged.mesh.geometry.index_map().size_global for tagged in (here, alone)]
    assert nodes[0] == nodes[1]
    for name in ("shank", "wall", "outside"):
        sizes = [measure(tagged, "ds", tagged.names[name]) for tagged in (here, alone)]
        assert sizes[0] == pytest.approx(sizes[1], rel=1e-12)


def test_errors_are_raised_on_all_ranks():
    whole = block("triangle", halves, COMM, 8)
    with pytest.raises(InputError, match="no facets between the bodies 1 and 3|tag 3 is on no"):
        split_interfaces(whole, [Interface((1, 3), (5, 6))])

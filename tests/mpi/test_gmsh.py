"""Meshes under mpirun: the same mesh for any number of ranks, and errors on all ranks."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

import dolfinx
import ufl

from fenics_tfeti.errors import InputError
from fenics_tfeti.io import Box, boxes, read_msh, tag_facets

COMM = MPI.COMM_WORLD
TWO_BEAMS = Path(__file__).parents[2] / "meshes" / "two_beams.msh"


def integral(mesh, measure):
    """Return the integral of one over the mesh of all ranks."""
    one = dolfinx.fem.Constant(mesh, 1.0)
    return COMM.allreduce(dolfinx.fem.assemble_scalar(dolfinx.fem.form(one * measure)))


def test_all_ranks_together_hold_the_mesh_of_the_file():
    two_beams = read_msh(TWO_BEAMS, COMM)
    topology = two_beams.mesh.topology
    assert topology.index_map(0).size_global == 2 * 25 * 13 * 13
    assert topology.index_map(3).size_global == 2 * 24 * 12 * 12
    assert two_beams.names["contact_upper"] == 5
    dx = ufl.Measure("dx", domain=two_beams.mesh, subdomain_data=two_beams.cell_tags)
    ds = ufl.Measure("ds", domain=two_beams.mesh, subdomain_data=two_beams.facet_tags)
    sizes = [integral(two_beams.mesh, measure) for measure in (dx(1), dx(2), ds(5), ds(7), ds)]
    assert sizes == pytest.approx([2, 2, 1, 3, 20])


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_boxes_do_not_depend_on_the_ranks(cell):
    gdim = 3 if "hedron" in cell else 2
    low, high, grid = (0, 0, 0)[:gdim], (2, 1, 1)[:gdim], (4, 3, 2)[:gdim]
    shift = np.eye(gdim)[gdim - 1]  # upwards
    parts = [Box(low, high, grid), Box(np.add(low, shift), np.add(high, shift), grid)]
    pair = boxes(COMM, parts, cell)

    def contact(x):
        return np.isclose(x[gdim - 1], 1)

    tags = tag_facets(pair.mesh, [(5, contact, 2), (6, contact, 1)], pair.cell_tags)
    dx = ufl.Measure("dx", domain=pair.mesh, subdomain_data=pair.cell_tags)
    ds = ufl.Measure("ds", domain=pair.mesh, subdomain_data=tags)
    sizes = [integral(pair.mesh, measure) for measure in (dx(1), dx(2), ds(5), ds(6))]
    assert sizes == pytest.approx([2, 2, 2, 2])
    nodes = pair.mesh.topology.index_map(0).size_global
    assert nodes == 2 * np.prod(np.add(grid, 1))


def test_wrong_files_are_errors_on_all_ranks():
    with pytest.raises(FileNotFoundError, match="no mesh file"):
        read_msh("nowhere.msh", COMM)
    with pytest.raises(InputError, match="pass gdim=3"):
        read_msh(TWO_BEAMS, COMM, gdim=2)


def test_wrong_markers_are_errors_on_all_ranks():
    mesh = boxes(COMM, [Box((0, 0), (1, 1), (8, 8))], "triangle").mesh

    def fails(x):
        if COMM.rank == COMM.size - 1:
            raise RuntimeError("no good")
        return x[0] < 1e-9

    with pytest.raises(InputError, match="facet tag 3 failed .*no good"):
        tag_facets(mesh, {3: fails})
    with pytest.raises(InputError, match=r"tags \[4\]"):
        tag_facets(mesh, {3: lambda x: x[0] < 1e-9, 4: lambda x: x[0] > 2})

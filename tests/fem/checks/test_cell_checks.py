"""Cells without volume, twisted ones and overlapping ones are refused and named."""

from contextlib import nullcontext
from itertools import permutations, product

from mpi4py import MPI

import numpy as np
import pytest
from curved_rings import quarter_rings
from mesh_arrays import block, check_arrays, concatenated
from msh_files import gmsh_model
from scenes import CELLS

from fenics_tfeti import InputError
from fenics_tfeti.fem.checks.mesh import check_mesh
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.fem.topology import cell_vertices
from fenics_tfeti.io import read_msh

by_cell = pytest.mark.parametrize("cell", CELLS)


@pytest.mark.parametrize("recombine", [False, True])
def test_folded_curved_cell_is_named(tmp_path, recombine):
    domain = quarter_rings(tmp_path / "a.msh", (4, 6), ((0.5, 1.0), (1.0, 1.6)), recombine).mesh
    check_mesh(domain, find_bodies(domain, None), [])
    vertices = np.unique(cell_vertices(domain))
    x = domain.geometry.x
    inner = np.setdiff1d(np.arange(len(x)), vertices)
    radius = np.linalg.norm(x[inner], axis=1)
    moved = inner[np.argmin(np.abs(radius - 1.3))]
    x[moved, :2] += 0.4
    with pytest.raises(InputError, match=r"curved cells that are folded.*of \d+ cells"):
        check_mesh(domain, find_bodies(domain, None), [])


@pytest.mark.ranks
@pytest.mark.parametrize("straighten", [False, True])
def test_remedy_for_folded_cells_mends_them(shared_folder, straighten):
    """A few cells along a thin ring: its arcs are curved by more than a cell is high."""
    comm, path = MPI.COMM_WORLD, shared_folder / "ring.msh"
    if comm.rank == 0:
        with gmsh_model(path, 2, order=2) as gmsh:
            occ = gmsh.model.occ
            outer, inner = (occ.addDisk(0, 0, 0, r, r) for r in (1.0, 0.9))
            occ.cut([(2, outer)], [(2, inner)])
            occ.synchronize()
            gmsh.model.addPhysicalGroup(2, [outer])
            gmsh.option.setNumber("Mesh.MeshSizeMin", 0.9)
    comm.barrier()
    told = pytest.warns(UserWarning, match=r"ring.msh: made the sides of \d+ of \d+ curved cells")
    with told if straighten and comm.rank == 0 else nullcontext():
        domain = read_msh(path, comm, gdim=2, straighten=straighten).mesh
    refused = pytest.raises(InputError, match=r"read_msh\(\.\.\., straighten=True\)")
    with nullcontext() if straighten else refused:
        check_mesh(domain, find_bodies(domain, None), [])


@by_cell
def test_flat_cell_is_named(cell):
    points, cells = block(cell)
    lone = points[cells[-1]] + 7.0
    lone[:, -1] = 8.0
    points, cells = concatenated((points, cells), (lone, np.arange(len(lone))[None]))
    with pytest.raises(
        InputError, match=rf"without .*1 of {len(cells)} cells, .* in body . in .9,"
    ):
        check_arrays(cell, points, cells)


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_concave_cell_is_named(cell):
    points, cells = block(cell, 2)
    points[0] = 0.9
    with pytest.raises(InputError, match="twisted .*: 1 of"):
        check_arrays(cell, points, cells)


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_simplex_turned_inside_out_is_found(cell):
    points, cells = block(cell)
    inner = np.all((points > 0.0) & (points < 3.0), axis=1)
    points[np.flatnonzero(inner)[0]] += 1.6
    with pytest.raises(InputError, match="overlap their neighbours"):
        check_arrays(cell, points, cells)


def orders(dim):
    """Yield the orders of a cube's corners that rotations and reflections make."""
    corners = np.array(list(product((0, 1), repeat=dim)))[:, ::-1]
    for axes, flips in product(permutations(range(dim)), product((0, 1), repeat=dim)):
        turned = corners[:, axes] ^ np.array(flips)
        yield turned @ 2 ** np.arange(dim)


@pytest.mark.parametrize("fold", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
def test_folded_neighbour_is_found_in_any_order_of_its_vertices(dim, fold):
    first = np.array(list(product((0.0, 1.0), repeat=dim)))[:, ::-1]
    places = np.concatenate([first, first + np.eye(dim)[0]])
    points, at = np.unique(places, axis=0, return_inverse=True)
    one, other = at.ravel().reshape(2, -1)
    if fold:
        points[points[:, 0] == 2.0, 0] = 0.5
    for order in orders(dim):
        arrays = {2: "quadrilateral", 3: "hexahedron"}[dim], points, np.array([one, other[order]])
        if fold:
            with pytest.raises(InputError, match="overlap their neighbours"):
                check_arrays(*arrays)
        else:
            check_arrays(*arrays)

"""Meshes from arrays: small ones, also flat, twisted or torn, and unstructured ones of Gmsh."""

from __future__ import annotations

import itertools
import runpy
import signal
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scenes import Scene, dimension

from dolfinx import mesh

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.checks.mesh import check_mesh
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.io import read_msh

MESHES = Path(__file__).resolve().parents[2] / "meshes"


def mesh_of(comm: MPI.Comm, cell: str, points: ArrayLike, cells: ArrayLike) -> Any:
    """Distribute a mesh that rank 0 has."""
    x, nodes = np.asarray(points, dtype=float), np.asarray(cells, dtype=np.int64)
    if comm.rank > 0:
        x, nodes = x[:0], nodes[:0]
    return _compat.distributed_mesh(comm, nodes, np.ascontiguousarray(x), cell)


def of_script(script: str, gdim: int, *arguments: Any, comm: MPI.Comm = MPI.COMM_SELF) -> Any:
    """Return the bodies that Gmsh meshes on rank 0 by the function of a script in meshes/."""
    pytest.importorskip("gmsh")
    make = runpy.run_path(str(MESHES / f"{script}.py"))[script]
    return of_function(make, gdim, *arguments, comm=comm)


def of_function(
    make: Callable[..., None], gdim: int, *arguments: Any, comm: MPI.Comm = MPI.COMM_SELF
) -> Any:
    """Return the bodies of a file that a function of its path makes on rank 0 by Gmsh."""
    handler = signal.getsignal(signal.SIGINT)  # Gmsh replaces it
    with tempfile.TemporaryDirectory() as folder:
        path = Path(comm.bcast(folder), "mesh.msh")
        if comm.rank == 0:
            make(path, *arguments)
            signal.signal(signal.SIGINT, handler)
        comm.barrier()
        bodies = read_msh(path, comm, gdim)
        comm.barrier()
    return bodies


def tags_of(domain: Any, values: ArrayLike) -> Any:
    """Tag the cells, given in the order of the arrays that the mesh was made of."""
    owned = domain.topology.index_map(domain.topology.dim).size_local
    of_cell = np.asarray(values, dtype=np.int32)[domain.topology.original_cell_index[:owned]]
    return mesh.meshtags(domain, domain.topology.dim, np.arange(owned, dtype=np.int32), of_cell)


def grid(divisions: tuple[int, ...], corner: tuple[float, ...] = ()) -> tuple[Any, Any]:
    """Return points and cells of a box of unit squares or cubes; the first axis runs fastest."""
    lattice = [range(n + 1) for n in reversed(divisions)]
    points = np.array(list(itertools.product(*lattice)), dtype=float)[:, ::-1]
    strides = np.cumprod([1, *np.add(divisions, 1)])[:-1]
    offsets = (np.arange(2 ** len(divisions))[:, None] >> np.arange(len(divisions)) & 1) @ strides
    blocks = np.array(list(itertools.product(*(range(n) for n in reversed(divisions)))))[:, ::-1]
    return points + np.array(corner or 0.0), (blocks @ strides)[:, None] + offsets


# Kuhn's tetrahedra of a cube
TETRAHEDRA = [(0, 1, 3, 7), (0, 1, 5, 7), (0, 2, 3, 7), (0, 2, 6, 7), (0, 4, 5, 7), (0, 4, 6, 7)]


def block(cell: str, n: int = 3) -> tuple[Any, Any]:
    """Return points and cells of a square or cube of n^2 or n^3 units."""
    points, cells = grid((n,) * dimension(cell))
    if cell == "triangle":
        cells = np.concatenate([cells[:, [0, 1, 3]], cells[:, [0, 2, 3]]])
    if cell == "tetrahedron":
        cells = np.concatenate([cells[:, corners] for corners in TETRAHEDRA])
    return points, cells


def check_arrays(
    cell: str, points: ArrayLike, cells: ArrayLike, tags: Any = None, contacts: Any = ()
) -> None:
    """Make a mesh of arrays, tag its cells, and check it; serial."""
    domain = mesh_of(MPI.COMM_SELF, cell, points, cells)
    cell_tags = None if tags is None else tags_of(domain, tags)
    check_mesh(domain, find_bodies(domain, cell_tags), contacts)


def concatenated(*parts: tuple[Any, Any]) -> tuple[Any, Any]:
    """Put meshes into one, without common nodes."""
    first = np.cumsum([0, *(len(points) for points, _ in parts)])
    return (
        np.concatenate([points for points, _ in parts]),
        np.concatenate([cells + k for (_, cells), k in zip(parts, first, strict=False)]),
    )


def merged(points: Any, cells: Any, where: Any = ...) -> tuple[Any, Any]:
    """Merge the nodes at the same place, or of these only those given by their numbers."""
    target = np.arange(len(points))
    chosen = target[where]
    _, first, inverse = np.unique(points[chosen], axis=0, return_index=True, return_inverse=True)
    target[chosen] = chosen[first][inverse.ravel()]
    used, renumbered = np.unique(target[cells], return_inverse=True)
    return points[used], renumbered.reshape(cells.shape)


def slit(n: int = 4) -> tuple[Any, Any]:
    """Return a square of n x n cells with a crack from the middle of its lower side to its centre.

    The n / 2 nodes of the crack, without its tip, are there twice.
    """
    points, cells = grid((n, n))
    half = n // 2
    crack = np.flatnonzero((points[:, 0] == half) & (points[:, 1] < half))
    copies = dict(zip(crack, range(len(points), len(points) + crack.size), strict=True))
    right = points[cells].mean(axis=1)[:, 0] > half
    cells[right] = np.vectorize(lambda node: copies.get(node, node))(cells[right])
    return np.concatenate([points, points[crack]]), cells


def problem_on(domain: Any, **arguments: Any) -> Any:
    """Pose a problem with steel, no load and no supports."""
    return Scene(domain, None).problem(**{"cell_tags": None, **arguments})


def unstructured_block(cell: str, size: float) -> tuple[Any, Any]:
    """Return points and cells of a unit square or cube that Gmsh has meshed, finer at one corner.

    `size` is that of the edges of triangles and tetrahedra; quadrilaterals are thirds of triangles,
    hexahedra quarters of tetrahedra.
    """
    import gmsh

    dim = dimension(cell)
    kind = {"triangle": 2, "quadrilateral": 3, "tetrahedron": 4, "hexahedron": 5}[cell]
    order = {3: [0, 1, 3, 2], 5: [0, 1, 3, 2, 4, 5, 7, 6]}.get(kind, slice(None))
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.SubdivisionAlgorithm", {3: 1, 5: 2}.get(kind, 0))
        if dim == 3:
            gmsh.model.occ.addBox(0, 0, 0, 1, 1, 1)
        else:
            gmsh.model.occ.addRectangle(0, 0, 0, 1, 1)
        gmsh.model.occ.synchronize()
        corners = gmsh.model.getEntities(0)
        gmsh.model.mesh.setSize(corners, size)
        gmsh.model.mesh.setSize(corners[:1], 0.5 * size)
        gmsh.model.mesh.generate(dim)
        numbers, points, _ = gmsh.model.mesh.getNodes()
        nodes = gmsh.model.mesh.getElementsByType(kind)[1]
    finally:
        gmsh.finalize()
    used, cells = np.unique(nodes, return_inverse=True)
    place = np.argsort(numbers)[np.searchsorted(np.sort(numbers), used)]
    vertices = {2: 3, 3: 4, 4: 4, 5: 8}[kind]
    return points.reshape(-1, 3)[place, :dim], cells.reshape(-1, vertices)[:, order]

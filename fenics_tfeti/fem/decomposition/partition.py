"""Cells into bodies, and each rank's cells into connected subdomains (sec. 11.4).

No cell moves: each rank splits the cells it owns.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from dolfinx.fem import FunctionSpace
from dolfinx.mesh import Mesh, exterior_facet_indices

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.grid import Grid, block_of_cells, find_grid
from fenics_tfeti.parallel import Directory, concatenate_ranks, first_of_rank, raise_collectively

__all__ = ["Bodies", "find_bodies", "given_subdomains", "split_into_subdomains"]

logger = logging.getLogger(__name__)

Numbers = NDArray[np.int64]
Partitioner = Literal["auto", "scotch"]


@dataclass(frozen=True)
class Bodies:
    """The bodies of a mesh: connected through facets and, where cells are tagged, of one tag.

    Attributes
    ----------
    of_cell : (cells,) integer array
        The body of each cell that this rank owns.
    names : list of str
        Names for messages, by number; the same on all ranks.
    tags : (bodies,) integer array or None
        The tag of each, where cells are tagged; the same on all ranks.
    part : (bodies,) integer array
        The connected part of the mesh, whatever the tags, that each is in; the same on all ranks.
    graph : (cells, cells) scipy.sparse.csr_matrix
        The cells that this rank owns, joined through facets, whatever the tags.
    """

    of_cell: Numbers
    names: list[str]
    tags: Numbers | None
    part: Numbers
    graph: sp.csr_matrix


def find_bodies(domain: Mesh, cell_tags: Any | None) -> Bodies:
    """Find the connected bodies of a distributed mesh.

    Parameters
    ----------
    domain : Mesh
        The mesh.
    cell_tags : MeshTags or None
        Tag of every cell, where bodies are to be told apart by tags too.

    Returns
    -------
    Bodies
        Numbered by tag, then by their lowest global cell number.

    Raises
    ------
    InputError
        If some cells have no tag.
    """
    tags = _cell_tags(domain, cell_tags)
    tagged = cell_tags is not None
    graph = _cell_graph(domain)
    unordered, bodies = _components(domain, graph, tags)
    part = _components(domain, graph, np.zeros_like(tags))[0] if tagged else unordered

    common, lowest = _describe(domain, unordered, np.stack([tags, part], axis=1), bodies)
    order = np.lexsort((lowest, common[:, 0]))
    number = np.empty(bodies, dtype=np.int64)
    number[order] = np.arange(bodies)
    of_cell = number[unordered]
    tag_of_body = common[order, 0] if tagged else None
    names = _names(domain, of_cell, bodies, tag_of_body)
    return Bodies(of_cell, names, tag_of_body, common[order, 1], graph)


def split_into_subdomains(
    space: FunctionSpace, bodies: Bodies, unknowns: int, partitioner: Partitioner = "auto"
) -> list[NDArray[np.int32]]:
    """Split this rank's cells, body by body, into connected subdomains.

    Parameters
    ----------
    space : FunctionSpace
        The displacement's space, to count unknowns.
    bodies : Bodies
        The bodies.
    unknowns : int
        Unknowns of a subdomain to aim at.
    partitioner : {"auto", "scotch"}
        SCOTCH for all, or blocks where the nodes of this rank's part of a body are a grid.

    Returns
    -------
    list of integer arrays
        The cells of each subdomain.
    """
    graph = bodies.graph
    dofs = _compat.cell_dofs(space)
    block = space.dofmap.index_map_bs
    _, piece = connected_components(_cut_between(graph, bodies.of_cell), directed=False)
    subdomains: list[NDArray[np.int32]] = []
    for cells in _groups(piece):
        parts = round(block * np.unique(dofs[cells]).size / unknowns)
        if parts <= 1:
            subdomains.append(cells)
            continue
        inside = graph[cells][:, cells]
        grid = _find_grid(space.mesh, cells) if partitioner == "auto" else None
        label = (
            block_of_cells(grid, unknowns / block)
            if grid is not None
            else _compat.partition_graph(inside.indptr, inside.indices, min(parts, cells.size))
        )
        subdomains += _connected_groups(inside, label.astype(np.int64), cells)
    return subdomains


def _find_grid(domain: Mesh, cells: NDArray[np.int32]) -> Grid | None:
    rows, cell_nodes = np.unique(_compat.geometry_cells(domain)[cells], return_inverse=True)
    points = domain.geometry.x[rows, : domain.geometry.dim]
    return find_grid(points, cell_nodes.reshape(cells.size, -1))


def given_subdomains(
    domain: Mesh, bodies: Bodies, labels: Sequence[int]
) -> list[NDArray[np.int32]]:
    """Take the user's subdomains: cells with the same label on the same rank in the same body.

    Parameters
    ----------
    domain : Mesh
        The mesh.
    bodies : Bodies
        The bodies.
    labels : (cells,) sequence of int
        Label of each cell that this rank owns.

    Returns
    -------
    list of integer arrays
        The cells of each subdomain; a label whose cells are not connected gives several.

    Raises
    ------
    InputError
        If there is not one label for each cell.
    """
    label = np.asarray(labels)
    owned = domain.topology.index_map(domain.topology.dim).size_local
    with raise_collectively(domain.comm):
        if label.shape != (owned,):
            raise InputError(
                f"'subdomains' has shape {label.shape}, but rank {domain.comm.rank} owns {owned} "
                "cells: give one label for each cell that the rank owns, ghosts left out"
            )
    graph = bodies.graph
    both = np.unique(np.stack([bodies.of_cell, label]), axis=1, return_inverse=True)[1].ravel()
    subdomains = _connected_groups(graph, both, np.arange(owned, dtype=np.int32))
    if len(subdomains) > np.unique(both).size:
        logger.info(
            "rank %d: %d subdomain labels gave %d connected subdomains",
            domain.comm.rank,
            np.unique(label).size,
            len(subdomains),
        )
    return subdomains


def _cell_tags(domain: Mesh, cell_tags: Any | None) -> Numbers:
    owned = domain.topology.index_map(domain.topology.dim).size_local
    tags = np.zeros(owned, dtype=np.int64)
    if cell_tags is None:
        return tags
    with raise_collectively(domain.comm):
        if cell_tags.dim != domain.topology.dim:
            raise InputError(
                f"cell_tags are on entities of dimension {cell_tags.dim}, cells have dimension "
                f"{domain.topology.dim}: were the facet tags passed?"
            )
        mine = cell_tags.indices < owned
        tagged = np.zeros(owned, dtype=bool)
        tagged[cell_tags.indices[mine]] = True
        tags[cell_tags.indices[mine]] = cell_tags.values[mine]
        if not tagged.all():
            raise InputError(
                f"cell_tags leave {np.count_nonzero(~tagged)} of {owned} cells of rank "
                f"{domain.comm.rank} without a tag: tag every cell, or leave cell_tags out"
            )
    return tags


def _cell_graph(domain: Mesh) -> sp.csr_matrix:
    """Return the graph of the cells that this rank owns, joined through facets."""
    dim = domain.topology.dim
    facet_of, owned = cell_facets(domain)
    facets = facet_of[:owned]
    domain.topology.create_connectivity(dim - 1, dim)
    incidence = sp.csr_matrix(
        (
            np.ones(facets.size, dtype=np.int32),
            (np.repeat(np.arange(owned), facets.shape[1]), facets.ravel()),
        ),
        shape=(owned, int(facet_of.max(initial=-1)) + 1),
    )
    graph = (incidence @ incidence.T).tocsr()
    graph.setdiag(0)
    graph.eliminate_zeros()
    return graph


def cell_facets(domain: Mesh) -> tuple[NDArray[np.int32], int]:
    """Return the facets of each cell of this rank, ghosts last, and the number of owned cells."""
    dim = domain.topology.dim
    domain.topology.create_entities(dim - 1)
    domain.topology.create_connectivity(dim, dim - 1)
    cells = domain.topology.index_map(dim)
    table = np.asarray(domain.topology.connectivity(dim, dim - 1).array)
    count = cells.size_local + cells.num_ghosts
    per_cell = {"triangle": 3, "quadrilateral": 4, "tetrahedron": 4, "hexahedron": 6}
    return table.reshape(count, per_cell[_compat.cell_name(domain)]), cells.size_local


def exterior_facets(domain: Mesh) -> NDArray[np.bool_]:
    """Tell which facets of this rank are on the boundary of the whole mesh; ghosts are not."""
    dim = domain.topology.dim
    domain.topology.create_entities(dim - 1)
    domain.topology.create_connectivity(dim - 1, dim)
    facets = domain.topology.index_map(dim - 1)
    exterior = np.zeros(facets.size_local + facets.num_ghosts, dtype=bool)
    exterior[exterior_facet_indices(domain.topology)] = True
    return exterior


def exterior_cell_facets(domain: Mesh) -> NDArray[np.bool_]:
    """Tell which facets of each owned cell are on the boundary of the whole mesh."""
    facet_of, owned = cell_facets(domain)
    of_cell: NDArray[np.bool_] = exterior_facets(domain)[facet_of[:owned]]
    return of_cell


def _cut_between(graph: sp.csr_matrix, label: Numbers) -> sp.csr_matrix:
    """Return the graph without the edges between different labels."""
    coo = graph.tocoo()
    same = label[coo.row] == label[coo.col]
    return sp.csr_matrix((coo.data[same], (coo.row[same], coo.col[same])), shape=graph.shape)


def _groups(label: Numbers) -> list[NDArray[np.int32]]:
    order = np.argsort(label, kind="stable").astype(np.int32)
    cuts = np.flatnonzero(np.diff(label[order])) + 1
    return [group for group in np.split(order, cuts) if group.size]


def _connected_groups(
    graph: sp.csr_matrix, label: Numbers, cells: NDArray[np.int32]
) -> list[NDArray[np.int32]]:
    _, piece = connected_components(_cut_between(graph, label), directed=False)
    return [cells[group] for group in _groups(piece)]


def _components(domain: Mesh, graph: sp.csr_matrix, tags: Numbers) -> tuple[Numbers, int]:
    """Return for each cell which connected component of one tag it is in, and their number."""
    count, piece = connected_components(_cut_between(graph, tags), directed=False)
    # pieces of this rank, numbered over all ranks, then joined through facets shared by ranks
    first, total = first_of_rank(domain.comm, count)
    of_piece = _join_pieces(domain, piece + first, tags, total)
    return of_piece[piece + first], int(of_piece.max(initial=-1)) + 1


def _join_pieces(domain: Mesh, piece: Numbers, tags: Numbers, total: int) -> Numbers:
    """Return the body of each piece, joining pieces of one tag through facets shared by ranks."""
    comm, dim = domain.comm, domain.topology.dim
    if comm.size == 1:
        return np.arange(total)
    facet_of, owned = cell_facets(domain)
    facets = facet_of[:owned]
    flat = facets.ravel()
    of_facet = np.repeat(np.arange(owned), facets.shape[1])
    # facets with one owned cell: on the boundary of the bodies or between ranks
    once = np.bincount(flat, minlength=int(facet_of.max(initial=-1)) + 1)[flat] == 1
    to_global = domain.topology.index_map(dim - 1).local_to_global
    keys = np.asarray(to_global(flat[once].astype(np.int32)), dtype=np.int64)
    cells = of_facet[once]
    order = np.argsort(keys)
    keys, pieces, tag = keys[order], piece[cells][order], tags[cells][order]

    found, other, other_tag = Directory(comm, keys).forward(keys, pieces, tag)
    at = np.searchsorted(keys, found)
    joined = (tag[at] == other_tag) & (pieces[at] != other)
    edges = np.unique(np.stack([pieces[at][joined], other[joined]]), axis=1)
    edges = concatenate_ranks(comm, edges.T)
    graph = sp.csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(total, total))
    body: Numbers = connected_components(graph, directed=False)[1].astype(np.int64)
    return body


def _describe(
    domain: Mesh, body: Numbers, columns: Numbers, bodies: int
) -> tuple[Numbers, Numbers]:
    """Return what the cells of each body have in common, and its lowest global cell number."""
    cells = np.arange(body.size, dtype=np.int32)
    numbers = domain.topology.index_map(domain.topology.dim).local_to_global(cells)
    common = np.full((bodies, columns.shape[1]), np.iinfo(np.int64).min)
    lowest = np.full(bodies, np.iinfo(np.int64).max)
    common[body] = columns
    np.minimum.at(lowest, body, np.asarray(numbers, dtype=np.int64))
    domain.comm.Allreduce(MPI.IN_PLACE, common, MPI.MAX)
    domain.comm.Allreduce(MPI.IN_PLACE, lowest, MPI.MIN)
    return common, lowest


def _names(domain: Mesh, body: Numbers, bodies: int, tags: Numbers | None) -> list[str]:
    """Name the bodies by number, tag and where they are."""
    gdim = domain.geometry.dim
    low = np.full((bodies, gdim), np.inf)
    high = -low
    order = np.argsort(body, kind="stable")
    here, first = np.unique(body[order], return_index=True)
    nodes = _compat.geometry_cells(domain)[order]
    x = domain.geometry.x[nodes.ravel(), :gdim]
    if here.size:
        low[here] = np.minimum.reduceat(x, first * nodes.shape[1])
        high[here] = np.maximum.reduceat(x, first * nodes.shape[1])
    domain.comm.Allreduce(MPI.IN_PLACE, low, MPI.MIN)
    domain.comm.Allreduce(MPI.IN_PLACE, high, MPI.MAX)
    names = []
    for number in range(bodies):
        label = "" if tags is None else f" (cell tag {tags[number]})"
        box = " x ".join(
            f"[{a:.4g}, {b:.4g}]" for a, b in zip(low[number], high[number], strict=True)
        )
        names.append(f"body {number}{label} in {box}")
    return names

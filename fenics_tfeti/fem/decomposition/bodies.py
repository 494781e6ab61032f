"""Bodies: the connected parts of a distributed mesh, told apart by cell tags where given."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from dolfinx.mesh import Mesh

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.cell_graph import cell_graph, components
from fenics_tfeti.fem.topology import cell_facets, owned_cells, tags_of_cells
from fenics_tfeti.parallel import Directory, concatenate_ranks, first_of_rank
from fenics_tfeti.typing import Numbers


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
        Adjacency, through facets, of the cells that this rank owns, whatever the tags.
    """

    of_cell: Numbers
    names: list[str]
    tags: Numbers | None
    part: Numbers
    graph: sp.csr_matrix


def find_bodies(domain: Mesh, cell_tags: Any | None) -> Bodies:
    """Find the connected bodies of a distributed mesh. Collective.

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
        Tags of facets instead of cells, cells without a tag.
    """
    tagged = cell_tags is not None
    tags = tags_of_cells(domain, cell_tags) if tagged else np.zeros(owned_cells(domain), np.int64)
    graph = cell_graph(domain)
    unordered, bodies = _global_components(domain, graph, tags)
    part = _global_components(domain, graph, np.zeros_like(tags))[0] if tagged else unordered

    common, lowest = _common_values(domain, unordered, np.stack([tags, part], axis=1), bodies)
    order = np.lexsort((lowest, common[:, 0]))
    number = np.empty(bodies, dtype=np.int64)
    number[order] = np.arange(bodies)
    of_cell = number[unordered]
    tag_of_body = common[order, 0] if tagged else None
    names = _names(domain, of_cell, bodies, tag_of_body)
    return Bodies(of_cell, names, tag_of_body, common[order, 1], graph)


def _global_components(domain: Mesh, graph: sp.csr_matrix, tags: Numbers) -> tuple[Numbers, int]:
    """Return the connected component of equal tags of each cell, over all ranks; their number."""
    count, component = components(graph, tags)
    # components of this rank, numbered over all ranks, then joined through facets between ranks
    first, total = first_of_rank(domain.comm, count)
    joined = _join_across_ranks(domain, component + first, tags, total)
    return joined[component + first], int(joined.max(initial=-1)) + 1


def _join_across_ranks(domain: Mesh, component: Numbers, tags: Numbers, total: int) -> Numbers:
    """Return the number (total,) of each component after joining those of one tag across ranks."""
    comm, dim = domain.comm, domain.topology.dim
    if comm.size == 1:
        return np.arange(total)
    facet_of = cell_facets(domain)
    owned = owned_cells(domain)
    facets = facet_of[:owned]
    flat = facets.ravel()
    cell_of = np.repeat(np.arange(owned), facets.shape[1])
    # facets with one owned cell: on the boundary of the mesh or between ranks
    once = np.bincount(flat, minlength=int(facet_of.max(initial=-1)) + 1)[flat] == 1
    to_global = domain.topology.index_map(dim - 1).local_to_global
    keys = np.asarray(to_global(flat[once].astype(np.int32)), dtype=np.int64)
    cells = cell_of[once]
    order = np.argsort(keys)
    keys, own, tag = keys[order], component[cells][order], tags[cells][order]

    found, other, other_tag = Directory(comm, keys).forward(keys, own, tag)
    at = np.searchsorted(keys, found)
    joined = (tag[at] == other_tag) & (own[at] != other)
    edges = np.unique(np.stack([own[at][joined], other[joined]]), axis=1)
    edges = concatenate_ranks(comm, edges.T)
    graph = sp.csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(total, total))
    number: Numbers = connected_components(graph, directed=False)[1].astype(np.int64)
    return number


def _common_values(
    domain: Mesh, body: Numbers, columns: Numbers, bodies: int
) -> tuple[Numbers, Numbers]:
    """Return for each body the columns, equal on all its cells, and its lowest global cell."""
    cells = np.arange(body.size, dtype=np.int32)
    numbers = domain.topology.index_map(domain.topology.dim).local_to_global(cells)
    common = np.full((bodies, columns.shape[1]), np.iinfo(np.int64).min)
    lowest = np.full(bodies, np.iinfo(np.int64).max)
    common[body] = columns
    order = np.argsort(body, kind="stable")
    here, first = np.unique(body[order], return_index=True)
    if here.size:
        lowest[here] = np.minimum.reduceat(np.asarray(numbers, dtype=np.int64)[order], first)
    domain.comm.Allreduce(MPI.IN_PLACE, common, MPI.MAX)
    domain.comm.Allreduce(MPI.IN_PLACE, lowest, MPI.MIN)
    return common, lowest


def _names(domain: Mesh, body: Numbers, bodies: int, tags: Numbers | None) -> list[str]:
    """Name the bodies by number, tag and bounding box."""
    gdim = domain.geometry.dim
    low = np.full((bodies, gdim), np.inf)
    high = -low
    order = np.argsort(body, kind="stable")
    here, first = np.unique(body[order], return_index=True)
    nodes = _compat.geometry_cells(domain)[order]
    # by component: reductions over long columns are faster than those over short rows
    for k in range(gdim if here.size else 0):
        x = domain.geometry.x[:, k][nodes.ravel()]
        low[here, k] = np.minimum.reduceat(x, first * nodes.shape[1])
        high[here, k] = np.maximum.reduceat(x, first * nodes.shape[1])
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

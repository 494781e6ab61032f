"""Bodies: the connected parts of a distributed mesh, told apart by cell tags where given."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from dolfinx.mesh import Mesh

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.fem.topology import (
    cell_facets,
    connected_labels,
    global_numbers,
    owned_cells,
    tag_names,
    tags_of_cells,
)
from fenics_tfeti.parallel import Directory, concatenate_ranks, first_of_rank
from fenics_tfeti.typing import Indices, Numbers, Vector


@dataclass(frozen=True)
class Bodies:
    """The bodies of a mesh: connected through facets and, where cells are tagged, of one tag.

    `labels`, `names`, `tags` and `part`, by number of the body, are the same on all ranks.
    """

    of_cell: Numbers  # of each cell that this rank owns
    piece: Numbers  # of each of these cells: of what is connected on this rank, and of one body
    deformable: int  # number of bodies that are not rigid, the first ones
    labels: list[str]  # number, and name or tag of the cells
    names: list[str]  # the labels with the places, for messages
    tags: Numbers | None  # None where cells are not tagged
    part: Numbers  # the connected part of the mesh, whatever the tags, that each is in
    graph: sp.csr_matrix  # adjacency of owned cells through facets, whatever the tags
    extent: Vector  # (bodies, gdim): sizes of the boxes around them [m]


def find_bodies(
    domain: Mesh, cell_tags: Any | None, rigid: Collection[int] = frozenset()
) -> Bodies:
    """Find the connected bodies of a distributed mesh. Collective.

    They are told apart by cell tags too, where given, and numbered by tag, then by their lowest
    cell number in the input of the mesh; those with rigid tags are the last ones.
    """
    tagged = cell_tags is not None
    tags = tags_of_cells(domain, cell_tags) if tagged else np.zeros(owned_cells(domain), np.int64)
    graph = cell_graph(domain)
    piece, unordered, bodies = _global_components(domain, graph, tags)
    part = _global_components(domain, graph, np.zeros_like(tags))[1] if tagged else unordered

    # the cells of each body of this rank one after the other
    cells = np.argsort(unordered, kind="stable")
    present, first = np.unique(unordered[cells], return_index=True)
    common = np.full((bodies, 2), np.iinfo(np.int64).min)
    common[unordered] = np.stack([tags, part], axis=1)
    domain.comm.Allreduce(MPI.IN_PLACE, common, MPI.MAX)
    lowest = np.full(bodies, np.iinfo(np.int64).max)
    if present.size:
        lowest[present] = np.minimum.reduceat(_compat.input_cells(domain)[cells], first)
    domain.comm.Allreduce(MPI.IN_PLACE, lowest, MPI.MIN)
    is_rigid = np.isin(common[:, 0], list(rigid)) if tagged else np.zeros(bodies, dtype=bool)
    order = np.lexsort((lowest, common[:, 0], is_rigid))
    number = np.empty(bodies, dtype=np.int64)
    number[order] = np.arange(bodies)
    of_cell = number[unordered]
    tag_of_body = common[order, 0] if tagged else None
    low, high = _bounding_boxes(domain, cells, first, number[present], bodies)
    labels = [f"body {k}" for k in range(bodies)]
    if tag_of_body is not None:
        known = tag_names(cell_tags)
        for k, tag in enumerate(tag_of_body.tolist()):
            labels[k] += f" ({known.get(tag, f'cell tag {tag}')})"
    names = [
        f"{label} in " + " x ".join(f"[{a:.4g}, {b:.4g}]" for a, b in zip(*box, strict=True))
        for label, *box in zip(labels, low, high, strict=True)
    ]
    deformable = bodies - int(np.count_nonzero(is_rigid))
    part, extent = common[order, 1], high - low
    return Bodies(of_cell, piece, deformable, labels, names, tag_of_body, part, graph, extent)


def _global_components(
    domain: Mesh, graph: sp.csr_matrix, tags: Numbers
) -> tuple[Numbers, Numbers, int]:
    """Return the connected component of equal tags of each cell, on this rank and over all ranks.

    With them the number of those over all ranks.
    """
    count, component = components(graph, tags)
    # components of this rank, numbered over all ranks, then joined through facets between ranks
    first, total = first_of_rank(domain.comm, count)
    joined = _join_across_ranks(domain, component + first, tags, total)
    return component, joined[component + first], int(joined.max(initial=-1)) + 1


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
    single = np.bincount(flat, minlength=int(facet_of.max(initial=-1)) + 1)[flat] == 1
    keys = global_numbers(domain.topology.index_map(dim - 1), flat[single])
    cells = cell_of[single]
    rows = Directory(comm, keys).collect(keys, component[cells], tags[cells])
    keys, label, tag = np.stack(rows)[:, np.argsort(rows[0])]
    joined = (keys[1:] == keys[:-1]) & (tag[1:] == tag[:-1])
    edges = concatenate_ranks(comm, np.unique([label[:-1][joined], label[1:][joined]], axis=1).T)
    return connected_labels(edges, total)


def _bounding_boxes(
    domain: Mesh, cells: Numbers, first: Numbers, present: Numbers, bodies: int
) -> tuple[Vector, Vector]:
    """Return the least and largest coordinates (bodies, gdim) of bodies. Collective.

    Those on this rank have their cells in a row.
    """
    low = np.full((bodies, domain.geometry.dim), np.inf)
    high = -low
    nodes = _compat.geometry_cells(domain)[cells]
    # by component: reductions over long columns are faster than those over short rows
    for k in range(domain.geometry.dim if present.size else 0):
        x = domain.geometry.x[:, k][nodes.ravel()]
        low[present, k] = np.minimum.reduceat(x, first * nodes.shape[1])
        high[present, k] = np.maximum.reduceat(x, first * nodes.shape[1])
    domain.comm.Allreduce(MPI.IN_PLACE, low, MPI.MIN)
    domain.comm.Allreduce(MPI.IN_PLACE, high, MPI.MAX)
    noise = RELATIVE_ROUNDING * (high - low).max(axis=1, keepdims=True)
    return np.where(np.abs(low) < noise, 0.0, low), np.where(np.abs(high) < noise, 0.0, high)


# -- the graph of the cells ---------------------------------------------------------------------


def cell_graph(domain: Mesh) -> sp.csr_matrix:
    """Return the adjacency matrix of the cells that this rank owns, through common facets."""
    return adjacency(cell_facets(domain)[: owned_cells(domain)])


def adjacency(facets: Indices | Numbers) -> sp.csr_matrix:
    """Return the adjacency matrix of cells with facets (m, f), through common ones."""
    owned = len(facets)
    # bisection takes the first of equal moves: neighbours are in the order of facets' numbers
    rows = np.sort(facets, axis=1)[:, ::-1]
    flat, cell = rows.ravel(), np.repeat(np.arange(owned), rows.shape[1])
    inner = np.bincount(flat)[flat] == 2
    other = np.bincount(flat, cell)[flat] - cell
    ends = np.append(0, np.cumsum(np.count_nonzero(inner.reshape(rows.shape), axis=1)))
    neighbours, ones = other[inner].astype(np.int32), np.ones(int(ends[-1]), dtype=np.int8)
    return sp.csr_matrix((ones, neighbours, ends), shape=(owned, owned))


def components(graph: sp.csr_matrix, label: Numbers) -> tuple[int, Numbers]:
    """Return the number of connected components of equal labels, and the component of each cell."""
    equal = np.repeat(label, np.diff(graph.indptr)) == label[graph.indices]
    ends = np.append(0, np.cumsum(equal))[graph.indptr]
    # SciPy would convert other data to float
    cut = sp.csr_matrix((np.ones(ends[-1]), graph.indices[equal], ends), shape=graph.shape)
    number, component = connected_components(cut, directed=False)
    return int(number), component


def groups(label: Numbers) -> list[Indices]:
    """Return the positions of each label, ascending, by ascending label."""
    order = np.argsort(label, kind="stable").astype(np.int32)
    cuts = np.flatnonzero(np.diff(label[order])) + 1
    return [group for group in np.split(order, cuts) if group.size]

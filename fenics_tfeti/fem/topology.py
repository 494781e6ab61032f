"""Cells and facets of a mesh: cell type, numbering, tables of their nodes, exterior facets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from dolfinx.fem import FunctionSpace
from dolfinx.mesh import Mesh, exterior_facet_indices

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.geometry.reference_cells import ReferenceCell, reference_cell
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Array, Indices, Mask, Numbers

Tag: TypeAlias = int | tuple[int, ...]
"""That of a surface, or several."""

NO_TAG = int(np.iinfo(np.int64).min)
"""In place of a tag, where there is none."""


def cell_type(domain: Mesh) -> ReferenceCell:
    """Return the type of the mesh's cells."""
    return reference_cell(_compat.cell_name(domain))


def owned_cells(domain: Mesh) -> int:
    """Return the number of cells that this rank owns; ghosts are numbered after them."""
    return int(domain.topology.index_map(domain.topology.dim).size_local)


def with_tag_names(tags: Any, names: Mapping[int, str]) -> Any:
    """Let tags of cells or facets carry the name of each tag that has one; return them."""
    tags.tag_names = dict(names)
    return tags


def tag_names(tags: Any) -> Mapping[int, str]:
    """Return the names that tags carry, by tag."""
    return getattr(tags, "tag_names", {})


def each_tag(tag: Tag) -> tuple[int, ...]:
    """Return the tags of a surface as a tuple."""
    return tag if isinstance(tag, tuple) else (tag,)


def find_tagged(tags: Any, tag: Tag) -> Indices:
    """Return the entities of this rank with a tag, or with any of several, ascending."""
    return np.sort(np.concatenate([tags.find(t) for t in each_tag(tag)])).astype(np.int32)


def dense_tags(tags: Any, size: int) -> Numbers:
    """Return the tags, if any, of the first entities of this rank; `NO_TAG` for those without."""
    dense = np.full(size, NO_TAG, dtype=np.int64)
    if tags is not None:
        first = tags.indices < size
        dense[tags.indices[first]] = tags.values[first]
    return dense


def tags_of_cells(domain: Mesh, cell_tags: Any) -> Numbers:
    """Return the tag of each cell that this rank owns; all cells need one. Collective."""
    owned = owned_cells(domain)
    with raise_collectively(domain.comm):
        if not (hasattr(cell_tags, "indices") and hasattr(cell_tags, "dim")):
            raise InputError(
                f"cell_tags is a {type(cell_tags).__name__}; the mesh tags of the cells are "
                "expected, as returned by dolfinx.mesh.meshtags"
            )
        if cell_tags.dim != domain.topology.dim:
            raise InputError(
                f"cell_tags are on entities of dimension {cell_tags.dim}, cells have dimension "
                f"{domain.topology.dim}: were the facet tags passed?"
            )
        tags = dense_tags(cell_tags, owned)
        if untagged := np.count_nonzero(tags == NO_TAG):
            raise InputError(
                f"cell_tags leave {untagged} of {owned} cells of rank "
                f"{domain.comm.rank} without a tag: tag every cell, or leave cell_tags out where "
                "they are optional"
            )
    return tags


def global_numbers(index_map: Any, local: Array) -> Numbers:
    """Return the global numbers of local ones of an index map, in an array of the same shape."""
    numbers = index_map.local_to_global(local.ravel().astype(np.int32))
    return np.asarray(numbers, dtype=np.int64).reshape(local.shape)


def cell_vertices(domain: Mesh) -> Indices:
    """Return the rows (cells, v) of ``geometry.x`` at the vertices of each cell, ghosts last."""
    return _compat.geometry_cells(domain)[:, : cell_type(domain).vertices]


def vertex_nodes(space: FunctionSpace) -> Indices:
    """Return the local nodes (cells, v) of a space at vertices, in the order of `cell_vertices`."""
    return _compat.cell_dofs(space)[:, : cell_type(space.mesh).vertices]


def nodes_in(other: FunctionSpace, space: FunctionSpace) -> Numbers:
    """Return the local node of another space at each node of a space; 0 at those at no vertex."""
    nodes = np.zeros(int(_compat.cell_dofs(space).max(initial=-1)) + 1, dtype=np.int64)
    nodes[vertex_nodes(space)] = vertex_nodes(other)
    return nodes


def cell_facets(domain: Mesh) -> Indices:
    """Return the facets (cells, facets of a cell) of each cell of this rank, ghosts last."""
    dim = domain.topology.dim
    domain.topology.create_entities(dim - 1)
    domain.topology.create_connectivity(dim, dim - 1)
    facets = np.asarray(domain.topology.connectivity(dim, dim - 1).array)
    # reshaped by the cell type: a rank may have no cells
    return facets.reshape(-1, len(cell_type(domain).facets))


def cells_of_facets(domain: Mesh, facets: Indices) -> tuple[Indices, Numbers]:
    """Return a cell (f,) of each of some facets of this rank, and the number of the facet in it."""
    dim = domain.topology.dim
    domain.topology.create_connectivity(dim - 1, dim)
    links = domain.topology.connectivity(dim - 1, dim)
    cells = np.asarray(links.array)[np.asarray(links.offsets)[facets]]
    return cells, np.argmax(cell_facets(domain)[cells] == facets[:, None], axis=1)


def facet_corners(domain: Mesh, cells: Numbers | Indices, numbers: Numbers) -> Indices:
    """Return the rows (f, v) of ``geometry.x`` around facets of cells, by numbers in these."""
    corners = np.array(cell_type(domain).facet_nodes(1))[numbers]
    return np.take_along_axis(cell_vertices(domain)[cells], corners, axis=1)


def exterior_facets(domain: Mesh) -> Mask:
    """Tell which facets of this rank are on the boundary of the mesh; False for ghosts."""
    dim = domain.topology.dim
    domain.topology.create_entities(dim - 1)
    domain.topology.create_connectivity(dim - 1, dim)
    facets = domain.topology.index_map(dim - 1)
    exterior = np.zeros(facets.size_local + facets.num_ghosts, dtype=bool)
    exterior[exterior_facet_indices(domain.topology)] = True
    return exterior


def exterior_cell_facets(domain: Mesh) -> Mask:
    """Tell which facets of each owned cell are on the boundary of the mesh."""
    return exterior_facets(domain)[cell_facets(domain)[: owned_cells(domain)]]


def connected_labels(pairs: Numbers, size: int) -> Numbers:
    """Return the connected component of each of `size` labels, which pairs (p, 2) join."""
    graph = sp.csr_matrix((np.ones(len(pairs)), tuple(pairs.T)), shape=(size, size))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def distinct_rows(rows: Numbers) -> tuple[Numbers, Numbers]:
    """Return the distinct rows (n, k), sorted, and where each row is; faster than NumPy's."""
    order = np.lexsort(rows.T[::-1])
    ascending = rows[order]
    is_new = np.ones(len(rows), dtype=bool)
    is_new[1:] = (ascending[1:] != ascending[:-1]).any(axis=1)
    inverse = np.zeros(len(rows), dtype=np.int64)
    inverse[order] = np.cumsum(is_new) - 1
    return ascending[is_new], inverse

"""The graph of the cells that a rank owns: an edge joins two cells with a common facet."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from dolfinx.mesh import Mesh

from fenics_tfeti.fem.topology import cell_facets, owned_cells
from fenics_tfeti.typing import Indices, Numbers


def cell_graph(domain: Mesh) -> sp.csr_matrix:
    """Return the adjacency matrix (cells, cells) of the cells that this rank owns."""
    facet_of = cell_facets(domain)
    owned = owned_cells(domain)
    facets = facet_of[:owned]
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


def connected_groups(graph: sp.csr_matrix, label: Numbers, cells: Indices) -> list[Indices]:
    """Split cells (n,) into connected components of equal labels."""
    return [cells[group] for group in groups(components(graph, label)[1])]

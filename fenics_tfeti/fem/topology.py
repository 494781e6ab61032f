"""Cells and facets of a distributed mesh: cell type, numbering, exterior facets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dolfinx.fem import FunctionSpace
from dolfinx.mesh import Mesh, exterior_facet_indices

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.reference_cells import ReferenceCell, reference_cell

__all__ = [
    "cell_facets",
    "cell_type",
    "cell_vertices",
    "exterior_cell_facets",
    "exterior_facets",
    "owned_cells",
    "vertex_nodes",
]

Indices = NDArray[np.int32]


def cell_type(domain: Mesh) -> ReferenceCell:
    """Return the type of the mesh's cells."""
    return reference_cell(_compat.cell_name(domain))


def owned_cells(domain: Mesh) -> int:
    """Return the number of cells that this rank owns; ghosts are numbered after them."""
    return int(domain.topology.index_map(domain.topology.dim).size_local)


def cell_vertices(domain: Mesh) -> Indices:
    """Return the rows (cells, v) of ``geometry.x`` at the vertices of each cell, ghosts last."""
    return _compat.geometry_cells(domain)[:, : cell_type(domain).vertices]


def vertex_nodes(space: FunctionSpace) -> Indices:
    """Return the local nodes (cells, v) of a space at the vertices of each cell, ghosts last.

    They are in the order of `cell_vertices`, and that of spaces of other degrees.
    """
    return _compat.cell_dofs(space)[:, : cell_type(space.mesh).vertices]


def cell_facets(domain: Mesh) -> Indices:
    """Return the facets (cells, facets of a cell) of each cell of this rank, ghosts last."""
    dim = domain.topology.dim
    domain.topology.create_entities(dim - 1)
    domain.topology.create_connectivity(dim, dim - 1)
    facets = np.asarray(domain.topology.connectivity(dim, dim - 1).array)
    # reshaped by the cell type: a rank may have no cells
    return facets.reshape(-1, len(cell_type(domain).facets))


def exterior_facets(domain: Mesh) -> NDArray[np.bool_]:
    """Tell which facets of this rank are on the boundary of the mesh; False for ghosts."""
    dim = domain.topology.dim
    domain.topology.create_entities(dim - 1)
    domain.topology.create_connectivity(dim - 1, dim)
    facets = domain.topology.index_map(dim - 1)
    exterior = np.zeros(facets.size_local + facets.num_ghosts, dtype=bool)
    exterior[exterior_facet_indices(domain.topology)] = True
    return exterior


def exterior_cell_facets(domain: Mesh) -> NDArray[np.bool_]:
    """Tell which facets of each owned cell are on the boundary of the mesh."""
    of_cell: NDArray[np.bool_] = exterior_facets(domain)[cell_facets(domain)[: owned_cells(domain)]]
    return of_cell

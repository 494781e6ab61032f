"""Dual shape functions, and the mortar matrices D and M with the gaps.

The Lagrange multipliers are linear combinations of dual functions psi_k, one for each node of the
slave: on each facet psi_j = sum_i A_ji N_i with A = diag(int N_j) (int N_i N_j)^-1, integrals over
the covered part alone. There int psi_j N_i = 0 for i != j, and the psi_j of a facet add up to 1.

Where only a narrow strip or a small corner of a facet is covered, the functions of its nodes are
fixed by next to nothing: their pressure is that of the rim, where it is singular, and their gap an
extrapolation. A node that is barely covered therefore has no multiplier: its dual function is
added, in equal shares, to those of the neighbours that are covered better. The functions still add
up to 1, so that rigid motions, linear functions and resultants stay exact; D has entries beside its
diagonal there.

For displacements of degree 2 the dual functions are the same, of degree 1 at the vertices, and D
couples each of them with all nodes of its facets. Their combinations contain constants, not linear
functions: the error in the energy norm of a smooth problem falls with h^1.5, as much as contact
allows, whose solutions have no more than 5/2 derivatives. Surfaces that are tied have the shape
functions of degree 1 as multipliers: there it falls with h^2. At the border of a contact these
overshoot, and the dual functions do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.fem.contact.mortar.facets import Facets, Planes
from fenics_tfeti.fem.contact.mortar.integrals import FacetIntegrals
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.typing import Mask, Numbers, Vector

# Coverage of a node: the integral of its shape function over the covered part, relative to that
# over all of its facets. Below the first it has no multiplier where neighbours are covered better:
# half is what the border of a master leaves of an edge that goes through a node. A node that had a
# multiplier before keeps it down to the second, since multipliers that come and go with small
# changes of the surfaces would alternate. Below the third it has none in any case: its force is
# negligible.
BARELY_COVERED, HARDLY_COVERED, SLIVER_COVERED = 0.4, 0.2, 1e-2


@dataclass(frozen=True)
class MortarMatrices:
    """D, M and the gaps of a slave's surface with n nodes and a master's with m nodes.

    With the displacements of both surfaces, the mean relative displacement at slave node k is
    (sum_j D_kj u_j - sum_l M_kl u_l) / area_k.
    """

    D: sp.csr_matrix  # (n, n): integrals of psi_k N^s_j [m^2 or m]; for degree 1 diagonal
    M: sp.csr_matrix  # (n, m): integrals of psi_k N^m_l
    gap: Vector  # (n, gdim): integrals of psi_k times the vector from the slave to the master
    area: Vector  # (n,): integrals of psi_k, the sums of the rows of D and of M


def mortar_matrices(
    integrals: FacetIntegrals, slave: Facets, master: Facets, dual: bool = True
) -> MortarMatrices:
    """Assemble D, M and gaps of covered nodes; multipliers are dual or shape functions."""
    n, m = len(slave.points), len(master.points)
    corners = slave.corners[integrals.facet]
    psi, slave_products = (
        _dual_functions(integrals, slave)
        if dual
        else (np.tile(np.eye(corners.shape[1]), (len(corners), 1, 1)), integrals.trace)
    )
    master_products = np.matmul(psi[integrals.pair], integrals.coupling)
    nodal_gaps = np.matmul(psi, integrals.gap).reshape(corners.size, slave.points.shape[1])
    gap = np.stack([_sums(corners, part, n) for part in nodal_gaps.T], axis=1)
    D = _assemble(slave_products, corners, slave.nodes[integrals.facet], (n, n))
    M = _assemble(master_products, corners[integrals.pair], master.nodes[integrals.master], (n, m))
    return MortarMatrices(D, M, gap, np.asarray(D.sum(axis=1)).ravel())


def multiplier_shares(coverage: Vector, least: Vector, free: Mask, pairs: Numbers) -> sp.csc_matrix:
    """Return the shares (n, n) of nodes in the dual functions of others.

    Column j has 1 at j if it keeps its function, or the shares of others, whose sum is 1; it is
    empty where no node around has a multiplier. Nodes have the coverage (n,), the `least` one with
    which they keep their function, and no multiplier where they are `free`; pairs (p, 2) are
    corners of one covered facet, in both orders.
    """
    j, k = pairs.T
    better = coverage[k] > (1.0 + RELATIVE_ROUNDING) * coverage[j]
    takes = ~free[k] & (free[j] | (coverage[j] < least[j]) & better)
    size = (coverage.size, coverage.size)
    links = sp.csc_matrix((np.ones(takes.sum()), (k[takes], j[takes])), shape=size)
    links.data[:] = 1.0
    number = np.diff(links.indptr)
    kept = (number == 0) & ~free & (coverage > SLIVER_COVERED)
    shares = links @ sp.diags(1.0 / np.maximum(number, 1)) + sp.diags((number == 0).astype(float))
    # what is given to nodes that give it on: always to nodes that are covered better
    while shares[number > 0].nnz:
        shares = shares @ shares
    shares = sp.diags(kept.astype(float)) @ shares
    shares.eliminate_zeros()
    return shares.tocsc()


def node_areas(integrals: FacetIntegrals, slave: Facets) -> tuple[Vector, Vector]:
    """Return the whole and the covered area (n,) of each slave node, without weight [m^2 or m]."""
    n, v = len(slave.points), slave.number_of_corners
    area = np.repeat(_areas(slave) / v, v)
    covered = slave.corners[integrals.facet]
    return _sums(slave.corners, area, n), _sums(covered, integrals.share, n)


def _sums(nodes: Numbers, values: Vector, n: int) -> Vector:
    """Sum values by their nodes, (n,)."""
    return np.bincount(nodes.ravel(), values.ravel(), n).astype(np.float64, copy=False)


def _dual_functions(integrals: FacetIntegrals, slave: Facets) -> tuple[Vector, Vector]:
    """Return A (c, v, v) of psi_j = sum_i A_ji N_i, and the integrals (c, v, t) of psi_j N^s_i."""
    v = integrals.ones.shape[1]
    # a narrow strip may cross the facet anywhere: the functions are the shape functions then
    narrow = integrals.covered <= 1e-4 * _areas(slave)[integrals.facet]
    dual = np.tile(np.eye(v), (narrow.size, 1, 1))
    ones = integrals.ones[~narrow]
    # scaled to a unit diagonal: a strip along an edge leaves the opposite node little
    root = np.sqrt(ones)
    scaled = integrals.mass[~narrow] / (root[:, :, None] * root[:, None, :])
    dual[~narrow] = root[:, :, None] * np.linalg.inv(scaled) / root[:, None, :]
    products = np.matmul(dual, integrals.trace)
    if integrals.trace.shape[2] == v:
        # exactly diagonal
        products[~narrow] = ones[:, :, None] * np.eye(v)
    return dual, products


def _areas(slave: Facets) -> Vector:
    """Return the areas (f,) of the facets, sums over their pieces [m^2 or m]."""
    pieces = Planes.of(slave.coordinates()).area.reshape(len(slave), slave.per_facet)
    return pieces.sum(axis=1)


def _assemble(
    values: Vector, rows: Numbers, columns: Numbers, shape: tuple[int, int]
) -> sp.csr_matrix:
    """Sum blocks (c, v, w) of rows (c, v) and columns (c, w); without what is rounding of zeros.

    Without it, a node of flat surfaces with matching meshes is coupled with the one opposite alone.
    """
    # the type of SciPy's indices, of which there are many more than rows and columns
    row = np.repeat(rows.astype(np.int32), columns.shape[1])
    column = np.tile(columns.astype(np.int32), rows.shape[1]).ravel()
    matrix = sp.coo_matrix((values.ravel(), (row, column)), shape=shape).tocsr()
    filled = np.flatnonzero(np.diff(matrix.indptr))
    if filled.size:
        size = np.abs(matrix.data)
        largest = np.maximum.reduceat(size, matrix.indptr[filled])
        rounding = 1e-13 * np.repeat(largest, np.diff(matrix.indptr)[filled])
        matrix.data[size <= rounding] = 0.0
    matrix.eliminate_zeros()
    return matrix

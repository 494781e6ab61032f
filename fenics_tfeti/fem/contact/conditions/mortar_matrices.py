"""Dual shape functions, and the mortar matrices D and M with the gaps.

The Lagrange multipliers are linear combinations of dual functions psi_k, one for each node of the
slave. On each facet they are dual to the shape functions of the smallest facet around the covered
part: with its corners x_j and T_ij = N_i(x_j), psi_j = sum_i A_ji N_i, A = P (int N_i N_j)^-1,

    int psi_j N_i = P_ji = d_j T_ij,  d = T^-1 int N > 0,

integrals over the covered part alone. The psi_j of a facet add up to 1, and sum_j P_ji = int N_i:
constants, linear functions and resultants are exact. Where all of a facet is covered T is the unit
matrix, and int psi_j N_i = 0 for i != j. At the rim of the master the condition of node j speaks of
x_j, which is on the rim or next to it: its force does not act beyond what is covered. D has entries
beside its diagonal there.

A function is well-defined by a narrow strip, too, but its force per area is that of the rim, where
pressures are singular: pressures are reported as means with neighbours that are covered better.
Only a node with a tiny support has no multiplier. Its dual function is added, in equal shares, to
those of the neighbours that are supported better: the functions still add up to 1.

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

from fenics_tfeti.fem.geometry.facets import Facets
from fenics_tfeti.fem.geometry.integrals import FacetIntegrals
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.typing import Mask, Numbers, Vector

# Support of a node: the integral of the square of its shape function over the covered part, over
# that of the function, relative to this of whole facets. On a strip along an edge it is the part of
# the facet's width that is covered. Below the first a node has no multiplier where neighbours are
# supported better; one that had a multiplier before keeps it down to the second, since multipliers
# that come and go with small changes of the surfaces would alternate. The third is the share of the
# area around a node, below which it has none in any case: its force is negligible.
BARELY_SUPPORTED, HARDLY_SUPPORTED, SLIVER_COVERED = 0.1, 0.05, 1e-3

# Covered share of the area around a node below which its pressure is the mean of neighbours: half
# is what the border of a master leaves of an edge that goes through a node.
BARELY_COVERED = 0.4

# entries, zeros as well, of matrices that are summed faster as dense ones than by SciPy
_SMALL = 100_000


@dataclass(frozen=True)
class Entries:
    """The entries (k,) of a sparse matrix, by row and column."""

    row: Numbers
    column: Numbers
    value: Vector
    shape: tuple[int, int]

    @staticmethod
    def of(matrix: sp.spmatrix) -> Entries:
        """Return those of a matrix."""
        entries = matrix.tocoo()
        return Entries(entries.row, entries.col, entries.data, entries.shape)

    def matrix(self) -> sp.csr_matrix:
        """Return the matrix."""
        return sp.csr_matrix((self.value, (self.row, self.column)), shape=self.shape)

    def sums(self) -> Vector:
        """Return the sum of each row."""
        return np.bincount(self.row, self.value, self.shape[0]).astype(np.float64, copy=False)


@dataclass(frozen=True)
class MortarMatrices:
    """D, M and the gaps of a slave's surface with n nodes and a master's with m nodes.

    With the displacements of both surfaces, the mean relative displacement at slave node k is
    (sum_j D_kj u_j - sum_l M_kl u_l) / area_k.
    """

    D: Entries  # (n, n): integrals of psi_k N^s_j [m^2 or m]; see above
    M: Entries  # (n, m): integrals of psi_k N^m_l
    gap: Vector  # (n, gdim): integrals of psi_k times the vector from the slave to the master
    area: Vector  # (n,): integrals of psi_k, the sums of the rows of D and of M


def mortar_matrices(
    integrals: FacetIntegrals, slave: Facets, master: Facets, dual: bool = True
) -> MortarMatrices:
    """Assemble D, M and gaps of covered nodes; multipliers are dual or shape functions."""
    n, m = len(slave.points), len(master.points)
    corners = slave.corners[integrals.facet]
    psi, slave_products = (
        dual_functions(integrals, slave)
        if dual
        else (np.tile(np.eye(corners.shape[1]), (len(corners), 1, 1)), integrals.trace)
    )
    master_products = np.matmul(psi[integrals.pair], integrals.coupling)
    nodal_gaps = np.matmul(psi, integrals.gap).reshape(corners.size, slave.points.shape[1])
    gap = np.stack([_sums(corners, part, n) for part in nodal_gaps.T], axis=1)
    D = _summed(slave_products, corners, slave.nodes[integrals.facet], (n, n))
    M = _summed(master_products, corners[integrals.pair], master.nodes[integrals.master], (n, m))
    return MortarMatrices(D, M, gap, D.sums())


def multiplier_shares(support: Vector, least: Vector, free: Mask, pairs: Numbers) -> sp.csc_matrix:
    """Return the shares (n, n) of nodes in the dual functions of others.

    Column j has 1 at j if it keeps its function, or the shares of others, whose sum is 1; it is
    empty where no node around has a multiplier. Nodes have the support (n,), the `least` one with
    which they keep their function, and no multiplier where they are `free`; pairs (p, 2) are
    corners of one covered facet, in both orders.
    """
    j, k = pairs.T
    better = support[k] > (1.0 + RELATIVE_ROUNDING) * support[j]
    takes = ~free[k] & (free[j] | (support[j] < least[j]) & better)
    n = support.size
    giver, taker = np.divmod(np.unique(n * j[takes] + k[takes]), n)
    number = np.bincount(giver, minlength=n)
    alone = np.flatnonzero(number == 0)
    values = np.concatenate([1.0 / number[giver], np.ones(alone.size)])
    places = np.append(taker, alone), np.append(giver, alone)
    shares = sp.csc_matrix((values, places), shape=(n, n))
    # what is given to nodes that give it on: always to nodes that are supported better
    while number[shares.indices].any():
        shares = shares @ shares
    shares.data *= (~free & (support > 0.0))[shares.indices]
    shares.eliminate_zeros()
    return shares


def covered_shares(slave: Facets, integrals: FacetIntegrals) -> Vector:
    """Return the share (f,) of each slave facet that is covered."""
    shares = np.zeros(len(slave))
    shares[integrals.facet] = integrals.covered / slave.areas[integrals.facet]
    return shares


def node_sums(integrals: FacetIntegrals, slave: Facets) -> Vector:
    """Return sums (n, 4) of facets for the `coverage_and_support` of nodes [m^2 or m].

    They are the whole and the covered area of each node, without weight, the integrals of N_j^2,
    relative to this on whole facets, and those of N_j.
    """
    n, v = len(slave.points), slave.number_of_corners
    covered = slave.corners[integrals.facet]
    # int N_j^2 / int N_j of a whole segment, triangle, parallelogram
    whole = {2: 2 / 3, 3: 1 / 2, 4: 4 / 9}[v]
    squares = np.einsum("cjj->cj", integrals.mass) / whole
    columns = [_sums(slave.corners, np.repeat(slave.areas / v, v), n)]
    columns += [_sums(covered, part, n) for part in (integrals.share, squares, integrals.ones)]
    return np.column_stack(columns)


def coverage_and_support(sums: Vector) -> tuple[Vector, Vector]:
    """Return the covered share (n,) of nodes, and their support (n,), 0 for slivers.

    The `node_sums` (n, 4) are those of all facets.
    """
    full, covered, squares, ones = sums.T
    # of degree 2, nodes that are no vertices have no area
    coverage = np.divide(covered, full, out=np.zeros_like(full), where=full > 0.0)
    support = np.divide(squares, ones, out=np.zeros_like(ones), where=ones > 0.0)
    return coverage, np.where(coverage > SLIVER_COVERED, support, 0.0)


def _sums(nodes: Numbers, values: Vector, n: int) -> Vector:
    """Sum values by their nodes, (n,)."""
    return np.bincount(nodes.ravel(), values.ravel(), n).astype(np.float64, copy=False)


def dual_functions(integrals: FacetIntegrals, slave: Facets) -> tuple[Vector, Vector]:
    """Return A (c, v, v) of psi_j = sum_i A_ji N_i, and the integrals (c, v, t) of psi_j N^s_i."""
    v = integrals.ones.shape[1]
    # a narrow strip may cross the facet anywhere: the functions are the shape functions then
    narrow = integrals.covered <= 1e-4 * slave.areas[integrals.facet]
    dual = np.tile(np.eye(v), (narrow.size, 1, 1))
    ones = integrals.ones[~narrow]
    # P: the integrals of the small facet's functions times their values in the corners of the facet
    rim = integrals.rim[~narrow]
    exact = np.linalg.solve(rim, ones[:, :, None]) * rim.swapaxes(1, 2)
    # scaled to a unit diagonal: a strip along an edge leaves the opposite node little
    root = np.sqrt(ones)
    inverse = np.linalg.inv(integrals.mass[~narrow] / (root[:, :, None] * root[:, None, :]))
    dual[~narrow] = exact @ (inverse / (root[:, :, None] * root[:, None, :]))
    products = np.matmul(dual, integrals.trace)
    if integrals.trace.shape[2] == v:
        # without rounding: diagonal off the rim
        products[~narrow] = exact
    return dual, products


def _summed(values: Vector, rows: Numbers, columns: Numbers, shape: tuple[int, int]) -> Entries:
    """Sum blocks (c, v, w) of rows (c, v) and columns (c, w); without what is rounding of zeros.

    Without it, a node of flat surfaces with matching meshes is coupled with the one opposite alone.
    """
    if shape[0] * shape[1] <= _SMALL:
        place = (rows[:, :, None] * shape[1] + columns[:, None, :]).ravel()
        dense = np.bincount(place, values.ravel(), shape[0] * shape[1])
        row, column = np.divmod(np.flatnonzero(dense), shape[1])
        value = dense[dense != 0.0]
    else:
        # the type of SciPy's indices, of which there are many more than rows and columns
        at = (
            np.repeat(rows.astype(np.int32), columns.shape[1]),
            np.tile(columns.astype(np.int32), rows.shape[1]).ravel(),
        )
        summed = sp.coo_matrix((values.ravel(), at), shape=shape).tocsr().tocoo()
        row, column, value = summed.row, summed.col, summed.data
    first = np.flatnonzero(np.diff(row, prepend=-1))
    size = np.abs(value)
    if first.size:
        largest = np.maximum.reduceat(size, first)
        kept = size > 1e-13 * np.repeat(largest, np.diff(first, append=row.size))
        row, column, value = row[kept], column[kept], value[kept]
    return Entries(row, column, value, shape)

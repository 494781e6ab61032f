"""Bodies of many cells cut by planes across their longest axes, with interfaces smoothed.

The cuts are those of recursive inertial bisection (Simon, Comput. Syst. Eng. 2 (1991) 135-148). A
graph partitioner takes several times as long for an interface that is a few per cent smaller.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.fem.decomposition.cell_graph import components
from fenics_tfeti.typing import Indices, Numbers, Points

# variance along a coordinate axis, relative to the largest one, at which cuts are across that axis:
# slanted cuts of a body along the axes have larger areas
_LONG_ENOUGH = 0.8
# passes over the cells at interfaces: more make the interface of tetrahedra 1 % smaller
_PASSES = 6
# cells of a piece that is a subdomain of its own, relative to the mean of all parts
_LARGE = 0.3


def bisect(graph: sp.csr_matrix, midpoints: Points, parts: int) -> Numbers:
    """Cut a connected set of cells into parts with nearly as many cells each.

    Parameters
    ----------
    graph : (m, m) scipy.sparse.csr_matrix
        Adjacency of the cells.
    midpoints : (m, d) array
        Their midpoints [m].
    parts : int
        Wanted number of parts, at most m.

    Returns
    -------
    (m,) integer array
        The part of each cell. Every part is connected; there are more of them than wanted where
        planes cut a part in two, and fewer where these pieces are small.

    Examples
    --------
    >>> import numpy as np, scipy.sparse as sp
    >>> row = sp.diags([1.0, 1.0], [-1, 1], shape=(4, 4), format="csr")
    >>> x = np.array([[0.0], [1.0], [2.0], [3.0]])
    >>> bisect(row, x, 2).tolist()
    [0, 0, 1, 1]
    """
    label = np.zeros(len(midpoints), dtype=np.int64)
    _cut(midpoints, np.arange(len(midpoints)), parts, label)
    return _connected(graph, _smoothed(graph, label), parts)


def _cut(x: Points, cells: Numbers, parts: int, label: Numbers) -> None:
    """Give the parts of some cells numbers from the one on that they have in `label`."""
    if parts == 1:
        return
    fewer = parts // 2
    count = cells.size * fewer // parts
    order = np.argpartition(_along_longest_axis(x[cells]), count)
    before, behind = cells[order[:count]], cells[order[count:]]
    label[behind] += fewer
    _cut(x, before, fewer, label)
    _cut(x, behind, parts - fewer, label)


def _along_longest_axis(x: Points) -> Points:
    """Return the coordinate along which points are spread most."""
    relative = x - x.mean(axis=0)
    covariance = relative.T @ relative
    variances, axes = np.linalg.eigh(covariance)
    longest = int(np.argmax(np.diag(covariance)))
    if covariance[longest, longest] >= _LONG_ENOUGH * variances[-1]:
        along: Points = relative[:, longest]
    else:
        along = relative @ axes[:, -1]
    return along


def _smoothed(graph: sp.csr_matrix, label: Numbers) -> Numbers:
    """Let cells join the part in which most of their neighbours are.

    Of neighbours only one moves at a time. Every second pass also moves cells that have as many
    neighbours in their own part, which lets others follow.
    """
    near = _neighbours(graph)
    # behind the cells is what stands for missing neighbours
    label, nobody = np.append(label, -1), len(near)
    turn = np.append(np.random.default_rng(0).permutation(nobody), 0)
    watched = np.arange(nobody)
    for step in range(_PASSES):
        of_near = label[near[watched]]
        at_interface = ((of_near >= 0) & (of_near != label[watched][:, None])).any(axis=1)
        watched, of_near = watched[at_interface], of_near[at_interface]
        gain, best = _best_move(label[watched], of_near)
        moving = gain >= (1 if step % 2 == 0 else 0)
        urgency = np.zeros(nobody + 1, dtype=np.int64)
        urgency[watched[moving]] = gain[moving] * nobody + turn[watched[moving]] + 1
        moving &= urgency[watched] > urgency[near[watched]].max(axis=1)
        label[watched[moving]] = best[moving]
        watched = np.union1d(watched, near[watched[moving]].ravel())
        watched = watched[watched < nobody]
    return label[:-1]


def _best_move(own: Numbers, of_near: Numbers) -> tuple[Numbers, Numbers]:
    """Return by how much moving each cell reduces the interface, in facets, and where to."""
    other = (of_near >= 0) & (of_near != own[:, None])
    count = np.sum((of_near[:, :, None] == of_near[:, None, :]) & other[:, :, None], axis=1)
    row, best = np.arange(own.size), np.argmax(count, axis=1)
    gain: Numbers = count[row, best] - np.sum(of_near == own[:, None], axis=1)
    return gain, of_near[row, best]


def _neighbours(graph: sp.csr_matrix) -> Indices:
    """Return the neighbours of each cell in rows, filled with the number of cells."""
    cells, degree = graph.shape[0], np.diff(graph.indptr)
    near = np.full((cells, int(degree.max(initial=1))), cells, dtype=np.int32)
    row = np.repeat(np.arange(cells), degree)
    near[row, np.arange(graph.nnz) - graph.indptr[row]] = graph.indices
    return near


def _connected(graph: sp.csr_matrix, label: Numbers, parts: int) -> Numbers:
    """Return connected pieces; small ones join the piece with which they have most facets."""
    number, piece = components(graph, label)
    facets = _common_facets(graph, piece, number)
    joined, size = np.arange(number), np.bincount(piece)
    for one in np.argsort(size, kind="stable"):
        own = joined[one]
        if size[own] >= _LARGE * label.size / parts:
            continue
        near = slice(*facets.indptr[one : one + 2])
        others = joined[facets.indices[near]]
        common = np.where(others == own, 0, facets.data[near])
        if common.any():
            other = others[np.argmax(common)]
            size[other] += size[own]
            joined[joined == own] = other
    part: Numbers = np.unique(joined, return_inverse=True)[1][piece]
    return part


def _common_facets(graph: sp.csr_matrix, piece: Numbers, number: int) -> sp.csr_matrix:
    """Return the number of facets between any two pieces."""
    edges = graph.tocoo()
    ends = piece[edges.row], piece[edges.col]
    apart = ends[0] != ends[1]
    pairs = ends[0][apart], ends[1][apart]
    return sp.csr_matrix((np.ones(pairs[0].size), pairs), shape=(number, number))

"""Bodies of many cells cut by planes across their longest axes, with interfaces smoothed.

The cuts are those of recursive inertial bisection (Simon, Comput. Syst. Eng. 2 (1991) 135-148). A
graph partitioner takes several times as long for an interface that is a few per cent smaller.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.fem.decomposition.bodies import components
from fenics_tfeti.typing import Indices, Numbers, Vector

# variance along a coordinate axis, relative to the largest one, at which cuts are across that axis:
# slanted cuts of a body along the axes have larger areas
_LONG_ENOUGH = 0.8
# passes over the cells at interfaces: more make the interface of tetrahedra 1 % smaller
_PASSES = 6
# cells of a piece that is a subdomain of its own, relative to the mean of all parts
_LARGE = 0.3


def bisect(graph: sp.csr_matrix, midpoints: Vector, count: int) -> Numbers:
    """Cut a connected set of m cells into parts with nearly as many cells each; return the labels.

    Every part is connected; there are more of them than `count` <= m where planes cut a part in
    two, and fewer where these pieces are small. `graph` is the adjacency of the cells, `midpoints`
    are of shape (m, d).
    """
    label = np.zeros(len(midpoints), dtype=np.int64)
    _cut(midpoints, np.arange(len(midpoints)), count, label)
    return _connected(graph, _smoothed(graph, label), count)


def _cut(x: Vector, cells: Numbers, count: int, label: Numbers) -> None:
    """Give the parts of some cells numbers from the one on that they have in `label`."""
    if count == 1:
        return
    fewer = count // 2
    below = cells.size * fewer // count
    order = np.argpartition(_along_longest_axis(x[cells]), below)
    lower, upper = cells[order[:below]], cells[order[below:]]
    label[upper] += fewer
    _cut(x, lower, fewer, label)
    _cut(x, upper, count - fewer, label)


def _along_longest_axis(x: Vector) -> Vector:
    """Return the coordinate along which points are spread most."""
    relative = x - x.mean(axis=0)
    covariance = relative.T @ relative
    variances, axes = np.linalg.eigh(covariance)
    longest = int(np.argmax(np.diag(covariance)))
    if covariance[longest, longest] >= _LONG_ENOUGH * variances[-1]:
        coordinate: Vector = relative[:, longest]
    else:
        coordinate = relative @ axes[:, -1]
    return coordinate


def _smoothed(graph: sp.csr_matrix, label: Numbers) -> Numbers:
    """Let cells join the part in which most of their neighbours are.

    Of neighbours only one moves at a time. Every second pass also moves cells that have as many
    neighbours in their own part, which lets others follow.
    """
    neighbours = _neighbours(graph)
    # behind the cells is what stands for missing neighbours
    label, cells = np.append(label, -1), neighbours.shape[1]
    random_order = np.append(np.random.default_rng(0).permutation(cells), 0)
    watched = np.arange(cells)
    for step in range(_PASSES):
        labels = label[neighbours.take(watched, axis=1)]
        at_interface = ((labels >= 0) & (labels != label[watched])).any(axis=0)
        watched, labels = watched[at_interface], labels[:, at_interface]
        gain, best = _best_move(label[watched], labels)
        moving = gain >= (1 if step % 2 == 0 else 0)
        urgency = np.zeros(cells + 1, dtype=np.int64)
        urgency[watched[moving]] = gain[moving] * cells + random_order[watched[moving]] + 1
        moving &= urgency[watched] > urgency[neighbours[:, watched]].max(axis=0)
        label[watched[moving]] = best[moving]
        watched = np.union1d(watched, neighbours[:, watched[moving]].ravel())
        watched = watched[watched < cells]
    return label[:-1]


def _best_move(label: Numbers, labels: Numbers) -> tuple[Numbers, Numbers]:
    """Return by how much moving each cell reduces the interface, in facets, and where to.

    The labels (k, m) are those of the neighbours of m cells.
    """
    outside = (labels >= 0) & (labels != label)
    # short integers: several times faster
    count = np.sum((labels[:, None] == labels) & outside[:, None], axis=0, dtype=np.int8)
    best, cell = np.argmax(count, axis=0), np.arange(label.size)
    gain = count[best, cell] - np.sum(labels == label, axis=0, dtype=np.int8)
    return gain.astype(np.int64), labels[best, cell]


def _neighbours(graph: sp.csr_matrix) -> Indices:
    """Return the neighbours (k, m) of m cells in columns, filled with the number of cells."""
    count, degree = graph.shape[0], np.diff(graph.indptr)
    neighbours = np.full((int(degree.max(initial=1)), count), count, dtype=np.int32)
    cell = np.repeat(np.arange(count), degree)
    neighbours[np.arange(graph.nnz) - graph.indptr[cell], cell] = graph.indices
    return neighbours


def _connected(graph: sp.csr_matrix, label: Numbers, count: int) -> Numbers:
    """Return connected pieces; small ones join the piece with which they have most facets."""
    number, piece = components(graph, label)
    of_piece = sp.csr_matrix((np.ones(piece.size), piece, np.arange(piece.size + 1)))
    facets = (of_piece.T @ graph @ of_piece).tocsr()  # common ones of any two pieces
    facets.sort_indices()
    joined, size = np.arange(number), np.bincount(piece)
    for small in np.argsort(size, kind="stable"):
        target = joined[small]
        if size[target] >= _LARGE * label.size / count:
            continue
        entries = slice(*facets.indptr[small : small + 2])
        neighbours = joined[facets.indices[entries]]
        common = np.where(neighbours == target, 0, facets.data[entries])
        if common.any():
            best = neighbours[np.argmax(common)]
            size[best] += size[target]
            joined[joined == target] = best
    return np.unique(joined, return_inverse=True)[1][piece]

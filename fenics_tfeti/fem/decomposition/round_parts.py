"""Bodies cut into round parts: products with F follow the aspect of parts, not their interfaces.

Two ways, for bodies of any shape: slabs across the longest axis, each cut again, of numbers that
make parts round; and the parts of a graph partitioner, rounded by k-means. Interfaces are smoothed,
and pieces that are cut off join a neighbour.
"""

from __future__ import annotations

import itertools

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from fenics_tfeti.fem.decomposition.bodies import components
from fenics_tfeti.typing import Indices, Numbers, Vector

# variance along a coordinate axis, relative to the largest one, at which cuts are across that axis:
# slanted cuts of a body along the axes have larger areas
_LONG_ENOUGH = 0.8
# by which factors there may be fewer parts, which are larger then, and more than wanted
_FEWER, _MORE = 1.5, 2.4
# weight of the logarithm of this factor beside that of the aspect
_WEIGHT = 0.5
# passes of k-means, and the part of a difference in size that a pass takes back
_ROUNDINGS, _EVEN = 10, 0.1
# passes over the cells at interfaces: more make the interface of tetrahedra 1 % smaller
_PASSES = 6
# cells of a piece that is a subdomain of its own, relative to the mean of all parts
LARGE = 0.3


def cut_into_slabs(graph: sp.csr_matrix, midpoints: Vector, count: int) -> Numbers:
    """Cut m connected cells into slabs, these into bars, and bars into parts; return the labels.

    Parts have nearly as many cells each and are connected; their number is near `count` <= m.
    `graph` is the adjacency of the cells, `midpoints` are of shape (m, d).
    """
    label, first = np.zeros(len(midpoints), dtype=np.int64), itertools.count()
    _cut(midpoints, np.arange(len(midpoints)), float(count), midpoints.shape[1], label, first)
    return _connected(graph, _smoothed(graph, label), count)


def _cut(
    x: Vector, cells: Numbers, parts: float, cuts: int, label: Numbers, first: itertools.count[int]
) -> None:
    """Label the parts of some cells, with at most so many cuts across each other."""
    if cuts > 0 and parts > 1.0:
        along, length, _ = principal(x[cells])
        slabs, *others = _numbers_of_slabs(length, min(parts, cells.size))
    if cuts == 0 or parts <= 1.0 or slabs == 1:
        label[cells] = next(first)
        return
    order = np.argsort(np.round(along / (length[0] or 1.0), 9), kind="stable")
    for piece in np.array_split(cells[order], slabs):
        _cut(x, piece, float(np.prod(others)), cuts - 1, label, first)


def principal(x: Vector) -> tuple[Vector, Vector, Vector]:
    """Return the coordinate along which points are spread most, the edges (d,) of a box, the axis.

    The box, with the longest edge first, has the variances of the points.
    """
    relative = x - x.mean(axis=0)
    covariance = relative.T @ relative / len(x)
    variances, axes = np.linalg.eigh(covariance)
    own = np.diag(covariance)
    if own.max() >= _LONG_ENOUGH * variances[-1]:
        first = int(np.argmax(own))
        return relative[:, first], np.sqrt(12.0 * np.sort(own)[::-1]), np.eye(x.shape[1])[first]
    return relative @ axes[:, -1], np.sqrt(12.0 * variances[::-1].clip(min=0.0)), axes[:, -1]


def _numbers_of_slabs(length: Vector, parts: float) -> tuple[int, ...]:
    """Return into how many slabs a box is cut along its edges (d,), the longest first.

    They make the parts as round as can be, and their number near that wanted.
    """
    edge, thick = 0.0, length > 0.0
    for dim in range(int(thick.sum()), 0, -1):
        edge = (np.prod(length[:dim]) / parts) ** (1.0 / dim)
        if length[dim - 1] >= edge:
            break
    if edge == 0.0:
        return (max(1, round(parts)), *np.ones(len(length) - 1, dtype=int).tolist())
    nearby = [
        np.unique(np.concatenate([np.floor(wanted), np.ceil(wanted)]).clip(min=1.0))
        for wanted in np.outer(length[thick] / edge, [*np.geomspace(1.0 / _FEWER, _MORE, 7), 1.0])
    ]
    numbers = np.array([*itertools.product(*nearby)])
    edges, total = length[thick] / numbers, numbers.prod(axis=1)
    more = np.log(total / parts)
    cost = np.log(edges.max(axis=1) / edges.min(axis=1)) + _WEIGHT * np.abs(more)
    cost[(more > np.log(_MORE)) | (more < -np.log(_FEWER))] = np.inf
    best = numbers[np.argmin(np.round(cost, 9))].astype(int).tolist()
    return (*best, *np.ones(len(length) - len(best), dtype=int).tolist())


def rounded(graph: sp.csr_matrix, midpoints: Vector, label: Numbers) -> Numbers:
    """Return the parts of m connected cells rounded by k-means, of nearly equal sizes.

    They are the cells of a power diagram, whose weights even out the sizes.
    """
    count, cells = int(label.max()) + 1, label.size
    weight, zeros = np.zeros(count), np.zeros(cells)
    edge2 = (np.prod(np.ptp(midpoints, axis=0)) / count) ** (2.0 / midpoints.shape[1])
    for _ in range(_ROUNDINGS):
        size = np.bincount(label, minlength=count).clip(min=1)
        centre = np.stack([np.bincount(label, x, count) / size for x in midpoints.T], axis=1)
        weight += _EVEN * edge2 * (1.0 - size * count / cells)
        # the squared distance less the weight is a distance with one more coordinate
        tree = cKDTree(np.column_stack([centre, np.sqrt(weight.max() - weight)]))
        label = tree.query(np.column_stack([midpoints, zeros]))[1]
    return _connected(graph, _smoothed(graph, label.astype(np.int64)), count)


def mean_aspect(graph: sp.csr_matrix, midpoints: Vector, label: Numbers) -> float:
    """Return the mean ratio of the longest to the shortest extent of parts, by their cells."""
    edges = sp.triu(graph).tocoo()
    steps = midpoints[edges.row] - midpoints[edges.col]
    # extents of a cell, for parts that are one cell thick
    own = np.sum(steps**2) / max(1, 12 * len(steps))
    size = np.bincount(label)
    mean = np.stack([np.bincount(label, x) / size for x in midpoints.T], axis=1)
    r = midpoints - mean[label]
    dim = r.shape[1]
    moments = np.empty((size.size, dim, dim))
    for i, j in itertools.product(range(dim), repeat=2):
        moments[:, i, j] = np.bincount(label, r[:, i] * r[:, j]) / size
    variances = np.linalg.eigvalsh(moments) + own
    return float(np.average(np.sqrt(variances[:, -1] / variances[:, 0]), weights=size))


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
        if size[target] >= LARGE * label.size / count:
            continue
        entries = slice(*facets.indptr[small : small + 2])
        neighbours = joined[facets.indices[entries]]
        common = np.where(neighbours == target, 0, facets.data[entries])
        if common.any():
            best = neighbours[np.argmax(common)]
            size[best] += size[target]
            joined[joined == target] = best
    return np.unique(joined, return_inverse=True)[1][piece]

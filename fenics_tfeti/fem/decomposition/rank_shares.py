"""Cells distributed over ranks body by body: each rank has whole bodies, or compact pieces of them.

No subdomain is on two ranks. A graph partitioner knows nothing of bodies: it cuts slivers off them
where the share of a rank is full, and subdomains that are not round take more iterations.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.fem.decomposition.bodies import components
from fenics_tfeti.fem.decomposition.round_parts import LARGE, principal
from fenics_tfeti.typing import Numbers, Vector

# imbalance at which bodies stay whole, at most, and the one below which others count as equal
_WHOLE, _EQUAL = 0.3, 0.05
# cells by which a cut may miss its place to be between layers of cells, relative to a rank's share
_BETWEEN_LAYERS = 0.15


def share_among_ranks(
    graph: sp.csr_matrix, midpoints: Vector, tag: Numbers, ranks: int, part: float
) -> Numbers:
    """Return the rank of each cell, nearly as many for each rank.

    Bodies in the order of their places along the longest axis of all are bisected again and again,
    and with them the ranks: between two bodies where ranks have about equal shares then, else
    across the longest axis of a body. Pieces smaller than a subdomain of about `part` cells are
    worse than unequal shares. `graph` is the adjacency of the cells, `midpoints` are of shape
    (m, d); bodies are connected and of one tag (m,).
    """
    if len(tag) <= ranks:
        return np.arange(len(tag))
    body = components(graph, tag)[1]
    rank, order = np.zeros(len(body), dtype=np.int64), np.argsort(body, kind="stable")
    bodies = np.split(order, np.flatnonzero(np.diff(body[order])) + 1)
    share = len(body) / ranks
    _bisect(midpoints, bodies, ranks, share, 1.0 + min(_WHOLE, part / share), 0, rank)
    return _without_small_pieces(graph, body, rank)


def _bisect(
    x: Vector,
    pieces: list[Numbers],
    ranks: int,
    share: float,
    largest: float,
    first: int,
    rank: Numbers,
) -> None:
    """Give the cells of some pieces to so many ranks, from the first one on."""
    if ranks == 1:
        rank[np.concatenate(pieces)] = first
        return
    axis = principal(x[np.concatenate(pieces)])[2]
    places = np.array([np.mean(x[piece] @ axis) for piece in pieces])
    ordered = [pieces[i] for i in np.argsort(np.round(places / np.ptp(x), 9), kind="stable")]
    ends = np.cumsum([piece.size for piece in ordered]) / share
    half, number = _between_bodies(ends, ranks, largest)
    lower, upper = ordered[:number], ordered[number:]
    if half == 0:
        half = ranks // 2
        number = int(np.searchsorted(ends, half / ranks * ends[-1]))
        cut, lower, upper = ordered[number], ordered[:number], ordered[number + 1 :]
        below = (half / ranks * ends[-1] - ends[number]) * share + cut.size
        before, behind = _cut(x, cut, axis, below, _BETWEEN_LAYERS * share)
        lower = [piece for piece in (*lower, before) if piece.size]
        upper = [piece for piece in (behind, *upper) if piece.size]
    _bisect(x, lower, half, share, largest, first, rank)
    _bisect(x, upper, ranks - half, share, largest, first + half, rank)


def _between_bodies(ends: Vector, ranks: int, largest: float) -> tuple[int, int]:
    """Return how many ranks get how many bodies, with the least load; zeros where it is too large.

    `ends` are the sums of shares up to each body. Of about equal loads that of the middle is taken.
    """
    below = ends[:-1]
    number = np.concatenate([np.floor(below), np.ceil(below)]).clip(1, ranks - 1)
    below = np.concatenate([below, below])
    load = np.maximum(below / number, (ends[-1] - below) / (ranks - number))
    if not load.size or load.min() > largest:
        return 0, 0
    about = np.maximum(load, (1.0 + _EQUAL) * max(load.min(), ends[-1] / ranks))
    best = int(np.lexsort((load, np.abs(number - ranks / 2), about))[0])
    return int(number[best]), best % (ends.size - 1) + 1


def _cut(
    x: Vector, piece: Numbers, direction: Vector, below: float, slack: float
) -> tuple[Numbers, Numbers]:
    """Cut about so many cells off a piece, on the lower side of a direction, between layers."""
    along, length, axis = principal(x[piece])
    if axis @ direction < 0.0:
        along = -along
    order = np.argsort(along, kind="stable")
    nearest, lowest = round(below), max(0, int(below - slack))
    steps = np.round(np.diff(along[order]) / (length[0] or 1.0), 9)
    # a cut at either end leaves the piece whole
    steps = np.concatenate([[np.inf], steps, [np.inf]])[lowest : int(below + slack) + 1]
    if np.median(steps) == 0.0:
        places = lowest + np.flatnonzero(steps)
        nearest = min(places, key=lambda place: abs(place - below), default=nearest)
    return piece[order[:nearest]], piece[order[nearest:]]


def _without_small_pieces(graph: sp.csr_matrix, body: Numbers, rank: Numbers) -> Numbers:
    """Let small pieces that a cut leaves beside a larger one join that of another rank.

    Planes cut single cells off a mesh without layers.
    """
    of_rank = np.unique(np.column_stack([body, rank]), axis=0, return_inverse=True)[1].ravel()
    count, piece = components(graph, of_rank)
    first = np.unique(piece, return_index=True)[1]
    of_piece, rank_of_piece, size = of_rank[first], rank[first], np.bincount(piece)
    ascending = np.argsort(size, kind="stable")
    largest = np.zeros(of_rank.max() + 1, dtype=np.int64)
    largest[of_piece[ascending]] = ascending
    small = size < np.minimum(size[largest[of_piece]], LARGE * len(piece) / largest.size)
    at = sp.csr_matrix((np.ones(piece.size), piece, np.arange(piece.size + 1)), (piece.size, count))
    facets = (at.T @ graph @ at).tocsr()  # common ones of any two pieces
    for number in ascending[small[ascending]]:
        entries = slice(*facets.indptr[number : number + 2])
        neighbours = facets.indices[entries]
        common = np.where(body[first[neighbours]] == body[first[number]], facets.data[entries], 0.0)
        common[neighbours == number] = 0.0
        if common.any():
            rank_of_piece[number] = rank_of_piece[neighbours[np.argmax(common)]]
    return rank_of_piece[piece]

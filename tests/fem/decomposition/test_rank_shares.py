"""Cells distributed over ranks body by body."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fenics_tfeti.fem.decomposition.rank_shares import share_among_ranks

pytestmark = pytest.mark.once

LARGE = 1e9  # cells of a subdomain: bodies stay whole where they can


def box(*divisions, corner=(0.0, 0.0, 0.0)):
    """Return the midpoints of unit cubes."""
    return np.array(list(itertools.product(*map(range, divisions))), dtype=float) + 0.5 + corner


def share(x, body, ranks, part):
    """Cells with midpoints at a distance of 1 are neighbours."""
    near = cKDTree(x).sparse_distance_matrix(cKDTree(x), 1.0 + 1e-9, output_type="coo_matrix")
    graph = (near > 0.0).astype(np.int8).tocsr()
    return share_among_ranks(graph, x, body, ranks, part)


def bodies(*points):
    return np.concatenate(points), np.repeat(np.arange(len(points)), [len(x) for x in points])


def test_bodies_stay_whole_where_shares_are_about_equal():
    """Two of 5 and two of 4 layers on two and four ranks; neighbours go together."""
    x, body = bodies(*(box(n, 2, 2, corner=(10.0 * k, 0, 0)) for k, n in enumerate([5, 4, 5, 4])))
    for ranks in (2, 4):
        rank = share(x, body, ranks, LARGE)
        of_body = [np.unique(rank[body == k]).tolist() for k in range(4)]
        assert of_body == [[k * ranks // 4] for k in range(4)]


@pytest.mark.parametrize(("ranks", "number"), [(2, [1, 1]), (5, [2, 3]), (6, [3, 3])])
def test_ranks_of_a_body_follow_its_size(ranks, number):
    x, body = bodies(box(16, 4, 4), box(20, 4, 4, corner=(100.0, 0, 0)))
    rank = share(x, body, ranks, LARGE)
    assert [np.unique(rank[body == k]).size for k in range(2)] == number
    assert np.unique(rank).size == ranks


@pytest.mark.parametrize("part", [1.0, LARGE])
def test_unequal_shares_are_accepted_of_few_subdomains_only(part):
    """Bodies of 5 and 7 layers on 2 ranks: one is cut where shares have many subdomains."""
    x, body = bodies(box(5, 6, 6), box(7, 6, 6, corner=(100.0, 0, 0)))
    rank = share(x, body, 2, part)
    layers = [5, 7] if part == LARGE else [6, 6]
    assert np.bincount(rank).tolist() == [36 * n for n in layers]


@pytest.mark.parametrize("axes", list(itertools.permutations(range(3))))
def test_cuts_are_between_layers_across_the_longest_axis(axes):
    divisions = np.array([13, 5, 4])[list(axes)]
    x = box(*divisions)
    rank = share(x, np.zeros(len(x), dtype=int), 3, 1.0)
    along = x[:, axes.index(0)]
    ranks_of_layers = [np.unique(rank[along == layer]).tolist() for layer in np.unique(along)]
    # 4.3 layers are wanted
    assert ranks_of_layers == [[0]] * 4 + [[1]] * 4 + [[2]] * 5


def test_no_rank_is_without_cells():
    random = np.random.default_rng(0)
    for _ in range(200):
        cells, ranks = random.integers(1, 60), random.integers(1, 12)
        body, x = random.integers(0, 4, cells), 4.0 * random.random((cells, 2))
        sizes = np.bincount(share(x, body, ranks, LARGE), minlength=ranks)
        assert np.count_nonzero(sizes) == min(cells, ranks)
        assert sizes.max() <= 1.4 * cells / ranks + 1.0

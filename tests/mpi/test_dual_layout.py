"""Dual vectors over the ranks: owners, sums over the holders, inner products."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import scipy.sparse as sp

from fenics_tfeti.feti.constraints.dual_layout import DualLayout

comm = MPI.COMM_WORLD
pytestmark = pytest.mark.ranks(2, 3)
TOTAL = 60


def numbers_of(rank: int, seed: int) -> np.ndarray:
    """Return what a rank holds: each number for certain on one rank, on the others by chance."""
    rng = np.random.default_rng(100 * seed + rank)
    held = rng.random(TOTAL) < 0.3
    held[rank :: comm.size] = True
    return rng.permutation(np.flatnonzero(held))


def holders(seed: int) -> np.ndarray:
    """Return which rank (row) holds which number (column)."""
    return np.stack([np.isin(np.arange(TOTAL), numbers_of(r, seed)) for r in range(comm.size)])


def layout_and_values(seed: int) -> tuple[DualLayout, np.ndarray, np.ndarray]:
    """Return a layout, this rank's part of a vector, and the parts of all ranks, all numbers."""
    layout = DualLayout(comm, numbers_of(comm.rank, seed))
    parts = np.random.default_rng(seed).standard_normal((comm.size, TOTAL)) * holders(seed)
    return layout, parts[comm.rank, layout.numbers], parts


each_seed = pytest.mark.parametrize("seed", range(2))


@each_seed
def test_lowest_holder_is_the_owner(seed):
    layout, _, _ = layout_and_values(seed)
    owner = holders(seed).argmax(axis=0)
    owned, others = layout.numbers[: layout.owned], layout.numbers[layout.owned :]
    assert owned.tolist() == np.flatnonzero(owner == comm.rank).tolist()
    here = holders(seed)[comm.rank] & (owner != comm.rank)
    assert others.tolist() == np.flatnonzero(here).tolist()
    assert layout.size == TOTAL
    assert layout.local(layout.numbers).tolist() == list(range(layout.numbers.size))


@each_seed
def test_sum_over_the_holders(seed):
    """All holders have the same bits, and owned parts add up to the vector."""
    layout, part, parts = layout_and_values(seed)
    x = layout.sum(part)
    np.testing.assert_allclose(x, parts.sum(axis=0)[layout.numbers], atol=1e-14)
    several = np.column_stack([part, 2.0 * part, part**2])
    expected = np.stack([parts, 2.0 * parts, parts**2], axis=2).sum(axis=0)[layout.numbers]
    np.testing.assert_allclose(layout.sum(several), expected, atol=1e-14)
    whole = np.full(TOTAL, np.nan)
    whole[layout.numbers] = x
    for number in np.stack(comm.allgather(whole), axis=1):
        assert len(set(number[~np.isnan(number)].tolist())) == 1
    np.testing.assert_array_equal(layout.sum(layout.owned_part(x)), x)


@each_seed
def test_inner_products_count_each_component_once(seed):
    layout, part, parts = layout_and_values(seed)
    x, whole = layout.sum(part), parts.sum(axis=0)
    expected = [whole @ whole, 3.0 * whole.sum()]
    threes = np.full_like(x, 3.0)
    np.testing.assert_allclose(layout.space.dots((x, x), (x, threes)), expected, rtol=1e-12)
    least = layout.space.dots_and_min((x, x), (x, threes), value=float(-comm.rank))
    np.testing.assert_allclose(least, [*expected, 1.0 - comm.size], rtol=1e-12)


@each_seed
def test_sums_of_sparse_rows_are_those_of_vectors(seed):
    layout, part, _ = layout_and_values(seed)
    # one column is that of all ranks, the others are each of one rank
    columns = np.zeros((part.size, 1 + comm.size))
    columns[:, 0] = columns[:, 1 + comm.rank] = part
    found = layout.sum_sparse(sp.csr_matrix(columns))
    np.testing.assert_allclose(found.toarray(), layout.sum(columns), atol=1e-14)

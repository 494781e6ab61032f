"""Loops over cells in C compared with sums of dense matrices, and what is said without compiler."""

from __future__ import annotations

import numpy as np
import pytest

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.assembly_loops import assembly_library
from fenics_tfeti.fem.decomposition.parts import BlockPattern

pytestmark = pytest.mark.once


@pytest.mark.parametrize("size", [1, 2, 3])
@pytest.mark.parametrize(("cells", "vertices", "nodes"), [(40, 4, 30), (30, 27, 60), (1, 3, 3)])
def test_matrices_of_cells_are_added(cells, vertices, nodes, size):
    random = np.random.default_rng(0)
    table = np.array([random.permutation(nodes)[:vertices] for _ in range(cells)], dtype=np.int32)
    matrices = random.integers(1, 9, (cells, vertices * size, vertices * size)).astype(float)
    expected = np.zeros((nodes * size, nodes * size))
    for row, matrix in zip(table, matrices, strict=True):
        unknowns = (size * row[:, None] + np.arange(size)).ravel()
        expected[np.ix_(unknowns, unknowns)] += matrix

    pattern = BlockPattern.of(table, nodes, size)
    data = np.zeros(pattern.indices.size)
    for batch in (slice(0, cells // 2), slice(cells // 2, None)):
        pattern.add(data, batch, matrices[batch])
    K = pattern.matrix(data)

    assert K.has_canonical_format
    assert K.nnz == np.count_nonzero(expected)
    np.testing.assert_array_equal(K.toarray(), expected)


def test_pattern_without_cells_has_no_entry():
    pattern = BlockPattern.of(np.zeros((0, 4), dtype=np.int32), 5, 3)
    assert pattern.matrix(np.zeros(0)).shape == (15, 15)
    assert not pattern.indptr.any()


def test_missing_compiler_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("CC", "/no/compiler")
    assembly_library.cache_clear()
    try:
        with pytest.raises(InputError, match="'/no/compiler' does not run"):
            assembly_library()
    finally:
        assembly_library.cache_clear()

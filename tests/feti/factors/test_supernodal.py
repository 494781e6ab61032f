"""Solves with packed supernodal factors, against SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from fenics_tfeti.feti.factors.cholesky import available_packages
from fenics_tfeti.feti.factors.compiled import supernodal_library
from fenics_tfeti.feti.factors.supernodal import NotDefinite, Ordering, SupernodalFactor

pytestmark = pytest.mark.skipif(
    "cholmod" not in available_packages() or supernodal_library()[0] is None,
    reason="no compiled solves",
)


def grid(*shape: int, width: int = 1) -> sp.csr_matrix:
    """Return a definite matrix of a grid of nodes with `width` unknowns that are all coupled."""
    A = sp.csr_matrix((1, 1))
    for n in shape:
        A = sp.kronsum(A, sp.diags([-1.0, 2.1, -1.0], [-1, 0, 1], shape=(n, n)))
    node = np.eye(width) + 0.1 * np.ones((width, width))
    return sp.csr_matrix(sp.kron(A, node))


def random(n: int, density: float) -> sp.csr_matrix:
    A = sp.random(n, n, density=density, random_state=n, format="csr")
    return (A @ A.T + sp.identity(n)).tocsr()


MATRICES = {
    "one unknown": sp.csr_matrix([[4.0]]),
    "two unknowns": sp.csr_matrix([[4.0, 1.0], [1.0, 3.0]]),
    "diagonal": sp.diags(np.arange(1.0, 8.0), format="csr"),
    **{f"dense {n}": random(n, 1.0) for n in (3, 5, 6, 7, 8, 9, 33)},
    "sparse": random(200, 0.01),
    "plane": grid(17, 13),
    "cube": grid(6, 7, 5),
    "two cubes": sp.block_diag([grid(4, 4, 4), grid(3, 3, 3)], format="csr"),
}


def factor(A: sp.csr_matrix, width: int = 1, methods: int = 0) -> SupernodalFactor:
    return SupernodalFactor(supernodal_library()[0], A, width, methods)


@pytest.mark.parametrize("columns", [1, 2, 7, 17])
@pytest.mark.parametrize("name", MATRICES)
def test_solutions_are_those_of_scipy(name, columns):
    A = MATRICES[name]
    b = np.random.default_rng(0).standard_normal((A.shape[0], columns))
    x = factor(A).solve_columns(np.asfortranarray(b))
    expected = spsolve(A.tocsc(), b).reshape(b.shape)
    np.testing.assert_allclose(x, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())
    one = factor(A).solve(b[:, 0].copy())
    np.testing.assert_allclose(one, x[:, 0], rtol=0.0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("rows", [0, 1, 5, 11])
@pytest.mark.parametrize("chosen", [[3, 200, 17, 4], []])
def test_inverse_between_some_unknowns(rows, chosen):
    """Rows of zeros stay zero beside others."""
    A, chosen = MATRICES["plane"], np.array(chosen, dtype=np.int64)
    forces = np.random.default_rng(0).standard_normal((rows, chosen.size))
    forces[1:-1:2] = 0.0
    found = factor(A).between(chosen)(forces)
    expected = forces @ np.linalg.inv(A.toarray())[np.ix_(chosen, chosen)]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("width", [1, 2, 3])
def test_ordering_of_nodes_leaves_the_solution(width):
    A = grid(5, 5, 5, width=3)
    b = np.ones(A.shape[0])
    np.testing.assert_allclose(A @ factor(A, width).solve(b), b, rtol=1e-12)


def test_nodes_are_ordered_as_well_as_their_unknowns():
    A = grid(9, 9, 9, width=3)
    assert factor(A, 3, methods=3).entries < 1.05 * factor(A, 1, methods=3).entries


def test_smallest_of_more_orderings_is_taken():
    A = grid(16, 16, 16)
    assert factor(A, methods=3).entries < 0.97 * factor(A, methods=2).entries


@pytest.mark.parametrize("name", ["plane", "cube"])
def test_matrix_with_a_negative_eigenvalue_is_refused(name):
    A = MATRICES[name].tolil()
    A[7, 7] = -1.0
    with pytest.raises(NotDefinite, match="pivot"):
        factor(A.tocsr())


def test_rows_need_not_be_sorted():
    A = MATRICES["cube"].copy()
    for begin, end in zip(A.indptr, A.indptr[1:], strict=False):
        A.indices[begin:end] = A.indices[begin:end][::-1].copy()
        A.data[begin:end] = A.data[begin:end][::-1].copy()
    A.has_sorted_indices = False
    b = np.ones(A.shape[0])
    np.testing.assert_allclose(A @ factor(A).solve(b), b, rtol=1e-12)
    assert not A.has_sorted_indices


def test_ordering_of_a_similar_matrix_serves_again():
    A = grid(9, 8, 7, width=3)
    # two entries more
    other = A + sp.csr_matrix(([-0.1, -0.1], ([0, 900], [900, 0])), shape=A.shape)
    b = np.random.default_rng(0).standard_normal(A.shape[0])
    library, last = supernodal_library()[0], Ordering()
    first = SupernodalFactor(library, A, 3, last=last)
    second = SupernodalFactor(library, other, 3, last=last)
    np.testing.assert_array_equal(second._places, first._places)
    np.testing.assert_allclose(other @ second.solve(b), b, atol=1e-12)


def test_ordering_of_another_matrix_does_not_serve():
    library, last = supernodal_library()[0], Ordering()
    SupernodalFactor(library, grid(504, width=3), 3, last=last)
    A = grid(9, 8, 7, width=3)
    assert SupernodalFactor(library, A, 3, last=last).entries == factor(A, 3).entries


def test_springs_of_a_similar_matrix_serve_again():
    library, last, size = supernodal_library()[0], Ordering(), 40
    vectors = np.linalg.qr(np.random.default_rng(0).standard_normal((size, size)))[0]
    values = np.append(np.full(6, -0.01), np.linspace(1.0, 10.0, size - 6))
    A = sp.csr_matrix((vectors * values) @ vectors.T)

    def held(most: int) -> list[int]:
        matrix = A.copy()
        factor = SupernodalFactor(library, matrix, last=last, spring=10.0, most=most)
        added = 10.0 * np.bincount(factor.held, minlength=size)
        np.testing.assert_allclose((matrix - A).toarray(), np.diag(added), atol=1e-12)
        return factor.held.tolist()

    with pytest.raises(NotDefinite):
        held(4)
    springs = held(4)
    assert 4 < len(springs) <= 8
    assert held(4) == springs

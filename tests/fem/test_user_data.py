"""Functions and arrays of the user become checked arrays."""

from mpi4py import MPI

import numpy as np
import pytest

from fenics_tfeti import InputError
from fenics_tfeti.fem.user_data import as_points, evaluate, unit_vectors, vectors_at

COMM = MPI.COMM_SELF
X = np.array([[1.0, 2.0, 0.0], [3.0, 4.0, 0.0]])


def test_function_gets_coordinates_by_rows():
    assert evaluate(lambda x: x[1].tolist(), X, "it") == [2.0, 4.0]


def test_function_may_change_its_argument():
    def change(x):
        x[:] = 0.0

    evaluate(change, X, "it")
    assert X[1, 0] == 3.0


def test_exception_of_a_function_names_it():
    with pytest.raises(InputError, match=r"the marker failed .*\(3, 2\): IndexError: "):
        evaluate(lambda x: x[7], X, "the marker")


def test_input_error_of_a_function_keeps_its_words():
    def fail(x):
        raise InputError("no normal there")

    with pytest.raises(InputError, match="^the obstacle: no normal there$"):
        evaluate(fail, X, "the obstacle")


@pytest.mark.parametrize("rows", [2, 3])
def test_vectors_may_have_three_rows_in_the_plane(rows):
    vectors = vectors_at(COMM, lambda x: 2.0 * x[:rows], X, 2, "it")
    np.testing.assert_array_equal(vectors, 2.0 * X[:, :2])


def test_function_is_not_called_without_points():
    assert vectors_at(COMM, lambda x: 1 / 0, X[:0], 2, "it").shape == (0, 2)


def test_unit_vectors_of_a_constant():
    np.testing.assert_allclose(unit_vectors(COMM, (3.0, 4.0), X, 2, "it"), [[0.6, 0.8]] * 2)


def test_unit_vectors_of_a_function():
    unit = unit_vectors(COMM, lambda x: 1e-20 * x, X, 2, "it")
    np.testing.assert_allclose(unit, X[:, :2] / np.linalg.norm(X, axis=1)[:, None])


def test_vector_that_is_rounding_has_no_direction():
    with pytest.raises(InputError, match=r"vanishes at 1 points, the first at \(1, 2\)"):
        unit_vectors(COMM, lambda x: np.where(x[0] == 1.0, 1e-16, 1.0) * x, X, 2, "it")


@pytest.mark.parametrize("columns", [2, 3])
def test_points_have_two_or_three_coordinates(columns):
    np.testing.assert_array_equal(as_points(X[:, :columns], "they"), X[:, :columns])


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (X[0], r"shape \(3,\), expected \(k, 2\) or"),
        (X[:0], r"shape \(0, 3\)"),
        ([["a", "b"]], "array of numbers, not list"),
        (X * [1.0, np.nan, 1.0], "NaN or infinite, the first in row 0"),
    ],
)
def test_wrong_points(given, words):
    with pytest.raises(InputError, match=words):
        as_points(given, "they")

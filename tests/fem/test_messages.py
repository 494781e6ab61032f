"""Messages name the first wrong place, however the points are ordered."""

from mpi4py import MPI

import numpy as np
import pytest
from mesh_arrays import grid, mesh_of

from fenics_tfeti.fem.messages import coordinate_order, first_mesh_point, first_wrong

POINTS = np.array([[1.0, 2.0], [0.0, 3.0], [1.0, -1.0], [0.0, 5.0]])


def test_order_is_by_the_first_coordinate_then_by_the_second():
    assert coordinate_order(POINTS).tolist() == [1, 3, 2, 0]


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1]])
def test_first_wrong_place_does_not_depend_on_the_order(order):
    points = POINTS[order]
    assert first_wrong(MPI.COMM_SELF, points[:, 1] != 3.0, points) == (3, "(0, 5)", 0, "")


def test_first_wrong_of_the_first_contact_that_has_any():
    wrong = np.array([True, False, True, True])
    contact = np.array([2, 0, 1, 1])
    bad = first_wrong(MPI.COMM_SELF, wrong, POINTS, contact, ["joint", "rail"])
    assert bad == (2, "(0, 5)", 1, "rail")


def test_nothing_wrong_is_none():
    assert first_wrong(MPI.COMM_SELF, np.zeros(4, dtype=bool), POINTS) is None


def test_no_points_are_none():
    assert first_wrong(MPI.COMM_SELF, np.zeros(0, dtype=bool), np.zeros((0, 3))) is None


def test_digits_are_those_of_the_size_of_the_mesh():
    domain = mesh_of(MPI.COMM_SELF, "quadrilateral", *grid((2, 2)))
    assert first_mesh_point(domain, np.array([[2.0, 0.0], [1e-9, 1.0 / 3.0]])) == "(0, 0.333333)"

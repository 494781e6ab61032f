"""The gluing of bodies in the plane: triangles of springs."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from fenics_tfeti import InputError
from fenics_tfeti.feti import ContactRows, Prescribed, Subdomain, TornSystem
from fenics_tfeti.feti.checks.system import check_system

pytestmark = pytest.mark.once


def triangle(points, nodes, body: int = 0) -> Subdomain:
    """Return a triangle of three springs along its sides; its kernel is that of elasticity."""
    x = np.array(points, float)
    K = np.zeros((6, 6))
    for i, j in ((0, 1), (1, 2), (2, 0)):
        along = (x[j] - x[i]) / np.linalg.norm(x[j] - x[i])
        b = np.zeros(6)
        b[2 * i : 2 * i + 2], b[2 * j : 2 * j + 2] = -along, along
        K += np.outer(b, b)
    return Subdomain(sp.csr_matrix(K), np.zeros(6), x, np.array(nodes), body)


A, B, C, D, E, F = (0, 0), (2, 0), (1, 2), (1, -1), (3, 2), (-1, 2)


def in_the_plane(*triangles: Subdomain) -> TornSystem:
    return TornSystem(triangles, Prescribed(), ContactRows.none(2), 2)


def test_two_common_nodes_make_two_triangles_rigid():
    check_system(in_the_plane(triangle([A, B, C], [0, 1, 2]), triangle([A, B, D], [0, 1, 3])))


def test_three_hinges_make_three_triangles_rigid():
    check_system(
        in_the_plane(
            triangle([A, B, D], [0, 1, 3]),
            triangle([B, C, E], [1, 2, 4]),
            triangle([A, C, F], [0, 2, 5]),
        )
    )


def test_two_hinges_leave_three_triangles_movable():
    with pytest.raises(InputError, match="body 0.*hinged"):
        check_system(
            in_the_plane(
                triangle([A, B, D], [0, 1, 3]),
                triangle([B, C, E], [1, 2, 4]),
                triangle([A, C, F], [0, 6, 5]),
            )
        )


def test_bodies_of_their_own_need_no_connection():
    check_system(
        in_the_plane(triangle([A, B, C], [0, 1, 2]), triangle([A, B, D], [3, 4, 5], body=1))
    )

"""The gluing of bodies in the plane: triangles of springs."""

from __future__ import annotations

import contextlib

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


@pytest.mark.parametrize(("triangles", "rigid"), [
    ([([A, B, C], [0, 1, 2]), ([A, B, D], [0, 1, 3])], True),
    ([([A, B, D], [0, 1, 3]), ([B, C, E], [1, 2, 4]), ([A, C, F], [0, 2, 5])], True),
    ([([A, B, D], [0, 1, 3]), ([B, C, E], [1, 2, 4]), ([A, C, F], [0, 6, 5])], False),
    ([([A, B, C], [0, 1, 2]), ([A, B, D], [3, 4, 5], 1)], True),
], ids=["two common nodes", "three hinges", "two hinges", "bodies of their own"])  # fmt: skip
def test_triangles_are_rigid_together_or_movable(triangles, rigid):
    parts = [triangle(*arguments) for arguments in triangles]
    system = TornSystem(parts, Prescribed(), ContactRows.none(2), 2)
    with contextlib.nullcontext() if rigid else pytest.raises(InputError, match="body 0.*hinged"):
        check_system(system)

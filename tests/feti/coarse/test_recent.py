"""Faces that come back are not factored again."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from torn import column

from fenics_tfeti.feti import TornSolver
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.recent import RecentFaces

ROWS = np.eye(4, dtype=bool)


def test_two_faces_are_kept():
    recent: RecentFaces[int] = RecentFaces(MPI.COMM_SELF)
    found = []
    for i in (0, 1, 0, 2, 0, 1, 2):
        found.append(recent.find(ROWS[i], None))
        if found[-1] is None:
            recent.keep(ROWS[i], None, i)
    # 1 was the oldest one when 2 came
    assert found == [None, None, 0, None, 0, None, None]
    assert [belonging for _, _, belonging in recent.kept] == [2, 1]


@pytest.mark.parametrize("other", [None, np.array([[0.0, 1.0]])])
def test_combinations_across_belong_to_a_face(other):
    recent: RecentFaces[int] = RecentFaces(MPI.COMM_SELF)
    across = np.array([[1.0, 0.0]])
    recent.keep(ROWS[0], across, 7)
    assert recent.find(ROWS[0], other) is None
    assert recent.find(ROWS[0], across.copy()) == 7


def test_projectors_of_the_same_face_share_their_factor():
    space = TornSolver(column()).setup.projector.coarse_space
    none = np.zeros(space.constraints.inequality.size, dtype=bool)
    one, other = (Projector.build(space, none) for _ in range(2))
    assert one.factor is other.factor is not None
    x = np.random.default_rng(0).standard_normal(space.constraints.size)
    np.testing.assert_array_equal(one.P(x), other.P(x))

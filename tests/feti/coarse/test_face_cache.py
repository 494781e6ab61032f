"""Faces that come back are not factored again."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from torn import column

from fenics_tfeti.feti import TornSolver
from fenics_tfeti.feti.coarse.face_cache import FaceCache
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.face import Face

pytestmark = pytest.mark.once

SPACE = TornSolver(column()).setup.projector.coarse_space
CONSTRAINTS = SPACE.constraints
FACES = [Face.of(CONSTRAINTS, np.arange(CONSTRAINTS.inequality.size) == k) for k in range(3)]


def test_two_faces_are_kept():
    cache = FaceCache(MPI.COMM_SELF)
    found = []
    for i in (0, 1, 0, 2, 0, 1, 2):
        found.append(cache.find(FACES[i]))
        if found[-1] is None:
            cache.keep(FACES[i], i)
    # 1 was the oldest one when 2 came
    assert found == [None, None, 0, None, 0, None, None]
    assert [belonging for _, belonging in cache.kept] == [2, 1]


@pytest.mark.parametrize("other", [None, np.array([[0.0, 1.0]])])
def test_combinations_across_belong_to_a_face(other):
    cache = FaceCache(MPI.COMM_SELF)
    face = replace(FACES[0], tangents=np.array([[1.0, 0.0]]))
    cache.keep(face, 7)
    assert cache.find(replace(face, tangents=other)) is None
    assert cache.find(replace(face, tangents=face.tangents.copy())) == 7


def test_projectors_of_the_same_face_share_their_factor():
    one, other = (Projector.build(SPACE, Face.supports(CONSTRAINTS)) for _ in range(2))
    assert one.gram is other.gram
    x = np.random.default_rng(0).standard_normal(CONSTRAINTS.size)
    np.testing.assert_array_equal(one.P(x), other.P(x))

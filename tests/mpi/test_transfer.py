"""The start from a coarse mesh on any number of ranks."""

from __future__ import annotations

from functools import lru_cache

from mpi4py import MPI

import numpy as np
import pytest
from scenes import block_on_ball, two_beams

COMM = MPI.COMM_WORLD
OPTIONS = {"subdomain_size": 200}
SCENES = {
    "beams, quadrilaterals": lambda comm, n: two_beams(comm, "quadrilateral", 4 * n),
    "beams, tetrahedra": lambda comm, n: two_beams(comm, "tetrahedron", 2 * n),
    "ball, hexahedra": lambda comm, n: block_on_ball(comm, "hexahedron", 4 * n),
}
every_scene = pytest.mark.parametrize("name", SCENES)


def problem_on(comm, name, n):
    return SCENES[name](comm, n).problem(options=OPTIONS)


@lru_cache(maxsize=None)
def started(name, coarse_alone=False, alone=False):
    """Return the fine problem, solved; of which the meshes are on one rank."""
    coarse = problem_on(MPI.COMM_SELF if coarse_alone else COMM, name, 1)
    coarse.solve()
    fine = problem_on(MPI.COMM_SELF if alone else COMM, name, 2)
    fine.solve(coarse=coarse)
    return fine


@every_scene
def test_first_face_is_that_of_one_rank(name):
    face, expected = started(name).report.faces[0], started(name, True, True).report.faces[0]
    assert face.active == expected.active


def changes_of_the_set(problem):
    """Return how many faces were found wrong; a right one may be solved again, more precisely."""
    return sum(face.changed > 0 for face in problem.report.faces)


@every_scene
def test_no_more_changes_of_the_set_than_from_nothing(name):
    cold = problem_on(COMM, name, 2)
    cold.solve()
    assert changes_of_the_set(started(name)) <= changes_of_the_set(cold)
    np.testing.assert_allclose(
        [c.normal_force for c in started(name).report.contacts],
        [c.normal_force for c in cold.report.contacts],
        rtol=1e-5,
    )


def test_coarse_mesh_may_be_on_each_rank_as_a_whole():
    name = "ball, hexahedra"
    face, expected = started(name, coarse_alone=True).report.faces[0], started(name).report.faces[0]
    assert face.active == expected.active


def test_own_multipliers_cost_no_second_face():
    """The exact set: a linear solve, on any number of ranks."""
    name = "ball, hexahedra"
    problem, again = started(name), problem_on(COMM, name, 2)
    again.solve(coarse=problem)
    assert {face.changed for face in again.report.faces} == {0}

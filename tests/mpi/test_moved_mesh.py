"""Nodes that are moved between two solves: as if the problem were set up anew."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes

from fenics_tfeti import InputError

comm = MPI.COMM_WORLD


def move(mesh):
    """Stretch all bodies, and lift what is above y = 1."""
    x = mesh.geometry.x
    x[:, 1] *= 1.0 + 0.1 * x[:, 0]
    x[:, 0] *= 1.2


def largest_difference(u, w):
    return comm.allreduce(float(np.abs(u.x.array - w.x.array).max(initial=0.0)), MPI.MAX)


def test_moved_nodes_are_noticed():
    options = {"rtol": 1e-9}
    scene = scenes.block_on_ball(comm, "quadrilateral")
    problem = scene.problem(options=options)
    first = problem.solve().copy()
    move(scene.mesh)
    uh = problem.solve()
    exact = scene.problem(options=options).solve()
    size = comm.allreduce(float(np.abs(exact.x.array).max(initial=0.0)), MPI.MAX)
    assert largest_difference(first, exact) > 1e-2 * size
    assert largest_difference(uh, exact) < 1e-6 * size
    problem.solve()
    assert "factors" in problem.report.reused


def flatten(scene):
    scene.mesh.geometry.x[:, 1] = np.minimum(scene.mesh.geometry.x[:, 1], 1.5)


def soften(scene):
    scene.young.value = -float(scene.young.value)


@pytest.mark.parametrize(("spoil", "error", "message"), [
    (flatten, InputError, "cells without area"),
    (soften, InputError, "diagonal entries are not positive"),
])  # fmt: skip
def test_what_is_wrong_is_an_error_until_it_is_undone(spoil, error, message):
    """Also in the second solve, which would otherwise go on with what was computed before."""
    scene = scenes.two_beams(comm, "quadrilateral")
    problem = scene.problem(options={"rtol": 1e-9})
    before, x, young = (
        problem.solve().copy(),
        scene.mesh.geometry.x.copy(),
        scene.young.value.copy(),
    )
    spoil(scene)
    for _ in range(2):
        with pytest.raises(error, match=message):
            problem.solve()
    scene.mesh.geometry.x[:], scene.young.value = x, young
    uh = problem.solve()
    size = comm.allreduce(float(np.abs(before.x.array).max(initial=0.0)), MPI.MAX)
    assert largest_difference(uh, before) < 1e-6 * size

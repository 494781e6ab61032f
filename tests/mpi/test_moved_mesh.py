"""Nodes that are moved between two solves: as if the problem were set up anew."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import scenes

from fenics_tfeti import ContactError, InputError

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


def test_wrong_moves_are_errors_until_they_are_undone():
    """Also in the second solve, which would otherwise go on with what was computed before."""
    scene = scenes.two_beams(comm, "quadrilateral")
    problem = scene.problem(options={"rtol": 1e-9})
    before = problem.solve().copy()
    x = scene.mesh.geometry.x
    right = x.copy()
    x[:, 1] = np.minimum(x[:, 1], 1.5)
    for _ in range(2):
        with pytest.raises(InputError, match="cells without area"):
            problem.solve()
    x[:] = right
    uh = problem.solve()
    size = comm.allreduce(float(np.abs(before.x.array).max(initial=0.0)), MPI.MAX)
    assert largest_difference(uh, before) < 1e-6 * size


def test_values_after_an_error_are_noticed():
    """A stiffness that cannot be factored leaves nothing behind that a later solve could use."""
    scene = scenes.two_beams(comm, "quadrilateral")
    problem = scene.problem(options={"rtol": 1e-9})
    before = problem.solve().copy()
    young = float(scene.young.value)
    scene.young.value = -young
    for _ in range(2):
        with pytest.raises(ContactError):
            problem.solve()
    scene.young.value = young
    uh = problem.solve()
    size = comm.allreduce(float(np.abs(before.x.array).max(initial=0.0)), MPI.MAX)
    assert largest_difference(uh, before) < 1e-6 * size

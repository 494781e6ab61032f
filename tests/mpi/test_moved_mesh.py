"""Nodes that are moved between two solves: as if the problem were set up anew."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import scenes

comm = MPI.COMM_WORLD


def move(mesh):
    """Stretch all bodies, and lift what is above y = 1."""
    x = mesh.geometry.x
    x[:, 1] *= 1.0 + 0.1 * x[:, 0]
    x[:, 0] *= 1.2


def largest_difference(u, w):
    return comm.allreduce(float(np.abs(u.x.array - w.x.array).max(initial=0.0)), MPI.MAX)


@pytest.mark.parametrize("make", [scenes.two_beams, scenes.block_on_ball])
def test_moved_nodes_are_noticed(make):
    options = {"rtol": 1e-9}
    scene, fresh = make(comm, "quadrilateral"), make(comm, "quadrilateral")
    problem = scene.problem(options=options)
    first = problem.solve().copy()
    move(scene.mesh)
    uh = problem.solve()
    move(fresh.mesh)
    exact = fresh.problem(options=options).solve()
    size = comm.allreduce(float(np.abs(exact.x.array).max(initial=0.0)), MPI.MAX)
    assert largest_difference(first, exact) > 1e-2 * size
    assert largest_difference(uh, exact) < 1e-6 * size
    problem.solve()
    assert "factors" in problem.report.reused

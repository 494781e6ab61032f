"""What adapters to dolfinx promise."""

from __future__ import annotations

import os
from itertools import pairwise

from mpi4py import MPI

import numpy as np

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.io import Box, boxes


def test_a_graph_is_always_cut_into_the_same_parts():
    mesh = boxes(MPI.COMM_SELF, [Box((0, 0, 0), (1, 1, 1), (24, 24, 24))]).mesh
    graph = find_bodies(mesh, None).graph
    parts = [_compat.partition_graph(graph.indptr, graph.indices, 8) for _ in range(4)]
    assert all(np.array_equal(one, other) for one, other in pairwise(parts))


def test_the_number_of_threads_of_scotch_is_put_back(monkeypatch):
    monkeypatch.setenv("SCOTCH_PTHREAD_NUMBER", "2")
    path = np.array([0, 1, 3, 4], dtype=np.int32), np.array([1, 0, 2, 1], dtype=np.int32)
    _compat.partition_graph(*path, 2)
    assert os.environ["SCOTCH_PTHREAD_NUMBER"] == "2"

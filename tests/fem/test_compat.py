"""What adapters to dolfinx promise."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import pairwise

from mpi4py import MPI

import numpy as np
import pytest
from joined_bodies import GDIM, halves, of_degree_two
from scenes import two_beams

import ufl
from dolfinx import fem

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.fem.geometry.reference_cells import reference_cell
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


@pytest.mark.parametrize("cell", GDIM)
def test_nodes_of_degree_two_are_in_the_middle_of_their_vertices(cell):
    mesh = of_degree_two(cell, halves, 2).mesh
    x = mesh.geometry.x[_compat.geometry_cells(mesh)]
    around = reference_cell(cell).midpoints
    middle = np.stack([x[:, ends].mean(axis=1) for ends in around], axis=1)
    np.testing.assert_allclose(x[:, len(x[0]) - len(around) :], middle, atol=1e-12)
    assert x.shape[1] == reference_cell(cell).nodes(2)


COMPILES_A_FORM = """
from mpi4py import MPI
import ufl
from dolfinx.mesh import create_unit_cube
from fenics_tfeti.fem import _compat
mesh = create_unit_cube(MPI.COMM_SELF, 1, 1, 1)
for _ in range(2):
    _compat.CompiledForm(ufl.SpatialCoordinate(mesh)[0] * ufl.dx(1), mesh)
"""


@pytest.fixture
def compile_a_form(tmp_path):
    """Return a function that compiles in a new process without a cache; it takes the compiler."""

    def run(**environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-c", COMPILES_A_FORM],
            env={**os.environ, "XDG_CACHE_HOME": str(tmp_path), **environment},
            capture_output=True,
            text=True,
        )

    return run


def test_a_form_is_compiled_once_and_prints_no_commands(compile_a_form, tmp_path):
    """Compiling must not change the mesh, nor what its forms are cached by."""
    run = compile_a_form()
    assert run.returncode == 0, run.stderr
    assert len([*tmp_path.glob("fenics/libffcx_forms_*.c")]) == 1
    assert "build_ext" not in run.stdout + run.stderr
    assert "gcc" not in run.stdout + run.stderr


def test_what_the_compiler_complains_about_is_shown(compile_a_form):
    run = compile_a_form(CFLAGS="-include is/not/there.h")
    assert run.returncode != 0
    assert "is/not/there.h: No such file" in run.stderr
    assert "CompileError" in run.stderr


@pytest.mark.parametrize(
    ("term", "linear"),
    [
        (
            lambda u, v, k: k * ufl.inner(ufl.grad(u), ufl.grad(v)) + k * ufl.div(u) * ufl.div(v),
            True,
        ),
        (lambda u, v, k: ufl.conditional(ufl.gt(k, 0), ufl.dot(u, v), 0.0), True),
        (lambda u, v, k: ufl.div(u) * ufl.dot(u, v), False),
        (lambda u, v, k: ufl.inner(u, v) + k * v[0], False),
        (lambda u, v, k: ufl.inner(u, v) / (k + u[0]), False),
        (lambda u, v, k: ufl.exp(u[0]) * v[0], False),
    ],
)
def test_forms_that_are_linear_in_their_arguments(term, linear):
    space = two_beams(MPI.COMM_SELF, "triangle", 2).V
    u, v = ufl.TrialFunction(space), ufl.TestFunction(space)
    k = fem.Constant(space.mesh, 1.0)
    assert _compat.is_linear_in_arguments(term(u, v, k) * ufl.dx) == linear

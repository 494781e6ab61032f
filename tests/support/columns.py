"""Columns of uniform stress, in two halves that an interface joins."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from scenes import Scene, at, dimension, strain

import ufl
from dolfinx import fem

FOOT, TOP, SLAVE, MASTER = 1, 2, 5, 6
YOUNG = 1000.0

MESHES = pytest.mark.parametrize(("cell", "upper"), [
    ("quadrilateral", 4), ("triangle", 5), ("hexahedron", 4), ("tetrahedron", 5),
])  # fmt: skip


def columns(cell: str, upper: int = 4, comm: MPI.Comm = MPI.COMM_SELF, degree: int = 1) -> Scene:
    """Return two unit blocks without Poisson's ratio, the lower one held at its foot.

    Their meshes match where the upper one has 4 cells an edge.
    """
    up = dimension(cell) - 1
    parts = [
        ((0.0,) * (up + 1), (1.0,) * (up + 1), (4,) * (up + 1)),
        ((0.0,) * up + (1.0,), (1.0,) * up + (2.0,), (upper,) * up + (3,)),
    ]
    marks = [
        (FOOT, at(up, 0.0), 1),
        (TOP, at(up, 2.0), 2),
        (SLAVE, at(up, 1.0), 2),
        (MASTER, at(up, 1.0), 1),
    ]
    scene = Scene.of_boxes(comm, cell, parts, marks, young=YOUNG, degree=degree)
    scene.a = scene.young * ufl.inner(strain(scene.u), strain(scene.v)) * scene.dx
    scene.fix(FOOT)
    return scene


def pulled(scene: Scene, displacement: float) -> fem.Function:
    """Move the top along the columns; return the value, to change it."""
    moved = fem.Function(scene.V)
    moved.x.array.reshape(-1, scene.gdim)[:, -1] = displacement
    scene.fix(TOP, value=moved)
    return moved


def sheared(
    cell: str = "quadrilateral", upper: int = 4, comm: MPI.Comm = MPI.COMM_SELF, **interface: Any
) -> tuple[Scene, fem.Function]:
    """Return a column in two halves with an interface, and the displacement of its top.

    Nothing moves along the column: simple shear.
    """
    scene = columns(cell, upper, comm)
    every = fem.locate_dofs_geometrical(
        (scene.V.sub(scene.gdim - 1), scene.V.sub(scene.gdim - 1).collapse()[0]),
        lambda x: np.isfinite(x[0]),
    )
    none = fem.Function(scene.V.sub(scene.gdim - 1).collapse()[0])
    moved = pulled(scene, 0.0)
    scene.bcs.append(fem.dirichletbc(none, every, scene.V.sub(scene.gdim - 1)))
    scene.add_pair(**interface, name="joint")
    return scene, moved


def shear(moved: fem.Function, displacement: float) -> None:
    """Move the top across the column."""
    moved.x.array[:] = 0.0
    moved.x.array.reshape(-1, moved.function_space.dofmap.index_map_bs)[:, 0] = displacement

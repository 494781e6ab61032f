"""A stiff tool that is pressed into a nearly incompressible block, with the volume by one point."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from scenes import Scene, at

import ufl

from fenics_tfeti import ContactProblem, Tresca

BOTTOM, BLOCK, PRESSED, TOOL = 1, 2, 3, 4


def pressed_blocks(
    comm: MPI.Intracomm,
    gdim: int,
    nu: float,
    degree: int = 1,
    friction: bool = False,
    **options: Any,
) -> ContactProblem:
    """Return the problem, with Poisson's ratio of the block."""
    n = 8 // degree
    lower, upper = (2.0, 1.0, 1.0)[:gdim], (1.5, 1.0, 1.5)[:gdim]
    if gdim == 2:
        n, lower, upper = 2 * n, (2.0, 1.0), (1.5, 1.5)
    corner = (0.5, *[0.0] * (gdim - 2), 1.0)
    grid = [int(n * (b - a)) for a, b in zip(corner, upper, strict=True)]
    up = gdim - 1
    scene = Scene.of_boxes(
        comm,
        "hexahedron" if gdim == 3 else "quadrilateral",
        [([0.0] * gdim, lower, [int(n * x) for x in lower]), (corner, upper, grid)],
        [
            (BOTTOM, at(up, 0.0), 1),
            (BLOCK, at(up, 1.0), 1),
            (TOOL, at(up, 1.0), 2),
            (PRESSED, at(up, 1.5), 2),
        ],
        degree=degree,
    )
    u, v = scene.u, scene.v
    scene.a = 0
    for body, young, poisson in ((1, 1.0, nu), (2, 100.0, 0.0)):
        mu = young / (2 * (1 + poisson))
        lmbda = young * poisson / ((1 + poisson) * (1 - 2 * poisson))
        shear = 2 * mu * ufl.inner(ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v)))
        by_one_point = scene.dx(body, metadata={"quadrature_degree": 0})
        scene.a += shear * scene.dx(body) + lmbda * ufl.div(u) * ufl.div(v) * by_one_point
    scene.fix(BOTTOM)
    scene.fix(PRESSED, None, np.array([0.0] * up + [-0.02]))
    scene.add_pair(TOOL, BLOCK, friction=Tresca(1e-3) if friction else None)
    return scene.problem(cell_tags=None, options=options)

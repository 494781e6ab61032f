"""A rigid ball, or roller, that is pressed on a block whose cells grow away from the contact."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from scenes import Scene, at

from fenics_tfeti import ContactProblem, Sphere

TOP, BOTTOM, SIDES = 1, 2, (3, 4)
# the rigid sphere's radius, in radii of contact of an indenter that sinks in by a^2 / R
RADIUS = 25.0


def graded_block(
    comm: MPI.Comm, gdim: int, cells: int, growth: float, size: float, **options: Any
) -> ContactProblem:
    """Return a quarter, in 2D a half, of the problem.

    There are so many cells on the radius of contact, which is 1, and each beyond is larger by a
    factor of `growth` than the one before, along each axis. The block is of about the given size.
    """
    x = list(np.arange(1.2 * cells + 1e-9) / cells)
    while x[-1] < size:
        x.append(x[-1] + growth * (x[-1] - x[-2]))
    n, up = len(x) - 1, gdim - 1
    scene = Scene.of_boxes(
        comm,
        "hexahedron" if gdim == 3 else "quadrilateral",
        [([0.0] * gdim, [1.0] * gdim, [n] * gdim)],
        [(TOP, at(up, 0.0)), (BOTTOM, at(up, 1.0)), *((SIDES[i], at(i, 0.0)) for i in range(up))],
        lambda points: np.interp(points * n, np.arange(n + 1), x),
        young=1.0,
    )
    scene.fix(BOTTOM)
    for axis in range(up):
        scene.fix(SIDES[axis], axis)
    centre = np.zeros(gdim)
    centre[-1] = 1.0 / RADIUS - RADIUS
    scene.add_obstacle(TOP, Sphere(centre=centre, radius=RADIUS))
    return scene.problem(cell_tags=None, options=options)

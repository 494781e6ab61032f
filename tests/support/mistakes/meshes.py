"""Mistakes in meshes and in the tags of their cells."""

import numpy as np
from mesh_arrays import concatenated, grid, merged, mesh_of, problem_on, slit, tags_of

from mistakes.catalogue import table


def on(cell, points, cells, tags=None):
    """Return what poses a problem on points and cells."""

    def pose(comm):
        domain = mesh_of(comm, cell, points, cells)
        problem_on(domain, cell_tags=None if tags is None else tags_of(domain, tags))

    return pose


def two_squares(*place):
    """Return two squares of 2 x 2 cells, the second one at a place."""
    return concatenated(grid((2, 2)), grid((2, 2), place))


def moved(points, of_points, to):
    points[of_points] = to
    return points


SEVENS = np.full(8, 7)
SQUARES, ROW, HALVES = grid((2, 2)), grid((1, 1, 3)), grid((3, 3))
FLAT = [(0, 0), (2, 0), (4, 0), (2, 2), (2, -2)], [(0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 4)]
EDGE = merged(*concatenated(grid((1, 2, 1)), grid((1, 2, 1), (1.0, 0.0, 1.0))))

MISTAKES = table(
    "The mesh",
    ("tag on two pieces", on("quadrilateral", *two_squares(5.0, 0.0), SEVENS)),
    (
        "tag on two pieces with nodes at the same places",
        on("quadrilateral", *two_squares(2.0, 0.0), SEVENS),
    ),
    (
        "tag on two pieces that share a vertex",
        on("quadrilateral", *merged(*two_squares(2.0, 2.0)), SEVENS),
    ),
    ("bodies that share a vertex", on("quadrilateral", *merged(*two_squares(2.0, 2.0)))),
    ("bodies that share an edge", on("hexahedron", *EDGE, [1, 1, 2, 2])),
    ("nodes at the same place in a body", on("quadrilateral", *slit(4))),
    ("cell without area", on("triangle", *FLAT)),
    ("cell without volume", on("hexahedron", moved(ROW[0], (ROW[0][:, 2] == 2.0, 2), 1.0), ROW[1])),
    ("vertices in the order of gmsh", on("quadrilateral", SQUARES[0], SQUARES[1][:, [0, 1, 3, 2]])),
    (
        "vertex pushed through the opposite side",
        on(
            "triangle",
            moved(HALVES[0], 5, (2.3, 2.1)),
            np.concatenate([HALVES[1][:, [0, 1, 2]], HALVES[1][:, [1, 2, 3]]]),
        ),
    ),
    (
        "NaN in a coordinate",
        on("quadrilateral", moved(SQUARES[0].copy(), (4, 1), np.nan), SQUARES[1]),
    ),
)

"""Blocks that are solved for, changed and solved for again, and blocks that slide on a bump."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mpi4py import MPI

import numpy as np
from scenes import CLAMPED, GROUND, MASTER, SIDE_X, SIDE_Y, SLAVE, Scene, at, plane

import ufl

from fenics_tfeti import Plane, Sphere

OPTIONS = {"rtol": 1e-9, "subdomain_size": 60}
EVERYTHING = ["factors", "coarse problem", "norm", "multipliers"]


@dataclass
class Floor:
    """A rigid floor, level or with a slope, that can be lifted after the contact was made."""

    height: float = 0.0
    slope: float = 0.0

    def __call__(self, x):
        normal = np.array([-self.slope, 1.0]) / np.hypot(1.0, self.slope)
        gap = normal[1] * (x[1] - self.height - self.slope * x[0])
        return gap, np.tile(normal[:, None], x.shape[1])


def two_blocks_on_a_floor(comm=MPI.COMM_SELF, gap=1e-4, n=8):
    """Return a block on a block on a rigid floor.

    The upper one's top is moved sideways and pressed by a traction that grows along it; the lower
    one's left face keeps it from moving sideways.
    """
    parts = [((0, 0), (1, 0.5), (n, n // 2)), ((0, 0.5 + gap), (1, 1 + gap), (n, n // 2))]
    marks = [
        (SLAVE, at(1, 0.5 + gap), 2),
        (MASTER, at(1, 0.5), 1),
        (CLAMPED, at(1, 1.0 + gap), 2),
        (GROUND, at(1, 0.0), 1),
        (SIDE_X, at(0, 0.0), 1),
        (SIDE_Y, at(0, 1.0), 1),
    ]
    scene = Scene.of_boxes(comm, "quadrilateral", parts, marks)
    scene.traction, scene.shift = scene.constant(-2e7), scene.constant(1e-4)
    x = ufl.SpatialCoordinate(scene.mesh)
    scene.L = scene.traction * x[0] * scene.v[1] * scene.ds(CLAMPED)
    scene.fix(CLAMPED, 0, scene.shift)
    scene.fix(SIDE_X, 0, scene.constant(0.0))
    scene.floor = Floor()
    scene.add_pair(name="joint")
    scene.add_obstacle(GROUND, scene.floor, name="floor")
    return scene


def new_problem(scene, **options):
    return scene.problem(cell_tags=None, options={**OPTIONS, **options})


# -- changes: each takes the scene and changes it, and says what can be reused ---------------------


def larger_load(scene):
    scene.traction.value *= 1.1
    return EVERYTHING


def other_side_unloaded(scene):
    """A smaller load: contacts open."""
    scene.traction.value *= 0.02
    return EVERYTHING


def moved_top(scene):
    scene.shift.value = -2e-4
    return EVERYTHING


def softer_and_larger_load(scene):
    scene.young.value *= 0.5
    scene.traction.value *= 1.1
    return ["multipliers"]


def lifted_floor(scene):
    """The same obstacle, whose state changed."""
    scene.floor.height = 1e-4
    return EVERYTHING


def tilted_floor(scene):
    scene.floor.slope = 1e-3
    return ["factors", "multipliers"]


def replace_floor(scene, obstacle):
    scene.contacts.pop()
    scene.add_obstacle(GROUND, obstacle, name="floor")


def other_floor(scene):
    """Another obstacle with the same normals."""
    replace_floor(scene, plane(1, 2, 1e-4))
    return EVERYTHING


def round_floor(scene):
    replace_floor(scene, Sphere((0.5, -10.0), 10.0))
    return ["factors", "multipliers"]


def given_normals(scene):
    scene.contacts[0] = replace(scene.contacts[0], normal=(0.1, -1.0))
    return ["factors", "multipliers"]


def added_wall(scene):
    scene.add_obstacle(SIDE_Y, Plane((1.0, 0.0), (-1.0, 0.0)), name="wall")
    return ["factors"]


def nothing(scene):
    return EVERYTHING


CHANGES = [
    larger_load,
    other_side_unloaded,
    moved_top,
    softer_and_larger_load,
    lifted_floor,
    tilted_floor,
    other_floor,
    round_floor,
    given_normals,
    added_wall,
    nothing,
]


# -- sliding


def two_blocks(
    slide, options, n=12, comm=MPI.COMM_SELF, upper=None, height=0.3, start=0.0, gaps=None
):
    """An upper block on the parabolic bump of a lower one, its top moved sideways and down.

    The meshes match unless `upper` is another number of facets than n. `start` is where the upper
    block is meshed, `slide` where it ends.
    """
    parts = [
        ((0, 0), (2, 0.5), (2 * n, n // 2)),
        ((0.5 + start, 0.5), (1.5 + start, 1.0), (upper or n, n // 2)),
    ]
    marks = [(SLAVE, at(1, 0.5), 2), (MASTER, at(1, 0.5), 1)]
    marks += [(CLAMPED, at(1, 1.0)), (GROUND, at(1, 0.0))]

    def bulged(x):
        # both surfaces alike, the outer faces stay
        bump = height * (0.25 - (x[0] - 1.0) ** 2)
        return np.stack([x[0], x[1] + bump * (1.0 - np.abs(x[1] - 0.5) / 0.5)])

    scene = Scene.of_boxes(comm, "quadrilateral", parts, marks, bulged, young=1e6)
    scene.fix(CLAMPED, 0, slide - start)
    scene.fix(CLAMPED, 1, -0.005)
    scene.fix(GROUND)
    scene.add_pair(partial=True)
    return scene.problem(cell_tags=None, gaps=gaps, options=options)

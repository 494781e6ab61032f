"""Seconds of each phase for a wall of loose bricks: many bodies, each held by contact alone.

    python benchmarks/run.py bricks [--bricks 100 1000] [--dimensions 2 3]

Bricks in running bond stand on rigid ground under their own weight, a body and a subdomain each.
Bed joints are closed, head joints are open, and the meshes of neighbouring courses do not match.
Without friction no brick is held sideways: there is at least one free motion for each brick in two
dimensions, and there are three in three dimensions. The whole is solved twice, and the second time
is printed, when the forms are compiled. The ground carries the weight: the error is printed.
"""

from __future__ import annotations

import time
from typing import Any

from mpi4py import MPI

import numpy as np
from scenes import Scene, at, elasticity, plane

import ufl
from dolfinx.mesh import meshtags

from fenics_tfeti import ContactProblem
from fenics_tfeti.io import Box, TaggedMesh, boxes, tag_facets

# length, width and height of a brick, and width of a head joint [m]
BRICK, JOINT = (0.24, 0.115, 0.071), 0.01
DIVISIONS = (4, 2, 2)
WEIGHT = 18e3  # N/m^3
GROUND, TOP, BOTTOM = 1, 1000, 2000


def wall(bricks: int, gdim: int) -> tuple[list[Box], list[int]]:
    """Return about as many bricks as wanted, and the course of each, from 0."""
    courses = round(np.sqrt(bricks / 2.0))
    in_course = round(bricks / courses)
    axes = [0, 2] if gdim == 2 else [0, 1, 2]
    size, divisions = np.array(BRICK)[axes], np.array(DIVISIONS)[axes]
    step, half = BRICK[0] + JOINT, 0.5 * (BRICK[0] - JOINT)
    found, course_of = [], []
    for course in range(courses):
        begins = step * np.arange(in_course)
        ends = begins + BRICK[0]
        if course % 2:
            # a half brick at either end
            begins = np.append(0.0, begins + half + JOINT)
            ends = np.append(half, np.append(ends[:-1] + half + JOINT, ends[-1]))
        for begin, end in zip(begins, ends, strict=True):
            lower, upper = np.zeros(gdim), size.copy()
            lower[0], upper[0] = begin, end
            lower[-1], upper[-1] = course * BRICK[2], (course + 1) * BRICK[2]
            found.append(Box(tuple(lower), tuple(upper), tuple(divisions + course % 2)))
            course_of.append(course)
    return found, course_of


def bed_joints(made: TaggedMesh, course_of: list[int]) -> Any:
    """Tag the upper faces of the courses, TOP + number from 1, and the lower ones."""
    mesh, cell_tags = made.mesh, made.cell_tags
    course = 1 + np.array(course_of, dtype=np.int32)[cell_tags.values - 1]
    courses = meshtags(mesh, mesh.topology.dim, cell_tags.indices, course)
    axis = mesh.geometry.dim - 1
    markers = [(GROUND, at(axis, 0.0), 1)]
    for number in range(1, max(course_of) + 1):
        bed = at(axis, number * BRICK[2])
        markers += [(TOP + number, bed, number), (BOTTOM + number, bed, number + 1)]
    return tag_facets(mesh, markers, courses)


def problem(bricks: int, gdim: int) -> ContactProblem:
    """Return the wall on the ground."""
    parts, course_of = wall(bricks, gdim)
    made = boxes(MPI.COMM_WORLD, parts, "quadrilateral" if gdim == 2 else "hexahedron")
    scene = Scene(made.mesh, bed_joints(made, course_of))
    # Lame's parameters are equal
    scene.a = elasticity(scene.u, scene.v, 2.5 * 5e9, poisson=0.25)
    scene.L = scene.constant(-WEIGHT) * scene.v[gdim - 1] * ufl.dx
    for number in range(1, max(course_of) + 1):
        scene.add_pair(TOP + number, BOTTOM + number)
    scene.add_obstacle(GROUND, plane(gdim - 1, gdim))
    return scene.problem()


def measure(bricks: int, gdim: int) -> dict[str, Any]:
    """Return sizes, products and seconds of the second of two solves."""
    for _ in range(2):
        begin = time.perf_counter()
        wall_problem = problem(bricks, gdim)
        made = time.perf_counter() - begin
        wall_problem.solve()
    report = wall_problem.report
    parts, _ = wall(bricks, gdim)
    weight = WEIGHT * sum(np.prod(np.subtract(part.upper, part.lower)) for part in parts)
    return {
        "bricks": len(parts),
        "dimensions": gdim,
        "ranks": MPI.COMM_WORLD.size,
        "unknowns": report.unknowns["primal"],
        "products": report.products["total"],
        "faces": len(report.faces),
        "free motions": len(report.free_motions),
        "seconds": {"made": made, **report.seconds},
        "weight error": abs(report.contacts[-1].normal_force / weight - 1.0),
        "bytes": report.peak_memory_bytes,
    }


CHOICES = {"dimensions": [2, 3]}


def run(bricks=(100, 1000), dimensions=(2, 3)):
    """Solve walls of all sizes in each dimension."""
    for gdim in dimensions:
        for number in bricks:
            yield measure(number, gdim)

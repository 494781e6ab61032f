"""Blocks that are solved for, changed and solved for again, and blocks that slide on a bump."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
from scenes import (
    CLAMPED,
    GROUND,
    MASTER,
    SIDE_X,
    SIDE_Y,
    SLAVE,
    YOUNG,
    at,
    elasticity,
    fixed,
    vector_space,
)

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, Plane, RigidObstacle, Sphere
from fenics_tfeti.io import Box, boxes, tag_facets

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
    """Return all that a problem is made of: a block on a block on a rigid floor.

    The upper one's top is moved sideways and pressed by a traction that grows along it; the lower
    one's left face keeps it from moving sideways.
    """
    parts = [Box((0, 0), (1, 0.5), (n, n // 2)), Box((0, 0.5 + gap), (1, 1 + gap), (n, n // 2))]
    blocks = boxes(comm, parts, "quadrilateral")
    mesh = blocks.mesh
    top = 1.0 + gap
    markers = [
        (SLAVE, at(1, 0.5 + gap), 2),
        (MASTER, at(1, 0.5), 1),
        (CLAMPED, at(1, top), 2),
        (GROUND, at(1, 0.0), 1),
        (SIDE_X, at(0, 0.0), 1),
        (SIDE_Y, at(0, 1.0), 1),
    ]
    tags = tag_facets(mesh, markers, blocks.cell_tags)
    V = vector_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    young, load, shift = (fem.Constant(mesh, x) for x in (YOUNG, -2e7, 1e-4))
    zero = fem.Constant(mesh, 0.0)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    x = ufl.SpatialCoordinate(mesh)
    dofs = [fem.locate_dofs_topological(V.sub(0), 1, tags.find(tag)) for tag in (CLAMPED, SIDE_X)]
    floor = Floor()
    return SimpleNamespace(
        young=young,
        load=load,
        shift=shift,
        zero=zero,
        tags=tags,
        floor=floor,
        V=V,
        a=elasticity(u, v, young),
        L=load * x[0] * v[1] * ds(CLAMPED),
        bcs=[
            fem.dirichletbc(value, found, V.sub(0))
            for value, found in zip((shift, zero), dofs, strict=True)
        ],
        contacts=[
            ContactPair(tags, slave=SLAVE, master=MASTER, name="joint"),
            RigidObstacle(tags, slave=GROUND, obstacle=floor, name="floor"),
        ],
    )


def new_problem(scene, **options):
    options = {**OPTIONS, **options}
    return ContactProblem(scene.a, scene.L, bcs=scene.bcs, contacts=scene.contacts, options=options)


# -- changes: each takes the scene and changes it, and says what can be reused ---------------------


def larger_load(scene):
    scene.load.value *= 1.1
    return EVERYTHING


def other_side_unloaded(scene):
    """A smaller load: contacts open."""
    scene.load.value *= 0.02
    return EVERYTHING


def moved_top(scene):
    scene.shift.value = -2e-4
    return EVERYTHING


def softer(scene):
    scene.young.value *= 0.5
    return ["multipliers"]


def softer_and_larger_load(scene):
    scene.young.value *= 0.5
    scene.load.value *= 1.1
    return ["multipliers"]


def lifted_floor(scene):
    """The same obstacle, whose state changed."""
    scene.floor.height = 1e-4
    return EVERYTHING


def tilted_floor(scene):
    scene.floor.slope = 1e-3
    return ["factors", "multipliers"]


def other_floor(scene):
    """Another obstacle with the same normals."""
    scene.contacts[1] = RigidObstacle(scene.tags, GROUND, Plane((0, 1e-4), (0, 1)), name="floor")
    return EVERYTHING


def round_floor(scene):
    floor = Sphere((0.5, -10.0), 10.0)
    scene.contacts[1] = RigidObstacle(scene.tags, GROUND, floor, name="floor")
    return ["factors", "multipliers"]


def given_normals(scene):
    scene.contacts[0] = replace(scene.contacts[0], normal=(0.1, -1.0))
    return ["factors", "multipliers"]


def added_wall(scene):
    wall = Plane((1.0, 0.0), (-1.0, 0.0))
    scene.contacts.append(RigidObstacle(scene.tags, SIDE_Y, wall, name="wall"))
    return ["factors"]


def nothing(scene):
    return EVERYTHING


CHANGES = [
    larger_load,
    other_side_unloaded,
    moved_top,
    softer,
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
    slide,
    options,
    n=12,
    comm=MPI.COMM_SELF,
    upper=None,
    height=0.3,
    start=0.0,
    geometry=None,
):
    """An upper block on the parabolic bump of a lower one, its top moved sideways and down.

    The meshes match unless `upper` is another number of facets than n. `start` is where the upper
    block is meshed, `slide` where it ends.
    """
    parts = [
        Box((0, 0), (2, 0.5), (2 * n, n // 2)),
        Box((0.5 + start, 0.5), (1.5 + start, 1.0), (upper or n, n // 2)),
    ]
    blocks = boxes(comm, parts, "quadrilateral")
    mesh = blocks.mesh
    markers = [
        (SLAVE, at(1, 0.5), 2),
        (MASTER, at(1, 0.5), 1),
        (CLAMPED, at(1, 1.0)),
        (GROUND, at(1, 0.0)),
    ]
    tags = tag_facets(mesh, markers, blocks.cell_tags)
    x = mesh.geometry.x
    bump = height * (0.25 - (x[:, 0] - 1.0) ** 2)
    # both surfaces bulge alike, the outer faces stay
    x[:, 1] += bump * (1.0 - np.abs(x[:, 1] - 0.5) / 0.5)
    V = vector_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    zero = fem.Constant(mesh, np.zeros(2))
    bcs = [fixed(V, tags, CLAMPED, i, value) for i, value in enumerate((slide - start, -0.005))]
    bcs += [fixed(V, tags, GROUND, i) for i in (0, 1)]
    a, L = elasticity(u, v, 1e6), ufl.inner(zero, v) * ufl.dx
    contact = ContactPair(tags, slave=SLAVE, master=MASTER, partial=True)
    problem = ContactProblem(a, L, bcs=bcs, contacts=[contact], geometry=geometry, options=options)
    problem.kept = zero
    return problem

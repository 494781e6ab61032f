"""Derivatives with other kinds of contacts, ties and obstacles, against differences."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

from mpi4py import MPI

import numpy as np
import pytest
from scenes import CLAMPED, LOADED, MASTER, SIDE_X, SLAVE, Scene, at
from sensitivity_scenes import (
    block_on_roller,
    blocks,
    of_constant,
    of_function,
    of_mesh,
    sensitive,
    taylor,
)

from dolfinx.mesh import CellType, compute_midpoints, create_rectangle, create_submesh

from fenics_tfeti import (
    ContactPair,
    Cylinder,
    FacetedObstacle,
    LinearRows,
    Plane,
    RigidBody,
    SelfContact,
    find_contacts,
)
from fenics_tfeti.io import tag_facets

pytestmark = pytest.mark.once

LIPS = (11, 12)


def wave(x):
    """A gap alone, whose normals are those of differences."""
    return x[1] + 0.05 * (x[0] - 0.45) ** 2


def ridge(shift=(0.0, 0.0)):
    """A polygon with a corner."""
    points = np.array([(1.5, -0.2), (0.43, 0.0), (-0.5, -0.15)]) + shift
    return FacetedObstacle(points, [(0, 1), (1, 2)])


def row_of(scene):
    """A node of the side that moves up with another one, and a little more."""
    x = scene.V.tabulate_dof_coordinates()
    nodes = [int(np.argmin(np.abs(x[:, :2] - p).sum(axis=1))) for p in ((0.0, 0.6), (1.0, 0.4))]
    return [
        LinearRows([2 * nodes[0] + 1], [2 * nodes[1] + 1], [0.5], [0, 1], values=1e-3, name="row")
    ]


def cracked(contact):
    """A block with a thin slot from its side to its middle, whose lips touch."""
    n, thin = 8, 2e-3
    whole = create_rectangle(
        MPI.COMM_SELF, [(0, 0), (1, 1 + 1 / n)], [n, n + 1], CellType.quadrilateral
    )
    middle = compute_midpoints(whole, 2, np.arange(n * (n + 1), dtype=np.int32))
    is_cut = (middle[:, 0] < 0.6) & (np.abs(middle[:, 1] - 0.5 - 0.5 / n) < 0.5 / n)
    mesh = create_submesh(whole, 2, np.flatnonzero(~is_cut).astype(np.int32))[0]
    x = mesh.geometry.x
    x[x[:, 1] > 0.5 + 0.5 / n, 1] -= 1 / n - thin
    lips = {
        tag: (lambda x, y=y: np.isclose(x[1], y) & (x[0] < 0.63))
        for tag, y in zip(LIPS, (0.5, 0.5 + thin), strict=True)
    }
    marks = {CLAMPED: at(1, 0.0), LOADED: at(1, 1.0 + thin), SIDE_X: at(0, 1.0)}
    scene = Scene(mesh, tag_facets(mesh, marks | lips), None)
    return sensitive(scene, contact(scene), moves_aside=False, down=0.02)


def rigid_base():
    """A block on another one, which is rigid and which a force pushes up."""
    scene = blocks(n=4, m=5).scene
    body = RigidBody((0.5, 0.5), force=(1e-3, 0.02), rotation=0.0, spring=(0.05, 0.05, 1.0))
    scene.bcs = []
    pair = ContactPair(scene.facet_tags, SLAVE, MASTER, name="joint", roles="given")
    return sensitive(scene, [pair], moves_aside=False, clamped=LOADED, rigid_bodies={1: body})


def exchanged():
    """Contact whose slave and master the problem chooses."""
    scene = blocks(n=4, m=5)
    scene.contacts[0] = replace(scene.joint, roles="auto")
    return scene


KINDS = {
    "plane": partial(block_on_roller, obstacle=Plane((0.4, 0.0), (0.05, 1.0))),
    "cylinder": partial(
        block_on_roller,
        cell="hexahedron",
        obstacle=Cylinder((0.45, 0.0, -2.0), (0.1, 1.0, 0.0), 2.0),
    ),
    "gaps alone": partial(block_on_roller, obstacle=wave),
    "faceted obstacle": partial(block_on_roller, obstacle=ridge()),
    "linear rows": partial(block_on_roller, others=row_of),
    "touches itself": partial(cracked, lambda s: [SelfContact(distance=0.04, name="joint")]),
    "crack": partial(
        cracked, lambda s: [ContactPair(s.facet_tags, *LIPS, partial=True, name="joint")]
    ),
    "found": partial(cracked, lambda s: find_contacts(s.mesh, itself=True, distance=0.04)),
    "roles": exchanged,
    "body of the mesh": rigid_base,
}
PARAMETERS = {
    "modulus": lambda s: of_function(s.E, 1e-3),
    "traction": lambda s: of_constant(s.traction, 1e-4),
    "support": lambda s: of_function(s.clamp, 1e-5),
    "nodes": lambda s: of_mesh(s, 4e-4),
}


@cache
def made(kind):
    return KINDS[kind]()


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("kind", KINDS)
def test_remainder_of_second_order(kind, name):
    scene = made(kind)
    scene.problem.contacts = list(scene.contacts)
    scene.solve()
    rates, same = taylor(scene, PARAMETERS[name](scene))
    assert same
    assert np.all(np.abs(rates - 2.0) < 0.05), rates

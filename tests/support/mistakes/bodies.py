"""Mistakes with rigid bodies, bolts, periodic surfaces and linear rows."""

import numpy as np
import scenes
from scenes import CLAMPED, GROUND, LOADED, MASTER, SLAVE, Scene, at

from dolfinx.mesh import locate_entities, meshtags

from fenics_tfeti import (
    BoltPreload,
    LinearRows,
    PeriodicPair,
    Plane,
    RigidBody,
    RigidObstacle,
    UnresistedMotion,
)
from mistakes.catalogue import posed, solved, table


def pressed(reference=(0.5, 1.0), **of_body):
    """Return what solves for a block below a plate that moves with a rigid body."""

    def pose(comm):
        scene = scenes.pressed_block(comm, "quadrilateral", 2)
        scene.bcs = scene.bcs[1:]
        scene.fix(GROUND)
        body = RigidBody(reference, name="plate", **of_body)
        plate = Plane((0.0, 1.0), (0.0, -1.0))
        joint = RigidObstacle(scene.facet_tags, LOADED, plate, rigid_body=body, name="joint")
        scene.problem(contacts=[joint]).solve()

    return pose


def rigid_beam(tag=2, body=None, supports=1, **more):
    """Return what solves for the beams, one of which is rigid."""
    upper = RigidBody((2.0, 1.5), translation=(0.0, None), rotation=0.0)
    rigid = {tag: upper if body is None else body}
    return solved(rigid_bodies=rigid, bcs=lambda s: s.bcs[:supports], **more)


def stacked(comm, upper=(2, 2), shape=None):
    """Return two blocks, the lower one clamped, on top of each other."""
    marks = [(CLAMPED, at(1, 0.0)), (SLAVE, at(1, 1.0), 1), (MASTER, at(1, 1.0), 2)]
    marks += [(LOADED, at(1, 2.0))]
    parts = [((0, 0), (1, 1), (2, 2)), ((0, 1), (1, 2), upper)]
    scene = Scene.of_boxes(comm, "quadrilateral", parts, marks, shape)
    scene.fix(CLAMPED)
    return scene


def contact_between_rigid_bodies(comm):
    scene = stacked(comm)
    scene.contacts = [RigidObstacle(scene.facet_tags, LOADED, Plane((0.0, 2.0), (0.0, -1.0)))]
    scene.problem(rigid_bodies={2: RigidBody((0.5, 1.5), name="blocks")}).solve()


def rigid_body_that_shares_nodes(comm):
    scene = Scene.of_boxes(comm, "quadrilateral", [((0, 0), (1, 2), (2, 2))], [(GROUND, at(1, 0))])
    upper = locate_entities(scene.mesh, 2, lambda x: x[1] > 1 - 1e-9)
    cells = scene.cell_tags.indices
    tags = meshtags(scene.mesh, 2, cells, np.isin(cells, upper).astype(np.int32))
    scene.problem(cell_tags=tags, rigid_bodies={1: RigidBody((0.5, 1.5))}).solve()


def bolted(surfaces=(SLAVE, MASTER), of_blocks=None, **of_bolt):
    """Return what solves for blocks that a bolt holds together."""

    def pose(comm):
        scene = stacked(comm, **(of_blocks or {}))
        scene.fix(LOADED)
        scene.contacts = [BoltPreload(scene.facet_tags, *surfaces, name="bolt", **of_bolt)]
        scene.problem().solve()

    return pose


def bolt_that_is_locked_by_a_number(comm):
    scene = stacked(comm)
    BoltPreload(scene.facet_tags, SLAVE, MASTER, force=1e3, name="bolt").locked(1e-3)


def bent(x):
    return np.array([x[0], x[1] + 0.2 * x[0] * (1 - x[0])])


def periodic(**of_pair):
    """Return what solves for two blocks, of which the top moves as the bottom."""

    def pose(comm):
        scene = stacked(comm)
        scene.add_pair()
        cell = PeriodicPair(scene.facet_tags, LOADED, CLAMPED, name="cell", **of_pair)
        scene.contacts.append(cell)
        scene.problem(bcs=[]).solve()

    return pose


def rows(slaves, offsets):
    return lambda comm: LinearRows(slaves, [2, 3], [1.0, 1.0], offsets, name="rows")


SKEW = [[1.0, 2.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
BOTH = {1: RigidBody((1.0, 0.5)), 2: RigidBody((2.0, 1.5))}
TITLE = "Rigid bodies, bolts, periodic surfaces"
MISTAKES = [
    *table(
        TITLE,
        ("rigid body that nothing holds", pressed(force=(0.0, 1e3), rotation=0.0)),
        error=UnresistedMotion,
    ),
    *table(
        TITLE,
        ("force on a rigid body with three components", pressed(force=(0.0, 0.0, -1e3))),
        ("reference point of another dimension", pressed((0.5, 1.0, 0.0))),
        ("spring that is not symmetric", pressed(spring=SKEW)),
        ("rigid tag on no cell", rigid_beam(tag=7)),
        ("rigid cells without cell tags", rigid_beam(cell_tags=None)),
        ("rigid body that is a number", rigid_beam(body=1e6)),
        ("rigid bodies in a list", posed(rigid_bodies=[RigidBody((2.0, 1.5))])),
        ("rigid body by its name", rigid_beam(tag="upper")),
        ("rigid body of another dimension", rigid_beam(body=RigidBody((2.0, 1.5, 0.0)))),
        ("rigid bodies alone", posed(rigid_bodies=BOTH)),
        ("support on a rigid body", rigid_beam(supports=2)),
        ("contact between rigid bodies", contact_between_rigid_bodies),
        ("rigid body that shares nodes", rigid_body_that_shares_nodes),
        ("bolt with force and shortening", bolted(force=1e3, shortening=1e-3)),
        ("axis of a bolt in its cut", bolted(force=1e3, axis=(1.0, 0.0))),
        ("bolt that is locked by a number", bolt_that_is_locked_by_a_number),
        ("cut of a bolt that is not plane", bolted(of_blocks={"shape": bent}, force=1e3)),
        ("sides of a cut with different meshes", bolted(of_blocks={"upper": (3, 2)}, force=1e3)),
        ("cut with one tag for both sides", bolted((SLAVE, SLAVE), force=1e3)),
        ("periodic surfaces without a translation", periodic()),
        ("periodic surfaces with a wrong translation", periodic(translation=(0.0, 1.9))),
        ("rotation of a sector that is no rotation", periodic(rotation=[[1.0, 0.1], [0.0, 1.0]])),
        ("offsets of linear rows that do not fit", rows([0], [0, 1])),
        ("slave of two linear rows", rows([0, 0], [0, 1, 2])),
    ),
]

"""Mistakes with rigid bodies, bolts, periodic surfaces and linear rows."""

from __future__ import annotations

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
from mistakes.catalogue import beams, mistake


def pressed(comm, **given):
    """Solve for a block below a plate that moves with a rigid body."""
    scene = scenes.pressed_block(comm, "quadrilateral", 2)
    scene.bcs = scene.bcs[1:]
    scene.fix(GROUND)
    body = RigidBody(**{"reference": (0.5, 1.0), "name": "plate", **given})
    plate = Plane((0.0, 1.0), (0.0, -1.0))
    joint = RigidObstacle(scene.facet_tags, LOADED, plate, body=body, name="joint")
    scene.problem(contacts=[joint]).solve()


def rigid_beam(comm, tag=2, body=None, supports=1, **arguments):
    """Solve for the beams, one of which is rigid."""
    scene = beams(comm)
    upper = RigidBody((2.0, 1.5), translation=(0.0, None), rotation=0.0)
    rigid = {tag: upper if body is None else body}
    scene.problem(rigid=rigid, bcs=scene.bcs[:supports], **arguments).solve()


@mistake("plate", "translation along", error=UnresistedMotion)
def rigid_body_that_nothing_holds(comm):
    pressed(comm, force=(0.0, 1e3), rotation=0.0)


@mistake("plate", "force", "2 finite numbers")
def force_on_a_rigid_body_with_three_components(comm):
    pressed(comm, force=(0.0, 0.0, -1e3))


@mistake("joint", "reference point", "3 coordinates")
def reference_point_of_another_dimension(comm):
    pressed(comm, reference=(0.5, 1.0, 0.0))


@mistake("plate", "spring", "not symmetric")
def spring_that_is_not_symmetric(comm):
    pressed(comm, spring=[[1.0, 2.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


@mistake("rigid", r"\b7\b", "cell_tags", r"\[1, 2\]")
def rigid_tag_on_no_cell(comm):
    rigid_beam(comm, tag=7)


@mistake("rigid", "cell_tags")
def rigid_cells_without_cell_tags(comm):
    rigid_beam(comm, cell_tags=None)


@mistake("rigid", r"\b2\b", "float")
def rigid_body_that_is_a_number(comm):
    rigid_beam(comm, body=1e6)


@mistake("rigid is a list", "dict of RigidBody")
def rigid_bodies_in_a_list(comm):
    beams(comm).problem(rigid=[RigidBody((2.0, 1.5))])


@mistake("rigid", "'upper'", "integer")
def rigid_body_by_its_name(comm):
    rigid_beam(comm, tag="upper")


@mistake("rigid", "tag 2", "3 coordinates", "mesh 2")
def rigid_body_of_another_dimension(comm):
    rigid_beam(comm, body=RigidBody((2.0, 1.5, 0.0)))


@mistake("all bodies are rigid", "deformable")
def rigid_bodies_alone(comm):
    beams(comm).problem(rigid={1: RigidBody((1.0, 0.5)), 2: RigidBody((2.0, 1.5))})


@mistake("rigid bodies", "5 nodes", r"\(3, 1\)", "translation")
def support_on_a_rigid_body(comm):
    rigid_beam(comm, supports=2)


def stacked(comm, upper=(2, 2), shape=None):
    """Return two blocks, the lower one clamped, on top of each other."""
    marks = [(CLAMPED, at(1, 0.0)), (SLAVE, at(1, 1.0), 1), (MASTER, at(1, 1.0), 2)]
    marks += [(LOADED, at(1, 2.0))]
    parts = [((0, 0), (1, 1), (2, 2)), ((0, 1), (1, 2), upper)]
    scene = Scene.of_boxes(comm, "quadrilateral", parts, marks, shape)
    scene.fix(CLAMPED)
    return scene


@mistake("contact 0", "rigid body 'blocks'", "not unique")
def contact_between_rigid_bodies(comm):
    scene = stacked(comm)
    scene.contacts = [RigidObstacle(scene.facet_tags, LOADED, Plane((0.0, 2.0), (0.0, -1.0)))]
    scene.problem(rigid={2: RigidBody((0.5, 1.5), name="blocks")}).solve()


@mistake("3 nodes", r"\(0, 1\)", "split_interfaces", "TiedPair")
def rigid_body_that_shares_nodes(comm):
    scene = Scene.of_boxes(comm, "quadrilateral", [((0, 0), (1, 2), (2, 2))], [(GROUND, at(1, 0))])
    upper = locate_entities(scene.mesh, 2, lambda x: x[1] > 1 - 1e-9)
    cells = scene.cell_tags.indices
    tags = meshtags(scene.mesh, 2, cells, np.isin(cells, upper).astype(np.int32))
    scene.problem(cell_tags=tags, rigid={1: RigidBody((0.5, 1.5))}).solve()


def bolted(comm, scene=None, surfaces=(SLAVE, MASTER), **given):
    """Solve for blocks that a bolt holds together."""
    scene = stacked(comm) if scene is None else scene
    scene.fix(LOADED)
    scene.contacts = [BoltPreload(scene.facet_tags, *surfaces, name="bolt", **given)]
    scene.problem().solve()


@mistake("bolt", "force or the shortening")
def bolt_with_force_and_shortening(comm):
    bolted(comm, force=1e3, shortening=1e-3)


@mistake("bolt", "axis", "in the plane of the cut")
def axis_of_a_bolt_in_its_cut(comm):
    bolted(comm, force=1e3, axis=(1.0, 0.0))


def bent(x):
    return np.array([x[0], x[1] + 0.2 * x[0] * (1 - x[0])])


@mistake("bolt", "not plane", "2 nodes", "axis")
def cut_of_a_bolt_that_is_not_plane(comm):
    bolted(comm, stacked(comm, shape=bent), force=1e3)


@mistake("bolt", "2 facets of the slave", "match")
def sides_of_a_cut_with_different_meshes(comm):
    bolted(comm, stacked(comm, upper=(3, 2)), force=1e3)


@mistake("bolt", "split_interfaces")
def cut_with_one_tag_for_both_sides(comm):
    bolted(comm, surfaces=(SLAVE, SLAVE), force=1e3)


def periodic(comm, **given):
    """Solve for two blocks, of which the top moves as the bottom."""
    scene = stacked(comm)
    scene.add_pair()
    scene.contacts.append(PeriodicPair(scene.facet_tags, LOADED, CLAMPED, name="cell", **given))
    scene.problem(bcs=[]).solve()


@mistake("cell", "translation", "rotation", "TiedPair")
def periodic_surfaces_without_a_translation(comm):
    periodic(comm)


@mistake("cell", "2 of 2 facets", "match")
def periodic_surfaces_with_a_wrong_translation(comm):
    periodic(comm, translation=(0.0, 1.9))


@mistake("cell", "rotation", "orthogonal")
def rotation_of_a_sector_that_is_no_rotation(comm):
    periodic(comm, rotation=[[1.0, 0.1], [0.0, 1.0]])


@mistake("rows", "offsets", "2 that ascend")
def offsets_of_linear_rows_that_do_not_fit(comm):
    LinearRows([0], [2, 3], [1.0, 1.0], [0, 1], name="rows")


@mistake("rows", "two conditions")
def slave_of_two_linear_rows(comm):
    LinearRows([0, 0], [2, 3], [1.0, 1.0], [0, 1, 2], name="rows")

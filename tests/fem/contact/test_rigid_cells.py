"""Rigid bodies with cells of the mesh, against obstacles with the same shape and stiff bodies."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import CLAMPED, LOADED, MASTER, SLAVE, YOUNG, Scene, at

from fenics_tfeti import Coulomb, Deformed, Plane, RigidBody, TiedPair

COMM = MPI.COMM_WORLD
FORCE = 1e-3 * YOUNG
BLOCK, FOOT = 1, 2
PRECISE = {"rtol": 1e-9}
ranks = pytest.mark.ranks


def block_below(foot, gdim, n=3, foot_modulus=1.0):
    """Return a clamped unit block below a foot with ends (a, b) along the first axis, or alone."""
    cell, up = ("quadrilateral", 1) if gdim == 2 else ("hexahedron", 2)
    boxes = [(np.zeros(gdim), np.ones(gdim), (n,) * gdim)]
    marks = [(CLAMPED, at(up, 0.0)), (SLAVE, at(up, 1.0), BLOCK)]
    if foot is not None:
        a, b = np.zeros(gdim), np.ones(gdim)
        (a[0], b[0]), a[up], b[up] = foot, 1.0, 1.5
        boxes.append((a, b, (n,) * gdim))
        marks += [(MASTER, at(up, 1.0), FOOT), (LOADED, at(up, 1.5))]
    young = {BLOCK: YOUNG, FOOT: foot_modulus * YOUNG}
    scene = Scene.of_boxes(COMM, cell, boxes, marks, young=young)
    scene.fix(CLAMPED)
    return scene


def foot_of(gdim, **more):
    """Return a body with loads beside its middle."""
    force = np.zeros(gdim)
    force[0], force[-1] = 0.1 * FORCE, -FORCE
    moment = -0.2 * FORCE if gdim == 2 else (0.15 * FORCE, 0.2 * FORCE, 0.0)
    return RigidBody([0.5] * (gdim - 1) + [1.0], name="foot", force=force, moment=moment, **more)


def measures(problem):
    """Return lengths, forces, and nodal forces by place of a problem with a foot on a joint."""
    body, joint = problem.rigid_bodies["foot"], problem.results["joint"].gather()
    order = np.lexsort(np.round(joint.coordinates.T, 9))
    forces = [body.force, body.moment, body.reaction, body.reaction_moment]
    friction = [] if joint.friction is None else [joint.friction.force]
    nodal = np.column_stack([joint.nodal_normal_force, *friction])[order]
    return np.append(body.translation, body.rotation), np.concatenate([*forces, nodal.ravel()])


@pytest.mark.parametrize(
    ("gdim", "held", "law"),
    [
        pytest.param(2, {}, Coulomb(0.3), marks=ranks),
        (3, {"translation": (0.0, 0.0, None), "rotation": (None, None, 0.0)}, None),
        pytest.param(2, {"translation": (2e-4, -1e-3), "rotation": 2e-4}, None, marks=ranks),
        (2, {"spring": [0.1 * YOUNG] * 2}, None),
    ],
    ids=["loads", "loads in 3D", "motion", "spring"],
)
def test_flat_foot_is_a_plane(gdim, held, law):
    """Where the nodes match, the conditions are those of an obstacle with the foot's end."""
    body = foot_of(gdim, **held)
    scene = block_below((0.0, 1.0), gdim)
    scene.add_pair(friction=law, name="joint")
    problem = scene.problem(rigid_bodies={FOOT: body}, options=PRECISE)
    problem.solve()
    alone, up = block_below(None, gdim), np.eye(gdim)[-1]
    alone.add_obstacle(SLAVE, Plane(up, -up), friction=law, rigid_body=body, name="joint")
    expected = alone.problem(options=PRECISE)
    expected.solve()
    for found, wanted in zip(measures(problem), measures(expected), strict=True):
        assert np.abs(found - wanted).max() <= 1e-6 * np.abs(wanted).max()


@pytest.mark.parametrize(
    ("foot", "sideways", "gaps"),
    [
        ((0.2, 0.7), 0.1 * FORCE, None),
        pytest.param((0.25, 0.75), 0.0, Deformed(1e-6), marks=ranks),
    ],
)
def test_foot_is_a_stiff_body(foot, sideways, gaps):
    """Tractions on the cells are loads of the body, and its nodes move with it.

    The exact one is symmetric: rigid bodies that turn move their loads, linear elastic ones do not.
    """
    found = []
    for rigid in ({FOOT: RigidBody((0.5, 1.5))}, {}):
        scene = block_below(foot, 2, foot_modulus=1e6)
        scene.add_load(LOADED, (sideways, -FORCE))
        # the rigid surface becomes the master, the much stiffer one too
        scene.add_pair(MASTER, SLAVE, friction=Coulomb(0.5))
        problem = scene.problem(rigid_bodies=rigid, gaps=gaps, options=PRECISE)
        uh = problem.solve()
        found.append((uh.x.array.copy(), problem.results[0].gather().pressure))
    for values, stiff in zip(*found, strict=True):
        assert np.abs(values - stiff).max(initial=0.0) <= 1e-5 * np.abs(stiff).max(initial=0.0)


@ranks
def test_tied_foot_transmits_its_loads():
    scene = block_below((0.2, 0.7), 3, n=2)
    scene.contacts = [TiedPair(scene.facet_tags, slave=SLAVE, master=MASTER)]
    body = foot_of(3)
    problem = scene.problem(rigid_bodies={FOOT: body}, options=PRECISE)
    problem.solve()
    found = problem.rigid_bodies["foot"]
    assert found.force == pytest.approx(-body.load[:3], rel=1e-8, abs=1e-8 * FORCE)
    assert found.moment == pytest.approx(-body.load[3:], rel=1e-8, abs=1e-8 * FORCE)


@ranks
def test_loads_are_read_by_each_solve():
    scene = block_below((0.0, 1.0), 2)
    scene.add_pair(name="joint")
    load = scene.add_load(LOADED, (0.0, -FORCE))
    guide = RigidBody((0.5, 1.5), translation=(0.0, None), rotation=0.0)
    problem = scene.problem(rigid_bodies={FOOT: guide}, options=PRECISE)
    for factor in (1.0, 2.0):
        load.value[1] = -factor * FORCE
        problem.solve()
        assert problem.results["joint"].force[1] == pytest.approx(-factor * FORCE)

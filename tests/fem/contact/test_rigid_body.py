"""Rigid bodies that forces move: the obstacles of elastic bodies."""

from __future__ import annotations

import warnings

from mpi4py import MPI

import daqp
import numpy as np
import primal_reference as reference
import pytest
from scenes import GROUND, LOADED, YOUNG, Scene, at, pressed_block

from dolfinx import fem
from dolfinx.fem import petsc

from fenics_tfeti import (
    ContactProblem,
    Coulomb,
    Deformed,
    FacetedObstacle,
    InputError,
    Plane,
    RigidBody,
    RigidObstacle,
    UnresistedMotion,
)

COMM = MPI.COMM_WORLD
FORCE = 1e-3 * YOUNG
ranks = pytest.mark.ranks


def block(gdim: int, n: int = 4) -> Scene:
    """Return a unit block that is clamped at its bottom, with its top tagged."""
    cell = "quadrilateral" if gdim == 2 else "hexahedron"
    up = gdim - 1
    marks = [(LOADED, at(up, 1.0)), (GROUND, at(up, 0.0))]
    scene = Scene.of_boxes(COMM, cell, [((0.0,) * gdim, (1.0,) * gdim, (n,) * gdim)], marks)
    scene.cell_tags = None
    scene.fix(GROUND)
    return scene


def above(gdim: int, bend: float = 0.0):
    """Return an obstacle above the block: its end at height 1, bent upwards at its rim."""

    def shape(x):
        gap = bend * np.sum((x[: gdim - 1] - 0.5) ** 2, axis=0)
        normal = np.zeros((gdim, gap.size))
        normal[-1] = -1.0
        return gap, normal

    return shape


def punch(gdim: int, **more) -> RigidBody:
    """Return a body that moves upwards and tilts, pressed down beside its middle."""
    reference = (0.5, 1.0) if gdim == 2 else (0.5, 0.5, 1.0)
    moment = -0.2 * FORCE if gdim == 2 else (0.15 * FORCE, 0.2 * FORCE, 0.0)
    slide = (0.0, None) if gdim == 2 else (0.0, 0.0, None)
    turn = None if gdim == 2 else (None, None, 0.0)
    force = np.zeros(gdim)
    force[-1] = -FORCE
    given = {"force": force, "moment": moment, "translation": slide, "rotation": turn}
    return RigidBody(reference, name="punch", **{**given, **more})


def dense_solution(scene: Scene, body: RigidBody, shape) -> tuple:
    """Return displacement, nodal forces and motion by the compliance of the nodes at the top."""
    gdim, V = scene.gdim, scene.V
    matrix = petsc.assemble_matrix(fem.form(scene.a))
    matrix.assemble()
    K = matrix.convert("dense").getDenseArray()
    free = np.isnan(reference.prescribed_values(V, scene.bcs))
    inverse = np.zeros_like(K)
    inverse[np.ix_(free, free)] = np.linalg.inv(K[np.ix_(free, free)])
    x = V.tabulate_dof_coordinates()
    top = np.flatnonzero(np.isclose(x[:, gdim - 1], 1.0))
    dofs, arms = gdim * top + gdim - 1, x[top] - 0.5
    # upward displacements of the body in its free motions
    turns = [arms[:, 0]] if gdim == 2 else [arms[:, 1], -arms[:, 0]]
    R = np.column_stack([np.ones(top.size), *turns])
    load, C, gap = body.load[body.is_free], inverse[np.ix_(dofs, dofs)], shape(x[top].T)[0]
    scale = np.abs(C).max()
    # downward forces p >= 0 on the block: min p'Cp / 2 + gap'p with R'p + load = 0
    p, _, flag, info = daqp.solve(
        np.ascontiguousarray(C / scale),
        gap / scale / FORCE,
        np.ascontiguousarray(np.vstack([np.identity(top.size), R.T])),
        np.append(np.full(top.size, 1e30), -load / FORCE),
        np.append(np.zeros(top.size), -load / FORCE),
        np.append(np.zeros(top.size), np.full(R.shape[1], 5)).astype(np.int32),
        primal_tol=1e-12,
        dual_tol=1e-12,
    )
    assert flag == 1
    p *= FORCE
    u = -inverse[:, dofs] @ p
    on = p > 1e-9 * p.max()
    motion = np.linalg.lstsq(R[on], u[dofs][on] - gap[on], rcond=None)[0]
    return u, top, p, motion


@pytest.mark.parametrize("bend", [0.0, 1e-3])
@pytest.mark.parametrize("gdim", [2, 3])
def test_eccentric_force_with_lift_off(gdim, bend):
    scene, body, shape = block(gdim), punch(gdim), above(gdim, bend)
    scene.add_obstacle(LOADED, shape, rigid_body=body, name="joint")
    problem = scene.problem(options={"rtol": 1e-9})
    uh = problem.solve()
    u, top, p, motion = dense_solution(scene, body, shape)
    assert 0 < np.count_nonzero(p > 1e-9 * p.max()) < p.size
    assert np.abs(uh.x.array - u).max() <= 1e-6 * np.abs(u).max()
    joint, result = problem.results["joint"], problem.rigid_bodies["punch"]
    assert np.array_equal(joint.dofs, top)
    assert np.abs(joint.nodal_normal_force - p).max() <= 1e-6 * p.max()
    solved = np.append(result.translation, result.rotation)[body.is_free]
    assert solved == pytest.approx(motion, rel=1e-6, abs=1e-6 * np.abs(u).max())
    # contact forces and the guides balance the load
    assert result.force[-1] == pytest.approx(FORCE, rel=1e-9)
    carried = np.append(result.force, result.moment) + body.load
    assert np.abs(carried[body.is_free]).max() <= 1e-9 * FORCE
    assert np.append(result.reaction, result.reaction_moment) == pytest.approx(-carried)
    assert (joint.opening >= -1e-9 * np.abs(u).max()).all()
    assert problem.report.equilibrium <= 1e-9
    assert problem.report.rigid_bodies == [result]


def test_force_and_prescribed_motion_are_inverse():
    """A body under the force that a prescribed motion takes makes this motion."""
    shape = above(3, 1e-3)
    slide = fem.Constant(block(3).mesh, (0.0, 0.0, -2e-3))
    pushed = RigidBody((0.2, 0.5, 1.0), translation=slide, rotation=(1e-3, -1e-3, 0.0))
    scene = block(3)
    scene.add_obstacle(LOADED, shape, rigid_body=pushed)
    problem = scene.problem(options={"rtol": 1e-9})
    first = problem.solve().x.array.copy()
    (held,) = problem.rigid_bodies
    assert held.translation == [0.0, 0.0, -2e-3]
    assert held.rotation == pytest.approx([1e-3, -1e-3, 0.0])
    assert held.reaction[2] < 0.0
    moment = held.reaction_moment
    loaded = RigidBody(
        (0.2, 0.5, 1.0),
        force=held.reaction,
        moment=(*moment[:2], 0.0),
        translation=(0.0, 0.0, None),
        rotation=(None, None, 0.0),
    )
    problem.contacts[0] = RigidObstacle(scene.facet_tags, LOADED, shape, rigid_body=loaded)
    second = problem.solve().x.array
    assert np.abs(second - first).max() <= 1e-6 * np.abs(first).max()
    (free,) = problem.rigid_bodies
    assert free.translation[2] == pytest.approx(-2e-3, rel=1e-6)
    assert free.rotation[:2] == pytest.approx([1e-3, -1e-3], rel=1e-5)
    # twice the load, as a Constant that the next step changes
    slide.value[2] = -4e-3
    problem.contacts[0] = RigidObstacle(scene.facet_tags, LOADED, shape, rigid_body=pushed)
    problem.solve()
    assert problem.rigid_bodies[0].translation[2] == -4e-3


@pytest.mark.parametrize("soft", [1e-4, 1e-2, 1.0, 1e3])
def test_spring_in_series(soft):
    """A block of stiffness k is pressed on a plane that a spring holds: both carry one force."""
    scene = pressed_block(COMM)
    k = YOUNG
    body = RigidBody(
        (0.5, 0.5, 0.0), spring=(0.0, 0.0, soft * k), translation=(0, 0, None), rotation=0.0
    )
    obstacle = scene.contacts[0].obstacle
    scene.contacts = [RigidObstacle(scene.facet_tags, GROUND, obstacle, rigid_body=body)]
    problem = scene.problem(options={"rtol": 1e-9})
    problem.solve()
    (result,) = problem.rigid_bodies
    force = 1e-3 * k * soft / (1.0 + soft)
    assert problem.results[0].force[2] == pytest.approx(force, rel=1e-8)
    assert result.translation[2] == pytest.approx(-force / (soft * k), rel=1e-8)
    assert result.reaction[2] == pytest.approx(force, rel=1e-8)


def test_spring_of_a_tilting_body():
    """A body on rotational springs alone turns by moment over stiffness, up to the contact."""
    scene = block(3)
    springs = np.diag([1e9, 2e9, 4e9, 1e8, 2e8, 4e8])
    springs[0, 4] = springs[4, 0] = 1e8
    load = np.array([1e3, 0.0, 2e3, 1e3, 1e3, 2e3])
    body = RigidBody((0.5, 0.5, 2.0), force=load[:3], moment=load[3:], spring=springs)
    scene.add_obstacle(LOADED, Plane((0.0, 0.0, 1.1), (0.0, 0.0, -1.0)), rigid_body=body)
    problem = scene.problem()
    problem.solve()
    (result,) = problem.rigid_bodies
    motion = np.append(result.translation, result.rotation)
    assert motion == pytest.approx(np.linalg.solve(springs, load), rel=1e-8, abs=1e-14)
    assert not np.any(result.force)


def test_one_body_in_two_contacts():
    """A shaft in two bores carries an eccentric force by both; they are one body."""
    scene = block(2)
    scene.add_obstacle(LOADED, above(2), rigid_body=punch(2))
    problem = scene.problem()
    problem.solve()
    whole = problem.rigid_bodies[0]
    marks = [(LOADED, lambda x: at(1, 1.0)(x) & (x[0] <= 0.5 + 1e-9)), (GROUND, at(1, 0.0))]
    marks.append((LOADED + 40, lambda x: at(1, 1.0)(x) & (x[0] >= 0.5 - 1e-9)))
    halves = Scene.of_boxes(COMM, "quadrilateral", [((0.0, 0.0), (1.0, 1.0), (4, 4))], marks)
    halves.cell_tags = None
    halves.fix(GROUND)
    body = punch(2)
    for tag in (LOADED, LOADED + 40):
        # two obstacles: a node in both has one condition
        halves.add_obstacle(tag, above(2), rigid_body=body)
    problem = halves.problem()
    problem.solve()
    assert len(problem.rigid_bodies) == 1
    both = problem.rigid_bodies["punch"]
    assert both.translation == pytest.approx(whole.translation, rel=1e-5)
    assert both.rotation == pytest.approx(whole.rotation, rel=1e-5)
    assert both.force == pytest.approx(whole.force, rel=1e-6)


@ranks
def test_friction_holds_a_body_sideways():
    """A block under a punch that is pressed and pushed sticks below the coefficient of friction."""
    scene = block(3)
    body = RigidBody((0.5, 0.5, 1.0), force=(0.2 * FORCE, 0.0, -FORCE), rotation=(0.0, None, 0.0))
    friction = Coulomb(0.3)
    scene.add_obstacle(LOADED, above(3), rigid_body=body, friction=friction)
    problem = scene.problem(options={"rtol": 1e-8})
    problem.solve()
    (result,) = problem.rigid_bodies
    assert result.force == pytest.approx([-0.2 * FORCE, 0.0, FORCE], rel=1e-6, abs=1e-6 * FORCE)
    assert result.translation[0] > 0.0
    first = np.append(result.translation, result.rotation)
    problem.advance()
    # the same load again: nothing slips further
    problem.solve()
    (again,) = problem.rigid_bodies
    assert np.append(again.translation, again.rotation) == pytest.approx(first, rel=1e-5, abs=1e-12)
    slip = problem.results[0].friction.slip
    assert np.abs(slip).max(initial=0.0) <= 1e-5 * np.abs(first).max()


def test_friction_that_does_not_hold():
    scene = block(3)
    body = RigidBody((0.5, 0.5, 1.0), force=(0.4 * FORCE, 0.0, -FORCE), rotation=0.0, name="sledge")
    scene.add_obstacle(LOADED, above(3), rigid_body=body, friction=Coulomb(0.3))
    with pytest.raises(UnresistedMotion, match=r"friction cannot hold the load.*sledge"):
        scene.problem().solve()


@ranks
def test_body_that_nothing_holds():
    scene = block(2)
    body = RigidBody((0.5, 1.0), force=(1.0, -1.0), name="sledge")
    scene.add_obstacle(LOADED, above(2), rigid_body=body)
    with pytest.raises(UnresistedMotion, match=r"sledge: translation along \(1, 0\)"):
        scene.problem().solve()


@ranks
def test_turned_body_with_exact_geometry():
    """A long bar that a hinge holds turns down on a block by an angle that is not small."""
    scene = block(2)
    # the lower face of the bar starts 0.3 above the block; its hinge is 1 beside it
    shape = Plane((0.0, 1.3), (0.0, -1.0))
    hinged = RigidBody((-1.0, 1.3), moment=-1e-3 * YOUNG, translation=0.0)
    scene.add_obstacle(LOADED, shape, rigid_body=hinged)
    problem = scene.problem(gaps=Deformed(1e-6))
    uh = problem.solve()
    (result,) = problem.rigid_bodies
    angle = result.rotation[0]
    joint = problem.results[0].gather()
    values = uh.x.array.reshape(-1, 2)
    local = problem.results[0]
    place = local.coordinates[:, :2] + values[local.dofs]
    # distance from the line through the hinge
    normal = np.array([np.sin(angle), -np.cos(angle)])
    distance = (place - [-1.0, 1.3]) @ normal
    assert np.abs(distance[local.active]).max(initial=0.0) <= 1e-5
    assert (distance >= -1e-5).all()
    # at the far corner of the block
    assert angle == pytest.approx(-np.arctan(0.15), rel=0.02)
    # the moment of the normal forces about the hinge is that of the load
    assert result.moment[0] == pytest.approx(1e-3 * YOUNG, rel=1e-5)
    assert joint.active.any()


@pytest.mark.parametrize("gaps", [None, Deformed(1e-8)])
def test_surface_of_facets(gaps):
    """A body with the surface of a mesh moves and turns as one with the same plane."""
    motions, pressures = [], []
    facets = FacetedObstacle([(-1.0, 1.0), (0.3, 1.0), (2.0, 1.0)], [(0, 1), (1, 2)])
    for shape in (Plane((0.0, 1.0), (0.0, -1.0)), facets):
        scene = block(2)
        scene.add_obstacle(LOADED, shape, rigid_body=punch(2), name="joint")
        problem = scene.problem(options={"rtol": 1e-10}, gaps=gaps)
        problem.solve()
        body = problem.rigid_bodies["punch"]
        motions.append([*body.translation, *body.rotation])
        pressures.append(problem.results["joint"].pressure)
    assert abs(motions[0][2]) > 1e-4
    assert motions[1] == pytest.approx(motions[0], rel=1e-7, abs=1e-12)
    assert np.abs(np.subtract(*pressures)).max() <= 1e-6 * pressures[0].max()


def test_page(tmp_path):
    """Rigid bodies have a table of their own, with the moments that hold them."""
    pytest.importorskip("plotly")
    scene = block(2)
    plate = RigidBody((0.0, 1.0), force=(0.0, -FORCE), translation=(0.0, None), rotation=0.0)
    scene.add_obstacle(LOADED, above(2), rigid_body=plate)
    problem = scene.problem()
    problem.solve()
    problem.report.to_html(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "<h2>Rigid bodies</h2>" in page and "<th>reaction moment [N]</th>" in page
    moment = problem.rigid_bodies[0].reaction_moment[0]
    assert moment == pytest.approx(-0.5 * FORCE, rel=1e-6)
    assert f"<td>{moment:.4g}</td>" in page


@ranks
def test_rotation_that_is_not_small():
    """The hinged bar without `Deformed`: one warning."""
    scene = block(2)
    hinged = RigidBody((-1.0, 1.3), moment=-1e-3 * YOUNG, translation=0.0, name="bar")
    scene.add_obstacle(LOADED, Plane((0.0, 1.3), (0.0, -1.0)), rigid_body=hinged)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene.problem().solve()
    messages = [str(warning.message) for warning in caught]
    told = sum("bar turns by 0.15 rad" in message for message in messages)
    assert COMM.allreduce(told) == 1


MISTAKES = {
    "reference point": lambda: RigidBody((0.0,)),
    "force is": lambda: RigidBody((0.0, 0.0), force=(1.0,)),
    "moment is": lambda: RigidBody((0.0, 0.0, 0.0), moment=None),
    "translation is": lambda: RigidBody((0.0, 0.0), translation=(0.0, "free")),
    "rotation is .* a number or None is expected": lambda: RigidBody((0.0, 0.0), rotation=(0, 1)),
    "3 numbers or None": lambda: RigidBody((0.0, 0.0, 0.0), rotation=(0.0, None)),
    "the spring is": lambda: RigidBody((0.0, 0.0), spring=(1.0, 2.0, 3.0, 4.0)),
    "not symmetric": lambda: RigidBody((0.0, 0.0), spring=np.triu(np.ones((3, 3)))),
    "negative in some": lambda: RigidBody((0.0, 0.0), spring=(1.0, -1.0)),
    "name is": lambda: RigidBody((0.0, 0.0), name=1),
}


@pytest.mark.parametrize("words", MISTAKES)
def test_wrong_descriptions(words):
    with pytest.raises(InputError, match=words):
        MISTAKES[words]()


def test_wrong_bodies():
    scene = block(2)
    with pytest.raises(InputError, match="body is a str"):
        RigidObstacle(scene.facet_tags, LOADED, above(2), rigid_body="punch")
    with pytest.raises(InputError, match="leave its displacement out"):
        RigidObstacle(
            scene.facet_tags,
            LOADED,
            above(2),
            rigid_body=punch(2),
            displacement=(1.0, 0.0),
            friction=Coulomb(0.1),
        )
    scene.add_obstacle(LOADED, above(2), rigid_body=punch(3))
    with pytest.raises(InputError, match="3 coordinates, the mesh 2"):
        ContactProblem(scene.a, 0, bcs=scene.bcs, contacts=scene.contacts)

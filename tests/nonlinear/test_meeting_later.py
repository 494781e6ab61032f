"""Surfaces that are opposite nothing at first: they meet where they turned, or moved, to.

Expected are the forces of the same bodies, built where they meet.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from pairwise import pairwise
from scenes import CLAMPED, GROUND, MASTER, SLAVE, at

import ufl
from dolfinx import fem

from fenics_tfeti import (
    Coulomb,
    Deformed,
    InputError,
    NonlinearContactProblem,
    Plane,
    UnresistedMotion,
)
from fenics_tfeti.models import neo_hookean

COMM = MPI.COMM_WORLD
CELLS = {2: "quadrilateral", 3: "hexahedron"}
# the block, before it has turned, is this far from where it meets the foundation
AWAY = np.array([3.0, 2.0, 0.0])

pytestmark = [pytest.mark.ranks(1, 2, 3), pytest.mark.once]


@dataclass
class Bodies:
    """A block that is held at its top, and a wider foundation below it."""

    scene: scenes.Scene
    is_away: bool  # whether the block is built away from the foundation

    @classmethod
    def of(cls, dim: int, is_away: bool, turns: bool = True, n: int = 2, degree: int = 1) -> Bodies:
        """Make them; the block away from the foundation is turned by a right angle, too."""
        across = (1.0,) * (dim - 1)
        boxes = [
            ((0.0,) * dim, (*across, 1.0), (n,) * dim),
            ((-0.5,) * (dim - 1) + (-1.0,), (1.5,) * (dim - 1) + (0.0,), (n + 3,) * dim),
        ]
        up = dim - 1
        marks = [(CLAMPED, at(up, 1.0), 1), (SLAVE, at(up, 0.0), 1)]
        marks += [(MASTER, at(up, 0.0), 2), (GROUND, at(up, -1.0), 2)]
        scene = scenes.Scene.of_boxes(COMM, CELLS[dim], boxes, marks, degree=degree, young=1.0)
        if is_away:
            x, own = scene.mesh.geometry.x, scene.nodes(1)
            x[own, :dim] = x[own, :dim] @ (turn(dim) if turns else np.eye(dim)) + AWAY[:dim]
        scene.fix(GROUND)
        return cls(scene, is_away)

    def place(self, turns: bool, down: float, slide: float) -> Any:
        """Return the displacement of the block as a whole, as a function of the place."""
        dim = self.scene.gdim
        shift = np.zeros((dim, 1))
        shift[-1], shift[0] = -down, slide

        def displacement(x: Any) -> Any:
            if not self.is_away:
                return np.tile(shift, x.shape[1])
            back = (turn(dim) if turns else np.eye(dim)) @ (x[:dim] - AWAY[:dim, None])
            return back + shift - x[:dim]

        return displacement

    def hold(self, turns: bool = True) -> fem.Function:
        """Hold the block at its top; return the function whose values are prescribed there."""
        held = fem.Function(self.scene.V)
        facets = self.scene.facet_tags.find(CLAMPED)
        dofs = fem.locate_dofs_topological(self.scene.V, self.scene.gdim - 1, facets)
        self.scene.bcs.append(fem.dirichletbc(held, dofs))
        return held


def turn(dim):
    """Return the matrix that turns by a right angle, from the first axis to the last."""
    R = np.eye(dim)
    R[[0, 0, -1, -1], [0, -1, 0, -1]] = 0.0, -1.0, 1.0, 0.0
    return R


def nonlinear(bodies, **contact):
    """Pose the problem of rubber bodies at their undeformed places."""
    scene, u = bodies.scene, fem.Function(bodies.scene.V)
    if contact:
        scene.add_pair(name="joint", **contact)
    W = neo_hookean(1.0, 0.3)(u) * ufl.dx
    return NonlinearContactProblem(
        ufl.derivative(W, u, scene.v),
        u,
        bcs=scene.bcs,
        contacts=scene.contacts,
        cell_tags=scene.cell_tags,
        options={"newton_rtol": 1e-8},
    )


def force_after_turning(dim, is_away, friction):
    """Turn the block as a whole, and press it on the foundation, with friction aslant."""
    bodies = Bodies.of(dim, is_away)
    held = bodies.hold()
    problem = nonlinear(bodies, roles="given", friction=friction)
    cells = bodies.scene.cell_tags.find(1)
    problem.u.interpolate(bodies.place(True, 0.0, 0.0), cells)
    problem.u.x.scatter_forward()
    problem.reset_slip()
    held.interpolate(bodies.place(True, 0.05, 0.03 if friction else 0.0), cells)
    held.x.scatter_forward()
    problem.solve()
    return problem.results["joint"].force


@pytest.mark.parametrize("friction", [None, Coulomb(0.3)])
@pytest.mark.parametrize("dim", [2, pytest.param(3, marks=pytest.mark.heavy)])
def test_surface_that_turns_until_it_meets_another(dim, friction):
    """Before, it looks sideways, and no facet is opposite another one."""
    force, expected = (force_after_turning(dim, away, friction) for away in (True, False))
    np.testing.assert_allclose(force, expected, atol=1e-7)
    assert force[-1] > 0.03
    assert (abs(force[0]) > 0.1 * force[-1]) == (friction is not None)


def forces_after_moving(dim, is_away, obstacle, degree):
    """Move the block over the foundation or a floor that ends, with exact non-penetration."""
    bodies = Bodies.of(dim, is_away, turns=False, degree=degree)
    held, scene = bodies.hold(turns=False), bodies.scene
    if obstacle:
        scene.add_obstacle(SLAVE, floor_that_ends(dim), name="joint")
    else:
        scene.add_pair(roles="given", name="joint")
    problem = scene.problem(gaps=Deformed(1e-8))
    held.interpolate(bodies.place(False, 0.01, 0.0), scene.cell_tags.find(1))
    held.x.scatter_forward()
    with warnings.catch_warnings():
        # the block is inside the foundation only as long as they have not met
        warnings.simplefilter("error")
        problem.solve()
    return problem.results["joint"].force


def floor_that_ends(dim):
    """Return a floor that ends beside the foundation."""
    floor = scenes.plane(dim - 1, dim)

    def gap_and_normal(x):
        gap, normal = floor(x)
        return np.where(x[0] < 1.6, gap, np.inf), normal

    return gap_and_normal


@pytest.mark.parametrize(("dim", "obstacle", "degree"), pairwise([2, 3], [False, True], [1, 2]))
def test_surface_that_moves_until_it_meets_another(dim, obstacle, degree):
    """With linear elasticity: before, the block is beside the foundation, and higher."""
    force, expected = (forces_after_moving(dim, away, obstacle, degree) for away in (True, False))
    np.testing.assert_allclose(force, expected, atol=1e-7)
    assert force[-1] > 0.005


@pytest.mark.parametrize("is_exact", [False, True])
def test_linear_problems_need_surfaces_that_are_opposite_each_other(is_exact):
    scene = Bodies.of(2, is_away=True, turns=False).scene
    scene.add_pair(roles="given", name="joint")
    if is_exact:
        scene.fix(CLAMPED)
        assert scene.problem(gaps=Deformed()).solve().x.array.max(initial=0.0) == 0.0
    else:
        with pytest.raises(InputError, match="^joint: no facet of the slave has a facet"):
            scene.problem()


def upset(obstacle, tags):
    """Return the force of a block under a rigid plane, or a body, that may touch some tags."""
    parts = [((0, 0), (1, 1), (3, 3)), ((0, 1), (2, 2), (5, 3))]
    marks = [(SLAVE, at(1, 1.0), 1), (scenes.SIDE_X, at(0, 1.0), 1), (GROUND, at(1, 0.0), 1)]
    marks += [(CLAMPED, at(0, 0.0), 1), (MASTER, at(1, 1.0), 2), (scenes.LOADED, at(1, 2.0), 2)]
    scene = scenes.Scene.of_boxes(COMM, "quadrilateral", parts, marks)
    scene.fix(GROUND, 1)
    scene.fix(CLAMPED, 0)
    scene.fix(scenes.LOADED, value=0.0 if obstacle else np.array([0.0, -0.1]))
    for tag in tags:
        if obstacle:
            plane = Plane((0.0, 0.9), (0.0, -1.0))
            scene.add_obstacle(tag, plane, name=f"tag {tag}")
        else:
            scene.add_pair(tag, roles="given", name=f"tag {tag}")
    problem = nonlinear(Bodies(scene, False))
    problem.solve()
    return np.sum([result.force for result in problem.results], axis=0)


@pytest.mark.parametrize("obstacle", [False, True])
def test_side_that_may_fold_onto_a_die(obstacle):
    """It looks past the die, and shares its upper edge with the top, which presses."""
    force, expected = (upset(obstacle, tags) for tags in ([SLAVE, scenes.SIDE_X], [SLAVE]))
    np.testing.assert_allclose(force, expected, rtol=1e-7, atol=1e-12)
    assert expected[1] < -0.05


@pytest.mark.parametrize("side", ["pair", "obstacle"])
def test_contact_that_has_not_met_is_to_be_checked(side):
    """The side of a block that is pressed from above looks past the foundation and the floor."""
    bodies = Bodies.of(2, is_away=True)
    scene, held = bodies.scene, bodies.hold()
    if side == "obstacle":
        scene.add_obstacle(SLAVE, scenes.plane(1, 2, -1.0), name="joint")
    else:
        scene.add_pair(roles="given", name="joint")
    problem = nonlinear(bodies)
    held.interpolate(lambda x: np.stack([0.1 * x[0], 0.0 * x[1]]), scene.cell_tags.find(1))
    problem.solve()
    text = "'joint' has not met anything: its surfaces are nowhere opposite each other"
    assert text in problem.report.to_check


def wrong_side(kind):
    """Return a block whose top is tagged in place of its lower face, above the foundation."""
    bodies = Bodies.of(2, is_away=False)
    scene = bodies.scene
    if kind == "obstacle":
        scene.add_obstacle(CLAMPED, scenes.plane(1, 2, -0.1), name="joint")
    else:
        scene.add_pair(CLAMPED, roles="given", name="joint")
    return bodies


MESSAGES = {
    "obstacle": "^joint: the obstacle's normal points away from the body at all 3 nodes",
    "pair": "^joint: slave and master have not met, and look the same way at all 3 slave nodes",
}


@pytest.mark.parametrize("is_held", [True, False])
@pytest.mark.parametrize("kind", MESSAGES)
def test_surfaces_that_look_the_same_way(kind, is_held):
    """An error once the solve has ended, also if that fails because nothing holds the block."""
    bodies = wrong_side(kind)
    if is_held:
        bodies.hold()
    bodies.scene.add_load(SLAVE, -1e-3)
    problem = nonlinear(bodies)
    with pytest.raises(InputError, match=MESSAGES[kind]) as caught:
        problem.solve()
    assert not isinstance(caught.value, UnresistedMotion)
    assert not problem.u.x.array.any()


def test_bodies_inside_each_other_are_told():
    """The side of a block is tagged in place of its lower face, and the block is pushed down."""
    parts = [((0, 0), (1, 1), (4, 4)), ((0, 1.1), (1, 2), (5, 4))]
    marks = [(GROUND, at(1, 0.0), 1), (MASTER, at(1, 1.0), 1)]
    marks += [(SLAVE, at(0, 1.0), 2), (CLAMPED, at(1, 2.0), 2)]
    scene = scenes.Scene.of_boxes(COMM, "quadrilateral", parts, marks, young=1.0)
    scene.fix(GROUND)
    scene.fix(CLAMPED, value=np.array([0.0, -0.2]))
    scene.add_pair(roles="given", name="joint")
    problem = nonlinear(Bodies(scene, False))
    for _ in range(2):
        with pytest.raises(InputError, match="^joint: slave and master have not met, and one of"):
            problem.solve()

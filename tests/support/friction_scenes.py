"""Contact problems with friction, as a user would write them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from scenes import Scene, at, dimension, elasticity, plane

import ufl

from fenics_tfeti import ContactProblem, Coulomb, Sphere, Tresca

CLAMPED, LOADED, SLAVE, MASTER, TOP, SIDE = 1, 3, 5, 6, 4, 7


@dataclass
class Rubbing:
    """A problem, and the traction [Pa] on its loaded surface or the displacement of its top [m]."""

    problem: ContactProblem
    traction: Any
    scene: Scene


def pushed_cube(
    cell: str,
    n: int = 4,
    lower: int | None = None,
    friction: Any = None,
    push: tuple[float, float] = (0.03, 0.009),
    press: float = 0.1,
    comm: MPI.Intracomm = MPI.COMM_SELF,
    degree: int = 1,
    young: float = 1.0,
    symmetry: bool = False,
    **arguments: Any,
) -> Rubbing:
    """Return a unit cube (square) on a rigid plane, or on a cube of `lower` elements an edge.

    Its top is pressed and pushed sideways. With `symmetry` the plane y = 0 is one.
    """
    d = dimension(cell)
    low, high, e = np.zeros(d), np.ones(d), np.eye(d)[-1]
    parts = [(low, high, (n,) * d)]
    marks: list[Any] = [(SLAVE, at(d - 1, 0.0), 1), (LOADED, at(d - 1, 1.0), 1)]
    if lower:
        parts += [(low - e, high - e, (lower,) * d)]
        marks += [(MASTER, at(d - 1, 0.0), 2), (CLAMPED, at(d - 1, -1.0), 2)]
    if symmetry:
        marks += [(SIDE, at(1, 0.0))]
    scene = Scene.of_boxes(comm, cell, parts, marks, degree=degree, young=young)
    traction = scene.add_load(LOADED, np.array([*push[: d - 1], -press]))
    friction = Tresca(0.05) if friction is None else friction
    if lower:
        scene.fix(CLAMPED)
        scene.add_pair(SLAVE, MASTER, friction=friction)
    else:
        scene.add_obstacle(SLAVE, plane(d - 1, d), friction=friction)
    if symmetry:
        scene.fix(SIDE, 1)
    return Rubbing(scene.problem(**{"options": {"rtol": 1e-8}, **arguments}), traction, scene)


THICKNESS, SHEAR_STRENGTH = 0.02, 1e-4


def pulled_strip(n: int = 50, comm: MPI.Intracomm = MPI.COMM_SELF) -> Rubbing:
    """Return a plane strip of length 1 on a rigid line, pulled at x = 1; E = 1, nu = 0.

    Its top moves along it only, so that it does not bend.
    """
    marks = [(SLAVE, at(1, 0.0)), (LOADED, at(0, 1.0)), (TOP, at(1, THICKNESS))]
    parts = [((0, 0), (1, THICKNESS), (n, 2))]
    scene = Scene.of_boxes(comm, "quadrilateral", parts, marks)
    scene.a = elasticity(scene.u, scene.v, 1.0, poisson=0.0)
    traction = scene.add_load(LOADED, np.zeros(2))
    scene.fix(TOP, 1)
    scene.add_obstacle(SLAVE, plane(1, 2), friction=Tresca(SHEAR_STRENGTH), name="ground")
    return Rubbing(scene.problem(options={"rtol": 1e-6, "subdomain_size": 60}), traction, scene)


def pulled_plate(friction: Any, n: int = 4) -> ContactProblem:
    """Return a plate of 8 x 1 x 1/4 pressed on a rigid plane, pulled at x = 8."""
    marks = [(SIDE, at(0, 8.0)), (SLAVE, at(2, 0.0)), (LOADED, at(2, 0.25))]
    parts = [((0, 0, 0), (8, 1, 0.25), (8 * n, n, max(n // 4, 1)))]
    scene = Scene.of_boxes(MPI.COMM_SELF, "hexahedron", parts, marks, young=1.0)
    scene.add_load(LOADED, np.array([0.0, 0.0, -1e-3]))
    scene.fix(SIDE, None, np.array([0.02, 0.003, 0.0]))
    scene.add_obstacle(SLAVE, plane(2, 3), friction=friction)
    return scene.problem(options={"subdomain_size": 375})


RADIUS, BALL_RADIUS, HALF_WIDTH = 40.0, 40.0, 8.0


def half_planes(n: int = 44, friction: Any = None, comm: MPI.Intracomm = MPI.COMM_SELF) -> Rubbing:
    """Return two equal blocks with the gap of a cylinder between them, the upper one to be moved.

    The elements grow away from the contact; E = 1, and `traction` is the displacement of the top.
    """

    def graded(x: Any) -> Any:
        return HALF_WIDTH * np.sinh(3.0 * x) / np.sinh(3.0)

    layers = n // 2
    parts = [((-1, 0), (1, 1), (n, layers)), ((-1, -1), (1, 0), (n, layers))]
    return _pressed_blocks(comm, parts, graded, friction, RADIUS, subdomain_size=400)


def half_spaces(n: int = 12, friction: Any = None, comm: MPI.Intracomm = MPI.COMM_SELF) -> Rubbing:
    """Return two equal blocks with the gap of a ball between them, the upper one to be moved.

    The half y > 0 of them: y = 0 is a plane of symmetry. Otherwise as `half_planes`.
    """

    def graded(x: Any) -> Any:
        # equal elements where they may touch
        core = 1.6 * x / 0.6
        beyond = np.maximum(np.abs(x) - 0.6, 0.0) / 0.4
        return core + np.sign(x) * (HALF_WIDTH - 1.6 / 0.6) * beyond**3

    parts = [((-1, 0, z), (1, 1, z + 1), (2 * n, n, n)) for z in (0, -1)]
    return _pressed_blocks(comm, parts, graded, friction, BALL_RADIUS, subdomain_size=1500)


def _pressed_blocks(
    comm: MPI.Intracomm,
    parts: list[Any],
    graded: Any,
    friction: Any,
    radius: float,
    subdomain_size: int,
) -> Rubbing:
    """Return graded blocks below and above the plane of the last coordinate, with a round gap."""

    def distance(x: Any) -> Any:
        return np.linalg.norm(x[:up], axis=0)

    up = len(parts[0][2]) - 1
    near = at(up, 0.0)
    marks: list[Any] = [
        (SLAVE, lambda x: near(x) & (distance(graded(x)) < 3.0), 1),
        (MASTER, lambda x: near(x) & (distance(graded(x)) < 3.0), 2),
        (TOP, at(up, 1.0), 1),
        (CLAMPED, at(up, -1.0), 2),
    ]
    marks += [(SIDE, at(1, 0.0))] if up == 2 else []
    cell = "quadrilateral" if up == 1 else "hexahedron"
    scene = Scene.of_boxes(comm, cell, parts, marks, graded, young=1.0)
    moved = scene.constant(np.zeros(up + 1))
    scene.fix(CLAMPED)
    scene.fix(TOP, None, moved)
    if up == 2:
        scene.fix(SIDE, 1)
    gap = {"initial_gap": lambda x: distance(x) ** 2 / (2.0 * radius)}
    scene.add_pair(SLAVE, MASTER, friction=friction, **gap)
    options = {"rtol": 1e-5, "subdomain_size": subdomain_size}
    return Rubbing(scene.problem(options=options), moved, scene)


def belt(
    n: int = 60, mu: float | None = 0.3, angle: float = np.pi, thickness: float = 0.01
) -> Rubbing:
    """Return a belt on a drum of radius 1, held at one end and pulled at the other; E = 1, nu = 0.

    The force is 1e-4 at the end that is pulled. There is no friction with `mu` None.
    """

    def round_drum(x: Any) -> Any:
        return (1.0 + x[1]) * np.stack([np.cos(x[0]), np.sin(x[0])])

    marks = [(SLAVE, at(1, 0.0)), (CLAMPED, at(0, 0.0)), (LOADED, at(0, angle))]
    parts = [((0, 0), (angle, thickness), (n, 1))]
    scene = Scene.of_boxes(MPI.COMM_SELF, "quadrilateral", parts, marks, round_drum)
    scene.a = elasticity(scene.u, scene.v, 1.0, poisson=0.0)
    pull = 1e-4 / thickness * np.array([-np.sin(angle), np.cos(angle)])
    traction = scene.add_load(LOADED, pull)
    scene.fix(CLAMPED)
    law = None if mu is None else Coulomb(mu)
    scene.add_obstacle(SLAVE, Sphere((0.0, 0.0), 1.0), friction=law)
    return Rubbing(scene.problem(options={"rtol": 1e-5, "subdomain_size": 60}), traction, scene)


def sheared_square(
    friction: Any,
    move: tuple[float, float],
    n: int = 3,
    fibre: float | None = None,
    **arguments: Any,
) -> ContactProblem:
    """Return a square on a rigid line whose top is moved; with stiff fibres at an angle."""
    marks = [(SLAVE, at(1, 0.0)), (TOP, at(1, 1.0))]
    parts = [((0, 0), (1, 1), (n, n))]
    scene = Scene.of_boxes(MPI.COMM_SELF, "quadrilateral", parts, marks, young=1.0)
    if fibre is not None:
        d = ufl.as_vector([np.cos(fibre), np.sin(fibre)])
        along = (ufl.inner(d, ufl.dot(ufl.sym(ufl.grad(w)), d)) for w in (scene.u, scene.v))
        scene.a += 100.0 * next(along) * next(along) * ufl.dx
    scene.fix(TOP, None, np.array(move))
    scene.add_obstacle(SLAVE, plane(1, 2), friction=friction)
    return scene.problem(**arguments)

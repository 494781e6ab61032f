"""Contact problems with friction, as a user would write them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from scenes import at, dimension, elasticity, fixed, vector_space

import ufl
from dolfinx import fem
from dolfinx.fem import Constant

from fenics_tfeti import (
    ContactPair,
    ContactProblem,
    Coulomb,
    Plane,
    RigidObstacle,
    Sphere,
    Tresca,
)
from fenics_tfeti.io import Box, boxes, tag_facets

CLAMPED, LOADED, SLAVE, MASTER, TOP, SIDE = 1, 3, 5, 6, 4, 7


@dataclass
class Rubbing:
    """A problem, and the traction [Pa] on its loaded surface."""

    problem: ContactProblem
    traction: Any
    tags: Any


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
    parts = [Box((0.0,) * d, (1.0,) * d, (n,) * d, "upper")]
    marks = [(SLAVE, at(d - 1, 0.0), 1), (LOADED, at(d - 1, 1.0), 1)]
    if lower:
        parts += [Box((*(0.0,) * (d - 1), -1.0), (*(1.0,) * (d - 1), 0.0), (lower,) * d, "lower")]
        marks += [(MASTER, at(d - 1, 0.0), 2), (CLAMPED, at(d - 1, -1.0), 2)]
    if symmetry:
        marks += [(SIDE, at(1, 0.0))]
    tagged = boxes(comm, parts, cell)
    tags = tag_facets(tagged.mesh, marks, tagged.cell_tags)
    V = vector_space(tagged.mesh, degree)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    traction = Constant(tagged.mesh, np.array([*push[: d - 1], -press]))
    ds = ufl.Measure("ds", domain=tagged.mesh, subdomain_data=tags)
    friction = Tresca(0.05) if friction is None else friction
    if lower:
        contact: Any = ContactPair(tags, SLAVE, MASTER, friction=friction)
    else:
        ground = Plane((0.0,) * d, (*(0.0,) * (d - 1), 1.0))
        contact = RigidObstacle(tags, SLAVE, ground, friction=friction)
    supports = [fixed(V, tags, CLAMPED, None)] if lower else []
    supports += [fixed(V, tags, SIDE, 1)] if symmetry else []
    problem = ContactProblem(
        elasticity(u, v, young),
        ufl.inner(traction, v) * ds(LOADED),
        bcs=supports,
        contacts=[contact],
        cell_tags=tagged.cell_tags,
        **{"options": {"rtol": 1e-8}, **arguments},
    )
    return Rubbing(problem, traction, tags)


THICKNESS, SHEAR_STRENGTH = 0.02, 1e-4


def pulled_strip(n: int = 50, comm: MPI.Intracomm = MPI.COMM_SELF) -> Rubbing:
    """Return a plane strip of length 1 on a rigid line, pulled at x = 1; E = 1, nu = 0.

    Its top moves along it only, so that it does not bend.
    """
    strip = boxes(comm, [Box((0, 0), (1, THICKNESS), (n, 2))], "quadrilateral")
    marks = [(SLAVE, at(1, 0.0)), (LOADED, at(0, 1.0)), (TOP, at(1, THICKNESS))]
    tags = tag_facets(strip.mesh, marks)
    V = vector_space(strip.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    traction = Constant(strip.mesh, np.zeros(2))
    ds = ufl.Measure("ds", domain=strip.mesh, subdomain_data=tags)
    ground = RigidObstacle(
        tags, SLAVE, Plane((0, 0), (0, 1)), friction=Tresca(SHEAR_STRENGTH), name="ground"
    )
    strain = ufl.sym(ufl.grad(u))
    problem = ContactProblem(
        ufl.inner(strain, ufl.grad(v)) * ufl.dx,
        ufl.inner(traction, v) * ds(LOADED),
        bcs=[fixed(V, tags, TOP, 1)],
        contacts=[ground],
        options={"rtol": 1e-6, "subdomain_size": 60},
    )
    return Rubbing(problem, traction, tags)


def pulled_plate(friction: Any, n: int = 4) -> ContactProblem:
    """Return a plate of 8 x 1 x 1/4 pressed on a rigid plane, pulled at x = 8."""
    tagged = boxes(MPI.COMM_SELF, [Box((0, 0, 0), (8, 1, 0.25), (8 * n, n, max(n // 4, 1)))])
    mesh = tagged.mesh
    tags = tag_facets(mesh, [(SIDE, at(0, 8.0)), (SLAVE, at(2, 0.0)), (TOP, at(2, 0.25))])
    V = vector_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    pressure = Constant(mesh, np.array([0.0, 0.0, -1e-3]))
    end = fem.locate_dofs_topological(V, 2, tags.find(SIDE))
    moved = Constant(mesh, np.array([0.02, 0.003, 0.0]))
    ground = RigidObstacle(tags, SLAVE, Plane((0, 0, 0), (0, 0, 1)), friction=friction)
    return ContactProblem(
        elasticity(u, v, 1.0),
        ufl.inner(pressure, v) * ds(TOP),
        bcs=[fem.dirichletbc(moved, end, V)],
        contacts=[ground],
        options={"subdomain_size": 375},
    )


def mapped_boxes(comm: MPI.Intracomm, parts: list[Box], shape: Any) -> Any:
    """Return boxes of quadrilaterals or hexahedra with nodes moved by x (d, n) -> (d, n)."""
    d = len(parts[0].divisions)
    tagged = boxes(comm, parts, "quadrilateral" if d == 2 else "hexahedron")
    x = tagged.mesh.geometry.x
    x[:, :d] = shape(x[:, :d].T).T
    return tagged


RADIUS, BALL_RADIUS, HALF_WIDTH = 40.0, 40.0, 8.0


def half_planes(n: int = 44, friction: Any = None, comm: MPI.Intracomm = MPI.COMM_SELF) -> Rubbing:
    """Return two equal blocks with the gap of a cylinder between them, the upper one to be moved.

    The elements grow away from the contact; E = 1, and `traction` is the displacement of the top.
    """

    def graded(x: Any) -> Any:
        return HALF_WIDTH * np.sinh(3.0 * x) / np.sinh(3.0)

    layers = n // 2
    parts = [Box((-1, 0), (1, 1), (n, layers)), Box((-1, -1), (1, 0), (n, layers))]
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

    parts = [
        Box((-1, 0, 0), (1, 1, 1), (2 * n, n, n)),
        Box((-1, 0, -1), (1, 1, 0), (2 * n, n, n)),
    ]
    return _pressed_blocks(comm, parts, graded, friction, BALL_RADIUS, subdomain_size=1500)


def _pressed_blocks(
    comm: MPI.Intracomm,
    parts: list[Box],
    graded: Any,
    friction: Any,
    radius: float,
    subdomain_size: int,
) -> Rubbing:
    """Return graded blocks below and above the plane of the last coordinate, with a round gap."""

    def distance(x: Any) -> Any:
        return np.linalg.norm(x[:up], axis=0)

    tagged, up = mapped_boxes(comm, parts, graded), len(parts[0].divisions) - 1
    marks = [
        (SLAVE, lambda x: np.isclose(x[up], 0.0) & (distance(x) < 3.0), 1),
        (MASTER, lambda x: np.isclose(x[up], 0.0) & (distance(x) < 3.0), 2),
        (TOP, at(up, HALF_WIDTH), 1),
        (CLAMPED, at(up, -HALF_WIDTH), 2),
    ]
    marks += [(SIDE, at(1, 0.0))] if up == 2 else []
    tags = tag_facets(tagged.mesh, marks, tagged.cell_tags)
    V = vector_space(tagged.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    moved = Constant(tagged.mesh, np.zeros(up + 1))
    top = fem.locate_dofs_topological(V, up, tags.find(TOP))
    pair = ContactPair(
        tags,
        SLAVE,
        MASTER,
        initial_gap=lambda x: distance(x) ** 2 / (2.0 * radius),
        friction=friction,
    )
    supports = [fixed(V, tags, CLAMPED, None), fem.dirichletbc(moved, top, V)]
    supports += [fixed(V, tags, SIDE, 1)] if up == 2 else []
    problem = ContactProblem(
        elasticity(u, v, 1.0),
        0,
        bcs=supports,
        contacts=[pair],
        cell_tags=tagged.cell_tags,
        options={"rtol": 1e-5, "subdomain_size": subdomain_size},
    )
    return Rubbing(problem, moved, tags)


def belt(
    n: int = 60, mu: float | None = 0.3, angle: float = np.pi, thickness: float = 0.01
) -> Rubbing:
    """Return a belt on a drum of radius 1, held at one end and pulled at the other; E = 1, nu = 0.

    The force is 1e-4 at the end that is pulled. There is no friction with `mu` None.
    """

    def round_drum(x: Any) -> Any:
        return (1.0 + x[1]) * np.stack([np.cos(x[0]), np.sin(x[0])])

    tagged = mapped_boxes(MPI.COMM_SELF, [Box((0, 0), (angle, thickness), (n, 1))], round_drum)

    def at_angle(phi: float) -> Any:
        return lambda x: np.isclose(np.arctan2(x[1], x[0]), phi)

    marks = [
        (SLAVE, lambda x: np.isclose(np.hypot(x[0], x[1]), 1.0)),
        (CLAMPED, at_angle(0.0)),
        (LOADED, at_angle(angle)),
    ]
    tags = tag_facets(tagged.mesh, marks)
    V = vector_space(tagged.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    pull = 1e-4 / thickness * np.array([-np.sin(angle), np.cos(angle)])
    traction = Constant(tagged.mesh, pull)
    ds = ufl.Measure("ds", domain=tagged.mesh, subdomain_data=tags)
    law = None if mu is None else Coulomb(mu)
    drum = RigidObstacle(tags, SLAVE, Sphere((0.0, 0.0), 1.0), friction=law)
    problem = ContactProblem(
        ufl.inner(ufl.sym(ufl.grad(u)), ufl.grad(v)) * ufl.dx,
        ufl.inner(traction, v) * ds(LOADED),
        bcs=[fixed(V, tags, CLAMPED, None)],
        contacts=[drum],
        options={"rtol": 1e-5, "subdomain_size": 60},
    )
    return Rubbing(problem, traction, tags)


def sheared_square(
    friction: Any,
    move: tuple[float, float],
    n: int = 3,
    fibre: float | None = None,
    **arguments: Any,
) -> ContactProblem:
    """Return a square on a rigid line whose top is moved; with stiff fibres at an angle."""
    square = boxes(MPI.COMM_SELF, [Box((0, 0), (1, 1), (n, n))], "quadrilateral")
    tags = tag_facets(square.mesh, [(SLAVE, at(1, 0.0)), (TOP, at(1, 1.0))])
    V = vector_space(square.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = elasticity(u, v, 1.0)
    if fibre is not None:
        d = ufl.as_vector([np.cos(fibre), np.sin(fibre)])
        along, other = (ufl.inner(d, ufl.dot(ufl.sym(ufl.grad(w)), d)) for w in (u, v))
        a += 100.0 * along * other * ufl.dx
    moved = Constant(square.mesh, np.array(move))
    top = fem.locate_dofs_topological(V, 1, tags.find(TOP))
    line = RigidObstacle(tags, SLAVE, Plane((0, 0), (0, 1)), friction=friction)
    return ContactProblem(a, 0, bcs=[fem.dirichletbc(moved, top, V)], contacts=[line], **arguments)

"""Bodies that slide far on each other in steps, on meshes that do not match, and their energies.

Without friction the work of loads and prescribed motions is the energy stored. Bodies that turn
are turned with their mesh, by rigid motions between the steps: displacements stay small beside the
rotation, which linear elasticity does not know. The moment that turns a body balances the forces on
it where they act in the deformed state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from mesh_arrays import concatenated, grid, mesh_of, tags_of
from numpy.typing import NDArray
from scenes import CLAMPED, GROUND, LOADED, MASTER, SIDE_X, SLAVE, Scene

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Exact
from fenics_tfeti.fem import _compat
from fenics_tfeti.io import tag_facets

Vector = NDArray[np.float64]

YOUNG = 1e7
GEOMETRY = Exact(tolerance=1e-4, max_passes=40)


@dataclass(frozen=True)
class Way:
    """What is recorded in the steps, one row each."""

    place: Vector  # of the driven body: a distance [m] or an angle [rad]
    drive: Vector  # what drives it: force [N/m] or moment [N m/m]
    dead: Vector  # work of the dead loads against the undeformed state [J/m]
    energy: Vector  # stored in the bodies and springs [J/m]
    passes: NDArray[np.int64]
    products: NDArray[np.int64]  # with F

    @property
    def work(self) -> Vector:
        """Work of the drive from the start, by the trapezoidal rule [J/m]."""
        parts = 0.5 * (self.drive[1:] + self.drive[:-1]) * np.diff(self.place)
        return np.concatenate([[0.0], np.cumsum(parts)])

    @property
    def miss(self) -> float:
        """Largest error of the balance on the way, relative to the largest work."""
        stored = self.energy - self.energy[0] - (self.dead - self.dead[0])
        return float(np.abs(stored - self.work).max() / np.abs(self.work).max())


class Bodies(Scene):
    """Two bodies on one mesh and what holds and loads them."""

    def sliding(self, slave: int, geometry: Exact = GEOMETRY) -> ContactProblem:
        self.add_pair(slave, SLAVE + MASTER - slave, partners="mortar")
        return self.problem(geometry=geometry, options={"rtol": 1e-8})

    def dofs(self, tag: int) -> NDArray[np.int64]:
        """Return the nodes of tagged facets."""
        return fem.locate_dofs_topological(self.V, 1, self.facet_tags.find(tag))

    def measures(self) -> tuple[Vector, Vector, Callable[[Any], tuple[Vector, float]]]:
        """Return loads on all nodes, and a function: displacement -> K u and energy."""
        of = fem.Function(self.V)
        action = fem.form(ufl.action(self.a, of))
        energy = fem.form(ufl.replace(0.5 * self.a, dict.fromkeys(self.a.arguments(), of)))
        load = np.zeros_like(of.x.array)
        if not isinstance(self.L, int):
            load[:] = fem.assemble_vector(fem.form(self.L)).array

        def measure(uh: Any) -> tuple[Vector, float]:
            of.x.array[:] = uh.x.array
            force = fem.assemble_vector(action).array.reshape(-1, 2)
            return force, float(fem.assemble_scalar(energy))

        return load, measure


def patch(divisions: tuple[int, int], place: Callable[[Vector, Vector], Any]) -> tuple[Any, Any]:
    """Return points and cells of a unit square that a function (s, t) -> (x, y) deforms."""
    points, cells = grid(divisions)
    return np.stack(place(*(points / np.array(divisions)).T), axis=1), cells


def ring(divisions: tuple[int, int], inner: float, outer: float) -> tuple[Any, Any]:
    """Return points and cells of a ring about the origin, divided around and through."""
    n = divisions[0]

    def polar(s: Vector, t: Vector) -> tuple[Vector, Vector]:
        angle, radius = 2.0 * np.pi * s, inner + (outer - inner) * t
        return radius * np.cos(angle), radius * np.sin(angle)

    points, cells = patch(divisions, polar)
    column = np.arange(len(points)) % (n + 1)
    # the last column is the first one
    number = np.arange(len(points)) // (n + 1) * n + column % n
    return points[column < n], number[cells]


def bodies_of(parts: list[Any], markers: list[Any]) -> Bodies:
    """Make a mesh of two bodies of quadrilaterals."""
    domain = mesh_of(MPI.COMM_SELF, "quadrilateral", *concatenated(*parts))
    cell_tags = tags_of(domain, np.repeat([1, 2], [len(cells) for _, cells in parts]))
    return Bodies(domain, tag_facets(domain, markers, cell_tags), cell_tags, young=YOUNG)


def on(height: Any) -> Callable[[Vector], Any]:
    """Return the marker of facets on a curve y = height(x), or at a height."""
    return lambda x: np.isclose(x[1], height(x[0]) if callable(height) else height)


def around(centre: tuple[float, float], radius: float) -> Callable[[Vector], Any]:
    """Return the marker of facets on a circle."""
    return lambda x: np.isclose(np.hypot(x[0] - centre[0], x[1] - centre[1]), radius)


def bump(height: float, half_width: float, middle: float = 0.0) -> Callable[[Vector], Vector]:
    """Return the profile of a track with one bump."""

    def profile(x: Vector) -> Vector:
        away = np.minimum(np.abs(x - middle) / half_width, 1.0)
        return 0.5 * height * (1.0 + np.cos(np.pi * away))

    return profile


def track(
    divisions: tuple[int, int], low: float, high: float, profile: Callable[[Vector], Vector]
) -> tuple[Any, Any]:
    """Return a body of depth 0.5 m below a profile."""

    def place(s: Vector, t: Vector) -> tuple[Vector, Vector]:
        x = low + (high - low) * s
        return x, -0.5 + t * (profile(x) + 0.5)

    return patch(divisions, place)


# -- a block pushed over a bump --------------------------------------------------------------------


def pushed_block(
    steps: int,
    base: int = 120,
    foot: int = 23,
    slave: int = SLAVE,
    geometry: Exact = GEOMETRY,
) -> Way:
    """Push a block with a round foot, SLAVE, over a bump by its upper part, under a dead load.

    There are `base` facets on 4 m of the base, `foot` on 0.6 m, and equal steps over 2.4 m.
    """
    start, width, top = -1.2, 0.6, 0.6
    profile = bump(0.08, 0.6)

    def sole(x: Vector) -> Vector:
        return 0.5 - np.sqrt(np.maximum(0.25 - (x - start) ** 2, 0.0))

    def upright(s: Vector, t: Vector) -> tuple[Vector, Vector]:
        x = start + width * (s - 0.5)
        return x, sole(x) + t * (top - sole(x))

    def guide(x: Vector) -> Any:
        return np.isclose(np.abs(x[0] - start), 0.5 * width) & (x[1] > 0.3)

    bodies = bodies_of(
        [track((base, base // 8), -2.0, 2.0, profile), patch((foot, foot), upright)],
        [
            (GROUND, on(-0.5), 1),
            (MASTER, on(profile), 1),
            (SLAVE, on(sole), 2),
            (LOADED, on(top), 2),
            (CLAMPED, guide, 2),
        ],
    )
    shift = bodies.constant(0.0)
    bodies.add_load(LOADED, np.array([0.0, -5e4]))
    bodies.fix(GROUND)
    for tag in (LOADED, CLAMPED):
        bodies.fix(tag, 0, shift)
    problem = bodies.sliding(slave, geometry)
    loads, measure = bodies.measures()
    driven = np.union1d(bodies.dofs(LOADED), bodies.dofs(CLAMPED))
    rows = []
    for place in np.linspace(0.0, -2.0 * start, steps + 1):
        shift.value = place
        uh = problem.solve()
        force, energy = measure(uh)
        rows.append((place, force[driven, 0].sum(), loads @ uh.x.array, energy, *effort(problem)))
    return Way(*map(np.array, zip(*rows, strict=True)))


def effort(problem: ContactProblem) -> tuple[int, int]:
    """Return the passes and products of the last solution."""
    passes = problem.report.passes
    return len(passes), sum(one.products for one in passes)


# -- bodies that turn ------------------------------------------------------------------------------

RADIUS, HUB = 0.5, 0.2


def turned_with_mesh(
    bodies: Bodies,
    centre: Vector,
    poses: list[tuple[float, Vector, Vector]],
    slave: int,
) -> Way:
    """Turn body 1, a ring with the hub CLAMPED, and record the drive's power per angle.

    `centre` is that of the ring in the mesh. The poses are the angle of each step, anticlockwise
    [rad], where the centre is and its derivative by the angle.
    """
    x, own = bodies.mesh.geometry.x, bodies.nodes(1)
    reference = x[own, :2] - centre
    problem: ContactProblem | None = None
    hub = bodies.dofs(CLAMPED)
    of_ring = np.unique(_compat.cell_dofs(bodies.V)[bodies.cell_tags.find(1)])
    outside = np.setdiff1d(of_ring, hub)
    loads, measure = bodies.measures()
    rows = []
    for angle, middle, velocity in poses:
        c, s = np.cos(angle), np.sin(angle)
        x[own, :2] = middle + reference @ np.array([[c, s], [-s, c]])
        if problem is None:
            problem = bodies.sliding(slave)
        uh = problem.solve()
        force, energy = measure(uh)
        arm = bodies.V.tabulate_dof_coordinates()[:, :2] + uh.x.array.reshape(-1, 2) - middle
        # the hub carries what acts elsewhere on the ring
        arm, force = arm[outside], force[outside]
        moment = -np.sum(arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0])
        power = moment - force.sum(axis=0) @ velocity
        rows.append((angle, power, loads @ uh.x.array, energy, *effort(problem)))
    return Way(*map(np.array, zip(*rows, strict=True)))


def cam(
    steps: int,
    around_cam: int = 128,
    foot: int = 24,
    eccentricity: float = 0.15,
    slave: int = SLAVE,
) -> Way:
    """Turn an eccentric disc by half a turn under a guided follower that a spring presses on it.

    There are `around_cam` facets on the circumference of the cam, SLAVE, and `foot` on 1 m of the
    flat follower, which rises by twice the eccentricity [m].
    """
    # the follower's spring is shortened by 0.1 m at first
    low = RADIUS - eccentricity - 0.1

    def follower(s: Vector, t: Vector) -> tuple[Vector, Vector]:
        return s - 0.5, low + 0.6 * t

    def sides(x: Vector) -> Any:
        return np.isclose(np.abs(x[0]), 0.5) & (x[1] > low + 0.2)

    # far below: facets are tagged by place
    centre = np.array([0.0, -5.0])
    points, cells = ring((around_cam, 8), HUB, RADIUS)
    bodies = bodies_of(
        [(points + centre, cells), patch((foot, max(2, foot // 2)), follower)],
        [
            (CLAMPED, around((0.0, -5.0), HUB), 1),
            (SLAVE, around((0.0, -5.0), RADIUS), 1),
            (MASTER, on(low), 2),
            (LOADED, on(low + 0.6), 2),
            (SIDE_X, sides, 2),
        ],
    )
    bodies.a += 1e5 * bodies.u[1] * bodies.v[1] * bodies.ds(LOADED)
    bodies.fix(CLAMPED)
    bodies.fix(SIDE_X, 0)
    poses = []
    for angle in np.linspace(0.0, np.pi, steps + 1):
        away = eccentricity * np.array([np.sin(angle), -np.cos(angle)])
        poses.append((angle, away, np.array([-away[1], away[0]])))
    return turned_with_mesh(bodies, centre, poses, slave)


def rolling(steps: int, around_wheel: int = 160, base: int = 120, slave: int = SLAVE) -> Way:
    """Roll a wheel, SLAVE, whose axle is guided at one height, by half a turn over a bump.

    There are `around_wheel` facets on its circumference, and `base` on 2.4 m of the base.
    """
    # no symmetry: the wheel ends nearer to the bump than it starts
    profile = bump(0.03, 0.6, middle=0.25)
    centre = np.array([0.0, 5.0])
    points, cells = ring((around_wheel, 8), HUB, RADIUS)
    bodies = bodies_of(
        [(points + centre, cells), track((base, base // 6), -1.2, 1.2, profile)],
        [
            (CLAMPED, around((0.0, 5.0), HUB), 1),
            (SLAVE, around((0.0, 5.0), RADIUS), 1),
            (MASTER, on(profile), 2),
            (GROUND, on(-0.5), 2),
        ],
    )
    bodies.fix(CLAMPED)
    bodies.fix(GROUND)
    # to the right: clockwise
    poses = [
        (-turn, np.array([RADIUS * (turn - 0.5 * np.pi), RADIUS - 0.01]), np.array([-RADIUS, 0.0]))
        for turn in np.linspace(0.0, np.pi, steps + 1)
    ]
    return turned_with_mesh(bodies, centre, poses, slave)

"""Bodies with finite strains in contact, whose forces and energies are known from other programs.

The references of the indented block are those of a Newton method with plain dolfinx and SciPy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import scenes
from scenes import at
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import ufl
from dolfinx import fem

from fenics_tfeti import NonlinearContactProblem, Plane, Sphere, TiedPair
from fenics_tfeti.models import neo_hookean

BASE, TOP, SLIDER, ENDS = 1, 2, 3, 4


@dataclass(frozen=True)
class Scene:
    """A problem with what a test changes and measures."""

    problem: NonlinearContactProblem
    strain_energy: Any  # form
    set_load: Callable[[float], None]  # a part of the load, 0 to 1

    @classmethod
    def of(
        cls,
        bodies: scenes.Scene,
        u: Any,
        energy: Any,
        set_load: Callable[[float], None],
        work: Any = 0,
        measure_weight: Any = None,
        **options: Any,
    ) -> Scene:
        """Pose the equilibrium of an energy and the work of dead loads."""
        problem = NonlinearContactProblem(
            ufl.derivative(energy - work, u, bodies.v),
            u,
            bcs=bodies.bcs,
            contacts=bodies.contacts,
            measure_weight=measure_weight,
            options=options,
        )
        return cls(problem, energy, set_load)

    @property
    def energy(self) -> float:
        """The energy stored in the bodies [J]."""
        comm = self.problem.space.mesh.comm
        return float(comm.allreduce(fem.assemble_scalar(fem.form(self.strain_energy))))

    def solve(self, loads: list[float]) -> None:
        """Solve and accept load steps."""
        for load in loads:
            self.set_load(load)
            self.problem.solve()
            self.problem.advance()

    def counts(self) -> tuple[int, float]:
        """Return the Newton steps of the last solve, and their mean products with F."""
        steps = self.problem.report.newton
        return len(steps), float(np.mean([step.products for step in steps]))


def solid(dim: int) -> str:
    return {2: "quadrilateral", 3: "hexahedron"}[dim]


def indented_block(
    dim: int = 2,
    n: int = 8,
    nu: float = 0.3,
    depth: float = 0.3,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    degree: int = 1,
    obstacle: Any = None,
    cell: str | None = None,
    turned: float = 0.0,
    energy: Callable[[Any], Any] | None = None,
    **options: Any,
) -> Scene:
    """Make a block of height 1 and width 2, clamped at its base, under a rigid ball of radius 0.5.

    In two dimensions the ball is a cylinder. Another obstacle may take its place, and another
    energy that of the neo-Hookean material. Everything is turned by the angle `turned`.
    """
    block = (-1.0,) * (dim - 1) + (0.0,), (1.0,) * dim, (2 * n,) * (dim - 1) + (n,)
    marks = [(BASE, at(dim - 1, 0.0)), (TOP, at(dim - 1, 1.0))]
    bodies = scenes.Scene.of_boxes(comm, cell or solid(dim), [block], marks, degree=degree)
    up = turn(bodies.mesh, turned)[:, -1]
    u, load = fem.Function(bodies.V), {"depth": 0.0}

    def ball(x: Any) -> Any:
        return Sphere((1.5 - load["depth"]) * up, 0.5)(x)

    bodies.fix(BASE)
    bodies.add_obstacle(TOP, obstacle or ball)
    W = energy(u) if energy else neo_hookean(1.0, nu)(u) * ufl.dx
    return Scene.of(bodies, u, W, lambda part: load.update(depth=part * depth), **options)


def beam(comm: MPI.Intracomm = MPI.COMM_WORLD, **options: Any) -> Scene:
    """Make a beam, clamped at one end, that a dead load at the other bends over a cylinder."""
    length, height = 10.0, 0.5
    marks = [(BASE, at(0, 0.0)), (ENDS, at(0, length)), (TOP, at(1, 0.0))]
    block = (0, 0), (length, height), (60, 3)
    bodies = scenes.Scene.of_boxes(comm, "quadrilateral", [block], marks)
    u, traction = fem.Function(bodies.V), bodies.constant(np.zeros(2))

    def set_load(part: float) -> None:
        traction.value[1] = -part * 1.5e-3 / height

    bodies.fix(BASE)
    bodies.add_obstacle(TOP, Sphere((6.0, -4.0), 2.0))
    W, work = neo_hookean(1.0, 0.3)(u) * ufl.dx, ufl.inner(traction, u) * bodies.ds(ENDS)
    return Scene.of(bodies, u, W, set_load, work, **options)


def ring(
    thickness: float = 0.05,
    n: int = 24,
    across: int = 1,
    degree: int = 2,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    **options: Any,
) -> Scene:
    """Make half a ring of mean radius 1 that two rigid plates squeeze by 1."""
    outside = at(1, 1.0)
    marks = [
        (BASE, lambda x: outside(x) & (x[0] < 0.5 + 1e-9)),
        (TOP, lambda x: outside(x) & (x[0] > 0.5 - 1e-9)),
        (ENDS, lambda x: np.isclose(x[0], 0) | np.isclose(x[0], 1)),
    ]

    def bent(x: Any) -> Any:
        angle, radius = np.pi * (x[0] - 0.5), 1.0 + thickness * (x[1] - 0.5)
        return np.stack([radius * np.cos(angle), radius * np.sin(angle)])

    bodies = scenes.Scene.of_boxes(
        comm, "quadrilateral", [((0, 0), (1, 1), (n, across))], marks, bent, degree=degree
    )
    u, load = fem.Function(bodies.V), {"height": 1.0 + 0.5 * thickness}

    def plate(side: float) -> Any:
        return lambda x: Plane((0.0, side * load["height"]), (0.0, -side))(x)

    def set_load(part: float) -> None:
        load["height"] = 1.0 + 0.5 * thickness - 0.5 * part

    bodies.fix(ENDS, 0)
    bodies.add_obstacle(BASE, plate(-1.0))
    bodies.add_obstacle(TOP, plate(1.0))
    W = neo_hookean(1.0, 0.3)(u) * ufl.dx(metadata={"quadrature_degree": 2 * degree})
    return Scene.of(bodies, u, W, set_load, **options)


def ironing(
    friction: Any = None,
    slave: int = SLIDER,
    n: int = 12,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    stiffness: float = 3.0,
    depth: float = 0.3,
    **options: Any,
) -> Scene:
    """Make half an annulus that its ends press into a block of 4 by 1, and drag along it.

    A load of 1 presses it down by the depth, each further one drags it by 1.5, its outer radius
    being 0.6. Its stiffness is relative to that of the block.
    """
    parts = [((0, 0), (4, 1), (4 * n, n)), ((10, 0), (11, 1), (2 * n, n // 3))]
    marks = [
        (BASE, at(1, 0.0), 1),
        (TOP, at(1, 1.0), 1),
        (SLIDER, at(1, 1.0), 2),
        (ENDS, lambda x: np.isclose(x[0], 10) | np.isclose(x[0], 11), 2),
    ]

    def bent(x: Any) -> Any:
        # the second box to the half annulus of the radii 0.3 and 0.6 around (0.9, 1.6)
        angle, radius = np.pi * (x[0] - 9.0), 0.3 + 0.3 * x[1]
        die = np.stack([0.9 + radius * np.cos(angle), 1.6 + radius * np.sin(angle)])
        return np.where(x[0] > 9.0, die, x)

    young = {1: 1.0, 2: stiffness}
    bodies = scenes.Scene.of_boxes(comm, "quadrilateral", parts, marks, bent, young=young)
    u, motion = fem.Function(bodies.V), fem.Function(bodies.V)

    def set_load(part: float) -> None:
        motion.x.array.reshape(-1, 2)[:] = 1.5 * max(part - 1.0, 0.0), -depth * min(part, 1.0)

    bodies.fix(BASE)
    bodies.fix(ENDS, None, motion)
    bodies.add_pair(slave, TOP + SLIDER - slave, friction=friction)
    W = neo_hookean(bodies.young, 0.3)(u) * ufl.dx
    return Scene.of(bodies, u, W, set_load, **options)


def pressed_patch(
    compression: float = 0.4,
    confined: bool = True,
    turned: float = 0.0,
    motion: float = 0.0,
    friction: Any = None,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    cell: str = "quadrilateral",
    degree: int = 1,
    upper: str = "slave",
    nu: float = 0.3,
    **options: Any,
) -> tuple[Scene, Any]:
    """Make two blocks meshed apart, of width 1 and height 0.5, under uniform compression.

    Their outer ends move as the closed form says, which is also turned by the angle `motion`, and
    so do the sides if they are confined. The mesh is turned by the angle `turned`. The upper block
    is the slave, the master, or tied. Returned is also the force on the upper block in the end [N].
    """
    dim = scenes.dimension(cell)
    sizes = [(6, 3), (8, 4)] if dim == 2 else [(2, 2, 1), (3, 3, 2)]
    low, high, up = np.zeros(dim), np.append(np.ones(dim - 1), 0.5), 0.5 * np.eye(dim)[-1]
    parts = [(low + k * up, high + k * up, cells) for k, cells in enumerate(sizes)]

    def moved(x: Any) -> Any:
        ends = np.isclose(x[dim - 1], 0) | np.isclose(x[dim - 1], 1)
        sides = (np.isclose(x[: dim - 1], 0) | np.isclose(x[: dim - 1], 1)).any(axis=0)
        return ends | sides if confined else ends

    marks = [(BASE, moved, 1), (ENDS, moved, 2)]
    marks += [(TOP, at(dim - 1, 0.5), 1), (SLIDER, at(dim - 1, 0.5), 2)]
    bodies = scenes.Scene.of_boxes(comm, cell, parts, marks, degree=degree)
    axes = turn(bodies.mesh, turned)
    u, ends = fem.Function(bodies.V), fem.Function(bodies.V)

    def set_load(part: float) -> None:
        axial = 1.0 - part * compression
        stretches = [stretch_across(axial, dim, nu, confined)] * (dim - 1) + [axial]
        F = rotation(part * motion, dim) @ axes @ np.diag(stretches) @ axes.T
        ends.interpolate(lambda x: F @ x[:dim] - x[:dim])

    for tag in (BASE, ENDS):
        bodies.fix(tag, None, ends)
    slave = TOP if upper == "master" else SLIDER
    bodies.add_pair(slave, TOP + SLIDER - slave, friction=friction)
    if upper == "tied":
        bodies.contacts = [TiedPair(bodies.facet_tags, slave=SLIDER, master=TOP)]
    scene = Scene.of(bodies, u, neo_hookean(1.0, nu)(u) * ufl.dx, set_load, **options)
    force = axial_force(1.0 - compression, dim, nu, confined)
    return scene, -force * rotation(motion, dim) @ axes[:, -1]


def squeezed_block(
    dim: int = 2,
    n: int = 4,
    compression: float = 0.3,
    turned: float = 0.0,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    **options: Any,
) -> tuple[Scene, Any]:
    """Make a unit cube that nothing but two rigid planes holds, which squeeze it.

    Returned is also the force of the lower plane on it in the end [N].
    """
    marks = [(BASE, at(dim - 1, 0.0)), (TOP, at(dim - 1, 1.0))]
    block = (0.0,) * dim, (1.0,) * dim, (n,) * dim
    bodies = scenes.Scene.of_boxes(comm, solid(dim), [block], marks)
    up = turn(bodies.mesh, turned)[:, -1]
    u, load = fem.Function(bodies.V), {"height": 1.0}
    bodies.add_obstacle(BASE, Plane(0.0 * up, up))
    bodies.add_obstacle(TOP, lambda x: Plane(load["height"] * up, -up)(x))

    def set_load(part: float) -> None:
        load["height"] = 1.0 - part * compression

    scene = Scene.of(bodies, u, neo_hookean(1.0, 0.3)(u) * ufl.dx, set_load, **options)
    return scene, -axial_force(1.0 - compression, dim) * up


def leaning_column(lean: float = 0.01, compression: float = 0.1, **options: Any) -> Scene:
    """Make a slender column, clamped at its base, that a rigid plane compresses to buckling."""
    bodies = scenes.Scene.of_boxes(
        MPI.COMM_WORLD,
        "quadrilateral",
        [((0, 0), (0.1, 1), (2, 12))],
        [(BASE, at(1, 0)), (TOP, at(1, 1))],
        lambda x: np.stack([x[0] + lean * x[1] ** 2, x[1]]),
    )
    u, down = fem.Function(bodies.V), {"now": 0.0}
    bodies.fix(BASE)
    bodies.add_obstacle(TOP, lambda x: Plane((0, 1 - down["now"]), (0, -1))(x))
    W = neo_hookean(1.0, 0.3)(u) * ufl.dx(metadata={"quadrature_degree": 3})
    return Scene.of(bodies, u, W, lambda part: down.update(now=part * compression), **options)


def pulled_strip(n: int, friction: Any, **options: Any) -> Scene:
    """Make a strip of n cells that a load of 1 presses on a plane, and that further ones pull."""
    marks = [(BASE, at(1, 0)), (TOP, at(1, 0.25)), (ENDS, at(0, 4))]
    parts = [((0, 0), (4, 0.25), (n, 2))]
    bodies = scenes.Scene.of_boxes(MPI.COMM_WORLD, "quadrilateral", parts, marks)
    u, pressure = fem.Function(bodies.V), bodies.constant(np.zeros(2))
    pull = fem.Constant(bodies.mesh, 0.0)
    bodies.fix(ENDS, 0, pull)
    bodies.add_obstacle(BASE, Plane((0.0, 0.0), (0.0, 1.0)), friction=friction)

    def set_load(load: float) -> None:
        pressure.value[1] = -0.02 * min(load, 1.0)
        pull.value = 0.02 * max(load - 1.0, 0.0)

    W = neo_hookean(1.0, 0.0)(u) * ufl.dx(metadata={"quadrature_degree": 3})
    return Scene.of(bodies, u, W, set_load, ufl.inner(pressure, u) * bodies.ds(TOP), **options)


def turn(mesh: Any, degrees: float) -> Any:
    """Turn a mesh around the origin, and return the directions of its axes as columns."""
    dim = mesh.geometry.dim
    axes = rotation(degrees, dim)
    mesh.geometry.x[:, :dim] = mesh.geometry.x[:, :dim] @ axes.T
    return axes


def rotation(degrees: float, dim: int = 2) -> Any:
    """Return the matrix of a rotation in the plane, or around an oblique axis in space."""
    axis = [0.0, 0.0, 1.0] if dim == 2 else np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)
    return Rotation.from_rotvec(np.deg2rad(degrees) * np.asarray(axis)).as_matrix()[:dim, :dim]


def stretch_across(axial: float, dim: int = 2, nu: float = 0.3, confined: bool = False) -> float:
    """Return the stretch across an axial one, without stress there if it is not confined.

    In two dimensions there is one such direction.
    """
    if confined:
        return 1.0
    mu, lmbda = _lame(nu)

    def force(across: float) -> float:
        log = np.log(axial * across ** (dim - 1))
        return float(mu * (across - 1 / across) + lmbda * log / across)

    return float(brentq(force, 0.5, 2.0, xtol=1e-14))


def axial_force(axial: float, dim: int = 2, nu: float = 0.3, confined: bool = False) -> float:
    """Return the force on the undeformed unit area along an axial stretch of E = 1."""
    mu, lmbda = _lame(nu)
    across = stretch_across(axial, dim, nu, confined)
    log = np.log(axial * across ** (dim - 1))
    return float(mu * (axial - 1 / axial) + lmbda * log / axial)


def _lame(nu: float) -> tuple[float, float]:
    """Return the Lame parameters for E = 1."""
    return 1 / (2 * (1 + nu)), nu / ((1 + nu) * (1 - 2 * nu))

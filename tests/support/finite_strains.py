"""Bodies with finite strains in contact, whose forces and energies are known from other programs.

The references of the indented block are those of a Newton method with plain dolfinx and SciPy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import ufl
from dolfinx import fem

from fenics_tfeti import (
    ContactPair,
    NonlinearContactProblem,
    Plane,
    RigidObstacle,
    Sphere,
    TiedPair,
)
from fenics_tfeti.fem._compat import lagrange_space
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
from fenics_tfeti.models import neo_hookean

BASE, TOP, SLIDER, ENDS = 1, 2, 3, 4


@dataclass(frozen=True)
class Scene:
    """A problem with what a test changes and measures."""

    problem: NonlinearContactProblem
    strain_energy: Any  # compiled form
    set_load: Callable[[float], None]  # a part of the load, 0 to 1

    @property
    def energy(self) -> float:
        """The energy stored in the bodies [J]."""
        comm = self.problem.space.mesh.comm
        return float(comm.allreduce(fem.assemble_scalar(self.strain_energy)))

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


def clamped(V: Any, facets: Any) -> Any:
    """Return the condition that nothing moves at facets."""
    dofs = fem.locate_dofs_topological(V, V.mesh.topology.dim - 1, facets)
    return fem.dirichletbc(np.zeros(V.mesh.geometry.dim), dofs, V)


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
    low, high = (-1.0,) * (dim - 1) + (0.0,), (1.0,) * dim
    cells = (2 * n,) * (dim - 1) + (n,)
    cell = cell or {2: "quadrilateral", 3: "hexahedron"}[dim]
    mesh = boxes(comm, [Box(low, high, cells)], cell).mesh
    tags = tag_facets(
        mesh, {BASE: lambda x: np.isclose(x[dim - 1], 0), TOP: lambda x: np.isclose(x[dim - 1], 1)}
    )
    up = turn(mesh, turned)[:, -1]
    V = displacement_space(mesh, degree)
    u = fem.Function(V)
    W = energy(u) if energy else neo_hookean(1.0, nu)(u) * ufl.dx
    load = {"depth": 0.0}

    def ball(x: Any) -> Any:
        return Sphere((1.5 - load["depth"]) * up, 0.5)(x)

    problem = NonlinearContactProblem(
        ufl.derivative(W, u, ufl.TestFunction(V)),
        u,
        bcs=[clamped(V, tags.find(BASE))],
        contacts=[RigidObstacle(tags, TOP, obstacle or ball)],
        options=options,
    )
    return Scene(problem, fem.form(W), lambda part: load.update(depth=part * depth))


def beam(comm: MPI.Intracomm = MPI.COMM_WORLD, **options: Any) -> Scene:
    """Make a beam, clamped at one end, that a dead load at the other bends over a cylinder."""
    length, height = 10.0, 0.5
    mesh = boxes(comm, [Box((0, 0), (length, height), (60, 3))], "quadrilateral").mesh
    tags = tag_facets(
        mesh,
        {
            BASE: lambda x: np.isclose(x[0], 0),
            ENDS: lambda x: np.isclose(x[0], length),
            TOP: lambda x: np.isclose(x[1], 0),
        },
    )
    V = displacement_space(mesh)
    u, traction = fem.Function(V), fem.Constant(mesh, np.zeros(2))
    W = neo_hookean(1.0, 0.3)(u) * ufl.dx
    ds = ufl.Measure("ds", mesh, subdomain_data=tags)
    problem = NonlinearContactProblem(
        ufl.derivative(W - ufl.inner(traction, u) * ds(ENDS), u, ufl.TestFunction(V)),
        u,
        bcs=[clamped(V, tags.find(BASE))],
        contacts=[RigidObstacle(tags, TOP, Sphere((6.0, -4.0), 2.0))],
        options=options,
    )

    def set_load(part: float) -> None:
        traction.value[1] = -part * 1.5e-3 / height

    return Scene(problem, fem.form(W), set_load)


def ring(
    thickness: float = 0.05,
    n: int = 24,
    across: int = 1,
    degree: int = 2,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    **options: Any,
) -> Scene:
    """Make half a ring of mean radius 1 that two rigid plates squeeze by 1."""
    mesh = boxes(comm, [Box((0, 0), (1, 1), (n, across))], "quadrilateral").mesh
    outside = {BASE: lambda x: x[0] < 0.5 + 1e-9, TOP: lambda x: x[0] > 0.5 - 1e-9}
    tags = tag_facets(
        mesh,
        {tag: lambda x, half=half: np.isclose(x[1], 1) & half(x) for tag, half in outside.items()}
        | {ENDS: lambda x: np.isclose(x[0], 0) | np.isclose(x[0], 1)},
    )
    x = mesh.geometry.x
    angle, radius = np.pi * (x[:, 0] - 0.5), 1.0 + thickness * (x[:, 1] - 0.5)
    x[:, 0], x[:, 1] = radius * np.cos(angle), radius * np.sin(angle)
    V = displacement_space(mesh, degree)
    u, load = fem.Function(V), {"height": 1.0 + 0.5 * thickness}
    W = neo_hookean(1.0, 0.3)(u) * ufl.dx(metadata={"quadrature_degree": 2 * degree})
    ends = fem.locate_dofs_topological(V.sub(0), 1, tags.find(ENDS))

    def plate(side: float) -> Any:
        return lambda x: Plane((0.0, side * load["height"]), (0.0, -side))(x)

    problem = NonlinearContactProblem(
        ufl.derivative(W, u, ufl.TestFunction(V)),
        u,
        bcs=[fem.dirichletbc(0.0, ends, V.sub(0))],
        contacts=[RigidObstacle(tags, BASE, plate(-1.0)), RigidObstacle(tags, TOP, plate(1.0))],
        options=options,
    )

    def set_load(part: float) -> None:
        load["height"] = 1.0 + 0.5 * thickness - 0.5 * part

    return Scene(problem, fem.form(W), set_load)


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
    bodies = [Box((0, 0), (4, 1), (4 * n, n)), Box((10, 0), (11, 1), (2 * n, n // 3))]
    tagged = boxes(comm, bodies, "quadrilateral")
    mesh = tagged.mesh
    surfaces = [
        (BASE, lambda x: np.isclose(x[1], 0), 1),
        (TOP, lambda x: np.isclose(x[1], 1), 1),
        (SLIDER, lambda x: np.isclose(x[1], 1), 2),
        (ENDS, lambda x: np.isclose(x[0], 10) | np.isclose(x[0], 11), 2),
    ]
    tags = tag_facets(mesh, surfaces, tagged.cell_tags)
    _bend(mesh.geometry.x)
    V = displacement_space(mesh)
    u, motion, E = fem.Function(V), fem.Function(V), fem.Function(cell_space(mesh))
    E.x.array[:] = 1.0
    E.x.array[tagged.cell_tags.find(2)] = stiffness
    W = neo_hookean(E, 0.3)(u) * ufl.dx
    ends = fem.locate_dofs_topological(V, 1, tags.find(ENDS))
    master = TOP if slave == SLIDER else SLIDER
    problem = NonlinearContactProblem(
        ufl.derivative(W, u, ufl.TestFunction(V)),
        u,
        bcs=[clamped(V, tags.find(BASE)), fem.dirichletbc(motion, ends)],
        contacts=[ContactPair(tags, slave=slave, master=master, friction=friction)],
        options=options,
    )

    def set_load(part: float) -> None:
        values = motion.x.array.reshape(-1, 2)
        values[:, 0], values[:, 1] = 1.5 * max(part - 1.0, 0.0), -depth * min(part, 1.0)

    return Scene(problem, fem.form(W), set_load)


def _bend(x: Any) -> None:
    """Bend the second box to the half annulus of the radii 0.3 and 0.6 around (0.9, 1.6)."""
    die = x[:, 0] > 9.0
    angle, radius = np.pi * (x[die, 0] - 9.0), 0.3 + 0.3 * x[die, 1]
    x[die, 0], x[die, 1] = 0.9 + radius * np.cos(angle), 1.6 + radius * np.sin(angle)


def cell_space(mesh: Any) -> Any:
    """Return the space of functions that are constant in each cell."""
    return lagrange_space(mesh, 0, discontinuous=True)


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
    mesh, tags, axes = _two_blocks(comm, cell, confined, turned)
    dim = mesh.geometry.dim
    V = displacement_space(mesh, degree)
    u, ends = fem.Function(V), fem.Function(V)
    W = neo_hookean(1.0, nu)(u) * ufl.dx
    outer = [fem.locate_dofs_topological(V, dim - 1, tags.find(tag)) for tag in (BASE, ENDS)]
    slave, master = (TOP, SLIDER) if upper == "master" else (SLIDER, TOP)
    if upper == "tied":
        interface = TiedPair(tags, slave=slave, master=master)
    else:
        interface = ContactPair(tags, slave=slave, master=master, friction=friction)
    problem = NonlinearContactProblem(
        ufl.derivative(W, u, ufl.TestFunction(V)),
        u,
        bcs=[fem.dirichletbc(ends, dofs) for dofs in outer],
        contacts=[interface],
        options=options,
    )

    def set_load(part: float) -> None:
        axial = 1.0 - part * compression
        stretches = [stretch_across(axial, dim, nu, confined)] * (dim - 1) + [axial]
        F = rotation(part * motion, dim) @ axes @ np.diag(stretches) @ axes.T
        ends.interpolate(lambda x: F @ x[:dim] - x[:dim])

    axial = 1.0 - compression
    force = axial_force(axial, dim, nu, confined)
    return Scene(problem, fem.form(W), set_load), -force * rotation(motion, dim) @ axes[:, -1]


def _two_blocks(comm: MPI.Intracomm, cell: str, confined: bool, turned: float) -> Any:
    """Mesh two blocks apart, one on the other, with the tags of their ends and of the interface."""
    dim = 2 if cell in ("triangle", "quadrilateral") else 3
    sizes = [(6, 3), (8, 4)] if dim == 2 else [(2, 2, 1), (3, 3, 2)]
    corners = [(0.0,) * dim, (1.0,) * (dim - 1) + (0.5,)]
    up = np.array((0.0,) * (dim - 1) + (0.5,))
    blocks = [Box(corners[0] + i * up, corners[1] + i * up, cells) for i, cells in enumerate(sizes)]
    tagged = boxes(comm, blocks, cell)
    mesh = tagged.mesh

    def moved(x: Any) -> Any:
        ends = np.isclose(x[dim - 1], 0) | np.isclose(x[dim - 1], 1)
        sides = (np.isclose(x[: dim - 1], 0) | np.isclose(x[: dim - 1], 1)).any(axis=0)
        return ends | sides if confined else ends

    surfaces = [
        (BASE, moved, 1),
        (ENDS, moved, 2),
        (TOP, lambda x: np.isclose(x[dim - 1], 0.5), 1),
        (SLIDER, lambda x: np.isclose(x[dim - 1], 0.5), 2),
    ]
    return mesh, tag_facets(mesh, surfaces, tagged.cell_tags), turn(mesh, turned)


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
    cell = {2: "quadrilateral", 3: "hexahedron"}[dim]
    mesh = boxes(comm, [Box((0.0,) * dim, (1.0,) * dim, (n,) * dim)], cell).mesh
    tags = tag_facets(
        mesh, {BASE: lambda x: np.isclose(x[dim - 1], 0), TOP: lambda x: np.isclose(x[dim - 1], 1)}
    )
    up = turn(mesh, turned)[:, -1]
    V = displacement_space(mesh)
    u, load = fem.Function(V), {"height": 1.0}
    W = neo_hookean(1.0, 0.3)(u) * ufl.dx
    problem = NonlinearContactProblem(
        ufl.derivative(W, u, ufl.TestFunction(V)),
        u,
        contacts=[
            RigidObstacle(tags, BASE, Plane(0.0 * up, up)),
            RigidObstacle(tags, TOP, lambda x: Plane(load["height"] * up, -up)(x)),
        ],
        options=options,
    )
    scene = Scene(problem, fem.form(W), lambda part: load.update(height=1.0 - part * compression))
    return scene, -axial_force(1.0 - compression, dim) * up


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

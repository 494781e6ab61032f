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

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, NonlinearContactProblem, RigidObstacle, Sphere
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
    **options: Any,
) -> Scene:
    """Make a block of height 1 and width 2, clamped at its base, under a rigid ball of radius 0.5.

    In two dimensions the ball is a cylinder. Another obstacle may take its place.
    """
    low, high = (-1.0,) * (dim - 1) + (0.0,), (1.0,) * dim
    cells = (2 * n,) * (dim - 1) + (n,)
    cell = {2: "quadrilateral", 3: "hexahedron"}[dim]
    mesh = boxes(comm, [Box(low, high, cells)], cell).mesh
    tags = tag_facets(
        mesh, {BASE: lambda x: np.isclose(x[dim - 1], 0), TOP: lambda x: np.isclose(x[dim - 1], 1)}
    )
    V = displacement_space(mesh, degree)
    u = fem.Function(V)
    W = neo_hookean(1.0, nu)(u) * ufl.dx
    load = {"depth": 0.0}

    def ball(x: Any) -> Any:
        centre = [0.0] * (dim - 1) + [1.5 - load["depth"]]
        return Sphere(centre, 0.5)(x)

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


def ironing(
    friction: Any = None,
    slave: int = SLIDER,
    n: int = 12,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    **options: Any,
) -> Scene:
    """Make half an annulus that its ends press into a block of 4 by 1, and drag along it.

    A load of 1 presses it down by 0.3, each further one drags it by 1.5, its outer radius being
    0.6.
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
    E.x.array[tagged.cell_tags.find(2)] = 3.0
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
        values[:, 0], values[:, 1] = 1.5 * max(part - 1.0, 0.0), -0.3 * min(part, 1.0)

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
    **options: Any,
) -> tuple[Scene, Any]:
    """Make two blocks meshed apart, of width 1 and height 0.5, under uniform compression.

    Their outer ends move as the closed form says, which is also turned by the angle `motion`, and
    so do the sides if they are confined. The mesh is turned by the angle `turned`. Returned is also
    the force on the upper block, the slave, in the end [N].
    """
    lower, upper = Box((0, 0), (1, 0.5), (6, 3)), Box((0, 0.5), (1, 1), (8, 4))
    tagged = boxes(comm, [lower, upper], "quadrilateral")
    mesh = tagged.mesh

    def moved(x: Any) -> Any:
        ends = np.isclose(x[1], 0) | np.isclose(x[1], 1)
        sides = np.isclose(x[0], 0) | np.isclose(x[0], 1)
        return ends | sides if confined else ends

    surfaces = [
        (BASE, moved, 1),
        (ENDS, moved, 2),
        (TOP, lambda x: np.isclose(x[1], 0.5), 1),
        (SLIDER, lambda x: np.isclose(x[1], 0.5), 2),
    ]
    tags = tag_facets(mesh, surfaces, tagged.cell_tags)
    axes = rotation(turned)
    mesh.geometry.x[:, :2] = mesh.geometry.x[:, :2] @ axes.T
    V = displacement_space(mesh)
    u, ends = fem.Function(V), fem.Function(V)
    W = neo_hookean(1.0, 0.3)(u) * ufl.dx
    outer = [fem.locate_dofs_topological(V, 1, tags.find(tag)) for tag in (BASE, ENDS)]
    problem = NonlinearContactProblem(
        ufl.derivative(W, u, ufl.TestFunction(V)),
        u,
        bcs=[fem.dirichletbc(ends, dofs) for dofs in outer],
        contacts=[ContactPair(tags, slave=SLIDER, master=TOP, friction=friction)],
        options=options,
    )

    def set_load(part: float) -> None:
        axial = 1.0 - part * compression
        F = rotation(part * motion) @ axes @ np.diag([_across(axial, confined), axial]) @ axes.T
        ends.interpolate(lambda x: F @ x[:2] - x[:2])

    force = -axial_force(1.0 - compression, _across(1.0 - compression, confined))
    return Scene(problem, fem.form(W), set_load), rotation(turned + motion) @ [0.0, force]


def rotation(degrees: float) -> Any:
    """Return the matrix of a rotation in the plane."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, -s], [s, c]])


def _across(axial: float, confined: bool) -> float:
    """Return the stretch across an axial one, without stress there if it is not confined."""
    if confined:
        return 1.0
    return float(brentq(lambda stretch: axial_force(stretch, axial), 0.5, 2.0, xtol=1e-14))


def axial_force(axial: float, across: float, E: float = 1.0, nu: float = 0.3) -> float:
    """Return the force on the undeformed width along an axial stretch, in plane strain."""
    mu, lmbda = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    return float(mu * (axial - 1 / axial) + lmbda * np.log(across * axial) / axial)

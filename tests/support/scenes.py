"""Small contact problems, as a user would write them, with what is known about their solutions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from mpi4py import MPI

from petsc4py import PETSc

import numpy as np
import primal_reference as reference
from numpy.typing import NDArray

import ufl
from dolfinx import fem

from fenics_tfeti.io import Box, boxes, tag_facets

YOUNG, POISSON = 2.1e11, 0.3
TRACTION = 20e6
WEIGHT = 1e5

# Facet tags, the same in all scenes.
CLAMPED, ROLLER, LOADED, SLAVE, MASTER, GROUND, SIDE_X, SIDE_Y = 1, 2, 3, 5, 6, 7, 8, 9


@dataclass(frozen=True)
class Plane:
    """A rigid half space below a plane; as a callable it is the obstacle of the reference."""

    point: tuple[float, ...]
    normal: tuple[float, ...]

    def __call__(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        point, normal = np.zeros(3), np.zeros(3)
        point[: len(self.point)], normal[: len(self.normal)] = self.point, self.normal
        normal /= np.linalg.norm(normal)
        return normal @ (x - point[:, None]), np.tile(normal[:, None], x.shape[1])


@dataclass(frozen=True)
class Ball:
    """A rigid ball, or disc in two dimensions."""

    centre: tuple[float, float, float]
    radius: float

    def __call__(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        outwards = x - np.array(self.centre)[:, None]
        distance = np.linalg.norm(outwards, axis=0)
        return distance - self.radius, outwards / distance


@dataclass
class Scene:
    """A contact problem and its known totals.

    Attributes
    ----------
    contacts : sequence of primal_reference.Pair or primal_reference.Obstacle
        The contacts, in terms of `facet_tags`; `package_contacts` says them in the package's.
    total_forces : list of float
        Exact magnitude [N] of the total normal force of each contact.
    exact : callable or None
        x (3, n) -> u (gdim, n) where the exact solution is in the discrete space.
    """

    mesh: Any
    V: Any
    a: Any
    L: Any
    bcs: list[Any]
    contacts: Sequence[reference.Pair | reference.Obstacle]
    facet_tags: Any
    cell_tags: Any
    total_forces: list[float]
    exact: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    kept: list[Any] = field(default_factory=list)  # dolfinx 0.5 does not keep constants alive

    def package_contacts(self) -> list[Any]:
        from fenics_tfeti import ContactPair, RigidObstacle
        from fenics_tfeti import Plane as RigidPlane

        def obstacle(surface: Any) -> Any:
            plane = isinstance(surface, Plane)
            return RigidPlane(surface.point, surface.normal) if plane else surface

        return [
            ContactPair(self.facet_tags, slave=contact.slave, master=contact.master)
            if isinstance(contact, reference.Pair)
            else RigidObstacle(
                self.facet_tags, slave=contact.slave, obstacle=obstacle(contact.surface)
            )
            for contact in self.contacts
        ]

    def problem(self, **arguments: Any) -> Any:
        """Return the package's problem; arguments replace those of the scene."""
        from fenics_tfeti import ContactProblem

        defaults = {
            "bcs": self.bcs,
            "contacts": self.package_contacts(),
            "cell_tags": self.cell_tags,
        }
        return ContactProblem(self.a, self.L, **{**defaults, **arguments})

    def reference(self) -> reference.ReferenceSolution:
        """Solve by the naive method; serial only."""
        return reference.reference_solution(
            self.V, self.a, self.L, self.bcs, self.facet_tags, self.contacts
        )


# -- what differs between the versions of dolfinx ----------------------------------------------


def vector_space(mesh: Any, degree: int = 1) -> Any:
    if hasattr(fem, "functionspace"):
        return fem.functionspace(mesh, ("Lagrange", degree, (mesh.geometry.dim,)))
    return fem.VectorFunctionSpace(mesh, ("Lagrange", degree))


def scalar_space(mesh: Any, family: str = "Lagrange", degree: int = 1) -> Any:
    if hasattr(fem, "functionspace"):
        return fem.functionspace(mesh, (family, degree))
    return fem.FunctionSpace(mesh, (family, degree))


def nothing_but_labels(mesh: Any, labels: NDArray[Any]) -> Any:
    """Return a coefficient that is zero, of data by which cells of different labels differ."""
    data = fem.Function(scalar_space(mesh, "DG", 0))
    data.x.array[:] = labels
    return fem.Constant(mesh, 0.0) * data


# -- forms and conditions ------------------------------------------------------------------------


def stress(u: Any, young: Any, poisson: float = POISSON) -> Any:
    """Return Hooke's stress, in two dimensions for plane strain."""
    gdim = u.ufl_shape[0]
    mu = young / (2.0 * (1.0 + poisson))
    lam = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    strain = ufl.sym(ufl.grad(u))
    return 2.0 * mu * strain + lam * ufl.tr(strain) * ufl.Identity(gdim)


def elasticity(u: Any, v: Any, young: Any, measure: Any = ufl.dx) -> Any:
    return ufl.inner(stress(u, young), ufl.sym(ufl.grad(v))) * measure


def fixed(V: Any, facet_tags: Any, tag: int, component: int | None, value: float = 0.0) -> Any:
    """Prescribe one component, or all, on the facets with a tag."""
    fdim, facets = V.mesh.topology.dim - 1, facet_tags.find(tag)
    V.mesh.topology.create_connectivity(fdim, fdim + 1)
    if component is None:
        dofs = fem.locate_dofs_topological(V, fdim, facets)
        return fem.dirichletbc(np.full(V.mesh.geometry.dim, value, PETSc.ScalarType), dofs, V)
    dofs = fem.locate_dofs_topological(V.sub(component), fdim, facets)
    return fem.dirichletbc(PETSc.ScalarType(value), dofs, V.sub(component))


def at(axis: int, value: float) -> Callable[[NDArray[np.float64]], NDArray[np.bool_]]:
    return lambda x: np.isclose(x[axis], value)


def dimension(cell: str) -> int:
    return 3 if cell in ("hexahedron", "tetrahedron") else 2


# -- the scenes ----------------------------------------------------------------------------------


def beams_mesh(
    comm: MPI.Comm, cell: str, n: int, gap: float = 0.0, metre: float = 1.0
) -> tuple[Any, Any, Any]:
    """Return mesh, cell tags and facet tags of two cantilevers, the second upon the first's end.

    Slave is the upper beam's lower face, where it is above the lower beam.
    """
    gdim, up = dimension(cell), dimension(cell) - 1
    middle, div = ([0.0], [1.0]), [n]
    start, end = middle if gdim == 3 else ([], [])
    div = div if gdim == 3 else []
    corners = metre * np.array(
        [
            [0.0, *start, 0.0],
            [2.0, *end, 1.0],
            [1.0, *start, 1.0 + gap],
            [3.0, *end, 2.0 + gap],
        ]
    )
    divisions = (2 * n, *div, n)
    lower = Box(corners[0], corners[1], divisions, "lower")
    upper = Box(corners[2], corners[3], divisions, "upper")
    tagged = boxes(comm, [lower, upper], cell)

    def overlap(height: float) -> Callable[[NDArray[np.float64]], NDArray[np.bool_]]:
        def inside(x: NDArray[np.float64]) -> NDArray[np.bool_]:
            x = x / metre
            return np.isclose(x[up], height) & (x[0] > 1.0 - 1e-9) & (x[0] < 2.0 + 1e-9)

        return inside

    facet_tags = tag_facets(
        tagged.mesh,
        [
            (CLAMPED, at(0, 0.0), 1),
            (ROLLER, at(0, 3.0 * metre), 2),
            (LOADED, at(up, (2.0 + gap) * metre), 2),
            (LOADED, at(0, 1.0 * metre), 2),
            (SLAVE, overlap(1.0 + gap), 2),
            (MASTER, overlap(1.0), 1),
        ],
        tagged.cell_tags,
    )
    return tagged.mesh, tagged.cell_tags, facet_tags


def beams_supports(V: Any, facet_tags: Any) -> list[Any]:
    """Clamp the lower beam; let the upper one move up and down only: semicoercive."""
    sideways = range(V.mesh.geometry.dim - 1)
    return [fixed(V, facet_tags, CLAMPED, None)] + [
        fixed(V, facet_tags, ROLLER, component) for component in sideways
    ]


def two_beams(
    comm: MPI.Comm, cell: str = "hexahedron", n: int = 4, gap: float = 0.0, metre: float = 1.0
) -> Scene:
    """The chapter's benchmark (sec. 11.11.1), plane strain for the cells of two dimensions.

    20 MPa downwards on 3 m2 (in 2D on 3 m) of the upper beam, which contact alone holds up.
    `n` is per metre, `metre` what a metre is in the unit of length used.
    """
    mesh, cell_tags, facet_tags = beams_mesh(comm, cell, n, gap, metre)
    V = vector_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    young = fem.Constant(mesh, YOUNG / metre**2)
    traction = fem.Constant(mesh, -TRACTION / metre**2)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
    return Scene(
        mesh=mesh,
        V=V,
        a=elasticity(u, v, young),
        L=traction * v[mesh.geometry.dim - 1] * ds(LOADED),
        bcs=beams_supports(V, facet_tags),
        contacts=[reference.Pair(SLAVE, MASTER)],
        facet_tags=facet_tags,
        cell_tags=cell_tags,
        total_forces=[3.0 * TRACTION * metre ** (mesh.geometry.dim - 3)],
        kept=[young, traction],
    )


def pressed_block(
    comm: MPI.Comm,
    cell: str = "hexahedron",
    n: int = 3,
    approach: float = 1e-3,
    gap: float = 0.0,
) -> Scene:
    """A unit block between symmetry planes, its top pushed down onto a rigid plane.

    The stress is uniaxial and uniform, so the exact displacement is linear in x.
    """
    gdim, up = dimension(cell), dimension(cell) - 1
    tagged = boxes(comm, [Box((0.0,) * gdim, (1.0,) * gdim, (n,) * gdim)], cell)
    mesh = tagged.mesh
    markers = [(GROUND, at(up, 0.0)), (LOADED, at(up, 1.0)), (SIDE_X, at(0, 0.0))]
    facet_tags = tag_facets(mesh, markers + [(SIDE_Y, at(1, 0.0))] * (gdim == 3))
    V = vector_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    young, nothing = fem.Constant(mesh, YOUNG), fem.Constant(mesh, 0.0)
    bcs = [
        fixed(V, facet_tags, LOADED, up, -approach),
        fixed(V, facet_tags, SIDE_X, 0),
    ] + [fixed(V, facet_tags, SIDE_Y, 1) for _ in range(gdim == 3)]

    strain = max(approach - gap, 0.0)
    stiffness = YOUNG if gdim == 3 else YOUNG / (1.0 - POISSON**2)
    sideways = POISSON if gdim == 3 else POISSON / (1.0 - POISSON)

    def exact(x: NDArray[np.float64]) -> NDArray[np.float64]:
        displacement = sideways * strain * x[:gdim]
        displacement[up] = -approach + strain * (1.0 - x[up])
        return displacement

    below, upwards = np.zeros(gdim), np.zeros(gdim)
    below[up], upwards[up] = -gap, 1.0
    return Scene(
        mesh=mesh,
        V=V,
        a=elasticity(u, v, young),
        L=nothing * v[0] * ufl.dx,
        bcs=bcs,
        contacts=[reference.Obstacle(GROUND, Plane(tuple(below), tuple(upwards)))],
        facet_tags=facet_tags,
        cell_tags=None,
        total_forces=[stiffness * strain],
        exact=exact,
        kept=[young, nothing],
    )


def block_on_ball(comm: MPI.Comm, cell: str = "hexahedron", n: int = 4) -> Scene:
    """The block pushed onto a rigid ball: all gaps and normals are different. No total is known."""
    scene = pressed_block(comm, cell, n, approach=1e-2)
    gdim = scene.mesh.geometry.dim
    centre = (0.4, 0.5, -10.0) if gdim == 3 else (0.4, -10.0, 0.0)
    scene.contacts = [reference.Obstacle(GROUND, Ball(centre, 10.0))]
    scene.exact, scene.total_forces = None, []
    return scene


def corner(comm: MPI.Comm, cell: str = "quadrilateral", n: int = 6) -> Scene:
    """The block pushed into a corner: the nodes of the edge are in two contacts."""
    scene = pressed_block(comm, cell, n)
    mesh, V = scene.mesh, scene.V
    gdim, up = mesh.geometry.dim, mesh.geometry.dim - 1
    v, push = ufl.TestFunction(V), fem.Constant(mesh, -TRACTION)
    dx, ds = ufl.dx(domain=mesh), ufl.Measure("ds", domain=mesh, subdomain_data=scene.facet_tags)
    scene.L = push * v[up] * ds(LOADED) + 0.5 * push * v[0] * dx
    scene.bcs = [fixed(V, scene.facet_tags, SIDE_Y, 1) for _ in range(gdim == 3)]
    axes, origin = np.eye(gdim), (0.0,) * gdim
    scene.contacts = [
        reference.Obstacle(GROUND, Plane(origin, tuple(axes[up]))),
        reference.Obstacle(SIDE_X, Plane(origin, tuple(axes[0]))),
    ]
    scene.exact, scene.total_forces = None, [TRACTION, 0.5 * TRACTION]
    scene.kept.append(push)
    return scene


def two_materials(comm: MPI.Comm, cell: str = "hexahedron", n: int = 2) -> Scene:
    """The beams with all kinds of data that forms can hold.

    A DG0 Young's modulus (the lower beam softer and graded along x), a P1 traction that
    grows along y or x, a body force on the upper beam by dx(tag), and the stiffness as a sum of
    integrals over tagged cells with two quadrature degrees.
    """
    mesh, cell_tags, facet_tags = beams_mesh(comm, cell, n)
    up = mesh.geometry.dim - 1
    V = vector_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    young = fem.Function(scalar_space(mesh, "DG", 0))
    young.interpolate(lambda x: YOUNG * np.where(x[up] < 1.0, 0.1 + 0.1 * x[0], 1.0))
    traction = fem.Function(scalar_space(mesh))
    traction.interpolate(lambda x: -TRACTION * x[0])
    weight = fem.Constant(mesh, -WEIGHT)
    dx = ufl.Measure("dx", domain=mesh, subdomain_data=cell_tags)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
    a = elasticity(u, v, young, dx(1)) + elasticity(
        u, v, young, dx(2, metadata={"quadrature_degree": 3})
    )
    # The top carries the integral of x over [1, 3], the left face is at x = 1.
    total = TRACTION * (4.0 + 1.0) + 2.0 * WEIGHT
    return Scene(
        mesh=mesh,
        V=V,
        a=a,
        L=traction * v[up] * ds(LOADED) + weight * v[up] * dx(2),
        bcs=beams_supports(V, facet_tags),
        contacts=[reference.Pair(SLAVE, MASTER)],
        facet_tags=facet_tags,
        cell_tags=cell_tags,
        total_forces=[total],
        kept=[weight],
    )


def stack_on_ground(comm: MPI.Comm, cell: str = "hexahedron", n: int = 4) -> Scene:
    """Two loose blocks, one on the other, on a rigid plane: both held by contact alone.

    Symmetry planes stop them sideways; both have their weight, and the upper one carries a load on
    a quarter of its top, so that they bend and part on the other side. Two contacts, two totals.
    """
    gdim, up = dimension(cell), dimension(cell) - 1
    zero, one = (0.0,) * (gdim - 1), (1.0,) * (gdim - 1)
    parts = [
        Box((*zero, 0.0), (*one, 1.0), (n,) * gdim, "lower"),
        Box((*zero, 1.0), (*one, 2.0), (n,) * gdim, "upper"),
    ]
    tagged = boxes(comm, parts, cell)
    mesh = tagged.mesh

    def quarter(x: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.isclose(x[up], 2.0) & (x[0] < 0.25 + 1e-9)

    facet_tags = tag_facets(
        mesh,
        [
            (GROUND, at(up, 0.0), 1),
            (MASTER, at(up, 1.0), 1),
            (SLAVE, at(up, 1.0), 2),
            (LOADED, quarter, 2),
            (SIDE_X, at(0, 0.0)),
        ]
        + [(SIDE_Y, at(1, 0.0))] * (gdim == 3),
        tagged.cell_tags,
    )
    V = vector_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    young, traction = fem.Constant(mesh, YOUNG), fem.Constant(mesh, -TRACTION)
    weight = fem.Constant(mesh, -WEIGHT)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
    upwards = tuple(np.eye(gdim)[up])
    return Scene(
        mesh=mesh,
        V=V,
        a=elasticity(u, v, young),
        L=traction * v[up] * ds(LOADED) + weight * v[up] * ufl.dx(domain=mesh),
        bcs=[fixed(V, facet_tags, SIDE_X, 0)]
        + [fixed(V, facet_tags, SIDE_Y, 1) for _ in range(gdim == 3)],
        contacts=[
            reference.Pair(SLAVE, MASTER),
            reference.Obstacle(GROUND, Plane((0.0,) * gdim, upwards)),
        ],
        facet_tags=facet_tags,
        cell_tags=tagged.cell_tags,
        total_forces=[0.25 * TRACTION + WEIGHT, 0.25 * TRACTION + 2.0 * WEIGHT],
        kept=[young, traction, weight],
    )

"""Small contact problems, as a user would write them, with what is known about their solutions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np
import primal_reference as reference
from numpy.typing import NDArray

import ufl
from dolfinx import fem
from dolfinx.mesh import meshtags

from fenics_tfeti import ContactPair, ContactProblem, Plane, RigidObstacle, Sphere
from fenics_tfeti.fem import _compat
from fenics_tfeti.io import Box, boxes, displacement_space, piecewise_constant, tag_facets

CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")
YOUNG, POISSON = 2.1e11, 0.3
TRACTION = 20e6
WEIGHT = 1e5

# Facet tags, the same in all scenes.
CLAMPED, ROLLER, LOADED, SLAVE, MASTER, GROUND, SIDE_X, SIDE_Y = 1, 2, 3, 5, 6, 7, 8, 9


class Scene:
    """A contact problem on tagged bodies, put together part by part.

    Attributes
    ----------
    u, v, dx, ds
        Trial and test function, and the measures of tagged cells and facets.
    young : dolfinx.fem.Constant or Function
        Young's modulus [Pa] of `a`, by default that of steel; given as a dict by tags of cells.
    a, L
        Forms: Hooke's law, and no load.
    traction : dolfinx.fem.Constant or None
        That of `L` on the beams [Pa], upwards.
    bcs, contacts : list
        Supports, and the package's contacts.
    total_forces : list of float
        Exact magnitude [N] of the total normal force of each contact, where it is known.
    exact : callable or None
        x (3, n) -> u (gdim, n) where the exact solution is in the discrete space.
    """

    def __init__(
        self, mesh: Any, facet_tags: Any, cell_tags: Any = None, degree: int = 1, young: Any = YOUNG
    ) -> None:
        self.mesh, self.facet_tags, self.cell_tags = mesh, facet_tags, cell_tags
        self.gdim = mesh.geometry.dim
        self.V = displacement_space(mesh, degree)
        self.u, self.v = ufl.TrialFunction(self.V), ufl.TestFunction(self.V)
        self.dx = ufl.Measure("dx", domain=mesh, subdomain_data=cell_tags)
        self.ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
        if isinstance(young, dict):
            young = piecewise_constant(mesh, cell_tags, young)
        self.young = self.constant(young)
        self.a, self.L = elasticity(self.u, self.v, self.young), 0
        self.bcs: list[Any] = []
        self.contacts: list[Any] = []
        self.traction: Any = None
        self.total_forces: list[float] = []
        self.exact: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None

    @classmethod
    def of_boxes(
        cls,
        comm: MPI.Comm,
        cell: str,
        parts: Sequence[Box | tuple[Any, ...]],
        marks: Sequence[tuple[Any, ...]],
        shape: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
        **more: Any,
    ) -> Scene:
        """Make boxes, tag their facets where they are, and move the nodes (gdim, n) by `shape`."""
        tagged = boxes(comm, [p if isinstance(p, Box) else Box(*p) for p in parts], cell)
        tags = tag_facets(tagged.mesh, marks, tagged.cell_tags)
        if shape is not None:
            x, gdim = tagged.mesh.geometry.x, tagged.mesh.geometry.dim
            x[:, :gdim] = shape(x[:, :gdim].T).T
        return cls(tagged.mesh, tags, tagged.cell_tags, **more)

    @classmethod
    def of(cls, bodies: Any, **more: Any) -> Scene:
        """Take mesh and tags from a mesh file."""
        return cls(bodies.mesh, bodies.facet_tags, bodies.cell_tags, **more)

    def constant(self, value: Any) -> Any:
        """Return a value, a number or a vector, that can be changed between solves."""
        return value if hasattr(value, "ufl_shape") else fem.Constant(self.mesh, value)

    def nodes(self, body: int) -> NDArray[np.int64]:
        """Return the rows of ``mesh.geometry.x`` of the cells with a tag."""
        return np.unique(_compat.geometry_cells(self.mesh)[self.cell_tags.find(body)])

    def add_load(self, tag: Any, traction: Any) -> Any:
        """Add a traction, a vector or along the outward normal, to L; return its value."""
        value = self.constant(traction)
        of_facet = value if value.ufl_shape else value * ufl.FacetNormal(self.mesh)
        self.L += ufl.inner(of_facet, self.v) * self.ds(tag)
        return value

    def fix(self, tag: int, component: int | None = None, value: Any = 0.0) -> None:
        """Prescribe one component, or all, on the facets with a tag."""
        self.bcs.append(fixed(self.V, self.facet_tags, tag, component, value))

    def add_pair(self, slave: int = SLAVE, master: int = MASTER, **more: Any) -> None:
        """Add a pair of tagged surfaces to the contacts."""
        self.contacts.append(ContactPair(self.facet_tags, slave, master, **more))

    def add_obstacle(self, slave: int, obstacle: Any, **more: Any) -> None:
        """Add an obstacle to the contacts."""
        self.contacts.append(RigidObstacle(self.facet_tags, slave, obstacle, **more))

    def problem(self, **arguments: Any) -> ContactProblem:
        """Return the package's problem; arguments replace those of the scene."""
        given = {"bcs": self.bcs, "contacts": self.contacts, "cell_tags": self.cell_tags}
        return ContactProblem(self.a, self.L, **{**given, **arguments})

    def reference(self) -> reference.ReferenceSolution:
        """Solve by the naive method; serial only."""
        return reference.reference_solution(self.V, self.a, self.L, self.bcs, self.contacts)


# -- what differs between the versions of dolfinx ----------------------------------------------


def scalar_space(mesh: Any, family: str = "Lagrange", degree: int = 1) -> Any:
    if hasattr(fem, "functionspace"):
        return fem.functionspace(mesh, (family, degree))
    return fem.FunctionSpace(mesh, (family, degree))


def nothing_but_labels(mesh: Any, labels: NDArray[Any]) -> Any:
    """Return a coefficient that is zero, of data by which cells of different labels differ."""
    data = fem.Function(scalar_space(mesh, "DG", 0))
    data.x.array[:] = labels
    return fem.Constant(mesh, 0.0) * data


def integral(mesh: Any, tags: Any, tag: int, kind: str = "ds", integrand: Any = 1.0) -> float:
    """Integrate over the cells ("dx") or facets with a tag, by one compiled form for all tags."""
    entities = np.sort(tags.find(tag))
    chosen = meshtags(mesh, tags.dim, entities, np.ones(entities.size, dtype=np.int32))
    over = ufl.Measure(kind, domain=mesh, subdomain_data=chosen)
    one = fem.Constant(mesh, 1.0)
    return mesh.comm.allreduce(fem.assemble_scalar(fem.form(one * integrand * over(1))))


# -- forms and conditions ------------------------------------------------------------------------


def strain(u: Any) -> Any:
    return ufl.sym(ufl.grad(u))


def axisymmetric_strain(u: Any) -> Any:
    """Return the strain of a displacement (u_r, u_z) in the plane of a meridian."""
    r = ufl.SpatialCoordinate(u.ufl_function_space().ufl_domain())[0]
    e = strain(u)
    return ufl.as_tensor([[e[0, 0], e[0, 1], 0], [e[1, 0], e[1, 1], 0], [0, 0, u[0] / r]])


def stress(u: Any, young: Any, poisson: Any = POISSON, strain: Any = strain) -> Any:
    """Return Hooke's stress, in two dimensions for plane strain."""
    e, nu = strain(u), poisson
    if not hasattr(nu, "ufl_shape"):
        nu = fem.Constant(u.ufl_function_space().ufl_domain(), nu)
    mu, lam = young / (2 * (1 + nu)), young * nu / ((1 + nu) * (1 - 2 * nu))
    return 2 * mu * e + lam * ufl.tr(e) * ufl.Identity(e.ufl_shape[0])


def elasticity(
    u: Any,
    v: Any,
    young: Any,
    measure: Any = ufl.dx,
    poisson: Any = POISSON,
    strain: Any = strain,
) -> Any:
    return ufl.inner(stress(u, young, poisson, strain), strain(v)) * measure


def fixed(V: Any, facet_tags: Any, tag: int, component: int | None = None, value: Any = 0.0) -> Any:
    """Prescribe one component, or all, on the facets with a tag."""
    fdim = V.mesh.topology.dim - 1
    V.mesh.topology.create_connectivity(fdim, fdim + 1)
    space = V if component is None else V.sub(component)
    dofs = fem.locate_dofs_topological(space, fdim, facet_tags.find(tag))
    if isinstance(value, fem.Function):
        return fem.dirichletbc(value, dofs)
    if component is None and np.isscalar(value):
        value = np.full(V.mesh.geometry.dim, value, dtype=np.float64)
    return fem.dirichletbc(value, dofs, space)


def normal_forces(problem: ContactProblem) -> list[float]:
    """Return the total normal force of each contact [N]."""
    return [contact.normal_force for contact in problem.report.contacts]


def at(axis: int, value: float) -> Callable[[NDArray[np.float64]], NDArray[np.bool_]]:
    return lambda x: np.isclose(x[axis], value)


def dimension(cell: str) -> int:
    return 3 if cell in ("hexahedron", "tetrahedron") else 2


def plane(axis: int, gdim: int, level: float = 0.0) -> Plane:
    """Return the rigid half space below a level of one coordinate."""
    e = np.eye(gdim)[axis]
    return Plane(level * e, e)


# -- the scenes ----------------------------------------------------------------------------------


def beams(comm: MPI.Comm, cell: str, n: int, gap: float = 0.0, metre: float = 1.0) -> Scene:
    """Return two cantilevers, the second upon the first's end, `n` cells a metre.

    Slave is the upper beam's lower face, where it is above the lower beam. The lower beam is
    clamped, the upper one moves up and down only: semicoercive.
    """
    gdim, up = dimension(cell), dimension(cell) - 1
    low = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 1.0 + gap]])[:, [0, 2] if gdim == 2 else [0, 1, 2]]
    size, divisions = [2.0, *[1.0] * up], (2 * n, *(n,) * up)

    def overlap(height: float) -> Callable[[NDArray[np.float64]], NDArray[np.bool_]]:
        return lambda x: (
            np.isclose(x[up], metre * height) & (np.abs(x[0] / metre - 1.5) < 0.5 + 1e-9)
        )

    scene = Scene.of_boxes(
        comm,
        cell,
        [(metre * corner, metre * (corner + size), divisions) for corner in low],
        [
            (CLAMPED, at(0, 0.0), 1),
            (ROLLER, at(0, 3.0 * metre), 2),
            (LOADED, at(up, (2.0 + gap) * metre), 2),
            (LOADED, at(0, 1.0 * metre), 2),
            (SLAVE, overlap(1.0 + gap), 2),
            (MASTER, overlap(1.0), 1),
        ],
        young=YOUNG / metre**2,
    )
    support_beams(scene)
    scene.add_pair()
    return scene


def support_beams(scene: Scene) -> None:
    scene.fix(CLAMPED)
    for sideways in range(scene.gdim - 1):
        scene.fix(ROLLER, sideways)


def two_beams(
    comm: MPI.Comm, cell: str = "hexahedron", n: int = 4, gap: float = 0.0, metre: float = 1.0
) -> Scene:
    """The chapter's benchmark (sec. 11.11.1), plane strain for the cells of two dimensions.

    20 MPa downwards on 3 m2 (in 2D on 3 m) of the upper beam, which contact alone holds up.
    `n` is per metre, `metre` what a metre is in the unit of length used.
    """
    return loaded_beams(beams(comm, cell, n, gap, metre), metre)


def loaded_beams(scene: Scene, metre: float = 1.0) -> Scene:
    """Load the beams."""
    scene.traction = scene.constant(-TRACTION / metre**2)
    scene.L = scene.traction * scene.v[scene.gdim - 1] * scene.ds(LOADED)
    scene.total_forces = [3.0 * TRACTION * metre ** (scene.gdim - 3)]
    return scene


def pressed_block(
    comm: MPI.Comm, cell: str = "hexahedron", n: int = 3, approach: float = 1e-3, gap: float = 0.0
) -> Scene:
    """A unit block between symmetry planes, its top pushed down onto a rigid plane.

    The stress is uniaxial and uniform, so the exact displacement is linear in x.
    """
    gdim, up = dimension(cell), dimension(cell) - 1
    marks = [(GROUND, at(up, 0.0)), (LOADED, at(up, 1.0))]
    marks += [(SIDE_X, at(0, 0.0)), (SIDE_Y, at(1, 0.0))][:up]
    scene = Scene.of_boxes(comm, cell, [((0.0,) * gdim, (1.0,) * gdim, (n,) * gdim)], marks)
    scene.cell_tags = None
    scene.fix(LOADED, up, -approach)
    symmetric(scene)
    scene.add_obstacle(GROUND, plane(up, gdim, -gap))
    strain = max(approach - gap, 0.0)
    stiffness = YOUNG if gdim == 3 else YOUNG / (1.0 - POISSON**2)
    sideways = POISSON if gdim == 3 else POISSON / (1.0 - POISSON)

    def exact(x: NDArray[np.float64]) -> NDArray[np.float64]:
        displacement = sideways * strain * x[:gdim]
        displacement[up] = -approach + strain * (1.0 - x[up])
        return displacement

    scene.total_forces, scene.exact = [stiffness * strain], exact
    return scene


def symmetric(scene: Scene) -> None:
    """Hold SIDE_X and SIDE_Y, in three dimensions, in their planes."""
    for axis, tag in enumerate((SIDE_X, SIDE_Y)[: scene.gdim - 1]):
        scene.fix(tag, axis)


def block_on_ball(comm: MPI.Comm, cell: str = "hexahedron", n: int = 4) -> Scene:
    """The block pushed onto a rigid ball: all gaps and normals are different. No total is known."""
    scene = pressed_block(comm, cell, n, approach=1e-2)
    centre = (0.4, 0.5, -10.0) if scene.gdim == 3 else (0.4, -10.0)
    scene.contacts = []
    scene.add_obstacle(GROUND, Sphere(centre, 10.0))
    scene.exact, scene.total_forces = None, []
    return scene


def corner(comm: MPI.Comm, cell: str = "quadrilateral", n: int = 6) -> Scene:
    """The block pushed into a corner: the nodes of the edge are in two contacts."""
    scene = pressed_block(comm, cell, n)
    up, v, push = scene.gdim - 1, scene.v, scene.constant(-TRACTION)
    scene.L = push * v[up] * scene.ds(LOADED) + 0.5 * push * v[0] * scene.dx
    scene.bcs, scene.contacts = scene.bcs[2:], scene.contacts[:1]
    scene.add_obstacle(SIDE_X, plane(0, scene.gdim))
    scene.exact, scene.total_forces = None, [TRACTION, 0.5 * TRACTION]
    return scene


def two_materials(comm: MPI.Comm, cell: str = "hexahedron", n: int = 2) -> Scene:
    """The beams with all kinds of data that forms can hold.

    A DG0 Young's modulus (the lower beam softer and graded along x), a P1 traction that
    grows along y or x, a body force on the upper beam by dx(tag), and the stiffness as a sum of
    integrals over tagged cells with two quadrature degrees.
    """
    scene = beams(comm, cell, n)
    u, v, dx, up = scene.u, scene.v, scene.dx, scene.gdim - 1
    young = fem.Function(scalar_space(scene.mesh, "DG", 0))
    young.interpolate(lambda x: YOUNG * np.where(x[up] < 1.0, 0.1 + 0.1 * x[0], 1.0))
    traction = fem.Function(scalar_space(scene.mesh))
    traction.interpolate(lambda x: -TRACTION * x[0])
    finer = dx(2, metadata={"quadrature_degree": 3})
    scene.a = elasticity(u, v, young, dx(1)) + elasticity(u, v, young, finer)
    scene.L = traction * v[up] * scene.ds(LOADED) + scene.constant(-WEIGHT) * v[up] * dx(2)
    # The top carries the integral of x over [1, 3], the left face is at x = 1.
    scene.total_forces = [TRACTION * (4.0 + 1.0) + 2.0 * WEIGHT]
    return scene


def stack_on_ground(comm: MPI.Comm, cell: str = "hexahedron", n: int = 4) -> Scene:
    """Two loose blocks, one on the other, on a rigid plane: both held by contact alone.

    Symmetry planes stop them sideways; both have their weight, and the upper one carries a load on
    a quarter of its top, so that they bend and part on the other side. Two contacts, two totals.
    """
    gdim, up = dimension(cell), dimension(cell) - 1
    marks = [
        (GROUND, at(up, 0.0), 1),
        (MASTER, at(up, 1.0), 1),
        (SLAVE, at(up, 1.0), 2),
        (LOADED, lambda x: np.isclose(x[up], 2.0) & (x[0] < 0.25 + 1e-9), 2),
        *[(SIDE_X, at(0, 0.0)), (SIDE_Y, at(1, 0.0))][:up],
    ]
    low, high = np.zeros(gdim), np.ones(gdim)
    step, divisions = np.eye(gdim)[up], (n,) * gdim
    parts = [(low, high, divisions), (low + step, high + step, divisions)]
    scene = Scene.of_boxes(comm, cell, parts, marks)
    scene.L = -scene.constant(TRACTION) * scene.v[up] * scene.ds(LOADED)
    scene.L += -scene.constant(WEIGHT) * scene.v[up] * scene.dx
    symmetric(scene)
    scene.add_pair()
    scene.add_obstacle(GROUND, plane(up, gdim))
    scene.total_forces = [0.25 * TRACTION + WEIGHT, 0.25 * TRACTION + 2.0 * WEIGHT]
    return scene

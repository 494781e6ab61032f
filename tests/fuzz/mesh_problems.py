"""Random contact problems of boxes in dolfinx: meshes of all cells, forms, conditions, contacts.

`draw_mesh` makes a description that knows nothing of ranks; `pose` turns it into the package's
problem on a communicator, `glue` into the matrices of the oracle, assembled by dolfinx on one rank
without the package.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from itertools import permutations
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from glued import GluedFriction, GluedProblem, Springs, unknowns_of
from numpy.random import Generator
from numpy.typing import NDArray
from scenes import Scene, elasticity

import ufl
from dolfinx import fem
from dolfinx.fem import petsc
from dolfinx.mesh import Mesh, meshtags

from fenics_tfeti import ContactProblem, Coulomb, Deformed, Mortar, Plane, Sphere, Tresca
from fenics_tfeti.fem import _compat

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]


CELLS = {"quadrilateral": 2, "triangle": 2, "hexahedron": 3, "tetrahedron": 3}
FAR = 1e10
# end of a patch, part of the edge, between nodes: rounding must not decide where they are
PATCH = 0.61
# of the measure of springs: all components, normal, one direction
ALL, NORMAL, ALONG = 1, 2, 3


# -- the description -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Joint:
    """Box `slave` may touch box `master` by a face; axis and side of the slave's face."""

    slave: int
    master: int
    axis: int
    side: int


@dataclass(frozen=True)
class Ground:
    """A rigid obstacle at a face of a box."""

    box: int
    axis: int
    side: int
    # "plane", "sphere" (a ball far below the face), "rough" (gaps of each node by a function) or
    # "patch" (the same, with `far` where there is no obstacle)
    kind: str
    gap: float  # distance, or its size
    far: float  # 1e10 or infinite
    moved: Vector  # (gdim,), a displacement of the obstacle
    tilt: float = 0.0  # facets are tilted by angles up to this; not a sphere's


@dataclass(frozen=True)
class Support:
    """Prescribed components {component: value} on a face of a box."""

    box: int
    axis: int
    side: int
    values: dict[int, float]


@dataclass(frozen=True)
class Spring:
    """A term k u.v, k (u.n)(v.n) or k (u.d)(v.d) on a face of a box."""

    box: int
    axis: int
    side: int
    kind: int
    stiffness: float


@dataclass(frozen=True)
class Rubbing:
    """Friction at a contact."""

    law: str  # "Tresca" or "Coulomb"
    value: float  # slip bound [Pa], or coefficient
    part: float  # of the face that has friction, as a function of points; 1 is a number
    moved: Vector  # (gdim,), displacement of the obstacle; zero for pairs


@dataclass
class MeshProblem:
    """A description; lengths in metres of the problem's own."""

    cell: str
    divisions: int
    lower: Vector  # (boxes, gdim)
    edges: Vector  # (gdim,)
    young: Vector  # (boxes,)
    jump: float  # factor of Young's modulus in every second cell
    poisson: float
    joints: list[Joint] = field(default_factory=list)
    grounds: list[Ground] = field(default_factory=list)
    supports: list[Support] = field(default_factory=list)
    springs: list[Spring] = field(default_factory=list)
    direction: Vector = field(default_factory=lambda: np.zeros(0))
    tractions: list[tuple[int, int, int, Vector]] = field(default_factory=list)
    weights: Vector = field(default_factory=lambda: np.zeros(0))  # (boxes, gdim)
    options: dict[str, Any] = field(default_factory=dict)
    gaps: Deformed | None = None
    story: list[str] = field(default_factory=list)
    friction: dict[int, Rubbing] = field(default_factory=dict)  # by contact
    pairing: dict[int, dict[str, Any]] = field(default_factory=dict)  # arguments, by joint
    degree: int = 1
    slider: int | None = None  # a box that only a contact with tilted facets holds, the last one

    @property
    def gdim(self) -> int:
        return CELLS[self.cell]

    @property
    def intervals(self) -> int:
        """Number of intervals between the nodes of an edge."""
        return self.degree * self.divisions

    def faces(self) -> list[tuple[int, int, int]]:
        """Return box, axis and side of the slave of each contact."""
        joints = [(j.slave, j.axis, j.side) for j in self.joints]
        return joints + [(g.box, g.axis, g.side) for g in self.grounds]


def draw_mesh(seed: int) -> MeshProblem:
    """Draw the problem of a seed."""
    rng = np.random.default_rng([seed, 2])
    cell = str(rng.choice(list(CELLS)))
    gdim = CELLS[cell]
    n = int(rng.integers(1, 6) if gdim == 2 else rng.integers(1, 4))
    count = int(rng.integers(1, 6 if gdim == 2 else 4))
    while count > 1 and count * gdim * (n + 1) ** gdim > 600:
        count -= 1
    metre, modulus = 10.0 ** rng.uniform(-6, 3), 10.0 ** rng.uniform(-6, 12)
    if rng.random() < 0.4:
        metre, modulus = 1.0, 2.1e11
    strain = 10.0 ** rng.uniform(-9, -1)
    edges = metre * 2.0 ** rng.uniform(-1, 1, gdim)
    unit = strain * float(edges.max())
    lower, joints = _stack(rng, count, edges, unit)
    young = modulus * (10.0 ** rng.uniform(-6, 0, count) if rng.random() < 0.4 else np.ones(count))
    problem = MeshProblem(
        cell=cell,
        divisions=n,
        lower=lower,
        edges=edges,
        young=young,
        jump=float(10.0 ** rng.uniform(-4, 0)) if rng.random() < 0.2 else 1.0,
        poisson=float(rng.choice([0.0, 0.3, 0.45])),
        joints=joints,
        direction=_unit(rng.normal(size=gdim)),
        weights=np.zeros((count, gdim)),
    )
    moved = unit * 10.0 ** rng.uniform(0, 4) * rng.normal(size=gdim) * (rng.random() < 0.15)
    _hold(problem, rng, unit, moved)
    _load(problem, rng, strain)
    problem.options = {
        "rtol": float(10.0 ** rng.uniform(-8, -2)) if rng.random() < 0.7 else 1e-6,
        "subdomain_size": int(rng.choice([30, 60, 100, 3000])),
        "partitioner": str(rng.choice(["auto", "scotch", "scotch"])),
        "method": str(rng.choice(["active_set"] * 4 + ["smalbe"])),
        "preconditioner": str(rng.choice(["lumped", "lumped", "dirichlet", "none"])),
        "scaling": str(rng.choice(["stiffness"] * 4 + ["multiplicity"])),
    }
    if rng.random() < 0.3:
        problem.options["partitioner"] = "slabs"
    problem.story = [
        f"{count} boxes of {cell}, {n} elements an edge, edges {edges}",
        f"strain {strain:.1e}, Young's moduli {young}, jump {problem.jump:.1e}",
        *(str(part) for part in (*joints, *problem.grounds, *problem.supports, *problem.springs)),
        f"tractions {problem.tractions}",
        f"weights {problem.weights.tolist()}",
        f"everything moved by {moved}",
        f"options {problem.options}",
    ]
    return problem


def _unit(vector: Vector) -> Vector:
    return vector / np.linalg.norm(vector)


def _stack(rng: Generator, count: int, edges: Vector, unit: float) -> tuple[Vector, list[Joint]]:
    """Put boxes next to each other as a tree; a gap moves a box along the axis of its joint."""
    gdim = edges.size
    places = [np.zeros(gdim, dtype=int)]
    lower = [np.zeros(gdim)]
    joints = []
    while len(places) < count:
        parent = int(rng.integers(len(places))) if rng.random() < 0.5 else len(places) - 1
        axis, side = int(rng.integers(gdim)), int(rng.choice([-1, 1]))
        step = side * np.eye(gdim, dtype=int)[axis]
        place = places[parent] + step
        # boxes meet by one joint only: others would be off by the gaps
        if any(np.abs(place - other).sum() < 2 for k, other in enumerate(places) if k != parent):
            if rng.random() < 0.1:
                break
            continue
        kind = rng.choice(["zero", "open", "closed", "wide"], p=[0.5, 0.25, 0.15, 0.1])
        amount = {
            "zero": 0.0,
            "open": unit * rng.random(),
            "closed": -unit * rng.random(),
            "wide": unit * 10.0 ** rng.uniform(0, 1.5),
        }[str(kind)]
        child = len(places)
        places.append(place)
        lower.append(lower[parent] + step * (edges + amount))
        if rng.random() < 0.9:
            if rng.random() < 0.5:
                joints.append(Joint(child, parent, axis, -side))
            else:
                joints.append(Joint(parent, child, axis, side))
    return np.array(lower), joints


def _free_faces(problem: MeshProblem, box: int) -> list[tuple[int, int]]:
    used = {(j.slave, j.axis, j.side) for j in problem.joints}
    used |= {(j.master, j.axis, -j.side) for j in problem.joints}
    used |= {(part.box, part.axis, part.side) for part in (*problem.grounds, *problem.supports)}
    return [
        (axis, side)
        for axis in range(problem.gdim)
        for side in (-1, 1)
        if (box, axis, side) not in used
    ]


def _hold(problem: MeshProblem, rng: Generator, unit: float, moved: Vector) -> None:
    """Draw supports, springs and obstacles of every box."""
    gdim, count = problem.gdim, len(problem.lower)
    for box in range(count):
        kind = rng.choice(
            ["clamp", "rollers", "spring", "component", "free"], p=[0.4, 0.2, 0.15, 0.1, 0.15]
        )
        faces = _free_faces(problem, box)
        offset = moved + unit * rng.normal(size=gdim) * (rng.random() < 0.4)
        if kind in ("clamp", "component") and faces:
            axis, side = faces[rng.integers(len(faces))]
            components = range(gdim) if kind == "clamp" else [int(rng.integers(gdim))]
            values = {int(c): float(offset[c]) for c in components}
            problem.supports.append(Support(box, axis, side, values))
        elif kind == "rollers":
            for axis in range(gdim):
                own = [f for f in _free_faces(problem, box) if f[0] == axis]
                if own:
                    values = {axis: float(offset[axis])}
                    problem.supports.append(
                        Support(box, axis, own[rng.integers(len(own))][1], values)
                    )
        if (kind == "spring" or rng.random() < 0.05) and not moved.any():
            axis, side = int(rng.integers(gdim)), int(rng.choice([-1, 1]))
            exponent = rng.uniform(-9, 2) if rng.random() < 0.8 else rng.uniform(-12, 3)
            k = problem.young[box] / problem.edges.max() * 10.0**exponent
            problem.springs.append(Spring(box, axis, side, int(rng.integers(1, 4)), float(k)))
        faces = _free_faces(problem, box)
        while faces and rng.random() < 0.3:
            axis, side = faces[rng.integers(len(faces))]
            problem.grounds.append(
                Ground(
                    box,
                    axis,
                    side,
                    str(rng.choice(["plane", "sphere", "rough", "patch"])),
                    float(
                        unit
                        * rng.choice([0.0, 1.0, -0.3, 1e3], p=[0.5, 0.25, 0.15, 0.1])
                        * rng.random()
                    ),
                    float(rng.choice([FAR, np.inf])),
                    moved.copy(),
                )
            )
            faces = _free_faces(problem, box)


def _load(problem: MeshProblem, rng: Generator, strain: float) -> None:
    """Draw tractions and body forces; boxes that nothing holds are pushed against a contact."""
    gdim = problem.gdim
    held = {s.box for s in problem.supports if len(s.values) == gdim}
    for box in range(len(problem.lower)):
        stress = strain * problem.young[box]
        towards = [
            side * np.eye(gdim)[axis]
            for axis, side in [
                *((j.axis, j.side) for j in problem.joints if j.slave == box),
                *((j.axis, -j.side) for j in problem.joints if j.master == box),
                *((g.axis, g.side) for g in problem.grounds if g.box == box),
            ]
        ]
        if box not in held and towards and rng.random() < 0.8:
            push = towards[rng.integers(len(towards))]
            problem.weights[box] = stress / problem.edges.max() * push * rng.random()
            continue
        choice = rng.random()
        if choice < 0.35:
            axis, side = int(rng.integers(gdim)), int(rng.choice([-1, 1]))
            problem.tractions.append((box, axis, side, stress * rng.normal(size=gdim)))
        elif choice < 0.7:
            problem.weights[box] = stress / problem.edges.max() * rng.normal(size=gdim)


# -- in dolfinx ------------------------------------------------------------------------------------


def _face_tag(problem: MeshProblem, box: int, axis: int, side: int) -> int:
    return 1 + 2 * (problem.gdim * box + axis) + (side > 0)


def _level(problem: MeshProblem, box: int, axis: int, side: int) -> float:
    return float(problem.lower[box, axis] + (problem.edges[axis] if side > 0 else 0.0))


def _set_up(problem: MeshProblem, comm: MPI.Comm) -> Scene:
    """Return mesh, elastic form, load and supports on a communicator; faces have tags."""
    gdim, n = problem.gdim, problem.divisions
    parts = [(low, low + problem.edges, (n,) * gdim) for low in problem.lower]
    near = 1e-3 * float(problem.edges.min()) / n
    marks = []
    for box, axis, side in itertools.product(range(len(parts)), range(gdim), (-1, 1)):
        level = _level(problem, box, axis, side)
        marks.append(
            (
                _face_tag(problem, box, axis, side),
                lambda x, axis=axis, level=level: np.abs(x[axis] - level) < near,
                box + 1,
            )
        )
    scene = Scene.of_boxes(comm, problem.cell, parts, marks, degree=problem.degree)
    young, weight = _constant_in_cells(scene), _constant_in_cells(scene, gdim)
    _fill(problem, scene.cell_tags, young, weight)
    poisson = scene.constant(problem.poisson)
    scene.a = elasticity(scene.u, scene.v, young, poisson=poisson)
    traction_tags, traction = _tractions(problem, scene)
    over = ufl.Measure("ds", domain=scene.mesh, subdomain_data=traction_tags)
    scene.L = ufl.inner(weight, scene.v) * ufl.dx
    if problem.tractions:
        scene.L += ufl.inner(traction, scene.v) * over(1)
    for s in problem.supports:
        for component, value in s.values.items():
            scene.fix(_face_tag(problem, s.box, s.axis, s.side), component, value)
    return scene


def _springs(problem: MeshProblem, scene: Scene) -> list[Any]:
    """Return a form for each kind of spring."""
    tags, k = _spring_tags(problem, scene)
    u, v, normal = scene.u, scene.v, ufl.FacetNormal(scene.mesh)
    along = scene.constant(problem.direction)
    terms = {
        ALL: k * ufl.inner(u, v),
        NORMAL: k * ufl.inner(u, normal) * ufl.inner(v, normal),
        ALONG: k * ufl.inner(u, along) * ufl.inner(v, along),
    }
    on = ufl.Measure("ds", domain=scene.mesh, subdomain_data=tags)
    return [terms[kind] * on(kind) for kind in sorted({s.kind for s in problem.springs})]


def _constant_in_cells(scene: Scene, components: int = 0) -> Any:
    return fem.Function(_compat.lagrange_space(scene.mesh, 0, components, discontinuous=True))


def _fill(problem: MeshProblem, cell_tags: Any, young: Any, weight: Any) -> None:
    """Set Young's modulus and the body force cell by cell; every second layer has the jump."""
    gdim = problem.gdim
    middle = young.function_space.tabulate_dof_coordinates()
    for box, low in enumerate(problem.lower):
        cells = cell_tags.find(box + 1)
        layer = np.floor((middle[cells, 0] - low[0]) / problem.edges[0] * problem.divisions)
        young.x.array[cells] = problem.young[box] * np.where(layer % 2, problem.jump, 1.0)
        for c in range(gdim):
            weight.x.array[gdim * cells + c] = problem.weights[box, c]
    young.x.scatter_forward()
    weight.x.scatter_forward()


def _cell_of_facets(mesh: Mesh, facets: NDArray[np.int32]) -> NDArray[np.int32]:
    dim = mesh.topology.dim
    mesh.topology.create_connectivity(dim - 1, dim)
    to_cells = mesh.topology.connectivity(dim - 1, dim)
    return to_cells.array[to_cells.offsets[facets]]


def _tags(mesh: Mesh, facets: list[NDArray[np.int32]], values: list[int]) -> Any:
    every = np.concatenate([np.zeros(0, dtype=np.int32), *facets])
    marks = np.concatenate(
        [
            np.zeros(0, dtype=np.int32),
            *(np.full(f.size, v, np.int32) for f, v in zip(facets, values, strict=True)),
        ]
    )
    order = np.argsort(every)
    return meshtags(mesh, mesh.topology.dim - 1, every[order], marks[order])


def _spring_tags(problem: MeshProblem, scene: Scene) -> tuple[Any, Any]:
    """Return tags of the facets by kind, and the stiffness as a function of cells."""
    k = _constant_in_cells(scene)
    facets, kinds = [], []
    for spring in problem.springs:
        found = scene.facet_tags.find(_face_tag(problem, spring.box, spring.axis, spring.side))
        k.x.array[_cell_of_facets(scene.mesh, found)] = spring.stiffness
        facets.append(found)
        kinds.append(spring.kind)
    k.x.scatter_forward()
    return _tags(scene.mesh, facets, kinds), k


def _tractions(problem: MeshProblem, scene: Scene) -> tuple[Any, Any]:
    gdim = problem.gdim
    traction = _constant_in_cells(scene, gdim)
    facets = []
    for box, axis, side, value in problem.tractions:
        found = scene.facet_tags.find(_face_tag(problem, box, axis, side))
        cells = _cell_of_facets(scene.mesh, found)
        for c in range(gdim):
            traction.x.array[gdim * cells + c] = value[c]
        facets.append(found)
    traction.x.scatter_forward()
    return _tags(scene.mesh, facets, [1] * len(facets)), traction


def _outward(problem: MeshProblem, axis: int, side: int) -> Vector:
    return side * np.eye(problem.gdim)[axis]


def _radius(problem: MeshProblem) -> float:
    return 50.0 * float(problem.edges.max())


def ground_function(problem: MeshProblem, ground: Ground) -> Any:
    """Return the obstacle as a function of points, or one of the package's."""
    gdim, out = problem.gdim, _outward(problem, ground.axis, ground.side)
    level = _level(problem, ground.box, ground.axis, ground.side)
    middle = problem.lower[ground.box] + 0.5 * problem.edges
    point = middle.copy()
    point[ground.axis] = level
    point = point + out * ground.gap + ground.moved
    if ground.kind == "plane" and not ground.tilt:
        return Plane(point, -out)
    if ground.kind == "sphere":
        return Sphere(point + _radius(problem) * out, _radius(problem))

    def rough(x: Vector) -> tuple[Vector, Vector]:
        place = (x[:gdim].T - problem.lower[ground.box]) / problem.edges
        wave = 1.0 + 0.5 * np.sin(7.0 * place.sum(axis=1))
        gap = ground.gap * wave + out @ ground.moved
        if ground.kind == "plane":
            gap = np.full(len(place), ground.gap + out @ ground.moved)
        if ground.kind == "patch":
            gap = np.where(place[:, (ground.axis + 1) % gdim] < PATCH, gap, ground.far)
        if problem.gaps is not None:
            gap = gap + ground.side * (level - x[ground.axis])
        return gap, _tilted(-out, ground, place).T

    return rough


def _tilted(normal: Vector, ground: Ground, place: Vector) -> Vector:
    """Return unit normals (k, gdim) near one of them, which tilt along the surface."""
    gdim = normal.size
    tilted = np.tile(normal, (len(place), 1))
    for k in range(gdim):
        if k != ground.axis:
            tilted[:, k] += ground.tilt * np.cos(11.0 * place.sum(axis=1) + 2.0 * k)
    return tilted / np.linalg.norm(tilted, axis=1)[:, None]


def _law(problem: MeshProblem, contact: int) -> Tresca | Coulomb | None:
    """Return the law of friction of a contact as the package gets it."""
    rubbing = problem.friction.get(contact)
    if rubbing is None:
        return None
    value: Any = rubbing.value
    if rubbing.part < 1.0:
        value = lambda x: _values(problem, contact, x)  # noqa: E731
    return Tresca(value) if rubbing.law == "Tresca" else Coulomb(value)


def _values(problem: MeshProblem, contact: int, x: Vector) -> Vector:
    """Return slip bounds or coefficients at points (3, k)."""
    rubbing, (box, axis, _) = problem.friction[contact], problem.faces()[contact]
    along = (axis + 1) % problem.gdim
    place = (x[along] - problem.lower[box, along]) / problem.edges[along]
    return rubbing.value * ((place < rubbing.part) | (rubbing.part == 1.0))


def pose(problem: MeshProblem, comm: MPI.Comm) -> tuple[ContactProblem, Scene]:
    """Return the package's problem on a communicator. Collective."""
    scene = _set_up(problem, comm)
    for number, j in enumerate(problem.joints):
        scene.add_pair(
            slave=_face_tag(problem, j.slave, j.axis, j.side),
            master=_face_tag(problem, j.master, j.axis, -j.side),
            friction=_law(problem, number),
            **problem.pairing.get(number, {}),
        )
    for number, g in enumerate(problem.grounds, start=len(problem.joints)):
        rubbing = problem.friction.get(number)
        scene.add_obstacle(
            _face_tag(problem, g.box, g.axis, g.side),
            ground_function(problem, g),
            friction=_law(problem, number),
            displacement=None if rubbing is None else rubbing.moved,
        )
    scene.a = sum(_springs(problem, scene), scene.a)
    return scene.problem(gaps=problem.gaps, options=problem.options), scene


# -- for the oracle --------------------------------------------------------------------------------


def node_numbers(problem: MeshProblem, V: Any, cell_tags: Any) -> Numbers:
    """Return the number of each local node of V: box by box, lattice point by lattice point.

    It is -1 for nodes of no cell that this rank knows.
    """
    gdim = problem.gdim
    x = V.tabulate_dof_coordinates()[:, :gdim]
    numbers = np.full(len(x), -1, dtype=np.int64)
    for box in range(len(problem.lower)):
        cells = cell_tags.find(box + 1)
        nodes = np.unique(
            np.concatenate([np.zeros(0, int), *(V.dofmap.cell_dofs(int(c)) for c in cells)])
        )
        numbers[nodes] = lattice_numbers(problem, box, x[nodes])
    return numbers


def lattice_numbers(problem: MeshProblem, box: int, x: Vector) -> Numbers:
    """Return the numbers of nodes of a box at given places (k, gdim)."""
    n, gdim = problem.intervals, problem.gdim
    place = np.rint((x[:, :gdim] - problem.lower[box]) / problem.edges * n).astype(np.int64)
    strides = (n + 1) ** np.arange(gdim)
    return box * (n + 1) ** gdim + place @ strides


def _face_nodes(problem: MeshProblem, box: int, axis: int, side: int) -> Numbers:
    n, gdim = problem.intervals, problem.gdim
    number = np.arange((n + 1) ** gdim)
    level = number // (n + 1) ** axis % (n + 1)
    return box * (n + 1) ** gdim + number[level == (n if side > 0 else 0)]


def _vertices(problem: MeshProblem, nodes: Numbers) -> NDArray[np.bool_]:
    """Tell which nodes are vertices of cells."""
    n, gdim = problem.intervals, problem.gdim
    places = nodes[:, None] // (n + 1) ** np.arange(gdim) % (n + 1)
    vertices: NDArray[np.bool_] = (places % problem.degree == 0).all(axis=1)
    return vertices


@dataclass(frozen=True)
class SlaveNodes:
    """The nodes of a contact's slave, in the order of the oracle's rows."""

    problem: MeshProblem
    box: int
    nodes: Numbers

    def number(self, coordinates: Vector) -> Numbers:
        """Return the numbers of nodes at given places (k, 3)."""
        return lattice_numbers(self.problem, self.box, coordinates)


def contact_places(problem: MeshProblem, exchanged: list[bool]) -> list[SlaveNodes]:
    """Return the slave nodes of each contact, where roles are exchanged those of the master."""
    faces = problem.faces()
    for number, j in enumerate(problem.joints):
        if exchanged[number]:
            faces[number] = (j.master, j.axis, -j.side)
    places = []
    for number, face in enumerate(faces):
        nodes = _face_nodes(problem, *face)
        nodes = nodes[_vertices(problem, nodes)]
        places.append(SlaveNodes(problem, face[0], nodes[~_held(problem, number, face, nodes)]))
    return places


def keep_held_roles(problem: MeshProblem) -> None:
    """Leave roles as given where supports hold nodes of a joint, of which the conditions depend."""
    for number, j in enumerate(problem.joints):
        faces = (j.slave, j.axis, j.side), (j.master, j.axis, -j.side)
        if any(_held(problem, number, f, _face_nodes(problem, *f)).any() for f in faces):
            problem.pairing.setdefault(number, {"partners": None})["roles"] = "given"


def _held(problem: MeshProblem, contact: int, face: tuple[int, int, int], nodes: Numbers) -> Any:
    """Tell at which nodes of a face a support of another face holds the normal displacement.

    They have no mortar condition, but one with an obstacle, or with the node opposite.
    """
    box, axis, side = face
    held = np.zeros(nodes.size, dtype=bool)
    asked = problem.pairing.get(contact, {}).get("partners") == Mortar()
    if contact >= len(problem.joints) or not (problem.degree == 2 or asked):
        return held
    for s in problem.supports:
        if s.box == box and axis in s.values and (s.axis, s.side) != (axis, side):
            held |= np.isin(nodes, _face_nodes(problem, s.box, s.axis, s.side))
    return held


def tangents(problem: MeshProblem, contact: int, x: Vector) -> Vector:
    """Return orthonormal tangents (k, gdim - 1, gdim) at slave nodes (k, gdim) of a contact."""
    gdim, (_, axis, side) = problem.gdim, problem.faces()[contact]
    normal = np.tile(_outward(problem, axis, side), (len(x), 1))
    ground = contact - len(problem.joints)
    if ground >= 0:
        normal = -_gap_and_normal(problem, problem.grounds[ground], x)[1]
    if gdim == 2:
        return np.column_stack([-normal[:, 1], normal[:, 0]])[:, None]
    # nearly tangential: obstacles are nearly parallel to the face
    first = np.eye(3)[(axis + 1) % 3] - normal[:, (axis + 1) % 3, None] * normal
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(normal, first)], axis=1)


def _gap_and_normal(problem: MeshProblem, ground: Ground, x: Vector) -> tuple[Vector, Vector]:
    """Return gaps (k,) and normals (k, gdim) of an obstacle at points (k, gdim)."""
    points = np.zeros((3, len(x)))
    points[: problem.gdim] = x.T
    gap, normal = ground_function(problem, ground)(points)
    return np.asarray(gap), np.asarray(normal)[: problem.gdim].T


def _matrix(form: Any, order: Numbers) -> sp.csr_matrix:
    matrix = petsc.assemble_matrix(fem.form(form))
    matrix.assemble()
    indptr, indices, data = matrix.getValuesCSR()
    K = sp.csr_matrix((data, indices, indptr), shape=matrix.getSize())
    K = K[order][:, order]
    return (0.5 * (K + K.T)).tocsr()


def glue(problem: MeshProblem) -> GluedProblem:
    """Return the matrices of a problem, assembled on one rank without the package's solver."""
    posed = _set_up(problem, MPI.COMM_SELF)
    gdim, V = problem.gdim, posed.V
    number = node_numbers(problem, V, posed.cell_tags)
    node = np.argsort(number)
    order = unknowns_of(node, gdim)
    coordinates = V.tabulate_dof_coordinates()[node, :gdim]
    load = petsc.assemble_vector(fem.form(posed.L)).array[order].copy()
    unknowns = load.size

    fixed: dict[int, float] = {}
    for s in problem.supports:
        for i in _face_nodes(problem, s.box, s.axis, s.side):
            for component, value in s.values.items():
                fixed[gdim * int(i) + component] = value
    where = np.array(sorted(fixed), dtype=np.int64)
    weights = [_weights(problem, posed, number, *face) for face in enumerate(problem.faces())]
    rows, gap, contact = _rows(problem, coordinates, weights)
    springs = (
        _spring_rows(problem, posed, order)
        if problem.springs
        else Springs(sp.csr_matrix((0, unknowns)), np.zeros(0))
    )
    return GluedProblem(
        coordinates,
        np.sort(number) // (problem.intervals + 1) ** gdim,
        _matrix(posed.a, order),
        springs,
        load,
        where,
        np.array([fixed[int(i)] for i in where]),
        rows,
        gap,
        contact,
        gap_rounding=_gap_rounding(problem, coordinates, contact),
        friction=_friction(problem, coordinates, contact, weights),
    )


@dataclass(frozen=True)
class _Weights:
    """The conditions of a face."""

    slave: Numbers  # (k,), the nodes that have a condition, of those of the face
    # (k, nodes of the face), the means of which they are: of sum 1, of degree 1 the identity
    mean: sp.csr_matrix
    area: Vector  # (k,), the area that belongs to each


# integrals of dual functions times shape functions of degree 2: on the unit interval, and on a
# triangle of area 1 the one of a vertex times those of it, another one, edges at it, the other edge
_ON_INTERVAL = np.array([[2.0, 2.0, -1.0], [-1.0, 2.0, 2.0]]) / 6.0
_ON_TRIANGLE = np.array([2.0, -1.0, 3.0, -1.0]) / 15.0


def _weights(
    problem: MeshProblem, posed: Scene, number: Numbers, contact: int, face: tuple[int, int, int]
) -> _Weights:
    """Integrate the multipliers of a face: at nodes, or dual functions at the vertices.

    Those of vertices that a support holds are added, in equal shares, to those beside them.
    """
    gdim, step = problem.gdim, problem.intervals + 1
    box, axis, side = face
    nodes = _face_nodes(problem, box, axis, side)
    rows, columns, values, ends = [], [], [], []
    others = [k for k in range(gdim) if k != axis]
    facets = posed.facet_tags.find(_face_tag(problem, box, axis, side))
    size = np.prod(problem.edges[others] / problem.divisions)
    for cell in _cell_of_facets(posed.mesh, facets):
        local = number[posed.V.dofmap.cell_dofs(int(cell))]
        local = local[np.isin(local, nodes)]
        place = local[:, None] // step ** np.array(others) % step
        vertex = np.flatnonzero((place % problem.degree == 0).all(axis=1))
        ends.extend(permutations(local[vertex], 2))
        block = _dual_block(problem, place, vertex) * size
        rows.append(np.repeat(local[vertex], local.size))
        columns.append(np.tile(local, vertex.size))
        values.append(block.ravel())
    slave = nodes[_vertices(problem, nodes)]
    matrix = sp.csr_matrix(
        (
            np.concatenate(values),
            (
                np.searchsorted(slave, np.concatenate(rows)),
                np.searchsorted(nodes, np.concatenate(columns)),
            ),
        ),
        shape=(slave.size, nodes.size),
    )
    held = _held(problem, contact, face, slave)
    j, k = np.unique(np.searchsorted(slave, np.array(ends)), axis=0).T
    given = held[j] & ~held[k]
    shares = sp.csr_matrix(
        (1.0 / np.bincount(j[given])[j[given]], (k[given], j[given])), 2 * held.shape
    )
    matrix, slave = ((sp.identity(held.size) + shares) @ matrix)[~held], slave[~held]
    area = np.asarray(matrix.sum(axis=1)).ravel()
    return _Weights(slave, (sp.diags(1.0 / area) @ matrix).tocsr(), area)


def _dual_block(problem: MeshProblem, place: Numbers, vertex: Numbers) -> Vector:
    """Return the integrals over a facet, for cells of edge 1, from the places of its nodes."""
    simplex = problem.cell == "tetrahedron"
    if problem.degree == 1:
        whole = 0.5 if simplex else 1.0
        return whole / vertex.size * np.eye(vertex.size)
    if not simplex:
        lower = place - place.min(axis=0)
        factors = [
            _ON_INTERVAL[lower[vertex, k][:, None] // 2, lower[:, k]] for k in range(place.shape[1])
        ]
        return np.prod(factors, axis=0)
    # a node between two vertices has half the sum of their places
    block = np.zeros((3, 6))
    for i, v in enumerate(vertex):
        for j, there in enumerate(place):
            if j in vertex:
                kind = 0 if j == v else 1
            else:
                ends = [2 * there - place[v] - place[w] for w in vertex if w != v]
                kind = 2 if any(not end.any() for end in ends) else 3
            block[i, j] = 0.5 * _ON_TRIANGLE[kind]
    return block


def _friction(
    problem: MeshProblem, x: Vector, contact: Numbers, weights: list[_Weights]
) -> GluedFriction | None:
    """Return friction at all conditions of the contacts that have it."""
    if not problem.friction:
        return None
    gdim = problem.gdim
    row, rows, before, bound, coefficient = [], [], [], [], []
    for number, rubbing in sorted(problem.friction.items()):
        of_face = weights[number]
        along = tangents(problem, number, x[of_face.slave])
        rows.append(_condition_rows(problem, number, of_face, along, x.size))
        points = np.zeros((3, of_face.slave.size))
        points[:gdim] = x[of_face.slave].T
        values, zero = _values(problem, number, points), np.zeros(of_face.slave.size)
        given = rubbing.law == "Tresca"
        row.append(np.flatnonzero(contact == number))
        before.append(along @ rubbing.moved)
        bound.append(values * of_face.area if given else zero)
        coefficient.append(zero if given else values)
    return GluedFriction(
        np.concatenate(row),
        sp.vstack(rows, format="csr"),
        np.concatenate(before),
        np.concatenate(bound),
        np.concatenate(coefficient),
    )


def penetrations(problem: MeshProblem, deformed: Vector) -> Vector:
    """Return the depths of deformed slave nodes in obstacles, of degree 1, and in masters.

    Those in masters are known in the plane, with displacements of degree 1. Mortar conditions are
    on means: where surfaces of straight facets are bent, nodes are as deep as the facets deviate.
    Nodes that supports hold have none there.
    """
    depths = [np.zeros(1)]
    for number, face in enumerate(problem.faces()):
        nodes = _face_nodes(problem, *face)
        nodes = nodes[~_held(problem, number, face, nodes)]
        slave, ground = deformed[nodes], number - len(problem.joints)
        if problem.degree > 1:
            continue
        if ground >= 0:
            depths.append(-_gap_and_normal(problem, problem.grounds[ground], slave)[0])
        elif problem.gdim == 2:
            joint = problem.joints[number]
            master = deformed[_face_nodes(problem, joint.master, joint.axis, -joint.side)]
            along, across = master[:, 1 - joint.axis], master[:, joint.axis]
            if (np.diff(along) <= 0.0).any():
                continue
            level = np.interp(slave[:, 1 - joint.axis], along, across, np.nan, np.nan)
            # less where the master is inclined
            slope = np.abs(np.diff(across) / np.diff(along)).max()
            depth = joint.side * (slave[:, joint.axis] - level) / np.sqrt(1.0 + slope**2)
            if problem.pairing.get(number, {}).get("partners") == Mortar():
                curves = master, deformed[_face_nodes(problem, *face)]
                depth -= max(_deviation(x[:, [1 - joint.axis, joint.axis]]) for x in curves)
            depths.append(depth[np.isfinite(depth)])
    return np.concatenate(depths)


def _deviation(curve: Vector) -> float:
    """Return how far the straight lines between the points (n, 2) of a curve are from it."""
    along, across = curve.T
    bends = np.abs(np.diff(np.diff(across) / np.diff(along)))
    return float((bends * np.abs(along[2:] - along[:-2])).max(initial=0.0)) / 8.0


def _condition_rows(
    problem: MeshProblem, contact: int, weights: _Weights, directions: Vector, size: int
) -> sp.csr_matrix:
    """Return the rows of conditions along directions (k, d, gdim): slave minus master."""
    box, axis, side = problem.faces()[contact]
    mean, (k, d, gdim) = weights.mean.tocoo(), directions.shape
    sides = [(_face_nodes(problem, box, axis, side), 1.0)]
    if contact < len(problem.joints):
        master = problem.joints[contact].master
        sides.append((_face_nodes(problem, master, axis, -side), -1.0))
    rows = sp.csr_matrix((k * d, size))
    for nodes, sign in sides:
        values = sign * mean.data[:, None, None] * directions[mean.row]
        row = d * mean.row[:, None, None] + np.arange(d)[:, None]
        column = gdim * nodes[mean.col][:, None, None] + np.arange(gdim)
        row, column = (np.broadcast_to(each, values.shape).ravel() for each in (row, column))
        rows = rows + sp.csr_matrix((values.ravel(), (row, column)), shape=rows.shape)
    return rows


def _spring_rows(problem: MeshProblem, posed: Scene, order: Numbers) -> Springs:
    """Return the springs as rows: the eigenvectors of their matrix, box by box."""
    first, *others = _springs(problem, posed)
    K = _matrix(sum(others, first), order)
    per_box = K.shape[0] // len(problem.lower)
    rows, stiffness = [], []
    for box in range(len(problem.lower)):
        at = np.arange(box * per_box, (box + 1) * per_box)
        values, vectors = np.linalg.eigh(K[at][:, at].toarray())
        kept = values > 1e-12 * max(values.max(), 0.0)
        rows.append(
            sp.csr_matrix(
                (
                    vectors[:, kept].T.ravel(),
                    (np.repeat(np.arange(kept.sum()), at.size), np.tile(at, kept.sum())),
                ),
                shape=(kept.sum(), K.shape[0]),
            )
        )
        stiffness.append(values[kept])
    return Springs(sp.vstack(rows, format="csr"), np.concatenate(stiffness))


def _gap_rounding(problem: MeshProblem, x: Vector, contact: Numbers) -> Vector:
    """Return the rounding errors of gaps: those of coordinates, for spheres of the radius."""
    sizes = [np.abs(x).max()] * len(problem.joints)
    sizes += [
        np.abs(x).max() + np.abs(g.moved).max() + (_radius(problem) if g.kind == "sphere" else 0.0)
        for g in problem.grounds
    ]
    return 4.0 * np.finfo(float).eps * np.array([0.0, *sizes])[contact + 1]


def _rows(
    problem: MeshProblem, x: Vector, weights: list[_Weights]
) -> tuple[sp.csr_matrix, Vector, Numbers]:
    """Return C, the gaps and the contacts' numbers, from the lattice alone."""
    C, gaps, contact = [], [np.zeros(0)], [np.zeros(0, dtype=np.int64)]
    for number, ((box, axis, side), of_face) in enumerate(
        zip(problem.faces(), weights, strict=True)
    ):
        nodes, ground = _face_nodes(problem, box, axis, side), number - len(problem.joints)
        if ground < 0:
            normal = np.tile(_outward(problem, axis, side), (of_face.slave.size, 1))
            master = _face_nodes(problem, problem.joints[number].master, axis, -side)
            gap = (x[master] - x[nodes]) @ normal[0]
        else:
            g = problem.grounds[ground]
            gap = _gap_and_normal(problem, g, x[nodes])[0]
            normal = -_gap_and_normal(problem, g, x[of_face.slave])[1]
        C.append(_condition_rows(problem, number, of_face, normal[:, None], x.size))
        # infinite gaps, of obstacles of degree 1, have no mean: all nodes have their own conditions
        gaps.append(of_face.mean @ gap if problem.degree > 1 or ground < 0 else gap)
        contact.append(np.full(of_face.slave.size, number, dtype=np.int64))
    rows = sp.vstack(C, format="csr") if C else sp.csr_matrix((0, x.size))
    return rows, np.concatenate(gaps), np.concatenate(contact)

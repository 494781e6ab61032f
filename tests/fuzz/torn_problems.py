"""Random torn systems: bodies of boxes on a lattice, without dolfinx.

A seed determines everything. The draws are biased towards problems that have a solution: bodies
that nothing holds get the load that some contact pressures would balance, with probability 0.85.
"""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from glued import GluedFriction, GluedProblem, Springs, rigid_modes, unknowns_of
from lattice import box_stiffness, lattice_points
from numpy.random import Generator
from numpy.typing import NDArray

from fenics_tfeti.feti import ContactRows, Friction, Prescribed, Subdomain, TornSystem

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
Place = tuple[int, ...]


MAX_UNKNOWNS = 600
FAR = 1e10
# springs softer than this have no friction beside them: the oracle for friction is less accurate
SOFT = 1e-5


@dataclass(frozen=True)
class TornProblem:
    """A problem as it is torn, and as a whole."""

    subdomains: list[Subdomain]  # all of them; nodes are numbered by `numbers`
    numbers: Numbers  # of the nodes of `glued` in the torn system
    glued: GluedProblem  # the same problem without subdomains
    prescribed: Prescribed  # as given, perhaps several times
    # in the order of the rows and sites of `glued`
    contacts: ContactRows
    tied: ContactRows
    contact_names: list[str]  # of contacts and tied pairs
    friction: Friction
    options: dict[str, Any]  # of the solver
    story: list[str] = field(default_factory=list)  # what was drawn, in words


def torn_system(
    problem: TornProblem, comm: MPI.Comm, seed: int
) -> tuple[TornSystem, Numbers, Numbers, Numbers]:
    """Distribute a problem over the ranks at random; also return the rows given here.

    These are contact rows, tied rows and sites of friction.
    """
    rng = np.random.default_rng([seed, 7])
    owner = rng.integers(comm.size, size=len(problem.subdomains))
    giver = rng.integers(comm.size, size=problem.contacts.size)
    speaker = rng.integers(comm.size, size=problem.prescribed.nodes.size)
    twice = rng.random(problem.prescribed.nodes.size) < 0.2
    rows = np.flatnonzero(giver == comm.rank)
    said = np.flatnonzero((speaker == comm.rank) | twice)
    contacts = problem.contacts.chosen(rows)
    prescribed = Prescribed(
        problem.prescribed.nodes[said],
        problem.prescribed.components[said],
        problem.prescribed.values[said],
    )
    own = [s for s, rank in zip(problem.subdomains, owner, strict=True) if rank == comm.rank]
    gdim = problem.glued.gdim
    names = [f"block {b}" for b in range(problem.glued.bodies)]
    ties = np.flatnonzero(rng.integers(comm.size, size=problem.tied.size) == comm.rank)
    tied = problem.tied.chosen(ties)
    whole = problem.friction
    sites = np.flatnonzero(giver[whole.row] == comm.rank)
    friction = Friction(
        np.searchsorted(rows, whole.row[sites]),
        whole.tangents[sites],
        whole.bound[sites],
        np.asarray(whole.slip)[sites],
        np.asarray(whole.coefficient)[sites],
    )
    system = TornSystem(
        own,
        prescribed,
        contacts,
        gdim,
        names,
        problem.contact_names,
        comm,
        tied=tied,
        friction=friction,
    )
    return system, rows, ties, sites


# -- geometry --------------------------------------------------------------------------------------


@dataclass
class _Draw:
    """State of a problem being drawn; lengths in units of a cell, stiffness of Young's 1."""

    rng: Generator
    gdim: int
    n: int
    edges: Vector
    cells: list[Place]
    body: dict[Place, int]
    story: list[str]
    strain: float
    young: dict[Place, float] = field(default_factory=dict)
    poisson: float = 0.3
    metre: float = 1.0
    node: dict[tuple[int, Place], int] = field(default_factory=dict)

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def nodes_of(self, cell: Place) -> Numbers:
        """Return the glued nodes of a cell, in lattice order."""
        base = self.n * np.array(cell)
        return np.array(
            [
                self.node.setdefault((self.body[cell], tuple(base + p)), len(self.node))
                for p in lattice_points(*[self.n] * self.gdim)
            ]
        )

    def nodes_of_body(self, body: int) -> Numbers:
        """Return the glued nodes of a body, ascending."""
        return np.unique(
            np.concatenate([self.nodes_of(c) for c in self.cells if self.body[c] == body])
        )

    def rigid_modes(self, nodes: Numbers) -> Vector:
        """Return the rigid motions of glued nodes."""
        place = {number: position for (_, position), number in self.node.items()}
        return rigid_modes(np.array([place[int(i)] for i in nodes]) * self.edges / self.n)

    def faces(self, cell: Place) -> list[tuple[int, int, Place]]:
        """Return (axis, side, neighbour's place) of all faces of a cell."""
        found = []
        for axis, side in itertools.product(range(self.gdim), (-1, 1)):
            other = list(cell)
            other[axis] += side
            found.append((axis, side, tuple(other)))
        return found

    def on_face(self, axis: int, side: int) -> Numbers:
        """Return the lattice numbers of the nodes on a face of a cell."""
        level = self.n if side > 0 else 0
        return np.flatnonzero(lattice_points(*[self.n] * self.gdim)[:, axis] == level)

    def outer_faces(self, body: int) -> list[tuple[Place, int, int]]:
        return [
            (cell, axis, side)
            for cell in self.cells
            if self.body[cell] == body
            for axis, side, other in self.faces(cell)
            if other not in self.body
        ]

    def face_nodes(self, cell: Place, axis: int, side: int) -> Numbers:
        return self.nodes_of(cell)[self.on_face(axis, side)]

    @property
    def bodies(self) -> int:
        return max(self.body.values()) + 1


def _grow(rng: Generator, gdim: int, limit: int, separate: float) -> tuple[list[Place], dict]:
    """Grow a set of lattice cells; each new one continues a body or starts one."""
    cells: list[Place] = [(0,) * gdim]
    body = {cells[0]: 0}
    straight = rng.random() < 0.4
    while len(cells) < limit:
        parent = cells[-1] if straight else cells[rng.integers(len(cells))]
        axis, side = rng.integers(gdim), rng.choice([-1, 1])
        if straight:
            axis, side = gdim - 1, 1
        place = list(parent)
        place[axis] += side
        cell = tuple(int(p) for p in place)
        if cell in body:
            continue
        body[cell] = max(body.values()) + 1 if rng.random() < separate else body[parent]
        cells.append(cell)
    return cells, body


def _geometry(rng: Generator) -> _Draw:
    gdim = 2 if rng.random() < 0.6 else 3
    n = int(rng.integers(1, 5) if gdim == 2 else rng.choice([1, 1, 2, 2, 3]))
    per_cell = gdim * (n + 1) ** gdim
    limit = max(1, min(int(rng.integers(1, 10 if gdim == 2 else 7)), MAX_UNKNOWNS // per_cell))
    cells, body = _grow(
        rng, gdim, limit, float(rng.choice([0.0, 0.3, 0.6, 1.0], p=[0.1, 0.3, 0.4, 0.2]))
    )
    edges = 2.0 ** rng.uniform(-1.0, 1.0, gdim) if rng.random() < 0.5 else np.ones(gdim)
    story = [f"{gdim}D, {n} elements an edge, cells of bodies {[body[c] for c in cells]}"]
    return _Draw(rng, gdim, n, edges, cells, body, story, strain=10.0 ** rng.uniform(-9, 0))


def _materials(draw: _Draw) -> None:
    rng = draw.rng
    draw.poisson = float(rng.choice([0.0, 0.3, 0.45, 0.49], p=[0.1, 0.6, 0.2, 0.1]))
    exponents = np.zeros(draw.bodies)
    if draw.chance(0.4):
        exponents = rng.uniform(-6.0, 0.0, draw.bodies)
        draw.story.append(f"moduli of bodies 1e{exponents.round(1).tolist()}")
    inside = draw.chance(0.2)
    for cell in draw.cells:
        more = rng.uniform(-4.0, 2.0) if inside else 0.0
        draw.young[cell] = 10.0 ** (exponents[draw.body[cell]] + more)
    if inside:
        draw.story.append("jumps within bodies")


# -- conditions ------------------------------------------------------------------------------------


@dataclass
class _Rows:
    """Contact rows by glued nodes."""

    slave: list[int] = field(default_factory=list)
    master: list[int] = field(default_factory=list)
    normal: list[Vector] = field(default_factory=list)
    gap: list[float] = field(default_factory=list)
    contact: list[int] = field(default_factory=list)
    names: list[str] = field(default_factory=list)

    def begin(self, name: str) -> int:
        self.names.append(name)
        return len(self.names) - 1


def _gaps(draw: _Draw, count: int, where: str) -> Vector:
    """Draw the gaps of one contact, in units of the expected displacements."""
    rng = draw.rng
    kind = rng.choice(
        ["zero", "same", "open", "closed", "mixed", "far", "none", "wide"],
        p=[0.35, 0.12, 0.12, 0.08, 0.15, 0.08, 0.05, 0.05],
    )
    unit = draw.strain
    if kind == "zero":
        gap = np.zeros(count)
    elif kind == "same":
        gap = np.full(count, unit * 10.0 ** rng.uniform(-3, 1))
    elif kind == "open":
        gap = unit * rng.random(count)
    elif kind == "closed":
        gap = np.full(count, -unit * 10.0 ** rng.uniform(-2, 0))
    elif kind == "mixed":
        gap = unit * rng.normal(size=count)
    elif kind == "wide":
        gap = unit * 10.0 ** rng.uniform(-3, 6, count)
    else:
        far = FAR if kind == "far" else np.inf
        gap = np.where(rng.random(count) < 0.6, far, unit * rng.random(count))
    draw.story.append(f"gaps of {where}: {kind}")
    return gap


def _tilted(draw: _Draw, normal: Vector, count: int) -> Vector:
    normals = np.tile(normal, (count, 1))
    if draw.chance(0.15):
        normals = normals + 0.2 * draw.rng.normal(size=normals.shape)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals


def _contact_pairs(draw: _Draw, rows: _Rows) -> None:
    """Let bodies that are neighbours touch, node to node."""
    pairs: dict[tuple[int, int], list[tuple[int, int, int, int]]] = {}
    for cell in draw.cells:
        for axis, side, other in draw.faces(cell):
            if side > 0 and other in draw.body and draw.body[other] != draw.body[cell]:
                one, two = draw.face_nodes(cell, axis, 1), draw.face_nodes(other, axis, -1)
                key = (draw.body[cell], draw.body[other])
                swap = key[0] > key[1]
                for i, j in zip(one, two, strict=True):
                    found = (int(j), int(i), axis, -1) if swap else (int(i), int(j), axis, 1)
                    pairs.setdefault((min(key), max(key)), []).append(found)
    for (one, two), nodes in pairs.items():
        if draw.chance(0.1):
            continue
        nodes = list(dict.fromkeys(nodes)) if draw.chance(0.8) else nodes
        slave_first = draw.chance(0.5)
        number = rows.begin(f"joint {one}-{two}")
        gap = _gaps(draw, len(nodes), rows.names[number])
        tilt = _tilted(draw, np.zeros(draw.gdim), 1)[0] if draw.chance(0.1) else 0.0
        for k, (i, j, axis, side) in enumerate(nodes):
            normal = side * np.eye(draw.gdim)[axis] + tilt
            normal = normal / np.linalg.norm(normal)
            rows.slave.append(i if slave_first else j)
            rows.master.append(j if slave_first else i)
            rows.normal.append(normal if slave_first else -normal)
            rows.gap.append(float(gap[k]))
            rows.contact.append(number)


def _obstacles(draw: _Draw, rows: _Rows) -> None:
    for body in range(draw.bodies):
        faces = draw.outer_faces(body)
        while faces and draw.chance(0.3):
            cell, axis, side = faces[draw.rng.integers(len(faces))]
            nodes = draw.face_nodes(cell, axis, side)
            number = rows.begin(f"obstacle {len(rows.names)} of block {body}")
            gap = _gaps(draw, nodes.size, rows.names[number])
            normals = _tilted(draw, side * np.eye(draw.gdim)[axis], nodes.size)
            rows.slave += nodes.tolist()
            rows.master += [-1] * nodes.size
            rows.normal += list(normals)
            rows.gap += gap.tolist()
            rows.contact += [number] * nodes.size


@dataclass
class _Supports:
    """Prescribed displacements {unknown: value} and springs by subdomain."""

    value: dict[int, float] = field(default_factory=dict)
    springs: list[tuple[Place, int, Vector, float]] = field(default_factory=list)
    held: dict[int, str] = field(default_factory=dict)


def _supports(draw: _Draw) -> _Supports:
    found = _Supports()
    rng = draw.rng
    kinds = ["clamp", "rollers", "spring", "component", "scattered", "free"]
    odds = [0.35, 0.15, 0.15, 0.1, 0.05, 0.2]
    moved = draw.chance(0.4)
    for body in range(draw.bodies):
        kind = str(rng.choice(kinds, p=odds))
        faces = draw.outer_faces(body)
        if not faces and kind in ("clamp", "component", "rollers", "spring"):
            kind = "scattered"
        found.held[body] = kind
        offset = draw.strain * rng.normal(size=draw.gdim) * moved
        if kind in ("clamp", "component"):
            cell, axis, side = faces[rng.integers(len(faces))]
            components = range(draw.gdim) if kind == "clamp" else [rng.integers(draw.gdim)]
            for node, c in itertools.product(draw.face_nodes(cell, axis, side), components):
                found.value[draw.gdim * int(node) + int(c)] = float(offset[c])
        elif kind == "rollers":
            for axis in range(draw.gdim):
                own = [f for f in faces if f[1] == axis]
                if own:
                    for node in draw.face_nodes(*own[rng.integers(len(own))]):
                        found.value[draw.gdim * int(node) + axis] = float(offset[axis])
        elif kind == "scattered":
            nodes = draw.nodes_of_body(body)
            for node in rng.choice(nodes, size=min(nodes.size, draw.gdim + 1), replace=False):
                for c in range(draw.gdim):
                    if draw.chance(0.8):
                        found.value[draw.gdim * int(node) + c] = float(
                            offset[c] + draw.strain * rng.normal() * moved
                        )
        if kind == "spring" or (faces and draw.chance(0.1)):
            stiffness = 10.0 ** (
                rng.uniform(-9.0, 2.0) if draw.chance(0.8) else rng.uniform(-13, 4)
            )
            cell, axis, side = faces[rng.integers(len(faces))]
            way = rng.choice(["all", "normal", "component"])
            directions = {
                "all": list(np.eye(draw.gdim)),
                "normal": [np.eye(draw.gdim)[axis]],
                "component": [np.eye(draw.gdim)[rng.integers(draw.gdim)]],
            }[str(way)]
            for node in draw.on_face(axis, side):
                for direction in directions:
                    found.springs.append((cell, int(node), direction, stiffness * draw.young[cell]))
            draw.story.append(f"springs on body {body}: {way}, {stiffness:.1e} of the modulus")
    draw.story.append(f"supports {list(found.held.values())}, moved {moved}")
    return found


# -- loads -----------------------------------------------------------------------------------------


def _loads(draw: _Draw, held: dict[int, str], C: sp.csr_matrix, gap: Vector) -> Vector:
    """Draw the nodal loads of the glued nodes, for strains of about `draw.strain`."""
    rng, gdim = draw.rng, draw.gdim
    f = np.zeros(gdim * len(draw.node))
    graded = draw.chance(0.3)
    for body in range(draw.bodies):
        size = draw.strain * 10.0 ** (rng.uniform(-6, 0) if graded else 0.0)
        kind = str(rng.choice(["traction", "weight", "points", "none"], p=[0.4, 0.25, 0.1, 0.25]))
        faces = draw.outer_faces(body)
        cells = [c for c in draw.cells if draw.body[c] == body]
        young = max(draw.young[c] for c in cells)
        free = held[body] in ("free", "component")
        if free and draw.chance(0.85):
            f += _pressed(draw, body, size * young, C, gap)
            continue
        direction = rng.normal(size=gdim)
        if kind == "traction" and faces:
            cell, axis, side = faces[rng.integers(len(faces))]
            nodes = draw.face_nodes(cell, axis, side)
        elif kind == "weight":
            nodes = draw.nodes_of_body(body)
        elif kind == "points":
            nodes = draw.nodes_of(cells[0])[:2]
        else:
            continue
        for c in range(gdim):
            f[gdim * nodes + c] += size * young * direction[c] / nodes.size
        if free and draw.chance(0.3):  # a balanced load
            every = draw.nodes_of_body(body)
            at = unknowns_of(every, gdim)
            R = draw.rigid_modes(every)
            f[at] -= R @ (R.T @ f[at])
    return f


def _pressed(draw: _Draw, body: int, size: float, C: sp.csr_matrix, gap: Vector) -> Vector:
    """Return a load on a body which pressures of its contacts balance."""
    near = np.flatnonzero(gap < 0.1 * FAR * draw.strain)
    pressure = np.zeros(gap.size)
    pressure[near] = draw.rng.random(near.size) * size / max(1, near.size)
    force = C.T @ pressure
    every = draw.nodes_of_body(body)
    at = unknowns_of(every, draw.gdim)
    R = draw.rigid_modes(every)
    f = np.zeros(force.size)
    f[at] = R @ (R.T @ force[at])
    return f


# -- all together ----------------------------------------------------------------------------------


def draw_torn(seed: int) -> TornProblem:
    """Draw the problem of a seed."""
    rng = np.random.default_rng([seed, 1])
    draw = _geometry(rng)
    _materials(draw)
    for cell in draw.cells:
        draw.nodes_of(cell)
    rows = _Rows()
    _contact_pairs(draw, rows)
    _obstacles(draw, rows)
    supports = _supports(draw)
    C = _row_matrix(draw, rows)
    gap = np.array(rows.gap)
    f = _loads(draw, supports.held, C, gap)
    shift = _shifts(draw, supports)
    gap = gap + C @ shift
    for unknown in supports.value:
        supports.value[unknown] += float(shift[unknown])
    problem = _in_units(draw, rows, supports, C, gap, f)
    for change in (_with_sparse_rows, _with_tied_rows):
        problem = change(draw, problem, shift)
    problem = _with_lengths(draw, problem)
    return _with_friction(draw, problem, set(supports.held.values()), shift)


# -- rows between more than two nodes, drawn last --------------------------------------------------


def _interpolations(draw: _Draw) -> list[tuple[int, Numbers, Vector]]:
    """Return some nodes of one body, with other bodies' nodes and weights that add up to 1."""
    rng, found = draw.rng, []
    body = np.array([b for b, _ in draw.node])
    slaves = np.flatnonzero(body == rng.integers(draw.bodies))
    others = np.flatnonzero(body != body[slaves[0]])
    if not others.size:
        return found
    if draw.chance(0.8):  # of one other body
        others = others[body[others] == body[rng.choice(others)]]
    places = np.array([p for _, p in draw.node], dtype=float)
    near = np.argsort(np.linalg.norm(places[others] - places[slaves].mean(axis=0), axis=1))
    few = others[near[: int(rng.integers(1, 12))]]
    for slave in rng.choice(slaves, min(slaves.size, int(rng.integers(1, 10))), replace=False):
        masters = rng.choice(few, min(few.size, int(rng.integers(1, 7))), replace=False)
        weights = rng.random(masters.size) + 0.1
        found.append((int(slave), masters, weights / weights.sum()))
    return found


def _sparse_rows(
    draw: _Draw, terms: list[tuple[int, Numbers, Vector, Vector]]
) -> tuple[sp.csr_matrix, ContactRows]:
    """Return rows d'(u(slave) - sum_l weight_l u(master_l)) of glued unknowns, and as they are."""
    gdim = draw.gdim
    nodes = [np.append(slave, masters) for slave, masters, *_ in terms]
    values = [np.append(1.0, -weights)[:, None] * d for _, _, weights, d in terms]
    offsets = np.append(0, np.cumsum([len(n) for n in nodes])).astype(np.int64)
    node = np.concatenate([np.zeros(0, dtype=np.int64), *nodes])
    coefficients = np.concatenate([np.zeros((0, gdim)), *values])
    columns = unknowns_of(node, gdim)
    shape = len(terms), gdim * len(draw.node)
    matrix = sp.csr_matrix((coefficients.ravel(), columns, gdim * offsets), shape=shape)
    zeros = np.zeros(len(terms))
    return matrix, ContactRows(offsets, node, coefficients, zeros, zeros.astype(np.int64))


def _as_given(problem: TornProblem, rows: ContactRows, gap: Vector, contact: int) -> ContactRows:
    numbers = np.full(rows.size, contact, dtype=np.int64)
    return replace(rows, nodes=problem.numbers[rows.nodes], gap=gap, contact=numbers)


def _with_sparse_rows(draw: _Draw, problem: TornProblem, shift: Vector) -> TornProblem:
    """Add contact conditions between one node and several others."""
    rng = draw.rng
    if not draw.chance(0.25):
        return problem
    normal = rng.normal(size=draw.gdim)
    terms = []
    for found in _interpolations(draw):
        n = normal + 0.1 * rng.normal(size=draw.gdim)
        terms.append((*found, n / np.linalg.norm(n)))
    C, rows = _sparse_rows(draw, terms)
    gap = (draw.strain * rng.uniform(-0.2, 1.0, rows.size) + C @ shift) * draw.metre
    draw.story.append(f"{rows.size} contact rows between several nodes")
    glued, number = problem.glued, len(problem.contact_names)
    given = _as_given(problem, rows, gap, number)
    return replace(
        problem,
        glued=replace(
            glued,
            rows=sp.vstack([glued.rows, C], format="csr"),
            gap=np.append(glued.gap, gap),
            contact=np.append(glued.contact, given.contact),
            gap_rounding=np.append(glued.gap_rounding, np.zeros(rows.size)),
        ),
        contacts=ContactRows.concatenate([problem.contacts, given]),
        contact_names=[*problem.contact_names, "sparse rows"],
    )


def _with_tied_rows(draw: _Draw, problem: TornProblem, shift: Vector) -> TornProblem:
    """Tie nodes to means of other nodes, in all directions or in some."""
    rng = draw.rng
    if not draw.chance(0.25):
        return problem
    some = int(rng.integers(1, draw.gdim + 1)) if draw.chance(0.3) else draw.gdim
    ways = np.linalg.qr(rng.normal(size=(draw.gdim, draw.gdim)))[0][:some]
    terms = [(*found, way) for found in _interpolations(draw) for way in ways]
    T, rows = _sparse_rows(draw, terms)
    jump = draw.strain * rng.normal(size=rows.size) * draw.chance(0.3)
    jump = (jump + T @ shift) * draw.metre
    draw.story.append(f"{rows.size} tied rows, {some} at a node")
    number = len(problem.contact_names)
    return replace(
        problem,
        glued=replace(problem.glued, tied=T, tied_jump=jump),
        tied=_as_given(problem, rows, jump, number),
        contact_names=[*problem.contact_names, "tied nodes"],
    )


def _with_lengths(draw: _Draw, problem: TornProblem) -> TornProblem:
    """Multiply rows by numbers of many sizes, which changes nothing."""
    if not draw.chance(0.3):
        return problem
    draw.story.append("rows of many lengths")

    def scaled(rows: ContactRows) -> ContactRows:
        length = 10.0 ** draw.rng.uniform(-6.0, 6.0, rows.size)
        coefficients = length[rows.row][:, None] * rows.coefficients
        return replace(rows, coefficients=coefficients, gap=length * rows.gap)

    return replace(problem, contacts=scaled(problem.contacts), tied=scaled(problem.tied))


# -- friction, drawn after everything else ---------------------------------------------------------


def _with_friction(draw: _Draw, problem: TornProblem, held: set[str], shift: Vector) -> TornProblem:
    """Add friction, with given bounds or Coulomb's, to some contacts."""
    rng, glued, contacts = draw.rng, problem.glued, problem.contacts
    soft = problem.glued.springs.stiffness.min(initial=np.inf) < SOFT * glued.elastic.max()
    if not draw.chance(0.4) or not contacts.size or soft:
        return problem
    law = str(rng.choice(["bounds", "Coulomb", "both"], p=[0.5, 0.35, 0.15]))
    rubs = np.isin(glued.contact, np.flatnonzero(rng.random(glued.contact.max() + 1) < 0.8))
    if draw.chance(0.2):
        rubs &= rng.random(rubs.size) < 0.7
    normals = contacts.normal
    rubs &= np.isfinite(contacts.gap) & _any_direction(glued, normals)
    row = np.flatnonzero(rubs)
    directions, tangents = draw.gdim - 1, _tangents(rng, normals[row])
    S = _slip_rows(glued.rows[row], normals[row], tangents)
    slide = _slide(glued, S, directions)
    row, tangents, k = row[slide], tangents[slide], np.count_nonzero(slide)
    S = S[np.flatnonzero(np.repeat(slide, directions))]
    force = draw.strain * draw.metre * _stiffness_at_rows(glued, row) / max(1, k) ** 0.5
    bound = force * 10.0 ** (rng.uniform(-3, 1) + rng.uniform(-1, 0, k))
    bound *= rng.random(k) < rng.choice([1.0, 0.8])
    coefficient = np.full(k, rng.choice([0.05, 0.1, 0.3, 0.5, 0.8]))
    coefficient *= (rng.random(k) < rng.choice([1.0, 0.8])) & _has_known_force(glued)[row]
    if law == "Coulomb":
        bound = 0.0 * bound
    if law == "bounds":
        coefficient = 0.0 * coefficient
    before = draw.strain * rng.normal(size=(k, directions)) * draw.chance(0.25)
    before = draw.metre * (before + (S @ shift).reshape(k, directions))
    friction = GluedFriction(row, S, before, bound, coefficient)
    given = Friction(row, tangents, bound, before, coefficient)
    largest = float(coefficient.max(initial=0.0))
    draw.story.append(f"friction at {k} rows: {law}, coefficient {largest}")
    problem = replace(problem, glued=replace(glued, friction=friction), friction=given)
    return _pushed(draw, problem) if {"free", "component"} & held else problem


def _slide(glued: GluedProblem, S: sp.csr_matrix, directions: int) -> NDArray[np.bool_]:
    """Tell at which sites free unknowns have a part in the slip."""
    moves = (abs(S) @ glued.is_free).reshape(-1, directions) > 1e-8
    return moves.any(axis=1)


def _has_known_force(glued: GluedProblem) -> NDArray[np.bool_]:
    """Tell which rows are moved by free unknowns, and parallel to no other row."""
    C = glued.rows.toarray()
    C[:, glued.fixed] = 0.0
    C[~np.isfinite(glued.gap)] = 0.0
    lengths = np.linalg.norm(C, axis=1)
    C /= np.maximum(lengths, 1e-300)[:, None]
    cosines = np.abs(C @ C.T) - np.eye(len(C))
    return (lengths > 1e-8) & (cosines.max(axis=1, initial=0.0) < 1.0 - 1e-8)


def _any_direction(glued: GluedProblem, normals: Vector) -> NDArray[np.bool_]:
    """Tell at which rows tangents may have any direction.

    That is not so in three dimensions where some of the components of all nodes are prescribed.
    """
    if glued.gdim == 2:
        return np.ones(len(normals), dtype=bool)
    fixed = 1.0 - glued.is_free
    rows = abs(glued.rows)
    nodes = sp.csr_matrix(
        (
            np.ones(rows.nnz),
            (np.repeat(np.arange(len(normals)), np.diff(rows.indptr)), rows.indices // glued.gdim),
        ),
        shape=(len(normals), len(glued.body)),
    )
    touched = nodes > 0.0
    held = (touched @ fixed.reshape(-1, glued.gdim)) / np.maximum(touched.sum(axis=1), 1)
    every = np.asarray(held) >= 1.0
    return every.all(axis=1) | ~every.any(axis=1)


def _tangents(rng: Generator, normals: Vector) -> Vector:
    """Return random orthonormal tangents (k, gdim - 1, gdim)."""
    k, gdim = normals.shape
    if gdim == 2:
        sign = rng.choice([-1.0, 1.0], k)[:, None]
        return (sign * np.column_stack([-normals[:, 1], normals[:, 0]]))[:, None]
    first = np.cross(normals, rng.normal(size=(k, 3)))
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(normals, first)], axis=1)


def _slip_rows(C: sp.csr_matrix, normals: Vector, tangents: Vector) -> sp.csr_matrix:
    """Return the rows C with tangents in place of the normals, site by site."""
    k, directions, gdim = tangents.shape
    C = C.tocoo()
    weight = sp.csr_matrix(
        (C.data * normals[C.row, C.col % gdim], (C.row, C.col // gdim)),
        shape=(k, C.shape[1] // gdim),
    ).tocoo()
    i, j, values = [], [], []
    for direction, component in itertools.product(range(directions), range(gdim)):
        i.append(directions * weight.row + direction)
        j.append(gdim * weight.col + component)
        values.append(weight.data * tangents[weight.row, direction, component])
    entries = tuple(np.concatenate(part) for part in (i, j))
    return sp.csr_matrix((np.concatenate(values), entries), shape=(directions * k, C.shape[1]))


def _stiffness_at_rows(glued: GluedProblem, row: Numbers) -> Vector:
    """Return the largest stiffness of the softest body of each row."""
    diagonal, body = glued.elastic.diagonal(), np.repeat(glued.body, glued.gdim)
    of_body = np.array([diagonal[body == b].max() for b in range(glued.bodies)])
    C = glued.rows[row]
    each = of_body[body[C.indices]]
    return np.array([each[C.indptr[k] : C.indptr[k + 1]].min() for k in range(row.size)])


def _pushed(draw: _Draw, problem: TornProblem) -> TornProblem:
    """Add loads on bodies that friction forces within given bounds would balance."""
    rng, glued = draw.rng, problem.glued
    friction = glued.friction
    assert friction is not None
    force = friction.bound * rng.uniform(0.0, 0.9, friction.size)
    way = rng.normal(size=friction.before.shape)
    way /= np.linalg.norm(way, axis=1)[:, None]
    push = friction.rows.T @ (force[:, None] * way).ravel()
    f = np.zeros(glued.load.size)
    for b in range(glued.bodies):
        at = glued.unknowns(b)
        if np.isin(at, glued.fixed).any() or not draw.chance(0.7):
            continue
        R = rigid_modes(glued.coordinates[glued.body == b])
        f[at] = R @ (R.T @ push[at])
    # on the first subdomain that has the node
    left, subdomains = f.copy(), []
    place = np.argsort(problem.numbers)
    for s in problem.subdomains:
        nodes = place[np.searchsorted(problem.numbers[place], s.nodes)]
        at = unknowns_of(nodes, glued.gdim)
        subdomains.append(replace(s, load=s.load + left[at]))
        left[at] = 0.0
    draw.story.append("pushed as friction holds")
    return replace(problem, subdomains=subdomains, glued=replace(glued, load=glued.load + f))


def _shifts(draw: _Draw, supports: _Supports) -> Vector:
    """Draw rigid motions of bodies that change nothing: supports and obstacles move as well."""
    shift = np.zeros(draw.gdim * len(draw.node))
    sprung = {draw.body[cell] for cell, *_ in supports.springs}
    for body, kind in supports.held.items():
        if kind in ("clamp", "rollers") and body not in sprung and draw.chance(0.15):
            amount = draw.strain * 10.0 ** draw.rng.uniform(0, 6)
            draw.story.append(f"body {body} is moved by {amount / draw.strain:.1e} displacements")
            every = draw.nodes_of_body(body)
            for c, way in enumerate(draw.rng.normal(size=draw.gdim)):
                shift[draw.gdim * every + c] = amount * way
    return shift


def _row_matrix(draw: _Draw, rows: _Rows) -> sp.csr_matrix:
    gdim, m = draw.gdim, len(rows.gap)
    i, j, values = [], [], []
    for k in range(m):
        for node, sign in ((rows.slave[k], 1.0), (rows.master[k], -1.0)):
            if node >= 0:
                i += [k] * gdim
                j += [gdim * node + c for c in range(gdim)]
                values += (sign * rows.normal[k]).tolist()
    return sp.csr_matrix((values, (i, j)), shape=(m, gdim * len(draw.node)))


def _in_units(
    draw: _Draw, rows: _Rows, supports: _Supports, C: sp.csr_matrix, gap: Vector, f: Vector
) -> TornProblem:
    """Choose units of stiffness and length, and write everything down in them."""
    rng, gdim, n = draw.rng, draw.gdim, draw.n
    modulus, metre = (10.0 ** rng.uniform(-6, 6), 10.0 ** rng.uniform(-6, 3))
    if draw.chance(0.3):
        modulus, metre = 1.0, 1.0
    draw.metre = metre
    draw.story.append(f"modulus {modulus:.1e}, length {metre:.1e}, strain {draw.strain:.1e}")
    stiffness_unit, force_unit = modulus * metre ** (gdim - 2), modulus * metre ** (gdim - 1)
    gap = np.where(gap == FAR, FAR, gap * metre)

    places = np.array([p for _, p in draw.node], dtype=float)
    coordinates = places * draw.edges / n * metre
    body = np.array([b for b, _ in draw.node], dtype=np.int64)
    unknowns = gdim * len(draw.node)
    numbers = rng.permutation(len(draw.node)).astype(np.int64)
    if draw.chance(0.3):
        numbers = numbers * 1009 + int(rng.integers(10**9))

    # loads of shared nodes go to one of the subdomains, or are divided
    cells = {cell: draw.nodes_of(cell) for cell in draw.cells}
    copies = Counter(int(i) for nodes in cells.values() for i in nodes)
    divided = draw.chance(0.5)
    used: set[int] = set()
    elastic = sp.csr_matrix((unknowns, unknowns))
    spring_rows: list[Any] = []
    spring_k: list[float] = []
    subdomains = []
    unit = {}
    for cell, nodes in cells.items():
        if draw.young[cell] not in unit:
            unit[draw.young[cell]] = (
                draw.young[cell] * stiffness_unit * box_stiffness(n, draw.edges, draw.poisson)
            ).tocsr()
        K = unit[draw.young[cell]]
        at = unknowns_of(nodes, gdim)
        spread = sp.csr_matrix(
            (np.ones(at.size), (np.arange(at.size), at)), shape=(at.size, unknowns)
        )
        elastic = elastic + spread.T @ K @ spread
        of_cell = [s for s in supports.springs if s[0] == cell]
        if of_cell:
            S = np.zeros((len(of_cell), at.size))
            for k, (_, node, direction, _) in enumerate(of_cell):
                S[k, gdim * node : gdim * node + gdim] = direction
            k = np.array([s[3] for s in of_cell]) * stiffness_unit
            spring_rows.append(sp.csr_matrix(S) @ spread)
            spring_k += k.tolist()
            K = (K + sp.csr_matrix(S.T @ (k[:, None] * S))).tocsr()
        share = np.array(
            [1.0 / copies[int(i)] if divided else float(int(i) not in used) for i in nodes]
        )
        used |= {int(i) for i in nodes}
        load = f[at] * np.repeat(share, gdim) * force_unit
        subdomains.append(
            Subdomain(K, load, coordinates[nodes].copy(), numbers[nodes], draw.body[cell])
        )
    whole_load = np.zeros(unknowns)
    for subdomain, nodes in zip(subdomains, cells.values(), strict=True):
        np.add.at(whole_load, unknowns_of(nodes, gdim), subdomain.load)

    fixed = np.array(sorted(supports.value), dtype=np.int64)
    values = np.array([supports.value[int(i)] for i in fixed]) * metre
    springs = Springs(
        sp.vstack(spring_rows, format="csr") if spring_rows else sp.csr_matrix((0, unknowns)),
        np.array(spring_k),
    )
    contact = np.array(rows.contact, dtype=np.int64)
    glued = GluedProblem(
        coordinates,
        body,
        elastic.tocsr(),
        springs,
        whole_load,
        fixed,
        values,
        C,
        gap,
        contact,
        gap_rounding=np.zeros(gap.size),
    )
    slave, master = np.array(rows.slave, dtype=np.int64), np.array(rows.master, dtype=np.int64)
    contacts = ContactRows.node_to_node(
        numbers[slave],
        np.where(master >= 0, numbers[master.clip(min=0)], -1),
        np.array(rows.normal).reshape(-1, gdim),
        gap,
        contact,
    )
    prescribed = Prescribed(numbers[fixed // gdim], fixed % gdim, values)
    options = _options(rng)
    draw.story.append(f"options {options}")
    return TornProblem(
        subdomains,
        numbers,
        glued,
        prescribed,
        contacts,
        ContactRows.none(gdim),
        rows.names,
        Friction.none(gdim),
        options,
        story=draw.story,
    )


def _options(rng: Generator) -> dict[str, Any]:
    options: dict[str, Any] = {"rtol": float(10.0 ** rng.uniform(-9, -2))}
    if rng.random() < 0.3:
        options["rtol"] = 1e-6
    choices = {
        "method": ["active_set"] * 4 + ["smalbe"],
        "preconditioner": ["lumped", "lumped", "dirichlet", "none"],
        "scaling": ["stiffness"] * 4 + ["multiplicity"],
        "dual_operator": ["auto", "implicit", "explicit"],
        "mprgp_expansion": ["projected_cg", "projected_cg", "standard"],
    }
    for name, values in choices.items():
        options[name] = values[rng.integers(len(values))]
    return options

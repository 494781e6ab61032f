"""Torn systems with friction, and their solution by a conic solver without subdomains."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import clarabel
import numpy as np
import scipy.sparse as sp
from sparse_rows import clamped, interpolated, two_blocks
from torn import Glued, column, cube, matrix, node_rows

from fenics_tfeti.feti import ContactRows, Friction, Prescribed, Subdomain, TornSystem

# torn systems with rows that depend on each other where sites stick, see tests/data/README.md
STORED = sorted((Path(__file__).parents[1] / "data").glob("friction_*.npz"))
TANGENTS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
DOWN = np.array([0.0, 0.0, -1.0])


def horizontal(rows: ContactRows, bound, slip=(0.0, 0.0)) -> Friction:
    """Return friction at all rows, which have vertical normals."""
    k = rows.size
    return Friction(
        np.arange(k),
        np.tile(TANGENTS, (k, 1, 1)),
        np.broadcast_to(np.asarray(bound, float), k),
        np.tile(np.asarray(slip, float), (k, 1)),
    )


def random_tangents(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return tangents of normals, the first across one random direction."""
    first = np.cross(normals, rng.standard_normal(3))
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(normals, first)], axis=1)


def without_upper_supports(system: TornSystem) -> TornSystem:
    """Return the system with supports at the nodes of the first body only."""
    given = system.prescribed
    lower = np.isin(given.nodes, np.concatenate([s.nodes for s in system.subdomains if not s.body]))
    prescribed = Prescribed(given.nodes[lower], given.components[lower], given.values[lower])
    return dataclasses.replace(system, prescribed=prescribed)


def pushed_block(n=3, load=(0.15, 0.05, -1.0), bound=0.02, slip=(0.0, 0.0)) -> TornSystem:
    """Return a cube on a cube that is held at its bottom; the load pushes the upper one."""
    system = without_upper_supports(column(n=n, height=1, load=load))
    return dataclasses.replace(system, friction=horizontal(system.contacts, bound, slip))


def held_block(bound=0.01) -> TornSystem:
    """Return the same with the top face of the upper cube held against sliding."""
    system = column(n=3, height=1, load=(0.15, 0.05, -1.0))
    return dataclasses.replace(system, friction=horizontal(system.contacts, bound))


def blocks_that_do_not_match(bound=1e-3, free: bool = False, load=(0.02, 0.01, -0.2)) -> TornSystem:
    """Return two blocks of two subdomains each, with rows that share master nodes."""
    subdomains = two_blocks(2, 3, load)
    rows = interpolated(subdomains, 2, DOWN, lambda x: 0.5 + x[:, 0])
    held = clamped(subdomains, (2, 0.0)) if free else clamped(subdomains, (2, 0.0), (2, 2.0))
    return TornSystem(
        subdomains, held, rows, 3, ["lower", "upper"], ["joint"], friction=horizontal(rows, bound)
    )


def on_the_ground(bound=0.012, load=(0.1, 0.0, -1.0)) -> TornSystem:
    """Return a cube of eight subdomains on a rigid plane."""
    places = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    subdomains = [cube(2, place, load=np.asarray(load) / 8.0) for place in places]
    nodes = np.concatenate([s.nodes for s in subdomains])
    z = np.concatenate([s.coordinates[:, 2] for s in subdomains])
    slave = np.unique(nodes[z == 0.0])
    k = slave.size
    none = np.full(k, -1)
    rows = node_rows(slave, DOWN, master=none)
    return TornSystem(
        subdomains, Prescribed(), rows, 3, ["block"], ["ground"], friction=horizontal(rows, bound)
    )


def in_a_corner(seed: int) -> TornSystem:
    """Return a cube that is pressed on the ground and on a wall, which share an edge of nodes."""
    rng = np.random.default_rng(seed)
    block = on_the_ground(load=(-rng.uniform(0.1, 1.0), 0.0, -rng.uniform(0.1, 1.0)))
    nodes = np.concatenate([s.nodes for s in block.subdomains])
    x = np.concatenate([s.coordinates for s in block.subdomains])
    slave = [np.unique(nodes[x[:, axis] == 0.0]) for axis in (2, 0)]
    size = [s.size for s in slave]
    k = sum(size)
    normals = np.repeat([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]], size, axis=0)
    gaps = 0.01 * rng.random(k) * rng.choice([0, 1])
    rows = ContactRows.node_to_node(
        np.concatenate(slave), np.full(k, -1), normals, gaps, np.repeat([0, 1], size)
    )
    tangents = random_tangents(normals, rng)
    bounds = 10.0 ** (rng.uniform(-4, -1) + rng.uniform(-1, 0, k))
    friction = Friction(np.arange(k), tangents, bounds)
    return dataclasses.replace(
        block, contacts=rows, contact_names=["floor", "wall"], friction=friction
    )


def in_a_groove(bound=0.02, gap=0.01, load=(0.01, 0.005, -1.0)) -> TornSystem:
    """Return a cube whose bottom is pressed on two rigid planes that slope towards each other.

    The nodes have gaps of up to three times `gap` to each plane, and slip bounds of some sizes.
    """
    block = on_the_ground(load=load)
    slave = block.contacts.slave
    k = slave.size
    slopes = np.array([[0.0, np.sin(0.6), -np.cos(0.6)], [0.0, -np.sin(0.6), -np.cos(0.6)]])
    normals = np.repeat(slopes, k, axis=0)
    gaps = gap * (1.0 + np.arange(2 * k) % 3)
    rows = ContactRows.node_to_node(
        np.tile(slave, 2), np.full(2 * k, -1), normals, gaps, np.repeat([0, 1], k)
    )
    along = np.tile([1.0, 0.0, 0.0], (2 * k, 1))
    tangents = np.stack([along, np.cross(normals, along)], axis=1)
    bounds = bound * (0.5 + 0.5 * (np.arange(2 * k) % 7) / 6.0)
    friction = Friction(np.arange(2 * k), tangents, bounds)
    return dataclasses.replace(
        block, contacts=rows, contact_names=["left", "right"], friction=friction
    )


def pulled_strip(n=6, bound=0.01, pull=0.06) -> TornSystem:
    """Return a plane strip of two subdomains on a rigid line, pressed on it and pulled sideways.

    Elements are squares of two triangles, E = 1, nu = 0.
    """
    subdomains = [_strip(n, first=0, load=0.0), _strip(n, first=n, load=pull)]
    bottom = np.unique(np.concatenate([s.nodes[s.coordinates[:, 1] == 0.0] for s in subdomains]))
    k = bottom.size
    rows = node_rows(bottom, [0.0, -1.0])
    friction = Friction(np.arange(k), np.tile([[[1.0, 0.0]]], (k, 1, 1)), np.full(k, bound))
    return TornSystem(subdomains, Prescribed(), rows, 2, ["strip"], ["line"], friction=friction)


def _strip(n: int, first: int, load: float) -> Subdomain:
    """Return n squares of edge 1 / n in a row, from x = first / n on."""
    h = 1.0 / n
    lattice = np.array([(i, j) for i in range(first, first + n + 1) for j in (0, 1)])
    K = np.zeros((2 * len(lattice),) * 2)
    C = np.diag([1.0, 1.0, 0.5])
    for i in range(n):
        a, b, c, d = 2 * i, 2 * i + 2, 2 * i + 3, 2 * i + 1
        for triangle in ([a, b, c], [a, c, d]):
            x = h * lattice[triangle]
            gradient = np.linalg.inv(np.column_stack([np.ones(3), x]))[1:]
            strain = np.zeros((3, 6))
            strain[0, 0::2], strain[1, 1::2] = gradient
            strain[2, 0::2], strain[2, 1::2] = gradient[1], gradient[0]
            at = (2 * np.array(triangle)[:, None] + np.arange(2)).ravel()
            K[np.ix_(at, at)] += 0.5 * h**2 * strain.T @ C @ strain
    f = np.zeros((len(lattice), 2))
    f[lattice[:, 1] == 1, 1] = -0.1 * h
    f[lattice[:, 0] == 2 * n, 0] = 0.5 * load
    numbers = 2 * lattice[:, 0] + lattice[:, 1]
    return Subdomain(sp.csr_matrix(K), f.ravel(), h * lattice, numbers.astype(np.int64), 0)


@dataclass(frozen=True)
class ConicSolution:
    """Minimiser of 1/2 u'Ku - f'u + sum of bounds times slips over the admissible u."""

    displacement: np.ndarray  # of the glued nodes
    energy: float
    normal_force: np.ndarray  # of the contact rows [N]
    tangential_force: np.ndarray  # of the rows with friction, along the tangents [N]
    slip: np.ndarray  # [m]


def solve_by_cones(system: TornSystem) -> ConicSolution:
    """Solve with a slack variable for the length of each slip, by an interior point method."""
    gdim = system.gdim
    whole, friction = Glued.of(system), system.friction
    K, f, known, free = whole.K, whole.f, whole.u, whole.free
    tangential = friction.tangential_rows(system.contacts)
    N, T = whole.C, matrix(tangential, whole.nodes)
    m, directions = friction.size, gdim - 1
    # |T u - c| <= slack in units of lengths, so that bounds are forces
    length = tangential.length[::directions]
    T = T / np.repeat(length, directions)[:, None]
    slip0 = np.asarray(friction.slip).ravel()
    rows = [np.hstack([N[:, free], np.zeros((len(N), m))])]
    right = [system.contacts.gap - N @ known]
    for k in range(m):
        mine = slice(directions * k, directions * (k + 1))
        block = np.zeros((gdim, free.size + m))
        block[0, free.size + k] = -1.0
        block[1:, : free.size] = -T[mine][:, free]
        rows.append(block)
        right.append(np.append(0.0, (T @ known - slip0)[mine]))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-14
    settings.static_regularization_enable = False  # which limits the accuracy of the steps
    # where rows depend on each other, iterates close to the cones make no progress before 1e-9
    settings.max_step_fraction = 0.9
    settings.max_iter = 100
    cones = [clarabel.NonnegativeConeT(len(N))] + [clarabel.SecondOrderConeT(gdim)] * m
    P = sp.block_diag([np.triu(K[np.ix_(free, free)]), sp.csc_matrix((m, m))], format="csc")
    load = (f - K @ known)[free]
    q = np.concatenate([-load, friction.bound])
    # displacements in units of `size`, forces in those of the load
    force = np.linalg.norm(load)
    size = force / K.diagonal().max()
    solver = clarabel.DefaultSolver(
        P * (size / force),
        q / force,
        sp.csc_matrix(np.vstack(rows)),
        np.concatenate(right) / size,
        cones,
        settings,
    )
    solution = solver.solve()
    assert str(solution.status) in ("Solved", "AlmostSolved", "InsufficientProgress")
    u = known.copy()
    u[free] = size * np.array(solution.x)[: free.size]
    dual = force * np.array(solution.z)
    slip = (T @ u - slip0).reshape(m, directions)
    energy = 0.5 * u @ K @ u - f @ u + friction.bound @ np.linalg.norm(slip, axis=1)
    return ConicSolution(
        u,
        float(energy),
        dual[: len(N)] * system.contacts.length,
        -dual[len(N) :].reshape(m, gdim)[:, 1:],
        slip,
    )

"""Surfaces in parts, with their sides, of several bodies, with corners, cracks and waves."""

from __future__ import annotations

import warnings
from typing import Any

from mpi4py import MPI

import numpy as np
from drawing import (
    BACK,
    FOURTH,
    LEFT,
    OTHER,
    SECOND,
    TOP,
    Draw,
    Ratios,
    RightError,
    block,
    ceiling,
    layer,
    levels,
    situation,
    up,
    worst,
)
from laws import Laws
from posed import BASE, LOADED, Answer, Frame, Posed, differ
from scenes import at, dimension

from dolfinx.mesh import CellType, create_rectangle, locate_entities, meshtags

from fenics_tfeti import Coulomb, Mortar, TiedPair, Tresca
from fenics_tfeti.errors import UnresistedMotion
from fenics_tfeti.io import Interface, TaggedMesh, split_interfaces, tag_facets


@situation(1.5)
def corners(draw: Draw) -> Ratios:
    """Corners of a foot on mesh lines of the table, which is the slave, do not sink in."""
    cell = draw.cell("quadrilateral", "triangle", "hexahedron")
    g, n = dimension(cell), draw.count(4, 8) if dimension(cell) == 2 else draw.count(3, 5)
    low = [draw.count(1, n - 2) for _ in range(g - 1)]
    size = [draw.count(1, n - 1 - k) for k in low]
    m, stiff = draw.count(1, 5 if g == 2 else 3), 10.0 ** draw.between(0, 3)
    depth, method = draw.between(0.002, 0.01), draw.one_of("linear", "linear", "finite")
    begin, end = np.array(low) / n, (np.array(low) + size) / n
    parts = [
        ((0.0,) * g, (1.0,) * (g - 1) + (0.5,), (n,) * (g - 1) + (2,)),
        ((*begin, 0.5), (*end, 1.0), (m,) * (g - 1) + (2,)),
    ]
    marks = levels(g - 1, (BASE, 0.0, 1), (TOP, 0.5, 1), (OTHER, 0.5, 2), (LOADED, 1.0, 2))
    frame = draw.frame(g)
    posed = draw.pose(frame, cell, parts, marks, method, young=[1.0, stiff])
    posed.hold(BASE)
    posed.hold(LOADED, up(g, -depth))
    posed.add_pair(TOP, OTHER, roles="given", partners=Mortar(), name="foot")
    answer = posed.solve()
    sunk = 0.0
    own = posed.places[:, : posed.owned]
    for corner in np.array(np.meshgrid(*zip(begin, end, strict=True))).reshape(g - 1, -1).T:
        near = np.linalg.norm(own.T - np.append(corner, 0.5), axis=1) < 1e-6
        heights = np.concatenate(draw.comm.allgather(answer.u[near, -1]))
        bodies = np.concatenate(draw.comm.allgather(posed.bodies_of_nodes()[near]))
        table, foot = heights[bodies == 1][0], heights[bodies == 2][0]
        sunk = max(sunk, table - foot)
    return worst(Laws(posed).ratios(), {"sunk": sunk / (0.02 * depth)})


@situation(1.0)
def tipping(draw: Draw) -> Ratios:
    """A block beyond the edge of a table falls where its load is, and holds before."""
    m, n = draw.count(4, 12), draw.count(2, 8)
    facet = draw.count(m // 2, m - 2)
    load = (facet + 0.5) / m
    falls, slave = draw.one_of(True, False), draw.one_of(TOP, OTHER)
    edge = load * (0.96 if falls else 1.04)
    parts = [((-0.5, 0.0), (edge, 1.0), (n, n)), ((0.0, 1.0), (1.0, 2.0), (m, m))]
    marks = levels(1, (BASE, 0.0, 1), (OTHER, 1.0, 1), (TOP, 1.0, 2))
    marks.append((LOADED, layer(2, 2.0, facet / m, (facet + 1) / m), 2))
    posed = draw.pose(draw.frame(2), "quadrilateral", parts, marks, young=[1.0, 1.0])
    posed.hold(BASE)
    posed.push((0.0, -1e-3))
    posed.add_pair(slave, TOP + OTHER - slave, roles="given", name="joint")
    posed.accuracy["rtol"] = 1e-6
    try:
        answer = posed.solve()
    except UnresistedMotion as error:
        if falls:
            raise RightError(str(error)) from None
        raise
    force = abs(answer.forces["joint"][1])
    ratios = {"force": abs(force * m / 1e-3 - 1.0) / 1e-4}
    return {**ratios, "falls, but holds": np.inf if falls else 0.0}


@situation(2.0)
def shared_nodes(draw: Draw) -> Ratios:
    """Surfaces of which parts are in several contacts, ties or supports, or in one."""
    kind = draw.one_of("parts", "parts", "tie", "tie", "support")
    cell = draw.cell("quadrilateral", "triangle", "hexahedron")
    g = dimension(cell)
    n = draw.count(3, 5) if g == 2 else 2
    # mortar conditions of a node are one for each part of its surface
    m = n if kind == "tie" or draw.one_of(True, True, False) else n + 1
    # Tresca's law acts at open nodes, too, so that it tells surfaces of other sizes apart
    law = draw.one_of(None, Coulomb(0.4), *[Tresca(2e-4)] * (kind == "parts"))
    method = draw.one_of("linear", "linear", "exact")
    if isinstance(law, Tresca):
        # sliding bends the surfaces: where these are deformed, two contacts have two normals at the
        # node at their border and one has the mean. That is another discrete problem, whose
        # solution differs by an amount that falls with h^2
        method = "linear"
    border = draw.count(1, 2 * n - 2)
    frames = draw.frame(g), draw.frame(g, along_axes=True)
    if kind == "support":
        return _support_beside_friction(draw, cell, n, law, method)

    def solved(frame: Frame, first: float, is_one: bool) -> Answer:
        """Begin the second contact at `first`, or have one contact up to the border and beyond."""
        limit = border / n
        end = 2.0 if is_one and kind == "parts" else limit
        marks = [
            (BASE, at(g - 1, 0.0)),
            (LOADED, at(g - 1, 2.0)),
            (TOP, layer(g, 1.0, high=end), 1),
        ]
        split = end < 2.0
        if split:
            marks.append((SECOND, layer(g, 1.0, low=first), 1))
        # the master's surface is whole, as meshes may differ
        marks.append((OTHER, at(g - 1, 1.0), 2))
        parts = [block(g, 2.0, n), block(g, 2.0, m, low=1.0)]
        posed = draw.pose(
            frame, cell, parts, marks, method, poisson=0.0 if kind == "parts" else 0.3
        )
        posed.accuracy["subdomain_size"] = 3000
        posed.hold(BASE)
        posed.hold(LOADED, up(g, -0.01, 0.004 if law else 0.0))
        if kind == "tie":
            posed.contacts.append(TiedPair(posed.facet_tags, TOP, OTHER, name="left"))
        else:
            posed.add_pair(TOP, OTHER, friction=law, name="left", roles="given")
        if split:
            posed.add_pair(SECOND, OTHER, friction=law, name="right", roles="given")
        if not is_one and draw.rng.random() < 0.5:
            posed.contacts.reverse()
        answer = posed.solve()
        if kind == "parts" and law is None:
            worst = [abs(p / 0.005 - 1.0).max(initial=0.0) for p in answer.pressures.values()]
            pressures.append(max(worst) / 1e-4)
        answer.forces = {"all": np.sum(list(answer.forces.values()), axis=0)}
        laws.append(Laws(posed).ratios())
        return answer

    pressures: list[float] = []
    laws: list[Ratios] = []
    first = solved(frames[0], border / n, False)
    if kind == "tie":
        # one facet shorter: the tie decides the node between
        second = solved(frames[1], (border + 1) / n, True)
        first.forces.clear()
    else:
        second = solved(frames[1], border / n, True)
    assert draw.posed is not None
    ratios = worst(*laws, differ(draw.posed, first, second, 1e-5 if m == n else 5e-2))
    return ratios | {"pressure": max(pressures, default=0.0)}


def _support_beside_friction(draw: Draw, cell: str, n: int, law: Any, method: str) -> Ratios:
    """A frictional surface that reaches a support along the obstacle's normal, or ends before."""
    g = dimension(cell)
    compression = 0.01

    def solved(frame: Frame, first: float) -> Answer:
        side = lambda x: np.isclose(x[0], 2.0) & (x[g - 1] > first - 1e-6)  # noqa: E731
        marks = [(TOP, at(g - 1, 1.0)), (TOP, side), (LEFT, at(0, 0.0)), (BASE, at(g - 1, 0.0))]
        marks += [(BACK, at(1, 0.0))] * (g - 2)
        posed = draw.pose(frame, cell, [block(g, 2.0, n)], marks, method)
        for tag, axis in [(BASE, g - 1), (LEFT, 0), (BACK, 1)][:g]:
            posed.guide(tag, axis)
        posed.add_obstacle(TOP, ceiling(g, 1.0 - compression), friction=law, name="plane")
        answer = posed.solve()
        laws.append(Laws(posed).ratios())
        return answer

    laws: list[Ratios] = []
    first = solved(draw.frame(g, along_axes=True), 0.0)
    second = solved(draw.frame(g, along_axes=True), 1.0 / n)
    assert draw.posed is not None
    return worst(*laws, differ(draw.posed, first, second, 1e-5))


@situation(1.5)
def several_bodies(draw: Draw) -> Ratios:
    """Bodies side by side under one tag, or with a contact each."""
    cell = draw.cell("quadrilateral", "triangle", "hexahedron")
    g, n = dimension(cell), draw.count(2, 4) if dimension(cell) == 2 else 2
    side, alike = draw.one_of("master", "slave"), draw.one_of(True, False)
    m = n if alike else n + 1
    soft, law = 10.0 ** draw.between(-2, 0), draw.one_of(None, None, Coulomb(0.3))
    gap, method = draw.one_of(0.0, 0.2), draw.one_of("linear", "linear", "exact", "finite")
    if method != "linear":
        # bodies that touch each other sideways would overlap once the bar presses them
        gap = max(gap, 0.05)

    def solved(frame: Frame, is_one: bool) -> Answer:
        left, right, bar = block(g, 1.0, n), block(g, 1.0, n), block(g, 2.0 + gap, m, low=1.0)
        shift = up(g, 0.0, 1.0 + gap)
        right = (tuple(right[0] + shift), tuple(right[1] + shift), right[2])
        marks = levels(g - 1, (BASE, 0.0), (LOADED, 2.0), (SECOND, 1.0, 3))
        marks += [(TOP, at(g - 1, 1.0), 1), (TOP if is_one else OTHER, at(g - 1, 1.0), 2)]
        posed = draw.pose(frame, cell, [left, right, bar], marks, method, young=[soft, 1.0, 1.0])
        posed.accuracy["subdomain_size"] = 3000
        posed.hold(BASE)
        posed.hold(LOADED, up(g, -0.01, 0.002))
        for k in range(1 if is_one else 2):
            tags = (TOP + k, SECOND) if side == "slave" else (SECOND, TOP + k)
            posed.add_pair(*tags, roles="given", friction=law, name=f"pair {k}")
        answer = posed.solve()
        laws.append(Laws(posed).ratios())
        answer.forces = {"all": np.sum(list(answer.forces.values()), axis=0)}
        return answer

    laws: list[Ratios] = []
    first, second = solved(draw.frame(g), True), solved(draw.frame(g), False)
    assert draw.posed is not None
    return worst(*laws, differ(draw.posed, first, second, 1e-5 if method == "linear" else 1e-4))


@situation(1.5)
def sides_in_tag(draw: Draw) -> Ratios:
    """A box that is tagged with its sides is its foot."""
    cell = draw.cell("quadrilateral", "triangle", "hexahedron")
    g, m = dimension(cell), draw.count(2, 4) if dimension(cell) == 2 else 2
    method = draw.one_of("linear", "linear", "exact", "finite")
    law, stiff = draw.one_of(None, None, Coulomb(0.3)), 10.0 ** draw.between(0, 3)
    roles, table = draw.one_of("given", "auto"), draw.count(4, 7) if g == 2 else draw.count(3, 5)
    sides = [k for k in range(g - 1) if draw.one_of(True, True, False)] or [0]
    where, along = draw.between(0.7, 1.3), 0.002 if law else 0.0

    def solved(frame: Frame, whole: bool) -> Answer:
        low, high = (where,) * (g - 1), (where + 1.0,) * (g - 1)
        parts = [
            ((0.0,) * g, (3.0,) * (g - 1) + (1.0,), (table,) * (g - 1) + (2,)),
            ((*low, 1.0), (*high, 2.0), (m,) * g),
        ]

        marks = [(BASE, at(g - 1, 0.0), 1), (OTHER, at(g - 1, 1.0), 1)]
        marks += [(TOP, at(g - 1, 1.0), 2), (LOADED, at(g - 1, 2.0), 2)]
        if whole:
            marks += [(TOP, at(k, end), 2) for k in sides for end in (low[0], high[0])]
        posed = draw.pose(frame, cell, parts, marks, method, young=[stiff, 1.0])
        posed.hold(BASE)
        posed.hold(LOADED, up(g, -0.02, along))
        posed.add_pair(TOP, OTHER, friction=law, roles=roles, name="foot")
        answer = posed.solve()
        laws.append(Laws(posed).ratios())
        return answer

    laws: list[Ratios] = []
    first, second = solved(draw.frame(g), True), solved(draw.frame(g), False)
    assert draw.posed is not None
    return worst(*laws, differ(draw.posed, first, second, 1e-5 if method == "linear" else 1e-4))


@situation(1.0)
def interference(draw: Draw) -> Ratios:
    """Pairs that are found between bodies that overlap, have gaps or waves, or that are named."""
    kind = draw.one_of("lap joint", "chain", "press fit", "waves")
    amount = draw.one_of(0.0, 1e-6, 1e-4, 1e-3, 1e-2)
    n, m = draw.count(1, 3), draw.count(1, 3)
    shape = None
    pairs = [(TOP, OTHER)]
    if kind == "lap joint":
        lap = draw.between(0.3, 1.0)
        parts = [
            ((0.0, 0.0), (3.0, 1.0), (6 * n, n)),
            ((lap - 3.0, 1.0 - amount), (lap, 2.0 - amount), (6 * m, m)),
        ]
        marks = [
            (OTHER, at(1, 1.0), 1),
            (TOP, at(1, 1.0 - amount), 2),
            (BASE, at(0, 3.0), 1),
            (LOADED, at(0, lap - 3.0), 2),
        ]
    elif kind == "chain":
        parts = [
            ((0.0, 0.0), (3.0, 1.0), (6 * n, n)),
            ((-2.5, 1.0 - amount), (0.5, 2.0 - amount), (6 * m, m)),
            ((2.5, 1.0 - amount), (5.5, 2.0 - amount), (6 * n, n)),
        ]
        marks = levels(1, (OTHER, 1.0, 1), (TOP, 1.0 - amount, 2), (SECOND, 1.0 - amount, 3))
        marks += [(BASE, at(1, 0.0), 1), (LOADED, at(0, -2.5), 2), (LEFT, at(0, 5.5), 3)]
        pairs.append((SECOND, OTHER))
    elif kind == "press fit":
        parts = [
            ((0.0, 0.0), (1.0, 1.0), (2 * n, 2 * n)),
            ((1.0 - amount, 0.0), (2.0 + amount, 1.0), (2 * m, 2 * m)),
            ((2.0, 0.0), (3.0, 1.0), (2 * n, 2 * n)),
        ]
        marks = levels(0, (OTHER, 1.0, 1), (TOP, 1.0 - amount, 2), (SECOND, 2.0 + amount, 2))
        marks += [
            (FOURTH, at(0, 2.0), 3),
            (BASE, at(0, 0.0), 1),
            (LOADED, at(1, 0.0), 2),
            (LEFT, at(0, 3.0), 3),
        ]
        pairs.append((SECOND, FOURTH))
    else:
        offset, height = draw.between(-0.4, 0.4), draw.one_of(0.02, 0.05)
        parts = [
            ((0.0, 0.0), (2.0, 1.0), (4 * n, 2 * n)),
            ((offset, 1.0), (2.0 + offset, 2.0), (4 * m, 2 * m)),
        ]
        marks = levels(1, (OTHER, 1.0, 1), (TOP, 1.0, 2), (BASE, 0.0, 1), (LOADED, 2.0, 2))
        shape = lambda x: np.stack([x[0], x[1] + height * np.sin(3.0 * x[0])])  # noqa: E731

    if n < m:
        # of pairs that are found the slave has the larger facets; with the roles exchanged this is
        # another discrete problem, which differs by more than a tenth on meshes of four facets
        pairs = [(master, slave) for slave, master in pairs]

    def solved(frame: Frame, is_named: bool) -> Answer:
        posed = draw.pose(frame, "quadrilateral", parts, marks, "linear", shape)
        posed.hold(BASE)
        posed.hold(LOADED, up(2, -0.001))
        if (LEFT, marks[-1][1]) == marks[-1][:2]:
            posed.hold(LEFT)
        for slave, master in pairs if is_named else ():
            posed.add_pair(slave, master, roles="given")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            answer = posed.solve(**({} if is_named else {"contacts": "auto"}))
        answer.forces.clear()
        return answer

    first, second = solved(draw.frame(2), True), solved(draw.frame(2), False)
    assert draw.posed is not None
    if kind == "waves":
        # gaps between facets of other sizes depend on the slave: nothing is pushed far
        sizes = [draw.posed.largest(answer.u) for answer in (first, second)]
        return {"size": sizes[1] / (5.0 * sizes[0])}
    # nodes may be in pairs
    return differ(draw.posed, first, second, 0.1)


@situation(1.5)
def pressures(draw: Draw) -> Ratios:
    """A uniform state: pressures are the force over the present area, at corners too."""
    cell = draw.cell("quadrilateral", "triangle", "hexahedron")
    g, method = dimension(cell), draw.one_of("linear", "finite", "finite")
    n, m = (draw.count(2, 4), draw.count(2, 5)) if g == 2 else (2, draw.one_of(2, 3))
    down = draw.between(0.05, 0.2)
    degree = draw.one_of(1, 1, 2) if g == 2 and method == "linear" else 1
    frame = draw.frame(g, along_axes=True)
    parts = [block(g, 1.0, n), ((0.0,) * (g - 1) + (1.0,), (1.0,) * (g - 1) + (2.0,), (m,) * g)]
    marks = [
        (BASE, at(g - 1, 0.0)),
        (LOADED, at(g - 1, 2.0)),
        (LEFT, at(0, 0.0)),
        (OTHER, at(g - 1, 1.0), 1),
        (TOP, at(g - 1, 1.0), 2),
    ]
    marks += [(BACK, at(1, 0.0))] * (g - 2)
    posed = draw.pose(frame, cell, parts, marks, method, degree=degree)
    for tag, axis in [(BASE, g - 1), (LEFT, 0), (BACK, 1)][:g]:
        posed.guide(tag, axis)
    posed.add_pair(TOP, OTHER, name="pair", partners=draw.one_of(None, Mortar()))
    level = {"now": 2.0}
    posed.add_obstacle(LOADED, lambda x: (level["now"] - x[-1], -up(g)), name="plane")
    posed.make()
    steps = 1 if method == "linear" else int(np.ceil(down / 0.1))
    for k in range(steps):
        level["now"] = 2.0 - down * (k + 1) / steps
        answer = posed.solve()
        posed.advance()
    own = posed.places[:, : posed.owned].T
    ends = [
        draw.comm.allreduce(
            (own[:, k] + (answer.u[:, k] if method == "finite" else 0.0)).max(initial=0.0), MPI.MAX
        )
        for k in range(g - 1)
    ]
    area = float(np.prod(ends))
    found: Ratios = {}
    for name, pressure in answer.pressures.items():
        exact = abs(answer.forces[name][-1]) / area
        whole = posed.solved.results[name].gather()
        areas = whole.area.sum() / frame.metre ** (g - 1)
        found[f"pressure of {name}"] = float(np.abs(pressure / exact - 1.0).max()) / 1e-4
        found[f"area of {name}"] = abs(areas / area - 1.0) / 1e-4
    return worst(Laws(posed).ratios(), found)


@situation(1.0)
def cracks(draw: Draw) -> Ratios:
    """The pressure of a closed crack under a uniform stress is uniform up to its tips."""
    n = draw.count(5, 10)
    kind = draw.one_of("quadrilateral", "triangle")
    begin = draw.count(0, n - 4)
    end = draw.count(begin + 3, n)
    if begin == 0 and end == n:
        end = n - 1
    degree, partners = draw.one_of((1, None), (1, Mortar()), (2, None))
    law = draw.one_of(None, Tresca(1e-3), Coulomb(0.3))
    frame = draw.frame(2)
    cells = {"quadrilateral": CellType.quadrilateral, "triangle": CellType.triangle}[kind]
    mesh = create_rectangle(draw.comm, [np.zeros(2), np.array([1.0, 2.0])], [n, 4], cells)
    mesh.topology.create_connectivity(1, 2)
    index = mesh.topology.index_map(2)
    every = np.arange(index.size_local + index.num_ghosts, dtype=np.int32)
    low, high = begin / n - 1e-6, end / n + 1e-6
    cut = locate_entities(mesh, 1, lambda x: np.isclose(x[1], 1.0) & (x[0] > low) & (x[0] < high))
    whole = TaggedMesh(
        mesh,
        meshtags(mesh, 2, every, np.ones_like(every)),
        meshtags(mesh, 1, np.sort(cut), np.full_like(cut, 9)),
        {},
    )
    parts = split_interfaces(whole, [Interface((1, 1), (TOP, OTHER), facets=9)])
    ends = tag_facets(parts.mesh, {LOADED: at(1, 2.0), BASE: at(1, 0.0)})
    tags = _joined(parts.mesh, parts.facet_tags, ends)
    x = parts.mesh.geometry.x
    x[:, :2] = frame.points(x[:, :2].T).T
    posed = Posed(parts.mesh, tags, parts.cell_tags, frame, "linear", [1.0], 0.0, degree)
    draw.posed = posed
    draw.story.append(f"{kind}, {n} cells, crack from {begin} to {end}, degree {degree}")
    posed.hold(BASE)
    posed.push((0.0, -1e-3))
    posed.add_pair(TOP, OTHER, partial=True, partners=partners, friction=law, name="crack")
    answer = posed.solve()
    off = float(np.abs(answer.pressures["crack"] / 1e-3 - 1.0).max(initial=0.0))
    return {"pressure": off / 1e-4, "equilibrium": Laws(posed).ratios()["equilibrium"]}


def _joined(mesh: Any, *every: Any) -> Any:
    """Return tags of facets in one."""
    facets = np.concatenate([tags.indices for tags in every])
    values = np.concatenate([tags.values for tags in every])
    order = np.argsort(facets)
    return meshtags(mesh, mesh.topology.dim - 1, facets[order], values[order])

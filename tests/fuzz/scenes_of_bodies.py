"""Rigid bodies that meet, travel and turn, and bodies whose rotations are large."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from drawing import (
    OTHER,
    TOP,
    Draw,
    Ratios,
    RightError,
    block,
    ceiling,
    levels,
    situation,
    up,
    worst,
)
from laws import Laws
from posed import BASE, LOADED, Answer, Frame, Posed, differ
from scenes import at, dimension

from fenics_tfeti import Coulomb, TiedPair
from fenics_tfeti.errors import InputError
from fenics_tfeti.typing import Vector


@situation(2.0)
def moving_bodies(draw: Draw) -> Ratios:
    """Several rigid bodies and stops press on one surface, and share its nodes."""
    cell = draw.cell()
    g, n = dimension(cell), draw.count(2, 4) if dimension(cell) == 2 else 2
    method = draw.one_of("linear", "linear", "exact", "finite")
    frame = draw.frame(g, along_axes=True)
    posed = draw.pose(
        frame, cell, [block(g, 2.0, n)], [(BASE, at(g - 1, 0.0)), (TOP, at(g - 1, 1.0))], method
    )
    law = draw.one_of(None, None, Coulomb(0.3))
    posed.hold(BASE, up(g, draw.between(0.01, 0.08), 0.02 if law else 0.0))
    # a node that stands on the edge of an obstacle would slide off it and on again
    beyond = 0.0 if method == "linear" else 0.3 / n
    border = draw.count(1, 2 * n - 1) / n + beyond
    left, right = (-beyond, border), (border, 2.0 + beyond)
    spans = [(-np.inf, np.inf)] * draw.count(1, 2)
    spans += draw.one_of([], [left, right])
    if len(spans) == 1:
        spans.append(left)
    for k in draw.rng.permutation(len(spans)):
        low, high = spans[k]
        middle = [0.5 * (max(low, 0.0) + min(high, 2.0)), *[0.5] * (g - 2), 1.0]
        gap = draw.one_of(0.0, 0.0, 0.01, 0.03)
        kind = draw.one_of("stop", "lid", "spring", "weight")
        name = f"{kind} {k}"
        more: dict[str, Any] = {"translation": [0.0] * (g - 1) + [None], "rotation": 0.0}
        stiffness = 10.0 ** draw.between(-3, 1)
        springs = np.repeat([stiffness], 3 if g == 2 else 6)
        if kind == "lid":
            more["spring"] = np.append(springs[:g], 0.0 * springs[g:])
        elif kind == "spring":
            more = {"spring": springs}
        elif kind == "weight":
            more["force"] = up(g, -0.01)
        body = None if kind == "stop" else frame.body(middle, name=name, **more)
        if kind == "weight":
            # it lies on the surface
            gap = 0.0
        posed.add_obstacle(
            TOP, ceiling(g, 1.0 + gap, low, high), rigid_body=body, name=name, friction=law
        )
    posed.solve()
    return Laws(posed).ratios()


@situation(1.0)
def tied_caps(draw: Draw) -> Ratios:
    """Rigid caps that are tied to one surface, side by side, and a stop above."""
    n, frame = draw.count(2, 4), draw.frame(2, along_axes=True)
    count, method = draw.count(1, 2), draw.one_of("linear", "linear", "exact", "finite")
    ends = [0.0, 2.0] if count == 1 else [0.0, draw.count(1, 2 * n - 1) / n, 2.0]
    caps = [
        ((low, 1.0), (high, 1.5), (round(n * (high - low)), 1))
        for low, high in zip(ends[:-1], ends[1:], strict=True)
    ]
    marks = [(BASE, at(1, 0.0), 1), (TOP, at(1, 1.0), 1)]
    marks += [(OTHER + k, at(1, 1.0), k + 2) for k in range(count)]
    posed = draw.pose(frame, "quadrilateral", [block(2, 2.0, n), *caps], marks, method, poisson=0.0)
    posed.hold(BASE, up(2, draw.between(0.02, 0.08)))
    level, has_stop = draw.between(0.0, 0.03), draw.one_of(True, True, False)
    for k in range(count):
        # the second one has a spring
        free = [0.0, None] if k == 0 else [None, None]
        spring = {} if k == 0 else {"spring": np.full(3, draw.between(0.01, 1.0))}
        posed.rigid[k + 2] = frame.body(
            (ends[k], 1.5),
            translation=free,
            rotation=None if spring else 0.0,
            name=f"cap {k}",
            **spring,
        )
        posed.contacts.append(TiedPair(posed.facet_tags, TOP, OTHER + k, name=f"weld {k}"))
    if has_stop:
        posed.add_obstacle(TOP, ceiling(2, 1.0 + level), name="stop")
    posed.contacts = [posed.contacts[k] for k in draw.rng.permutation(len(posed.contacts))]
    posed.solve()
    laws = Laws(posed)
    ratios = laws.ratios()
    own = posed.places[:, : posed.owned]
    for k in range(count):
        there = posed.nodes_on(TOP) & (own[0] > ends[k] - 1e-6) & (own[0] < ends[k + 1] + 1e-6)
        x = laws.x[there, :2]
        if method == "linear":
            expected = laws.motion_of(posed.rigid[k + 2], x)
            off = laws.u[there] - expected
        else:
            off = laws.before(posed.rigid[k + 2], x + laws.u[there]) - x
        ratios[f"weld {k}"] = posed.largest(off) / (1e-5 * laws.length)
    return ratios


@situation(1.5)
def travelling_plate(draw: Draw) -> Ratios:
    """A rigid plate that travels, or turns, before its weight acts, or is there from the start."""
    cell = draw.cell("quadrilateral", "quadrilateral", "hexahedron")
    g, method = dimension(cell), draw.one_of("exact", "finite", "linear")
    # in the linear problem a plate on blocks has the arms of the undeformed state
    travel = 0.0 if method == "linear" else draw.between(-0.8, 0.8)
    turned = draw.one_of(0.0, 0.0, 0.02) if method != "linear" else 0.0
    has_cells = g == 2 and draw.one_of(False, False, True) and not turned
    law = draw.one_of(None, None, Coulomb(0.3)) if travel == 0.0 else None
    places = [(0.0, 0.0), (3.0, 0.0)] if g == 2 else [(0.0, 0.0), (3.0, 0.0), (0.0, 3.0)]
    if g == 2 and draw.one_of(False, True):
        places.append((5.0, 0.0))
    n, weight, at_x = draw.count(1, 3), 10.0 ** draw.one_of(-9, -7, -4, -2), draw.between(1.5, 2.5)
    reference = np.array([at_x, 1.0]) if g == 2 else np.array([at_x, 1.5, 1.0])

    def solved(frame: Frame, moved: float, angle: float) -> tuple[Answer, Ratios]:
        """Solve with a plate that travels by `moved` of the way itself."""
        parts = [
            ((a, 0.0), (a + 1.0, 1.0), (n, n))
            if g == 2
            else ((a, b, 0.0), (a + 1.0, b + 1.0, 1.0), (1, 1, 1))
            for a, b in places
        ]
        marks: list[Any] = [
            mark
            for k in range(len(places))
            for mark in [(BASE, at(g - 1, 0.0), k + 1), (TOP + k, at(g - 1, 1.0), k + 1)]
        ]
        if has_cells:
            begin = travel - moved
            parts.append(((-3.0 + begin, 1.0), (9.0 + begin, 1.2), (4, 1)))
            marks.append((TOP + 5, at(1, 1.0), len(parts)))
        posed = draw.pose(frame, cell, parts, marks, method)
        posed.hold(BASE)
        along = [moved] + [0.0] * (g - 2) + [None]
        rotation = None if not turned else ([angle] if g == 2 else [0.0, angle, 0.0])
        if rotation is not None:
            rotation = angle if g == 2 else rotation
        plate = frame.body(
            reference + up(g, 0.0, travel - moved),
            force=up(g, -weight),
            translation=along,
            name="plate",
            **({} if rotation is None else {"rotation": rotation}),
            **({} if g == 2 or rotation is not None else {"rotation": [None, None, 0.0]}),
        )
        if has_cells:
            posed.rigid[len(parts)] = plate
        tilt = (turned - angle) * (1.0 if g == 2 else -1.0)

        def flat(x: Vector) -> tuple[Vector, Vector]:
            # turned about the point where the reference is at last
            point = reference + up(g, 0.0, travel)
            normal = up(g, -np.cos(tilt), np.sin(tilt))
            return normal @ (x - point[:, None]), normal

        for k in range(len(places)):
            name = f"block {k}"
            if has_cells:
                posed.add_pair(TOP + k, TOP + 5, name=name, friction=law, roles="given")
            elif turned and moved:
                # the same plate before it travels
                before = lambda x: flat(x + up(g, 0.0, moved)[:, None])  # noqa: E731
                posed.add_obstacle(TOP + k, before, rigid_body=plate, name=name, friction=law)
            else:
                posed.add_obstacle(TOP + k, flat, rigid_body=plate, name=name, friction=law)
        posed.accuracy["subdomain_size"] = 3000
        answer = posed.solve()
        if has_cells:
            # the nodes of the plate are at other places
            answer = answer.only(posed.bodies_of_nodes() <= len(places))
        return answer, Laws(posed, 1e-4).ratios()

    first, ratios = solved(draw.frame(g, along_axes=True), travel, turned)
    posed = draw.posed
    assert posed is not None
    if not (travel or turned):
        return ratios
    second, more = solved(draw.frame(g, along_axes=True), 0.0, 0.0)
    return worst(ratios, more, differ(posed, first, second, 2e-3))


@situation(1.0)
def turning_obstacle(draw: Draw) -> Ratios:
    """A roller that friction holds, moved as a body or by the function of its displacements."""
    method, n = draw.one_of("linear", "exact", "finite"), draw.count(4, 6)
    radius, press = draw.between(0.4, 0.8), draw.between(0.01, 0.05)
    angle, law = draw.between(-0.06, 0.06), Coulomb(draw.one_of(2.0, 0.3))
    along = draw.one_of(0.0, 0.02)
    if method == "linear":
        press, angle = 0.1 * press, 0.01 * angle
        along *= 0.01
    centre = np.array([1.0, 1.0 + radius - press])

    def solved(frame: Frame, by_body: bool) -> Answer:
        posed = draw.pose(
            frame,
            "quadrilateral",
            [block(2, 2.0, n)],
            [(BASE, at(1, 0.0)), (TOP, at(1, 1.0))],
            method,
        )
        posed.accuracy["subdomain_size"] = 3000
        posed.hold(BASE)
        now = {"turn": 0.0, "along": 0.0}

        def moved(x: Vector) -> Vector:
            """Return how far the points of the roller that are at x now have been moved."""
            t = np.array([[now["along"]], [0.0]])
            if method == "linear":
                arm = x - centre[:, None]
                return t + now["turn"] * np.stack([-arm[1], arm[0]])
            c, s = np.cos(now["turn"]), np.sin(now["turn"])
            arm = x - centre[:, None] - t
            moves: Vector = x - centre[:, None] - np.array([[c, s], [-s, c]]) @ arm
            return moves

        def roller(x: Vector) -> tuple[Vector, Vector]:
            out = x - centre[:, None]
            if not by_body and method != "linear":
                out = out - np.array([[now["along"]], [0.0]])
            size = np.linalg.norm(out, axis=0)
            gap, normal = size - radius, out / size
            if not by_body and method == "linear":
                gap = gap - normal[0] * now["along"]
            return gap, normal

        class Angle:
            """What a Constant is: the value is read by each solve."""

            value = 0.0

        class Way:
            value = np.zeros(2)

        turn, way = Angle(), Way()
        if by_body:
            body = frame.body(centre, translation=[0.0, 0.0], rotation=0.0, name="roller")
            body = type(body)(body.reference, translation=way, rotation=turn, name="roller")
            posed.add_obstacle(TOP, roller, rigid_body=body, friction=law, name="roller")
        else:
            posed.add_obstacle(TOP, roller, displacement=moved, friction=law, name="roller")
        posed.solve()
        posed.advance()
        turn.value, way.value = angle, frame.metre * frame.turn @ np.array([along, 0.0])
        now["turn"], now["along"] = angle, along
        return posed.solve()

    first = solved(draw.frame(2), True)
    second = solved(draw.frame(2), False)
    assert draw.posed is not None
    # the arm to a node is longer than that to the roller by the gap
    return differ(draw.posed, first, second, 3e-3)


def _driven(posed: Posed, angle: float, press: float) -> None:
    """Turn what BASE and LOADED hold by an angle, LOADED after it has come down."""
    c, s = np.cos(angle), np.sin(angle)
    Q = np.array([[c, -s], [s, c]])
    down = Q @ np.array([[0.0], [-press]])
    if posed.method != "finite":
        Q, down = np.array([[1.0, -angle], [angle, 1.0]]), np.array([[0.0], [-press]])
    posed.hold(BASE, lambda x: Q @ x - x)
    posed.hold(LOADED, lambda x: Q @ x - x + down)


def _turned_back(answer: Answer, posed: Posed, angle: float) -> Answer:
    """Return displacements and forces in the frame that turns with the bodies."""
    own = posed.places[:, : posed.owned].T
    c, s = np.cos(angle), np.sin(angle)
    Q = np.array([[c, -s], [s, c]])
    if posed.method != "finite":
        linear = angle * np.column_stack([-own[:, 1], own[:, 0]])
        return replace(answer, u=answer.u - linear)
    forces = {name: Q.T @ force for name, force in answer.forces.items()}
    return replace(answer, u=(own + answer.u) @ Q - own, forces=forces)


def _turn_in_steps(posed: Posed, angle: float, press: float) -> Answer:
    """Turn first and press then, where rotations are not small in steps."""
    whole = angle if posed.method == "finite" else 0.0
    steps = max(1, int(np.ceil(abs(whole) / 0.25)))
    own = posed.places
    for k in range(1, steps + 1):
        posed.bcs.clear()
        _driven(posed, angle * k / steps, press if k == steps else 0.0)
        if posed.method == "finite" and k < steps:
            # Newton's method starts from the rotation
            c, s = np.cos(angle * k / steps), np.sin(angle * k / steps)
            rigid = np.array([[c, -s], [s, c]]) @ own - own
            posed.now.x.array[:] = (posed.frame.metre * posed.frame.turn @ rigid).T.ravel()
            continue
        if posed.solved is None:
            posed.make()
        answer = posed.solve()
    return answer


@situation(1.0)
def given_normal(draw: Draw) -> Ratios:
    """Normals that are given, of bodies that turn before they are pressed."""
    method = draw.one_of("linear", "finite", "finite")
    angle = draw.between(-2.0, 2.0) if method == "finite" else draw.between(-0.01, 0.01)
    press, n, m = draw.between(0.005, 0.03), draw.count(2, 4), draw.count(2, 4)
    parts = [((-1.0, 0.0), (1.0, 1.0), (2 * n, n)), ((-0.5, 1.0), (0.5, 2.0), (m, m))]
    marks = levels(1, (BASE, 0.0, 1), (OTHER, 1.0, 1), (TOP, 1.0, 2), (LOADED, 2.0, 2))
    kind = draw.one_of("vector", "function")

    def solved(frame: Frame, is_given: bool, angle: float) -> Answer:
        posed = draw.pose(frame, "quadrilateral", parts, marks, method)
        normal: Any = frame.turn @ np.array([0.0, -2.0])
        if kind == "function":
            normal = frame.vectors(lambda x: np.tile([[0.0], [-1.0]], x.shape[1]), 1.0)
        given = {"normal": normal} if is_given else {}
        posed.add_pair(TOP, OTHER, roles="given", name="joint", **given)
        return _turned_back(_turn_in_steps(posed, angle, press), posed, angle)

    first = solved(draw.frame(2), False, 0.0)
    try:
        second = solved(draw.frame(2), True, angle)
    except InputError as error:
        if method == "finite" and "normal" in str(error) and "given" in str(error):
            raise RightError(str(error)) from None
        raise
    assert draw.posed is not None
    # normals at edges of the deformed surface are others than one that only turns
    return differ(draw.posed, first, second, 1e-2 if method == "finite" else 1e-5)


@situation(1.5)
def turned_ties(draw: Draw) -> Ratios:
    """Parts that are tied over gaps, or none, turned and then pressed as if they were not."""
    method = draw.one_of("linear", "finite", "finite")
    angle = draw.between(-3.0, 3.0) if method == "finite" else draw.between(-0.01, 0.01)
    gap, press = draw.one_of(0.0, 0.02), draw.one_of(0.0, 0.03)
    bent = draw.one_of(0.0, 0.3)
    n, m = draw.count(2, 4), draw.count(2, 6)
    parts = [((-1.0, 0.0), (1.0, 1.0), (2 * n, n)), ((-1.0, 1.0), (1.0, 2.0), (m, 3))]
    marks = levels(1, (BASE, 0.0, 1), (OTHER, 1.0, 1), (TOP, 1.0, 2), (LOADED, 2.0, 2))

    def bend(x: Vector) -> Vector:
        # curved, so that facets of other sizes have gaps; the tied surfaces are at 1 at first
        y = x[1] + bent * (1.0 - x[0] ** 2)
        return np.stack([x[0], y])

    def solved(frame: Frame, angle: float) -> tuple[Answer, Posed]:
        posed = draw.pose(frame, "quadrilateral", parts, marks, method, bend if bent else None)
        if gap:
            nodes = posed.nodes(2)
            posed.mesh.geometry.x[nodes, :2] += gap * frame.metre * frame.turn[:, 1]
        posed.contacts.append(TiedPair(posed.facet_tags, TOP, OTHER, name="tie"))
        answer = _turn_in_steps(posed, angle, press)
        return _turned_back(answer, posed, angle), posed

    frame = draw.frame(2)
    second, posed = solved(frame, angle)
    if not press:
        # nothing is strained
        size = frame.newton
        ratios = {"stress": posed.largest(Laws(posed).residual) / (1e-6 * size)}
        return ratios | {"u": posed.largest(second.u) / 1e-6}
    first, posed = solved(draw.frame(2), 0.0)
    return differ(posed, first, second, 1e-5 if method == "linear" else 1e-4)

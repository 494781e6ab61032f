"""What happens between solves: contacts, weights and loads that change, and what is told."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from drawing import (
    LEFT,
    OTHER,
    SECOND,
    TOP,
    Draw,
    Ratios,
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

from fenics_tfeti import ContactPair, Coulomb, RigidObstacle, Tresca
from fenics_tfeti.errors import InputError
from fenics_tfeti.typing import Vector


@situation(1.0)
def swapped_contacts(draw: Draw) -> Ratios:
    """The history of friction follows a contact whose place in the list changes."""
    method, n = draw.one_of("linear", "exact", "finite"), draw.count(2, 4)
    laws = draw.one_of(Coulomb(0.4), Tresca(5e-4)), Coulomb(draw.one_of(0.2, 0.8))
    change = draw.one_of("swapped", "renewed", "one added")
    steps = [
        ([0.01, 0.0], [0.005, 0.0]),
        ([-0.002, 0.001], [0.004, 0.002]),
        ([-0.002, -0.002], [0.004, draw.between(-0.005, 0.005)]),
    ]

    def solved(frame: Frame, is_changed: bool) -> Answer:
        marks = [(LOADED, at(0, 0.0)), (TOP, layer(2, 1.0, 0.9)), (OTHER, layer(2, 0.0, 0.9))]
        posed = draw.pose(frame, "quadrilateral", [block(2, 2.0, n)], marks, method)
        move = posed.hold(LOADED)
        # how far the obstacles have moved along the surfaces
        dragged = np.zeros(2)
        for k, (tag, shape, name) in enumerate(
            [(TOP, ceiling(2, 0.99), "upper"), (OTHER, lambda x: (x[1] + 0.0, up(2)), "lower")]
        ):
            drag = lambda x, k=k: dragged[k] * np.tile([[1.0], [0.0]], x.shape[1])  # noqa: E731
            posed.add_obstacle(tag, shape, friction=laws[k], displacement=drag, name=name)
        posed.make()
        for k, (way, drag) in enumerate(steps):
            move(np.array(way))
            dragged[:] = drag
            if is_changed and k == 1:
                posed.solved.contacts = _changed(posed, change)
            answer = posed.solve()
            posed.advance()
        answer.forces.pop("more", None)
        return answer

    first, second = solved(draw.frame(2), True), solved(draw.frame(2), False)
    assert draw.posed is not None
    return differ(draw.posed, first, second, 1e-4)


def _changed(posed: Posed, change: str) -> list[Any]:
    """Return the same contacts in another order, or others that are equal, or one more."""
    upper, lower = posed.contacts
    if change == "swapped":
        return [lower, upper]
    if change == "renewed":
        again = [replace(c, obstacle=lambda x, c=c: c.obstacle(x)) for c in (lower, upper)]
        return again
    far = RigidObstacle(upper.facet_tags, LOADED, lambda x: np.full(x.shape[1], 1e9), name="more")
    return [far, upper, lower]


@situation(1.0)
def measure_weight(draw: Draw) -> Ratios:
    """A thickness that changes between solves, or that a new problem has."""
    method, n = draw.one_of("linear", "exact", "finite"), draw.count(2, 4)
    m = draw.one_of(n, n + 1)
    law = draw.one_of(None, Tresca(1e-3), Coulomb(0.3))
    before, after = draw.one_of(1.0, 0.1), draw.between(0.5, 3.0)

    def solved(frame: Frame, weights: Sequence[float]) -> Answer:
        parts = [block(2, 2.0, n), block(2, 2.0, m, low=1.0)]
        marks = levels(1, (BASE, 0.0), (LOADED, 2.0), (OTHER, 1.0, 1), (TOP, 1.0, 2))
        posed = draw.pose(frame, "quadrilateral", parts, marks, method, weight=weights[0])
        posed.hold(BASE)
        posed.hold(LOADED, up(2, -0.02, 0.01 if law else 0.0))
        posed.add_pair(TOP, OTHER, friction=law, roles="given", name="joint")
        for weight in weights:
            posed.weight.value = weight
            answer = posed.solve()
        found.append(worst(Laws(posed).ratios()))
        return answer

    found: list[Ratios] = []
    first, second = solved(draw.frame(2), [before, after]), solved(draw.frame(2), [after])
    assert draw.posed is not None
    ratios = differ(draw.posed, first, second, 1e-5 if method == "linear" else 1e-4)
    p, q = first.pressures["joint"], second.pressures["joint"]
    ratios["pressure"] = float(np.abs(p - q).max()) / (1e-4 * float(q.max()))
    return worst(*found, ratios)


@situation(1.0)
def unloading(draw: Draw) -> Ratios:
    """What is loaded no more is at rest; small loads have small answers."""
    method = draw.one_of("exact", "finite", "finite", "linear")
    kind, n = draw.one_of("die", "pair"), draw.count(2, 4)
    law = draw.one_of(None, None, Coulomb(0.3))
    small = 10.0 ** draw.between(-11, -5)
    cell, frame = draw.cell("quadrilateral", "triangle"), draw.frame(2)
    parts = [block(2, 2.0, n)] + ([block(2, 2.0, n + 1, low=1.0)] if kind == "pair" else [])
    marks = [(BASE, at(1, 0.0)), (TOP, at(1, 1.0), 1)]
    marks += [(OTHER, at(1, 1.0), 2), (LOADED, at(1, 2.0))] if kind == "pair" else []
    posed = draw.pose(frame, cell, parts, marks, method)
    posed.hold(BASE)
    depth = {"now": 0.0}
    if kind == "pair":
        move = posed.hold(LOADED)
        posed.add_pair(TOP, OTHER, friction=law, name="joint")
    else:

        def die(x: Vector) -> tuple[Vector, Vector]:
            out = x - np.array([[1.0], [2.5 - depth["now"]]])
            size = np.linalg.norm(out, axis=0)
            return size - 1.5, out / size

        posed.add_obstacle(TOP, die, friction=law, name="joint")
    posed.make()
    found = []
    for step in (0.02, 0.05, 0.0, -0.01, 0.0):
        depth["now"] = step
        if kind == "pair":
            move(up(2, -step))
        posed.solved.reset_slip()
        answer = posed.solve()
        posed.advance()
        if step <= 0.0 and (law is None or step < 0.0):
            lower = posed.places[1, : posed.owned] < 1.0 - 1e-6
            force = float(np.abs(answer.forces["joint"]).max())
            found.append(posed.largest(answer.u[lower]) / 1e-8)
            found.append(force / 1e-8)
    ratios = {"at rest": max(found)}
    if law is None:
        sizes = []
        for step in (1e-5, small):
            depth["now"] = step
            if kind == "pair":
                move(up(2, -step))
            sizes.append(posed.largest(posed.solve().u) / step)
        # rounding of coordinates
        allowed = 1e-2 + 1e-13 * (1.0 + posed.largest(frame.shift)) / small
        ratios["small"] = abs(sizes[1] / sizes[0] - 1.0) / allowed
    return ratios


@situation(0.7)
def refused(draw: Draw) -> Ratios:
    """A solve that is refused leaves no trace."""
    method, n = draw.one_of("linear", "exact", "finite"), draw.count(2, 4)
    depth = draw.between(0.005, 0.03)
    parts = [block(2, 2.0, n), block(2, 2.0, n + 1, low=1.0)]
    side = lambda x: np.isclose(x[0], 2.0)  # noqa: E731
    marks = [
        (BASE, at(1, 0.0)),
        (LOADED, at(1, 2.0)),
        (OTHER, at(1, 1.0), 1),
        (TOP, at(1, 1.0), 2),
        (SECOND, side, 2),
    ]

    def solved(frame: Frame, is_wrong_first: bool) -> Answer:
        posed = draw.pose(frame, "quadrilateral", parts, marks, method)
        posed.hold(BASE)
        posed.hold(LOADED, up(2, -depth))
        posed.add_pair(TOP, OTHER, name="joint", roles="given")
        posed.make()
        if is_wrong_first:
            right = posed.contacts
            # but for the linear problem, surfaces that face nothing may meet later
            slave = SECOND if method == "linear" else 99
            posed.solved.contacts = [ContactPair(posed.facet_tags, slave, OTHER, name="joint")]
            for _ in range(2):
                try:
                    posed.solved.solve()
                    found["accepted"] = np.inf
                except InputError:
                    pass
            posed.solved.contacts = right
        return posed.solve()

    found = {"accepted": 0.0}
    first, second = solved(draw.frame(2), True), solved(draw.frame(2), False)
    assert draw.posed is not None
    return found | differ(draw.posed, first, second, 1e-5)


@situation(0.7)
def two_rules(draw: Draw) -> Ratios:
    """Terms of one form that are integrated by different rules."""
    method = draw.one_of("linear", "finite")
    cell = draw.cell("quadrilateral", "triangle")
    n, poisson = draw.count(2, 6), draw.one_of(0.3, 0.45, 0.49)
    marks = [(BASE, at(1, 0.0)), (TOP, at(1, 1.0))]
    posed = draw.pose(
        draw.frame(2), cell, [block(2, 2.0, n)], marks, method, poisson=poisson, two_rules=True
    )
    if draw.one_of(True, False):
        posed.terms.reverse()
    posed.hold(BASE)
    posed.add_obstacle(TOP, ceiling(2, 1.0 - draw.between(0.01, 0.08)), name="plane")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        posed.solve()
    return Laws(posed).ratios()


@situation(0.7)
def free_bodies(draw: Draw) -> Ratios:
    """A body that nothing holds along its contacts is told, one that is held is not."""
    cell = draw.cell("quadrilateral", "triangle", "hexahedron")
    g, kind = dimension(cell), draw.one_of("planes", "pair")
    # deformed surfaces of pairs are curved, which resists motions along them
    method = draw.one_of("linear", "exact") if kind == "planes" else "linear"
    n, is_free = draw.count(2, 4) if g == 2 else 2, draw.one_of(True, False)
    parts = [block(g, 1.0, n)] + ([block(g, 1.0, n, low=1.0)] if kind == "pair" else [])
    last = len(parts)
    marks = [(BASE, at(g - 1, 0.0)), (LOADED, at(g - 1, float(last))), (LEFT, at(0, 0.0), last)]
    marks += [(TOP, at(g - 1, 1.0), 2), (OTHER, at(g - 1, 1.0), 1)] if kind == "pair" else []
    posed = draw.pose(draw.frame(g, along_axes=True), cell, parts, marks, method)
    if kind == "pair":
        posed.hold(BASE)
        posed.add_pair(TOP, OTHER, name="pair")
    else:
        posed.add_obstacle(BASE, lambda x: (x[-1], up(g)), name="floor")
    posed.add_obstacle(LOADED, ceiling(g, last - 0.01), name="lid")
    if not is_free:
        posed.guide(LEFT, 0)
    posed.solve()
    told = posed.solved.report.free_motions
    along = [text for text in told if "translation" in text]
    # one component of one side leaves the other one along the contacts
    expected = is_free or g == 3
    ratios = {"free motions": 0.0 if bool(along) == expected else np.inf}
    return worst(Laws(posed).ratios(), ratios)

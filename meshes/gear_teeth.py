"""Make gear_teeth.msh: a quarter of a pinion and some teeth of its wheel, in 2D.

    python meshes/gear_teeth.py [--element-size 0.03e-3] [--output FILE]

Lengths are in metres. The pinion's axis is at the origin; it is cut along the axes of coordinates.
Flanks are involutes. One tooth of the pinion touches one of the wheel at the pitch point; these two
flanks are tagged. Elements are small there, and of different size, so that nodes do not match.
"""

from __future__ import annotations

from pathlib import Path

import gmsh
import numpy as np
from gmsh_files import closed, command_line, name_group, new_file, set_size_formula, surface

MODULE, PRESSURE_ANGLE = 4e-3, np.radians(20)
PINION, WHEEL = 20, 28  # numbers of teeth
DRAWN = 5  # teeth of each gear, a quarter of the pinion's
ADDENDUM, DEDENDUM, FILLET = MODULE, 1.25 * MODULE, 0.3 * MODULE
BORE = 0.5  # relative to the pitch radius
LINE_OF_CENTRES = np.radians(40.5)  # the cuts then are in the middle between two teeth
COARSEST, INSIDE = 0.7e-3, 1.5e-3  # the largest elements of the outline and within
FINER = 0.75  # the wheel's elements at the contact, relative to the pinion's
NEAR = 0.45e-3  # the uniform part of the mesh reaches so far from the pitch point
GROWTH = 0.3  # of the elements' size with the distance

PITCH_POINT = 0.5 * MODULE * PINION * np.array([np.cos(LINE_OF_CENTRES), np.sin(LINE_OF_CENTRES)])


def cartesian(angle: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return points (n, 2) from polar coordinates."""
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def arc(start: float, end: float, radius: float) -> np.ndarray:
    """Return a finely drawn arc about the origin."""
    angle = np.linspace(start, end, 1000)
    return cartesian(angle, np.full_like(angle, radius))


def graded(curve: np.ndarray, finest: float) -> np.ndarray:
    """Choose points of a finely drawn curve (n, 2), among them its ends."""
    steps = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    middle = 0.5 * (curve[1:] + curve[:-1])
    away = np.maximum(0.0, np.linalg.norm(middle - PITCH_POINT, axis=1) - NEAR)
    size = np.minimum(finest + GROWTH * away, COARSEST)
    number = np.concatenate([[0.0], np.cumsum(steps / size)])  # of elements from the start
    places = np.linspace(0.0, number[-1], max(1, int(np.ceil(number[-1]))) + 1)
    return np.stack([np.interp(places, number, curve[:, k]) for k in (0, 1)], axis=1)


def right_flank(teeth: int) -> list[np.ndarray]:
    """Return the clockwise flank of a tooth on the x axis, as polar coordinates from root to tip.

    The first part ends at the pitch circle. From the base circle on the flank is an involute, below
    it a radial line and a fillet.
    """
    pitch = 0.5 * MODULE * teeth
    base, centre = pitch * np.cos(PRESSURE_ANGLE), pitch - DEDENDUM + FILLET
    involute = np.tan(PRESSURE_ANGLE) - PRESSURE_ANGLE
    start = -np.pi / (2 * teeth) - involute
    # the fillet touches the root circle and the radial line
    away = np.arcsin(FILLET / centre)
    turn = np.linspace(np.pi, 0.5 * np.pi + away, 200)
    x, y = centre + FILLET * np.cos(turn), FILLET * np.sin(turn)
    parts = [[start - away + np.arctan2(y, x), np.hypot(x, y)]]
    radial = np.linspace(parts[0][1][-1], base, 200)[1:]
    parts.append([np.full_like(radial, start), radial])
    roll = np.sqrt(((pitch + ADDENDUM) / base) ** 2 - 1)
    for first, last in ((0.0, np.tan(PRESSURE_ANGLE)), (np.tan(PRESSURE_ANGLE), roll)):
        turn = np.linspace(first, last, 5000)
        parts.append([start + turn - np.arctan(turn), base * np.hypot(1.0, turn)])
    below = np.concatenate([np.stack(part) for part in parts[:3]], axis=1)
    return [below, np.stack(parts[3])]


def toothed_side(teeth: int, first: float, touching: int) -> list[tuple[np.ndarray, bool]]:
    """Return the teeth about the origin as curves, counter-clockwise.

    They begin in the middle between two teeth, at the angle `first`. Each curve comes with whether
    it is the clockwise flank of the tooth with the number `touching`.
    """
    pitch = 0.5 * MODULE * teeth
    step, root = 2 * np.pi / teeth, pitch - DEDENDUM
    flank = right_flank(teeth)
    curves = []
    for tooth in range(DRAWN):
        middle = first + (tooth + 0.5) * step
        foot, tip = flank[0][0, 0], flank[1][0, -1]
        curves.append((arc(middle - 0.5 * step, middle + foot, root), False))
        curves += [(cartesian(middle + a, r), tooth == touching) for a, r in flank]
        curves.append((arc(middle + tip, middle - tip, pitch + ADDENDUM), False))
        back = np.concatenate(flank, axis=1)[:, ::-1]
        curves.append((cartesian(middle - back[0], back[1]), False))
        curves.append((arc(middle - foot, middle + 0.5 * step, root), False))
    return curves


def gear(name: str, curves: list[tuple[np.ndarray, str]], finest: float) -> None:
    """Draw the outline of a gear: closed, counter-clockwise, each curve with its name or none."""
    geo = gmsh.model.geo
    points: list[int] = []
    groups: list[str] = []
    for curve, group in curves:
        chosen = graded(curve, finest)
        points += [geo.addPoint(x, y, 0) for x, y in chosen[:-1]]
        groups += [group] * (len(chosen) - 1)
    sides = closed(points)
    body = surface(sides)
    geo.synchronize()
    name_group(2, [body], name)
    for group in sorted(set(groups) - {""}):
        chosen = [side for side, its in zip(sides, groups, strict=True) if its == group]
        name_group(1, chosen, group)


def sector(teeth: int, first: float, touching: int) -> list[tuple[np.ndarray, str]]:
    """Return the outline of some teeth with the body between them and the bore."""
    pitch = 0.5 * MODULE * teeth
    last, bore = first + DRAWN * 2 * np.pi / teeth, BORE * pitch
    radius = np.linspace(bore, pitch - DEDENDUM, 1000)
    outline = [
        (curve, "flank" if touches else "")
        for curve, touches in toothed_side(teeth, first, touching)
    ]
    outline.append((cartesian(np.full_like(radius, last), radius[::-1]), "last cut"))
    outline.append((arc(last, first, bore), "bore"))
    outline.append((cartesian(np.full_like(radius, first), radius), "first cut"))
    return outline


def gear_teeth(output: Path, element_size: float = 0.03e-3) -> None:
    """Mesh both gears by triangles, those of the pinion of a size [m], and write the file."""
    with new_file(output):
        pinion = sector(PINION, 0.0, 2)
        gear("pinion", [(c, g and f"pinion {g}") for c, g in pinion], element_size)
        # the flank of the tooth in the middle is, by a quarter of a step, after the pitch point
        first = LINE_OF_CENTRES + np.pi - (0.5 * DRAWN - 0.25) * 2 * np.pi / WHEEL
        centre = PITCH_POINT * (1 + WHEEL / PINION)
        wheel = sector(WHEEL, first, DRAWN // 2)
        gear("wheel", [(centre + c, g and f"wheel {g}") for c, g in wheel], FINER * element_size)
        # after both bodies: to synchronise the second would undo it for the first
        for _, side in gmsh.model.getEntities(1):
            gmsh.model.mesh.setTransfiniteCurve(side, 2)
        away = "sqrt((x-({}))^2+(y-({}))^2)".format(*PITCH_POINT)
        law = f"{FINER * element_size}+{GROWTH}*0.5*({away}-{NEAR}+abs({away}-{NEAR}))"
        set_size_formula(law)
        gmsh.option.setNumber("Mesh.MeshSizeMax", INSIDE)
        gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
        gmsh.model.mesh.generate(2)


if __name__ == "__main__":
    command_line(gear_teeth)

"""Make pile_of_cylinders.msh: three discs (or short cylinders) of radius 1/4 m in a trough.

    python meshes/pile_of_cylinders.py [--dim 2] [--elements 12] [--output FILE]

Needs Gmsh with its Python module ('apt install python3-gmsh' or 'pip install gmsh').
Two discs lie on the floor y = 0 between two walls, the third one upon both. The line of centres to
the upper disc has the slope 4/3, so all forces are simple fractions of the weight. The surface is
tagged, and finely divided, only around the places of contact: by so many elements of equal length
for 0.02 radians to either side of each. Where two discs touch, these are mirror images. Triangles
in 2D, hexahedra in 3D (the cylinders' axes are along z).
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import gmsh

RADIUS = 0.25
LENGTH = RADIUS  # of the cylinders
LAYERS = 2  # of elements along them
HALF_ANGLE = 0.02  # of a tagged arc [rad]

# body -> (centre / radius, {neighbour: direction from the centre to the place of contact})
DISCS = {
    "left": ((-1.2, 1.0), {"top": (0.6, 0.8), "floor": (0.0, -1.0), "wall": (-1.0, 0.0)}),
    "right": ((1.2, 1.0), {"top": (-0.6, 0.8), "floor": (0.0, -1.0), "wall": (1.0, 0.0)}),
    "top": ((0.0, 2.6), {"left": (-0.6, -0.8), "right": (0.6, -0.8)}),
}


def point_on_circle(centre: tuple[float, float], angle: float, size: float) -> int:
    """Make a point of the disc's boundary."""
    x, y = (RADIUS * (c + f(angle)) for c, f in zip(centre, (math.cos, math.sin), strict=True))
    return gmsh.model.geo.addPoint(x, y, 0, size)


def disc(
    centre: tuple[float, float], directions: dict[str, tuple[float, float]], elements: int
) -> tuple[int, dict[str, list[int]]]:
    """Make a disc, and return its surface and the arcs at each place of contact, one an element.

    Away from these, the elements grow up to RADIUS / elements.
    """
    finest, coarsest = RADIUS * HALF_ANGLE / elements, RADIUS / elements
    angles = {name: math.atan2(y, x) % (2 * math.pi) for name, (x, y) in directions.items()}
    names = sorted(angles, key=lambda name: angles[name])
    middle = gmsh.model.geo.addPoint(RADIUS * centre[0], RADIUS * centre[1], 0)
    points: list[tuple[int, str]] = []  # and what the arc that starts there touches
    for name, following in zip(names, names[1:] + names[:1], strict=True):
        for k in range(-elements, elements + 1):
            angle = angles[name] + HALF_ANGLE * k / elements
            touches = name if k < elements else ""
            points.append((point_on_circle(centre, angle, finest), touches))
        # an arc has to be less than half a circle
        start, end = angles[name] + HALF_ANGLE, angles[following] - HALF_ANGLE
        free = (end - start) % (2 * math.pi)
        points += [(point_on_circle(centre, start + k * free / 4, coarsest), "") for k in (1, 2, 3)]
    arcs: dict[str, list[int]] = {name: [] for name in ["", *names]}
    loop = []
    for (start_point, touches), (end_point, _) in zip(points, points[1:] + points[:1], strict=True):
        loop.append(gmsh.model.geo.addCircleArc(start_point, middle, end_point))
        arcs[touches].append(loop[-1])
        if touches:
            gmsh.model.geo.mesh.setTransfiniteCurve(loop[-1], 2)
    surface = gmsh.model.geo.addPlaneSurface([gmsh.model.geo.addCurveLoop(loop)])
    arcs.pop("")
    return surface, arcs


def extruded(
    surface: int, arcs: dict[str, list[int]], elements: int
) -> tuple[int, dict[str, list[int]]]:
    """Make a cylinder, and return its volume and the strips at each place of contact."""
    gmsh.model.geo.mesh.setRecombine(2, surface)
    made = gmsh.model.geo.extrude([(2, surface)], 0, 0, LENGTH, [LAYERS // 2], recombine=True)
    gmsh.model.geo.synchronize()
    curves = [abs(tag) for _, tag in gmsh.model.getBoundary([(2, surface)], oriented=False)]
    strips = dict(zip(curves, (tag for _, tag in made[2:]), strict=True))
    return made[1][1], {name: [strips[arc] for arc in two] for name, two in arcs.items()}


def name_group(dim: int, entities: list[int], name: str) -> None:
    """Add a named physical group."""
    gmsh.model.setPhysicalName(dim, gmsh.model.addPhysicalGroup(dim, entities), name)


def pile_of_cylinders(output: Path, dim: int = 2, elements: int = 12) -> None:
    """Mesh the discs or cylinders and write the file; in 3D, `elements` has to be even."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("pile_of_cylinders")
        if dim == 3:  # every cell is cut into hexahedra, half as large
            gmsh.option.setNumber("Mesh.SubdivisionAlgorithm", 2)
            elements //= 2
        made = {body: disc(*geometry, elements) for body, geometry in DISCS.items()}
        if dim == 3:
            made = {body: extruded(*parts, elements) for body, parts in made.items()}
        gmsh.model.geo.synchronize()
        for body, (solid, contacts) in made.items():
            name_group(dim, [solid], body)
            for touches, sides in contacts.items():
                name_group(dim - 1, sides, f"{body} {touches}")
        gmsh.model.mesh.generate(dim)
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        gmsh.write(str(output))
    finally:
        gmsh.finalize()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dim", type=int, choices=(2, 3), default=2)
    parser.add_argument("--elements", type=int, default=12)
    parser.add_argument("--output", type=Path, default=Path(__file__).with_suffix(".msh"))
    options = parser.parse_args()
    pile_of_cylinders(options.output, options.dim, options.elements)

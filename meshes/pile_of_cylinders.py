"""Make pile_of_cylinders.msh: three discs (or short cylinders) of radius 1/4 m in a trough.

    python meshes/pile_of_cylinders.py [--dim 2] [--elements 12] [--output FILE]

Two discs lie on the floor y = 0 between two walls, the third one upon both. The line of centres to
the upper disc has the slope 4/3, so all forces are simple fractions of the weight. The surface is
tagged, and finely divided, only around the places of contact: by so many elements of equal length
for 0.02 radians to either side of each. Where two discs touch, these are mirror images. Triangles
in 2D, hexahedra in 3D (the cylinders' axes are along z).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import gmsh
from gmsh_files import command_line, graded, name_group, new_file, surface

RADIUS = 0.25
LENGTH = RADIUS  # of the cylinders
LAYERS = 2  # of elements along them
HALF_ANGLE = 0.02  # of a tagged arc [rad]
GROWTH = 1.3  # from one element of the circle to the next

# body -> (centre / radius, {neighbour: direction from the centre to the place of contact})
DISCS = {
    "left": ((-1.2, 1.0), {"top": (0.6, 0.8), "floor": (0.0, -1.0), "wall": (-1.0, 0.0)}),
    "right": ((1.2, 1.0), {"top": (-0.6, 0.8), "floor": (0.0, -1.0), "wall": (1.0, 0.0)}),
    "top": ((0.0, 2.6), {"left": (-0.6, -0.8), "right": (0.6, -0.8)}),
}


Point = tuple[float, float, float]


def point_on_circle(centre: Point, angle: float, size: float) -> int:
    """Make a point of the disc's boundary."""
    x, y, z = centre
    x, y = x + RADIUS * math.cos(angle), y + RADIUS * math.sin(angle)
    return gmsh.model.geo.addPoint(x, y, z, size)


def disc(
    centre: Point, directions: dict[str, tuple[float, float]], elements: int, growth: float
) -> tuple[int, dict[str, list[int]]]:
    """Make a disc, and return its surface and the arcs at each place of contact.

    Each arc is for one element. Those of the upper disc are symmetric: its weight has no moment
    about its axis, which nothing would balance.
    """
    finest, coarsest = HALF_ANGLE / elements, 1 / elements
    angles = {name: math.atan2(y, x) % (2 * math.pi) for name, (x, y) in directions.items()}
    names = sorted(angles, key=lambda name: angles[name])
    corners: list[tuple[float, float, str]] = []  # angle, size, what the arc from there touches
    for name, following in zip(names, names[1:] + names[:1], strict=True):
        for k in range(-elements, elements + 1):
            touches = name if k < elements else ""
            corners.append((angles[name] + k * finest, finest, touches))
        start, end = angles[name] + HALF_ANGLE, angles[following] - HALF_ANGLE
        end = start + (end - start) % (2 * math.pi)
        corners += [(angle, coarsest, "") for angle in graded(start, end, finest, coarsest, growth)]
    middle = gmsh.model.geo.addPoint(*centre)
    points = [point_on_circle(centre, angle, RADIUS * size) for angle, size, _ in corners]
    loop = [
        gmsh.model.geo.addCircleArc(start_point, middle, end_point)
        for start_point, end_point in zip(points, points[1:] + points[:1], strict=True)
    ]
    gmsh.model.geo.synchronize()
    for arc in loop:
        gmsh.model.mesh.setTransfiniteCurve(arc, 2)
    body = surface(loop)
    gmsh.model.geo.synchronize()
    touching = [touches for _, _, touches in corners]
    return body, {
        name: [arc for arc, touches in zip(loop, touching, strict=True) if touches == name]
        for name in names
    }


def extruded(base: int, arcs: dict[str, list[int]]) -> tuple[int, dict[str, list[int]]]:
    """Make a cylinder, and return its volume and the strips at each place of contact."""
    gmsh.model.mesh.setRecombine(2, base)
    made = gmsh.model.geo.extrude([(2, base)], 0, 0, LENGTH, [LAYERS // 2], recombine=True)
    gmsh.model.geo.synchronize()
    strips = {
        name: [
            side for arc in several for side in gmsh.model.getAdjacencies(1, arc)[0] if side != base
        ]
        for name, several in arcs.items()
    }
    return next(tag for dim, tag in made if dim == 3), strips


def put_in_place(dim: int, solid: int, shift: float) -> None:
    """Move a meshed body back along z."""
    tags, coordinates, _ = gmsh.model.mesh.getNodes(dim, solid, includeBoundary=True)
    for tag, (x, y, z) in zip(tags, coordinates.reshape(-1, 3), strict=True):
        gmsh.model.mesh.setNode(tag, (x, y, round(z - shift, 12)), [])


def pile_of_cylinders(output: Path, dim: Literal[2, 3] = 2, elements: int = 12) -> None:
    """Mesh the discs or cylinders and write the file; in 3D, `elements` has to be even."""
    with new_file(output):
        growth = GROWTH
        if dim == 3:  # every cell is cut into hexahedra, half as large
            gmsh.option.setNumber("Mesh.SubdivisionAlgorithm", 2)
            elements, growth = elements // 2, GROWTH**2
        solids = []
        for number, (body, ((x, y), directions)) in enumerate(DISCS.items()):
            # Gmsh would merge points at one place: each body is made behind the one before
            shift = 2 * LENGTH * number if dim == 3 else 0.0
            solid, contacts = disc((RADIUS * x, RADIUS * y, shift), directions, elements, growth)
            if dim == 3:
                solid, contacts = extruded(solid, contacts)
            name_group(dim, [solid], body)
            for touches, sides in contacts.items():
                name_group(dim - 1, sides, f"{body} {touches}")
            solids.append((solid, shift))
        gmsh.model.mesh.generate(dim)
        for solid, shift in solids:
            put_in_place(dim, solid, shift)


if __name__ == "__main__":
    command_line(pile_of_cylinders)

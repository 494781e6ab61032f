"""Make roller.msh: a roller of radius 0.1 m between two plates, in two dimensions.

    python meshes/roller.py [--elements 24] [--output FILE]

The roller's axis is at the origin. The surfaces are tagged for 5 mm to either side of the places of
contact, and divided there into so many elements a side: each node of a plate is straight below or
above one of the roller.
"""

from __future__ import annotations

import math
from pathlib import Path

import gmsh
from gmsh_files import closed, command_line, graded, name_group, new_file, set_size_formula, surface

RADIUS = 0.1
WIDTH, THICKNESS = 0.4, 0.15  # of the plates
TOUCHING = 0.005  # half-width of the tagged surfaces
COARSEST = RADIUS / 8
GROWTH = 1.2  # from one element of the roller's surface to the next


def polygon(
    corners: list[tuple[float, float, float]], groups: dict[str, range], name: str
) -> list[int]:
    """Make a polygon out of (x, y, size) and name some ranges of its sides; return these sides."""
    geo = gmsh.model.geo
    sides = closed([geo.addPoint(x, y, 0, size) for x, y, size in corners])
    body = surface(sides)
    geo.synchronize()
    name_group(2, [body], name)
    for group, chosen in groups.items():
        name_group(1, [sides[k] for k in chosen], group)
    return sides


def roller(elements: int) -> None:
    """Make the roller; each side of the polygon is one element."""
    finest = TOUCHING / elements
    places = [k * finest for k in range(-elements, elements + 1)]
    below = [(x, -math.sqrt(RADIUS**2 - x**2)) for x in places]
    half = math.asin(TOUCHING / RADIUS)
    angles = graded(
        half - math.pi / 2, math.pi / 2 - half, finest / RADIUS, COARSEST / RADIUS, GROWTH
    )
    right = [(RADIUS * math.cos(angle), RADIUS * math.sin(angle)) for angle in angles]
    half_circle = below + right
    circle = half_circle + [(-x, -y) for x, y in half_circle]
    n = len(half_circle)
    fine, round_ = range(2 * elements), len(below)
    sizes = [finest if k % n < round_ else COARSEST for k in range(2 * n)]
    sides = polygon(
        [(x, y, size) for (x, y), size in zip(circle, sizes, strict=True)],
        {"roller below": fine, "roller above": range(n, n + len(fine))},
        "roller",
    )
    for side in sides:
        gmsh.model.mesh.setTransfiniteCurve(side, 2)


def plate(elements: int, name: str, sign: int) -> None:
    """Make a plate, above the roller for the sign 1 and below it for -1."""
    inner, outer, w = sign * RADIUS, sign * (RADIUS + THICKNESS), WIDTH / 2
    finest = TOUCHING / elements
    sides = polygon(
        [
            (-w, inner, COARSEST),
            (-TOUCHING, inner, finest),
            (0.0, inner, finest),
            (TOUCHING, inner, finest),
            (w, inner, COARSEST),
            (w, outer, COARSEST),
            (-w, outer, COARSEST),
        ],
        {
            f"{name} inner": range(1, 3),
            f"{name} right": range(4, 5),
            f"{name} outer": range(5, 6),
            f"{name} left": range(6, 7),
        },
        name,
    )
    for side in sides[1:3]:
        gmsh.model.mesh.setTransfiniteCurve(side, elements + 1)


def grow_from_contact(elements: int) -> None:
    """Let the elements grow with the distance from the nearer place of contact."""
    finest = TOUCHING / elements
    square = f"(x*x + (abs(y) - {RADIUS})*(abs(y) - {RADIUS}))"
    set_size_formula(f"sqrt({finest**2} + {0.12**2}*{square})")


def roller_between_plates(output: Path, elements: int = 24) -> None:
    """Mesh the three bodies by triangles and write the file."""
    with new_file(output):
        plate(elements, "lower", -1)
        roller(elements)
        plate(elements, "upper", 1)
        grow_from_contact(elements)
        gmsh.model.mesh.generate(2)


if __name__ == "__main__":
    command_line(roller_between_plates)

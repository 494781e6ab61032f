"""Make sliding_block.msh: a block with a round foot, left of the bump of another body, in 2D.

    python meshes/sliding_block.py [--element-size 0.0125] [--output FILE]

The base is 4 m wide and symmetric about x = 0, where its bump is. The block stands upright on its
foot, the arc of a circle, above x = START; the foot just touches the base. The surfaces that may
touch are divided evenly in x, the foot twice as coarsely as the base: node stands over node.
"""

from __future__ import annotations

from pathlib import Path

import gmsh
import numpy as np
from gmsh_files import closed, command_line, name_group, new_file, surface

HALF_WIDTH, DEPTH = 2.0, 0.5  # of the base [m]
BUMP_HEIGHT, BUMP_HALF_WIDTH = 0.08, 0.6
START = -1.2  # where the block stands
BLOCK_WIDTH, BLOCK_TOP = 0.6, 0.6
RADIUS = 0.5  # of the foot
COARSEST = 0.1


def bump(x: np.ndarray) -> np.ndarray:
    """Return the height of the base's surface."""
    inside = np.abs(x) < BUMP_HALF_WIDTH
    return np.where(inside, 0.5 * BUMP_HEIGHT * (1 + np.cos(np.pi * x / BUMP_HALF_WIDTH)), 0.0)


def foot(x: np.ndarray) -> np.ndarray:
    """Return the height of the block's lower surface."""
    return RADIUS - np.sqrt(RADIUS**2 - (x - START) ** 2)


def polygon(
    name: str,
    upper: list[tuple[float, float]],
    corners: list[tuple[float, float]],
    size: float,
    sides: dict[str, list[int]],
) -> None:
    """Make a body: the upper side, one element a line, and other corners, counter-clockwise.

    `sides` names the sides after the surface, by number.
    """
    geo = gmsh.model.geo
    points = [geo.addPoint(x, y, 0, size) for x, y in upper]
    points += [geo.addPoint(x, y, 0, COARSEST) for x, y in corners]
    lines = closed(points)
    body = surface(lines)
    geo.synchronize()
    name_group(2, [body], name)
    n = len(upper) - 1
    groups = {f"{name} surface": lines[:n]}
    groups |= {side: [lines[n + k] for k in numbers] for side, numbers in sides.items()}
    for side, chosen in groups.items():
        name_group(1, chosen, side)
    for line in lines[:n]:
        gmsh.model.mesh.setTransfiniteCurve(line, 2)


def sliding_block(output: Path, element_size: float = 0.0125) -> None:
    """Mesh both bodies by triangles, those of the base's top of a size [m]; write the file."""
    with new_file(output):
        x = HALF_WIDTH * np.linspace(1, -1, round(2 * HALF_WIDTH / element_size) + 1)
        polygon(
            "base",
            list(zip(x, bump(x), strict=True)),
            [(-HALF_WIDTH, -DEPTH), (HALF_WIDTH, -DEPTH)],
            element_size,
            {"ground": [1]},
        )
        x = START + 0.5 * BLOCK_WIDTH * np.linspace(
            -1, 1, round(BLOCK_WIDTH / element_size / 2) + 1
        )
        right, left = START + 0.5 * BLOCK_WIDTH, START - 0.5 * BLOCK_WIDTH
        waist = 0.5 * BLOCK_TOP
        polygon(
            "block",
            list(zip(x, foot(x), strict=True)),
            [(right, waist), (right, BLOCK_TOP), (left, BLOCK_TOP), (left, waist)],
            2 * element_size,
            {"guide": [1, 3], "top": [2]},
        )
        gmsh.model.mesh.generate(2)


if __name__ == "__main__":
    command_line(sliding_block)

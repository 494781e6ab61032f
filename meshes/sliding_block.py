"""Make sliding_block.msh: a block with a round foot, left of the bump of another body, in 2D.

    python meshes/sliding_block.py [--element-size 0.0125] [--output FILE]

Needs Gmsh with its Python module ('apt install python3-gmsh' or 'pip install gmsh').
The base is 4 m wide and symmetric about x = 0, where its bump is. The block stands upright on its
foot, the arc of a circle, above x = START; the foot just touches the base. The surfaces that may
touch are divided evenly in x, the foot twice as coarsely as the base: node stands over node.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gmsh
import numpy as np

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
    surface: list[tuple[float, float]],
    corners: list[tuple[float, float]],
    size: float,
    sides: dict[str, list[int]],
) -> None:
    """Make a body: its surface, one element a side, and other corners, counter-clockwise from it.

    `sides` names the sides after the surface, by number.
    """
    geo = gmsh.model.geo
    points = [geo.addPoint(x, y, 0, size) for x, y in surface]
    points += [geo.addPoint(x, y, 0, COARSEST) for x, y in corners]
    lines = [geo.addLine(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True)]
    body = geo.addPlaneSurface([geo.addCurveLoop(lines)])
    geo.synchronize()
    gmsh.model.setPhysicalName(2, gmsh.model.addPhysicalGroup(2, [body]), name)
    n = len(surface) - 1
    groups = {f"{name} surface": lines[:n]}
    groups |= {side: [lines[n + k] for k in numbers] for side, numbers in sides.items()}
    for side, chosen in groups.items():
        gmsh.model.setPhysicalName(1, gmsh.model.addPhysicalGroup(1, chosen), side)
    for line in lines[:n]:
        gmsh.model.mesh.setTransfiniteCurve(line, 2)


def sliding_block(output: Path, size: float = 0.0125) -> None:
    """Mesh both bodies by triangles and write the file."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("sliding_block")
        x = HALF_WIDTH * np.linspace(1, -1, round(2 * HALF_WIDTH / size) + 1)
        polygon(
            "base",
            list(zip(x, bump(x), strict=True)),
            [(-HALF_WIDTH, -DEPTH), (HALF_WIDTH, -DEPTH)],
            size,
            {"ground": [1]},
        )
        x = START + 0.5 * BLOCK_WIDTH * np.linspace(-1, 1, round(BLOCK_WIDTH / size / 2) + 1)
        right, left = START + 0.5 * BLOCK_WIDTH, START - 0.5 * BLOCK_WIDTH
        waist = 0.5 * BLOCK_TOP
        polygon(
            "block",
            list(zip(x, foot(x), strict=True)),
            [(right, waist), (right, BLOCK_TOP), (left, BLOCK_TOP), (left, waist)],
            2 * size,
            {"guide": [1, 3], "top": [2]},
        )
        gmsh.model.mesh.generate(2)
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        gmsh.write(str(output))
    finally:
        gmsh.finalize()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--element-size", type=float, default=0.0125, help="of the base's top [m]")
    parser.add_argument("--output", type=Path, default=Path(__file__).with_suffix(".msh"))
    options = parser.parse_args()
    sliding_block(options.output, options.element_size)

"""Make tied_block.msh: a quarter of a block with a bore, in two parts that are meshed apart, in 2D.

    python meshes/tied_block.py [--element-size 0.6e-3] [--coarser 6] [--output FILE]

Lengths are in metres. The fine part is a square about the bore, the coarse part the rest of the
block. The two sides of each part where the parts meet are tagged; their nodes do not match.
"""

from __future__ import annotations

from pathlib import Path

import gmsh
from gmsh_files import command_line, name_group, new_file, surface

BORE, PART, BLOCK = 0.01, 0.025, 0.08  # radius of the bore, half-widths of part and block


Sides = dict[str, list[int]]


def part(name: str, corners: list[tuple[float, float, float]], sides: list[str]) -> Sides:
    """Draw a part through corners (x, y, size of elements); return its named sides.

    The side named "bore" is an arc about the origin.
    """
    geo = gmsh.model.geo
    origin = geo.addPoint(0, 0, 0)
    points = [geo.addPoint(x, y, 0, size) for x, y, size in corners]
    curves: Sides = {}
    for side, start, end in zip(sides, points, points[1:] + points[:1], strict=True):
        arc = side == "bore"
        curve = geo.addCircleArc(start, origin, end) if arc else geo.addLine(start, end)
        curves.setdefault(side, []).append(curve)
    body = surface([curve for group in curves.values() for curve in group])
    geo.synchronize()
    name_group(2, [body], name)
    return curves


def tied_block(output: Path, element_size: float = 0.6e-3, coarser: float = 6.0) -> None:
    """Mesh both parts by triangles and write the file.

    `element_size` [m] is that at the bore, those of the coarse part are `coarser` times as large.
    """
    with new_file(output):
        large = coarser * element_size
        fine = part(
            "fine part",
            [
                (0, BORE, element_size),
                (BORE, 0, element_size),
                (PART, 0, 2 * element_size),
                (PART, PART, 2 * element_size),
                (0, PART, 2 * element_size),
            ],
            ["bore", "symmetry_y", "fine right", "fine top", "symmetry_x"],
        )
        coarse = part(
            "coarse part",
            [
                (PART, 0, large),
                (BLOCK, 0, large),
                (BLOCK, BLOCK, large),
                (0, BLOCK, large),
                (0, PART, large),
                (PART, PART, large),
            ],
            ["symmetry_y", "outside", "outside", "symmetry_x", "coarse top", "coarse right"],
        )
        for name in dict.fromkeys([*fine, *coarse]):
            name_group(1, fine.get(name, []) + coarse.get(name, []), name)
        gmsh.model.mesh.generate(2)


if __name__ == "__main__":
    command_line(tied_block)

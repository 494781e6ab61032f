"""Make tied_block.msh: a quarter of a block with a bore, in two parts that are meshed apart, in 2D.

    python meshes/tied_block.py [--element-size 0.6e-3] [--coarser 6] [--output FILE]

Needs Gmsh with its Python module ('apt install python3-gmsh' or 'pip install gmsh').
Lengths are in metres. The fine part is a square about the bore, the coarse part the rest of the
block. The two sides of each part where the parts meet are tagged; their nodes do not match.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gmsh

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
    loop = geo.addCurveLoop([curve for group in curves.values() for curve in group], reorient=True)
    body = geo.addPlaneSurface([loop])
    geo.synchronize()
    gmsh.model.setPhysicalName(2, gmsh.model.addPhysicalGroup(2, [body]), name)
    return curves


def tied_block(output: Path, size: float = 0.6e-3, coarser: float = 6.0) -> None:
    """Mesh both parts by triangles and write the file."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("tied_block")
        large = coarser * size
        fine = part(
            "fine part",
            [
                (0, BORE, size),
                (BORE, 0, size),
                (PART, 0, 2 * size),
                (PART, PART, 2 * size),
                (0, PART, 2 * size),
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
            tag = gmsh.model.addPhysicalGroup(1, fine.get(name, []) + coarse.get(name, []))
            gmsh.model.setPhysicalName(1, tag, name)
        gmsh.model.mesh.generate(2)
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        gmsh.write(str(output))
    finally:
        gmsh.finalize()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--element-size", type=float, default=0.6e-3, help="at the bore [m]")
    parser.add_argument("--coarser", type=float, default=6.0, help="factor of the coarse part")
    parser.add_argument("--output", type=Path, default=Path(__file__).with_suffix(".msh"))
    options = parser.parse_args()
    tied_block(options.output, options.element_size, options.coarser)

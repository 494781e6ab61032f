"""Make ball_in_socket.msh: the meridian of half a ball in a socket, meshed apart, in 2D.

    python meshes/ball_in_socket.py [--element-size 0.5e-3] [--output FILE]

Needs Gmsh with its Python module ('apt install python3-gmsh' or 'pip install gmsh').
Lengths are in metres. The axis is x = 0; ball and socket touch at the origin. Elements grow with
the distance from there; those of the socket are 1.4 times as large, so that nodes do not match.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import gmsh

BALL, SOCKET = 0.05, 0.051  # radii
BLOCK, DEPTH = 0.12, 0.08  # radius of the block, its depth below the socket
NEAR, COARSEST = 6e-3, 6e-3  # the radius of the uniform part of the mesh, the largest elements
GROWTH = 14e-3  # over this distance, elements grow by their size in the uniform part
COARSER = 1.4


def body(name: str, points: list[tuple[float, float]], radius: float, sides: list[str]) -> None:
    """Draw a body through points, the first side an arc from the origin, and name its sides."""
    geo = gmsh.model.geo
    centre = geo.addPoint(0, radius, 0)
    corners = [geo.addPoint(x, y, 0) for x, y in points]
    curves = [geo.addCircleArc(corners[0], centre, corners[1])]
    curves += [geo.addLine(*ends) for ends in zip(corners[1:], corners[2:], strict=False)]
    curves.append(geo.addLine(corners[-1], corners[0]))
    surface = geo.addPlaneSurface([geo.addCurveLoop(curves)])
    geo.synchronize()
    gmsh.model.setPhysicalName(2, gmsh.model.addPhysicalGroup(2, [surface]), name)
    for curve, side in zip(curves, sides, strict=True):
        if side:
            tag = gmsh.model.addPhysicalGroup(1, [curve])
            gmsh.model.setPhysicalName(1, tag, f"{name} {side}")


def ball_in_socket(output: Path, size: float = 0.5e-3) -> None:
    """Mesh both bodies by triangles and write the file."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("ball_in_socket")
        body("ball", [(0, 0), (BALL, BALL), (0, BALL)], BALL, ["surface", "top", "axis"])
        body(
            "socket",
            [(0, 0), (SOCKET, SOCKET), (BLOCK, SOCKET), (BLOCK, -DEPTH), (0, -DEPTH)],
            SOCKET,
            ["surface", "", "", "bottom", "axis"],
        )
        socket = {(2, 2), *gmsh.model.getBoundary([(2, 2)], oriented=False)}

        def element_size(dim: int, tag: int, x: float, y: float, *_: float) -> float:
            own = COARSER * size if (dim, tag) in socket else size
            growth = 1 + max(0.0, math.hypot(x, y) - NEAR) / GROWTH
            return min(own * growth, COARSEST)

        gmsh.model.mesh.setSizeCallback(element_size)
        for source in ("ExtendFromBoundary", "FromPoints", "FromCurvature"):
            gmsh.option.setNumber(f"Mesh.MeshSize{source}", 0)
        gmsh.model.mesh.generate(2)
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        gmsh.write(str(output))
    finally:
        gmsh.finalize()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--element-size", type=float, default=0.5e-3, help="of the ball [m]")
    parser.add_argument("--output", type=Path, default=Path(__file__).with_suffix(".msh"))
    options = parser.parse_args()
    ball_in_socket(options.output, options.element_size)

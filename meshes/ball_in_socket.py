"""Make ball_in_socket.msh: the meridian of half a ball in a socket, meshed apart, in 2D.

    python meshes/ball_in_socket.py [--element-size 0.5e-3] [--output FILE]

Needs Gmsh with its Python module ('apt install python3-gmsh' or 'pip install gmsh').
Lengths are in metres. The axis is x = 0; ball and socket touch at the origin. Elements grow with
the distance from there; those of the socket are 1.4 times as large, so that nodes do not match.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gmsh

BALL, SOCKET = 0.05, 0.051  # radii
BLOCK, DEPTH = 0.12, 0.08  # radius of the block, its depth below the socket
NEAR, GROWTH, COARSEST = 6e-3, 0.035, 6e-3  # elements are equal up to a distance, then they grow
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
        mesh = gmsh.model.mesh
        for option in ("MeshSizeExtendFromBoundary", "MeshSizeFromPoints"):
            gmsh.option.setNumber(f"Mesh.{option}", 0)
        gmsh.option.setNumber("Mesh.MeshSizeMax", COARSEST)
        away = f"(sqrt(x^2+y^2)-{NEAR})"
        law = f"{size}*(1+{GROWTH / 5e-4}*0.5*({away}+abs({away})))"
        sizes = []
        for surface, factor in ((1, 1.0), (2, COARSER)):
            every = mesh.field.add("MathEval")
            mesh.field.setString(every, "F", f"{factor}*{law}")
            own = mesh.field.add("Restrict")
            mesh.field.setNumber(own, "IField", every)
            boundary = gmsh.model.getBoundary([(2, surface)], oriented=False)
            mesh.field.setNumbers(own, "FacesList", [surface])
            mesh.field.setNumbers(own, "EdgesList", [curve for _, curve in boundary])
            sizes.append(own)
        least = mesh.field.add("Min")
        mesh.field.setNumbers(least, "FieldsList", sizes)
        mesh.field.setAsBackgroundMesh(least)
        mesh.generate(2)
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

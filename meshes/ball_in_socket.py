"""Make ball_in_socket.msh: the meridian of half a ball in a socket, meshed apart, in 2D.

    python meshes/ball_in_socket.py [--element-size 0.5e-3] [--output FILE]

Lengths are in metres. The axis is x = 0; ball and socket touch at the origin. Elements grow with
the distance from there; those of the socket are 1.4 times as large, so that nodes do not match.
"""

from __future__ import annotations

import math
from pathlib import Path

import gmsh
from gmsh_files import command_line, name_group, new_file, set_size, surface

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
    whole = surface(curves)
    geo.synchronize()
    name_group(2, [whole], name)
    for curve, side in zip(curves, sides, strict=True):
        if side:
            name_group(1, [curve], f"{name} {side}")


def ball_in_socket(output: Path, element_size: float = 0.5e-3) -> None:
    """Mesh both bodies by triangles, those of the ball of a size [m], and write the file."""
    with new_file(output):
        body("ball", [(0, 0), (BALL, BALL), (0, BALL)], BALL, ["surface", "top", "axis"])
        body(
            "socket",
            [(0, 0), (SOCKET, SOCKET), (BLOCK, SOCKET), (BLOCK, -DEPTH), (0, -DEPTH)],
            SOCKET,
            ["surface", "", "", "bottom", "axis"],
        )
        socket = {(2, 2), *gmsh.model.getBoundary([(2, 2)], oriented=False)}

        def size(dim: int, tag: int, x: float, y: float, *_: float) -> float:
            own = COARSER * element_size if (dim, tag) in socket else element_size
            growth = 1 + max(0.0, math.hypot(x, y) - NEAR) / GROWTH
            return min(own * growth, COARSEST)

        set_size(size)
        gmsh.model.mesh.generate(2)


if __name__ == "__main__":
    command_line(ball_in_socket)

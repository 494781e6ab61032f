"""Make cam.msh: an eccentric disc with a bore, and the follower above it, in 2D.

    python meshes/cam.py [--element-size 0.025] [--output FILE]

The cam is drawn about (0, -1), away from the follower: the demo puts it in its place. The elements
of the follower are 1.4 times as large as those of the cam.
"""

from __future__ import annotations

from pathlib import Path

import gmsh
from gmsh_files import circle, closed, command_line, name_group, new_file, surface

RADIUS, BORE = 0.5, 0.2
FOOT, HEIGHT, WIDTH = 0.25, 0.6, 1.0  # of the follower [m]
GUIDED = 0.2  # the sides are guided above this height over the foot


def cam(output: Path, element_size: float = 0.025) -> None:
    """Mesh both bodies by triangles, those of the cam's side of a size [m], and write the file."""
    geo = gmsh.model.geo
    with new_file(output):
        sides = {
            "cam": circle(0, -1, RADIUS, element_size),
            "bore": circle(0, -1, BORE, 2 * element_size),
        }
        bodies = [surface(*sides.values())]
        right, coarse = 0.5 * WIDTH, 1.4 * element_size
        corners = [
            (-right, FOOT, coarse),
            (right, FOOT, coarse),
            (right, FOOT + GUIDED, 2 * coarse),
            (right, FOOT + HEIGHT, 2 * coarse),
            (-right, FOOT + HEIGHT, 2 * coarse),
            (-right, FOOT + GUIDED, 2 * coarse),
        ]
        lines = closed([geo.addPoint(x, y, 0, h) for x, y, h in corners])
        bodies.append(surface(lines))
        sides |= {"foot": [lines[0]], "guide": [lines[2], lines[4]], "top": [lines[3]]}
        geo.synchronize()
        for name, body in zip(("cam body", "follower"), bodies, strict=True):
            name_group(2, [body], name)
        for name, curves in sides.items():
            name_group(1, curves, name)
        gmsh.model.mesh.generate(2)


if __name__ == "__main__":
    command_line(cam)

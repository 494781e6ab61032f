"""Make cam.msh: an eccentric disc with a bore, and the follower above it, in 2D.

    python meshes/cam.py [--element-size 0.025] [--output FILE]

Needs Gmsh with its Python module ('apt install python3-gmsh' or 'pip install gmsh').
The cam is drawn about (0, -1), away from the follower: the demo puts it in its place. The elements
of the follower are 1.4 times as large as those of the cam.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gmsh

RADIUS, BORE = 0.5, 0.2
FOOT, HEIGHT, WIDTH = 0.25, 0.6, 1.0  # of the follower [m]
GUIDED = 0.2  # the sides are guided above this height over the foot


def cam(output: Path, size: float = 0.025) -> None:
    """Mesh both bodies by triangles and write the file."""
    geo = gmsh.model.geo
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("cam")
        centre = geo.addPoint(0, -1, 0)
        loops, sides = [], {}
        for name, radius, h in (("cam", RADIUS, size), ("bore", BORE, 2 * size)):
            points = [
                geo.addPoint(x * radius, -1 + y * radius, 0, h)
                for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1))
            ]
            ends = points[1:] + points[:1]
            arcs = [geo.addCircleArc(a, centre, b) for a, b in zip(points, ends, strict=True)]
            loops.append(geo.addCurveLoop(arcs))
            sides[name] = arcs
        bodies = [geo.addPlaneSurface(loops)]
        right, coarse = 0.5 * WIDTH, 1.4 * size
        corners = [
            (-right, FOOT, coarse),
            (right, FOOT, coarse),
            (right, FOOT + GUIDED, 2 * coarse),
            (right, FOOT + HEIGHT, 2 * coarse),
            (-right, FOOT + HEIGHT, 2 * coarse),
            (-right, FOOT + GUIDED, 2 * coarse),
        ]
        points = [geo.addPoint(x, y, 0, h) for x, y, h in corners]
        ends = points[1:] + points[:1]
        lines = [geo.addLine(a, b) for a, b in zip(points, ends, strict=True)]
        bodies.append(geo.addPlaneSurface([geo.addCurveLoop(lines)]))
        sides |= {"foot": [lines[0]], "guide": [lines[2], lines[4]], "top": [lines[3]]}
        geo.synchronize()
        for name, body in zip(("cam body", "follower"), bodies, strict=True):
            gmsh.model.setPhysicalName(2, gmsh.model.addPhysicalGroup(2, [body]), name)
        for name, curves in sides.items():
            gmsh.model.setPhysicalName(1, gmsh.model.addPhysicalGroup(1, curves), name)
        gmsh.model.mesh.generate(2)
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        gmsh.write(str(output))
    finally:
        gmsh.finalize()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--element-size", type=float, default=0.025, help="of the cam's side [m]")
    parser.add_argument("--output", type=Path, default=Path(__file__).with_suffix(".msh"))
    options = parser.parse_args()
    cam(options.output, options.element_size)

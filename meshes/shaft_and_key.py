"""Make shaft_and_key.msh: a shaft in the bore of a hub, and a key in the grooves of both; in 2D.

    python meshes/shaft_and_key.py [--element-size 1e-3] [--output FILE]

Needs Gmsh with its Python module ('apt install python3-gmsh' or 'pip install gmsh').
Each body has nodes of its own; along the bore those of shaft and hub are at the same places.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import gmsh

RADIUS, OUTSIDE = 10e-3, 18e-3  # of the shaft, and of the hub [m]
WIDTH, BOTTOM, TOP = 6e-3, 6.5e-3, 12.5e-3  # of the key, and its ends along y


def shaft_and_key(output: Path, size: float = 1e-3) -> None:
    """Mesh the three bodies and write the file."""
    half = WIDTH / 2
    corner = math.sqrt(RADIUS**2 - half**2)
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        geo = gmsh.model.geo
        centre = geo.addPoint(0, 0, 0)

        def bore() -> tuple[list[int], list[int]]:
            """Make the arc below the key's grooves, clockwise from the right in three parts."""
            angle = math.atan2(corner, half)
            ends = [angle - k * (math.pi + 2 * angle) / 3 for k in range(4)]
            points = [
                geo.addPoint(RADIUS * math.cos(t), RADIUS * math.sin(t), 0, size) for t in ends
            ]
            return points, [geo.addCircleArc(points[k], centre, points[k + 1]) for k in range(3)]

        def groove(points: list[int], height: float) -> list[int]:
            """Make the lines of a groove, from the end of the arc back to its beginning."""
            left, right = (geo.addPoint(x, height, 0, size / 2) for x in (-half, half))
            path = [points[-1], left, right, points[0]]
            return [geo.addLine(a, b) for a, b in zip(path[:-1], path[1:], strict=True)]

        def surface(*loops: list[int]) -> int:
            return int(geo.addPlaneSurface([geo.addCurveLoop(lines) for lines in loops]))

        (of_shaft, shaft_arcs), (of_hub, hub_arcs) = bore(), bore()
        shaft = surface(shaft_arcs + groove(of_shaft, BOTTOM))
        inner = hub_arcs + groove(of_hub, TOP)
        rim = [
            geo.addPoint(OUTSIDE * x, OUTSIDE * y, 0, 2 * size)
            for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1))
        ]
        outer = [geo.addCircleArc(rim[k], centre, rim[(k + 1) % 4]) for k in range(4)]
        hub = surface(outer, inner)
        box = [(-half, BOTTOM), (half, BOTTOM), (half, TOP), (-half, TOP)]
        corners = [geo.addPoint(*x, 0, size / 2) for x in box]
        key = surface([geo.addLine(corners[k], corners[(k + 1) % 4]) for k in range(4)])
        geo.synchronize()
        for arc in shaft_arcs + hub_arcs:
            length = RADIUS * (math.pi + 2 * math.atan2(corner, half)) / 3
            gmsh.model.mesh.setTransfiniteCurve(arc, round(length / size) + 1)
        for name, body in (("shaft", shaft), ("hub", hub), ("key", key)):
            gmsh.model.setPhysicalName(2, gmsh.model.addPhysicalGroup(2, [body]), name)
        gmsh.model.setPhysicalName(1, gmsh.model.addPhysicalGroup(1, outer), "outside")
        gmsh.model.mesh.generate(2)
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        gmsh.write(str(output))
    finally:
        gmsh.finalize()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--element-size", type=float, default=1e-3)
    parser.add_argument("--output", type=Path, default=Path(__file__).with_suffix(".msh"))
    options = parser.parse_args()
    shaft_and_key(options.output, options.element_size)

"""Make shaft_and_key.msh: a shaft in the bore of a hub, and a key in the grooves of both; in 2D.

    python meshes/shaft_and_key.py [--element-size 1e-3] [--output FILE]

Each body has nodes of its own; along the bore those of shaft and hub are at the same places.
"""

from __future__ import annotations

import math
from pathlib import Path

import gmsh
from gmsh_files import circle, closed, command_line, name_group, new_file, surface

RADIUS, OUTSIDE = 10e-3, 18e-3  # of the shaft, and of the hub [m]
WIDTH, BOTTOM, TOP = 6e-3, 6.5e-3, 12.5e-3  # of the key, and its ends along y


def shaft_and_key(output: Path, element_size: float = 1e-3) -> None:
    """Mesh the three bodies by triangles of a size [m], and write the file."""
    half = WIDTH / 2
    corner = math.sqrt(RADIUS**2 - half**2)
    with new_file(output):
        geo = gmsh.model.geo
        centre = geo.addPoint(0, 0, 0)

        def bore() -> tuple[list[int], list[int]]:
            """Make the arc below the key's grooves, clockwise from the right in three parts."""
            angle = math.atan2(corner, half)
            ends = [angle - k * (math.pi + 2 * angle) / 3 for k in range(4)]
            points = [
                geo.addPoint(RADIUS * math.cos(t), RADIUS * math.sin(t), 0, element_size)
                for t in ends
            ]
            return points, [geo.addCircleArc(points[k], centre, points[k + 1]) for k in range(3)]

        def groove(points: list[int], height: float) -> list[int]:
            """Make the lines of a groove, from the end of the arc back to its beginning."""
            left, right = (geo.addPoint(x, height, 0, element_size / 2) for x in (-half, half))
            path = [points[-1], left, right, points[0]]
            return [geo.addLine(a, b) for a, b in zip(path[:-1], path[1:], strict=True)]

        (of_shaft, shaft_arcs), (of_hub, hub_arcs) = bore(), bore()
        shaft = surface(shaft_arcs + groove(of_shaft, BOTTOM))
        inner = hub_arcs + groove(of_hub, TOP)
        outer = circle(0, 0, OUTSIDE, 2 * element_size)
        hub = surface(outer, inner)
        box = [(-half, BOTTOM), (half, BOTTOM), (half, TOP), (-half, TOP)]
        key = surface(closed([geo.addPoint(*x, 0, element_size / 2) for x in box]))
        geo.synchronize()
        for arc in shaft_arcs + hub_arcs:
            length = RADIUS * (math.pi + 2 * math.atan2(corner, half)) / 3
            gmsh.model.mesh.setTransfiniteCurve(arc, round(length / element_size) + 1)
        for name, body in (("shaft", shaft), ("hub", hub), ("key", key)):
            name_group(2, [body], name)
        name_group(1, outer, "outside")
        gmsh.model.mesh.generate(2)


if __name__ == "__main__":
    command_line(shaft_and_key)

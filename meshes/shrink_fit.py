"""Make shrink_fit.msh: a quarter of two rings, one in the other, meshed apart.

    python meshes/shrink_fit.py [--element-size 1.25e-3] [--output FILE]

Lengths are in metres. Both rings are drawn with the same radius where they are pressed together.
The elements of the hub are 1.4 times as large as those of the shaft, so that nodes do not match.
"""

from __future__ import annotations

from pathlib import Path

import gmsh
from gmsh_files import command_line, name_group, new_file, surface

INNER, RADIUS, OUTER = 0.02, 0.04, 0.07  # of the bore, the fit and the hub
COARSER = 1.4


def ring(name: str, inner: float, outer: float, size: float) -> dict[str, int]:
    """Draw a quarter of a ring; return its sides."""
    geo = gmsh.model.geo
    centre = geo.addPoint(0, 0, 0)
    places = [(inner, 0), (outer, 0), (0, outer), (0, inner)]
    points = [geo.addPoint(x, y, 0, size) for x, y in places]
    sides = {
        "symmetry_y": geo.addLine(points[0], points[1]),
        f"{name} outside": geo.addCircleArc(points[1], centre, points[2]),
        "symmetry_x": geo.addLine(points[2], points[3]),
        f"{name} inside": geo.addCircleArc(points[3], centre, points[0]),
    }
    body = surface(list(sides.values()))
    geo.synchronize()
    name_group(2, [body], name)
    return sides


def shrink_fit(output: Path, element_size: float = 1.25e-3) -> None:
    """Mesh both rings by triangles, those of the shaft of a size [m], and write the file."""
    with new_file(output):
        shaft = ring("shaft", INNER, RADIUS, element_size)
        hub = ring("hub", RADIUS, OUTER, COARSER * element_size)
        for group in dict.fromkeys([*shaft, *hub]):
            sides = [named[group] for named in (shaft, hub) if group in named]
            name_group(1, sides, group)
        gmsh.model.mesh.generate(2)


if __name__ == "__main__":
    command_line(shrink_fit)

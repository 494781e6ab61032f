"""Make bolt_in_lug.msh: a quarter of a lug and of the bolt in its hole, of tetrahedra.

    python meshes/bolt_in_lug.py [--element-size 0.9e-3] [--output FILE]

Lengths are in metres. The bodies are made by OpenCASCADE's Boolean operations, and meshed apart by
Gmsh. The axis of the bolt is the z axis, the lug extends along x; y = 0 and z = 0 are planes of
symmetry. Hole and bolt are drawn with the same radius. The bolt's elements are 0.8 times as large
as those of the lug.
"""

from __future__ import annotations

import math
from pathlib import Path

import gmsh
from gmsh_files import command_line, name_group, new_file, round_coordinates, set_size, sides_of

RADIUS = 0.01  # of hole and bolt
HALF_WIDTH, LENGTH, HALF_THICKNESS = 0.022, 0.06, 0.006  # of the lug; length from the hole's axis
HALF_BOLT = 0.012  # length of the bolt from the plane of symmetry
FINER = 0.8  # the bolt's elements, relative to the lug's
GROWTH, COARSEST = 0.25, 5e-3  # of the elements' size with the distance from the contact
TINY = 1e-6


def lug() -> int:
    """Make a quarter of the lug: a plate with a round end and a hole."""
    occ = gmsh.model.occ
    plate = occ.addBox(0, 0, 0, LENGTH, HALF_WIDTH, HALF_THICKNESS)
    end = occ.addCylinder(0, 0, 0, 0, 0, HALF_THICKNESS, HALF_WIDTH)
    hole = occ.addCylinder(0, 0, 0, 0, 0, HALF_THICKNESS, RADIUS)
    below = occ.addBox(-LENGTH, -LENGTH, 0, 2 * LENGTH, LENGTH, HALF_THICKNESS)
    whole, _ = occ.fuse([(3, plate)], [(3, end)])
    (body,), _ = occ.cut(whole, [(3, hole), (3, below)])
    return int(body[1])


def bolt() -> int:
    """Make a quarter of the bolt."""
    occ = gmsh.model.occ
    return int(occ.addCylinder(0, 0, 0, 0, 0, HALF_BOLT, RADIUS, angle=math.pi))


def name_sides(bodies: dict[str, int]) -> None:
    """Name the bodies and, by shape and place, their sides."""
    named: dict[str, list[int]] = {}
    for name, body in bodies.items():
        name_group(3, [body], name)
        for side in sides_of(body):
            x, y, z = gmsh.model.occ.getCenterOfMass(2, side)
            largest = max(abs(c) for c in gmsh.model.getBoundingBox(2, side)[:2])
            if gmsh.model.getType(2, side) == "Cylinder":
                group = f"{name} surface" if largest < 1.01 * RADIUS else ""
            elif abs(z) < TINY:
                group = "symmetry_z"
            elif abs(y) < TINY:
                group = "symmetry_y"
            elif abs(x - LENGTH) < TINY:
                group = "pulled"
            else:
                group = "clamped" if abs(z - HALF_BOLT) < TINY else ""
            named.setdefault(group, []).append(side)
    for group in sorted(set(named) - {""}):
        name_group(2, named[group], group)


def bolt_in_lug(output: Path, element_size: float = 0.9e-3) -> None:
    """Mesh both bodies by tetrahedra, those of the lug of a size [m], and write the file."""
    with new_file(output):
        bodies = {"lug": lug(), "bolt": bolt()}
        gmsh.model.occ.synchronize()
        name_sides(bodies)
        whole = gmsh.model.getBoundary([(3, bodies["bolt"])], oriented=False)
        of_bolt = {(3, bodies["bolt"]), *whole, *gmsh.model.getBoundary(whole, combined=False)}
        of_bolt = {(dim, abs(tag)) for dim, tag in of_bolt}

        def size(dim: int, tag: int, x: float, y: float, z: float, *_: float) -> float:
            own = FINER * element_size if (dim, tag) in of_bolt else element_size
            away = abs(math.hypot(x, y) - RADIUS) + max(0.0, x)
            return min(own + GROWTH * away, COARSEST)

        set_size(size)
        gmsh.model.mesh.generate(3)
        round_coordinates()


if __name__ == "__main__":
    command_line(bolt_in_lug)

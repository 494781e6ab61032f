"""Mesh a fork, a lug and the pin through both by tetrahedra, as one draws a first joint in CAD.

    python meshes/pin_joint.py [--element-size 1.5] [--order 1] [--output pin_joint.msh]

Lengths are in millimetres. The pin's axis is the z axis, its ends have chamfers; the lug extends
along x, the fork against x. The holes are wider than the pin by the clearance in radius. With
cells of order 2 the nodes in the middle of edges are on the cylinders too.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import gmsh
from gmsh_files import command_line, name_group, new_file, sides_of

RADIUS, CLEARANCE = 5.0, 0.02  # of the pin; of the holes, in radius
HALF_LUG, GAP, TINE = 4.9, 0.1, 7.0  # thickness of half the lug, gap beside it, thickness of a tine
HALF_PIN, CHAMFER = 13.0, 1.0  # half the pin's length
HALF_WIDTH, LENGTH, BRIDGE = 9.0, 30.0, 10.0  # of lug and fork; of the fork's closed end
TINY = 1e-3


def _eye(sign: float, low: float, high: float) -> int:
    """Make a plate with a round end about the z axis that extends along sign x."""
    occ = gmsh.model.occ
    plate = occ.addBox(
        min(0.0, sign * LENGTH), -HALF_WIDTH, low, LENGTH, 2 * HALF_WIDTH, high - low
    )
    end = occ.addCylinder(0, 0, low, 0, 0, high - low, HALF_WIDTH)
    hole = occ.addCylinder(0, 0, low, 0, 0, high - low, RADIUS + CLEARANCE)
    whole, _ = occ.fuse([(3, plate)], [(3, end)])
    ((_, body),), _ = occ.cut(whole, [(3, hole)])
    return int(body)


def _fork() -> int:
    inner, outer = HALF_LUG + GAP, HALF_LUG + GAP + TINE
    tines = [_eye(-1.0, inner, outer), _eye(-1.0, -outer, -inner)]
    bridge = gmsh.model.occ.addBox(-LENGTH, -HALF_WIDTH, -inner, BRIDGE, 2 * HALF_WIDTH, 2 * inner)
    ((_, body),), _ = gmsh.model.occ.fuse([(3, tines[0])], [(3, tines[1]), (3, bridge)])
    return int(body)


def _pin() -> int:
    occ = gmsh.model.occ
    rod = occ.addCylinder(0, 0, -HALF_PIN, 0, 0, 2 * HALF_PIN, RADIUS)
    occ.synchronize()
    ends = [side for side in sides_of(rod) if gmsh.model.getType(2, side) == "Plane"]
    rims = [gmsh.model.getBoundary([(2, end)], oriented=False)[0][1] for end in ends]
    ((_, body),) = occ.chamfer([rod], rims, ends, [CHAMFER])
    return int(body)


def _group(body: str, side: int) -> str:
    """Return the name of the group of a side of a body; none if it is free."""
    x0, _, z0, x1, _, z1 = gmsh.model.getBoundingBox(2, side)
    # the round ends of lug and fork are wider
    if gmsh.model.getType(2, side) == "Cylinder" and max(-x0, x1) < RADIUS + 2 * CLEARANCE:
        return f"{body} surface"
    for name, place in {"fork": -LENGTH, "lug": LENGTH}.items():
        if body == name and max(abs(x0 - place), abs(x1 - place)) < TINY:
            return f"{body} end"
    return ""


def pin_joint(output: Path, element_size: float = 1.5, order: Literal[1, 2] = 1) -> None:
    """Mesh the bodies by tetrahedra of an order, with edges up to a size [mm]; write the file."""
    with new_file(output):
        bodies = {"fork": _fork(), "lug": _eye(1.0, -HALF_LUG, HALF_LUG), "pin": _pin()}
        gmsh.model.occ.synchronize()
        named: dict[str, list[int]] = {}
        for name, body in bodies.items():
            name_group(3, [body], name)
            for side in sides_of(body):
                named.setdefault(_group(name, side), []).append(side)
        for group in sorted(set(named) - {""}):
            name_group(2, named[group], group)
        gmsh.option.setNumber("Mesh.MeshSizeMax", element_size)
        gmsh.model.mesh.generate(3)
        gmsh.model.mesh.setOrder(order)


if __name__ == "__main__":
    command_line(pin_joint)

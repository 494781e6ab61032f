"""Make flange.msh: two flanged pipes, a gasket and three bolts, of tetrahedra.

    python meshes/flange.py [--element-size 5.5e-3] [--output FILE]

Lengths are in metres. The bodies are made by OpenCASCADE's Boolean operations, and meshed apart by
Gmsh. The axis of the pipes is the z axis, the gasket is between the flanges around z = 0. Bolts
have play in their holes. The shank of each is cut at z = 0: "cut 1" is a surface inside the body
"bolt 1". "upper face" and "lower face" are those of the flanges, "gasket above" and "gasket below"
those of the gasket, "upper seats" and "lower seats" those under the heads and nuts, "heads" and
"nuts" those of the bolts. "pulled" and "fixed" are the ends of the pipes.
"""

from __future__ import annotations

import math
from pathlib import Path

import gmsh
from gmsh_files import command_line, name_group, new_file, round_coordinates, set_size, sides_of

# radii of the pipes and of the bolts' circle
BORE, PIPE, FLANGE, BOLTS = 0.020, 0.026, 0.060, 0.043
THICKNESS, STUB = 0.012, 0.020  # of a flange; length of a pipe from it
HALF, GASKET = 0.001, 0.034  # half thickness and outer radius of the gasket
SHANK, HOLE, HEAD, HEIGHT = 0.006, 0.0066, 0.010, 0.008  # radii, and height of a head
NUMBER = 3
TINY = 1e-6


def flange(side: int) -> int:
    """Make the upper (side 1) or lower (-1) pipe with its flange, with holes."""
    occ = gmsh.model.occ
    face = side * HALF
    parts = [(3, occ.addCylinder(0, 0, face, 0, 0, side * THICKNESS - face, FLANGE))]
    parts.append((3, occ.addCylinder(0, 0, face, 0, 0, side * (THICKNESS + STUB) - face, PIPE)))
    whole, _ = occ.fuse(parts[:1], parts[1:])
    holes = [(3, occ.addCylinder(0, 0, 0, 0, 0, side * (THICKNESS + STUB), BORE))]
    for x, y in places():
        holes.append((3, occ.addCylinder(x, y, 0, 0, 0, side * THICKNESS, HOLE)))
    ((_, body),), _ = occ.cut(whole, holes)
    return int(body)


def gasket() -> int:
    """Make the ring between the flanges."""
    occ = gmsh.model.occ
    disc = occ.addCylinder(0, 0, -HALF, 0, 0, 2 * HALF, GASKET)
    ((_, body),), _ = occ.cut(
        [(3, disc)], [(3, occ.addCylinder(0, 0, -HALF, 0, 0, 2 * HALF, BORE))]
    )
    return int(body)


def places() -> list[tuple[float, float]]:
    """Return the axes of the bolts."""
    angles = [2 * math.pi * k / NUMBER for k in range(NUMBER)]
    return [(BOLTS * math.cos(t), BOLTS * math.sin(t)) for t in angles]


def bolt(x: float, y: float) -> list[int]:
    """Make the upper and the lower half of a bolt, which share the cut."""
    occ = gmsh.model.occ
    halves = []
    for side in (1, -1):
        shank = occ.addCylinder(x, y, 0, 0, 0, side * THICKNESS, SHANK)
        head = occ.addCylinder(x, y, side * THICKNESS, 0, 0, side * HEIGHT, HEAD)
        whole, _ = occ.fuse([(3, shank)], [(3, head)])
        halves.append(whole[0])
    made, _ = occ.fragment(halves[:1], halves[1:])
    return [int(tag) for _, tag in made]


def name_sides(bodies: dict[str, list[int]]) -> None:
    """Name the bodies and, by place, their sides."""
    named: dict[str, list[int]] = {}
    for name, parts in bodies.items():
        name_group(3, parts, name)
        for side in sorted({side for part in parts for side in sides_of(part)}):
            low, high = (gmsh.model.getBoundingBox(2, side)[k] for k in (2, 5))
            if high - low > TINY * 10:
                continue
            z = 0.5 * (low + high)
            place = min((0, HALF, THICKNESS, THICKNESS + STUB), key=lambda at: abs(abs(z) - at))
            if abs(abs(z) - place) > 10 * TINY:
                continue
            if name.startswith("bolt"):
                groups = {0: f"cut {name[-1]}", THICKNESS: "heads" if z > 0 else "nuts"}
            elif name == "gasket":
                groups = {HALF: "gasket above" if z > 0 else "gasket below"}
            else:
                end = "pulled" if z > 0 else "fixed"
                groups = {HALF: f"{name} face", THICKNESS: f"{name} seats", THICKNESS + STUB: end}
            if place in groups:
                named.setdefault(groups[place], []).append(side)
    for group in sorted(named):
        name_group(2, named[group], group)


def flange_with_bolts(output: Path, element_size: float = 5.5e-3) -> None:
    """Mesh all bodies by tetrahedra, of a size [m] or smaller, and write the file."""
    with new_file(output):
        bodies = {"upper": [flange(1)], "lower": [flange(-1)], "gasket": [gasket()]}
        bodies |= {f"bolt {k}": bolt(*place) for k, place in enumerate(places(), start=1)}
        gmsh.model.occ.synchronize()
        name_sides(bodies)

        def size(dim: int, tag: int, x: float, y: float, *_: float) -> float:
            away = min(math.hypot(x - a, y - b) for a, b in places())
            return min(max(0.7 * element_size, 0.25 * away), element_size)

        set_size(size)
        gmsh.model.mesh.generate(3)
        round_coordinates()


if __name__ == "__main__":
    command_line(flange_with_bolts)

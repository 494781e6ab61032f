"""Make flange.msh: two flanged pipes, a gasket and three bolts, of tetrahedra.

    python meshes/flange.py [--element-size 5.5e-3] [--output FILE]

Needs Gmsh with its Python module ('apt install python3-gmsh' or 'pip install gmsh').
Lengths are in metres. The bodies are made by OpenCASCADE's Boolean operations, and meshed apart by
Gmsh. The axis of the pipes is the z axis, the gasket is between the flanges around z = 0. Bolts
have play in their holes. The shank of each is cut at z = 0: "cut 1" is a surface inside the body
"bolt 1". "upper face" and "lower face" are those of the flanges, "gasket above" and "gasket below"
those of the gasket, "upper seats" and "lower seats" those under the heads and nuts, "heads" and
"nuts" those of the bolts. "pulled" and "fixed" are the ends of the pipes.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import gmsh
import numpy as np

BORE, PIPE, FLANGE, BOLTS = (
    0.020,
    0.026,
    0.060,
    0.043,
)  # radii of the pipes and of the bolts' circle
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
        gmsh.model.setPhysicalName(3, gmsh.model.addPhysicalGroup(3, parts), name)
        sides = {
            abs(tag)
            for part in parts
            for _, tag in gmsh.model.getBoundary([(3, part)], oriented=False)
        }
        for side in sorted(sides):
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
        gmsh.model.setPhysicalName(2, gmsh.model.addPhysicalGroup(2, named[group]), group)


def round_coordinates() -> None:
    """Round to a nanometre: shorter files."""
    for dim, entity in gmsh.model.getEntities():
        nodes, points, _ = gmsh.model.mesh.getNodes(dim, entity)
        for node, point in zip(nodes, np.reshape(points, (-1, 3)), strict=True):
            gmsh.model.mesh.setNode(int(node), list(np.round(point, 9)), [])


def flange_with_bolts(output: Path, size: float = 5.5e-3) -> None:
    """Mesh all bodies by tetrahedra and write the file."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("flange")
        bodies = {"upper": [flange(1)], "lower": [flange(-1)], "gasket": [gasket()]}
        bodies |= {f"bolt {k}": bolt(*place) for k, place in enumerate(places(), start=1)}
        gmsh.model.occ.synchronize()
        name_sides(bodies)

        def element_size(dim: int, tag: int, x: float, y: float, z: float, *_: float) -> float:
            away = min(math.hypot(x - a, y - b) for a, b in places())
            return min(max(0.7 * size, 0.25 * away), size)

        gmsh.model.mesh.setSizeCallback(element_size)
        for source in ("ExtendFromBoundary", "FromPoints", "FromCurvature"):
            gmsh.option.setNumber(f"Mesh.MeshSize{source}", 0)
        gmsh.model.mesh.generate(3)
        round_coordinates()
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        gmsh.write(str(output))
    finally:
        gmsh.finalize()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--element-size", type=float, default=5.5e-3, help="of the flanges [m]")
    parser.add_argument("--output", type=Path, default=Path(__file__).with_suffix(".msh"))
    options = parser.parse_args()
    flange_with_bolts(options.output, options.element_size)

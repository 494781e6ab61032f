"""Make stack_of_blocks.msh: 3 x 3 x 3 loose cubes of 1 m, each with nodes of its own.

    python meshes/stack_of_blocks.py [--blocks 3] [--elements-per-block 4] [--output FILE]

Needs Gmsh with its Python module ('apt install python3-gmsh' or 'pip install gmsh').
The cubes are numbered from 1 along x, y and z. Every face has a physical group of its own, named
by its cube and the side it is on: "2 1 3 +x" touches "3 1 3 -x".
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import gmsh

SIDES = {"-x": (0, 0), "+x": (0, 1), "-y": (1, 0), "+y": (1, 1), "-z": (2, 0), "+z": (2, 1)}


def cube(corner: tuple[int, int, int], number: int, name: str) -> None:
    """Make a unit cube and the physical groups of its volume and its six faces."""
    volume = gmsh.model.occ.addBox(*corner, 1, 1, 1)
    gmsh.model.occ.synchronize()
    gmsh.model.addPhysicalGroup(3, [volume], number)
    gmsh.model.setPhysicalName(3, number, name)
    for _, surface in gmsh.model.getBoundary([(3, volume)], oriented=False):
        centre = gmsh.model.occ.getCenterOfMass(2, surface)
        for side, (axis, end) in SIDES.items():
            if abs(centre[axis] - corner[axis] - end) < 1e-6:
                group = gmsh.model.addPhysicalGroup(2, [surface])
                gmsh.model.setPhysicalName(2, group, f"{name} {side}")


def mesh_with_hexahedra(elements_per_block: int) -> None:
    """Cut each cube into a regular grid."""
    mesh = gmsh.model.mesh
    for _, curve in gmsh.model.getEntities(1):
        mesh.setTransfiniteCurve(curve, elements_per_block + 1)
    for _, surface in gmsh.model.getEntities(2):
        mesh.setTransfiniteSurface(surface)
        mesh.setRecombine(2, surface)
    for _, volume in gmsh.model.getEntities(3):
        mesh.setTransfiniteVolume(volume)
    mesh.generate(3)


def stack_of_blocks(output: Path, blocks: int = 3, elements_per_block: int = 4) -> None:
    """Mesh the cubes and write the file."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("stack_of_blocks")
        places = itertools.product(range(blocks), repeat=3)
        for number, (k, j, i) in enumerate(places, start=1):
            cube((i, j, k), number, f"{i + 1} {j + 1} {k + 1}")
        mesh_with_hexahedra(elements_per_block)
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        gmsh.write(str(output))
    finally:
        gmsh.finalize()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--blocks", type=int, default=3)
    parser.add_argument("--elements-per-block", type=int, default=4)
    parser.add_argument("--output", type=Path, default=Path(__file__).with_suffix(".msh"))
    options = parser.parse_args()
    stack_of_blocks(options.output, options.blocks, options.elements_per_block)

"""Make stack_of_blocks.msh: 3 x 3 x 3 loose cubes of 1 m, each with nodes of its own.

    python meshes/stack_of_blocks.py [--blocks 3] [--elements-per-block 4] [--output FILE]

The cubes are numbered from 1 along x, y and z. Every face has a physical group of its own, named
by its cube and the side it is on: "2 1 3 +x" touches "3 1 3 -x".
"""

from __future__ import annotations

import itertools
from pathlib import Path

import gmsh
from gmsh_files import command_line, mesh_with_hexahedra, name_group, new_file, sides_of

SIDES = {"-x": (0, 0), "+x": (0, 1), "-y": (1, 0), "+y": (1, 1), "-z": (2, 0), "+z": (2, 1)}


def cube(corner: tuple[int, int, int], number: int, name: str) -> None:
    """Make a unit cube and the physical groups of its volume and its six faces."""
    volume = gmsh.model.occ.addBox(*corner, 1, 1, 1)
    gmsh.model.occ.synchronize()
    name_group(3, [volume], name, number)
    for face in sides_of(volume):
        centre = gmsh.model.occ.getCenterOfMass(2, face)
        for side, (axis, end) in SIDES.items():
            if abs(centre[axis] - corner[axis] - end) < 1e-6:
                name_group(2, [face], f"{name} {side}")


def stack_of_blocks(output: Path, blocks: int = 3, elements_per_block: int = 4) -> None:
    """Mesh the cubes and write the file."""
    with new_file(output):
        places = itertools.product(range(blocks), repeat=3)
        for number, (k, j, i) in enumerate(places, start=1):
            cube((i, j, k), number, f"{i + 1} {j + 1} {k + 1}")
        mesh_with_hexahedra(elements_per_block)


if __name__ == "__main__":
    command_line(stack_of_blocks)

"""Make half_disc_on_block.msh: half of a half disc that stands on half of a block, in 2D.

    python meshes/half_disc_on_block.py [--radius 50] [--side 100] [--order 2] [--output FILE]

The axis of symmetry is x = 0; they touch at the origin. The block is twice as deep as half its
width, `side`. Elements grow away from the origin; the meshes do not match.
"""

from __future__ import annotations

from pathlib import Path

import gmsh
from gmsh_files import command_line, name_group, new_file, set_size_formula

TINY = 1e-3


def half_disc_on_block(
    output: Path,
    radius: float = 50.0,
    side: float = 100.0,
    element_size: float = 0.3,
    near: float = 9.0,
    order: int = 2,
) -> None:
    """Mesh both by triangles, of a size up to the distance `near` from the origin."""
    occ, model = gmsh.model.occ, gmsh.model
    with new_file(output):
        disc = occ.addDisk(0, radius, 0, radius, radius)
        part = occ.addRectangle(0, 0, 0, radius, radius)
        ((_, disc),), _ = occ.intersect([(2, disc)], [(2, part)])
        block = occ.addRectangle(0, -2 * side, 0, side, 2 * side)
        occ.synchronize()
        sides = {}
        for name, (x0, y0, x1, y1) in {
            "axis": (-1, -2 * side - 1, TINY, radius + 1),
            "top": (-1, radius - TINY, radius + 1, radius + TINY),
            "foot": (-1, -2 * side - TINY, side + 1, TINY - 2 * side),
            "face": (-1, -TINY, side + 1, TINY),
        }.items():
            found = model.getEntitiesInBoundingBox(x0, y0, -1, x1, y1, 1, 1)
            sides[name] = [tag for _, tag in found]
        around = [tag for _, tag in model.getBoundary([(2, disc)], oriented=False)]
        sides["arc"] = [tag for tag in around if tag not in sides["axis"] + sides["top"]]
        name_group(2, [disc], "disc")
        name_group(2, [block], "block")
        for name, curves in sides.items():
            name_group(1, curves, name)
        set_size_formula(f"{element_size}+0.12*Max(Sqrt(x*x+y*y)-{near},0)")
        gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
        model.mesh.generate(2)
        model.mesh.setOrder(order)


if __name__ == "__main__":
    command_line(half_disc_on_block)

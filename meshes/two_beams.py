"""Make two_beams.msh: two beams of 2 x 1 x 1 m, the upper one resting on half of the lower one.

    python meshes/two_beams.py [--cell tetrahedron] [--elements-per-metre 12] [--output FILE]

The beams are separate bodies: where they touch, each has its own nodes, at the same places.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import gmsh
from gmsh_files import command_line, mesh_with_hexahedra, name_group, new_file, sides_of

IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]

# Physical groups: name -> (tag, a point in each of the surfaces)
SURFACES = {
    "clamped": (3, [(0, 0.5, 0.5)]),
    "guided": (4, [(3, 0.5, 1.5)]),
    "contact_upper": (5, [(1.5, 0.5, 1)]),
    "contact_lower": (6, [(1.5, 0.5, 1)]),
    "loaded": (7, [(1.5, 0.5, 2), (2.5, 0.5, 2), (1, 0.5, 1.5)]),
}
BODIES = {
    "lower": (1, ["clamped", "contact_lower"]),
    "upper": (2, ["guided", "contact_upper", "loaded"]),
}


def beam(x: float, z: float) -> list[int]:
    """Make a beam with the lowest corner (x, 0, z) out of two cubes, which share a face."""
    cubes = [(3, gmsh.model.occ.addBox(x + k, 0, z, 1, 1, 1)) for k in (0, 1)]
    gmsh.model.occ.fragment(cubes[:1], cubes[1:])
    gmsh.model.occ.synchronize()
    return [tag for _, tag in cubes]


def surface_at(point: tuple[float, float, float], volumes: list[int]) -> int:
    """Find the surface of the volumes that has its centre at a point."""
    for side in (side for volume in volumes for side in sides_of(volume)):
        centre = gmsh.model.occ.getCenterOfMass(2, side)
        if max(abs(a - b) for a, b in zip(centre, point, strict=True)) < 1e-6:
            return side
    raise ValueError(f"no surface has its centre at {point}")


def mesh_with_tetrahedra(elements_per_metre: int, surface: int, same_as: int) -> None:
    """Fill the cubes with tetrahedra, and copy the triangles of one surface to another."""
    size = 1 / elements_per_metre
    gmsh.model.mesh.setSize(gmsh.model.getEntities(0), size)
    gmsh.model.mesh.setPeriodic(2, [surface], [same_as], IDENTITY)
    gmsh.model.mesh.generate(3)


def two_beams(
    output: Path,
    cell: Literal["hexahedron", "tetrahedron"] = "hexahedron",
    elements_per_metre: int = 12,
) -> None:
    """Mesh the two beams and write the file."""
    with new_file(output):
        volumes = {"lower": beam(0, 0), "upper": beam(1, 1)}
        surfaces: dict[str, list[int]] = {}
        for body, (body_tag, names) in BODIES.items():
            name_group(3, volumes[body], body, body_tag)
            for name in names:
                tag, points = SURFACES[name]
                surfaces[name] = [surface_at(point, volumes[body]) for point in points]
                name_group(2, surfaces[name], name, tag)
        if cell == "hexahedron":
            mesh_with_hexahedra(elements_per_metre)
        else:
            mesh_with_tetrahedra(
                elements_per_metre, *surfaces["contact_upper"], *surfaces["contact_lower"]
            )


if __name__ == "__main__":
    command_line(two_beams)

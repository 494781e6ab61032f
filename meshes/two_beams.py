"""Make two_beams.msh: two beams of 2 x 1 x 1 m, the upper one resting on half of the lower one.

    python meshes/two_beams.py [--cell tetrahedron] [--elements-per-metre 12] [--output FILE]

Needs Gmsh with its Python module ('apt install python3-gmsh' or 'pip install gmsh').
The beams are separate bodies: where they touch, each has its own nodes, at the same places.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gmsh

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
    solids = [(3, volume) for volume in volumes]
    for _, surface in gmsh.model.getBoundary(solids, oriented=False):
        centre = gmsh.model.occ.getCenterOfMass(2, surface)
        if max(abs(a - b) for a, b in zip(centre, point, strict=True)) < 1e-6:
            return surface
    raise ValueError(f"no surface has its centre at {point}")


def mesh_with_hexahedra(elements_per_metre: int) -> None:
    """Cut each cube into a regular grid."""
    mesh = gmsh.model.mesh
    for _, curve in gmsh.model.getEntities(1):
        mesh.setTransfiniteCurve(curve, elements_per_metre + 1)
    for _, surface in gmsh.model.getEntities(2):
        mesh.setTransfiniteSurface(surface)
        mesh.setRecombine(2, surface)
    for _, volume in gmsh.model.getEntities(3):
        mesh.setTransfiniteVolume(volume)
    mesh.generate(3)


def mesh_with_tetrahedra(elements_per_metre: int, surface: int, same_as: int) -> None:
    """Fill the cubes with tetrahedra, and copy the triangles of one surface to another."""
    size = 1 / elements_per_metre
    gmsh.model.mesh.setSize(gmsh.model.getEntities(0), size)
    gmsh.model.mesh.setPeriodic(2, [surface], [same_as], IDENTITY)
    gmsh.model.mesh.generate(3)


def two_beams(output: Path, cell: str = "hexahedron", elements_per_metre: int = 12) -> None:
    """Mesh the two beams and write the file."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("two_beams")
        volumes = {"lower": beam(0, 0), "upper": beam(1, 1)}
        surfaces: dict[str, list[int]] = {}
        for body, (body_tag, names) in BODIES.items():
            gmsh.model.addPhysicalGroup(3, volumes[body], body_tag)
            gmsh.model.setPhysicalName(3, body_tag, body)
            for name in names:
                tag, points = SURFACES[name]
                surfaces[name] = [surface_at(point, volumes[body]) for point in points]
                gmsh.model.addPhysicalGroup(2, surfaces[name], tag)
                gmsh.model.setPhysicalName(2, tag, name)
        if cell == "hexahedron":
            mesh_with_hexahedra(elements_per_metre)
        else:
            mesh_with_tetrahedra(
                elements_per_metre, *surfaces["contact_upper"], *surfaces["contact_lower"]
            )
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        gmsh.write(str(output))
    finally:
        gmsh.finalize()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cell", choices=("hexahedron", "tetrahedron"), default="hexahedron")
    parser.add_argument("--elements-per-metre", type=int, default=12)
    parser.add_argument("--output", type=Path, default=Path(__file__).with_name("two_beams.msh"))
    options = parser.parse_args()
    two_beams(options.output, options.cell, options.elements_per_metre)

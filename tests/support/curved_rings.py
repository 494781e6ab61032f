"""Two quarter rings, one in the other, meshed by Gmsh with curved cells."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI

from msh_files import gmsh_model

from fenics_tfeti.io import read_msh


def quarter_rings(path: Path, cells: Sequence[int], radii: Sequence[Any], recombine: bool) -> Any:
    """Mesh two quarter rings with cells of degree 2, each with its number of cells along its arcs.

    Tags 1 and 2 of cells; of facets 11, 12 where they touch, 13 on the x axis, 14 on the y axis.
    """
    with gmsh_model(path, 2, order=2) as gmsh:
        geo, mesh = gmsh.model.geo, gmsh.model.mesh
        rings = []
        for a, b in radii:
            centre = geo.addPoint(0, 0, 0)
            p = [geo.addPoint(*x, 0) for x in ((a, 0), (b, 0), (0, b), (0, a))]
            lines = [
                geo.addLine(p[0], p[1]),
                geo.addCircleArc(p[1], centre, p[2]),
                geo.addLine(p[2], p[3]),
                geo.addCircleArc(p[3], centre, p[0]),
            ]
            rings.append((geo.addPlaneSurface([geo.addCurveLoop(lines)]), lines))
        geo.synchronize()
        for n, (surface, lines) in zip(cells, rings, strict=True):
            for k, line in enumerate(lines):
                mesh.setTransfiniteCurve(line, (n if k % 2 else max(2, n // 3)) + 1)
            mesh.setTransfiniteSurface(surface)
            if recombine:
                mesh.setRecombine(2, surface)
        (inner, i), (outer, o) = rings
        groups = [(2, [inner], 1), (2, [outer], 2), (1, [i[1]], 11), (1, [o[3]], 12)]
        for dim, entities, tag in [*groups, (1, [i[0], o[0]], 13), (1, [i[2], o[2]], 14)]:
            gmsh.model.addPhysicalGroup(dim, entities, tag)
    return read_msh(path, MPI.COMM_SELF, 2)

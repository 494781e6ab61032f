"""Time and memory of the estimate of the mesh's error, beside those of the solve.

    python benchmarks/run.py mesh_error [--cases tetrahedra triangles ...] [--size 1.0]

Unstructured tetrahedra of the two beams of `general`, and blocks of unstructured triangles, or of
cells of one size, on a rigid roller or ball. Each runs in a process of its own, after a small one
that compiles the forms. Seconds are of the processor. `size` multiplies the cells along an edge.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

import gmsh
from general import Beams, make_meshes
from mesh_errors import FOOT, LEFT, TOP, roller, roller_on
from runner import separately
from scenes import at

from fenics_tfeti.feti.report.report import peak_memory
from fenics_tfeti.io import read_msh, tag_facets

# cells along an edge, or along a metre, and those of a run that compiles
CASES = {
    "tetrahedra": (34, 4),
    "triangles": (420, 4),
    "tetrahedra of one size": (50, 3),
    "hexahedra of one size": (32, 3),
    "triangles of one size": (450, 4),
    "quadrilaterals of one size": (450, 4),
}
CELLS = {"tetrahedra": "tetrahedron", "hexahedra": "hexahedron"}
CELLS |= {"triangles": "triangle", "quadrilaterals": "quadrilateral"}
CHOICES = {"cases": list(CASES)}


def posed(name, n):
    """Return a problem."""
    if name == "tetrahedra":
        with tempfile.TemporaryDirectory() as folder:
            beams = Beams(read_msh(make_meshes(n, Path(folder))["contact"]))
        return beams.contact()
    if name == "triangles":
        return roller_on(block(n))
    return roller(MPI.COMM_SELF, n, 1, CELLS[name.split()[0]]).problem(cell_tags=None)


def block(n):
    """Return a block of unstructured triangles."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    for option in ("Mesh.MeshSizeMin", "Mesh.MeshSizeMax"):
        gmsh.option.setNumber(option, 0.02 / n)
    face = gmsh.model.occ.addRectangle(0.0, -0.02, 0.0, 0.02, 0.02)
    gmsh.model.occ.synchronize()
    gmsh.model.addPhysicalGroup(2, [face], 1)
    gmsh.model.mesh.generate(2)
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder) / "block.msh")
        gmsh.write(file)
        gmsh.finalize()
        parts = read_msh(file, MPI.COMM_SELF, gdim=2)
    marks = [(FOOT, at(1, 0.0)), (TOP, at(1, -0.02)), (LEFT, at(0, 0.0))]
    return replace(parts, facet_tags=tag_facets(parts.mesh, marks))


def measured(name, n):
    """Solve and estimate; return a row of the table."""
    problem = posed(name, n)
    comm = problem.space.mesh.comm
    begin = time.process_time()
    problem.solve()
    solved, memory = time.process_time(), peak_memory(comm)
    estimate = problem.mesh_error()
    seconds = time.process_time() - solved
    cells = problem.space.mesh.topology.index_map(problem.space.mesh.topology.dim).size_global
    return {
        "case": name,
        "unknowns": problem.report.unknowns["primal"],
        "cells": cells,
        "error": estimate.error,
        "seconds of the solve": solved - begin,
        "seconds": seconds,
        "ratio": seconds / (solved - begin),
        "kB per cell": (peak_memory(comm) - memory) / cells / 1e3,
    }


def run(cases=tuple(CASES), size=1.0, only=0):
    """Solve each case, and estimate its error. With `only`, cells, it runs in this process."""
    for name in cases:
        n, small = CASES[name]
        if only:
            yield measured(name, only)
            continue
        separately("mesh_error", cases=[name], only=small)
        yield from separately("mesh_error", cases=[name], only=max(small, round(size * n)))

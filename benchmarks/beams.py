"""The two beams of sec. 11.11.1 from structured hexahedra at any size, in box subdomains.

    python benchmarks/run.py beams --subdomains-per-metre 2 --elements-per-subdomain 8 --rtol 1e-4

The subdomains are cubes of 1 / (subdomains per metre). The mesh does not depend on the number of
processes, but a cube whose cells are on two processes becomes two subdomains.
"""

from __future__ import annotations

import time

from mpi4py import MPI

import numpy as np
import scenes
from scenes import Scene

import ufl

from fenics_tfeti import ContactProblem
from fenics_tfeti.fem import _compat

PLAIN = {
    "method": "smalbe",
    "mprgp_expansion": "standard",
    "preconditioner": "none",
    "scaling": "multiplicity",
}


def cubes(scene: Scene, per_metre: int) -> np.ndarray:
    """Number the cube, or square, that holds each cell of this rank."""
    owned = scene.mesh.topology.index_map(scene.gdim).size_local
    corners = scene.mesh.geometry.x[_compat.geometry_cells(scene.mesh)[:owned], : scene.gdim]
    number = scene.cell_tags.values[:owned].astype(np.int64)
    for place in np.floor(per_metre * corners.mean(axis=1)).astype(np.int64).T:
        number = 4 * per_metre * number + place
    return number


def sheets(comm: MPI.Intracomm, cell: str, n: int) -> Scene:
    """Return the beams in plane strain, loaded at the top alone, with n cells per metre."""
    scene = scenes.beams(comm, cell, n)
    upwards = ufl.FacetNormal(scene.mesh)[1]  # zero at the left face
    scene.L = scene.constant(-scenes.TRACTION) * upwards * scene.v[1] * scene.ds(scenes.LOADED)
    return scene


def build(
    subdomains_per_metre: int, elements_per_subdomain: int, rtol: float, plain: bool = False
) -> ContactProblem:
    """Return the problem of demos/two_beams.py, with the cubes as subdomains."""
    n = subdomains_per_metre * elements_per_subdomain
    scene = scenes.two_beams(MPI.COMM_WORLD, "hexahedron", n)
    return scene.problem(
        cell_tags=None,
        subdomains=cubes(scene, subdomains_per_metre),
        options={"rtol": rtol, **(PLAIN if plain else {})},
    )


def run(subdomains_per_metre=2, elements_per_subdomain=8, rtol=1e-4, plain=False):
    """Solve once; `plain` is SMALBE-M with plain MPRGP and no preconditioner."""
    start = time.perf_counter()
    problem = build(subdomains_per_metre, elements_per_subdomain, rtol, plain)
    problem.solve()
    wall, report = time.perf_counter() - start, problem.report
    yield {
        "ranks": report.ranks,
        "subdomains": report.subdomains,
        "classes": report.classes,
        "outer": report.outer_iterations,
        "force [N]": report.contacts[0].normal_force,
        "energy [J]": report.energy,
        "peak [MB]": report.peak_memory_bytes // 10**6,
        "seconds with mesh": wall,
        "unknowns": report.unknowns,
        "products": report.products,
        "seconds": report.seconds,
        "certificate": report.certificate.numbers(),
    }

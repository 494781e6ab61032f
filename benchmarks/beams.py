"""The two beams of sec. 11.11.1 from structured hexahedra at any size, in box subdomains.

    python benchmarks/run.py beams --subdomains-per-metre 2 --elements-per-subdomain 8 --rtol 1e-4

The subdomains are cubes of 1 / (subdomains per metre). The mesh does not depend on the number of
processes, but a cube whose cells are on two processes becomes two subdomains.
"""

from __future__ import annotations

import time

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem
from dolfinx.mesh import Mesh

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.fem import _compat
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets

CLAMPED, GUIDED, SLAVE, MASTER, LOADED = 3, 4, 5, 6, 7
PLAIN = {
    "method": "smalbe",
    "mprgp_expansion": "standard",
    "preconditioner": "none",
    "scaling": "multiplicity",
}


def cube_of_cells(mesh: Mesh, cell_tags, per_metre: int) -> np.ndarray:
    """Number the cube that holds each cell of this rank."""
    owned = mesh.topology.index_map(3).size_local
    corners = mesh.geometry.x[_compat.geometry_cells(mesh)[:owned]]
    x, y, z = np.floor(per_metre * corners.mean(axis=1)).astype(np.int64).T
    size = 4 * per_metre
    return ((cell_tags.values[:owned] * size + x) * size + y) * size + z


def build(
    subdomains_per_metre: int, elements_per_subdomain: int, rtol: float, plain: bool = False
) -> ContactProblem:
    """Return the problem of demos/two_beams.py, with the cubes as subdomains."""
    n = subdomains_per_metre * elements_per_subdomain
    lower = Box((0, 0, 0), (2, 1, 1), (2 * n, n, n))
    upper = Box((1, 0, 1), (3, 1, 2), (2 * n, n, n))
    tagged = boxes(MPI.COMM_WORLD, [lower, upper])
    mesh, cell_tags = tagged.mesh, tagged.cell_tags
    facet_tags = tag_facets(
        mesh,
        [
            (CLAMPED, lambda x: np.isclose(x[0], 0), 1),
            (GUIDED, lambda x: np.isclose(x[0], 3), 2),
            (SLAVE, lambda x: np.isclose(x[2], 1) & (x[0] < 2 + 1e-9), 2),
            (MASTER, lambda x: np.isclose(x[2], 1) & (x[0] > 1 - 1e-9), 1),
            (LOADED, lambda x: np.isclose(x[2], 2), 2),
            (LOADED, lambda x: np.isclose(x[0], 1), 2),
        ],
        cell_tags,
    )
    V = displacement_space(mesh)
    mu, lmbda = (fem.Constant(mesh, 2.1e11 * factor) for factor in (1 / 2.6, 0.3 / 0.52))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)

    def strain(w):
        return ufl.sym(ufl.grad(w))

    stress = lmbda * ufl.tr(strain(u)) * ufl.Identity(3) + 2 * mu * strain(u)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
    traction = fem.Constant(mesh, np.array([0.0, 0.0, -20e6]))
    fixed = fem.locate_dofs_topological(V, 2, facet_tags.find(CLAMPED))
    bcs = [fem.dirichletbc(np.zeros(3), fixed, V)]
    for component in (0, 1):
        part = V.sub(component)
        dofs = fem.locate_dofs_topological(part, 2, facet_tags.find(GUIDED))
        bcs.append(fem.dirichletbc(0.0, dofs, part))
    return ContactProblem(
        ufl.inner(stress, strain(v)) * ufl.dx,
        ufl.inner(traction, v) * ds(LOADED),
        bcs=bcs,
        contacts=[ContactPair(facet_tags, slave=SLAVE, master=MASTER)],
        subdomains=cube_of_cells(mesh, cell_tags, subdomains_per_metre),
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

"""The two beams of sec. 11.11.1 from structured hexahedra at any size, in box subdomains.

    python benchmarks/beams.py --subdomains-per-metre 2 --elements-per-subdomain 8 --rtol 1e-4 \
        --json out.json

The subdomains are cubes of 1 / (subdomains per metre). The mesh does not depend on the number of
processes, but a cube whose cells are on two processes becomes two subdomains.
"""

from __future__ import annotations

import argparse
import logging
import sys
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


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--subdomains-per-metre", type=int, default=2, metavar="m")
    parser.add_argument("--elements-per-subdomain", type=int, default=8, metavar="H/h")
    parser.add_argument("--rtol", type=float, default=1e-4)
    parser.add_argument("--json", metavar="FILE", help="write the report")
    parser.add_argument(
        "--plain", action="store_true", help="SMALBE-M with plain MPRGP, no preconditioner"
    )
    parser.add_argument("--verbose", action="store_true", help="a line for each outer iteration")
    return parser.parse_known_args()[0]


def cube_of_cells(mesh: Mesh, cell_tags, per_metre: int) -> np.ndarray:
    """Number the cube that holds each cell of this rank."""
    owned = mesh.topology.index_map(3).size_local
    corners = mesh.geometry.x[_compat.geometry_cells(mesh)[:owned]]
    x, y, z = np.floor(per_metre * corners.mean(axis=1)).astype(np.int64).T
    size = 4 * per_metre
    return ((cell_tags.values[:owned] * size + x) * size + y) * size + z


def build(arguments: argparse.Namespace) -> ContactProblem:
    """Return the problem of demos/two_beams.py, with the cubes as subdomains."""
    n = arguments.subdomains_per_metre * arguments.elements_per_subdomain
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
        subdomains=cube_of_cells(mesh, cell_tags, arguments.subdomains_per_metre),
        options={"rtol": arguments.rtol, **(PLAIN if arguments.plain else {})},
    )


def print_table(report, wall: float) -> None:
    """Print the report as a table, with the wall time of set-up and solution."""
    groups = {
        "unknowns": report.unknowns,
        "products": report.products,
        "seconds": {name: f"{time:.2f}" for name, time in report.seconds.items()},
        "certificate": {
            name: f"{value:.1e}" for name, value in report.certificate.numbers().items()
        },
        "solve": {
            "subdomains": report.subdomains,
            "classes": report.classes,
            "outer iterations": report.outer_iterations,
            "contact force [N]": f"{report.contacts[0].normal_force:.6e}",
            "energy [J]": f"{report.energy:.6e}",
            "peak memory [MB]": report.peak_memory_bytes // 10**6,
            "seconds with mesh": f"{wall:.1f}",
            "converged": report.converged,
            "ranks": report.ranks,
        },
    }
    for group, entries in groups.items():
        print(group)
        for name, value in entries.items():
            print(f"  {name:<20} {value!s:>14}")


def main() -> None:
    arguments = parse_arguments()
    if arguments.verbose:
        logging.basicConfig(stream=sys.stdout, format="%(message)s", force=True)
        logging.getLogger("fenics_tfeti").setLevel(logging.INFO)
    start = time.perf_counter()
    problem = build(arguments)
    problem.solve()
    if MPI.COMM_WORLD.rank == 0:
        print_table(problem.report, time.perf_counter() - start)
    if arguments.json:
        problem.report.to_json(arguments.json)


if __name__ == "__main__":
    main()

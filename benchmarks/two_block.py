"""Products with F for nearly incompressible materials: the blocks of MFEM's contact miniapp.

    python benchmarks/two_block.py [-r 0 1 2] [--nu 0.3 0.499 0.49999] [--json FILE]
    mpirun -n 2 python benchmarks/two_block.py -r 1

A stiff unit cube (E = 1000, nu = 0) is pressed by 0.25 / 1.4 into a block of 9 x 4 x 2.5 (E = 1) of
24 x 12 x 6 hexahedra, refined r times; --scene ironing bends a stiff shell over the block instead.
The volumetric term is integrated by one point; --full integrates it fully, which locks; --degree 2
takes quadratic displacements. Seconds are processor time of set-up and solve on rank 0.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.fem import _compat
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets

comm = MPI.COMM_WORLD
LENGTHS = np.array([9.0, 4.0, 2.5])
BOTTOM, BLOCK, TOOL, PRESSED = 1, 2, 3, 4
DESCENT = 0.25 / 1.4


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-r", type=int, nargs="+", default=[0, 1], help="refinements")
    parser.add_argument("--nu", type=float, nargs="+", default=[0.3, 0.45, 0.49, 0.499, 0.49999])
    parser.add_argument("--scene", choices=("two-block", "ironing"), default="two-block")
    parser.add_argument("--slave", choices=("tool", "block"), default="tool")
    parser.add_argument("--full", action="store_true", help="full integration, which locks")
    parser.add_argument("--degree", type=int, default=1)
    parser.add_argument("--cell", default="hexahedron")
    parser.add_argument("--option", nargs="*", default=[], metavar="NAME=VALUE")
    parser.add_argument("--json", metavar="FILE", help="write the table")
    return parser.parse_known_args()[0]


def bent(x: np.ndarray) -> np.ndarray:
    """Bend the shell, a box from 0 to (4, 5, 0.5), over the middle of a quarter of the block."""
    length, width, thickness = 4.0, 5.0, 0.5
    angle = 0.5 * np.pi
    t = -angle * (x[:, 0] / length + 0.5)
    r = length / angle + x[:, 2]
    height = length / angle + thickness + LENGTHS[2]
    return np.column_stack(
        [
            0.25 * LENGTHS[0] + r * np.cos(t),
            0.5 * (LENGTHS[1] - width) + x[:, 1],
            height + r * np.sin(t),
        ]
    )


def bodies_of(scene: str, refinements: int, cell: str) -> tuple[Any, Any]:
    """Return the mesh of block and tool, and its facet tags."""
    s, top = 2**refinements, LENGTHS[2]
    block = Box((0, 0, 0), LENGTHS, (24 * s, 12 * s, 6 * s), name="block")
    if scene == "two-block":
        corner = np.array([(LENGTHS[1] - 1) / 3, (LENGTHS[1] - 1) / 2, top])
        tool = Box(corner, corner + 1.0, (5 * s, 5 * s, 5 * s), name="tool")
        touching, pressed = top, top + 1.0
    else:
        tool = Box((0, 0, 0), (4.0, 5.0, 0.5), (16 * s, 20 * s, 2 * s), name="tool")
        # the outer face of the shell is the block's, the inner one is moved
        touching, pressed = 0.5, 0.0
    bodies = boxes(comm, [block, tool], cell)
    of = bodies.names
    facet_tags = tag_facets(
        bodies.mesh,
        [
            (BOTTOM, lambda x: np.isclose(x[2], 0.0), of["block"]),
            (BLOCK, lambda x: np.isclose(x[2], top), of["block"]),
            (TOOL, lambda x: np.isclose(x[2], touching), of["tool"]),
            (PRESSED, lambda x: np.isclose(x[2], pressed), of["tool"]),
        ],
        bodies.cell_tags,
    )
    if scene == "ironing":
        points = bodies.mesh.geometry.x
        cells = _compat.geometry_cells(bodies.mesh)
        nodes = np.unique(cells[bodies.cell_tags.find(of["tool"])])
        points[nodes] = bent(points[nodes])
    return bodies, facet_tags


def problem_of(arguments: argparse.Namespace, refinements: int, nu_of_block: float) -> Any:
    """Return the problem of one row of the table."""
    bodies, facet_tags = bodies_of(arguments.scene, refinements, arguments.cell)
    mesh = bodies.mesh
    constant = _compat.lagrange_space(mesh, 0, discontinuous=True)
    young, nu = fem.Function(constant), fem.Function(constant)
    young.x.array[:], nu.x.array[:] = 1.0, nu_of_block
    of_tool = _compat.cell_dofs(constant).ravel()[bodies.cell_tags.find(bodies.names["tool"])]
    young.x.array[of_tool], nu.x.array[of_tool] = 1e3, 0.0
    V = displacement_space(mesh, degree=arguments.degree)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    mu, lmbda = 0.5 * young / (1 + nu), young * nu / ((1 + nu) * (1 - 2 * nu))
    one_point = {} if arguments.full else {"metadata": {"quadrature_degree": 0}}
    a = 2 * mu * ufl.inner(ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v))) * ufl.dx
    a += lmbda * ufl.div(u) * ufl.div(v) * ufl.dx(**one_point)
    L = ufl.inner(fem.Constant(mesh, np.zeros(3)), v) * ufl.dx
    bcs = [
        fem.dirichletbc(
            np.array([0.0, 0.0, height]),
            fem.locate_dofs_topological(V, 2, facet_tags.find(tag)),
            V,
        )
        for tag, height in ((BOTTOM, 0.0), (PRESSED, -DESCENT))
    ]
    slave, master = (TOOL, BLOCK) if arguments.slave == "tool" else (BLOCK, TOOL)
    options = dict(option.split("=") for option in arguments.option)
    contacts = [ContactPair(facet_tags, slave=slave, master=master)]
    return ContactProblem(a, L, bcs=bcs, contacts=contacts, options=options)


def measure(arguments: argparse.Namespace, refinements: int, nu: float) -> dict[str, Any]:
    """Solve the problem of one row."""
    problem = problem_of(arguments, refinements, nu)
    start = time.process_time()
    problem.solve()
    report = problem.report
    return {
        "r": refinements,
        "nu": nu,
        "unknowns": report.unknowns["primal"],
        "subdomains": report.subdomains,
        "products": report.products["total"],
        "preconditioned": report.products["preconditioner"],
        "vectors": report.deflation["vectors"],
        "seconds": time.process_time() - start,
        "solver": report.seconds["total"],
        "force": report.contacts[0].normal_force,
        "certificate": report.certificate.worst,
        "converged": report.converged,
    }


def main() -> None:
    arguments = parse_arguments()
    for message in (".*lock at a Poisson.s ratio", ".*grad u. is as large"):
        warnings.filterwarnings("ignore", message=message)
    columns = ("r", "nu", "unknowns", "subdomains", "products", "vectors", "seconds")
    if comm.rank == 0:
        print(*(f"{column:>10}" for column in (*columns, "force", "certificate")))
    runs = []
    for refinements in arguments.r:
        for nu in arguments.nu:
            run = measure(arguments, refinements, nu)
            runs.append(run)
            if comm.rank == 0:
                row = [f"{run[column]:>10.7g}" for column in columns[:-1]]
                row += [f"{run['seconds']:>10.2f}", f"{run['force']:>10.7f}"]
                print(*row, f"{run['certificate']:>10.1e}", flush=True)
    if arguments.json and comm.rank == 0:
        Path(arguments.json).write_text(json.dumps(runs, indent=2) + "\n")


if __name__ == "__main__":
    main()

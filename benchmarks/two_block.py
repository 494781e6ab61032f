"""Products with F for nearly incompressible materials: the blocks of MFEM's contact miniapp.

    python benchmarks/run.py two_block [--refinements 0 1 2] [--nu 0.3 0.499 0.49999]
    mpirun -n 2 python benchmarks/run.py two_block --refinements 1

A stiff unit cube (E = 1000, nu = 0) is pressed by 0.25 / 1.4 into a block of 9 x 4 x 2.5 (E = 1) of
24 x 12 x 6 hexahedra, refined r times; --scene ironing bends a stiff shell over the block instead.
The volumetric term is integrated by one point; --full integrates it fully, which locks; --degree 2
takes quadratic displacements. Seconds are processor time of set-up and solve on rank 0.
"""

from __future__ import annotations

import time
import warnings
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
CHOICES = {"scene": ["two-block", "ironing"], "slave": ["tool", "block"], "degree": [1, 2]}


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


def problem_of(
    refinements: int,
    nu_of_block: float,
    scene: str,
    slave: str,
    full: bool,
    degree: int,
    cell: str,
) -> Any:
    """Return the problem of one row of the table."""
    bodies, facet_tags = bodies_of(scene, refinements, cell)
    mesh = bodies.mesh
    constant = _compat.lagrange_space(mesh, 0, discontinuous=True)
    young, nu = fem.Function(constant), fem.Function(constant)
    young.x.array[:], nu.x.array[:] = 1.0, nu_of_block
    of_tool = _compat.cell_dofs(constant).ravel()[bodies.cell_tags.find(bodies.names["tool"])]
    young.x.array[of_tool], nu.x.array[of_tool] = 1e3, 0.0
    V = displacement_space(mesh, degree=degree)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    mu, lmbda = 0.5 * young / (1 + nu), young * nu / ((1 + nu) * (1 - 2 * nu))
    one_point = {} if full else {"metadata": {"quadrature_degree": 0}}
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
    surfaces = (TOOL, BLOCK) if slave == "tool" else (BLOCK, TOOL)
    return ContactProblem(a, L, bcs=bcs, contacts=[ContactPair(facet_tags, *surfaces)])


def run(
    refinements=(0, 1),
    nu=(0.3, 0.45, 0.49, 0.499, 0.49999),
    scene="two-block",
    slave="tool",
    full=False,
    degree=1,
    cell="hexahedron",
):
    """Solve for each refinement and each Poisson's ratio of the block."""
    for message in (".*lock at a Poisson.s ratio", ".*grad u. is as large"):
        warnings.filterwarnings("ignore", message=message)
    for r in refinements:
        for poisson in nu:
            problem = problem_of(r, poisson, scene, slave, full, degree, cell)
            start = time.process_time()
            problem.solve()
            report = problem.report
            yield {
                "r": r,
                "nu": poisson,
                "unknowns": report.unknowns["primal"],
                "subdomains": report.subdomains,
                "products": report.products["total"],
                "chosen": report.preconditioner_reason,
                "seconds": time.process_time() - start,
                "force": report.contacts[0].normal_force,
                "certificate": report.certificate.worst,
            }

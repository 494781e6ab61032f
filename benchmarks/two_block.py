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

from mpi4py import MPI

import numpy as np
from scenes import Scene, at, strain

import ufl

from fenics_tfeti import ContactProblem
from fenics_tfeti.io import Box, piecewise_constant

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


def bodies_of(scene: str, refinements: int, cell: str, degree: int) -> Scene:
    """Return block and tool without forms."""
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
    marks = [(BOTTOM, at(2, 0.0), 1), (BLOCK, at(2, top), 1)]
    marks += [(TOOL, at(2, touching), 2), (PRESSED, at(2, pressed), 2)]
    bodies = Scene.of_boxes(comm, cell, [block, tool], marks, degree=degree)
    if scene == "ironing":
        points, nodes = bodies.mesh.geometry.x, bodies.nodes(2)
        points[nodes] = bent(points[nodes])
    return bodies


def problem_of(
    refinements: int,
    nu_of_block: float,
    scene: str,
    slave: str,
    full: bool,
    degree: int,
    cell: str,
) -> ContactProblem:
    """Return the problem of one row of the table."""
    bodies = bodies_of(scene, refinements, cell, degree)
    young, nu = (
        piecewise_constant(bodies.mesh, bodies.cell_tags, {1: of_block, 2: of_tool})
        for of_block, of_tool in ((1.0, 1e3), (nu_of_block, 0.0))
    )
    u, v = bodies.u, bodies.v
    mu, lmbda = 0.5 * young / (1 + nu), young * nu / ((1 + nu) * (1 - 2 * nu))
    one_point = {} if full else {"metadata": {"quadrature_degree": 0}}
    bodies.a = 2 * mu * ufl.inner(strain(u), strain(v)) * ufl.dx
    bodies.a += lmbda * ufl.div(u) * ufl.div(v) * ufl.dx(**one_point)
    for tag, height in ((BOTTOM, 0.0), (PRESSED, -DESCENT)):
        bodies.fix(tag, None, np.array([0.0, 0.0, height]))
    bodies.add_pair(*((TOOL, BLOCK) if slave == "tool" else (BLOCK, TOOL)))
    return bodies.problem(cell_tags=None)


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

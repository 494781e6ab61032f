"""A block with Coulomb friction on rigid ground, by fenics_tfeti and by GetFEM's nodal brick.

    python benchmarks/run.py peers_friction --divisions 10 20

A plane block of 4 x 1 m is pressed on the ground and pulled at its right end; the left one is held
along x above the ground. Its lower nodes slip on the right and stick on the left. Needs GetFEM, see
`peers.py`.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray
from scenes import Scene, at, elasticity, plane

from fenics_tfeti import ContactProblem, Coulomb

LENGTH, LAMBDA, MU, PRESSURE, PULL, FRICTION = 4, 1.0, 1.0, 1e-2, 1e-2, 0.3
BOTTOM, TOP, RIGHT, LEFT = 1, 2, 3, 4
SIDES = [(BOTTOM, 1, 0.0), (TOP, 1, 1.0), (RIGHT, 0, LENGTH), (LEFT, 0, 0.0)]

Vector = NDArray[np.float64]


def run(divisions=(10,)):
    """Solve by both codes on each mesh."""
    for n in divisions:
        products, figures = compare(n)
        yield {"1/h": n, "products": products, **figures}


def compare(n: int) -> tuple[int, dict[str, Any]]:
    """Solve by both codes; return the products of fenics_tfeti, and the relative differences."""
    x, u, problem = solve_by_tfeti(n)
    y, v, normal, tangential, steps = solve_by_getfem(n)
    order, other = (np.lexsort(np.round(points, 9).T) for points in (x, y))
    if not np.allclose(x[order], y[other]):
        raise AssertionError("the codes did not solve on the same nodes")
    contact = problem.results[0]
    along_x = np.argsort(contact.coordinates[:, 0])
    friction = contact.friction.force[along_x, 0]
    return problem.report.products["total"], {
        "steps": steps,
        "nodes": len(along_x),
        "sticking": int(np.count_nonzero(contact.friction.sticking)),
        "displacement": float(np.abs(u[order] - v[other]).max() / np.abs(v).max()),
        "normal": float(np.abs(contact.nodal_normal_force[along_x] - normal).max() / normal.max()),
        "tangential": float(np.abs(friction - tangential).max() / np.abs(tangential).max()),
    }


def solve_by_tfeti(n: int, rtol: float = 1e-8) -> tuple[Vector, Vector, ContactProblem]:
    """Return nodes, displacements, and the solved problem."""
    parts = [((0.0, 0.0), (LENGTH, 1.0), (LENGTH * n, n))]
    marks = [(tag, at(k, value)) for tag, k, value in SIDES[:-1]]
    marks.append((LEFT, lambda x: np.isclose(x[0], 0.0) & (x[1] > 0.5 / n)))
    block = Scene.of_boxes(MPI.COMM_SELF, "quadrilateral", parts, marks)
    # lambda = mu
    block.a = elasticity(block.u, block.v, 2.5 * MU, poisson=0.25)
    pressure, pull = (block.constant(value) for value in (PRESSURE, PULL))
    block.L = pull * block.v[0] * block.ds(RIGHT) - pressure * block.v[1] * block.ds(TOP)
    block.fix(LEFT, 0)
    block.add_obstacle(BOTTOM, plane(1, 2), friction=Coulomb(FRICTION))
    problem = block.problem(options={"rtol": rtol})
    values = problem.solve().x.array.reshape(-1, 2)
    return block.V.tabulate_dof_coordinates()[:, :2], values, problem


def solve_by_getfem(n: int) -> tuple[Vector, Vector, Vector, Vector, int]:
    """Return nodes, displacements, normal and tangential forces along x, and Newton steps."""
    import getfem

    block = getfem.Mesh(
        "cartesian", np.linspace(0, LENGTH, LENGTH * n + 1), np.linspace(0, 1, n + 1)
    )
    space = getfem.MeshFem(block, 2)
    space.set_fem(getfem.Fem("FEM_QK(2,1)"))
    rule = getfem.MeshIm(block, getfem.Integ("IM_GAUSS_PARALLELEPIPED(2,3)"))
    for tag, k, value in SIDES:
        nodes = np.flatnonzero(np.isclose(block.pts()[k], value))
        block.set_region(tag, block.faces_from_pid(nodes))
    model = getfem.Model("real")
    model.add_fem_variable("u", space)
    constants = {"lambda": LAMBDA, "mu": MU, "r": 1.0, "friction": FRICTION}
    for name, value in constants.items():
        model.add_initialized_data(name, [value])
    model.add_isotropic_linearized_elasticity_brick(rule, "u", "lambda", "mu")
    for name, tag, load in (("press", TOP, [0.0, -PRESSURE]), ("pull", RIGHT, [PULL, 0.0])):
        model.add_initialized_data(name, load)
        model.add_source_term_brick(rule, "u", name, tag)
    place = space.basic_dof_nodes()

    def along_x(tag: int, above: float) -> NDArray[np.int64]:
        dofs = np.asarray(space.basic_dof_on_region(tag))
        dofs = dofs[(dofs % 2 == 0) & (place[1, dofs] > above)]
        return dofs[np.argsort(place[0, dofs])]

    def rows(dofs: NDArray[np.int64], factor: float) -> Any:
        matrix = getfem.Spmat("empty", len(dofs), space.nbdof())
        for row, dof in enumerate(dofs):
            matrix.add(row, int(dof), factor)
        return matrix

    held, bottom = along_x(LEFT, 0.5 / n), along_x(BOTTOM, -1.0)
    model.add_variable("held", len(held))
    model.add_constraint_with_multipliers("u", "held", rows(held, 1.0), np.zeros(len(held)))
    size = len(bottom)
    model.add_variable("normal", size)
    model.add_variable("tangential", size)
    # Newton's method needs a start that presses
    model.set_variable("normal", -np.full(size, PRESSURE * LENGTH / size))
    model.add_initialized_data("gap", np.zeros(size))
    model.add_initialized_data("alpha", np.ones(size))
    normal, tangential = rows(bottom + 1, -1.0), rows(bottom, 1.0)
    # version 1: unsymmetric, Alart and Curnier
    model.add_basic_contact_brick(
        "u", "normal", "tangential", "r", normal, tangential, "friction", "gap", "alpha", 1
    )
    steps, converged = model.solve(
        "max_res", 1e-12, "max_iter", 200, "lsearch", "default", "lsolver", "mumps"
    )
    if not converged:
        raise RuntimeError(f"GetFEM did not converge in {steps} steps")
    forces = -model.variable("normal"), model.variable("tangential")
    return place[:, ::2].T, model.variable("u").reshape(-1, 2), *forces, int(steps)

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

import ufl
from dolfinx import fem, mesh

from fenics_tfeti import ContactProblem, Coulomb, Plane, RigidObstacle
from fenics_tfeti.io import displacement_space, tag_facets

LENGTH, LAMBDA, MU, PRESSURE, PULL, FRICTION = 4, 1.0, 1.0, 1e-2, 1e-2, 0.3
BOTTOM, TOP, RIGHT, LEFT = 1, 2, 3, 4

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
        "normal": float(np.abs(contact.normal_force[along_x] - normal).max() / normal.max()),
        "tangential": float(np.abs(friction - tangential).max() / np.abs(tangential).max()),
    }


def solve_by_tfeti(n: int, rtol: float = 1e-8) -> tuple[Vector, Vector, ContactProblem]:
    """Return nodes, displacements, and the solved problem."""
    block = mesh.create_rectangle(
        MPI.COMM_SELF,
        [np.zeros(2), np.array([LENGTH, 1.0])],
        [LENGTH * n, n],
        mesh.CellType.quadrilateral,
    )
    V = displacement_space(block)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    marks = [(BOTTOM, 1, 0.0), (TOP, 1, 1.0), (RIGHT, 0, LENGTH)]
    tags = tag_facets(
        block, [(tag, lambda x, k=k, at=at: np.isclose(x[k], at)) for tag, k, at in marks]
    )
    ds = ufl.Measure("ds", domain=block, subdomain_data=tags)
    strain = ufl.sym(ufl.grad(u))
    stress = 2 * MU * strain + LAMBDA * ufl.tr(strain) * ufl.Identity(2)
    pressure, pull = (fem.Constant(block, value) for value in (PRESSURE, PULL))
    left = mesh.locate_entities_boundary(
        block, 1, lambda x: np.isclose(x[0], 0.0) & (x[1] > 0.5 / n)
    )
    held = fem.locate_dofs_topological(V.sub(0), 1, left)
    ground = Plane((0.0, 0.0), (0.0, 1.0))
    problem = ContactProblem(
        ufl.inner(stress, ufl.sym(ufl.grad(v))) * ufl.dx,
        pull * v[0] * ds(RIGHT) - pressure * v[1] * ds(TOP),
        bcs=[fem.dirichletbc(0.0, held, V.sub(0))],
        contacts=[RigidObstacle(tags, BOTTOM, ground, friction=Coulomb(FRICTION))],
        options={"rtol": rtol},
    )
    values = problem.solve().x.array.reshape(-1, 2)
    return V.tabulate_dof_coordinates()[:, :2], values, problem


def solve_by_getfem(n: int) -> tuple[Vector, Vector, Vector, Vector, int]:
    """Return nodes, displacements, normal and tangential forces along x, and Newton steps."""
    import getfem

    block = getfem.Mesh(
        "cartesian", np.linspace(0, LENGTH, LENGTH * n + 1), np.linspace(0, 1, n + 1)
    )
    space = getfem.MeshFem(block, 2)
    space.set_fem(getfem.Fem("FEM_QK(2,1)"))
    rule = getfem.MeshIm(block, getfem.Integ("IM_GAUSS_PARALLELEPIPED(2,3)"))
    for tag, k, at in ((BOTTOM, 1, 0.0), (TOP, 1, 1.0), (RIGHT, 0, LENGTH), (LEFT, 0, 0.0)):
        nodes = np.flatnonzero(np.isclose(block.pts()[k], at))
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

"""The two beams of `peers.py` in GetFEM: nodal contact by the augmented Lagrangian and Newton."""

from __future__ import annotations

from typing import Any

import getfem
import numpy as np
from numpy.typing import NDArray
from peers_scene import LAMBDA, MU, TRACTION, YOUNG, Answer, Scene

CLAMPED, GUIDED, SLAVE, MASTER, TOP, END = 3, 4, 5, 6, 7, 8


def solve_by_getfem(scene: Scene, rtol: float) -> Answer:
    """Solve the two beams; forces are scaled by 1 / E, so the augmentation parameter is 1."""
    meshes = [_mesh(scene, body) for body in (2, 1)]
    upper, lower = meshes
    _region(upper, GUIDED, lambda x: np.isclose(x[0], 3))
    _region(upper, SLAVE, lambda x: np.isclose(x[2], 1) & (x[0] < 2 + 1e-9))
    _region(upper, TOP, lambda x: np.isclose(x[2], 2))
    _region(upper, END, lambda x: np.isclose(x[0], 1))
    _region(lower, CLAMPED, lambda x: np.isclose(x[0], 0))
    _region(lower, MASTER, lambda x: np.isclose(x[2], 1) & (x[0] > 1 - 1e-9))

    model = getfem.Model("real")
    model.add_initialized_data("lambda", [LAMBDA / YOUNG])
    model.add_initialized_data("mu", [MU / YOUNG])
    model.add_initialized_data("traction", [0.0, 0.0, -TRACTION / YOUNG])
    model.add_initialized_data("r", [1.0])
    spaces, rules = [], []
    for mesh, name in zip(meshes, ("upper", "lower"), strict=True):
        space = getfem.MeshFem(mesh, 3)
        space.set_fem(getfem.Fem("FEM_QK(3,1)"))
        # two points along each axis: exact on boxes
        rules.append(getfem.MeshIm(mesh, getfem.Integ("IM_GAUSS_PARALLELEPIPED(3,3)")))
        spaces.append(space)
        model.add_fem_variable(name, space)
        model.add_isotropic_linearized_elasticity_brick(rules[-1], name, "lambda", "mu")
    for region in (TOP, END):
        model.add_source_term_brick(rules[0], "upper", "traction", region)
    model.add_Dirichlet_condition_with_simplification("lower", CLAMPED)
    _guide(model, spaces[0])
    version = 1  # unsymmetric, Alart and Curnier; the symmetric version does not converge
    model.add_nodal_contact_between_nonmatching_meshes_brick(
        rules[0], rules[1], "upper", "lower", "force", "r", SLAVE, MASTER, 1, 0, version
    )
    steps, converged = model.solve(
        "max_iter", 50, "max_res", rtol, "lsolver", "mumps", "lsearch", "default"
    )
    if not converged:
        raise RuntimeError(f"GetFEM did not converge in {steps} steps")
    values = [model.variable(name).reshape(-1, 3) for name in ("upper", "lower")]
    return Answer(
        np.concatenate([space.basic_dof_nodes()[:, ::3].T for space in spaces]),
        np.concatenate(values),
        np.repeat(np.array([2, 1], dtype=np.int32), [len(v) for v in values]),
        float(-model.variable("force").sum() * YOUNG),
        {"iterations": int(steps), "iterations_of": "Newton steps"},
    )


def _mesh(scene: Scene, body: int) -> Any:
    """Return one beam as a mesh of its own, since GetFEM merges nodes at the same place."""
    mesh = getfem.Mesh("empty", 3)
    corners: NDArray[np.float64] = scene.points[scene.cells[scene.body == body]]
    mesh.add_convex(getfem.GeoTrans("GT_QK(3,1)"), corners.transpose(2, 1, 0))
    return mesh


def _region(mesh: Any, number: int, marker: Any) -> None:
    mesh.set_region(number, mesh.faces_from_pid(np.flatnonzero(marker(mesh.pts()))))


def _guide(model: Any, space: Any) -> None:
    """Hold the x and y components at x = 3, by nodal multipliers."""
    dofs = np.asarray(space.basic_dof_on_region(GUIDED))
    dofs = dofs[dofs % 3 != 2]
    rows = getfem.Spmat("empty", len(dofs), space.nbdof())
    for row, dof in enumerate(dofs):
        rows.add(row, int(dof), 1.0)
    model.add_variable("guide", len(dofs))
    model.add_constraint_with_multipliers("upper", "guide", rows, np.zeros(len(dofs)))

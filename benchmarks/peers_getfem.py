"""The two beams of `peers.py` in GetFEM: contact by the augmented Lagrangian and Newton."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import getfem
import numpy as np
from numpy.typing import NDArray
from peers_scene import LAMBDA, MU, TRACTION, YOUNG, Answer, Scene

CLAMPED, GUIDED, SLAVE, MASTER, TOP, END = 3, 4, 5, 6, 7, 8


# augmentation parameter of both bricks; forces are scaled by 1 / E
AUGMENTATION = 1.0


@dataclass(frozen=True)
class Beams:
    """The two beams without contact: GetFEM's model; meshes, spaces and quadratures of both."""

    model: Any
    meshes: list[Any]
    spaces: list[Any]
    rules: list[Any]


def solve_by_getfem(scene: Scene, rtol: float) -> Answer:
    """Solve the two beams with conditions between pairs of nodes."""
    beams = _beams(scene)
    version = 1  # unsymmetric, Alart and Curnier; the symmetric version does not converge
    beams.model.add_nodal_contact_between_nonmatching_meshes_brick(
        *beams.rules, "upper", "lower", "force", "r", SLAVE, MASTER, 1, 0, version
    )
    steps = _solve(beams, rtol)
    return _answer(beams, -beams.model.variable("force").sum() * YOUNG, steps)


def solve_by_getfem_mortar(scene: Scene, rtol: float, points: int) -> Answer:
    """Solve with GetFEM's integral condition; multipliers are the slave's shape functions.

    The integrals over a slave facet are by `points` points of Gauss along each edge: GetFEM does
    not cut the facets where the shape functions of the master have kinks.
    """
    beams = _beams(scene)
    upper = beams.meshes[0]
    scalar = getfem.MeshFem(upper, 1)
    scalar.set_fem(getfem.Fem("FEM_QK(3,1)"))
    beams.model.add_filtered_fem_variable("pressure", scalar, SLAVE)
    rule = getfem.Integ(f"IM_GAUSS_PARALLELEPIPED(3,{2 * points - 1})")
    rule = getfem.MeshIm(upper, rule)
    version = 1  # unsymmetric, Alart and Curnier
    beams.model.add_integral_contact_between_nonmatching_meshes_brick(
        rule, "upper", "lower", "pressure", "r", SLAVE, MASTER, version
    )
    steps = _solve(beams, rtol)
    force, area = (
        getfem.asm_generic(rule, 1, f"{factor}*Test_pressure", SLAVE, beams.model)
        for factor in ("pressure", "1")
    )
    own = area != 0.0
    # pressures of GetFEM are negative
    force = -force[own] * YOUNG
    answer = _answer(beams, force.sum(), steps)
    answer.pressure = np.full(len(answer.coordinates), np.nan)
    answer.pressure[np.asarray(scalar.basic_dof_on_region(SLAVE))] = force / area[own]
    return answer


def _beams(scene: Scene) -> Beams:
    """Return the elastic beams with loads and supports."""
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
    model.add_initialized_data("r", [AUGMENTATION])
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
    return Beams(model, meshes, spaces, rules)


def _solve(beams: Beams, rtol: float) -> int:
    """Iterate, and return the number of Newton steps."""
    steps, converged = beams.model.solve(
        "max_iter", 50, "max_res", rtol, "lsolver", "mumps", "lsearch", "default"
    )
    if not converged:
        raise RuntimeError(f"GetFEM did not converge in {steps} steps")
    return int(steps)


def _answer(beams: Beams, force: float, steps: int) -> Answer:
    values = [beams.model.variable(name).reshape(-1, 3) for name in ("upper", "lower")]
    return Answer(
        np.concatenate([space.basic_dof_nodes()[:, ::3].T for space in beams.spaces]),
        np.concatenate(values),
        np.repeat(np.array([2, 1], dtype=np.int32), [len(v) for v in values]),
        float(force),
        {"iterations": steps, "iterations_of": "Newton steps"},
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

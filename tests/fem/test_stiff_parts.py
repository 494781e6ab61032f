"""Stiff parts inside one body, cut or not by its subdomains, against a direct solution."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from scenes import GROUND, LOADED, SIDE_X, Scene, at, elasticity, scalar_space

from dolfinx import fem

from fenics_tfeti import Plane

pytestmark = pytest.mark.once

CELLS = 8  # along each axis
PARTS = {
    # ends at the contact, embedded in soft material
    "fibres": lambda x: (np.floor(8 * x[:2]) % 4 == 1).all(axis=0),
    "columns": lambda x: (np.floor(4 * x[:2]) % 2 == 0).all(axis=0),
    "inclusion": lambda x: (np.abs(x - 0.5) < 0.2).all(axis=0),
    "half": lambda x: x[0] > 0.5,
}


def block(parts: str, jump: float) -> Scene:
    """Return a block on a rigid plane, held at a side; some parts are `jump` times stiffer."""
    box = ([0.0] * 3, [1.0] * 3, [CELLS] * 3)
    marks = [(GROUND, at(2, 0.0)), (LOADED, at(2, 1.0)), (SIDE_X, at(0, 0.0))]
    scene = Scene.of_boxes(MPI.COMM_SELF, "hexahedron", [box], marks)
    space = scalar_space(scene.mesh, "DG", 0)
    young = fem.Function(space)
    stiff = PARTS[parts](space.tabulate_dof_coordinates().T)
    young.x.array[:] = np.where(stiff, jump, 1.0)
    scene.a = elasticity(scene.u, scene.v, young)
    scene.add_load(LOADED, (0.002, 0.0, -0.01))
    scene.fix(SIDE_X)
    scene.add_obstacle(GROUND, Plane((0.0, 0.0, -0.0001), (0.0, 0.0, 1.0)))
    return scene


@pytest.mark.parametrize(
    ("parts", "jump", "options", "products"),
    [
        # rounding counts: with OpenBLAS' kernels of eight processors 244 to 295 and 269 to 336
        ("fibres", 1e8, {"subdomain_size": 2000}, 310),
        ("fibres", 1e10, {"subdomain_size": 2000}, 350),
        ("fibres", 1e10, {"subdomain_size": 2000, "preconditioner": "dirichlet"}, 90),
        ("fibres", 1e10, {"subdomain_size": 200}, 50),
        ("columns", 1e10, {"subdomain_size": 200, "rtol": 1e-5}, 60),
        ("inclusion", 1e10, {"subdomain_size": 200, "rtol": 1e-5}, 50),
        ("half", 1e10, {"subdomain_size": 200}, 30),
    ],
)
def test_against_direct_solution(parts, jump, options, products):
    scene = block(parts, jump)
    problem = scene.problem(cell_tags=None, options=options)
    found, expected = problem.solve().x.array, scene.reference()
    # rounding of the stiffest entries makes errors of jump times eps in the direct one, too
    size = np.abs(expected.displacement).max()
    assert np.abs(found - expected.displacement).max() <= 3e-5 * size
    force = expected.contacts[0].forces.sum()
    assert force > 0.005
    assert problem.report.contacts[0].normal_force == pytest.approx(force, rel=1e-5)
    assert problem.report.products["total"] <= products


def test_message_where_the_stiffness_is_rounding():
    options: dict[str, Any] = {"subdomain_size": 200, "rtol": 1e-9, "error_if_not_converged": False}
    problem = block("inclusion", 1e10).problem(cell_tags=None, options=options)
    problem.solve()
    reason = problem.report.reason
    assert "(equilibrium, largest in body 0" in reason
    assert "stiffness matrices, whose diagonals jump by up to 8e+10, are accurate to" in reason

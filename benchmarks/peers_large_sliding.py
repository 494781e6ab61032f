"""The die of `peers_nonlinear.py` in GetFEM: its large sliding brick, an augmented Lagrangian.

    python benchmarks/run.py peers_large_sliding --divisions 4 --steps 2

gives the force on the die, the Newton steps and the processor seconds.
"""

from __future__ import annotations

import resource
import time
from typing import Any

import getfem
import numpy as np
from peers_nonlinear import (
    BASE,
    BLOCK,
    DIE,
    DRAG,
    GRIP,
    LONGEST,
    MASTER,
    MODULI,
    PRESS,
    SLAVE,
    Bodies,
    foot,
    lame,
)

# augmentation parameter, and distance up to which surfaces may meet
AUGMENTATION, RELEASE = 10.0, 0.8
# of its line searches the one that converges in the longest steps
LINE_SEARCH = "simplest"
MOST_ITERATIONS = 60
SURFACES = {
    BLOCK: {BASE: lambda x: np.isclose(x[2], 0), MASTER: lambda x: np.isclose(x[2], 1)},
    DIE: {GRIP: lambda x: np.isclose(x[2], 1.8), SLAVE: lambda x: np.isclose(x[2], foot(x[0]))},
}


class Model:
    """GetFEM's model of both bodies, each with a mesh of its own."""

    def __init__(self, bodies: Bodies) -> None:
        self.model = getfem.Model("real")
        self.rules: dict[int, Any] = {}
        meshes = {body: self._add(body, bodies) for body in (BLOCK, DIE)}
        self.model.add_Dirichlet_condition_with_simplification("u1", BASE)
        self.model.add_initialized_data("motion", [0.0, 0.0, 0.0])
        self.model.add_Dirichlet_condition_with_simplification("u2", GRIP, "motion")
        self.model.add_filtered_fem_variable("pressure", _space(meshes[DIE]), SLAVE)
        self.model.add_initialized_data("r", [AUGMENTATION])
        brick = self.model.add_integral_large_sliding_contact_brick_raytracing("r", RELEASE)
        self.model.add_slave_contact_boundary_to_large_sliding_contact_brick(
            brick, self.rules[DIE], SLAVE, "u2", "pressure"
        )
        self.model.add_master_contact_boundary_to_large_sliding_contact_brick(
            brick, self.rules[BLOCK], MASTER, "u1"
        )

    def _add(self, body: int, bodies: Bodies) -> Any:
        """Add a body with its strain energy; return its mesh."""
        mesh, x = getfem.Mesh("empty", 3), bodies.mesh.geometry.x
        corners = x[bodies.cells[bodies.cell_tags.values == body]]
        mesh.add_convex(getfem.GeoTrans("GT_QK(3,1)"), corners.transpose(2, 1, 0))
        for tag, is_on in SURFACES[body].items():
            mesh.set_region(tag, mesh.faces_from_pid(np.flatnonzero(is_on(mesh.pts()))))
        rule = getfem.MeshIm(mesh, getfem.Integ("IM_GAUSS_PARALLELEPIPED(3,3)"))
        self.rules[body] = rule
        self.model.add_fem_variable(f"u{body}", _space(mesh))
        (mu, kappa), F = lame(MODULI[body]), f"(Id(3)+Grad_u{body})"
        shear = f"{mu / 2}*(pow(Det{F},-2/3)*Norm_sqr{F}-3)"
        self.model.add_nonlinear_term(rule, f"{shear}+{kappa / 2}*sqr(Det{F}-1)")
        return mesh

    def solve(self, load: float) -> int:
        """Press up to a load of 1, then drag; return the Newton steps."""
        self.model.set_variable(
            "motion", [DRAG * max(load - 1.0, 0.0), 0.0, -PRESS * min(load, 1.0)]
        )
        newton, converged = self.model.solve(
            *("max_iter", MOST_ITERATIONS, "max_res", 1e-7),
            *("lsolver", "mumps", "lsearch", LINE_SEARCH),
        )
        if not converged:
            raise SystemExit(f"no convergence in {newton} Newton steps")
        return int(newton)

    def force(self) -> list[float]:
        """Return the contact force on the die."""
        force = getfem.asm_generic(self.rules[DIE], 0, "pressure", SLAVE, self.model)
        return [float(value) for value in force]


def _space(mesh: Any) -> Any:
    """Return the trilinear vector fields on a mesh."""
    space = getfem.MeshFem(mesh, 3)
    space.set_fem(getfem.Fem("FEM_QK(3,1)"))
    return space


def run(divisions=4, steps=1):
    """Press and drag in equal steps, within a time: where cells invert, a step may not end."""
    resource.setrlimit(resource.RLIMIT_CPU, (LONGEST, LONGEST))
    model, start = Model(Bodies(divisions)), time.process_time()
    newton = sum(model.solve(load) for load in np.arange(1, 2 * steps + 1) / steps)
    yield {"force": model.force(), "newton": newton, "cpu": time.process_time() - start}

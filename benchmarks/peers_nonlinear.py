"""Finite strains on one mesh: load steps of fenics_tfeti, CalculiX and GetFEM.

    python benchmarks/run.py peers_nonlinear --divisions 6

A die with a round foot, three times as stiff, is pressed into a block by 0.3 of its height and
dragged along it by its height, without friction. Both loads are divided into 1, 2, 4, ... equal
steps, until a code converges in all of them to a drag of less than a tenth of the pressing force:
without friction it is nearly zero, but long steps of CalculiX converge to other states. CalculiX
has contact by a penalty of 100 E per metre, facet to facet, and finite strains (NLGEOM); its
material, neo-Hookean with the volumetric energy k (J - 1)^2 / 2, is that of all. GetFEM has its
large sliding brick, an augmented Lagrangian with the complete tangent. One thread each; seconds are
processor seconds, without the compilation of forms. Needs the Debian packages calculix-ccx and
python3-getfem.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
from typing import Any

from mpi4py import MPI

import numpy as np
from peers_calculix import iterations, run_ccx, total_of, write_mesh
from peers_scene import processor_seconds
from runner import separately
from scenes import at

import ufl
from dolfinx import fem

from fenics_tfeti import ContactError, ContactPair, NonlinearContactProblem
from fenics_tfeti.io import Box, boxes, displacement_space, piecewise_constant, tag_facets

BLOCK, DIE = 1, 2
BASE, MASTER, SLAVE, GRIP = 1, 2, 3, 4
MODULI = {BLOCK: 1.0, DIE: 3.0}
NU, PRESS, DRAG, PENALTY = 0.3, 0.3, 1.0, 100.0
DRAGGED = 0.1  # largest drag, relative to the pressing force
MOST = 64  # steps of each load
LONGEST = 120  # processor seconds after which a run of GetFEM is ended


class Bodies:
    """The mesh of both bodies, with tags of facets."""

    def __init__(self, n: int) -> None:
        parts = [
            Box((0, 0, 0), (3, 1, 1), (3 * n, n, n), "block"),
            Box((0.4, 0, 1), (1.6, 1, 1.8), (round(1.4 * n), n, n), "die"),
        ]
        tagged = boxes(MPI.COMM_SELF, parts)
        self.mesh, self.cell_tags = tagged.mesh, tagged.cell_tags
        markers = [
            (BASE, at(2, 0), BLOCK),
            (MASTER, at(2, 1), BLOCK),
            (SLAVE, at(2, 1), DIE),
            (GRIP, at(2, 1.8), DIE),
        ]
        self.facet_tags = tag_facets(self.mesh, markers, self.cell_tags)
        self.space = displacement_space(self.mesh)
        x, cells = self.mesh.geometry.x, self.mesh.geometry.dofmap
        self.cells = np.asarray(getattr(cells, "array", cells)).reshape(-1, 8)
        of_die = np.unique(self.cells[self.cell_tags.values == DIE])
        share = (1.8 - x[of_die, 2]) / 0.8
        x[of_die, 2] += share * (foot(x[of_die, 0]) - 1.0)

    def dofs(self, tag: int) -> Any:
        """Return the degrees of freedom of a tagged surface."""
        return fem.locate_dofs_topological(self.space, 2, self.facet_tags.find(tag))


def foot(x: Any) -> Any:
    """Return the height of the die's foot."""
    return 1.0 + 1.2 * (x - 1.0) ** 2


def lame(E: Any) -> tuple[Any, Any]:
    """Return shear and bulk modulus."""
    return E / (2 * (1 + NU)), E / (3 * (1 - 2 * NU))


def by_tfeti(n: int, steps: int) -> dict[str, Any]:
    """Press and drag in equal steps; raise ContactError if one does not converge."""
    bodies = Bodies(n)
    u, motion = fem.Function(bodies.space), fem.Function(bodies.space)
    mu, kappa = lame(piecewise_constant(bodies.mesh, bodies.cell_tags, MODULI))
    F = ufl.Identity(3) + ufl.grad(u)
    J = ufl.det(F)
    energy = mu / 2 * (J ** (-2 / 3) * ufl.inner(F, F) - 3) + kappa / 2 * (J - 1) ** 2
    problem = NonlinearContactProblem(
        ufl.derivative(
            energy * ufl.dx(metadata={"quadrature_degree": 3}), u, ufl.TestFunction(bodies.space)
        ),
        u,
        bcs=[
            fem.dirichletbc(np.zeros(3), bodies.dofs(BASE), bodies.space),
            fem.dirichletbc(motion, bodies.dofs(GRIP)),
        ],
        contacts=[ContactPair(bodies.facet_tags, slave=SLAVE, master=MASTER)],
    )
    start, newton = processor_seconds(), 0
    for load in np.arange(1, 2 * steps + 1) / steps:
        values = motion.x.array.reshape(-1, 3)
        values[:, 0], values[:, 2] = DRAG * max(load - 1.0, 0.0), -PRESS * min(load, 1.0)
        problem.solve()
        problem.advance()
        newton += len(problem.report.newton)
    force = problem.report.reactions[1].force
    return _row(force, newton, processor_seconds() - start)


def by_calculix(n: int, steps: int) -> dict[str, Any]:
    """Press and drag in equal increments; raise ContactError if one does not converge."""
    bodies, start = Bodies(n), processor_seconds()
    try:
        output, lines = run_ccx(lambda file: _write(file, bodies, steps))
    except RuntimeError as error:
        raise ContactError("CalculiX did not converge") from error
    return _row(total_of(lines, "GRIP"), iterations(output), processor_seconds() - start)


def by_getfem(n: int, steps: int) -> dict[str, Any]:
    """Press and drag in equal steps; raise ContactError if one does not converge."""
    try:
        (found,) = separately("peers_large_sliding", divisions=n, steps=steps)
    except RuntimeError as error:
        reason = str(error).splitlines()[-1]
        if reason == f"exit code {-signal.SIGXCPU}":
            reason = f"had not ended after {LONGEST} processor seconds"
        raise ContactError(f"GetFEM: {reason}") from error
    # on the die in place of the force of its grip
    return _row(-np.array(found["force"]), found["newton"], found["cpu"])


def _write(file: Any, bodies: Bodies, steps: int) -> None:
    """Write the input of CalculiX."""
    x, names = bodies.mesh.geometry.x, {BLOCK: "BLOCK", DIE: "DIE"}
    cells = {name: np.flatnonzero(bodies.cell_tags.values == b) for b, name in names.items()}
    of_die = np.unique(bodies.cells[cells["DIE"]])
    sets = {
        "BASE": np.flatnonzero(np.isclose(x[:, 2], 0)),
        "GRIP": of_die[np.isclose(x[of_die, 2], 1.8)],
    }
    write_mesh(file, x, bodies.cells, cells, sets)
    for body, name in names.items():
        mu, kappa = lame(MODULI[body])
        file.write(
            f"*MATERIAL,NAME=OF_{name}\n*HYPERELASTIC,NEO HOOKE\n{mu / 2:.12g},{2 / kappa:.12g}\n"
        )
        file.write(f"*SOLID SECTION,ELSET={name},MATERIAL=OF_{name}\n")
    faces = {"SLAVE": (DIE, "S1"), "MASTER": (BLOCK, "S2")}
    connectivity = bodies.mesh.topology.connectivity(2, 3)
    for name, (body, face) in faces.items():
        file.write(f"*SURFACE,NAME={name}\n")
        for facet in bodies.facet_tags.find(SLAVE if body == DIE else MASTER):
            file.write(f"{connectivity.links(facet)[0] + 1},{face}\n")
    file.write("*SURFACE INTERACTION,NAME=CONTACT\n")
    file.write(f"*SURFACE BEHAVIOR,PRESSURE-OVERCLOSURE=LINEAR\n{PENALTY:g}\n")
    file.write("*CONTACT PAIR,INTERACTION=CONTACT,TYPE=SURFACE TO SURFACE\nSLAVE,MASTER\n")
    for drag in (0.0, DRAG):
        file.write(f"*STEP,NLGEOM,INC=1000\n*STATIC,SOLVER=SPOOLES,DIRECT\n{1 / steps:.12g},1.\n")
        file.write("*BOUNDARY\nBASE,1,3\n")
        file.write(f"GRIP,1,1,{drag:g}\nGRIP,2,2,0.\nGRIP,3,3,{-PRESS:g}\n")
        file.write("*NODE PRINT,NSET=GRIP,TOTALS=ONLY\nRF\n*END STEP\n")


def _row(force: Any, newton: int, seconds: float) -> dict[str, Any]:
    return {
        "pressing": -float(force[2]),
        "dragging": float(force[0]),
        "newton": newton,
        "cpu": seconds,
    }


def run(divisions=(4,)):
    """Solve in 1, 2, 4, ... equal steps of each load, until the drag is what it has to be."""
    os.environ["OMP_NUM_THREADS"] = "1"
    codes = {"tfeti": by_tfeti}
    if shutil.which("ccx"):
        codes["calculix-penalty"] = by_calculix
    if importlib.util.find_spec("getfem"):
        codes["getfem-large-sliding"] = by_getfem
    for n in divisions:
        reference = None
        for name, solve in codes.items():
            steps, drag = 1, np.inf
            while drag > DRAGGED and steps <= MOST:
                row = {"code": name, "1/h": n, "steps": 2 * steps}
                try:
                    row |= solve(n, steps)
                except ContactError as error:
                    yield {**row, "failed": str(error)}
                else:
                    reference = reference or row["cpu"]
                    drag = abs(row["dragging"]) / row["pressing"]
                    yield {**row, "ratio": row["cpu"] / reference}
                steps *= 2

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
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

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
# vertices of dolfinx in the order of C3D8
_ORDER = [0, 1, 3, 2, 4, 5, 7, 6]


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
            (BASE, lambda x: np.isclose(x[2], 0), BLOCK),
            (MASTER, lambda x: np.isclose(x[2], 1), BLOCK),
            (SLAVE, lambda x: np.isclose(x[2], 1), DIE),
            (GRIP, lambda x: np.isclose(x[2], 1.8), DIE),
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
    start, newton = _processor_seconds(), 0
    for load in np.arange(1, 2 * steps + 1) / steps:
        values = motion.x.array.reshape(-1, 3)
        values[:, 0], values[:, 2] = DRAG * max(load - 1.0, 0.0), -PRESS * min(load, 1.0)
        problem.solve()
        problem.advance()
        newton += len(problem.report.newton)
    force = problem.report.reactions[1].force
    return _row(force, newton, _processor_seconds() - start)


def by_calculix(n: int, steps: int) -> dict[str, Any]:
    """Press and drag in equal increments; raise ContactError if one does not converge."""
    with tempfile.TemporaryDirectory() as folder:
        with open(Path(folder) / "die.inp", "w") as file:
            _write(file, Bodies(n), steps)
        start = _processor_seconds()
        done = subprocess.run(["ccx", "die"], cwd=folder, capture_output=True, text=True)
        seconds = _processor_seconds() - start
        if done.returncode or "Job finished" not in done.stdout:
            raise ContactError("CalculiX did not converge")
        lines = (Path(folder) / "die.dat").read_text().split("\n")
    total = max(i for i, line in enumerate(lines) if "set GRIP" in line)
    force = [float(value) for value in lines[total + 2].split()]
    newton = sum(line.startswith(" iteration ") for line in done.stdout.splitlines())
    return _row(force, newton, seconds)


def by_getfem(n: int, steps: int) -> dict[str, Any]:
    """Press and drag in equal steps; raise ContactError if one does not converge."""
    script = Path(__file__).with_name("peers_large_sliding.py")
    command = [sys.executable, str(script), str(n), str(steps)]
    done = subprocess.run(command, capture_output=True, text=True, preexec_fn=_limit)
    if done.returncode < 0:
        raise ContactError(f"GetFEM had not ended after {LONGEST} processor seconds")
    if done.returncode:
        raise ContactError(f"GetFEM: {(done.stderr or done.stdout).splitlines()[-1]}")
    found = json.loads(done.stdout.splitlines()[-1])
    # on the die in place of the force of its grip
    return _row(-np.array(found["force"]), found["newton"], found["cpu"])


def _limit() -> None:
    """End this process after a time: where cells invert, a step of GetFEM may not end."""
    resource.setrlimit(resource.RLIMIT_CPU, (LONGEST, LONGEST))


def _write(file: Any, bodies: Bodies, steps: int) -> None:
    """Write the input of CalculiX."""
    x, cells = bodies.mesh.geometry.x, 1 + bodies.cells[:, _ORDER]
    file.write("*NODE,NSET=ALL\n")
    np.savetxt(file, np.column_stack([np.arange(1, len(x) + 1), x]), fmt="%d,%.12g,%.12g,%.12g")
    names = {BLOCK: "BLOCK", DIE: "DIE"}
    for body, name in names.items():
        numbers = np.flatnonzero(bodies.cell_tags.values == body)
        file.write(f"*ELEMENT,TYPE=C3D8,ELSET={name}\n")
        np.savetxt(file, np.column_stack([numbers + 1, cells[numbers]]), fmt="%d", delimiter=",")
        mu, kappa = lame(MODULI[body])
        file.write(
            f"*MATERIAL,NAME=OF_{name}\n*HYPERELASTIC,NEO HOOKE\n{mu / 2:.12g},{2 / kappa:.12g}\n"
        )
        file.write(f"*SOLID SECTION,ELSET={name},MATERIAL=OF_{name}\n")
    of_die = np.unique(bodies.cells[bodies.cell_tags.values == DIE])
    for name, nodes in {
        "BASE": np.flatnonzero(np.isclose(x[:, 2], 0)),
        "GRIP": of_die[np.isclose(x[of_die, 2], 1.8)],
    }.items():
        file.write(f"*NSET,NSET={name}\n")
        np.savetxt(file, 1 + nodes, fmt="%d")
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


def _processor_seconds() -> float:
    """Return processor seconds of this process and of its finished children."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


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

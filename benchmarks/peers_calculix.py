"""The two beams of `peers.py` in CalculiX, through its input and output files."""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray
from peers_scene import POISSON, TRACTION, YOUNG, Answer, Scene

# vertices x + 2 y + 4 z in the order of C3D8
_ORDER = [0, 1, 3, 2, 4, 5, 7, 6]
# Contact, surface behaviour, equation solver. The penalty of 100 E per metre needs the fewest steps
# (10 at h = 1/8; 1e3 E: 12, 1e4 E: 17), and ITERATIVE CHOLESKY the least time of the solvers in
# Debian's package. With mortars the iterative solvers do not finish within a minute at h = 1/8.
WAYS = {
    "penalty": (
        "SURFACE TO SURFACE",
        f"*SURFACE BEHAVIOR,PRESSURE-OVERCLOSURE=LINEAR\n{100 * YOUNG:g}\n",
        "ITERATIVE CHOLESKY",
    ),
    # without surface behaviour: dual multipliers, hard contact
    "mortar": ("MORTAR", "", "SPOOLES"),
}


def solve_by_calculix(scene: Scene, way: str) -> Answer:
    """Write the input, run ccx, read the displacement and the reaction of the clamp.

    The contact transmits the whole load of the upper beam to the clamp, so the contact force is the
    reaction of the clamp.
    """
    with tempfile.TemporaryDirectory() as folder:
        with open(Path(folder) / "beams.inp", "w") as file:
            _write(file, scene, *WAYS[way])
        done = subprocess.run(
            ["ccx", "beams"], cwd=folder, env={**os.environ}, capture_output=True, text=True
        )
        if "Job finished" not in done.stdout:
            raise RuntimeError("ccx stopped:\n" + "\n".join(done.stdout.splitlines()[-10:]))
        lines = (Path(folder) / "beams.dat").read_text().splitlines()
    displacement, force = _read(lines, len(scene.points))
    body = np.zeros(len(scene.points), dtype=np.int32)
    body[scene.cells] = scene.body[:, np.newaxis]
    steps = sum(line.startswith(" iteration ") for line in done.stdout.splitlines())
    facts = {"iterations": steps, "iterations_of": "Newton steps", "solver": WAYS[way][2]}
    return Answer(scene.points, displacement, body, force, facts)


def _write(file: TextIO, scene: Scene, contact: str, behaviour: str, solver: str) -> None:
    x, h = scene.points, 1.0 / scene.divisions
    numbers = np.arange(1, len(x) + 1)
    cells = 1 + scene.cells[:, _ORDER]
    file.write("*NODE,NSET=ALL\n")
    np.savetxt(file, np.column_stack([numbers, x]), fmt="%d,%.12g,%.12g,%.12g")
    file.write("*ELEMENT,TYPE=C3D8,ELSET=BEAMS\n")
    np.savetxt(
        file, np.column_stack([np.arange(1, len(cells) + 1), cells]), fmt="%d", delimiter=","
    )
    for name, place in (("CLAMPED", 0.0), ("GUIDED", 3.0)):
        file.write(f"*NSET,NSET={name}\n")
        np.savetxt(file, 1 + np.flatnonzero(np.isclose(x[:, 0], place)), fmt="%d")
    centre = x[scene.cells].mean(axis=1)
    at_contact = np.isclose(np.abs(centre[:, 2] - 1.0), 0.5 * h)
    at_contact &= (centre[:, 0] > 1.0) & (centre[:, 0] < 2.0)
    for name, body, face in (("SLAVE", 2, "S1"), ("MASTER", 1, "S2")):
        file.write(f"*SURFACE,NAME={name}\n")
        chosen = 1 + np.flatnonzero(at_contact & (scene.body == body))
        file.writelines(f"{number},{face}\n" for number in chosen)
    file.write(f"*MATERIAL,NAME=STEEL\n*ELASTIC\n{YOUNG:g},{POISSON:g}\n")
    file.write("*SOLID SECTION,ELSET=BEAMS,MATERIAL=STEEL\n")
    file.write(f"*SURFACE INTERACTION,NAME=CONTACT\n{behaviour}")
    file.write(f"*CONTACT PAIR,INTERACTION=CONTACT,TYPE={contact}\nSLAVE,MASTER\n")
    file.write("*BOUNDARY\nCLAMPED,1,3\nGUIDED,1,2\n")
    # the whole load in one increment, as the other codes do
    file.write(f"*STEP\n*STATIC,SOLVER={solver},DIRECT\n1.,1.\n*CLOAD\n")
    force = _nodal_load(scene)
    loaded = np.flatnonzero(force)
    columns = np.column_stack([loaded + 1, np.full(len(loaded), 3), force[loaded]])
    np.savetxt(file, columns, fmt="%d,%d,%.12g")
    file.write("*NODE PRINT,NSET=ALL\nU\n*NODE PRINT,NSET=CLAMPED,TOTALS=ONLY\nRF\n*END STEP\n")


def _nodal_load(scene: Scene) -> NDArray[np.float64]:
    """Return the nodal forces in z of the traction on the top and the end of the upper beam."""
    force = np.zeros(len(scene.points))
    vertices = scene.points[scene.cells]
    for axis, place in ((2, 2.0), (0, 1.0)):
        on_face = np.isclose(vertices[..., axis], place)
        faces = (on_face.sum(axis=1) == 4) & (scene.body == 2)
        nodes = scene.cells[faces][on_face[faces]]
        np.add.at(force, nodes, -TRACTION / (4.0 * scene.divisions**2))
    return force


def _read(lines: list[str], nodes: int) -> tuple[NDArray[np.float64], float]:
    """Return the displacement (nodes, 3) and the total reaction of the last increment."""
    last = max(i for i, line in enumerate(lines) if line.strip().startswith("displacements"))
    rows = np.array([line.split() for line in lines[last + 2 : last + 2 + nodes]], dtype=float)
    total = max(i for i, line in enumerate(lines) if "set CLAMPED" in line)
    displacement = np.zeros((nodes, 3))
    displacement[rows[:, 0].astype(np.int64) - 1] = rows[:, 1:]
    return displacement, float(lines[total + 2].split()[2])

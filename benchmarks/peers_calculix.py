"""The two beams of `peers.py` in CalculiX, through its input and output files."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray
from peers_scene import POISSON, YOUNG, Answer, Scene, nodal_load, slave_areas, slave_nodes

# vertices x + 2 y + 4 z in the order of C3D8
_ORDER = [0, 1, 3, 2, 4, 5, 7, 6]
# sides x = const of the supports
_HELD = {"CLAMPED": 0.0, "GUIDED": 3.0}
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
    output, lines = run_ccx(lambda file: _write(file, scene, *WAYS[way]))
    displacement = _read(lines, "displacements", scene)
    force = float(total_of(lines, "CLAMPED")[2])
    pressure = np.full(len(scene.points), np.nan)
    if way == "mortar":
        # the forces of the elements at the nodes, without what is applied there
        slave, nodal = slave_nodes(scene), _read(lines, "forces", scene)[:, 2] - nodal_load(scene)
        pressure[slave] = nodal[slave] / slave_areas(scene)
    steps, solver = iterations(output), WAYS[way][2]
    facts = {"iterations": steps, "iterations_of": "Newton steps", "solver": solver}
    return Answer(scene.points, displacement, scene.node_body(), force, facts, pressure)


def run_ccx(write: Callable[[TextIO], None]) -> tuple[str, list[str]]:
    """Write the input and run ccx; return what it prints, and the lines of its tables."""
    with tempfile.TemporaryDirectory() as folder:
        with open(Path(folder) / "peer.inp", "w") as file:
            write(file)
        done = subprocess.run(["ccx", "peer"], cwd=folder, capture_output=True, text=True)
        if done.returncode or "Job finished" not in done.stdout:
            raise RuntimeError("ccx stopped:\n" + "\n".join(done.stdout.splitlines()[-10:]))
        return done.stdout, (Path(folder) / "peer.dat").read_text().splitlines()


def total_of(lines: list[str], name: str) -> list[float]:
    """Return the last sum of the forces on a set of nodes."""
    total = max(i for i, line in enumerate(lines) if f"set {name}" in line)
    return [float(value) for value in lines[total + 2].split()]


def iterations(output: str) -> int:
    """Return the number of Newton steps."""
    return sum(line.startswith(" iteration ") for line in output.splitlines())


def write_mesh(
    file: TextIO,
    x: NDArray[np.float64],
    cells: NDArray[np.int64],
    bodies: dict[str, NDArray[np.int64]],
    sets: dict[str, NDArray[np.int64]],
) -> None:
    """Write nodes, cells by bodies, and sets of nodes."""
    file.write("*NODE,NSET=ALL\n")
    np.savetxt(file, np.column_stack([np.arange(1, len(x) + 1), x]), fmt="%d,%.12g,%.12g,%.12g")
    for name, numbers in bodies.items():
        file.write(f"*ELEMENT,TYPE=C3D8,ELSET={name}\n")
        rows = np.column_stack([numbers, cells[numbers][:, _ORDER]])
        np.savetxt(file, 1 + rows, fmt="%d", delimiter=",")
    for name, nodes in sets.items():
        file.write(f"*NSET,NSET={name}\n")
        np.savetxt(file, 1 + nodes, fmt="%d")


def _write(file: TextIO, scene: Scene, contact: str, behaviour: str, solver: str) -> None:
    x = scene.points
    sets = {name: np.flatnonzero(np.isclose(x[:, 0], at)) for name, at in _HELD.items()}
    sets["TOUCHING"] = slave_nodes(scene)
    write_mesh(file, x, scene.cells, {"BEAMS": np.arange(len(scene.cells))}, sets)
    centre = x[scene.cells].mean(axis=1)
    h = 1.0 / np.where(scene.body == 1, scene.lower_divisions, scene.divisions)
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
    force = nodal_load(scene)
    loaded = np.flatnonzero(force)
    columns = np.column_stack([loaded + 1, np.full(len(loaded), 3), force[loaded]])
    np.savetxt(file, columns, fmt="%d,%d,%.12g")
    file.write("*NODE PRINT,NSET=ALL\nU\n*NODE PRINT,NSET=TOUCHING\nRF\n")
    file.write("*NODE PRINT,NSET=CLAMPED,TOTALS=ONLY\nRF\n*END STEP\n")


def _read(lines: list[str], what: str, scene: Scene) -> NDArray[np.float64]:
    """Return a table (nodes, 3) of the last increment; zero for nodes that are not in it."""
    first = 2 + max(i for i, line in enumerate(lines) if line.strip().startswith(what))
    last = next((i for i in range(first, len(lines)) if not lines[i].strip()), len(lines))
    rows = np.array([line.split() for line in lines[first:last]], dtype=float)
    values = np.zeros((len(scene.points), 3))
    values[rows[:, 0].astype(np.int64) - 1] = rows[:, 1:]
    return values

"""Comparison of fenics_tfeti with other codes on the same mesh.

    python benchmarks/peers.py --divisions 8 16 --json out.json
    python benchmarks/peers.py --divisions 8 --codes getfem snesvi-icc
    python benchmarks/peers.py --divisions 10 --scenes "two beams, meshes 1:1.4"

Each code runs in its own process, on one thread. Seconds are from the arrays of the mesh to the
displacement at the nodes, without imports and just-in-time compilation. On a shared machine,
compare processor seconds and not wall time.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from peers_scene import SCENES, Answer, Scene, nodal_load, sort_key

TWO, *_APART, RIGID = SCENES
APART = tuple(_APART)
RTOL = 1e-6


@dataclass(frozen=True)
class Code:
    """A code for some scenes: a function of `module`, and the Debian package that it needs."""

    scenes: tuple[str, ...]
    module: str
    function: str
    arguments: tuple[Any, ...]
    package: str = ""
    find: Callable[[], object] = lambda: True


def _getfem() -> object:
    return importlib.util.find_spec("getfem")


def _ccx() -> object:
    return shutil.which("ccx")


# points of Gauss along the edges of a facet of the slave, for GetFEM's integrals
POINTS = 3
CODES = {
    "tfeti": Code((TWO,), "peers_fenics", "solve_by_tfeti", (RTOL,)),
    "tfeti-scotch": Code((TWO,), "peers_fenics", "solve_by_tfeti", (RTOL, "scotch")),
    "getfem": Code((TWO,), "peers_getfem", "solve_by_getfem", (RTOL,), "python3-getfem", _getfem),
    "calculix-penalty": Code(
        (TWO,), "peers_calculix", "solve_by_calculix", ("penalty",), "calculix-ccx", _ccx
    ),
    "calculix-mortar": Code(
        (TWO,), "peers_calculix", "solve_by_calculix", ("mortar",), "calculix-ccx", _ccx
    ),
    "tfeti-apart": Code(APART, "peers_fenics", "solve_by_tfeti", (RTOL,)),
    "tfeti-apart-scotch": Code(APART, "peers_fenics", "solve_by_tfeti", (RTOL, "scotch")),
    "getfem-mortar": Code(
        APART, "peers_getfem", "solve_by_getfem_mortar", (RTOL, POINTS), "python3-getfem", _getfem
    ),
    "calculix-mortar-apart": Code(
        APART, "peers_calculix", "solve_by_calculix", ("mortar",), "calculix-ccx", _ccx
    ),
    "tfeti-rigid": Code((RIGID,), "peers_fenics", "solve_by_tfeti", (RTOL,)),
    "tfeti-rigid-scotch": Code((RIGID,), "peers_fenics", "solve_by_tfeti", (RTOL, "scotch")),
    "snesvi-icc": Code((RIGID,), "peers_fenics", "solve_by_snesvi", (RTOL, "icc")),
    "snesvi-gamg": Code((RIGID,), "peers_fenics", "solve_by_snesvi", (RTOL, "gamg")),
    "snesvi-mumps": Code((RIGID,), "peers_fenics", "solve_by_snesvi", (RTOL, "mumps")),
}
REFERENCE = {TWO: "tfeti", **dict.fromkeys(APART, "tfeti-apart"), RIGID: "tfeti-rigid"}
COLUMNS = (
    ("code", "{:<21}"),
    ("seconds", "{:>8.2f}"),
    ("processor_seconds", "{:>8.2f}"),
    ("ratio", "{:>6.1f}"),
    ("peak_memory_mb", "{:>6.0f}"),
    ("iterations", "{:>6d}"),
    ("difference", "{:>8.1e}"),
    ("work_difference", "{:>8.1e}"),
    ("force_difference", "{:>8.1e}"),
    ("pressure_difference", "{:>8.1e}"),
)
HEADER = """\
                         clock process.  ratio         iter-        u     work    force pressure
code                         s        s            MB ations   differ   differ   differ   differ"""


def main() -> None:
    arguments = parse_arguments()
    if arguments.child:
        run_child(*arguments.child)
        return
    chosen = list(CODES) if "all" in arguments.codes else arguments.codes
    # the reference runs in any case
    wanted = {REFERENCE[s] for name in chosen for s in CODES[name].scenes}.union(chosen)
    rows: list[dict[str, Any]] = []
    scenes = arguments.scenes or SCENES
    for scene in (s for s in SCENES if s in scenes and REFERENCE[s] in wanted):
        names = [n for n in CODES if n in wanted and scene in CODES[n].scenes]
        for divisions in arguments.divisions:
            rows += compare(scene, names, divisions)
    if arguments.json:
        Path(arguments.json).write_text(json.dumps({"rtol": RTOL, "rows": rows}, indent=1))


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--divisions", type=int, nargs="+", default=[8], metavar="1/h", help="elements per metre"
    )
    parser.add_argument("--codes", nargs="+", default=["all"], choices=["all", *CODES])
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES), help="by default all")
    parser.add_argument("--json", metavar="FILE", help="write the table")
    parser.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    return parser.parse_args()


def compare(scene: str, names: list[str], divisions: int) -> list[dict[str, Any]]:
    """Run the codes on one mesh, print the table, and return its rows."""
    mesh = SCENES[scene](divisions)
    unknowns = 3 * len(mesh.points)
    print(f"{scene}, h = 1/{divisions}, {unknowns} unknowns")
    print(HEADER)
    rows: list[dict[str, Any]] = []
    reference: tuple[dict[str, Any], Answer] | None = None
    for name in names:
        row: dict[str, Any] = {"scene": scene, "divisions": divisions, "unknowns": unknowns}
        row["code"] = name
        rows.append(row)
        if not CODES[name].find():
            row["skipped"] = f"{name} needs the Debian package {CODES[name].package}"
            print(f"{name:<21} skipped: {sys.executable} does not find {CODES[name].package}")
            continue
        try:
            figures, answer = run(name, scene, divisions)
        except RuntimeError as error:
            if reference is None:
                raise
            row["failed"] = str(error)
            print(f"{name:<21} failed: {error}")
            continue
        row.update(figures)
        reference = reference or (row, answer)
        row.update(differences(mesh, row, answer, *reference))
        print(*(form.format(row[key]) for key, form in COLUMNS), flush=True)
    print()
    return rows


def differences(
    scene: Scene,
    row: dict[str, Any],
    answer: Answer,
    reference_row: dict[str, Any],
    reference: Answer,
) -> dict[str, float]:
    """Compare with the answer of fenics_tfeti, at nodes of the same coordinates and body.

    The work of the load is twice the energy where gaps are zero; pressures are compared where both
    codes have some, NaN if one has none.
    """
    order, reference_order = (sort_key(a.coordinates, a.body) for a in (answer, reference))
    same = np.allclose(answer.coordinates[order], reference.coordinates[reference_order], atol=1e-6)
    if not (same and np.array_equal(answer.body[order], reference.body[reference_order])):
        raise AssertionError("the codes did not solve on the same nodes")
    u, v = answer.displacement[order], reference.displacement[reference_order]
    load = nodal_load(scene)[sort_key(scene.points, scene.node_body())]
    p, q = answer.pressure[order], reference.pressure[reference_order]
    slave = np.isfinite(p) & np.isfinite(q)
    pressure = np.linalg.norm((p - q)[slave]) / np.linalg.norm(q[slave]) if slave.any() else np.nan
    return {
        "difference": float(np.linalg.norm(u - v) / np.linalg.norm(v)),
        "work_difference": float(abs(load @ (u - v)[:, 2]) / abs(load @ v[:, 2])),
        "pressure_difference": float(pressure),
        "force_difference": abs(answer.force - reference.force) / abs(reference.force),
        "ratio": row["processor_seconds"] / reference_row["processor_seconds"],
    }


def run(name: str, scene: str, divisions: int) -> tuple[dict[str, Any], Answer]:
    """Run a code in its own process; raise RuntimeError with its last output if it fails."""
    one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "answer.npz"
        child = ["--child", name, scene, str(divisions), str(output)]
        command = [sys.executable, __file__, *child]
        done = subprocess.run(
            command, env={**os.environ, **one_thread}, capture_output=True, text=True
        )
        if done.returncode:
            words = (done.stderr or done.stdout).strip().splitlines()
            raise RuntimeError("\n".join(words[-5:]) or f"exit code {done.returncode}")
        with np.load(output) as arrays:
            figures = json.loads(str(arrays["figures"]))
            answer = Answer(
                arrays["coordinates"],
                arrays["displacement"],
                arrays["body"],
                figures["force"],
                pressure=arrays["pressure"],
            )
    return figures, answer


def run_child(name: str, scene_name: str, divisions: str, output: str) -> None:
    """Solve, and write the answer with the figures of this process and its children."""
    code = CODES[name]
    solve = getattr(importlib.import_module(code.module), code.function)
    if code.module == "peers_fenics":
        solve(SCENES[scene_name](2), *code.arguments)  # compiles the forms
    scene = SCENES[scene_name](int(divisions))
    clock, processor = time.perf_counter(), _processor_seconds()
    answer: Answer = solve(scene, *code.arguments)
    figures = {
        "seconds": time.perf_counter() - clock,
        "processor_seconds": _processor_seconds() - processor,
        "peak_memory_mb": _peak_memory() / 1e6,
        "force": answer.force,
        **answer.facts,
    }
    np.savez(
        output,
        coordinates=answer.coordinates,
        displacement=answer.displacement,
        body=answer.body,
        pressure=answer.pressure,
        figures=json.dumps(figures),
    )


def _processor_seconds() -> float:
    """Return processor seconds of this process and of its finished children."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def _peak_memory() -> int:
    """Return the largest resident set [B] of this process or a child of it."""
    who = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return 1024 * max(resource.getrusage(w).ru_maxrss for w in who)


if __name__ == "__main__":
    main()

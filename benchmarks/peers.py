"""Comparison of fenics_tfeti with other codes on the same mesh.

    python benchmarks/run.py peers --divisions 8 16
    python benchmarks/run.py peers --divisions 8 --codes getfem snesvi-icc
    python benchmarks/run.py peers --divisions 10 --scenes "two beams, meshes 1:1.4"

Each code runs in its own process, on one thread. Seconds are from the arrays of the mesh to the
displacement at the nodes, without imports and just-in-time compilation. On a shared machine,
compare processor seconds and not wall time.
"""

from __future__ import annotations

import importlib
import importlib.util
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from peers_scene import SCENES, Answer, Scene, nodal_load, processor_seconds, sort_key
from runner import separately

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
CHOICES = {"codes": ["all", *CODES], "scenes": list(SCENES)}


def run(divisions=(8,), codes=("all",), scenes=tuple(SCENES), answer=""):
    """Solve the scenes by the codes and by the reference; `answer` is where one child writes."""
    if answer:
        yield solve_alone(codes[0], scenes[0], divisions[0], answer)
        return
    chosen = list(CODES) if "all" in codes else codes
    # the reference runs in any case
    wanted = {REFERENCE[s] for name in chosen for s in CODES[name].scenes}.union(chosen)
    solved = [scene for scene in SCENES if scene in scenes and REFERENCE[scene] in wanted]
    if not solved:
        raise SystemExit(f"{', '.join(codes)} solve none of these scenes: {', '.join(scenes)}")
    for scene in solved:
        names = [n for n in CODES if n in wanted and scene in CODES[n].scenes]
        for n in divisions:
            yield from compare(scene, names, n)


def compare(scene: str, names: list[str], divisions: int) -> Iterator[dict[str, Any]]:
    """Run the codes on one mesh, and compare them with the first one."""
    mesh = SCENES[scene](divisions)
    reference: tuple[dict[str, Any], Answer] | None = None
    for name in names:
        row: dict[str, Any] = {"scene": scene, "1/h": divisions, "unknowns": 3 * len(mesh.points)}
        row["code"] = name
        if not CODES[name].find():
            package = CODES[name].package
            yield {**row, "skipped": f"{sys.executable} does not find the Debian package {package}"}
            continue
        try:
            figures, answer = in_its_process(name, scene, divisions)
        except RuntimeError as error:
            if reference is None:
                raise
            yield {**row, "failed": str(error)}
            continue
        row.update(figures)
        reference = reference or (row, answer)
        yield {**row, **differences(mesh, row, answer, *reference)}


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


def in_its_process(name: str, scene: str, divisions: int) -> tuple[dict[str, Any], Answer]:
    """Run a code in its own process; raise RuntimeError with its last output if it fails."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "answer.npz"
        (figures,) = separately(
            "peers", codes=name, scenes=scene, divisions=divisions, answer=output
        )
        with np.load(output) as arrays:
            return figures, Answer(force=figures["force"], **arrays)


def solve_alone(name: str, scene_name: str, divisions: int, output: str) -> dict[str, Any]:
    """Solve, write the answer, and return the figures of this process and its children."""
    code = CODES[name]
    solve = getattr(importlib.import_module(code.module), code.function)
    if code.module == "peers_fenics":
        solve(SCENES[scene_name](2), *code.arguments)  # compiles the forms
    scene = SCENES[scene_name](divisions)
    clock, processor = time.perf_counter(), processor_seconds()
    answer: Answer = solve(scene, *code.arguments)
    figures = {
        "seconds": time.perf_counter() - clock,
        "processor_seconds": processor_seconds() - processor,
        "peak_memory_mb": _peak_memory() / 1e6,
        "force": answer.force,
        **answer.facts,
    }
    names = ("coordinates", "displacement", "body", "pressure")
    np.savez(output, **{name: getattr(answer, name) for name in names})
    return figures


def _peak_memory() -> int:
    """Return the largest resident set [B] of this process or a child of it."""
    who = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return 1024 * max(resource.getrusage(w).ru_maxrss for w in who)

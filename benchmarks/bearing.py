"""Roller bearings of up to 73 bodies: products with F, time and memory by phase.

    python benchmarks/run.py bearing --sizes 8 [20 35 73 full] --verbose

One process for each size, or on several ranks. The sizes are two rows of 8 rollers, of 20 rollers
in a cage, of 35 rollers without cage (each of coarse elements), 73 bodies of elements half as large
as in the full size, and this.
"""

from __future__ import annotations

import itertools
import time

from mpi4py import MPI

import numpy as np
from mesh_arrays import of_function
from roller_bearing import Bearing, roller_bearing, subdomain_labels
from scenes import Scene

from dolfinx import fem
from dolfinx.mesh import compute_midpoints

from fenics_tfeti import Deformed

COARSE = {"elements": 2, "growth": 1.2, "coarsest": 0.03, "layers": 4}
FINER = {"elements": 2, "growth": 1.0, "coarsest": 0.025, "layers": 6}
SIZES = {
    "8": (Bearing(rollers=8, cage=False, **FINER), 2),
    "20": (Bearing(rollers=20, spacing=0.03, **COARSE), 1),
    "35": (Bearing(cage=False, **COARSE), 1),
    "73": (Bearing(**FINER), 2),
    "full": (Bearing(), 4),
}
LOAD = np.array([0.0, -0.8e6, -0.16e6])  # N
comm = MPI.COMM_WORLD


def problem_of(bearing, slices, tolerance, load=LOAD):
    """Return the problem of a bearing, cut equally in all sectors."""
    bodies = of_function(roller_bearing, 3, bearing, comm=comm)
    names, scene = bodies.names, Scene.of(bodies)
    mesh, bore = scene.mesh, scene.ds(names["bore"])
    area = comm.allreduce(fem.assemble_scalar(fem.form(scene.constant(1.0) * bore)))
    scene.add_load(names["bore"], load / area)
    scene.fix(names["outside"])
    rows = range(1, bearing.rows + 1)
    for row, side in itertools.product(rows, ("outer", "inner")):
        slave, master = names[f"rollers {row} {side}"], names[f"{side} raceway {row}"]
        scene.add_pair(slave, master, normal=bearing.away_from_axis(row))
    for row in rows if bearing.cage else ():
        scene.add_pair(names[f"pockets {row}"], names[f"rollers {row} side"])
    owned = mesh.topology.index_map(3).size_local
    middles = compute_midpoints(mesh, 3, np.arange(owned, dtype=np.int32))
    cells = {body: bodies.cell_tags.find(names[body]) for body in bearing.names}
    return scene.problem(
        subdomains=subdomain_labels(bearing, cells, middles, slices),
        gaps=Deformed(tolerance),
        options={"rtol": 1e-4, "preconditioner": "dirichlet", "deflation": "on"},
    )


CHOICES = {"sizes": list(SIZES)}


def run(sizes=("8",), tolerance=3e-2, changed=-1):
    """Solve each size; `changed` is the seed of a load that differs by a thousandth."""
    load = LOAD
    if changed >= 0:
        load = LOAD * (1 + 1e-3 * np.random.default_rng(changed).standard_normal(3))
    for size in sizes:
        bearing, slices = SIZES[size]
        start = time.perf_counter()
        problem = problem_of(bearing, slices, tolerance, load)
        problem.solve()
        report, unknowns = problem.report, problem.report.unknowns
        yield {
            "size": size,
            "bodies": bearing.bodies,
            "unknowns": unknowns["primal"],
            "dual": unknowns["dual"],
            "contact rows": unknowns["inequalities"],
            "subdomains": report.subdomains,
            "shapes": report.classes,
            "products": " ".join(str(one.products) for one in report.passes),
            "seconds with mesh": time.perf_counter() - start,
            "peak [MB]": report.peak_memory_bytes // 10**6,
            "seconds": report.seconds,
            "certificate": report.certificate.numbers(),
        }

"""Roller bearings of up to 73 bodies: products with F, time and memory by phase.

    python benchmarks/run.py bearing --sizes 8 [20 35 73 full] --verbose

One process for each size, or on several ranks. The sizes are two rows of 8 rollers, of 20 rollers
in a cage, of 35 rollers without cage (each of coarse elements), 73 bodies of elements half as large
as in the full size, and this.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem
from dolfinx.mesh import compute_midpoints

from fenics_tfeti import ContactPair, ContactProblem, Exact
from fenics_tfeti.io import displacement_space, read_msh

sys.path.insert(0, str(Path(__file__).parents[1] / "meshes"))
from roller_bearing import Bearing, roller_bearing, subdomain_labels

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
    path = Path(comm.bcast(tempfile.mkdtemp() if comm.rank == 0 else None)) / "bearing.msh"
    if comm.rank == 0:
        roller_bearing(path, bearing)
    comm.barrier()
    bodies = read_msh(path, comm, gdim=3)
    comm.barrier()
    if comm.rank == 0:
        path.unlink()
        path.parent.rmdir()
    mesh, tags, names = bodies.mesh, bodies.facet_tags, bodies.names
    V = displacement_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    mu, lmbda = 2.1e11 / 2.6, 2.1e11 * 0.3 / (1.3 * 0.4)
    strain = ufl.sym(ufl.grad(u))
    a = (2 * mu * ufl.inner(strain, ufl.grad(v)) + lmbda * ufl.div(u) * ufl.div(v)) * ufl.dx
    bore = ufl.Measure("ds", domain=mesh, subdomain_data=tags)(names["bore"])
    area = comm.allreduce(fem.assemble_scalar(fem.form(fem.Constant(mesh, 1.0) * bore)))
    outside = fem.locate_dofs_topological(V, 2, tags.find(names["outside"]))
    rows = range(1, bearing.rows + 1)
    contacts = [
        ContactPair(
            tags,
            slave=names[f"rollers {row} {side}"],
            master=names[f"{side} raceway {row}"],
            normal=bearing.away_from_axis(row),
        )
        for row in rows
        for side in ("outer", "inner")
    ]
    if bearing.cage:
        contacts += [
            ContactPair(tags, slave=names[f"pockets {r}"], master=names[f"rollers {r} side"])
            for r in rows
        ]
    owned = mesh.topology.index_map(3).size_local
    middles = compute_midpoints(mesh, 3, np.arange(owned, dtype=np.int32))
    cells = {body: bodies.cell_tags.find(names[body]) for body in bearing.names}
    labels = subdomain_labels(bearing, cells, middles, slices)
    options = {
        "rtol": 1e-4,
        "preconditioner": "dirichlet",
        "deflation": "on",
    }
    return ContactProblem(
        a,
        ufl.inner(fem.Constant(mesh, load / area), v) * bore,
        bcs=[fem.dirichletbc(np.zeros(3), outside, V)],
        contacts=contacts,
        cell_tags=bodies.cell_tags,
        subdomains=labels,
        geometry=Exact(tolerance),
        options=options,
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

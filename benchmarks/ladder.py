"""The benchmark of sec. 11.11.1 up to its largest problem: two beams of congruent cubes.

    python benchmarks/run.py ladder [--subdomains-per-metre 3 5 7 9] [--elements-per-subdomain 10]

There is no mesh of the beams. dolfinx assembles one cube, with the loads of a cube at the top and
at the left face; the other cubes differ by their position in the lattice. The solver detects from
matrices and coordinates that they are congruent; `--softer` gives one of them half the stiffness.
Each size runs in a separate process, so that its peak of memory is measured, by phase too.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import replace

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray
from peaks import peaks_by_phase
from runner import separately

import ufl
from dolfinx import fem

from fenics_tfeti.fem.decomposition.assembly import prepare_forms
from fenics_tfeti.fem.decomposition.parts import number_parts
from fenics_tfeti.feti import ContactRows, Options, Prescribed, Subdomain, TornSolver, TornSystem
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
from fenics_tfeti.models import isotropic, small_strain

YOUNG, POISSON = 2.1e11, 0.3
TRACTION = -20e6  # [Pa] in z
LOWER, UPPER = 0, 1
FIRST = {LOWER: (0, 0), UPPER: (1, 1)}  # smallest x and z of the beams [m]


def cubes(m: int, n: int) -> dict[str, Subdomain]:
    """Assemble a cube of n^3 elements of width 1/m, without load and with a load on a face."""
    mesh = boxes(MPI.COMM_SELF, [Box((0, 0, 0), (1 / m, 1 / m, 1 / m), (n, n, n))]).mesh
    tags = tag_facets(
        mesh, {1: lambda x: np.isclose(x[2], 1 / m), 2: lambda x: np.isclose(x[0], 0.0)}
    )
    V = displacement_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(isotropic(YOUNG, POISSON)(u), small_strain(v)) * ufl.dx
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    traction = fem.Constant(mesh, TRACTION)
    cube = number_parts(V, [np.arange(n**3, dtype=np.int32)], [0])
    (top,), (left,) = (
        prepare_forms(V, a, traction * v[2] * ds(tag)).subdomains(cube) for tag in (1, 2)
    )
    return {
        "": replace(top, load=np.zeros(top.size)),
        "top": top,
        "left": replace(top, load=left.load),
        "top left": replace(top, load=top.load + left.load),
    }


def lattice_numbers(points: NDArray[np.int64], body: int, per_metre: int) -> NDArray[np.int64]:
    """Number the nodes of a beam by their position in its lattice, those of the upper beam last."""
    edge = per_metre + 1
    number = (points[:, 0] * edge + points[:, 1]) * edge + points[:, 2]
    return number + body * (2 * per_metre + 1) * edge**2


def two_beams(m: int, n: int, softer: bool) -> TornSystem:
    """Return the torn system of m subdomains per metre with n^3 elements each."""
    per_metre = m * n
    template = cubes(m, n)
    local = np.rint(template[""].coordinates * per_metre).astype(np.int64)
    subdomains = []
    places = itertools.product((LOWER, UPPER), range(2 * m), range(m), range(m))
    for body, *place in places:
        loaded = [
            name
            for name, there in (("top", place[2] == m - 1), ("left", place[0] == 0))
            if there and body == UPPER
        ]
        part = template[" ".join(loaded)]
        begin = np.array(place) / m + np.array([FIRST[body][0], 0, FIRST[body][1]])
        nodes = lattice_numbers(local + n * np.array(place), body, per_metre)
        subdomains.append(
            replace(part, coordinates=part.coordinates + begin, nodes=nodes, body=body)
        )
    if softer:
        middle = len(subdomains) // 4
        soft = subdomains[middle]
        subdomains[middle] = replace(soft, stiffness=soft.stiffness * 0.5)
    return TornSystem(
        subdomains,
        supports(per_metre),
        contact(per_metre),
        3,
        ["lower beam", "upper beam"],
        ["contact"],
    )


def face(x: range, y: range, z: range, body: int, per_metre: int) -> NDArray[np.int64]:
    """Return the nodes of a part of a beam's lattice."""
    points = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    return lattice_numbers(points, body, per_metre)


def supports(per_metre: int) -> Prescribed:
    """Clamp the lower beam at x = 0, fix x and y of the upper one at x = 3."""
    edge, end = range(per_metre + 1), 2 * per_metre
    clamped = face(range(1), edge, edge, LOWER, per_metre)
    guided = face(range(end, end + 1), edge, edge, UPPER, per_metre)
    nodes = np.concatenate([np.repeat(clamped, 3), np.repeat(guided, 2)])
    components = np.concatenate([np.tile([0, 1, 2], clamped.size), np.tile([0, 1], guided.size)])
    return Prescribed(nodes, components, np.zeros(nodes.size))


def contact(per_metre: int) -> ContactRows:
    """Pair the bottom of the upper beam with the top of the lower one, 1 <= x <= 2."""
    edge = range(per_metre + 1)
    slave = face(edge, edge, range(1), UPPER, per_metre)
    shifted = range(per_metre, 2 * per_metre + 1)
    master = face(shifted, edge, range(per_metre, per_metre + 1), LOWER, per_metre)
    down = np.tile([0.0, 0.0, -1.0], (slave.size, 1))
    return ContactRows.node_to_node(slave, master, down, np.zeros(slave.size), np.zeros_like(slave))


def solve(m: int, n: int, options: Options, softer: bool) -> dict[str, object]:
    """Build and solve one size; return a row of the table."""
    begin = time.perf_counter()
    with peaks_by_phase() as peaks:
        system = two_beams(m, n, softer)
        built = time.perf_counter() - begin
        report = TornSolver(system, options).solve().report
    most = max(peaks.values())
    wall = time.perf_counter() - begin
    torn = report.unknowns["torn"]
    return {
        "m": m,
        "n": n,
        "subdomains": report.subdomains,
        "classes": report.classes,
        "torn": torn,
        "dual": report.unknowns["dual"],
        "F": report.products["total"],
        "preconditioner": report.products["preconditioner"],
        "norm": report.products["norm"],
        "faces": len(report.faces),
        "outer": report.outer_iterations,
        "seconds": wall,
        "bytes": most,
        "microseconds an unknown": 1e6 * wall / torn,
        "bytes an unknown": most / torn,
        "force": report.contacts[0].normal_force,
        "certificate": report.certificate.worst,
        "phases": {"building": built, **report.seconds},
        "peaks, bytes an unknown": {name: peak / torn for name, peak in peaks.items()},
    }


def run(subdomains_per_metre=(3, 5, 7, 9), elements_per_subdomain=10, rtol=1e-4, softer=False):
    """Solve each size; with `softer` one subdomain has half the stiffness."""
    if len(subdomains_per_metre) == 1:
        (m,) = subdomains_per_metre
        yield solve(m, elements_per_subdomain, Options(rtol=rtol), softer)
        return
    more = {"elements_per_subdomain": elements_per_subdomain, "rtol": rtol, "softer": softer}
    for m in subdomains_per_metre:
        yield from separately("ladder", subdomains_per_metre=m, **more)

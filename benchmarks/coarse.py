"""Coarse matrices of the beams of ladder.py: entries of the factor, time and messages of a solve.

    mpirun -n 4 python benchmarks/coarse.py [--subdomains-per-metre 3 5 7] [--json out.json]

Every second contact row is on the face. Redundant on every rank with CHOLMOD; distributed over some
of the ranks with MUMPS; iterative with GAMG. Processor time and time of the clock. The calls of
MUMPS are counted if `count_calls.so` (see `count_calls.c`) is preloaded: mpirun -x LD_PRELOAD=...
"""

from __future__ import annotations

import argparse
import ctypes
import itertools
import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from mpi4py import MPI

import ladder
import numpy as np
from communication import dealt

from fenics_tfeti.feti.coarse.factor import choose_coarse_solver
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.constraints.interface import Interface
from fenics_tfeti.feti.constraints.rows import build_constraints
from fenics_tfeti.feti.local.congruence import find_congruence_classes
from fenics_tfeti.feti.local.rigid_body_modes import kernel

comm = MPI.COMM_WORLD
SOLVES = 10


class Counts:
    """Messages, bytes and collective calls of this rank, if the counter is preloaded."""

    def __init__(self) -> None:
        preloaded = os.environ.get("LD_PRELOAD", "")
        self._counter = ctypes.CDLL(preloaded) if "count_calls" in preloaded else None

    def reset(self) -> None:
        if self._counter is not None:
            self._counter.reset_counts()

    def largest(self) -> list[int] | None:
        """Return the maxima over the ranks."""
        if self._counter is None:
            return None
        result = (ctypes.c_long * 3)()
        self._counter.call_counts(result)
        return [comm.allreduce(number, MPI.MAX) for number in result]


def coarse_space(m: int, solver: str) -> CoarseSpace:
    """Return G of the beams with m subdomains per metre; 2^3 elements suffice for its size."""
    system = dealt(ladder.two_beams(m, 2, softer=False), comm)
    constraints, _ = build_constraints(system)
    classes = find_congruence_classes(system.subdomains)
    kernels = [kernel(subdomain) for subdomain in system.subdomains]
    interface = Interface.build(constraints.matrix, classes)
    return CoarseSpace.build(system, constraints, interface, kernels, "cholmod", solver)


def measure(m: int, solver: str, groups: int | None) -> dict[str, Any]:
    """Factor the matrix of a face and solve with it; return the largest times, and counts."""
    space, counts = coarse_space(m, solver), Counts()
    if groups is not None:
        space = replace(space, layout=replace(space.layout, groups=groups))
    first_half = np.arange(space.constraints.inequality.size) % 2 == 0
    comm.Barrier()
    counts.reset()
    begin = np.array([time.process_time(), time.perf_counter()])
    factor = Projector.build(space, first_half).gram.factor
    factoring = np.array([time.process_time(), time.perf_counter()]) - begin
    of_factor = counts.largest()
    b = np.random.default_rng(0).standard_normal(space.size)
    comm.Barrier()
    counts.reset()
    begin = np.array([time.process_time(), time.perf_counter()])
    for _ in range(SOLVES):
        factor.solve(b)
    solving = (np.array([time.process_time(), time.perf_counter()]) - begin) / SOLVES
    of_solves = counts.largest()
    # processor time and time of the clock
    times = [comm.allreduce(seconds, MPI.MAX) for seconds in (*factoring, *solving)]
    return {
        "ranks": comm.size,
        "solver": solver,
        "subdomains": 4 * m**3,
        "size": space.size,
        "groups": space.layout.groups if solver == "distributed" else None,
        "entries": comm.allreduce(factor.entries, MPI.MAX),
        "factorisation": times[:2],
        "solve": times[2:],
        "calls of the factorisation": of_factor,
        "calls of a solve": None if of_solves is None else [n / SOLVES for n in of_solves],
        "auto": choose_coarse_solver(comm.size, space.size),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--subdomains-per-metre", type=int, nargs="+", default=[2, 3, 5, 7])
    parser.add_argument(
        "--groups", type=int, help="ranks that share a factor, by default as counted"
    )
    parser.add_argument("--solvers", nargs="+", default=["redundant", "distributed", "iterative"])
    parser.add_argument("--json", metavar="FILE")
    arguments = parser.parse_args()
    table = []
    for solver, m in itertools.product(arguments.solvers, arguments.subdomains_per_metre):
        row = measure(m, solver, arguments.groups)
        table.append(row)
        if comm.rank == 0:
            on = "" if row["groups"] is None else f" on {row['groups']}"
            print(
                f"{row['ranks']:3} {solver + on:17} {row['subdomains']:5} {row['size']:6} entries "
                f"{row['entries']:9,}  factorisation {row['factorisation'][0]:.3f} s, solve "
                f"{1e3 * row['solve'][0]:.2f} ms (clock: {row['factorisation'][1]:.3f} s, "
                f"{1e3 * row['solve'][1]:.2f} ms)  messages, bytes, collective calls: "
                f"{row['calls of the factorisation']}, {row['calls of a solve']}; "
                f"auto: {row['auto']}",
                flush=True,
            )
    if arguments.json and comm.rank == 0:
        Path(arguments.json).write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Coarse matrices of the beams of ladder.py: entries of the factor, time and messages of a solve.

    mpirun -n 4 python benchmarks/run.py coarse [--subdomains-per-metre 3 5 7] [--json out.json]

Every second contact row is on the face. Redundant on every rank with CHOLMOD; distributed over some
of the ranks with MUMPS. Processor time and time of the clock. The calls of
MUMPS are counted if `count_calls.so` (see `count_calls.c`) is preloaded: mpirun -x LD_PRELOAD=...
"""

from __future__ import annotations

import ctypes
import itertools
import os
import time
from dataclasses import replace
from typing import Any

from mpi4py import MPI

import ladder
import numpy as np
from communication import dealt

from fenics_tfeti.feti.coarse.factor import choose_coarse_solver
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.constraints.face import Face
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

    def largest(self, solves: int = 1) -> dict[str, float]:
        """Return the maxima over the ranks for each solve."""
        if self._counter is None:
            return {}
        result = (ctypes.c_long * 3)()
        self._counter.call_counts(result)
        numbers = [comm.allreduce(number, MPI.MAX) / solves for number in result]
        return dict(zip(("messages", "bytes", "collective"), numbers, strict=True))


def coarse_space(m: int, solver: str) -> CoarseSpace:
    """Return G of the beams with m subdomains per metre; 2^3 elements suffice for its size."""
    system = dealt(ladder.two_beams(m, 2, softer=False), comm)
    constraints, _ = build_constraints(system)
    classes = find_congruence_classes(system.subdomains)
    kernels = [kernel(subdomain) for subdomain in system.subdomains]
    interface = Interface.build(constraints.matrix, classes)
    return CoarseSpace.build(system, constraints, interface, kernels, "cholmod", solver)


def measure(m: int, solver: str, groups: int) -> dict[str, Any]:
    """Factor the matrix of a face and solve with it; return the largest times, and counts."""
    space, counts = coarse_space(m, solver), Counts()
    if groups:
        space = replace(space, layout=replace(space.layout, groups=groups))
    first_half = np.arange(space.constraints.inequality.size) % 2 == 0
    comm.Barrier()
    counts.reset()
    begin = np.array([time.process_time(), time.perf_counter()])
    factor = Projector.build(space, Face.of(space.constraints, first_half)).gram.factor
    factoring = np.array([time.process_time(), time.perf_counter()]) - begin
    of_factor = counts.largest()
    b = np.random.default_rng(0).standard_normal(space.size)
    comm.Barrier()
    counts.reset()
    begin = np.array([time.process_time(), time.perf_counter()])
    for _ in range(SOLVES):
        factor.solve(b)
    solving = (np.array([time.process_time(), time.perf_counter()]) - begin) / SOLVES
    of_solves = counts.largest(SOLVES)

    def slowest(seconds: np.ndarray) -> dict[str, float]:
        names = ("processor", "clock")
        return {k: comm.allreduce(t, MPI.MAX) for k, t in zip(names, seconds, strict=True)}

    return {
        "ranks": comm.size,
        "solver": solver,
        "subdomains": 4 * m**3,
        "size": space.size,
        "groups": space.layout.groups if solver == "distributed" else None,
        "entries": comm.allreduce(factor.entries, MPI.MAX),
        "factorisation": slowest(factoring) | of_factor,
        "solve": slowest(solving) | of_solves,
        "auto": choose_coarse_solver(comm.size, space.size),
    }


def run(subdomains_per_metre=(2, 3, 5, 7), groups=0, solvers=("redundant", "distributed")):
    """Factor and solve for each size; `groups` ranks share a factor, by default as counted."""
    for solver, m in itertools.product(solvers, subdomains_per_metre):
        yield measure(m, solver, groups)

"""A block pressed onto a disc that moves in steps, with exact non-penetration; the run may die.

    python killed_run.py CHECKPOINT REPORTS [STEP PASS]

goes on from the checkpoint if there is one, writes a line of JSON for each step that it has
finished, and kills its last rank in the given pass of the given step.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
from scenes import CLAMPED, SLAVE, Scene, at

from fenics_tfeti import ContactProblem, Deformed, Sphere
from fenics_tfeti.io import Box, boxes, tag_facets

GAPS = Deformed(tolerance=1e-8)
HEIGHTS = [-1.02, -1.01, -1.0]


class Disc:
    """A disc whose centre moves."""

    height = HEIGHTS[0]

    def __call__(self, x):
        return Sphere((0.6, self.height, 0.0), 1.0)(x)


def block(comm, divisions: int = 12):
    """Return the mesh of a block.

    On three ranks and more dolfinx may distribute the same mesh in another way when it is made
    again: PT-SCOTCH depends on the order in which messages come.
    """
    return boxes(comm, [Box((0, 0), (1, 0.5), (divisions, divisions // 2))], "quadrilateral").mesh


def block_on_disc(mesh, disc, held: int = 2, friction=None, gaps=GAPS, **options) -> ContactProblem:
    """Return a block over a disc; components of its upper face are held, shifted by 0.05 m."""
    tags = tag_facets(mesh, [(CLAMPED, at(1, 0.5)), (SLAVE, at(1, 0.0))])
    scene = Scene(mesh, tags, young=1e6)
    for axis in range(held):
        scene.fix(CLAMPED, axis, (0.05, -0.02)[axis])
    scene.add_obstacle(SLAVE, disc, friction=friction)
    options = {"rtol": 1e-9, "subdomain_size": 60, **options}
    return scene.problem(gaps=gaps, options=options)


def run(mesh, checkpoint: Path, dies_in: tuple[int, int] | None = None):
    """Solve the steps that are left; yield step and problem after each."""
    comm, disc = mesh.comm, Disc()
    problem = block_on_disc(mesh, disc)
    begin = problem.restore(checkpoint) if checkpoint.exists() else 0

    def die(step):
        here = (len(reports), len(problem._accepted.passes))
        if here == dies_in and comm.rank == comm.size - 1:
            os.kill(os.getpid(), signal.SIGKILL)

    reports = list(range(begin))
    for step in range(begin, len(HEIGHTS)):
        disc.height = HEIGHTS[step]
        uh = problem.solve(monitor=die, checkpoint=checkpoint)
        problem.advance()
        problem.save(checkpoint)
        reports.append(step)
        size = comm.allreduce(float(np.abs(uh.x.array).max(initial=0.0)), MPI.MAX)
        report = problem.report
        yield {
            "step": step,
            "passes": len(report.passes),
            "force": report.contacts[0].normal_force,
            "energy": report.energy,
            "reused": report.reused,
            "size": size,
        }


if __name__ == "__main__":
    dies_in = tuple(map(int, sys.argv[3:5])) or None
    world = MPI.COMM_WORLD
    for line in run(block(world), Path(sys.argv[1]), dies_in):
        if world.rank == 0:
            with Path(sys.argv[2]).open("a") as file:
                file.write(json.dumps(line) + "\n")

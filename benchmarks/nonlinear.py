"""Steps of Newton's method and products with F that finite strains take.

    python benchmarks/run.py nonlinear [--cases "block 2D" ironing]
    mpirun -n 2 python benchmarks/run.py nonlinear --divisions 74 207

Cases are those of tests/nonlinear: a block pressed in by a rigid ball by a third of its height, a
beam bent over a cylinder, an ironed block with and without friction. A row has the Newton steps of
each load step and, over all of them, the mean products and the largest number of negative
directions. With `--divisions` the block is ironed with so many cells over its height instead,
pressed in one load step and dragged in others; processor seconds are those of the slowest rank,
bytes those of all ranks together.
"""

from __future__ import annotations

import math
import time

from mpi4py import MPI

import numpy as np
from finite_strains import beam, indented_block, ironing

from fenics_tfeti import Coulomb

THIRDS = (1 / 3, 2 / 3, 1.0)
QUARTERS = (0.25, 0.5, 0.75, 1.0)
DRAG = (0.5, *np.linspace(1.0, 2.0, 11))
# how a case is made, and the ends of its load steps
CASES = {
    "block 2D": (lambda: indented_block(n=16, subdomain_size=140), THIRDS),
    "block 2D, nu 0.45": (lambda: indented_block(2, 16, 0.45, subdomain_size=140), THIRDS),
    "block 2D, n = 32": (lambda: indented_block(n=32, subdomain_size=134), THIRDS),
    "block 2D, n = 64": (lambda: indented_block(n=64, subdomain_size=131), THIRDS),
    "block 2D, one step": (lambda: indented_block(n=16, subdomain_size=140), (1.0,)),
    "block 2D, one step, nu 0.45": (
        lambda: indented_block(2, 16, 0.45, subdomain_size=140),
        (1.0,),
    ),
    "block 3D": (lambda: indented_block(3, 6, subdomain_size=250), THIRDS),
    "block 3D, nu 0.45": (lambda: indented_block(3, 6, 0.45, subdomain_size=1000), THIRDS),
    "block 3D, 32 subdomains": (lambda: indented_block(3, 4, subdomain_size=50), THIRDS),
    "beam": (lambda: beam(subdomain_size=75), QUARTERS),
    "beam, one step": (lambda: beam(subdomain_size=75), (1.0,)),
    "ironing": (lambda: ironing(subdomain_size=400), DRAG),
    "ironing, friction 0.3": (lambda: ironing(Coulomb(0.3), subdomain_size=400), DRAG),
}


def run(cases=tuple(CASES), divisions=()):
    """Solve each case in its load steps, or the ironed block of each size."""
    if divisions:
        for n in map(int, divisions):
            yield from sized(n)
        return
    for name in cases:
        make, loads = CASES[name]
        scene, each, start = make(), [], time.process_time()
        for load in loads:
            scene.solve([load])
            each.append(scene.problem.report.newton)
        yield {
            **row(name, scene.problem.report, each),
            "cpu": time.process_time() - start,
        }


def sized(n):
    """Press the die down by 0.3, and drag it by 0.3 in load steps of at most 16 cells."""
    scene, start = ironing(n=n), time.process_time()
    drags = np.linspace(1.0, 1.2, 1 + math.ceil(0.3 * n / 16))
    for name, loads in {"press": drags[:1], "drag": drags[1:]}.items():
        each = []
        for load in loads:
            scene.solve([load])
            each.append(scene.problem.report.newton)
        yield {
            **row(f"ironing, {name}", scene.problem.report, each),
            "cpu": MPI.COMM_WORLD.allreduce(time.process_time() - start, MPI.MAX),
            "bytes": scene.problem.report.peak_memory_bytes,
        }


def row(name, report, each):
    """Return what is counted of the Newton steps of each load step."""
    steps = sum(each, [])
    return {
        "case": name,
        "subdomains": report.subdomains,
        "unknowns": report.unknowns["primal"],
        "newton": " ".join(str(len(of_load)) for of_load in each),
        "products": float(np.mean([step.products for step in steps])),
        "negative": max(step.negative for step in steps),
    }

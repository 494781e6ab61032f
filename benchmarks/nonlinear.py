"""Steps of Newton's method and products with F that finite strains take.

    python benchmarks/run.py nonlinear [--cases "block 2D" ironing]

Cases are those of tests/nonlinear: a block pressed in by a rigid ball by a third of its height, a
beam bent over a cylinder, an ironed block with and without friction. A row has the Newton steps of
each load step and, over all of them, the mean products and the largest number of negative
directions.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from fenics_tfeti import Coulomb

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
from finite_strains import beam, indented_block, ironing

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


def run(cases=tuple(CASES)):
    """Solve each case in its load steps."""
    for name in cases:
        make, loads = CASES[name]
        scene, each, start = make(), [], time.process_time()
        for load in loads:
            scene.solve([load])
            each.append(scene.problem.report.newton)
        steps, unknowns = sum(each, []), scene.problem.report.unknowns
        yield {
            "case": name,
            "subdomains": scene.problem.report.subdomains,
            "unknowns": unknowns["primal"],
            "newton": " ".join(str(len(of_load)) for of_load in each),
            "products": float(np.mean([step.products for step in steps])),
            "negative": max(step.negative for step in steps),
            "cpu": time.process_time() - start,
        }

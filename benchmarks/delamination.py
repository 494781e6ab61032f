"""Double cantilever beams that delaminate.

    python benchmarks/delamination.py [--case C] [--cell 0.25] [--cells 8] [--steps 52]

Two arms of laminate of 100 mm, clamped at one end, with a crack at the other, where they are opened
(``tests/support/delaminating.py``). Printed are the peak of the load, beside that of corrected beam
theory, and passes and products of the load steps.
"""

from __future__ import annotations

import argparse

import numpy as np
import runner  # noqa: F401 - the folders of the tests
from delaminating import CASES, Beam

from fenics_tfeti import Cohesive


def main() -> None:
    """Open one beam, and print what it took."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--case", default="C", choices=CASES)
    parser.add_argument("--cell", type=float, default=0.25, help="length of a cell [mm]")
    parser.add_argument("--cells", type=int, default=8, help="over the height of an arm")
    parser.add_argument("--stiffness", type=float, default=10.0, help="in strength^2 / energy")
    parser.add_argument("--opening", type=float, default=1.3, help="last one, over beam theory's")
    parser.add_argument("--steps", type=int, default=52, help="of the opening")
    parser.add_argument("--size", type=int, default=1000, help="unknowns of a subdomain")
    given = parser.parse_args()
    case = CASES[given.case]
    stiffness = given.stiffness * case.strength**2 / case.energy
    options = {"rtol": 1e-5, "preconditioner": "dirichlet", "subdomain_size": given.size}
    beam = Beam(
        case, given.cell, given.cells, options, Cohesive(case.strength, case.energy, stiffness)
    )
    theory = case.beam_theory()
    beam.open_by(0.1 * theory[1])
    bonded = beam.problem.report.products["total"]
    curve, entries = beam.open_in_steps(
        given.opening * theory[1] * np.arange(1, given.steps + 1) / given.steps
    )
    opening, load = curve.T
    peak = load.argmax()
    print(f"{given.case}: peak {load[peak]:.2f} N at {opening[peak]:.3f} mm")
    print(f"beam theory: {theory[0]:.1f} N at {theory[1]:.2f} mm")
    passes, products, steps = (
        np.array(x)
        for x in zip(*[(e.passes, e.products, len(e.path)) for e in entries], strict=True)
    )
    grows = steps > 0
    print(
        f"damage grows in {grows.sum()} load steps of {grows.size}: {steps[grows].mean():.1f} "
        f"equilibria each, {passes[grows].mean():.1f} passes, {passes.max()} at most"
    )
    print(
        f"{products[grows].mean():.0f} products a load step, {products.sum() / passes.sum():.1f} a "
        f"pass, {bonded} of a solve from zero"
    )


if __name__ == "__main__":
    main()

"""Double cantilever beams that delaminate: an `ElasticBond` that a bilinear law weakens.

    python benchmarks/delamination.py [--case C] [--cell 0.25] [--cells 8] [--growth 8]

Two arms of laminate of 100 mm, clamped at one end, with a crack at the other, where they are opened
(``tests/support/delaminating.py``). Printed are the peak of the load, beside that of corrected beam
theory, passes and products of a step, and products of a tied solve.
"""

from __future__ import annotations

import argparse

import runner  # noqa: F401 - the folders of the tests
from delaminating import CASES, Beam, Bilinear, propagate


def main() -> None:
    """Open one beam, and print what it took."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--case", default="C", choices=CASES)
    parser.add_argument("--cell", type=float, default=0.25, help="length of a cell [mm]")
    parser.add_argument("--cells", type=int, default=8, help="over the height of an arm")
    parser.add_argument("--stiffness", type=float, default=10.0, help="in strength^2 / energy")
    parser.add_argument("--growth", type=float, default=8.0, help="length of the new crack [mm]")
    parser.add_argument("--size", type=int, default=1000, help="unknowns of a subdomain")
    given = parser.parse_args()
    case = CASES[given.case]
    law = Bilinear(given.stiffness * case.strength**2 / case.energy, case.strength, case.energy)
    options = {"rtol": 1e-5, "preconditioner": "dirichlet", "subdomain_size": given.size}
    beam = Beam(case, given.cell, given.cells, options)
    curve = propagate(beam, law, case, given.cell, given.growth)
    opening, load, passes, products = curve.T
    theory, peak = case.beam_theory(), load.argmax()
    print(f"{given.case}: peak {load[peak]:.2f} N at {opening[peak]:.3f} mm")
    print(f"beam theory: {theory[0]:.1f} N at {theory[1]:.2f} mm")
    print(f"{len(curve)} steps of {passes.mean():.1f} passes, {passes.max():.0f} at most")
    print(
        f"{products.mean():.0f} products a step, {products.sum() / passes.sum():.1f} a pass, "
        f"{beam.tied} of a tied solve"
    )


if __name__ == "__main__":
    main()

"""A fork, a lug and a pin with clearance on tetrahedra of Gmsh: what a first joint gives.

    python benchmarks/joint.py [--element-size 1.5] [--degree 1] [--exchange] [--initial-gap 0.02]

The lug is pulled by 5,292 N, the pin is loose, nothing has friction; lengths in mm, forces in N.
Prints for each contact the largest pressure, and for lug and pin how far they move along the pin.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))
from joints import axial_motion, joint_problem, read_joint


def main() -> None:
    """Run one case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--element-size", type=float, default=1.5, help="[mm]")
    parser.add_argument("--degree", type=int, default=1, choices=(1, 2))
    parser.add_argument("--exchange", action="store_true", help="the pin is the slave")
    parser.add_argument("--initial-gap", type=float, help="prescribed clearance [mm]")
    given = parser.parse_args()
    bodies = read_joint(given.element_size, given.degree)
    of_pair = {} if given.initial_gap is None else {"initial_gap": given.initial_gap}
    problem = joint_problem(bodies, given.degree, given.exchange, **of_pair)
    uh = problem.solve()
    motion, results = axial_motion(bodies, uh), [contact.gather() for contact in problem.results]
    if bodies.mesh.comm.rank:
        return
    print(problem.report)
    for result in results:
        print(f"{result.name}: largest pressure {result.pressure.max():.0f} MPa, ", end="")
        print(f"{result.active.sum()} nodes press")
    print("along the pin: " + ", ".join(f"{name} {z:.4f} mm" for name, z in motion.items()))


if __name__ == "__main__":
    main()

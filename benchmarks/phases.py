"""Seconds of each phase of a solve, in one table for all problems.

    python benchmarks/phases.py [--problems beams stack] [--json out.json]

Each problem of `products.py` is set up and solved twice in this process with its default options.
The second time is printed, when forms are compiled and libraries are loaded. Phases are those of
the report, in seconds and in per cent of their sum. They do not include what the script does before
`ContactProblem` (mesh, forms).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from mpi4py import MPI

from products import PROBLEMS


def measure(name: str) -> dict[str, Any]:
    """Return sizes, products and seconds of the second solve of a problem."""
    for _ in range(2):
        problem = PROBLEMS[name](False)
        problem.solve()
    report = problem.report
    return {
        "problem": name,
        "unknowns": report.unknowns["primal"],
        "subdomains": report.subdomains,
        "classes": report.classes,
        "products": report.products,
        "seconds": report.seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--problems", nargs="+", choices=PROBLEMS, default=list(PROBLEMS))
    parser.add_argument("--json", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    rows = [measure(name) for name in arguments.problems]
    if MPI.COMM_WORLD.rank > 0:
        return
    print(f"{'':<18}" + "".join(f"{row['problem']:>18}" for row in rows))
    for size in ("unknowns", "subdomains", "classes"):
        print(f"{size:<18}" + "".join(f"{row[size]:>18,}" for row in rows))
    print(f"{'products':<18}" + "".join(f"{row['products']['total']:>18}" for row in rows))
    for phase in dict.fromkeys(name for row in rows for name in row["seconds"]):
        cells = []
        for row in rows:
            time, total = row["seconds"].get(phase, 0.0), row["seconds"]["total"]
            cells.append(f"{time:10.2f} s {time / total:5.0%}")
        print(f"{phase:<18}" + "".join(cells))
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()

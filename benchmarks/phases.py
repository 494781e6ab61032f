"""Seconds of each phase of a solve.

    python benchmarks/run.py phases [--problems beams stack]

Each problem of `products.py` is set up and solved twice in this process with its default options.
The second time is printed, when forms are compiled and libraries are loaded. Phases are those of
the report. They do not include what the script does before
`ContactProblem` (mesh, forms).
"""

from __future__ import annotations

from typing import Any

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


CHOICES = {"problems": list(PROBLEMS)}


def run(problems=tuple(PROBLEMS)):
    """Solve each problem twice."""
    for name in problems:
        yield measure(name)

"""Seconds of each phase of a solve.

    python benchmarks/run.py phases [--problems beams stack]

Each problem of `products.py` is set up and solved twice in this process with its default options.
The second time is printed, when forms are compiled and libraries are loaded. Phases are those of
the report. They do not include what the script does before
`ContactProblem` (mesh, forms). The processor seconds are those of `ContactProblem` and `solve()`.
"""

from __future__ import annotations

import time
from typing import Any
from unittest import mock

from products import PROBLEMS
from scenes import Scene


def measure(name: str) -> dict[str, Any]:
    """Return sizes, products and seconds of the second solve of a problem."""
    build, processor = Scene.problem, {}

    def timed(part: str, function, *args, **kwargs):
        begin = time.process_time()
        result = function(*args, **kwargs)
        processor[part] = time.process_time() - begin
        return result

    def construct(*args, **kwargs):
        return timed("ContactProblem", build, *args, **kwargs)

    with mock.patch.object(Scene, "problem", construct):
        for _ in range(2):
            problem = PROBLEMS[name](False)
            timed("solve", problem.solve)
    report = problem.report
    return {
        "problem": name,
        "unknowns": report.unknowns["primal"],
        "subdomains": report.subdomains,
        "classes": report.classes,
        "products": report.products,
        "seconds": report.seconds,
        "processor seconds": processor,
    }


CHOICES = {"problems": list(PROBLEMS)}


def run(problems=tuple(PROBLEMS)):
    """Solve each problem twice."""
    for name in problems:
        yield measure(name)

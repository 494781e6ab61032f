"""Products with F and time of an adjoint, beside those of the solve and of a linear problem.

    python benchmarks/run.py adjoint [--problems beams stack] [--rtol 1e-6]

The linear problem is that of the solution itself: its loads and gaps on the face where the solve
has ended, from zero multipliers, to the same tolerance. J is the mean square of the displacement.
Processor seconds of the solve have its set-up, without meshes and assembly.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from products import PROBLEMS, with_options

import ufl

from fenics_tfeti.feti.solution.linear import LinearData, RowValues

CHOICES = {"problems": list(PROBLEMS)}


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """Return what a call returns, and its processor seconds."""
    start = time.process_time()
    return call(), time.process_time() - start


def run(problems=tuple(PROBLEMS), rtol=(1e-6,)):
    """Solve each problem and its adjoint, to each tolerance."""
    for name in problems:
        for tolerance in rtol:
            problem = with_options(name, coarse=False, rtol=tolerance)
            _, of_solve = timed(problem.solve)
            linear = problem._solver.linear_problem()
            system, zeros = linear.system, RowValues.zeros(linear.system)
            contacts = system.contacts
            gap = np.where(linear.active, contacts.gap / contacts.length, 0.0)
            jumps = RowValues(gap, zeros.tangential, zeros.tied)
            data = LinearData([s.load for s in system.subdomains], jumps, zeros)
            state = linear.solve(data, tolerance)
            u = problem.u
            problem.adjoint(ufl.dot(u, u) * ufl.dx)  # compiles dJ/du
            adjoint, of_adjoint = timed(lambda: problem.adjoint(ufl.dot(u, u) * ufl.dx))  # noqa: B023
            yield {
                "problem": name,
                "rtol": tolerance,
                "solve": problem.report.products["total"],
                "linear": state.products,
                "adjoint": adjoint.linear_solves.products,
                "adjoint / linear": adjoint.linear_solves.products / state.products,
                "seconds of solve": of_solve,
                "seconds of adjoint": of_adjoint,
            }

"""The bound of the certificate against the true error in the energy norm, and the products spent.

    python benchmarks/accuracy.py [--problems beams stack] [--rtol 1e-2 1e-6] [--json out.json]

The problems of `products.py`, on one rank. The true error is that of the displacement which is
returned, relative to the solution at rtol 1e-9.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from products import PROBLEMS, with_options

from fenics_tfeti import ContactProblem


def energy_norm(problem: ContactProblem, u: np.ndarray) -> float:
    """Return ||u||_K of a displacement on all nodes."""
    by_node = u.reshape(-1, problem.space.mesh.geometry.dim)
    parts = ((by_node[s.nodes].ravel(), s.stiffness) for s in problem.system.subdomains)
    return float(np.sqrt(sum(v @ (K @ v) for v, K in parts)))


def measure(name: str, exact: np.ndarray, preconditioner: str, rtol: float) -> dict[str, object]:
    """Solve a problem; return products, the true error and the certificate."""
    problem = with_options(name, False, rtol=rtol, preconditioner=preconditioner)
    u = problem.solve().x.array
    report = problem.report
    return {
        "problem": name,
        "preconditioner": preconditioner,
        "rtol": rtol,
        "products": report.products["total"],
        "applications": report.products["preconditioner"],
        "true": energy_norm(problem, u - exact) / energy_norm(problem, exact),
        "bound": report.certificate.error,
        "largest": report.certificate.worst,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--problems", nargs="+", choices=PROBLEMS, default=list(PROBLEMS))
    parser.add_argument("--rtol", type=float, nargs="+", default=[1e-2, 1e-4, 1e-6, 1e-8])
    parser.add_argument("--json", metavar="FILE")
    arguments = parser.parse_args()
    table = []
    print(f"{'problem':<17}{'precond.':<11}rtol    F + M    true  bound / true  largest")
    for name in arguments.problems:
        exact = with_options(name, False, rtol=1e-9).solve().x.array.copy()
        for preconditioner in ("lumped", "dirichlet"):
            for rtol in arguments.rtol:
                row = measure(name, exact, preconditioner, rtol)
                table.append(row)
                print(
                    f"{name:<17}{preconditioner:<11}{rtol:.0e} {row['products']:3} + "
                    f"{row['applications']:<3} {row['true']:.1e} {row['bound'] / row['true']:8.2f}"
                    f"     {row['largest']:.1e}",
                    flush=True,
                )
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Products with F on meshes whose cells grow away from the contact, with each preconditioner.

    python benchmarks/run.py graded [--cases "2D, a/40" "3D, a/10"]

A rigid ball, in 2D a roller, on a block: cells of 1/10 or 1/40 of the radius of contact a, each
beyond it larger than the one before by a factor, up to a distance of 10 to 100 a.
"""

from __future__ import annotations

from mpi4py import MPI

from graded_block import graded_block

# dimension, cells on a, growth, size
CASES = {
    "2D, a/10": (2, 10, 1.2, 20.0),
    "2D, a/40": (2, 40, 1.2, 20.0),
    "2D, a/40, to 100 a": (2, 40, 1.15, 100.0),
    "3D, a/6": (3, 6, 1.3, 20.0),
    "3D, a/10": (3, 10, 1.25, 10.0),
}
OPTIONS = {
    "auto": {},
    "lumped": {"preconditioner": "lumped", "deflation": "off"},
    "dirichlet": {"preconditioner": "dirichlet", "deflation": "off"},
    "lumped, deflated": {"preconditioner": "lumped"},
}
MOST = 3000
CHOICES = {"cases": list(CASES)}


def run(cases=tuple(CASES)):
    """Solve each case with each choice."""
    for name in cases:
        counts = {}
        for label, options in OPTIONS.items():
            limited = {"max_products": MOST, "error_if_not_converged": False}
            problem = graded_block(MPI.COMM_WORLD, *CASES[name], rtol=1e-6, **limited, **options)
            problem.solve()
            report = problem.report
            if label == "auto":
                counts = {
                    "case": name,
                    "unknowns": report.unknowns["primal"],
                    "subdomains": report.subdomains,
                    "chosen": report.preconditioner,
                    "vectors": report.deflation["vectors"],
                    "solves": report.products["deflation"],
                    "certificate": report.certificate.worst,
                }
            counts[label] = report.products["total"] if report.converged else f"over {MOST}"
        yield counts

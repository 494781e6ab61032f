"""The spectrum of PFP on Ker G as a function of H/h and of 1/h, compared with theorem 11.1.

    python benchmarks/run.py theory [--ratios 4 8 16] [--metres 1 2 3] [--plot FILE]

By (11.42) the eigenvalues of PFP + rho Q lie between c and C H/h, with F in units of 1 / (E h), in
two dimensions of 1 / E: the smallest one is bounded from below, the largest one grows at most like
H/h, and neither depends on 1/h at fixed H/h. The orthonormal rows of B that the theorem assumes,
(11.22), are those of scaling="multiplicity". The problems are the two beams of sec. 11.11.1 in
cubes, and two sheets in squares, which allow larger H/h. The table also has the products of plain
SMALBE-M and of the default method.
"""

from __future__ import annotations

from mpi4py import MPI

import beams
import numpy as np
from scenes import YOUNG
from scipy.sparse.linalg import LinearOperator, eigsh

from fenics_tfeti import ContactProblem
from fenics_tfeti.feti import Options, TornSolver, TornSystem

PLAIN = Options(rtol=1e-4, **beams.PLAIN)


def extreme_eigenvalues(solver: TornSolver, rtol: float = 1e-4) -> tuple[float, float]:
    """Return the smallest and the largest eigenvalue of PFP on Ker G, by Lanczos. Serial.

    On Im G', which P removes, the operator is a multiple of the identity away from the end that is
    computed: zero for the largest eigenvalue, twice the largest eigenvalue for the smallest one.
    """
    projector, m = solver.setup.projector, solver.setup.constraints.layout.size

    def operator(shift: float) -> LinearOperator:
        def apply(x: np.ndarray) -> np.ndarray:
            x = x.ravel()
            Qx = projector.Q(x)
            return projector.P(solver.setup.F(x - Qx)) + shift * Qx

        return LinearOperator((m, m), apply, dtype=float)

    start = projector.P(np.random.default_rng(0).standard_normal(m))

    def end(which: str, shift: float) -> float:
        found = eigsh(
            operator(shift), 1, which=which, v0=start, tol=rtol, return_eigenvectors=False
        )
        return float(found[0])

    largest = end("LA", 0.0)
    return end("SA", 2.0 * largest), largest


def two_beams(metres: int, ratio: int) -> ContactProblem:
    """Return the two beams, with `metres` cubes of `ratio`^3 elements per metre."""
    return beams.build(metres, ratio, 1e-4, plain=True)


def two_sheets(metres: int, ratio: int) -> ContactProblem:
    """Return two sheets in contact in plane strain, the two-dimensional two beams."""
    sheets = beams.sheets(MPI.COMM_WORLD, "quadrilateral", metres * ratio)
    return sheets.problem(cell_tags=None, subdomains=beams.cubes(sheets, metres))


def measure(system: TornSystem, metres: int, ratio: int) -> dict[str, float]:
    """Return a row of the table."""
    plain = TornSolver(system, PLAIN)
    # F in units of 1 / (E h), in the plane 1 / E
    unit = YOUNG * (1.0 / (metres * ratio)) ** (system.gdim - 2)
    smallest, largest = (unit * value for value in extreme_eigenvalues(plain))
    products = plain.solve().report.products["total"]
    default = TornSolver(system, Options(rtol=1e-4)).solve().report.products["total"]
    return {
        "dimension": system.gdim,
        "subdomains per metre": metres,
        "H/h": ratio,
        "1/h": metres * ratio,
        "subdomains": len(system.subdomains),
        "dual": plain.setup.constraints.layout.size,
        "smallest": smallest,
        "largest": largest,
        "condition": largest / smallest,
        "plain products": products,
        "default products": default,
    }


def slope(rows: list[dict[str, float]], x: str, y: str) -> float:
    """Return the slope in the log-log plot by least squares; without m = 1 where m varies.

    With m = 1 every cube has neighbours on two sides at most, and no node has eight copies.
    """
    if x == "1/h":
        rows = [row for row in rows if row["subdomains per metre"] > 1] or rows
    return float(np.polyfit(np.log([r[x] for r in rows]), np.log([r[y] for r in rows]), 1)[0])


def draw(tables: dict[str, list[dict[str, float]]], path: str) -> None:
    """Draw the eigenvalues of all tables, log-log."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True)
    for ax, x in zip(axes, ("H/h", "1/h"), strict=True):
        for (name, rows), colour in zip(
            [(n, r) for n, r in tables.items() if n.endswith(x)], ("C0", "C1"), strict=False
        ):
            at = [row[x] for row in rows]
            label = name.split(",")[0]
            for y, mark in (("largest", "o-"), ("smallest", "s--")):
                values = [row[y] for row in rows]
                text = f"{label}, {y}, slope {slope(rows, x, y):.2f}"
                ax.loglog(at, values, mark, color=colour, label=text)
        ax.set_xlabel(x if x == "H/h" else "1/h at fixed H/h [1/m]")
        ax.grid(True, which="both", alpha=0.3)
        ax.legend(fontsize=7)
    axes[0].set_ylabel("eigenvalues of PFP on Ker G, scaled")
    figure.suptitle("Theorem 11.1 on the two beams (3D) and two sheets (2D)", fontsize=10)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def run(ratios=(4, 8, 16), per_metre=2, ratios_2d=(4, 8, 16, 32, 64), metres=(1, 2, 3, 4), plot=""):
    """Sweep H/h (`ratios`, in 3D with `per_metre` cubes) and 1/h (`metres`); draw to `plot`."""
    sweeps = {
        "2D, against H/h": (two_sheets, [(2, r) for r in ratios_2d], "H/h"),
        "2D, against 1/h": (two_sheets, [(m, 16) for m in metres], "1/h"),
        "3D, against 1/h": (two_beams, [(m, 4) for m in metres], "1/h"),
        "3D, against H/h": (two_beams, [(per_metre, r) for r in ratios], "H/h"),
    }
    tables = {}
    for name, (build, pairs, x) in sweeps.items():
        tables[name] = rows = []
        for m, ratio in pairs:
            problem = build(m, ratio)  # owns the communicator of its torn system
            rows.append({"sweep": name, **measure(problem.system, m, ratio)})
            yield rows[-1]
        if len(rows) > 2:
            slopes = {f"slope of {y}": slope(rows, x, y) for y in ("smallest", "largest")}
            yield {"sweep": name, **slopes, "slope of condition": slope(rows, x, "condition")}
    if plot:
        draw(tables, plot)

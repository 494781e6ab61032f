"""Products with and without deflation where subdomains cut stiff fibres and inclusions.

    python benchmarks/run.py deflation
    mpirun -n 2 python benchmarks/run.py deflation
    python benchmarks/run.py deflation --plot out.png

The problems are the two beams of benchmarks/materials.py in tetrahedra (3D) and two sheets of the
same outline in triangles (2D), cut by SCOTCH. On several ranks the subdomains of one rank are dealt
out, so that all runs have the same ones. With --plot, the spectrum of PFP on Ker G with and without
deflation, in units of the stiffness that the weights stand for.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import beams as two_beams
import materials
import numpy as np
from communication import dealt
from mesh_arrays import of_function

from fenics_tfeti.feti import TornSolver, TornSystem, parse_options

comm = MPI.COMM_WORLD
PATIENT = {"smalbe_patience": 1000}  # SMALBE-M alone
WAYS = {
    "lumped": {"preconditioner": "lumped"},
    "dirichlet": {"preconditioner": "dirichlet"},
    "smalbe lumped": {"preconditioner": "lumped", "method": "smalbe", **PATIENT},
    "smalbe dirichlet": {"preconditioner": "dirichlet", "method": "smalbe", **PATIENT},
    "smalbe none": {"preconditioner": "none", "method": "smalbe", **PATIENT},
}


# -- problems ------------------------------------------------------------------------------------


def sheets(elements_per_metre: int, size: int) -> Callable[..., TornSystem]:
    """Return a function of the stiff part and the ratio: two sheets in plane strain."""
    scene = two_beams.sheets(MPI.COMM_SELF, "triangle", elements_per_metre)
    return systems(materials.Beams(scene), size, SHEET)


def beams(elements_per_metre: int, size: int) -> Callable[..., TornSystem]:
    """Return a function of the stiff part and the ratio: two beams of tetrahedra."""
    tagged = of_function(materials.write_mesh, 3, 2, elements_per_metre)
    return systems(materials.two_beams(tagged), size, BEAM)


def systems(bodies: materials.Beams, size: int, stiff: dict[str, Any]) -> Callable[..., TornSystem]:
    """Return a function of the stiff part and the ratio, for subdomains of SCOTCH."""
    labels = bodies.cut(size)
    return lambda name, ratio: bodies.problem(stiff[name], ratio, labels).system


def sheet_fibres(x: materials.Places) -> np.ndarray:
    """Four fibres along each sheet, 0.09 m thick."""
    return np.abs(x[1] % 0.25 - 0.125) < 0.046


def sheet_inclusions(x: materials.Places) -> np.ndarray:
    """Discs of 0.18 m diameter, a quarter of a metre apart."""
    return np.hypot(x[0] % 0.25 - 0.125, x[1] % 0.25 - 0.125) < 0.09


SHEET = {
    "uniform": materials.uniform,
    "fibres": sheet_fibres,
    "inclusions": sheet_inclusions,
}
BEAM = {
    "uniform": materials.uniform,
    "fibres": materials.fibres,
    "inclusions": materials.inclusions,
}


# -- table ---------------------------------------------------------------------------------------


def seconds(call: Callable[[], Any], least: float = 0.2) -> float:
    """Return the mean processor time of a call on this rank, called for so many seconds or more."""
    start, calls = time.process_time(), 0
    while (spent := time.process_time() - start) < least:
        call()
        calls += 1
    return spent / calls


def measure(system: TornSystem, **options: Any) -> dict[str, Any]:
    """Solve, and time the set-up of deflation in products with F."""
    chosen = parse_options({"error_if_not_converged": False, **options})
    solver = TornSolver(system, chosen)
    report = solver.solve().report
    setup, x = solver.setup, np.ones(solver.setup.constraints.size)
    product = seconds(lambda: setup.F.part(x))
    plain = setup.without_deflation()
    price = seconds(lambda: plain.deflated(system, chosen)) / product
    return {
        "products": report.products["total"] if report.converged else None,
        "energy": report.energy,
        "certificate": report.certificate.worst,
        "vectors": report.deflation["vectors"],
        "bytes": report.deflation["bytes"],
        "solves": report.products["deflation"],
        "price": comm.allreduce(price, MPI.MAX),
        "deflated": seconds(lambda: setup.part(x)) / product,
    }


def run(
    elements_per_metre=(32, 8),
    subdomain_size=(450, 450),
    ratios=(1e4, 1e6),
    max_products=1000,
    plain=False,
    plot="",
):
    """Solve by all ways, `plain` also without deflation; sizes are those in 2D and 3D.

    With `plot`, a file, draw the spectrum instead.
    """
    if plot:
        draw(plot)
        return
    for gdim, make in ((2, sheets), (3, beams)):
        system = make(elements_per_metre[gdim - 2], subdomain_size[gdim - 2])
        jumps = [(name, ratio) for name in ("fibres", "inclusions") for ratio in ratios]
        for name, ratio in [("uniform", 1.0), *jumps]:
            share = dealt(system(name, ratio), comm)
            for kind in ("off", "auto") if plain else ("auto",):
                case = {"gdim": gdim, "case": name, "ratio": ratio, "kind": kind}
                for way, options in WAYS.items():
                    limits = {"max_products": max_products, "deflation": kind}
                    yield {**case, "way": way, **measure(share, **options, **limits)}


# -- picture -------------------------------------------------------------------------------------


def spectrum(system: TornSystem, **options: Any) -> np.ndarray:
    """Return the eigenvalues of PFP, or PF_cP, on Ker G, largest first. Serial."""
    setup = TornSolver(system, parse_options(options)).setup
    P, unit = setup.projector.P, setup.local.unit
    columns = [P(setup.part(P(e))) for e in np.eye(setup.constraints.size)]
    values = np.linalg.eigvalsh(unit * np.array(columns))[::-1]
    return values[values > 1e-9 * values[0]]


def draw(path: str) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4.4), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    system = sheets(16, 300)
    lines = {
        "fibres 1e6": (spectrum(system("fibres", 1e6), deflation="off"), "-"),
        "fibres 1e4": (spectrum(system("fibres", 1e4), deflation="off"), "--"),
        "fibres 1e6, deflated": (spectrum(system("fibres", 1e6)), "-."),
        "uniform": (spectrum(system("uniform", 1.0)), ":"),
    }
    for name, (values, style) in lines.items():
        print(f"{name}: largest {values[0]:.4g}, smallest {values[-1]:.3g}, {values.size} values")
        axes.semilogy(np.arange(1, values.size + 1), values, style, label=name)
    axes.set_xlabel("number of the eigenvalue")
    axes.set_ylabel("eigenvalue of PFP times the stiffness of a weight")
    axes.grid(color="#d5d8dc", linewidth=0.6)
    axes.legend(frameon=False)
    figure.savefig(path)

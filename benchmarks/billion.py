"""A model of the ladder with a billion unknowns on 10 to 10,000 ranks, and checks of its terms.

    python benchmarks/run.py billion                                      # the model
    python benchmarks/run.py billion --what rates [--elements 10 14 18]   # those of the plan
    python benchmarks/run.py billion --what general [--sizes 800 3000 6000]
    mpirun -n 4 python benchmarks/run.py billion --what check [--subdomains-per-metre 3]

The model is that of ``fenics_tfeti.plan``: subdomains, rows, messages and bytes are counted for the
geometry of the two beams, processor times are measured. A check counts and measures terms on the
ranks that it runs on, in parts without communication.
"""

from __future__ import annotations

import itertools
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

from mpi4py import MPI

import communication
import general
import ladder
import numpy as np
from runner import separately

from fenics_tfeti import plan
from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.io import read_msh

CHOICES = {"what": ["model", "rates", "general", "check"]}
UNKNOWNS = 1e9
OPTIONS = Options(rtol=1e-4, dual_operator="explicit", coarse_solver="distributed")
BLOCKS = {int(rates.n): rates for rates in plan.MESHES["blocks"].rates}
# elements a metre of the two meshes of tetrahedra between which rates are measured
COARSE, FINE = 16, 28


def row(model: plan.Model) -> dict[str, Any]:
    """Return the row of the table."""
    memory = model.bytes
    return {
        "H/h": model.rates.n,
        "subdomains": round(model.subdomains),
        "ranks": model.ranks,
        "own": round(model.own),
        "set-up s": model.set_up,
        "set-up messages s": model.set_up_messages,
        "iteration ms": 1e3 * model.iteration,
        "messages ms": 1e3 * model.messages,
        "MUMPS ms": 1e3 * model.coarse_solves,
        "face messages s": model.face,
        "Q": model.groups,
        "face MUMPS s": model.factorisation,
        "GB local": (memory["interpreter, libraries"] + memory["subdomains"]) / 1e9,
        "GB whole": memory["whole coarse vectors"] / 1e9,
        "GB factor": memory["coarse factor"] / 1e9,
        "solve MUMPS s": sum(model.seconds.values()),
    }


def products(solver: TornSolver) -> float:
    """Return the least processor seconds of F and preconditioner on this rank, of 20."""
    x = np.ones(solver.setup.constraints.layout.numbers.size)
    seconds = []
    for _ in range(20):
        begin = time.process_time()
        solver.setup.F.part(x)
        solver.setup.preconditioner.apply(x)
        seconds.append(time.process_time() - begin)
    return min(seconds)


def measured(m: int, n: int) -> dict[str, float]:
    """Return processor seconds and the peak of memory of a ladder on this process."""
    system = ladder.two_beams(m, n, softer=False)
    begin = time.process_time()
    solver = TornSolver(system, OPTIONS)
    set_up = time.process_time() - begin
    begin = time.process_time()
    report = solver.solve().report
    solve = (time.process_time() - begin) / report.products["total"]
    peak = 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    number = report.subdomains
    terms = {"product": products(solver), "solve": solve, "set_up": set_up, "bytes": peak}
    return {"H/h": n, "subdomains": number, **terms}


def rates_of(n: int) -> plan.Rates:
    """Return the rates between ladders of 32 and of 256 subdomains, each by its own process."""
    small, large = (
        separately("billion", what="rates", subdomains_per_metre=m, elements=n)[0] for m in (2, 4)
    )
    number = large["subdomains"] - small["subdomains"]
    of_one = {name: (large[name] - small[name]) / number for name in list(small)[2:]}
    once = {name: small[name] - small["subdomains"] * of_one[name] for name in ("set_up", "bytes")}
    return plan.cube(n, *of_one.values(), once["set_up"], once["bytes"])


def measured_general(path: Path, size: int) -> dict[str, float]:
    """Return processor seconds and the peak of memory of tetrahedra on this process."""
    beams = general.Beams(read_msh(path))
    begin = time.process_time()
    problem = beams.contact(rtol=3e-6, subdomain_size=size)
    problem._timer.clock = time.process_time
    problem.solve()
    total, report = time.process_time() - begin, problem.report
    iterations = report.seconds["iterations"]
    return {
        "unknowns": report.unknowns["primal"],
        "torn": report.unknowns["torn"],
        "subdomains": report.subdomains,
        "product": products(problem._solver),
        "solve": iterations / report.products["total"],
        "set_up": total - iterations,
        "bytes": report.peak_memory_bytes,
    }


def general_rates(size: int) -> plan.Rates:
    """Return the rates of a finer mesh: set-up and bytes by the torn unknowns it has more."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [general.make_meshes(n, Path(folder))["contact"] for n in (COARSE, FINE)]
        small, large = (
            separately("billion", what="general", mesh=path, sizes=size)[0] for path in paths
        )
    number, torn = large["subdomains"], large["torn"]
    a_torn = {
        name: (large[name] - small[name]) / (torn - small["torn"]) for name in ("set_up", "bytes")
    }
    once = {name: large[name] - a_torn[name] * torn for name in a_torn}
    set_up, size_of_one = (a_torn[name] * torn / number for name in a_torn)
    n = (torn / number / 3.0) ** (1 / 3) - 1.0
    of_one = [large[name] / number for name in ("unknowns", "product", "solve")]
    return plan.Rates(size, n, *of_one, set_up, size_of_one, once["set_up"], once["bytes"])


def check(m: int, n: int) -> dict[str, Any]:
    """Return terms of the model beside what is counted and measured on these ranks. Collective."""
    comm = MPI.COMM_WORLD
    system = communication.dealt(ladder.two_beams(m, n, softer=False), comm)
    counts = communication.measure(system, OPTIONS)
    seconds = comm.allreduce(products(TornSolver(system, OPTIONS)), MPI.MAX)
    model = plan.Model(4.0 * m**3, comm.size, BLOCKS[n])
    # slabs of whole layers, of which each beam has 2 m; the beams touch at nodes of rank 0
    cuts = min(2, max(0, comm.size // 2 - 1)) * plan.cut_rows(m, n)
    nodes = (m * n + 1) ** 2 if comm.size > 1 else 0
    received = float(np.dot(plan.GATHERED, (model.subdomains, comm.size, cuts, nodes)))
    iteration, set_up, faces = counts["iteration"], counts["set-up"], counts["faces"]
    others = sum(set_up[name] for name in ("reductions", "coarse", "pickled"))
    of_faces = counts["mean"]["coarse_bytes"] * (counts["products"] - 1) / faces
    exchanged = plan.EXCHANGES * 8 * (cuts + nodes) + plan.COARSE_SOLVES * 48 * (cuts > 0) * m * m
    pairs = {
        "F + M ms": (1e3 * (plan.OVERHEAD + model.own * model.rates.product), 1e3 * seconds),
        "exchanges": (plan.EXCHANGES, iteration["exchanges"]),
        "coarse solves": (plan.COARSE_SOLVES, iteration["coarse_exchanges"]),
        "kB exchanged": (exchanged / 1e3, iteration["exchange_bytes"] / 1e3),
        "all to all": (plan.ALL_TO_ALL, set_up["all_to_all"]),
        "collective": (plan.COLLECTIVE, others),
        "kB set-up": (received / 1e3, (set_up["pickled_bytes"] + set_up["coarse_bytes"]) / 1e3),
        "kB face": (plan.WHOLE_VECTORS * 48 * model.subdomains / 1e3, of_faces / 1e3),
    }
    row: dict[str, Any] = {"ranks": comm.size, "subdomains": round(model.subdomains), "H/h": n}
    return row | {name: f"{a:.4g} / {b:.4g}" for name, (a, b) in pairs.items()}


def run(
    what="model", subdomains_per_metre=0, elements=(10, 14, 18), sizes=(800, 3000, 6000), mesh=""
):
    """Tabulate the model, or what is measured; of one ladder or mesh where m or it is given."""
    if what == "model":
        blocks = plan.MESHES["blocks"]
        for n, ranks in itertools.product(elements, (10, 100, 1000, 10_000)):
            subdomains = UNKNOWNS / (3.0 * (n + 1) ** 3)
            counts = blocks.products, blocks.faces
            yield row(plan.Model(subdomains, ranks, BLOCKS[n], *counts))
    elif what == "check":
        for n in elements:
            yield check(subdomains_per_metre or 2, n)
    elif what == "general":
        for size in sizes:
            yield measured_general(mesh, size) if mesh else vars(general_rates(size))
    else:
        for n in elements:
            yield measured(subdomains_per_metre, n) if subdomains_per_metre else vars(rates_of(n))

"""A model of the ladder with a billion unknowns on 10 to 10,000 ranks, and checks of its terms.

    python benchmarks/run.py billion                                      # the model
    python benchmarks/run.py billion --what rates [--elements 10 14 18]   # RATES, by one process
    mpirun -n 4 python benchmarks/run.py billion --what check [--subdomains-per-metre 3]

Subdomains, rows, messages and bytes are counted for the geometry of the two beams; processor times
are those of `RATES` and of benchmarks/coarse.py; the machine is `MESSAGE`, `MEMORY`, `NETWORK`. A
check counts and measures terms on the ranks that it runs on, in parts without communication.
"""

from __future__ import annotations

import itertools
import resource
import time
from dataclasses import asdict, dataclass
from typing import Any

from mpi4py import MPI

import communication
import ladder
import numpy as np
from runner import separately

from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.coarse import factor as coarse

CHOICES = {"what": ["model", "rates", "check"]}
UNKNOWNS = 1e9
OPTIONS = Options(rtol=1e-4, dual_operator="explicit", coarse_solver="distributed")
# Assumed: seconds of a message, bytes a second from memory and from the network
MESSAGE, MEMORY, NETWORK = 5e-6, 1e10, 1e9
# Of the ladder with 108 to 2916 subdomains: products with F, faces
ITERATIONS, FACES = 22, 7
# A rank with a cube of subdomains has 26 neighbours; an iteration exchanges multipliers twice,
# coarse unknowns twice, and reduces numbers three times
NEIGHBOURS, EXCHANGES, COARSE_SOLVES, REDUCTIONS = 26, 2, 2, 3
# Collective calls of the set-up: between all pairs of ranks, and others. For each face: gatherings
# of whole coarse vectors, and other calls
ALL_TO_ALL, COLLECTIVE, WHOLE_VECTORS, CALLS = 35, 283, 11, 60
# Bytes received in the set-up for each subdomain of all, rank of all, row of B that crosses to
# other ranks, and contact node: fitted to 2 to 16 ranks
GATHERED = 2064, 12_093, 129, 279
# Bytes kept on every rank for each subdomain of all: coarse vectors and motions of bodies
WHOLE = 508
# Seconds of interpreted code on a rank for each product with F: of F and M, of all in a solve
OVERHEAD, OVERHEAD_OF_SOLVE = 1e-4, 4e-3
# MUMPS: seconds of a factorisation of this size, which grow with its square beyond
FACTORISATION, FACTORED = 12.2, 98_304


@dataclass(frozen=True)
class Rates:
    """Processor seconds and bytes of a subdomain, and seconds and bytes of a rank once."""

    product: float  # F and the preconditioner
    solve: float  # of all that a solve does without communication, for each product with F
    set_up: float
    bytes: float
    once: float  # factor and dense operator of the class
    bytes_once: float  # with interpreter and libraries


# by --what rates --elements 4 6 10 14 18
RATES = {
    4: Rates(1.29e-05, 0.000118, 0.0008, 2.31e05, 0.035, 1.28e08),
    6: Rates(2.67e-05, 0.000136, 0.00126, 3.56e05, 0.052, 1.32e08),
    10: Rates(9.95e-05, 0.0004, 0.00314, 8.29e05, 0.17, 1.54e08),
    14: Rates(0.000246, 0.000806, 0.00684, 1.57e06, 0.87, 2.32e08),
    18: Rates(0.000466, 0.00149, 0.0121, 2.71e06, 2.6, 4.01e08),
}


def cut_rows(b: int, n: int) -> int:
    """Return the rows of B on a plane between b^2 subdomains of n^2 facets and as many others.

    A node of k subdomains has k - 1 rows for each component, and all of them cross the plane. Per
    axis, b (n + 1) nodes of subdomains are b n + 1 nodes of the plane.
    """
    return 3 * (2 * (b * (n + 1)) ** 2 - (b * n + 1) ** 2)


@dataclass(frozen=True)
class Model:
    """Terms of a rank with a cube of subdomains, in a ladder of m^3 subdomains a cubic metre."""

    m: float
    n: int
    ranks: int

    @property
    def subdomains(self) -> float:
        """Number of all subdomains."""
        return 4.0 * self.m**3

    @property
    def own(self) -> float:
        """Number of subdomains of a rank."""
        return self.subdomains / self.ranks

    @property
    def rates(self) -> Rates:
        """Rates for subdomains of this size."""
        return RATES[self.n]

    @property
    def size(self) -> int:
        """Number of coarse unknowns."""
        return int(6 * self.subdomains)

    @property
    def groups(self) -> int:
        """Number of ranks that share the coarse factor."""
        return coarse.choose_groups(self.ranks, self.size)

    @property
    def rows(self) -> int:
        """Rows of B that cross from a rank to others."""
        return 6 * cut_rows(max(1, round(self.own ** (1 / 3))), self.n)

    def collective(self, calls: float, received: float = 0.0) -> float:
        """Return the seconds of calls of log2 P messages each, and of the bytes received."""
        return float(calls * np.log2(self.ranks) * MESSAGE + received / NETWORK)

    @property
    def messages(self) -> float:
        """Seconds of the messages of an iteration, without coarse solves."""
        exchange = NEIGHBOURS * MESSAGE + 8 * self.rows / NETWORK
        return EXCHANGES * exchange + self.collective(REDUCTIONS)

    @property
    def mumps_bytes(self) -> float:
        """Bytes of the part of the factor on one of the ranks that share it."""
        return 8 * coarse._ENTRIES * self.size**1.5 / self.groups

    @property
    def mumps(self) -> float:
        """Seconds of the two solves of an iteration with MUMPS."""
        reading = 2 * self.mumps_bytes * coarse._SLOWER / MEMORY
        return COARSE_SOLVES * (reading + MESSAGE * self._rounds)

    @property
    def factorisation(self) -> float:
        """Seconds of a factorisation by MUMPS."""
        part = FACTORISATION * (self.size / FACTORED) ** 2 * coarse._SLOWER / self.groups
        return part + MESSAGE * coarse._MESSAGES_OF_FACTORISATION * self._rounds

    @property
    def _rounds(self) -> float:
        groups = self.groups
        rounds = (coarse._COLLECTIVES + groups) * np.log2(groups)
        in_groups = 2 * np.log2(self.ranks / groups)
        return float(rounds + coarse._MESSAGES * (groups - 1) + in_groups)

    @property
    def face(self) -> float:
        """Seconds of the messages of a face."""
        return self.collective(CALLS + WHOLE_VECTORS, WHOLE_VECTORS * 8 * self.size)

    @property
    def gathered(self) -> float:
        """Bytes that a rank receives in the set-up."""
        numbers = self.subdomains, self.ranks, self.rows, (self.m * self.n + 1) ** 2
        return float(np.dot(GATHERED, numbers))

    @property
    def set_up_messages(self) -> float:
        """Seconds of the messages of the set-up."""
        return ALL_TO_ALL * self.ranks * MESSAGE + self.collective(COLLECTIVE, self.gathered)

    def row(self) -> dict[str, Any]:
        """Return the row of the table."""
        rates = self.rates
        set_up = rates.once + self.own * rates.set_up
        iteration = OVERHEAD_OF_SOLVE + self.own * rates.solve
        local = set_up + ITERATIONS * iteration
        messages = self.set_up_messages + FACES * self.face + ITERATIONS * self.messages
        with_mumps = FACES * self.factorisation + ITERATIONS * self.mumps
        return {
            "H/h": self.n,
            "subdomains": round(self.subdomains),
            "ranks": self.ranks,
            "own": round(self.own),
            "set-up s": set_up,
            "set-up messages s": self.set_up_messages,
            "iteration ms": 1e3 * iteration,
            "messages ms": 1e3 * self.messages,
            "MUMPS ms": 1e3 * self.mumps,
            "face messages s": self.face,
            "Q": self.groups,
            "face MUMPS s": self.factorisation,
            "GB local": (rates.bytes_once + rates.bytes * self.own) / 1e9,
            "GB whole": WHOLE * self.subdomains / 1e9,
            "GB factor": self.mumps_bytes / 1e9,
            "solve MUMPS s": local + messages + with_mumps,
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


def rates_of(n: int) -> Rates:
    """Return the rates between ladders of 32 and of 256 subdomains, each by its own process."""
    small, large = (
        separately("billion", what="rates", subdomains_per_metre=m, elements=n)[0] for m in (2, 4)
    )
    number = large["subdomains"] - small["subdomains"]
    of_one = {name: (large[name] - small[name]) / number for name in list(small)[2:]}
    once = {name: small[name] - small["subdomains"] * of_one[name] for name in ("set_up", "bytes")}
    return Rates(**of_one, once=once["set_up"], bytes_once=once["bytes"])


def check(m: int, n: int) -> dict[str, Any]:
    """Return terms of the model beside what is counted and measured on these ranks. Collective."""
    comm = MPI.COMM_WORLD
    system = communication.dealt(ladder.two_beams(m, n, softer=False), comm)
    counts = communication.measure(system, OPTIONS)
    seconds = comm.allreduce(products(TornSolver(system, OPTIONS)), MPI.MAX)
    model = Model(m, n, comm.size)
    # slabs of whole layers, of which each beam has 2 m; the beams touch at nodes of rank 0
    cuts = min(2, max(0, comm.size // 2 - 1)) * cut_rows(m, n)
    nodes = (m * n + 1) ** 2 if comm.size > 1 else 0
    received = float(np.dot(GATHERED, (model.subdomains, comm.size, cuts, nodes)))
    iteration, set_up, faces = counts["iteration"], counts["set-up"], counts["faces"]
    others = sum(set_up[name] for name in ("reductions", "coarse", "pickled"))
    of_faces = counts["mean"]["coarse_bytes"] * (counts["products"] - 1) / faces
    exchanged = EXCHANGES * 8 * (cuts + nodes) + COARSE_SOLVES * 48 * (cuts > 0) * m * m
    pairs = {
        "F + M ms": (1e3 * (OVERHEAD + model.own * model.rates.product), 1e3 * seconds),
        "exchanges": (EXCHANGES, iteration["exchanges"]),
        "coarse solves": (COARSE_SOLVES, iteration["coarse_exchanges"]),
        "kB exchanged": (exchanged / 1e3, iteration["exchange_bytes"] / 1e3),
        "all to all": (ALL_TO_ALL, set_up["all_to_all"]),
        "collective": (COLLECTIVE, others),
        "kB set-up": (received / 1e3, (set_up["pickled_bytes"] + set_up["coarse_bytes"]) / 1e3),
        "kB face": (WHOLE_VECTORS * 48 * model.subdomains / 1e3, of_faces / 1e3),
    }
    row: dict[str, Any] = {"ranks": comm.size, "subdomains": round(model.subdomains), "H/h": n}
    return row | {name: f"{a:.4g} / {b:.4g}" for name, (a, b) in pairs.items()}


def run(what="model", subdomains_per_metre=0, elements=(10, 14, 18)):
    """Tabulate the model, or what is measured here; `rates` of one ladder where m is given."""
    if what == "model":
        for n, ranks in itertools.product(elements, (10, 100, 1000, 10_000)):
            yield Model((UNKNOWNS / (12.0 * (n + 1) ** 3)) ** (1 / 3), n, ranks).row()
    elif what == "check":
        for n in elements:
            yield check(subdomains_per_metre or 2, n)
    else:
        for n in elements:
            yield (
                measured(subdomains_per_metre, n)
                if subdomains_per_metre
                else {"H/h": n, **asdict(rates_of(n))}
            )

"""Messages, reductions and bytes per iteration, counted on the communicator.

    mpirun -n 4 python benchmarks/run.py communication [--subdomains-per-metre 3] [--json out.json]

The two beams of `ladder.py`, with the cubes distributed over the ranks. The solver gets a
communicator that records every call. MUMPS uses its own communicators, so its messages in a
distributed coarse solve are not counted here.
"""

from __future__ import annotations

import itertools
import pickle
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, astuple, dataclass, replace
from typing import Any

from mpi4py import MPI

import ladder
import numpy as np

from fenics_tfeti.feti import ContactRows, Options, TornSolver, TornSystem
from fenics_tfeti.feti.constraints.dual_layout import DualLayout
from fenics_tfeti.feti.dual.operator import DualOperator
from fenics_tfeti.feti.solution.outer import LANCZOS_STEPS

METHODS = {
    "active_set": {},
    "smalbe": {"method": "smalbe", "preconditioner": "none"},
    "smalbe, lumped": {"method": "smalbe"},
}

# largest reduction of inner products, in numbers; coarse vectors are longer
_FEW = 8


@dataclass(frozen=True)
class Call:
    """A call of a communicator, or a mark among the calls.

    Bytes are those that this rank receives; messages that it sends are counted in exchanges only.
    """

    kind: str
    messages: int = 0
    bytes: int = 0


class CountingComm(MPI.Intracomm):
    """A communicator that records its calls.

    There is an entry for each collective call and one for each exchange (receives, and what is sent
    before the next receive), and the marks.
    """

    calls: list[Call]

    def __new__(cls, comm: MPI.Intracomm) -> CountingComm:
        self = super().__new__(cls, comm)
        self.calls = []
        self._receiving = False
        return self

    def Irecv(self, buf: Any, *args: Any, **kwargs: Any) -> MPI.Request:
        if not self._receiving:
            of_multipliers = bool(self.calls) and self.calls[-1].kind == "sum"
            self.calls.append(Call("exchange" if of_multipliers else "coarse exchange"))
            self._receiving = True
        last = self.calls[-1]
        self.calls[-1] = replace(last, bytes=last.bytes + size_of(buf))
        return super().Irecv(buf, *args, **kwargs)

    def Isend(self, buf: Any, *args: Any, **kwargs: Any) -> MPI.Request:
        self._receiving = False
        last = self.calls[-1]
        self.calls[-1] = replace(last, messages=last.messages + 1)
        return super().Isend(buf, *args, **kwargs)


def size_of(message: Any) -> int:
    """Return the bytes of a buffer as mpi4py takes it."""
    buffer = message[0] if isinstance(message, list | tuple) else message
    return int(np.asarray(buffer).nbytes)


def _buffered(name: str) -> Callable[..., None]:
    def call(self: CountingComm, send: Any, receive: Any, *args: Any) -> None:
        getattr(MPI.Intracomm, name)(self, send, receive, *args)
        received = size_of(receive)
        few = name == "Allreduce" and received <= 8 * _FEW
        self.calls.append(Call("reduction" if few else "coarse", bytes=received))

    return call


def _pickled(name: str) -> Callable[..., Any]:
    def call(self: CountingComm, *args: Any, **kwargs: Any) -> Any:
        result = getattr(MPI.Intracomm, name)(self, *args, **kwargs)
        kind = "all to all" if name == "alltoall" else "pickled"
        self.calls.append(Call(kind, bytes=len(pickle.dumps(result))))
        return result

    return call


for _name in ("Allreduce", "Allgather", "Allgatherv"):
    setattr(CountingComm, _name, _buffered(_name))
for _name in ("allreduce", "allgather", "alltoall", "bcast", "gather"):
    setattr(CountingComm, _name, _pickled(_name))


@contextmanager
def marks(comm: CountingComm) -> Iterator[None]:
    """Mark products with F and sums of multipliers among the calls."""

    def marked(kind: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            comm.calls.append(Call(kind))
            return original(*args)

        return call

    product, total = DualOperator.part, DualLayout.sum
    DualOperator.part, DualLayout.sum = marked("F", product), marked("sum", total)
    try:
        yield
    finally:
        DualOperator.part, DualLayout.sum = product, total


@dataclass(frozen=True)
class Tally:
    """Counts of some calls."""

    reductions: int  # of a few numbers
    coarse: int  # reductions and gatherings of coarse vectors
    exchanges: int  # of multipliers, with neighbours
    coarse_exchanges: int  # of coarse unknowns
    pickled: int  # collective calls that send objects
    all_to_all: int  # from each rank to each other one
    messages: int  # sent in exchanges
    exchange_bytes: int  # received
    coarse_bytes: int
    pickled_bytes: int


def tally(calls: list[Call]) -> Tally:
    """Count the calls of one rank."""

    def number(kind: str) -> int:
        return sum(c.kind == kind for c in calls)

    def received(*kinds: str) -> int:
        return sum(c.bytes for c in calls if c.kind in kinds)

    return Tally(
        number("reduction"),
        number("coarse"),
        number("exchange"),
        number("coarse exchange"),
        number("pickled"),
        number("all to all"),
        sum(c.messages for c in calls),
        received("exchange", "coarse exchange"),
        received("coarse"),
        received("pickled", "all to all"),
    )


def maxima(comm: MPI.Intracomm, own: Tally) -> Tally:
    """Return the maximum of each number over the ranks."""
    return Tally(*(comm.allreduce(value, MPI.MAX) for value in astuple(own)))


def iterations(calls: list[Call]) -> tuple[Tally, Tally]:
    """Return the calls between products with F: the most frequent counts and the mean."""
    at = [i for i, call in enumerate(calls) if call.kind == "F"]
    between = [tally(calls[i:j]) for i, j in itertools.pairwise(at)]
    usual = Counter(between).most_common(1)[0][0]
    mean = np.array([astuple(t) for t in between]).mean(axis=0)
    return usual, Tally(*mean.tolist())


def dealt(system: TornSystem, comm: MPI.Intracomm) -> TornSystem:
    """Return this rank's part of a system that every rank has completely."""
    ends = len(system.subdomains) * np.arange(comm.size + 1) // comm.size
    share = system.subdomains[ends[comm.rank] : ends[comm.rank + 1]]
    contacts = system.contacts if comm.rank == 0 else ContactRows.none(system.gdim)
    return replace(system, subdomains=share, contacts=contacts, comm=comm)


def measure(system: TornSystem, options: Options) -> dict[str, Any]:
    """Solve a system; return the calls of set-up (with the norm) and iterations."""
    comm = CountingComm(system.comm)
    with marks(comm):
        solver = TornSolver(replace(system, comm=comm), options)
        # the products for the norm belong to the set-up
        solver.setup.norm(LANCZOS_STEPS)
        set_up = list(comm.calls)
        comm.calls.clear()
        report = solver.solve().report
        usual, mean = iterations(comm.calls)
    plain = system.comm
    return {
        "ranks": plain.size,
        "subdomains": report.subdomains,
        "coarse": report.unknowns["coarse"],
        "dual": report.unknowns["dual"],
        "products": report.products["total"],
        "faces": len(report.faces),
        "iteration": asdict(maxima(plain, usual)),
        "mean": asdict(maxima(plain, mean)),
        "set-up": asdict(maxima(plain, tally(set_up))),
    }


CHOICES = {"coarse_solver": ["redundant", "distributed"]}


def run(
    subdomains_per_metre=2, elements_per_subdomain=6, coarse_solver=("redundant", "distributed")
):
    """Solve by each method with each coarse solver: the usual iteration, the mean, the set-up."""
    comm = MPI.COMM_WORLD
    beams = ladder.two_beams(subdomains_per_metre, elements_per_subdomain, softer=False)
    system = dealt(beams, comm)
    for (method, given), solver in itertools.product(METHODS.items(), coarse_solver):
        row = measure(system, Options(coarse_solver=solver, **given))
        yield {"method": method, "coarse solver": solver, **row}

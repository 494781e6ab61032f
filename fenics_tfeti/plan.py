"""``python -m fenics_tfeti.plan``: memory and time of a solve on many ranks, before it is run.

A rank has a cube of subdomains. Processor times and bytes of a subdomain are measured, messages and
bytes that are sent are counted, and the machine's network and memory are assumed: `Machine`. The
documentation's page on a billion unknowns checks each term.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti.coarse import factor as coarse

# A rank with a cube of subdomains has 26 neighbours; an iteration exchanges multipliers twice,
# coarse unknowns twice, and reduces numbers three times
NEIGHBOURS, EXCHANGES, COARSE_SOLVES, REDUCTIONS = 26, 2, 2, 3
# Collective calls of the set-up: between all pairs of ranks, and others. For each face: gatherings
# of whole coarse vectors, and other calls
ALL_TO_ALL, COLLECTIVE, WHOLE_VECTORS, CALLS = 38, 172, 2, 14
# Bytes received in the set-up for each subdomain of all, rank of all, row of B that crosses to
# other ranks, and contact node: fitted to 2 to 16 ranks
GATHERED = 1508, 8785, 215, 373
# Bytes kept on every rank for each subdomain of all: coarse vectors and motions of bodies
WHOLE = 508
# Seconds of interpreted code on a rank for each product with F: of F and M, of all in a solve
OVERHEAD, OVERHEAD_OF_SOLVE = 1e-4, 4e-3
# MUMPS on one rank: seconds of a factorisation of this size, which grow with its square beyond
FACTORISATION, FACTORED = 12.2, 98_304
# Of memory that is measured: what other versions of the libraries have taken
LEAST_BYTES, MOST_BYTES = 0.8, 1.25


@dataclass(frozen=True)
class Machine:
    """Speeds of a machine that a model assumes."""

    processor: float = 1.0  # times of its work over those measured
    message: float = 5e-6  # [s]
    memory: float = 1e10  # bytes a second that a rank reads
    network: float = 1e9  # bytes a second of a rank


# the measured times differ by this factor between machines of ten years, networks by ten
FAST = Machine(0.6, 2e-6, 2e10, 1e10)
SLOW = Machine(1.6, 2e-5, 5e9, 2.5e8)


@dataclass(frozen=True)
class Rates:
    """Processor seconds and bytes of a subdomain, and seconds and bytes of a rank once."""

    subdomain_size: int  # the option
    n: float  # elements along the edge of a cube with as many unknowns
    unknowns: float  # of the mesh, those of each subdomain
    product: float  # F and the preconditioner
    solve: float  # of all that a solve does without communication, for each product with F
    set_up: float
    bytes: float
    once: float  # factor and dense operator that all share
    bytes_once: float  # with interpreter and libraries


def cube(n: int, *measured: float) -> Rates:
    """Return the rates of cubes of n^3 hexahedra."""
    return Rates(3 * n**3, n, 3.0 * n**3, *measured)


@dataclass(frozen=True)
class Mesh:
    """A kind of mesh, how many iterations it takes, and the rates of its subdomains."""

    products: int  # with F
    faces: int
    rates: Sequence[Rates]
    seconds: float = 0.0  # of mesh, spaces and tags for each unknown
    bytes: float = 0.0


MESHES = {
    # benchmarks/run.py billion --what rates --elements 4 6 10 14 18: cubes that share one factor;
    # products and faces of the ladder with 108 to 23,328 subdomains, rtol=1e-4. The mesh is the
    # difference of benchmarks/run.py beams and ladder
    "blocks": Mesh(
        22,
        8,
        [
            cube(4, 6.4e-06, 4.9e-05, 0.00045, 2.20e05, 0.025, 1.28e08),
            cube(6, 1.5e-05, 7.8e-05, 0.00080, 3.36e05, 0.032, 1.32e08),
            cube(10, 6.2e-05, 0.000217, 0.0017, 8.81e05, 0.100, 1.48e08),
            cube(14, 0.000168, 0.000471, 0.0042, 1.62e06, 0.54, 2.28e08),
            cube(18, 0.000352, 0.000974, 0.0089, 2.63e06, 1.8, 4.10e08),
        ],
        2.2e-6,
        207.0,
    ),
    # benchmarks/run.py billion --what general: tetrahedra, with the mesh, of which no two
    # subdomains are equal
    "general": Mesh(
        33,
        4,
        [
            Rates(800, 6.4, 848.0, 7.6e-05, 0.000116, 0.0154, 2.65e06, 0.09, 1.66e08),
            Rates(3000, 8.6, 2009.0, 0.000194, 0.00025, 0.0343, 6.76e06, 0.02, 1.65e08),
            Rates(6000, 12.8, 6782.0, 0.00092, 0.00109, 0.127, 2.50e07, 0.26, 2.08e08),
        ],
    ),
}


def cut_rows(b: int, n: float) -> float:
    """Return the rows of B on a plane between b^2 subdomains of n^2 facets and as many others.

    A node of k subdomains has k - 1 rows for each component, and all of them cross the plane. Per
    axis, b (n + 1) nodes of subdomains are b n + 1 nodes of the plane.
    """
    return 3 * (2 * (b * (n + 1)) ** 2 - (b * n + 1) ** 2)


@dataclass(frozen=True)
class Model:
    """Terms of a rank with a cube of subdomains of a size."""

    subdomains: float  # of all ranks
    ranks: int
    rates: Rates
    products: int = 22
    faces: int = 8
    machine: Machine = field(default_factory=Machine)

    @property
    def own(self) -> float:
        """Number of subdomains of a rank."""
        return self.subdomains / self.ranks

    @property
    def size(self) -> int:
        """Number of coarse unknowns."""
        return int(6 * self.subdomains)

    @property
    def solver(self) -> str:
        """The coarse solver that the package chooses."""
        return coarse.choose_coarse_solver(self.ranks, self.size)

    @property
    def groups(self) -> int:
        """Number of ranks that share the coarse factor."""
        return 1 if self.solver == "redundant" else coarse.choose_groups(self.ranks, self.size)

    @property
    def rows(self) -> float:
        """Rows of B that cross from a rank to others."""
        if self.ranks == 1:
            return 0.0
        return 6 * cut_rows(max(1, round(self.own ** (1 / 3))), self.rates.n)

    def collective(self, calls: float, received: float = 0.0) -> float:
        """Return the seconds of calls of log2 P messages each, and of the bytes received."""
        machine = self.machine
        return float(calls * np.log2(self.ranks) * machine.message + received / machine.network)

    # -- seconds -----------------------------------------------------------------------------------

    @property
    def set_up(self) -> float:
        """Seconds of the set-up without messages."""
        return self.machine.processor * (self.rates.once + self.own * self.rates.set_up)

    @property
    def iteration(self) -> float:
        """Seconds of an iteration without messages and coarse solves."""
        return self.machine.processor * (OVERHEAD_OF_SOLVE + self.own * self.rates.solve)

    @property
    def messages(self) -> float:
        """Seconds of the messages of an iteration, without coarse solves."""
        if self.ranks == 1:
            return 0.0
        machine = self.machine
        exchange = NEIGHBOURS * machine.message + 8 * self.rows / machine.network
        return EXCHANGES * exchange + self.collective(REDUCTIONS)

    @property
    def coarse_solves(self) -> float:
        """Seconds of the two coarse solves of an iteration."""
        reading = 2 * self.coarse_bytes * self._slower / self.machine.memory
        return COARSE_SOLVES * (reading + self.machine.message * self._rounds)

    @property
    def factorisation(self) -> float:
        """Seconds of a factorisation of the coarse matrix."""
        part = FACTORISATION * (self.size / FACTORED) ** 2 * self.machine.processor / self.groups
        part *= self._slower / coarse.SLOWER if self.groups == 1 else self._slower
        messages = coarse.MESSAGES_OF_FACTORISATION * self._rounds
        return part + self.machine.message * messages

    @property
    def face(self) -> float:
        """Seconds of the messages of a face."""
        received = 0 if self.ranks == 1 else WHOLE_VECTORS * 8 * self.size
        return self.collective(CALLS + WHOLE_VECTORS, received)

    @property
    def set_up_messages(self) -> float:
        """Seconds of the messages of the set-up."""
        if self.ranks == 1:
            return 0.0
        pairs = ALL_TO_ALL * self.ranks * self.machine.message
        return pairs + self.collective(COLLECTIVE, self.gathered)

    @property
    def gathered(self) -> float:
        """Bytes that a rank receives in the set-up, with contact nodes as of two beams."""
        nodes = ((self.subdomains / 4.0) ** (1 / 3) * self.rates.n + 1) ** 2
        return float(np.dot(GATHERED, (self.subdomains, self.ranks, self.rows, nodes)))

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds of a solve by what they are spent on."""
        coarse_problem = self.faces * self.factorisation + self.products * self.coarse_solves
        faces, iterations = self.faces * self.face, self.products * self.messages
        return {
            "set-up": self.set_up,
            "iterations": self.products * self.iteration,
            "coarse problem": coarse_problem,
            "messages": self.set_up_messages + faces + iterations,
        }

    # -- bytes of a rank ---------------------------------------------------------------------------

    @property
    def coarse_bytes(self) -> float:
        """Bytes of the part of the coarse factor on one of the ranks that share it."""
        return float(8 * coarse.ENTRIES * self.size**1.5 / self.groups)

    @property
    def bytes(self) -> dict[str, float]:
        """Bytes of a rank by what they are."""
        return {
            "interpreter, libraries": self.rates.bytes_once,
            "subdomains": self.rates.bytes * self.own,
            "whole coarse vectors": WHOLE * self.subdomains,
            "coarse factor": self.coarse_bytes,
        }

    @property
    def _slower(self) -> float:
        """The time of MUMPS over that of CHOLMOD, which the redundant solver takes."""
        return 1.0 if self.solver == "redundant" else float(coarse.SLOWER)

    @property
    def _rounds(self) -> float:
        """Messages one after the other in a coarse solve."""
        if self.solver == "redundant":
            return float(2 * np.log2(self.ranks))
        groups = self.groups
        rounds = (coarse.COLLECTIVES + groups) * np.log2(groups)
        in_groups = 2 * np.log2(self.ranks / groups)
        return float(rounds + coarse.MESSAGES * (groups - 1) + in_groups)


@dataclass(frozen=True)
class Plan:
    """A solve as it is planned: bytes of a rank and seconds, with the spread of all terms."""

    unknowns: float
    model: Model
    mesh: Mesh

    @staticmethod
    def of(unknowns: float, ranks: int, mesh: Mesh, rates: Rates) -> Plan:
        """Return the plan with subdomains of these rates; each rank has one at least."""
        subdomains = max(unknowns / rates.unknowns, ranks)
        model = Model(subdomains, ranks, rates, mesh.products, mesh.faces)
        return Plan(unknowns, model, mesh)

    def seconds(self, machine: Machine | None = None) -> dict[str, float]:
        """Return the seconds on a machine by what they are spent on."""
        machine = machine or self.model.machine
        model = Model(**{**vars(self.model), "machine": machine})
        share = self.unknowns / self.model.ranks
        return {"mesh": machine.processor * self.mesh.seconds * share, **model.seconds}

    @property
    def bytes(self) -> dict[str, float]:
        """Bytes of a rank by what they are."""
        return {**self.model.bytes, "mesh": self.mesh.bytes * self.unknowns / self.model.ranks}


def plans(unknowns: float, ranks: int, mesh: str = "blocks") -> list[Plan]:
    """Return the plans with each size of subdomains that was measured, the fastest first.

    Parameters
    ----------
    unknowns : float
        Displacement components of the mesh.
    ranks : int
        MPI processes.
    mesh : str
        "blocks" where subdomains are equal, as blocks of a grid are, "general" where none are.

    Raises
    ------
    InputError
        If there are fewer unknowns than 1000 for each rank, or no such kind of mesh.

    Examples
    --------
    >>> best = plans(1e8, 512)[0]
    >>> best.model.solver
    'distributed'
    """
    if mesh not in MESHES:
        raise InputError(f"there is no mesh {mesh!r}; there are {', '.join(MESHES)}")
    if ranks < 1 or unknowns < 1000 * ranks:
        raise InputError(
            f"{unknowns:g} unknowns on {ranks} ranks: a rank has one subdomain at least, and a "
            "subdomain 1000 unknowns. Take fewer ranks"
        )
    kind = MESHES[mesh]
    listed = [Plan.of(unknowns, ranks, kind, rates) for rates in kind.rates]
    return sorted(listed, key=lambda plan: sum(plan.seconds().values()))


def describe(listed: Sequence[Plan], name: str) -> str:
    """Return the best of plans as lines to read, and the others in a table."""
    best = listed[0]
    model = best.model
    shared = f"{model.solver}, on {model.groups} ranks" if model.groups > 1 else model.solver
    lines = [
        f"{best.unknowns:,.0f} unknowns, {name} mesh, {model.ranks:,} ranks",
        "",
        f"{'subdomains':>16}  {model.subdomains:,.0f}, {model.own:,.0f} a rank: "
        f"subdomain_size={model.rates.subdomain_size}",
        f"{'coarse problem':>16}  {model.size:,} unknowns, {shared}",
    ]
    for title, unit, scale, parts, ends in (
        ("memory of a rank", "GB", 1e-9, best.bytes, _ends_of_bytes(best)),
        ("seconds", "s", 1.0, best.seconds(), _ends_of_seconds(best)),
    ):
        low, high = (scale * end for end in ends)
        total = scale * sum(parts.values())
        lines.append(f"{title:>16}  {total:.3g} {unit} ({low:.3g} to {high:.3g})")
        lines += [
            f"{'':>16}    {part}: {scale * value:.2g}" for part, value in parts.items() if value
        ]
    lines += ["", f"{'subdomain_size':>16}{'GB a rank':>12}{'seconds':>10}"]
    for plan in listed:
        total, seconds = sum(plan.bytes.values()) / 1e9, sum(plan.seconds().values())
        lines.append(f"{plan.model.rates.subdomain_size:16,}{total:12.3g}{seconds:10.3g}")
    lines += [
        "",
        f"A solve of {model.products} iterations and {model.faces} active sets, as of two beams;",
        "friction and bodies of very different stiffness take more. The spread is that of",
        "processors (0.6 to 1.6 times the time of the measured one), memory "
        f"({LEAST_BYTES} to {MOST_BYTES}",
        "times), messages (2 to 20 us) and networks (0.25 to 10 GB/s a rank).",
    ]
    return "\n".join(lines)


def _ends_of_bytes(plan: Plan) -> tuple[float, float]:
    total = sum(plan.bytes.values())
    return LEAST_BYTES * total, MOST_BYTES * total


def _ends_of_seconds(plan: Plan) -> tuple[float, float]:
    low, high = (sum(plan.seconds(machine).values()) for machine in (FAST, SLOW))
    return low, high


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the plan of a solve."""
    parser = argparse.ArgumentParser(
        prog="python -m fenics_tfeti.plan", description="Memory and time of a solve on many ranks."
    )
    parser.add_argument("--unknowns", type=float, required=True, help="displacement components")
    parser.add_argument("--ranks", type=int, default=1, help="MPI processes")
    parser.add_argument(
        "--mesh",
        choices=list(MESHES),
        default="general",
        help="whether subdomains are equal, as blocks of a grid are",
    )
    given = parser.parse_args(arguments)
    try:
        print(describe(plans(given.unknowns, given.ranks, given.mesh), given.mesh))
    except InputError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()

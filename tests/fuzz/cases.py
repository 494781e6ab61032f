"""One case: draw it, solve it with the package and with the oracle, compare."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import oracle
from outcome import Found, Outcome, agree, attempt, compare
from torn_problems import TornProblem, draw_torn, torn_system

from fenics_tfeti.feti import TornSolver, parse_options

__all__ = ["solve_case", "tell_case"]


def solve_case(level: str, seed: int, comm: MPI.Comm) -> Outcome:
    """Solve the case of a seed on all ranks of a communicator; the outcome is that of rank 0."""
    problem = draw_torn(seed)
    found = attempt(lambda: _solve_torn(problem, comm, seed))
    differ = agree(comm, found)
    if differ:
        return Outcome("ranks differ", differ)
    if comm.rank > 0:
        return Outcome("")
    answer = oracle.solve(problem.glued)
    return compare(problem.glued, answer, found, problem.options["rtol"])


def _solve_torn(problem: TornProblem, comm: MPI.Comm, seed: int) -> Found:
    system, rows = torn_system(problem, comm, seed)
    solution = TornSolver(system, parse_options(problem.options)).solve()
    glued = problem.glued
    n, gdim = glued.load.size, glued.gdim
    place = np.argsort(problem.numbers)
    sums, counts = np.zeros(n), np.zeros(n)
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    for subdomain, u in zip(system.subdomains, solution.displacements, strict=False):
        nodes = place[np.searchsorted(problem.numbers[place], subdomain.nodes)]
        at = (gdim * nodes[:, None] + np.arange(gdim)).ravel()
        sums[at] += u
        counts[at] += 1
        low[at], high[at] = np.minimum(low[at], u), np.maximum(high[at], u)
    force = np.zeros(problem.contacts.slave.size)
    force[rows] = solution.normal_force
    sums, counts, force = (comm.allreduce(x) for x in (sums, counts, force))
    comm.Allreduce(MPI.IN_PLACE, low, MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, high, MPI.MAX)
    jump = (high - low).reshape(-1, gdim).max(axis=1)
    report = solution.report
    return Found(
        sums / counts, jump, force, report.contact_force, report.energy, report.products["total"]
    )


def tell_case(level: str, seed: int) -> None:
    """Print the case of a seed and both solutions."""
    problem = draw_torn(seed)
    print("\n".join(problem.story))
    answer = oracle.solve(problem.glued)
    print(f"oracle: {answer.verdict} {answer.why}")
    found = attempt(lambda: _solve_torn(problem, MPI.COMM_SELF, seed))
    if found.error is not None:
        print(found.trace)
    if answer.verdict == "solution":
        contacts = problem.glued.contact
        print("energy of bodies", answer.energy, "groups", answer.group)
        print("oracle's error", answer.error, "noise", answer.noise)
        print("contact forces:", np.bincount(contacts, weights=answer.force))
        print("        package", found.contact_force, "after", found.products, "products")
        print("largest displacement:", np.abs(answer.displacement).max(), end=" ")
        if found.displacement is not None:
            print("package", np.abs(found.displacement).max())
    outcome = compare(problem.glued, answer, found, problem.options["rtol"])
    print(f"{outcome.kind}: {outcome.detail}\n{outcome.numbers}")

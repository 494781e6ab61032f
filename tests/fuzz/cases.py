"""One case: draw it, solve it with the package and with the oracle, compare."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from mpi4py import MPI

import numpy as np
import oracle
from bad_systems import with_mistake
from friction_oracle import compare_with_friction, is_refused, verdict_with_friction
from glued import GluedProblem, unknowns_of
from numpy.typing import NDArray
from outcome import Found, Outcome, agree, attempt, compare, compare_refused
from torn_problems import TornProblem, draw_torn, torn_system

from fenics_tfeti.errors import NotConverged
from fenics_tfeti.feti import TornSolver, parse_options

Vector = NDArray[np.float64]


# part of the torn systems that are wrong on purpose
MUTATED = 0.05


@dataclass(frozen=True)
class _Case:
    """A case and what the package made of it."""

    found: Found
    glue: Callable[[], GluedProblem]
    rtol: float
    story: list[str]  # what was drawn
    wrong: bool = False  # whether the system was made wrong on purpose
    exact: Any = None  # the problem, with exact non-penetration

    def outcome(self) -> Outcome:
        """Compare with the oracle."""
        if self.wrong:
            return compare_refused(self.found)
        problem = self.glue()
        if self.exact is not None:
            from mesh_options import compare_exact

            rubs = problem.friction is not None
            if rubs and is_refused(problem, self.found):
                return Outcome("right error", self.found.said)
            answer = verdict_with_friction(problem) if rubs else oracle.solve(problem)
            return compare_exact(self.exact, problem.coordinates, answer, self.found)
        if problem.friction is not None:
            return compare_with_friction(problem, self.found, self.rtol)
        return compare(problem, oracle.solve(problem), self.found, self.rtol)


def solve_case(
    level: str, seed: int, comm: MPI.Comm, notes: MPI.Comm, situation: str = ""
) -> Outcome:
    """Solve the case of a seed on all ranks of a communicator; the outcome is that of rank 0.

    `notes` is another communicator of the same ranks, for what they tell each other in the end.
    Of the level "scenes" a situation can be given.
    """
    if level == "scenes":
        from situations import solve_situation

        return solve_situation(seed, comm, notes, situation)[0]
    case = _solve(level, seed, comm)
    differ = agree(notes, case.found)
    if differ:
        return Outcome("ranks differ", differ)
    if comm.rank > 0:
        return Outcome("")
    outcome = case.outcome()
    # those of solutions: without one a limit has ended them
    products = case.found.products if case.found.error is None else 0
    return replace(outcome, numbers={**outcome.numbers, "products": products})


def _solve(level: str, seed: int, comm: MPI.Comm) -> _Case:
    if level == "both":
        level = "mesh" if seed % 5 == 4 else "feti"
    if level == "feti":
        problem = draw_torn(seed)
        wrong = np.random.default_rng([seed, 3]).random() < MUTATED
        found = attempt(lambda: _solve_torn(problem, comm, seed, wrong))
        return _Case(found, lambda: problem.glued, problem.options["rtol"], problem.story, wrong)
    # dolfinx is not needed for the other level
    from mesh_options import draw_mesh_case
    from mesh_problems import glue

    meshed = draw_mesh_case(seed)
    found = attempt(lambda: _solve_mesh(meshed, comm))
    exact = meshed if meshed.gaps is not None else None
    return _Case(found, lambda: glue(meshed), meshed.options["rtol"], meshed.story, exact=exact)


def _solve_torn(problem: TornProblem, comm: MPI.Comm, seed: int, wrong: bool = False) -> Found:
    system, rows, ties, sites = torn_system(problem, comm, seed)
    if wrong and comm.rank == seed % comm.size:
        system = with_mistake(system, np.random.default_rng([seed, 4]))
    solver, error = TornSolver(system, parse_options(problem.options)), None
    try:
        solution = solver.solve()
    except NotConverged as not_converged:
        solution, error = not_converged.solution, not_converged
    glued = problem.glued
    n, gdim = glued.load.size, glued.gdim
    place = np.argsort(problem.numbers)
    sums, counts = np.zeros(n), np.zeros(n)
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    for subdomain, u in zip(system.subdomains, solution.displacements, strict=False):
        nodes = place[np.searchsorted(problem.numbers[place], subdomain.nodes)]
        at = unknowns_of(nodes, gdim)
        sums[at] += u
        counts[at] += 1
        low[at], high[at] = np.minimum(low[at], u), np.maximum(high[at], u)
    force = np.zeros(problem.contacts.size)
    force[rows] = solution.normal_force
    tied = np.zeros(problem.tied.size)
    tied[ties] = solution.tied_force
    tangential = np.zeros(problem.friction.tangents.shape[:2])
    tangential[sites] = solution.tangential_force
    sums, counts, force, tied, tangential = (
        comm.allreduce(x) for x in (sums, counts, force, tied, tangential)
    )
    comm.Allreduce(MPI.IN_PLACE, low, MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, high, MPI.MAX)
    jump = (high - low).reshape(-1, gdim).max(axis=1)
    found = _found(sums / counts, jump, force, solution.report, tied, tangential)
    return replace(found, error=error)


def _solve_mesh(problem: Any, comm: MPI.Comm) -> Found:
    from mesh_options import check_roles, check_weak_motions
    from mesh_problems import contact_places, node_numbers, pose, tangents

    contact_problem, posed = pose(problem, comm)
    uh = contact_problem.solve()
    gdim = problem.gdim
    number = node_numbers(problem, posed.V, posed.cell_tags)
    known = number >= 0
    parts = comm.allgather((number[known], uh.x.array.reshape(-1, gdim)[known]))
    u = np.full((1 + max(nodes.max(initial=-1) for nodes, _ in parts), gdim), np.nan)
    for nodes, values in parts:
        u[nodes] = values
    force, tangential = [np.zeros(0)], [np.zeros((0, gdim - 1))]
    contacts = contact_problem.results
    exchanged = [contact.on_master for contact in contacts]
    check_roles(problem, exchanged)
    places = zip(contact_places(problem, exchanged), contacts, strict=True)
    for number, (slave, contact) in enumerate(places):
        whole = contact.gather()
        nodes = slave.number(whole.coordinates)
        order = np.argsort(nodes)
        assert np.array_equal(nodes[order], slave.nodes), "the contact's nodes"
        force.append(whole.nodal_normal_force[order])
        assert (whole.friction is not None) == (number in problem.friction), "friction"
        # tangents of deformed surfaces are others
        if whole.friction is not None and problem.gaps is None:
            along = tangents(problem, number, whole.coordinates[order, :gdim])
            on_slave = whole.friction.force[order]
            tangential.append(-np.einsum("kta,ka->kt", along, on_slave))
            off = np.abs(on_slave + np.einsum("kta,kt->ka", along, tangential[-1]))
            assert off.max(initial=0.0) <= 1e-12 * np.abs(on_slave).max(initial=0.0), "direction"
    report = contact_problem.report
    check_weak_motions(problem, np.count_nonzero(force[-1]), report.weak_motions)
    none = np.zeros(0)
    forces, rubbing = np.concatenate(force), np.concatenate(tangential)
    return _found(u.ravel(), np.zeros(len(u)), forces, report, none, rubbing)


def _found(
    u: Vector, jump: Vector, force: Vector, report: Any, tied: Vector, tangential: Vector
) -> Found:
    normal = [entry.normal_force for entry in report.contacts]
    products = report.products["total"]
    return Found(u, jump, force, tied, tangential, normal, report.energy, products)


def tell_case(level: str, seed: int, situation: str = "") -> None:
    """Print the case of a seed and both solutions."""
    if level == "scenes":
        from situations import solve_situation

        outcome, story = solve_situation(seed, MPI.COMM_SELF, MPI.COMM_SELF, situation)
        print("\n".join(story))
        print(f"{outcome.kind}: {outcome.detail}\n{outcome.numbers}")
        return
    case = _solve(level, seed, MPI.COMM_SELF)
    print("\n".join(case.story))
    if case.found.error is not None:
        print(case.found.trace)
    if not case.wrong:
        problem = case.glue()
        rubs = problem.friction is not None
        answer = verdict_with_friction(problem) if rubs else oracle.solve(problem)
        print(f"oracle: {answer.verdict} {answer.why}")
        if answer.verdict == "solution" and not rubs:
            _tell_solutions(problem, answer, case.found)
    outcome = case.outcome()
    print(f"{outcome.kind}: {outcome.detail}\n{outcome.numbers}")


def _tell_solutions(problem: GluedProblem, answer: oracle.Answer, found: Found) -> None:
    print("energy of bodies", answer.energy, "groups", answer.group)
    print("oracle's error", answer.error, "noise", answer.noise)
    print("contact forces:", np.bincount(problem.contact, weights=answer.force))
    print("largest displacement:", np.abs(answer.displacement).max(initial=0.0))
    if found.displacement is not None:
        print("the package's:", found.contact_force, np.abs(found.displacement).max(), end=" ")
        print(f"after {found.products} products")

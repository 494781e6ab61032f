"""Some random problems, in a process of their own so that a hang or a crash is an outcome too."""

import json
import subprocess
import sys
from itertools import product
from pathlib import Path

from mpi4py import MPI

import pytest
from cases import solve_case
from drawing import SITUATIONS
from mesh_options import draw_mesh_case
from outcome import FINE
from situations import draw_situation

from fenics_tfeti import Mortar

RUN = Path(__file__).with_name("run.py")


# problems that fail without the mechanism that is named
NEEDS = {
    ("both", 49): "Newton's method where the active set cycles",
    ("both", 67): "the ground of soft springs as unknowns",
    ("both", 121): "motions that supports prescribe, out of the right-hand sides",
    ("both", 162): "free motions of several bodies together",
    ("both", 193): "polished forces of rigid bodies, SMALBE-M",
    ("both", 196): "the solution at rest",
    ("both", 199): "polished forces of rigid bodies",
    ("both", 337): "no bounds of friction from forces that are rounding",
    ("both", 446): "Newton's method where the sets repeat",
    ("both", 525): "a part of the preconditioner of SMALBE-M for dependent rows",
    ("both", 694): "passes without the residual of the recurrences",
    ("both", 961): "passes without the residual of the recurrences",
    ("both", 1059): "passes without the residual of the recurrences",
    ("both", 1078): "methods that take turns",
    ("both", 1129): "springs of a tiny part of the stiffness, as supports",
    ("both", 1783): "no bounds of friction from forces that are rounding",
    ("feti", 318): "rows that stick depend on each other",
    ("feti", 430): "friction on a body at rest",
    ("feti", 725): "the balance of wedged bodies",
    ("feti", 864): "the balance of large forces",
    ("feti", 1037): "no balance of forces that are rounding of gaps",
    ("feti", 1221): "friction much smaller than the load",
    ("feti", 1760): "kinks of the least norm",
    ("feti", 5920): "directions that swing, without preconditioner",
    ("feti", 7884): "directions that swing, with the Dirichlet preconditioner",
    ("feti", 7944): "directions that swing, with a small tolerance",
    ("feti", 50040): "a limit on outer iterations for each step of Coulomb's law",
    ("mesh", 362): "fixed directions of forces with slips out of all proportion",
    ("mesh", 2170): "passes until they fail, not until an estimate of rounding",
    ("feti", 30066): "a motion that closes a far gap which friction keeps from closing, undone",
    ("mesh", 41020): "slips of rows that depend on each other, small beside the motion of the body",
    ("mesh", 90058): "curvatures of slips in passes that start from multipliers",
    ("mesh", 92123): "no certificate where friction at its bounds is out of balance",
}


SLOW = {
    ("both", 49),
    ("both", 525),
    ("both", 694),
    ("both", 1059),
    ("feti", 30066),
    ("feti", 50040),
}


@pytest.mark.once
@pytest.mark.parametrize(
    ("level", "seed"),
    [pytest.param(*case, marks=[pytest.mark.heavy] * (case in SLOW)) for case in NEEDS],
)
def test_problem_that_needs_a_mechanism(level, seed):
    outcome = solve_case(level, seed, MPI.COMM_WORLD, MPI.COMM_SELF)
    assert outcome.kind in ("right", "right error"), f"{NEEDS[level, seed]}: {outcome.detail}"


@pytest.mark.timeout(900)
@pytest.mark.parametrize(("level", "first", "count"), [
    pytest.param("feti", 0, 12, marks=pytest.mark.once),
    ("mesh", 7, 8),
    pytest.param("feti", 0, 160, marks=pytest.mark.heavy),
    pytest.param("mesh", 0, 40, marks=pytest.mark.heavy),
])  # fmt: skip
def test_random_problems(level, first, count, tmp_path):
    results = tmp_path / "results.jsonl"
    command = [sys.executable, str(RUN), "-n", str(count), "--first", str(first)]
    command += ["--level", level, "--jobs", "1"]
    ended = subprocess.run(
        [*command, "--json", str(results)], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, f"{' '.join(command)}\n{ended.stdout}\n{ended.stderr}"
    kinds = [json.loads(line)["kind"] for line in results.read_text().splitlines()]
    assert len(kinds) == count
    # the oracle has to be sure, and the problems are not all of one kind
    assert kinds.count("skipped") <= 0.05 * count
    assert kinds.count("right") >= 0.4 * count
    assert kinds.count("right error") >= 0.05 * count


@pytest.mark.once
@pytest.mark.parametrize("situation", [
    "corners", "cracks", "free_bodies", "given_normal", "interference", "measure_weight",
    "moving_bodies", "pressures", "refused", "several_bodies", "shared_nodes", "sides_in_tag",
    "swapped_contacts", "tied_caps", "tipping", "travelling_plate", "turned_ties",
    "turning_obstacle", "two_rules",
])  # fmt: skip
def test_situation(situation):
    outcome = solve_case("scenes", 0, MPI.COMM_WORLD, MPI.COMM_SELF, situation)
    assert outcome.kind in ("right", "right error"), outcome.detail


def test_situations_are_drawn():
    assert {draw_situation(seed) for seed in range(200)} == set(SITUATIONS)


def test_options_are_drawn():
    problems = [draw_mesh_case(seed) for seed in range(40)]
    given = [pair for problem in problems for pair in problem.pairing.values()]
    rubbing = [one for problem in problems for one in problem.friction.values()]
    assert {one.law for one in rubbing} == {"Tresca", "Coulomb"}
    assert {(pair["partners"], pair["roles"]) for pair in given} == set(
        product((None, Mortar()), ("auto", "given"))
    )
    assert {problem.degree for problem in problems} == {1, 2}
    assert any(problem.slider is not None for problem in problems)
    assert any(problem.gaps is not None for problem in problems)


@pytest.fixture(scope="module")
def notes():
    """The communicator on which the ranks compare what they found."""
    comm = MPI.COMM_WORLD.Dup()
    yield comm
    comm.Free()


# those with friction that failed once; `make fuzz` draws others
@pytest.mark.ranks(2)
@pytest.mark.parametrize("seed", [318, 864, 1760, 7884])
def test_random_problem(seed, notes):
    comm = MPI.COMM_WORLD
    outcome = notes.bcast(solve_case("feti", seed, comm, notes))
    assert outcome.kind in FINE, f"seed {seed}: {outcome.kind}: {outcome.detail}"

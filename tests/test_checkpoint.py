"""Runs that were killed, interrupted or stopped go on to the same answer."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
from killed_run import HEIGHTS, Disc, block, block_on_disc, run
from new_process import mpirun

from fenics_tfeti import Coulomb, InputError, Interrupted, NotConverged, Plane
from fenics_tfeti.feti import save_checkpoint

pytestmark = pytest.mark.once

COMM = MPI.COMM_SELF
SCRIPT = Path(__file__).parent / "support" / "killed_run.py"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return what a run prints that nothing ends."""
    return list(run(block(COMM), tmp_path_factory.mktemp("whole") / "checkpoint.npz"))


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Return a solved problem, and the checkpoint of its solve."""
    path = tmp_path_factory.mktemp("saved") / "checkpoint.npz"
    problem = block_on_disc(block(COMM), Disc())
    problem.solve(checkpoint=path)
    return problem, path


@pytest.fixture
def path(tmp_path):
    return tmp_path / "checkpoint.npz"


def launched(ranks: int, *arguments: object) -> int:
    """Run the script on some ranks; return the exit code."""
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    if ranks > 1:
        command = [*mpirun(), "-n", str(ranks), *command]
    # this process may be a run of MPI itself, which its children must not join
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_", "PMI", "HYDRA"))}
    allowed = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=200, env={**kept, **allowed}
    )
    assert done.returncode in (0, -signal.SIGKILL, 128 + signal.SIGKILL, 9), done.stderr
    return done.returncode


@pytest.mark.parametrize(
    ("ranks", "later", "dies_in"),
    [
        (1, 1, (1, 3)),
        *(
            pytest.param(*case, marks=pytest.mark.heavy)
            for case in [
                (1, 1, (0, 1)),
                (1, 1, (2, 0)),
                (2, 2, (1, 3)),
                (2, 1, (1, 3)),
                (1, 3, (2, 0)),
            ]
        ),
    ],
)
def test_killed_run_goes_on(path, whole, ranks, later, dies_in):
    """SIGKILL in a pass: the step begins again with that pass, and the rest is the same."""
    reports = path.with_name("reports.jsonl")
    assert launched(ranks, path, reports, *dies_in) != 0
    finished = reports.read_text().splitlines() if reports.exists() else []
    assert len(finished) == dies_in[0] and path.exists()
    assert launched(later, path, reports) == 0
    steps = [json.loads(line) for line in reports.read_text().splitlines()]
    assert [step["step"] for step in steps] == list(range(len(HEIGHTS)))
    for found, expected in zip(steps, whole, strict=True):
        for name in ("force", "energy", "size"):
            assert found[name] == pytest.approx(expected[name], rel=1e-6, abs=1e-12)
        assert abs(found["passes"] - expected["passes"]) <= 1


def test_first_solve_after_it_starts_from_the_checkpoint(path, whole):
    steps = run(block(COMM), path)
    next(steps)
    next(steps)
    steps.close()
    (last,) = run(block(COMM), path)
    assert last["step"] == 2 and last["passes"] <= whole[2]["passes"]
    assert last["energy"] == pytest.approx(whole[2]["energy"], rel=1e-8)


def test_passes_of_both_runs_are_in_the_report(path, whole):
    """And the limit on passes counts them all."""
    problem = block_on_disc(block(COMM), moved := Disc())
    moved.height = HEIGHTS[-1]
    passes = []

    def stop(step):
        passes.append(len(problem._accepted.passes))
        if passes[-1] == 3:
            raise Interrupted("here")

    with pytest.raises(Interrupted):
        problem.solve(monitor=stop, checkpoint=path)
    again = block_on_disc(block(COMM), moved)
    assert again.restore(path) == 0
    again.solve()
    assert len(again.report.passes) >= 4
    assert [p.products for p in again.report.passes[:3]] == [
        p.products for p in problem._accepted.passes[:3]
    ]
    errors = [p.error for p in again.report.passes]
    assert errors[-1] <= 1e-8 < min(errors[:-1])


def test_forces_of_all_nodes_are_in_the_checkpoint(path):
    """Also that of the node with the lowest number, at the corner."""
    problem = block_on_disc(block(COMM), floor := Plane((0.0, 0.0), (0.0, 1.0)))
    problem.solve()
    nodes = problem.results[0].nodes
    assert problem._torn.nodes.input_numbers[nodes].min() == 0
    problem.save(path)
    again = block_on_disc(block(COMM), floor)
    again.restore(path)
    (key,), force = problem._torn.undeformed.keys, problem._accepted.force
    assert (force.at(key, nodes) > 0.0).all()
    np.testing.assert_array_equal(again._accepted.force.at(key, nodes), force.at(key, nodes))


def test_interruption_writes_the_checkpoint(path):
    problem = block_on_disc(block(COMM), disc := Disc())
    disc.height = HEIGHTS[-1]
    signals = [signal.SIGINT]

    def interrupt(step):
        # once: a second signal would end the process at once
        while signals:
            os.kill(os.getpid(), signals.pop())

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(Interrupted):
            problem.solve(monitor=interrupt, checkpoint=path)
    finally:
        signal.signal(signal.SIGINT, before)
    again = block_on_disc(block(COMM), disc)
    assert again.restore(path) == 0
    again.solve()
    assert again.report.converged


def test_last_iterate_of_a_limit_is_no_finished_step(path):
    problem = block_on_disc(block(COMM), disc := Disc())
    disc.height = HEIGHTS[-1]
    problem.solve(checkpoint=path)
    kept = path.read_bytes()
    problem.gaps = replace(problem.gaps, max_passes=1)
    disc.height = HEIGHTS[-1] + 0.02
    with pytest.raises(NotConverged):
        problem.solve(checkpoint=path)
    assert path.read_bytes() == kept
    # nor does the next solve count the passes of one that failed
    problem.gaps, disc.height = replace(problem.gaps, max_passes=2), HEIGHTS[-1] + 0.01
    with pytest.raises(NotConverged):
        problem.solve()
    failed = problem.report.passes
    problem.gaps = replace(problem.gaps, max_passes=40)
    problem.solve()
    assert len(failed) == 2 and failed[0] not in problem.report.passes


def test_checkpoints_that_cannot_be_restored(path, saved):
    with pytest.raises(FileNotFoundError):
        block_on_disc(block(COMM), Disc()).restore(path)
    problem, written = saved
    with pytest.raises(InputError, match="not solved yet"):
        problem.restore(written)
    with pytest.raises(InputError, match="the nodes differ"):
        block_on_disc(block(COMM, 8), Disc()).restore(written)
    save_checkpoint(path, problem.system, problem._solver.state)
    with pytest.raises(InputError, match="the format is 'fenics_tfeti checkpoint"):
        block_on_disc(block(COMM), Disc()).restore(path)
    with pytest.raises(InputError, match="nothing to save"):
        block_on_disc(block(COMM), Disc()).save(path)


def test_coordinates_and_contacts_of_another_problem(saved):
    mesh = block(COMM)
    mesh.geometry.x[:, 0] *= 1.0 + 1e-6
    with pytest.raises(InputError, match="the coordinates differ"):
        block_on_disc(mesh, Disc()).restore(saved[1])
    problem = block_on_disc(block(COMM), Disc())
    problem.contacts = []
    problem._refresh()
    with pytest.raises(InputError, match="the contacts differ"):
        problem.restore(saved[1])


def test_other_supports_are_another_start(saved):
    found, other = (block_on_disc(block(COMM), Disc(), held=1, gaps=None) for _ in range(2))
    assert found.restore(saved[1]) == 0
    exact = other.solve()
    np.testing.assert_allclose(found.solve().x.array, exact.x.array, atol=1e-8)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("force_contact", np.array(0), "'force_contact' has shape"),
        ("force_contact", None, "'force_contact' is missing"),
        ("force_contact", 7, "'force_contact' has numbers of no contact"),
        ("displacement", np.zeros((3, 2)), "'displacement' has shape"),
        ("slip_origin", None, "'slip_origin' is missing"),
        ("obstacle", np.zeros(0, dtype=np.int64), "'obstacle' is of type|'obstacle' has shape"),
        ("passes", np.zeros((1, 2)), "'passes' has shape"),
    ],
)
def test_damaged_arrays(path, saved, name, values, message):
    arrays = dict(np.load(saved[1]))
    arrays[name] = np.full_like(arrays[name], values) if isinstance(values, int) else values
    np.savez(path, **{key: array for key, array in arrays.items() if array is not None})
    with pytest.raises(InputError, match=message):
        block_on_disc(block(COMM), Disc()).restore(path)


def test_other_subdomains_start_from_the_contact_forces(path):
    """The first face is the last one of the solution that was saved."""
    disc = Disc()
    disc.height = HEIGHTS[-1]
    solved, other = (
        block_on_disc(block(COMM), disc, subdomain_size=size, gaps=None) for size in (60, 25)
    )
    exact = solved.solve()
    solved.advance()
    solved.save(path)
    assert other.restore(path) == 1
    found = other.solve()
    assert other.report.reused == ["contact guess"]
    assert other.report.faces[0].active == solved.report.unknowns["active"] > 0
    size = np.abs(exact.x.array).max()
    np.testing.assert_allclose(found.x.array, exact.x.array, atol=1e-7 * size)


def test_smalbe_starts_from_nothing_on_other_subdomains(path):
    """With the steps that were finished."""
    problem = block_on_disc(block(COMM), Disc())
    problem.solve()
    problem.advance()
    problem.save(path)
    other = block_on_disc(block(COMM), Disc(), subdomain_size=25, method="smalbe", rtol=1e-6)
    assert other.restore(path) == 1
    other.solve()
    assert other.report.converged and other.report.passes[0].products > 0


def test_other_subdomains_count_slip_from_the_last_step(path):
    def problem(size):
        disc = Disc()
        changes = {"friction": Coulomb(0.3), "gaps": None}
        return disc, block_on_disc(block(COMM), disc, subdomain_size=size, **changes)

    disc, whole = problem(60)
    for disc.height in HEIGHTS[:2]:
        whole.solve()
        whole.advance()
    whole.save(path)
    disc.height = HEIGHTS[2]
    expected = whole.solve().x.array
    found = []
    for from_undeformed in (False, True):
        disc, other = problem(25)
        assert other.restore(path) == 2
        disc.height = HEIGHTS[2]
        if from_undeformed:
            other.reset_slip()
        found.append(other.solve().x.array.copy())
    size = np.abs(expected).max()
    np.testing.assert_allclose(found[0], expected, atol=1e-6 * size)
    assert np.abs(found[1] - expected).max() > 1e-4 * size


def test_unwritable_checkpoint_is_an_error_of_the_solve(tmp_path):
    with pytest.raises(OSError, match="the checkpoint cannot be written"):
        block_on_disc(block(COMM), Disc()).solve(checkpoint=tmp_path / "missing" / "checkpoint.npz")


def test_solution_does_not_depend_on_what_the_checkpoint_holds(path):
    """A checkpoint with other numbers is another start; the certificate decides."""
    problem = block_on_disc(block(COMM), disc := Disc())
    disc.height = HEIGHTS[-1]
    exact = problem.solve(checkpoint=path)
    arrays = dict(np.load(path))
    rng = np.random.default_rng(0)
    arrays["force"] = 1e3 * rng.standard_normal(arrays["force"].size)
    np.savez(path, **arrays)
    again = block_on_disc(block(COMM), disc)
    again.restore(path)
    uh = again.solve()
    np.testing.assert_allclose(uh.x.array, exact.x.array, atol=1e-6 * np.abs(exact.x.array).max())

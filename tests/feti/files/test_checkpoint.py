"""Checkpoints of torn systems: where a later run starts, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from torn import column, with_fields

from fenics_tfeti import InputError
from fenics_tfeti.feti import (
    ContactRows,
    Options,
    Prescribed,
    TornSolver,
    load_checkpoint,
    save_checkpoint,
    save_system,
)

OPTIONS = Options(rtol=1e-8)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "checkpoint.npz"


@pytest.fixture
def saved(path):
    """Return the solver whose state is saved."""
    solver = TornSolver(column(), OPTIONS)
    solver.solve()
    save_checkpoint(path, solver.system, solver.state)
    return solver


def test_another_solver_starts_where_the_first_has_ended(path, saved):
    found = load_checkpoint(path, column())
    np.testing.assert_array_equal(found.multipliers, saved.state.multipliers)
    again = TornSolver(column(), OPTIONS, start=found)
    assert again.reused == ["checkpoint"]
    new, old = again.solve(), saved.solve()
    assert new.report.converged
    assert new.report.products["total"] <= 2
    np.testing.assert_allclose(new.normal_force, old.normal_force, rtol=1e-8)


def test_it_is_the_start_of_other_loads_and_gaps(path, saved):
    system = column(load=(0.3, 0, -2.0))
    system = with_fields(system, "contacts", gap=np.linspace(0, 1e-3, system.contacts.size))
    start = load_checkpoint(path, system)
    found = TornSolver(system, OPTIONS, start=start).solve()
    exact = TornSolver(system, OPTIONS).solve()
    size = exact.normal_force.max()
    np.testing.assert_allclose(found.normal_force, exact.normal_force, atol=1e-6 * size)


def test_multipliers_of_other_rows_are_left_out(saved):
    system = column()
    few = replace(system, contacts=system.contacts.chosen(np.delete(np.arange(16), 5)))
    solver = TornSolver(few, OPTIONS, start=saved.state)
    assert solver.reused == []
    assert solver.solve().report.converged


def test_nothing_to_save_before_the_first_solve():
    with pytest.raises(InputError, match="call solve"):
        _ = TornSolver(column()).state


def other_problems():
    system = column()
    first, *others = system.subdomains
    moved = replace(first, coordinates=first.coordinates + 1e-9)
    fewer = {name: array[:-1] for name, array in vars(system.prescribed).items()}
    return {
        "subdomains": replace(system, subdomains=[moved, *others]),
        "supports": replace(system, prescribed=Prescribed(**fewer)),
        "contacts": replace(system, contacts=system.contacts.chosen(np.arange(5))),
        "tied surfaces": replace(system, tied=system.contacts, contacts=ContactRows.none(3)),
    }


@pytest.mark.parametrize("what", ["subdomains", "supports", "contacts", "tied surfaces"])
def test_checkpoint_of_another_problem_is_refused(path, saved, what):
    system = other_problems()[what]
    wanted = "contacts" if what == "tied surfaces" else what
    with pytest.raises(InputError, match=f"another problem, .*: the {wanted} differ") as caught:
        load_checkpoint(path, system)
    assert str(path) in str(caught.value)


def test_wrong_and_damaged_files_are_refused(path, saved):
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="cut off"):
        load_checkpoint(path, column())
    at = whole.index(saved.state.multipliers.tobytes())
    path.write_bytes(whole[:at] + b"?" + whole[at + 1 :])
    with pytest.raises(InputError, match="'0/multipliers' is damaged"):
        load_checkpoint(path, column())
    save_system(path, column())
    with pytest.raises(InputError, match="the format is 'fenics_tfeti torn system 1'"):
        load_checkpoint(path, column())
    path.write_bytes(whole)
    arrays = dict(np.load(path))
    np.savez(path, **{**arrays, "ranks": np.array(4)})
    with pytest.raises(InputError, match="a run on 4 ranks, this one has 1"):
        load_checkpoint(path, column())
    np.savez(path, **{**arrays, "0/numbers": arrays["0/numbers"][:-1]})
    with pytest.raises(InputError, match="do not fit"):
        load_checkpoint(path, column())
    del arrays["0/multipliers"]
    np.savez(path, **arrays)
    with pytest.raises(InputError, match="'0/multipliers' is missing"):
        load_checkpoint(path, column())

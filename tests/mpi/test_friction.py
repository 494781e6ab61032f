"""Friction on several ranks: the solution of one rank."""

from __future__ import annotations

import dataclasses

from mpi4py import MPI

import numpy as np
import pytest
from friction_problems import (
    STORED,
    blocks_that_do_not_match,
    in_a_groove,
    on_the_ground,
    pulled_strip,
    pushed_block,
)
from sparse_rows import distributed

from fenics_tfeti import UnresistedMotion
from fenics_tfeti.feti import Options, TornSolver, load_system, save_system
from fenics_tfeti.feti.constraints.rows import build_constraints

COMM = MPI.COMM_WORLD
SYSTEMS = {
    "pushed": pushed_block,
    "do not match": blocks_that_do_not_match,
    "ground": on_the_ground,
    "strip": pulled_strip,
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_solution_does_not_depend_on_ranks(name):
    system, options = SYSTEMS[name](), Options(rtol=1e-9, error_if_not_converged=False)
    alone = TornSolver(system, options).solve()
    found = TornSolver(distributed(system, COMM), options).solve()
    size = max(np.abs(u).max() for u in alone.displacements)
    own = alone.displacements[COMM.rank :: COMM.size]
    for u, expected in zip(found.displacements, own, strict=True):
        np.testing.assert_allclose(u, expected, rtol=0.0, atol=1e-8 * size)
    mine = slice(COMM.rank, None, COMM.size)
    largest = np.abs(alone.normal_force).max()
    for force, expected in (
        (found.normal_force, alone.normal_force),
        (found.tangential_force, alone.tangential_force),
    ):
        np.testing.assert_allclose(force, expected[mine], rtol=0.0, atol=1e-6 * largest)
    np.testing.assert_allclose(found.slip, alone.slip[mine], rtol=0.0, atol=1e-8 * size)
    assert found.sticking.tolist() == alone.sticking[mine].tolist()
    for name in ("friction", "sticking", "dual", "inequalities"):
        assert found.report.unknowns[name] == alone.report.unknowns[name]
    np.testing.assert_allclose(
        [c.friction_work for c in found.report.contacts],
        [c.friction_work for c in alone.report.contacts],
        rtol=1e-6,
    )
    np.testing.assert_allclose(found.report.energy, alone.report.energy, rtol=1e-12)


SLOW = {"friction_50076", "friction_50136", "friction_50140", "friction_50220"}


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=[pytest.mark.heavy] * (path.stem in SLOW))
        for path in STORED
    ],
)
def test_dependent_rows_that_stick(path):
    found = TornSolver(load_system(path, COMM)).solve().report
    alone = TornSolver(load_system(path, MPI.COMM_SELF)).solve().report
    assert found.converged
    assert found.energy == pytest.approx(alone.energy, rel=1e-5)


def test_nodes_between_two_planes():
    system = in_a_groove()
    found = TornSolver(distributed(system, COMM), Options(rtol=1e-8)).solve().report
    alone = TornSolver(system, Options(rtol=1e-8)).solve().report
    assert found.energy == pytest.approx(alone.energy, rel=1e-12)


@pytest.mark.parametrize("name", SYSTEMS)
def test_all_rows_of_a_site_are_on_the_same_ranks(name):
    constraints = build_constraints(distributed(SYSTEMS[name](), COMM))[0]
    friction, owned = constraints.friction, constraints.layout.owned
    assert friction.present.all()
    assert np.all((friction.rows < owned).all(axis=1) == (friction.rows < owned).any(axis=1))
    total = COMM.allreduce(int(np.count_nonzero(friction.owned(owned))))
    assert total == SYSTEMS[name]().friction.size


def test_ranks_without_subdomains_or_rows():
    system = on_the_ground()
    here = COMM.rank == COMM.size - 1
    alone = TornSolver(system, Options(rtol=1e-8)).solve()
    empty = dataclasses.replace(
        system,
        subdomains=system.subdomains if here else [],
        contacts=system.contacts if here else system.contacts.chosen(np.zeros(0, int)),
        friction=system.friction if here else type(system.friction).none(3),
        comm=COMM,
    )
    found = TornSolver(empty, Options(rtol=1e-8)).solve()
    assert found.report.energy == pytest.approx(alone.report.energy, rel=1e-12)


def test_load_that_friction_cannot_hold_is_an_error_on_all_ranks():
    system = distributed(on_the_ground(bound=0.003), COMM)
    with pytest.raises(UnresistedMotion, match=r"It would take 1\.333 times the slip bounds"):
        TornSolver(system)


def test_friction_in_a_file(tmp_path):
    """Rows are written in the order of ranks, and dealt out to them in blocks."""
    path = COMM.bcast(tmp_path / "system.npz")
    system = blocks_that_do_not_match()
    save_system(path, distributed(system, COMM))
    read = load_system(path, COMM)
    assert COMM.allreduce(read.friction.size) == system.friction.size
    found, exact = (TornSolver(s, Options(rtol=1e-8)).solve().report for s in (read, system))
    assert found.energy == pytest.approx(exact.energy, rel=1e-12)
    assert found.unknowns["sticking"] == exact.unknowns["sticking"]

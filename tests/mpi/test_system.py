"""Mistakes in the data of one rank are errors on all ranks, with the same message."""

from __future__ import annotations

import dataclasses

from mpi4py import MPI

import numpy as np
import pytest
from bad_systems import MISTAKES, column_on

from fenics_tfeti import InputError
from fenics_tfeti.feti import ContactGuess, ContactRows, Prescribed, TornSolver, TornSystem
from fenics_tfeti.feti.checks.system import check_system

comm = MPI.COMM_WORLD
LAST = comm.rank == comm.size - 1
several_ranks = pytest.mark.skipif(comm.size == 1, reason="needs two ranks")


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)
def test_mistake_of_one_rank_is_named_on_all(mistake):
    system = column_on(comm)
    with pytest.raises(InputError) as raised:
        TornSolver(mistake.make(system) if LAST else system)
    message = str(raised.value).replace(f" of rank {comm.size - 1}", "")
    assert [word for word in mistake.words if word not in message] == [], message
    assert len(set(comm.allgather(message))) == 1


def test_right_system_passes():
    check_system(column_on(comm))


@several_ranks
def test_rank_is_named():
    system = column_on(comm)
    if LAST:
        changed = dataclasses.replace(system.subdomains[0], body=-1)
        system = dataclasses.replace(system, subdomains=[changed])
    with pytest.raises(InputError, match=f"body of subdomain 0 of rank {comm.size - 1} "):
        check_system(system)


@several_ranks
def test_dimensions_of_the_ranks_differ():
    contacts = ContactRows.none(2 + LAST)
    with pytest.raises(InputError, match="gdim differs between the ranks: 2,.*3"):
        check_system(TornSystem([], Prescribed(), contacts, 2 + LAST, comm=comm))


def test_no_subdomains_on_any_rank():
    with pytest.raises(InputError, match="no subdomains"):
        check_system(TornSystem([], Prescribed(), ContactRows.none(3), 3, comm=comm))


def test_rank_without_subdomains():
    system = column_on(MPI.COMM_SELF)
    if comm.rank > 0:
        system = TornSystem([], Prescribed(), ContactRows.none(3), 3)
    system = dataclasses.replace(system, comm=comm)
    check_system(system)
    solution = TornSolver(system).solve()
    assert len(solution.displacements) == len(solution.torn_displacements) == len(system.subdomains)


@several_ranks
def test_guess_of_one_rank():
    system = column_on(comm)
    rows = system.contacts.size
    guess = ContactGuess(np.zeros(rows), np.zeros(rows)) if LAST else None
    with pytest.raises(InputError, match="guess: this rank gives none, others do"):
        TornSolver(system, guess=guess)

"""The check of a torn system: mistakes are named, and what is unusual but right is accepted."""

import dataclasses

from mpi4py import MPI

import numpy as np
import pytest
import scipy.sparse as sp
from bad_systems import MISTAKES, column_on
from torn import column, cube

from fenics_tfeti import InputError
from fenics_tfeti.feti import (
    ContactGuess,
    ContactRows,
    Prescribed,
    Subdomain,
    TornSolver,
    TornSystem,
)
from fenics_tfeti.feti.checks.system import check_guess, check_system

pytestmark = pytest.mark.once

COMM = MPI.COMM_WORLD
LAST = COMM.rank == COMM.size - 1


@pytest.mark.ranks
@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake[1])
def test_mistake_of_one_rank_is_named_on_all(mistake):
    change, *words = mistake
    system = column_on(COMM)
    with pytest.raises(InputError) as raised:
        TornSolver(change(system) if LAST else system)
    message = str(raised.value).replace(f" of rank {COMM.size - 1}", "")
    assert [word for word in words if word not in message] == [], message
    assert len(set(COMM.allgather(message))) == 1


@pytest.mark.ranks
def test_right_system_passes():
    check_system(column_on(COMM))


@pytest.mark.ranks
def test_no_subdomains():
    with pytest.raises(InputError, match="no subdomains.*at least one"):
        check_system(TornSystem([], Prescribed(), ContactRows.none(3), 3, comm=COMM))


def test_subdomain_in_two_parts_that_elastic_supports_hold():
    one, other = cube(1), cube(1, (5, 0, 0))
    K = sp.block_diag([one.stiffness, other.stiffness], format="csr") + 0.1 * sp.identity(48)
    both = Subdomain(
        K.tocsr(),
        np.concatenate([one.load, other.load]),
        np.concatenate([one.coordinates, other.coordinates]),
        np.concatenate([one.nodes, other.nodes]),
        0,
    )
    check_system(TornSystem([both], Prescribed(), ContactRows.none(3), 3))


@pytest.mark.parametrize(("force", "gap", "message"), [
    ([0.0, 0.0], 3 * [0.0], r"normal_force .* shape \(2,\), expected \(3,\)"),
    (3 * [0.0], 4 * [0.0], r"gap .* shape \(4,\), expected \(3,\)"),
    ([0.0, np.inf, 1.0], 3 * [0.0], "normal_force .* 1 of 3 numbers are NaN"),
    (3 * [0.0], [0.0, np.nan, 1.0], "gap .* 1 of 3 gaps are NaN"),
])  # fmt: skip
def test_wrong_guess(force, gap, message):
    with pytest.raises(InputError, match=message):
        check_guess(ContactGuess(np.array(force), np.array(gap)), 3)
    check_guess(ContactGuess(np.zeros(3), np.array([0.0, np.inf, 1.0])), 3)


@pytest.mark.parametrize("contacts", [None, np.zeros(3)], ids=["none", "array"])
def test_system_is_checked_before_the_guess(contacts):
    system = dataclasses.replace(column(), contacts=contacts)
    guess = ContactGuess(np.zeros(2), np.zeros(2))
    with pytest.raises(InputError, match="contacts: got .* expected ContactRows"):
        TornSolver(system, guess=guess)


@pytest.mark.parametrize(("arguments", "message"), [
    ({"system": None}, "system: got NoneType, expected a TornSystem"),
    ({"options": {"rtol": 1e-3}}, "options: got dict, .* parse_options"),
    ({"guess": "all closed"}, "guess: got str, expected a ContactGuess"),
])  # fmt: skip
def test_arguments_of_wrong_types(arguments, message):
    with pytest.raises(InputError, match=message):
        TornSolver(**{"system": column(), **arguments})


@pytest.mark.ranks(2)
def test_rank_is_named():
    system = column_on(COMM)
    if LAST:
        changed = dataclasses.replace(system.subdomains[0], body=-1)
        system = dataclasses.replace(system, subdomains=[changed])
    with pytest.raises(InputError, match=f"body of subdomain 0 of rank {COMM.size - 1} "):
        check_system(system)


@pytest.mark.ranks(2)
def test_dimensions_of_the_ranks_differ():
    contacts = ContactRows.none(2 + LAST)
    with pytest.raises(InputError, match="gdim differs between the ranks: 2,.*3"):
        check_system(TornSystem([], Prescribed(), contacts, 2 + LAST, comm=COMM))


@pytest.mark.ranks(2)
def test_rank_without_subdomains():
    system = column_on(MPI.COMM_SELF)
    if COMM.rank > 0:
        system = TornSystem([], Prescribed(), ContactRows.none(3), 3)
    system = dataclasses.replace(system, comm=COMM)
    check_system(system)
    solution = TornSolver(system).solve()
    assert len(solution.displacements) == len(solution.torn_displacements) == len(system.subdomains)


@pytest.mark.ranks(2)
def test_guess_of_one_rank():
    system = column_on(COMM)
    rows = system.contacts.size
    guess = ContactGuess(np.zeros(rows), np.zeros(rows)) if LAST else None
    with pytest.raises(InputError, match="guess: this rank gives none, others do"):
        TornSolver(system, guess=guess)

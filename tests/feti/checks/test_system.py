"""The check of a torn system: mistakes are named, and what is unusual but right is accepted."""

from __future__ import annotations

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


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)
def test_mistake_is_named(mistake):
    with pytest.raises(InputError) as raised:
        TornSolver(mistake.make(column_on(MPI.COMM_SELF)))
    message = str(raised.value)
    assert [word for word in mistake.words if word not in message] == [], message


def test_right_system_passes():
    check_system(column_on(MPI.COMM_SELF))


def test_no_subdomains():
    with pytest.raises(InputError, match="no subdomains.*at least one"):
        check_system(TornSystem([], Prescribed(), ContactRows.none(3), 3))


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


@pytest.mark.parametrize(
    ("force", "gap", "message"),
    [
        (np.zeros(2), np.zeros(3), r"normal_force .* shape \(2,\), expected \(3,\)"),
        (np.zeros(3), np.zeros(4), r"gap .* shape \(4,\), expected \(3,\)"),
        (np.array([0.0, np.inf, 1.0]), np.zeros(3), "normal_force .* 1 of 3 numbers are NaN"),
        (np.zeros(3), np.array([0.0, np.nan, 1.0]), "gap .* 1 of 3 gaps are NaN"),
    ],
)
def test_wrong_guess(force, gap, message):
    with pytest.raises(InputError, match=message):
        check_guess(ContactGuess(force, gap), 3)


def test_gaps_of_a_guess_may_be_infinite():
    check_guess(ContactGuess(np.zeros(2), np.array([0.0, np.inf])), 2)


def test_guess_of_a_wrong_type():
    with pytest.raises(InputError, match="guess: got str, expected a ContactGuess"):
        TornSolver(column(), guess="all closed")


@pytest.mark.parametrize("contacts", [None, np.zeros(3)], ids=["none", "array"])
def test_system_is_checked_before_the_guess(contacts):
    system = dataclasses.replace(column(), contacts=contacts)
    guess = ContactGuess(np.zeros(2), np.zeros(2))
    with pytest.raises(InputError, match="contacts: got .* expected ContactRows"):
        TornSolver(system, guess=guess)


def test_arguments_of_wrong_types():
    with pytest.raises(InputError, match="system: got NoneType, expected a TornSystem"):
        TornSolver(None)
    with pytest.raises(InputError, match="options: got dict, .* parse_options"):
        TornSolver(column(), {"rtol": 1e-3})

"""A complete check of a torn system: each mistake is named before anything is computed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from torn import column

from fenics_tfeti import InputError
from fenics_tfeti.feti import ContactGuess, ContactRows, TornSystem

SYSTEM = column()


def with_subdomain(**parts) -> TornSystem:
    """Return the system with parts of its second subdomain replaced."""
    first, second, *others = SYSTEM.subdomains
    return replace(SYSTEM, subdomains=[first, replace(second, **parts), *others])


def with_contacts(**parts) -> TornSystem:
    return replace(SYSTEM, contacts=replace(SYSTEM.contacts, **parts))


def with_entry(array, value: float):
    """Return a copy with one entry replaced."""
    changed = array.copy()
    changed.ravel()[4] = value
    return changed


def with_stiffness(row: int, column: int, value: float) -> TornSystem:
    K = SYSTEM.subdomains[1].stiffness.tolil()
    K[row, column] = value
    return with_subdomain(stiffness=K.tocsr())


SECOND = SYSTEM.subdomains[1]
MISTAKES = {
    "stiffness of a wrong shape": (
        with_subdomain(stiffness=SECOND.stiffness[:-1]),
        r"subdomain 1 \(body 0\): stiffness has shape \(191, 192\), expected \(192, 192\)",
    ),
    "load of a wrong shape": (
        with_subdomain(load=SECOND.load[:-1]),
        r"subdomain 1 .*: load has shape \(191,\), expected \(192,\)",
    ),
    "coordinates of a wrong shape": (
        with_subdomain(coordinates=SECOND.coordinates[:, :2]),
        r"subdomain 1 .*: coordinates has shape \(64, 2\), expected \(64, 3\)",
    ),
    "NaN in the stiffness": (
        with_stiffness(3, 3, np.nan),
        r"stiffness of subdomain 1 .* 1 of \d+ numbers are NaN or infinite",
    ),
    "infinite load": (
        with_subdomain(load=with_entry(SECOND.load, np.inf)),
        "load of subdomain 1 .* 1 of 192 numbers are NaN or infinite",
    ),
    "NaN in the coordinates": (
        with_subdomain(coordinates=with_entry(SECOND.coordinates, np.nan)),
        "coordinates of subdomain 1 .* 1 of 192 numbers",
    ),
    "stiffness that is not symmetric": (
        with_stiffness(0, 1, 1.0),
        r"not symmetric: in subdomain 1 \(body 0\)",
    ),
    "NaN in a prescribed displacement": (
        replace(
            SYSTEM,
            prescribed=replace(
                SYSTEM.prescribed, values=with_entry(SYSTEM.prescribed.values, np.nan)
            ),
        ),
        "prescribed displacements: 1 of 80 numbers",
    ),
    "NaN in a gap": (
        with_contacts(gap=with_entry(SYSTEM.contacts.gap, np.nan)),
        "contact gaps: 1 of 16 numbers",
    ),
    "NaN in a normal": (
        with_contacts(normal=with_entry(SYSTEM.contacts.normal, np.nan)),
        "contact normals: 1 of 48 numbers",
    ),
    "normal of another length": (
        with_contacts(normal=with_entry(SYSTEM.contacts.normal, 0.5)),
        r"1 contact normals are not of unit length, .* slave node \d+ with length 1.118e\+00",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistake(name):
    system, message = MISTAKES[name]
    with pytest.raises(InputError, match=message):
        system.check()


def test_system_without_a_mistake():
    SYSTEM.check()


def test_stiffness_is_not_checked_again():
    with_stiffness(0, 1, 1.0).check(stiffness=False)


def test_name_of_a_body():
    assert SYSTEM.body_name(1) == "upper"
    assert SYSTEM.body_name(7) == "body 7"


def test_no_contact_rows():
    none = ContactRows.none(2)
    assert none.normal.shape == (0, 2)
    assert none.slave.size == none.master.size == none.gap.size == none.contact.size == 0


@pytest.mark.parametrize(
    ("force", "gap", "message"),
    [
        (np.zeros(2), np.zeros(3), r"normal forces .* shape \(2,\), expected \(3,\)"),
        (np.zeros(3), np.zeros(4), r"gaps .* shape \(4,\), expected \(3,\)"),
        (np.array([0.0, np.inf, 1.0]), np.zeros(3), "normal forces .* 1 of 3 numbers are NaN"),
        (np.zeros(3), np.array([0.0, np.nan, 1.0]), "gaps .* 1 are NaN"),
    ],
)
def test_wrong_guess(force, gap, message):
    with pytest.raises(InputError, match=message):
        ContactGuess(force, gap).check(3)


def test_gaps_of_a_guess_may_be_infinite():
    ContactGuess(np.zeros(2), np.array([0.0, np.inf])).check(2)

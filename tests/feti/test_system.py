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
    Options,
    Prescribed,
    Subdomain,
    TornSolver,
    TornSystem,
)
from fenics_tfeti.feti.system_checks import check_guess, check_system


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)
def test_mistake_is_named(mistake):
    with pytest.raises(InputError) as raised:
        TornSolver(mistake.make(column_on(MPI.COMM_SELF)))
    message = str(raised.value)
    assert [word for word in mistake.words if word not in message] == [], message


def test_right_system_passes():
    check_system(column_on(MPI.COMM_SELF))


@pytest.mark.parametrize("comm", [None, MPI.COMM_NULL, "world"], ids=["none", "null", "text"])
def test_communicator(comm):
    with pytest.raises(InputError, match="comm: got .*intracommunicator"):
        TornSystem([], Prescribed(), ContactRows.none(3), 3, comm=comm)


def test_no_subdomains():
    with pytest.raises(InputError, match="no subdomains.*at least one"):
        check_system(TornSystem([], Prescribed(), ContactRows.none(3), 3))


def as_lists(system: TornSystem) -> TornSystem:
    """Return the same system from lists, 32 bit integers and whole numbers."""
    return TornSystem(
        tuple(
            Subdomain(
                sp.csr_array(s.stiffness),
                s.load.tolist(),
                s.coordinates.tolist(),
                s.nodes.astype(np.uint32),
                np.int32(s.body),
            )
            for s in system.subdomains
        ),
        Prescribed(
            system.prescribed.nodes.tolist(),
            system.prescribed.components.astype(np.int8),
            [0] * system.prescribed.values.size,
        ),
        ContactRows(
            system.contacts.offsets.tolist(),
            system.contacts.nodes.astype(np.int32),
            system.contacts.coefficients.tolist(),
            system.contacts.gap.astype(np.float32),
            [0] * system.contacts.gap.size,
        ),
        np.int64(3),
    )


def test_lists_and_other_integers_are_converted():
    expected, found = TornSolver(column()).solve(), TornSolver(as_lists(column())).solve()
    np.testing.assert_allclose(found.normal_force, expected.normal_force, rtol=1e-12)
    assert found.report.products == expected.report.products


def test_arrays_of_the_right_type_stay_the_same_objects():
    nodes, load, K = np.arange(8), np.zeros(24), cube(1).stiffness
    subdomain = Subdomain(K, load, cube(1).coordinates, nodes, 0)
    assert subdomain.nodes is nodes
    assert subdomain.load is load
    assert subdomain.stiffness is K


def unsorted(K: sp.csr_matrix) -> sp.csr_matrix:
    """Return K with the entries of each row in the opposite order, the first in two halves."""
    data, indices, indptr = K.data[::-1], K.indices[::-1], K.indptr[-1] - K.indptr[::-1]
    turned = sp.csr_matrix((data, K.shape[0] - 1 - indices, indptr), K.shape)
    data, indices = turned.data.copy(), turned.indices
    data = np.concatenate([[0.5 * data[0], 0.5 * data[0]], data[1:]])
    indices = np.concatenate([[indices[0], indices[0]], indices[1:]])
    return sp.csr_matrix((data, indices, np.append(0, turned.indptr[1:] + 1)), K.shape)


def test_repeated_and_unsorted_entries_are_merged():
    K = cube(1).stiffness
    reverse = np.arange(24)[::-1]
    messy = unsorted(K[reverse][:, reverse].tocsr())
    np.testing.assert_allclose(messy.toarray(), K.toarray(), atol=1e-16)
    assert not messy.has_canonical_format
    subdomain = dataclasses.replace(cube(1), stiffness=messy)
    assert subdomain.stiffness is messy
    assert messy.has_canonical_format
    np.testing.assert_allclose(messy.toarray(), K.toarray(), atol=1e-16)


def test_repeated_entries_that_cannot_be_merged_in_place():
    reverse = np.arange(24)[::-1]
    messy = unsorted(cube(1).stiffness[reverse][:, reverse].tocsr())
    for array in (messy.data, messy.indices, messy.indptr):
        array.flags.writeable = False
    subdomain = dataclasses.replace(cube(1), stiffness=messy)
    with pytest.raises(InputError, match="stiffness of subdomain 0.*repeated.*sum_duplicates"):
        check_system(TornSystem([subdomain], Prescribed(), ContactRows.none(3), 3))


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


# -- bodies in the plane: triangles of springs -----------------------------------------------------


def triangle(points, nodes, body: int = 0) -> Subdomain:
    """Return a triangle of three springs along its sides; its kernel is that of elasticity."""
    x = np.array(points, float)
    K = np.zeros((6, 6))
    for i, j in ((0, 1), (1, 2), (2, 0)):
        along = (x[j] - x[i]) / np.linalg.norm(x[j] - x[i])
        b = np.zeros(6)
        b[2 * i : 2 * i + 2], b[2 * j : 2 * j + 2] = -along, along
        K += np.outer(b, b)
    return Subdomain(sp.csr_matrix(K), np.zeros(6), x, np.array(nodes), body)


A, B, C, D, E, F = (0, 0), (2, 0), (1, 2), (1, -1), (3, 2), (-1, 2)


def in_the_plane(*triangles: Subdomain) -> TornSystem:
    return TornSystem(triangles, Prescribed(), ContactRows.none(2), 2)


def test_two_common_nodes_make_two_triangles_rigid():
    check_system(in_the_plane(triangle([A, B, C], [0, 1, 2]), triangle([A, B, D], [0, 1, 3])))


def test_three_hinges_make_three_triangles_rigid():
    check_system(
        in_the_plane(
            triangle([A, B, D], [0, 1, 3]),
            triangle([B, C, E], [1, 2, 4]),
            triangle([A, C, F], [0, 2, 5]),
        )
    )


def test_two_hinges_leave_three_triangles_movable():
    with pytest.raises(InputError, match="body 0.*hinged"):
        check_system(
            in_the_plane(
                triangle([A, B, D], [0, 1, 3]),
                triangle([B, C, E], [1, 2, 4]),
                triangle([A, C, F], [0, 6, 5]),
            )
        )


def test_bodies_of_their_own_need_no_connection():
    check_system(
        in_the_plane(triangle([A, B, C], [0, 1, 2]), triangle([A, B, D], [3, 4, 5], body=1))
    )


def test_infinite_gaps_bear_no_force():
    system = column()
    rows = system.contacts
    expected = TornSolver(system, Options(rtol=1e-8)).solve()
    far = ContactRows.node_to_node(
        rows.slave, -np.ones_like(rows.slave), rows.normal, rows.gap + np.inf, rows.contact
    )
    both = ContactRows.concatenate([rows, far])
    found = TornSolver(dataclasses.replace(system, contacts=both), Options(rtol=1e-8)).solve()
    k = rows.size
    np.testing.assert_allclose(found.normal_force[:k], expected.normal_force, rtol=1e-10)
    assert not found.normal_force[k:].any()
    assert not found.active[k:].any()
    assert found.report.products == expected.report.products


def test_name_of_a_body():
    assert column().body_name(1) == "upper"
    assert column().body_name(7) == "body 7"


def test_no_contact_rows():
    none = ContactRows.none(2)
    assert none.normal.shape == (0, 2)
    assert none.slave.size == none.nodes.size == none.gap.size == none.contact.size == 0


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

"""The torn system: conversion of its fields, and names."""

from __future__ import annotations

import dataclasses

from mpi4py import MPI

import numpy as np
import pytest
import scipy.sparse as sp
from torn import column, cube

from fenics_tfeti import InputError
from fenics_tfeti.feti import ContactRows, Options, Prescribed, Subdomain, TornSolver, TornSystem
from fenics_tfeti.feti.checks.system import check_system
from fenics_tfeti.feti.system import node_graph


def test_nodes_of_one_element_are_neighbours():
    graph = node_graph(cube(2).stiffness, 3).toarray()
    corner, centre = graph[0], graph[13]
    assert np.flatnonzero(corner).tolist() == [0, 1, 3, 4, 9, 10, 12, 13]
    assert centre.tolist() == [1.0] * 27


@pytest.mark.parametrize("comm", [None, MPI.COMM_NULL, "world"], ids=["none", "null", "text"])
def test_communicator(comm):
    with pytest.raises(InputError, match="comm: got .*intracommunicator"):
        TornSystem([], Prescribed(), ContactRows.none(3), 3, comm=comm)


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


def messy_stiffness() -> sp.csr_matrix:
    """Return K with the entries of each row in the opposite order, the first in two halves."""
    K = cube(1).stiffness
    data, indices = K.data.copy(), K.indices.copy()
    for begin, end in zip(K.indptr[:-1], K.indptr[1:], strict=True):
        data[begin:end], indices[begin:end] = data[begin:end][::-1], indices[begin:end][::-1]
    data = np.concatenate([[0.5 * data[0], 0.5 * data[0]], data[1:]])
    indices = np.concatenate([[indices[0], indices[0]], indices[1:]])
    return sp.csr_matrix((data, indices, np.append(0, K.indptr[1:] + 1)), K.shape)


def test_repeated_and_unsorted_entries_are_merged():
    K, messy = cube(1).stiffness, messy_stiffness()
    np.testing.assert_allclose(messy.toarray(), K.toarray(), atol=1e-16)
    assert not messy.has_canonical_format
    subdomain = dataclasses.replace(cube(1), stiffness=messy)
    assert subdomain.stiffness is messy
    assert messy.has_canonical_format
    np.testing.assert_allclose(messy.toarray(), K.toarray(), atol=1e-16)


def test_repeated_entries_that_cannot_be_merged_in_place():
    messy = messy_stiffness()
    for array in (messy.data, messy.indices, messy.indptr):
        array.flags.writeable = False
    subdomain = dataclasses.replace(cube(1), stiffness=messy)
    with pytest.raises(InputError, match="stiffness of subdomain 0.*repeated.*sum_duplicates"):
        check_system(TornSystem([subdomain], Prescribed(), ContactRows.none(3), 3))


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


def test_names_of_bodies_and_no_contact_rows():
    assert [column().body_name(i) for i in (1, 7)] == ["upper", "body 7"]
    none = ContactRows.none(2)
    assert none.normal.shape == (0, 2)
    assert none.slave.size == none.nodes.size == none.gap.size == none.contact.size == 0

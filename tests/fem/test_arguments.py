"""Arguments whose meaning is clear are taken; tests/test_errors.py has those that are mistakes."""

from __future__ import annotations

import dataclasses

from mpi4py import MPI

import numpy as np
import pytest
import scenes

import ufl

from fenics_tfeti import RigidObstacle


def block():
    return scenes.pressed_block(MPI.COMM_SELF, "quadrilateral")


LOADS = [
    pytest.param(0, id="0"),
    pytest.param(0.0, id="0.0"),
    pytest.param(ufl.Form([]), id="empty"),
]
if hasattr(ufl, "ZeroBaseForm"):
    LOADS.append(pytest.param(ufl.ZeroBaseForm(()), id="ZeroBaseForm"))


@pytest.mark.parametrize("zero", LOADS)
def test_no_load(zero):
    scene = block()
    scene.L = zero
    problem = scene.problem()
    problem.solve()
    np.testing.assert_allclose(problem.report.contact_force, scene.total_forces, rtol=1e-8)
    problem.solve()
    assert "multipliers" in problem.report.reused


def test_one_contact_without_a_list():
    scene = block()
    (contact,) = scene.package_contacts()
    problem = scene.problem(contacts=contact)
    assert problem.contacts == [contact]
    problem.solve()
    np.testing.assert_allclose(problem.report.contact_force, scene.total_forces, rtol=1e-8)
    problem.contacts = contact
    problem.solve()
    assert problem.contacts == [contact]


def test_one_condition_without_a_list():
    scene = block()
    problem = scene.problem(bcs=scene.bcs[0])
    assert problem.bcs == [scene.bcs[0]]


def test_no_conditions_and_no_contacts():
    problem = block().problem(bcs=None, contacts=None)
    assert (problem.bcs, problem.contacts) == ([], [])


def test_tuples_and_generators():
    scene = block()
    problem = scene.problem(bcs=tuple(scene.bcs), contacts=(c for c in scene.package_contacts()))
    assert (len(problem.bcs), len(problem.contacts)) == (2, 1)


def test_tags_may_be_numpy_integers():
    scene = block()
    (contact,) = scene.package_contacts()
    assert isinstance(contact, RigidObstacle)
    problem = scene.problem(contacts=dataclasses.replace(contact, slave=np.int32(contact.slave)))
    problem.solve()
    np.testing.assert_allclose(problem.report.contact_force, scene.total_forces, rtol=1e-8)

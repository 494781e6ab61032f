"""Arguments whose meaning is clear are taken; tests/test_errors.py has those that are mistakes."""

import dataclasses

from mpi4py import MPI

import numpy as np
import pytest
import scenes

import ufl
from dolfinx import fem

from fenics_tfeti import InputError, NotConverged, RigidObstacle


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
    np.testing.assert_allclose(scenes.normal_forces(problem), scene.total_forces, rtol=1e-8)
    problem.solve()
    assert "multipliers" in problem.report.reused


def test_one_contact_without_a_list():
    scene = block()
    (contact,) = scene.contacts
    problem = scene.problem(contacts=contact)
    assert problem.contacts == [contact]
    problem.solve()
    np.testing.assert_allclose(scenes.normal_forces(problem), scene.total_forces, rtol=1e-8)
    problem.contacts = contact
    problem.solve()
    assert problem.contacts == [contact]


def test_one_condition_none_tuples_and_generators():
    scene = block()
    for bcs, contacts, numbers in (
        (scene.bcs[0], scene.contacts, (1, 1)),
        (None, None, (0, 0)),
        (tuple(scene.bcs), (c for c in scene.contacts), (2, 1)),
    ):
        problem = scene.problem(bcs=bcs, contacts=contacts)
        assert (len(problem.bcs), len(problem.contacts)) == numbers


def test_tags_may_be_numpy_integers():
    scene = block()
    (contact,) = scene.contacts
    assert isinstance(contact, RigidObstacle)
    problem = scene.problem(contacts=dataclasses.replace(contact, slave=np.int32(contact.slave)))
    problem.solve()
    np.testing.assert_allclose(scenes.normal_forces(problem), scene.total_forces, rtol=1e-8)


def test_function_is_filled_by_each_solve():
    scene = block()
    u = fem.Function(scene.V, name="u")
    problem = scene.problem(u=u)
    assert problem.solve() is u and u.name == "u"
    first = u.x.array.copy()
    assert first.any()
    u.x.array[:] = 7.0
    assert problem.solve() is problem.u is u
    np.testing.assert_allclose(u.x.array, first, atol=1e-9 * np.abs(first).max())
    new = scene.problem().solve()
    assert new is not u and new.name == "displacement"
    np.testing.assert_array_equal(new.x.array, first)


def test_function_holds_the_last_iterate():
    scene = block()
    u = fem.Function(scene.V)
    with pytest.raises(NotConverged) as caught:
        scene.problem(u=u, options={"max_products": 1, "rtol": 1e-12}).solve()
    assert caught.value.solution is u and u.x.array.any()


@pytest.mark.parametrize("wrong", [3.0, "other space"])
def test_function_that_cannot_be_filled(wrong):
    scene = block()
    if wrong == "other space":
        wrong = fem.Function(block().V)
    with pytest.raises(InputError, match="^u is"):
        scene.problem(u=wrong)

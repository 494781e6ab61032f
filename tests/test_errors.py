"""Every mistake has a clear message, raised before any stiffness matrix is factored."""

from __future__ import annotations

import re

from mpi4py import MPI

import numpy as np
import pytest
from bad_input import MISTAKES
from scenes import two_beams

import fenics_tfeti
from fenics_tfeti.feti import setup

by_name = pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)


@pytest.fixture
def no_factorisation(monkeypatch):
    """Fail where a subdomain's stiffness matrix would be factored."""

    def refuse(*_, **__):
        raise AssertionError("too late: factored before the input was checked")

    monkeypatch.setattr(setup, "GeneralizedInverse", refuse)


@by_name
def test_message(mistake):
    with pytest.raises(mistake.error) as raised:
        mistake.pose(MPI.COMM_SELF)
    for words in mistake.words:
        assert re.search(words, str(raised.value)), f"{words!r} is not in: {raised.value}"


@by_name
def test_kind_of_error(mistake):
    with pytest.raises(fenics_tfeti.ContactError) as raised:
        mistake.pose(MPI.COMM_SELF)
    assert isinstance(raised.value, (ValueError, fenics_tfeti.FactorizationError))


@by_name
def test_message_is_short_and_ends_like_a_sentence_or_a_list(mistake):
    with pytest.raises(fenics_tfeti.ContactError) as raised:
        mistake.pose(MPI.COMM_SELF)
    message = str(raised.value)
    assert 20 <= len(message) <= 900
    assert "\n\n" not in message
    assert "Traceback" not in message


@pytest.mark.parametrize(
    "mistake",
    [mistake for mistake in MISTAKES if mistake.name != "form_that_is_negative"],
    ids=lambda mistake: mistake.name,
)
def test_raised_before_any_factorisation(mistake, no_factorisation):
    with pytest.raises(fenics_tfeti.ContactError):
        mistake.pose(MPI.COMM_SELF)


def test_the_scene_without_a_mistake_is_solved():
    """Otherwise the tests above may pass for another reason."""
    problem = two_beams(MPI.COMM_SELF, "quadrilateral", 4).problem()
    problem.solve()
    assert problem.report.converged


@pytest.mark.parametrize("limit", ["smalbe_max_it", "max_products"])
def test_not_converged_raises_with_the_last_iterate(limit):
    problem = two_beams(MPI.COMM_SELF, "quadrilateral", 6).problem(
        options={limit: 1, "method": "smalbe", "rtol": 1e-10, "subdomain_size": 100}
    )
    with pytest.raises(fenics_tfeti.NotConverged, match=limit) as raised:
        problem.solve()
    assert isinstance(raised.value, RuntimeError)
    assert np.all(np.isfinite(raised.value.solution.x.array))
    assert not raised.value.report.converged


@pytest.mark.parametrize("limit", ["smalbe_max_it", "max_products"])
def test_not_converged_returns_the_last_iterate_if_asked(limit):
    problem = two_beams(MPI.COMM_SELF, "quadrilateral", 6).problem(
        options={
            limit: 1,
            "method": "smalbe",
            "rtol": 1e-10,
            "subdomain_size": 100,
            "error_if_not_converged": False,
        }
    )
    uh = problem.solve()
    assert np.all(np.isfinite(uh.x.array))
    assert not problem.report.converged
    assert limit in problem.report.reason


def test_not_converged_gets_better_with_the_limit():
    """The last iterate is worth having: it comes nearer to the solution."""
    scene = two_beams(MPI.COMM_SELF, "quadrilateral", 6)
    exact = scene.reference().displacement
    errors = []
    for limit in (2, 8, 400):
        problem = scene.problem(
            options={
                "max_products": limit,
                "rtol": 1e-8,
                "subdomain_size": 100,
                "error_if_not_converged": False,
            }
        )
        errors.append(np.linalg.norm(problem.solve().x.array - exact))
    assert errors[0] > errors[1] > errors[2]

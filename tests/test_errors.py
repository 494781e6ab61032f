"""Each mistake of a user is one clear error, raised before any stiffness matrix is factored.

It is the same on all ranks: none is left waiting.
"""

import re
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
from mistakes import MISTAKES
from mistakes.page import PAGE, page
from scenes import two_beams

import fenics_tfeti
from fenics_tfeti.errors import format_point
from fenics_tfeti.fem.contact.conditions.summary import warn_of_deviation
from fenics_tfeti.feti.local.generalized_inverse import GeneralizedInverse

COMM = MPI.COMM_WORLD


@pytest.fixture
def factored(monkeypatch):
    """Return a list that grows by one for each stiffness matrix that is about to be factored."""
    begun, initialise = [], GeneralizedInverse.__init__

    def counted(self, *arguments, **keywords):
        begun.append(self)
        initialise(self, *arguments, **keywords)

    monkeypatch.setattr(GeneralizedInverse, "__init__", counted)
    return begun


def on_any_ranks(text):
    """Leave out what may differ with the ranks: numbers, and which is the first."""
    return re.sub(r" of rank \d+|the first |[\d.]+(e[-+]?\d+)?", "", text)


@pytest.mark.ranks(2)
@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)
def test_mistake(mistake, factored):
    with pytest.raises(fenics_tfeti.ContactError) as raised:
        mistake.pose(COMM)
    assert type(raised.value) is mistake.error
    # Only the factorisation itself can find that a matrix is not positive semidefinite, and only a
    # solve that surfaces never meet.
    may_factor = mistake.error is fenics_tfeti.FactorizationError or "after a solve" in mistake.name
    assert not factored or may_factor
    message = str(raised.value)
    assert f": `{on_any_ranks(message)}`\n" in on_any_ranks(PAGE.read_text())
    assert 20 <= len(message) <= 900
    assert "\n\n" not in message
    assert "Traceback" not in message
    assert COMM.allgather(message) == COMM.size * [message]


@pytest.mark.once
def test_messages_are_on_the_page():
    """After a change of messages run python tests/support/mistakes/page.py."""
    assert PAGE.read_text() == page()


@pytest.mark.ranks
def test_problem_without_a_mistake_is_solved(factored):
    """Otherwise the mistakes may fail for another reason, and the fixture count nothing."""
    problem = two_beams(COMM, "quadrilateral", 4).problem()
    problem.solve()
    assert problem.report.converged
    assert factored


@pytest.mark.ranks
@pytest.mark.parametrize("limit", ["smalbe_max_it", "max_products"])
def test_not_converged_raises_with_the_last_iterate(limit):
    problem = two_beams(COMM, "quadrilateral", 6).problem(
        options={limit: 1, "method": "smalbe", "rtol": 1e-10, "subdomain_size": 100}
    )
    with pytest.raises(fenics_tfeti.NotConverged, match=limit) as raised:
        problem.solve()
    assert isinstance(raised.value, RuntimeError)
    assert np.all(np.isfinite(raised.value.solution.x.array))
    assert not raised.value.report.converged


@pytest.mark.parametrize("limit", ["smalbe_max_it", "max_products"])
def test_not_converged_returns_the_last_iterate_if_asked(limit):
    problem = two_beams(COMM, "quadrilateral", 6).problem(
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
    scene = two_beams(COMM, "quadrilateral", 6)
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


@pytest.mark.parametrize(
    ("point", "written"),
    [
        ((0.5, 1.0, 0.0), "(0.5, 1, 0)"),
        ((1.38777878e-17, 0.25), "(0, 0.25)"),
        ((-1e-17, 1.0), "(0, 1)"),
        ((1 / 3, 2 / 3, 1.0), "(0.333333, 0.666667, 1)"),
        ((1.5e-9, 1e-9, 1e-25), "(1.5e-09, 1e-09, 0)"),
        ((123456.7, 2e-3), "(123457, 0)"),
        ((2e7, 0.0), "(2e+07, 0)"),
        ((0.0, 0.0, 0.0), "(0, 0, 0)"),
        ((np.nan, 1.0), "(nan, 1)"),
        ((np.inf, 1.0), "(inf, 1)"),
        ((5e-324, 0.0), "(4.94066e-324, 0)"),
    ],
)
def test_point_in_a_message_has_no_rounding_errors(point, written):
    assert format_point(np.array(point)) == written


def test_coordinate_that_is_small_against_the_surroundings_is_zero():
    assert format_point((1.4e-17, -3e-18), size=2.0) == "(0, 0)"


def test_warnings_have_the_place_of_the_users_line():
    """And not one inside the package: here of the call of a function that warns."""
    with pytest.warns(UserWarning, match="interference of the mesh") as caught:
        warn_of_deviation(
            dict.fromkeys(("contact", "smallest_gap", "largest_gap"), 0.0)
            | {"blurred": 1.0, "mean_gap": -0.1, "deviation": 0.2}
        )
    assert caught[0].filename == __file__


def test_warning_is_at_the_line_of_a_script_beside_the_package():
    """Whose path begins with that of the package, and which nothing else has called."""
    script = f"{Path(fenics_tfeti.__file__).parent}_first.py"
    code = compile("from fenics_tfeti.errors import warn_user\n\nwarn_user('look')", script, "exec")
    with pytest.warns(UserWarning, match="look") as caught:
        exec(code, {})
    assert (caught[0].filename, caught[0].lineno) == (script, 3)

"""What is to be tried after a solve that has not converged."""

import pytest

from fenics_tfeti.feti import Options
from fenics_tfeti.feti.dual.iterate import Method, SolveStatus
from fenics_tfeti.feti.solution.attempts import next_attempt

pytestmark = pytest.mark.once

BY_ACTIVE_SET = {Method.ACTIVE_SET: 9000, Method.SMALBE: 1000}
BY_SMALBE = {Method.ACTIVE_SET: 1000, Method.SMALBE: 9000}


@pytest.mark.parametrize(
    ("method", "spent", "preconditioner", "option"),
    [
        ("active_set", BY_ACTIVE_SET, "lumped", "method='smalbe'"),
        ("smalbe", BY_SMALBE, "lumped", "method='active_set'"),
        ("active_set", BY_SMALBE, "lumped", "preconditioner='dirichlet'"),
        ("smalbe", BY_ACTIVE_SET, "lumped", "preconditioner='dirichlet'"),
    ],
)
def test_what_had_no_turn_is_next(method, spent, preconditioner, option):
    attempt = next_attempt(
        SolveStatus.OUT_OF_PRODUCTS, spent, Options(method=method), preconditioner
    )
    assert attempt == f"Try {option}, raise the limit or rtol"


@pytest.mark.parametrize(
    ("status", "options", "preconditioner", "expected"),
    [
        (SolveStatus.OUT_OF_PRODUCTS, {"max_products": 100}, "lumped", "Raise the limit or rtol"),
        (SolveStatus.OUT_OF_PRODUCTS, {"method": "smalbe"}, "dirichlet", "Raise the limit or rtol"),
        (SolveStatus.AT_LIMIT, {}, "lumped", "Raise rtol"),
    ],
)
def test_nothing_else_is_known(status, options, preconditioner, expected):
    assert next_attempt(status, BY_ACTIVE_SET, Options(**options), preconditioner) == expected

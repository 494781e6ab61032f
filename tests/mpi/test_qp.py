"""The qp layer with vectors shared by ranks: the same iterations as in one process."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from qp_problems import Problem, random_problem

from fenics_tfeti.qp import (
    Bounds,
    MPRGPOptions,
    Products,
    SMALBEOptions,
    Space,
    lanczos_upper_bound,
    mprgp,
    smalbe,
)
from fenics_tfeti.qp.smalbe import SMALBEState

comm = MPI.COMM_WORLD
N = 23


class Shared:
    """A vector of which each rank owns a slice and holds the next rank's first component too."""

    def __init__(self, problem: Problem) -> None:
        ends = N * np.arange(comm.size + 1) // comm.size
        owned = np.arange(ends[comm.rank], ends[comm.rank + 1])
        ghost = ends[(comm.rank + 1) % comm.size]
        self.held = owned if comm.size == 1 else np.append(owned, ghost)
        self.problem = problem
        self.bounds = Bounds.from_vector(problem.lower[self.held])
        self.space = Space(
            owned.size,
            sum_over_ranks=lambda values: comm.allreduce(values),
            sum_and_min_over_ranks=lambda values: np.append(
                comm.allreduce(values[:-1]), comm.allreduce(values[-1], MPI.MIN)
            ),
        )

    def whole(self, x):
        return np.concatenate(comm.allgather(x[: self.space.owned]))

    def hessian(self, x):
        return (self.problem.A @ self.whole(x))[self.held], None

    def penalised(self, x):
        return tuple(y[self.held] for y in self.problem.penalised(1.0)(self.whole(x)))


@pytest.mark.parametrize("expansion", ["standard", "projected_cg"])
def test_mprgp(expansion):
    problem = random_problem(0, N, condition=1e3)
    shared, alone, together = Shared(problem), Products(), Products()
    options = MPRGPOptions(step_length=1.9, expansion=expansion)

    def stop(split):
        return split.projected_norm <= 1e-8

    expected = mprgp(
        problem.hessian, problem.b, problem.bounds, np.zeros(N), stop,
        options=options, products=alone,
    ).x  # fmt: skip
    found = mprgp(
        shared.hessian, problem.b[shared.held], shared.bounds, np.zeros(shared.held.size), stop,
        options=options, products=together, space=shared.space,
    ).x  # fmt: skip
    np.testing.assert_allclose(found, expected[shared.held], atol=1e-6)
    # Sums in another order may pass the stopping test a step earlier or later.
    assert abs(together.total - alone.total) <= 2


def test_smalbe():
    problem = random_problem(1, N, equalities=3)
    shared, alone, together = Shared(problem), Products(), Products()
    options = SMALBEOptions(rtol=1e-6, inner=MPRGPOptions(step_length=1.9))
    zeros = np.zeros(N)
    expected = smalbe(
        problem.penalised(1.0), problem.b, problem.bounds, SMALBEState(zeros, zeros),
        options=options, products=alone,
    )  # fmt: skip
    zeros = zeros[shared.held]
    found = smalbe(
        shared.penalised, problem.b[shared.held], shared.bounds, SMALBEState(zeros, zeros),
        options=options, products=together, space=shared.space,
    )  # fmt: skip
    np.testing.assert_allclose(found.state.x, expected.state.x[shared.held], atol=1e-5)
    assert abs(together.total - alone.total) <= 2
    assert found.history[-1].active == expected.history[-1].active


def test_lanczos():
    shared = Shared(random_problem(2, N))
    start = np.random.default_rng(0).standard_normal(N)[shared.held]
    bound = lanczos_upper_bound(lambda x: shared.hessian(x)[0], start, 12, shared.space)
    assert 1.0 - 1e-12 <= bound <= 1.05

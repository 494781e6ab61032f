"""QP algorithms with vectors shared by ranks: the same iterations as on one rank."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from mpi4py import MPI

import numpy as np
import pytest
from qp_problems import Problem, random_discs, random_intervals, random_problem

from fenics_tfeti.qp import (
    Bounds,
    Discs,
    Products,
    ProductSet,
    ProportioningOptions,
    SMALBEOptions,
    Space,
    lanczos_estimate,
    proportioning,
    smalbe,
)
from fenics_tfeti.qp.smalbe import SMALBEState

pytestmark = pytest.mark.once

comm = MPI.COMM_WORLD
N = 23


class Shared:
    """A vector of which each rank owns a slice, and holds the next rank's first components too.

    Slices begin with even components, so that a disc of two neighbours is on one rank.
    """

    def __init__(self, problem: Problem) -> None:
        n = problem.b.size
        ends = n * np.arange(comm.size + 1) // comm.size
        ends[:-1] -= ends[:-1] % 2
        owned = np.arange(ends[comm.rank], ends[comm.rank + 1])
        ghost = ends[(comm.rank + 1) % comm.size] + np.arange(2)
        self.held = owned if comm.size == 1 else np.append(owned, ghost)
        self.problem = problem
        self.feasible = self._part(problem)
        self.space = Space(
            owned.size,
            sum_over_ranks=lambda values: comm.allreduce(values),
            sum_and_min_over_ranks=lambda values: np.append(
                comm.allreduce(values[:-1]), comm.allreduce(values[-1], MPI.MIN)
            ),
        )

    def _part(self, problem: Problem) -> ProductSet:
        bounds = Bounds.from_vector(problem.lower[self.held], problem.upper[self.held])
        discs = problem.discs
        if not discs.radius.size:
            return ProductSet(bounds)
        local = np.full(problem.b.size, -1)
        local[self.held] = np.arange(self.held.size)
        here = np.flatnonzero(local[discs.indices[:, 0]] >= 0)
        return ProductSet(
            bounds, Discs(local[discs.indices[here]], discs.centre[here], discs.radius[here])
        )

    def whole(self, x):
        return np.concatenate(comm.allgather(x[: self.space.owned]))

    def hessian(self, x):
        return (self.problem.A @ self.whole(x))[self.held], None

    def penalised(self, x):
        return tuple(y[self.held] for y in self.problem.penalised(1.0)(self.whole(x)))


def with_neighbours(problem: Problem) -> Problem:
    """Return a problem with discs with their components next to each other."""
    n, at = problem.b.size, problem.discs.indices
    order = np.concatenate([np.setdiff1d(np.arange(n), at), at.ravel()])
    discs = replace(problem.discs, indices=np.argsort(order)[at])
    return Problem(
        problem.A[np.ix_(order, order)],
        problem.b[order],
        problem.lower[order],
        problem.G[:, order],
        discs=discs,
    )


PROBLEMS = {
    "half-lines": partial(random_problem, n=N),
    "intervals": partial(random_intervals, n=N),
    "discs": lambda seed, **more: with_neighbours(random_discs(seed, **more)),
}


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("expansion", ["standard", "projected_cg"])
@pytest.mark.parametrize("name", PROBLEMS)
def test_proportioning(expansion, seed, name):
    """So well conditioned that the order of the sums does not change the number of iterations."""
    problem = PROBLEMS[name](seed, condition=10.0)
    shared, alone, on_ranks = Shared(problem), Products(), Products()
    zeros, b = np.zeros(problem.b.size), problem.b
    solve = partial(
        proportioning,
        stop=lambda split: split.gradient_norm <= 1e-8,
        options=ProportioningOptions(step_length=1.9, expansion=expansion),
    )
    expected = solve(problem.hessian, b, problem.feasible, zeros, products=alone).x
    found = solve(
        shared.hessian, b[shared.held], shared.feasible, zeros[shared.held],
        products=on_ranks, space=shared.space,
    ).x  # fmt: skip
    np.testing.assert_allclose(found, expected[shared.held], atol=1e-11)
    # a step that ends at a bound meets it up to rounding, or one step later
    assert abs(on_ranks.total - alone.total) <= (name == "intervals")
    assert name != "discs" or min(alone.cg, alone.proportioning) > 0


@pytest.mark.parametrize("name", PROBLEMS)
def test_smalbe(name):
    problem = PROBLEMS[name](1, equalities=3)
    shared, alone, on_ranks = Shared(problem), Products(), Products()
    zeros, b = np.zeros(problem.b.size), problem.b
    options = SMALBEOptions(rtol=1e-6, inner=ProportioningOptions(step_length=1.9))
    solve = partial(smalbe, options=options)
    start, shared_start = SMALBEState(zeros, zeros), SMALBEState(*2 * (zeros[shared.held],))
    expected = solve(problem.penalised(1.0), b, problem.feasible, start, products=alone)
    found = solve(
        shared.penalised, b[shared.held], shared.feasible, shared_start,
        products=on_ranks, space=shared.space,
    )  # fmt: skip
    np.testing.assert_allclose(found.state.x, expected.state.x[shared.held], atol=1e-11)
    assert on_ranks.total == alone.total
    assert found.history[-1].active == expected.history[-1].active


def test_lanczos():
    shared = Shared(random_problem(2, N))
    start = np.random.default_rng(0).standard_normal(N)[shared.held]
    bound = lanczos_estimate(lambda x: shared.hessian(x)[0], start, 12, shared.space)
    assert 1.0 - 1e-12 <= bound <= 1.05

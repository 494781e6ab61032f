"""Deflation on several ranks: the same directions and counts as on one."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from fibres import reinforced_block
from sparse_rows import assert_same_on_ranks, distributed

from fenics_tfeti.feti import Options, TornSolver, TornSystem

COMM = MPI.COMM_WORLD


def block(gdim: int) -> TornSystem:
    return reinforced_block(gdim, 1e6, columns=4 if gdim == 2 else 3, layers=4 - gdim)


CASES = [
    (2, {"preconditioner": "lumped", "coarse_solver": "distributed"}),
    (3, {"preconditioner": "dirichlet", "coarse_solver": "redundant"}),
    (2, {"method": "smalbe", "coarse_solver": "distributed"}),
]


@pytest.mark.parametrize(("gdim", "options"), CASES)
def test_same_solution_and_counts_as_on_one_rank(gdim, options):
    alone, found = assert_same_on_ranks(block(gdim), Options(rtol=1e-7, **options), 1e-6)
    # whether a direction depends on the others may be decided by rounding
    vectors = [solution.report.deflation["vectors"] for solution in (found, alone)]
    assert min(vectors) > 1
    assert abs(vectors[0] - vectors[1]) <= 1
    if "method" not in options:
        counts = [solution.report.products["total"] for solution in (found, alone)]
        assert abs(counts[0] - counts[1]) <= 1
    assert found.report.energy == pytest.approx(alone.report.energy, rel=1e-9)


def test_directions_satisfy_the_constraints():
    """G U = 0, zero on contact rows, and the same on all ranks that hold a row; F_c U = 0."""
    setup = TornSolver(distributed(block(2), COMM)).setup
    found, constraints = setup.deflation, setup.constraints
    layout = constraints.layout
    sizes = []
    for alpha in found.basis.T:
        u = found.prolonged(alpha)
        assert not u[constraints.inequality].any()
        assert np.abs(setup.projector.coarse_space.restrict(u)).max() <= 1e-12
        np.testing.assert_allclose(layout.sum(u), layout.sum(np.ones_like(u)) * u, atol=1e-14)
        products = (layout.sum(F(u)) for F in (setup.F.part, setup.part))
        sizes.append([layout.space.norm(x) for x in (u, *products)])
    length, plain, deflated = np.transpose(sizes)
    assert (deflated <= 1e-11 * length * (plain / length).max()).all()


def test_load_step_reuses_all():
    first = TornSolver(distributed(block(2), COMM))
    first.solve()
    heavier = [replace(s, load=2.0 * s.load) for s in first.system.subdomains]
    second = TornSolver(replace(first.system, subdomains=heavier), previous=first)
    assert second.setup.deflation is first.setup.deflation
    assert second.solve().report.products["deflation"] == 0

"""Deflation on several ranks: the same directions and counts as on one."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from fibres import reinforced_block

from fenics_tfeti.feti import ContactRows, Options, TornSolver, TornSystem

COMM = MPI.COMM_WORLD


def block(gdim: int) -> TornSystem:
    return reinforced_block(gdim, 1e6, columns=4 if gdim == 2 else 3, layers=4 - gdim)


def dealt(system: TornSystem) -> TornSystem:
    """Return this rank's share of a system."""
    contacts = system.contacts if COMM.rank == 0 else ContactRows.none(system.gdim)
    share = system.subdomains[COMM.rank :: COMM.size]
    return replace(system, subdomains=share, contacts=contacts, comm=COMM)


CASES = [
    (2, {"preconditioner": "lumped", "coarse_solver": "distributed"}),
    (3, {"preconditioner": "dirichlet", "coarse_solver": "redundant"}),
    (2, {"method": "smalbe", "coarse_solver": "distributed"}),
]


@pytest.mark.parametrize(("gdim", "options"), CASES)
def test_same_solution_and_counts_as_on_one_rank(gdim, options):
    chosen = Options(rtol=1e-7, **options)
    found, alone = (TornSolver(s, chosen).solve() for s in (dealt(block(gdim)), block(gdim)))
    # whether a direction depends on the others may be decided by rounding
    vectors = [solution.report.deflation["vectors"] for solution in (found, alone)]
    assert min(vectors) > 1
    assert abs(vectors[0] - vectors[1]) <= 1
    if "method" not in options:
        counts = [solution.report.products["total"] for solution in (found, alone)]
        assert abs(counts[0] - counts[1]) <= 1
    assert found.report.energy == pytest.approx(alone.report.energy, rel=1e-9)
    largest = max(np.abs(u).max() for u in alone.displacements)
    mine = alone.displacements[COMM.rank :: COMM.size]
    for u, expected in zip(found.displacements, mine, strict=True):
        np.testing.assert_allclose(u, expected, rtol=0.0, atol=1e-6 * largest)


def test_directions_satisfy_the_constraints():
    """G U = 0, zero on contact rows, and the same on all ranks that hold a row."""
    setup = TornSolver(dealt(block(2))).setup
    found, constraints = setup.deflation, setup.constraints
    for alpha in found.basis.T:
        u = found.prolonged(alpha)
        assert not u[constraints.inequality].any()
        assert np.abs(setup.projector.coarse_space.restrict(u)).max() <= 1e-12
        multiplicity = constraints.layout.sum(np.ones_like(u))
        np.testing.assert_allclose(constraints.layout.sum(u), multiplicity * u, atol=1e-14)


def test_deflated_product_vanishes_on_the_directions():
    setup = TornSolver(dealt(block(2))).setup
    found, space = setup.deflation, setup.constraints.layout.space
    for alpha in found.basis.T[:5]:
        u = found.prolonged(alpha)
        plain, deflated = (
            setup.constraints.layout.sum(part(u)) for part in (setup.F.part, setup.part)
        )
        assert space.norm(deflated) <= 1e-9 * space.norm(plain)


def test_load_step_reuses_all():
    first = TornSolver(dealt(block(2)))
    first.solve()
    heavier = [replace(s, load=2.0 * s.load) for s in first.system.subdomains]
    second = TornSolver(replace(first.system, subdomains=heavier), previous=first)
    assert second.setup.deflation is first.setup.deflation
    assert second.solve().report.products["deflation"] == 0

"""Bodies on soft springs: any number of ranks finds what one finds."""

from __future__ import annotations

import dataclasses

from mpi4py import MPI

import numpy as np
import pytest
from springs import glued_column, pressed_column

from fenics_tfeti.feti import ContactRows, Options, Prescribed, TornSolver

COMM = MPI.COMM_WORLD


def distribute(system):
    """Return a system with the subdomains dealt out to the ranks, contacts on the first."""
    contacts = system.contacts if COMM.rank == 0 else ContactRows.none(3)
    return dataclasses.replace(
        system,
        subdomains=system.subdomains[COMM.rank :: COMM.size],
        prescribed=system.prescribed if COMM.rank == 0 else Prescribed(),
        contacts=contacts,
        comm=COMM,
    )


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
@pytest.mark.parametrize("stiffness", [1e-13, 1e-10, 1e-6, 1e-3])
@pytest.mark.parametrize("problem", [lambda s: glued_column(s, 3), pressed_column])
def test_same_as_on_one_rank(problem, stiffness, method):
    """K is the same to the last bit, so that only the tolerance and other sums remain."""
    system = dataclasses.replace(problem(stiffness), comm=MPI.COMM_SELF)
    options = Options(rtol=1e-8, method=method)
    alone = TornSolver(system, options).solve()
    found = TornSolver(distribute(system), options).solve()
    assert found.report.certificate.worst <= 1e-8
    largest = max(np.abs(u).max() for u in alone.displacements)
    mine = alone.displacements[COMM.rank :: COMM.size]
    for u, expected in zip(found.displacements, mine, strict=True):
        np.testing.assert_allclose(u, expected, atol=1e-6 * largest)
    # softer springs amplify rounding to more than the tolerance, and steps are spent on it
    few = 2 if stiffness >= 1e-6 else 20
    assert abs(found.report.products["total"] - alone.report.products["total"]) <= few

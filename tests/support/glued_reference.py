"""Solutions of torn systems against those of the glued bodies by a primal method."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from primal_reference import PrimalSolution, primal_active_set
from torn import Glued

from fenics_tfeti.feti import TornSolution, TornSystem


def primal_solution(system: TornSystem) -> tuple[PrimalSolution, list[np.ndarray]]:
    """Return the solution of the glued bodies, and the unknowns of each subdomain."""
    whole, gap = Glued.of(system), system.contacts.gap
    fixed = np.setdiff1d(np.arange(whole.f.size), whole.free)
    K, C = sp.csr_matrix(whole.K), sp.csr_matrix(whole.C)
    return primal_active_set(K, whole.f, fixed, whole.u[fixed], C, gap), whole.places


def assert_solves(found: TornSolution, system: TornSystem, energy: float = 1e-7) -> None:
    """Compare forces, displacements and, to the given accuracy, the energy."""
    expected, places = primal_solution(system)
    assert expected.active.any()
    largest, size = expected.forces.max(), np.abs(expected.displacement).max()
    np.testing.assert_allclose(found.normal_force, expected.forces, rtol=0.0, atol=1e-6 * largest)
    for u, at in zip(found.displacements, places, strict=True):
        np.testing.assert_allclose(u, expected.displacement[at], rtol=0.0, atol=1e-6 * size)
    assert found.report.energy == pytest.approx(expected.energy, rel=energy)

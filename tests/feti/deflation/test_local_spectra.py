"""The large eigenvalues of P_s F_s P_s against dense algebra."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
import scipy.linalg
from fibres import reinforced_block
from torn import column

from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.deflation.local_spectra import (
    LocalVectors,
    TornRows,
    local_vectors,
    threshold,
)

pytestmark = pytest.mark.once

every_gdim = pytest.mark.parametrize("gdim", [2, 3])


@lru_cache(maxsize=None)
def solver(gdim: int, ratio: float = 1e4) -> TornSolver:
    return TornSolver(reinforced_block(gdim, ratio, columns=3, layers=1), Options(deflation="off"))


def torn_rows(torn: TornSolver) -> TornRows:
    constraints, interface = torn.setup.constraints, torn.setup.F.interface
    every = np.ones(interface.ends.size - 1, dtype=bool)
    return TornRows.build(interface, constraints.equality, every)


def vectors(torn: TornSolver, limit: float) -> LocalVectors:
    setup = torn.setup
    interface = setup.F.interface
    return local_vectors(
        torn_rows(torn),
        interface,
        setup.F.on_interface,
        [
            setup.local.kernels[congruent.first][unknowns]
            for congruent, unknowns in zip(interface.classes, interface.unknowns, strict=True)
        ],
        numbers=setup.constraints.layout.numbers,
        unit=setup.local.unit,
        limits=np.full(interface.ends.size - 1, limit),
        negative=np.zeros(interface.ends.size - 1, dtype=np.int64),
    )


def exact_spectra(torn: TornSolver) -> list[np.ndarray]:
    """Return the eigenvalues of P_s F_s P_s of each subdomain, with contact rows left out."""
    B = torn.setup.constraints.matrix[np.flatnonzero(torn.setup.constraints.equality)].toarray()
    ends, spectra = torn.setup.local.unknowns.ends, []
    for s, R, begin, end in zip(
        torn.system.subdomains, torn.setup.local.kernels, ends[:-1], ends[1:], strict=True
    ):
        B_s = B[:, begin:end]
        F_s = B_s @ np.linalg.pinv(s.stiffness.toarray(), rcond=1e-12, hermitian=True) @ B_s.T
        Q = scipy.linalg.orth(B_s @ R, rcond=1e-10)
        P = np.eye(len(F_s)) - Q @ Q.T
        spectra.append(np.linalg.eigvalsh(torn.setup.local.unit * P @ F_s @ P)[::-1])
    return spectra


@every_gdim
def test_large_eigenvalues_are_found(gdim):
    torn = solver(gdim)
    limit = threshold(gdim, torn.system.subdomains[0].nodes.size)
    large = np.sort(np.concatenate([s[s > limit] for s in exact_spectra(torn)]))
    found = np.sort(limit * vectors(torn, limit).excess)
    assert large.size == (7 if gdim == 2 else 14) and large.min() > 2 * limit
    np.testing.assert_allclose(found, large, rtol=1e-3)


@every_gdim
def test_uniform_material_has_none(gdim):
    torn = solver(gdim, 1.0)
    limit = threshold(gdim, torn.system.subdomains[0].nodes.size)
    assert max(s[0] for s in exact_spectra(torn)) < limit
    found = vectors(torn, limit)
    assert not found.excess.size
    # and few solves tell so
    assert 0 < found.solves <= 16 * len(torn.system.subdomains)


@every_gdim
def test_vectors_are_on_the_equality_rows_of_one_subdomain(gdim):
    torn = solver(gdim)
    found = vectors(torn, 40.0)
    constraints = torn.setup.constraints
    contact = constraints.layout.numbers[constraints.inequality]
    of_subdomain = torn_rows(torn)
    every = [
        constraints.layout.numbers[of_subdomain.rows[begin:end]]
        for begin, end in zip(of_subdomain.ends[:-1], of_subdomain.ends[1:], strict=True)
    ]
    for rows, values in zip(found.rows, found.values, strict=True):
        assert not np.isin(contact, rows).any()
        assert any(np.array_equal(rows, own) for own in every)
        assert np.linalg.norm(values) == pytest.approx(1.0)


def test_number_of_vectors_of_a_subdomain_is_limited():
    found = vectors(solver(3), 1e-3)
    first, counts = np.unique([rows[0] for rows in found.rows], return_counts=True)
    assert first.size <= len(solver(3).system.subdomains)
    assert found.excess.size <= 20 * len(solver(3).system.subdomains)
    assert counts.max() >= 20


def test_subdomain_with_few_rows():
    """The subspace is as large as the space then."""
    torn = TornSolver(column(n=1), Options(deflation="off"))
    found = vectors(torn, 1e-9)
    sizes = [np.count_nonzero(s > 1e-9) for s in exact_spectra(torn)]
    assert found.excess.size == sum(min(n, 20) for n in sizes)


def test_thresholds():
    assert threshold(3, 150) == pytest.approx(63.8, abs=0.1)
    assert threshold(2, 81) == 36.0

"""Deluxe scaling of stiff modes against dense algebra."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from pressed_blocks import pressed_blocks

from fenics_tfeti import ContactProblem
from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.constraints.face import Face

pytestmark = pytest.mark.once


@lru_cache(maxsize=None)
def problem() -> ContactProblem:
    """Return the problem, whose mesh has the communicator of the system."""
    return pressed_blocks(MPI.COMM_SELF, 2, 0.49999, subdomain_size=200)


@lru_cache(maxsize=None)
def solver() -> TornSolver:
    return TornSolver(problem().system, Options())


def columns(operator: Any, size: int) -> np.ndarray:
    return np.stack([operator(unit) for unit in np.eye(size)], axis=1)


def faces(torn: TornSolver) -> list[np.ndarray]:
    """Return the face of all rows, that of equality rows, and one of every other contact row."""
    equality = torn.setup.constraints.equality
    other = equality.copy()
    other[np.flatnonzero(~equality)[::2]] = True
    return [np.ones_like(equality), equality, other]


@pytest.mark.parametrize("number", range(3))
def test_jumps_are_closed(number):
    """B_R B_D' = I: the displacements that the preconditioner takes close the jumps."""
    torn = solver()
    F, scaling = torn.setup.F, torn.setup.preconditioner.scaling
    constraints, rows = torn.setup.constraints, faces(torn)[number]
    (coupled,) = constraints.coupling.gather(rows.astype(float))
    close = scaling.on_face(rows, constraints.coupling.inverse(coupled > 0.0))
    B = F.interface.matrix

    def closed(x: np.ndarray) -> np.ndarray:
        return B @ scaling.displacements(B.T @ close(x))

    found = columns(closed, constraints.size)[np.ix_(rows, rows)]
    np.testing.assert_allclose(found, np.eye(rows.sum()), atol=1e-8)


def test_weights_are_those_of_the_modes():
    """(D + sum theta f f')^{-1} of each class by dense algebra."""
    torn = solver()
    setup, F = torn.setup, torn.setup.F
    scaling = setup.preconditioner.scaling
    inverse = columns(scaling.displacements, F.interface.columns.size)
    weights = setup.constraints.weights[F.interface.columns]
    end = 0
    for congruent, V in zip(F.interface.classes, scaling.modes, strict=True):
        begin, end = end, end + len(V)
        D = np.diag(weights[begin:end])
        share = np.sum(V**2 * weights[begin:end, None], axis=0)  # theta / (1 + theta)
        f = D @ V / np.sqrt(share)
        expected = np.linalg.inv(D + (f * (share / (1.0 - share))) @ f.T)
        found = inverse[begin:end, begin:end]
        np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())
        end = begin + congruent.members.size * len(V)
    assert scaling.size >= 2


def test_preconditioner_is_at_least_the_inverse():
    """M >= F^{-1} on the face: the energy of displacements that close the jumps is no less."""
    torn = solver()
    setup, rows = torn.setup, faces(torn)[0]
    precondition = setup.preconditioner.on(Face.of_rows(setup.constraints, rows))
    F, M = (columns(A, rows.size) for A in (setup.F, precondition))
    P = columns(torn.setup.projector.P, rows.size)
    PF = P @ F @ P.T
    values = np.linalg.eigvals(P @ M @ P.T @ PF).real
    # zero on the range of G'
    assert values[values > 1e-6].min() > 1.0 - 1e-6
    assert values.max() < 100.0

"""Lumped and Dirichlet preconditioners against dense algebra."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.linalg
from dense import DenseSystem
from torn import column

from fenics_tfeti.feti import Options, Prescribed, TornSolver


def sliding_column():
    """Return a column of which each cube may slide in the plane of its joint: no interface in x, y.

    The upper cube is in contact along z alone, and three rigid motions are in the kernel of K_ii.
    """
    system = column(height=1)
    bottom = system.prescribed.nodes[system.prescribed.nodes < 10**9]
    return dataclasses.replace(
        system,
        prescribed=Prescribed(bottom, np.tile([0, 1, 2], bottom.size // 3), np.zeros(bottom.size)),
    )


def unequal_column():
    """Return a column of cubes with three moduli, so that the weights differ."""
    system = column(height=2)
    parts = [
        dataclasses.replace(part, stiffness=factor * part.stiffness)
        for part, factor in zip(system.subdomains, (1.0, 0.1, 20.0), strict=True)
    ]
    return dataclasses.replace(system, subdomains=parts)


def interface_stiffness(kind: str, K: np.ndarray, touched: np.ndarray) -> np.ndarray:
    """Return K_bb or its Schur complement on the touched unknowns, zeros elsewhere."""
    inner = ~touched
    S = K[np.ix_(touched, touched)]
    if kind == "dirichlet":
        S = (
            S
            - K[np.ix_(touched, inner)]
            @ np.linalg.lstsq(K[np.ix_(inner, inner)], K[np.ix_(inner, touched)], rcond=1e-12)[0]
        )
    whole = np.zeros_like(K)
    whole[np.ix_(touched, touched)] = S
    return whole


@pytest.mark.parametrize("scaling", ["stiffness", "multiplicity"])
@pytest.mark.parametrize("kind", ["lumped", "dirichlet"])
@pytest.mark.parametrize("make", [unequal_column, sliding_column])
def test_scaled_stiffness_of_the_interfaces(make, kind, scaling):
    """B D^{-1} S D^{-1} B' with S of each subdomain."""
    solver = TornSolver(make(), Options(preconditioner=kind, scaling=scaling))
    system = DenseSystem.of(solver)
    interface = solver.setup.F.interface
    touched = np.zeros(len(system.K), dtype=bool)
    touched[interface.columns] = True
    ends = np.cumsum([s.size for s in solver.system.subdomains])[:-1]
    S = scipy.linalg.block_diag(
        *(
            interface_stiffness(kind, subdomain.stiffness.toarray(), part)
            for subdomain, part in zip(
                solver.system.subdomains, np.split(touched, ends), strict=True
            )
        )
    )
    D = np.linalg.inv(system.D)
    exact = system.B @ D @ S @ D @ system.B.T
    apply = solver.setup.preconditioner.apply
    found = np.stack([apply(unit) for unit in np.eye(len(system.B))], axis=1)
    np.testing.assert_allclose(found, exact, rtol=0.0, atol=1e-11 * np.abs(exact).max())


def test_without_preconditioner():
    assert TornSolver(column(), Options(preconditioner="none")).setup.preconditioner is None

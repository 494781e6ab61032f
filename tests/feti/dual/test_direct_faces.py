"""The direct solver of faces against dense algebra."""

import numpy as np
import pytest
from dense import DenseSystem
from torn import column

from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.dual import direct_faces


@pytest.mark.parametrize("compliance", [0.0, 2.0])
@pytest.mark.parametrize("active", ["all", "some"])
def test_inverse_on_a_face(active, compliance):
    """(PFP + C)^{-1} on the rows of a face, but for the compliance that all of them have."""
    solver = TornSolver(column(height=1), Options())
    setup = solver.setup
    dense, constraints = DenseSystem.of(solver), setup.constraints
    closed = np.ones(constraints.inequality.size, dtype=bool)
    closed[::3] = active == "all"
    sticking = np.zeros(0, dtype=bool)
    projector = Projector.build(setup.projector.coarse_space, closed, sticking)
    direct = setup.preconditioner.direct
    per_row = compliance / setup.local.unit
    solve = direct.on_face(projector, np.zeros(0), per_row)
    random = np.random.default_rng(1).standard_normal(constraints.size)
    x = projector.P(projector.on_rows(random))
    C = np.where(constraints.equality, 0.0, per_row) + direct_faces._COMPLIANCE / setup.local.unit
    part = projector.P(projector.on_rows(dense.F @ x + C * x))
    assert projector.P(solve(part)) == pytest.approx(x, abs=1e-9 * np.abs(x).max())


def test_direct_from_the_time_of_a_factor_on(monkeypatch):
    """Of all two blocks, which are in contact; many unknowns are left to conjugate gradients."""
    preconditioner = TornSolver(column(height=1), Options()).setup.preconditioner
    steps = preconditioner.direct.patience
    assert 40 < steps < np.inf
    for products, direct in ((int(steps), False), (int(steps) + 1, True)):
        assert preconditioner.becomes_direct(products) == direct
        assert preconditioner.is_direct == direct
    monkeypatch.setattr(direct_faces, "_MOST", 10)
    preconditioner = TornSolver(column(height=1), Options()).setup.preconditioner
    assert not preconditioner.becomes_direct(10**9)
    assert not preconditioner.is_direct

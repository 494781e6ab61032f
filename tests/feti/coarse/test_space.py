"""G = R'B' against dense algebra, and the motions that its rows leave free."""

import numpy as np
import pytest
from dense import DenseSystem
from torn import column

from fenics_tfeti.feti import TornSolver
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.face import Face

SOLVER = TornSolver(column())
SPACE = SOLVER.setup.projector.coarse_space
SYSTEM = DenseSystem.of(SOLVER)


def test_restriction_is_kernel_times_constraints():
    G = np.stack([SPACE.restrict(unit) for unit in np.eye(len(SYSTEM.B))], axis=1)
    np.testing.assert_allclose(G, SYSTEM.G, atol=1e-14)


def test_prolongation_is_the_transpose_of_the_restriction():
    columns = np.stack([SPACE.prolong(unit) for unit in np.eye(SPACE.size)], axis=0)
    np.testing.assert_allclose(columns, SYSTEM.G, atol=1e-14)


def test_coarse_load_and_rigid_motion():
    rng = np.random.default_rng(0)
    forces, coarse = rng.standard_normal(len(SYSTEM.R)), rng.standard_normal(SPACE.size)
    np.testing.assert_allclose(SPACE.coarse_load(forces), SYSTEM.R.T @ forces, atol=1e-13)
    np.testing.assert_allclose(SPACE.rigid_motion(coarse), SYSTEM.R @ coarse, atol=1e-14)


@pytest.mark.parametrize(("active", "motions"), [
    ([], 3), ([0], 2), ([0, 3], 1), ([0, 3, 12], 0), ([0, 1, 2, 3], 1),
], ids=["none", "one node", "two nodes", "three nodes", "nodes on a line"])  # fmt: skip
def test_motions_that_equalities_and_some_contact_rows_leave_free(active, motions):
    """The upper cube may sink and tilt about two axes: its kernel of G' by an SVD."""
    contact_nodes = SOLVER.system.contacts.size
    rows = np.isin(np.arange(contact_nodes), active)
    free = Projector.build(SPACE, Face.of(SPACE.constraints, rows)).free.toarray()
    assert free.shape == (SPACE.size, motions)
    np.testing.assert_allclose(free.T @ free, np.eye(motions), atol=1e-13)
    chosen = SOLVER.setup.constraints.equality
    chosen[SOLVER.setup.constraints.inequality] = rows
    np.testing.assert_allclose(SYSTEM.G[:, chosen].T @ free, 0.0, atol=1e-12)
    singular = np.linalg.svd(SYSTEM.G[:, chosen], compute_uv=False)
    assert np.count_nonzero(singular > 1e-10) == SPACE.size - motions

"""P and Q of all rows and of the rows of a face, against dense algebra."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.sparse as sp
from dense import DenseSystem
from friction_problems import blocks_that_do_not_match, pushed_block
from stiff_half import stiff_half
from torn import column, cube

from fenics_tfeti.feti import ContactRows, Prescribed, TornSolver
from fenics_tfeti.feti.coarse import space
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.face import Face

SOLVER = TornSolver(column())
SYSTEM = DenseSystem.of(SOLVER)
CONSTRAINTS = SOLVER.setup.constraints
SPACE = SOLVER.setup.projector.coarse_space
X, Y = np.random.default_rng(0).standard_normal((2, len(SYSTEM.B)))

# active contact rows: all, some that hold the upper cube, too few to hold it, none
FACES = {"all": slice(None), "five": slice(0, 5), "two": slice(0, 2), "none": slice(0, 0)}


def on_face(name: str) -> tuple[Projector, np.ndarray, np.ndarray]:
    """Return the projector of a face, its rows, and the dense P."""
    active = np.zeros(CONSTRAINTS.inequality.size, dtype=bool)
    active[FACES[name]] = True
    rows = CONSTRAINTS.equality
    rows[CONSTRAINTS.inequality] = active
    return Projector.build(SPACE, Face.of(CONSTRAINTS, active)), rows, SYSTEM.projector(rows)


each_face = pytest.mark.parametrize("face", FACES)


def test_projector_is_that_of_orthonormal_rows():
    """Q = G'G for G with orthonormal rows, here from an SVD."""
    rows = np.linalg.svd(SYSTEM.G, full_matrices=False)[2]
    np.testing.assert_allclose(SOLVER.setup.projector.Q(X), rows.T @ (rows @ X), atol=1e-12)


@each_face
def test_projections_of_vectors_on_the_face(face):
    """On one rank the part is the whole; off the face rigid motions are removed too.

    There it is y - G'a with the a of least norm that makes it Py on the face.
    """
    projector, rows, P = on_face(face)
    x = np.where(rows, X, 0.0)
    np.testing.assert_allclose(projector.P(x), P @ x, atol=1e-12)
    np.testing.assert_allclose(projector.Q(x), x - P @ x, atol=1e-12)
    np.testing.assert_allclose(projector.part_of_P(Y), P @ Y, atol=1e-12)
    for found in projector.part_of_Q(X):
        np.testing.assert_allclose(found, projector.Q(X), atol=1e-12)
    a = np.linalg.lstsq(SYSTEM.G[:, rows].T, Y[rows], rcond=1e-10)[0]
    for (found, product), expected, atol in (
        (projector.P_of_sum(Y, X), P @ Y, 1e-12),
        (projector.remove_rigid_motion(Y, X), Y - SYSTEM.G.T @ a, 1e-11),
    ):
        np.testing.assert_allclose(found, expected, atol=atol)
        assert product == pytest.approx(X @ Y, rel=1e-12)


@pytest.mark.parametrize("jump", [1e2, 1e8])
def test_stiff_subdomains_on_soft_ones(jump):
    """Against Gram-Schmidt in extended precision; one application at 1e8 has errors of 1e-7."""
    solver = TornSolver(stiff_half(jump))
    G, projector = DenseSystem.of(solver).G, solver.setup.projector
    basis = np.zeros((0, G.shape[1]), dtype=np.longdouble)
    for row in G.astype(np.longdouble):
        for _ in range(2):
            row = row - basis.T @ (basis @ row)
        basis = np.vstack([basis, row / np.sqrt(row @ row)])
    x = np.random.default_rng(0).standard_normal(G.shape[1])
    expected = x - (basis.T @ (basis @ x)).astype(float)
    np.testing.assert_allclose(projector.P(x), expected, atol=1e-10)
    np.testing.assert_allclose(projector.Q(x), x - expected, atol=1e-10)
    np.testing.assert_allclose(projector.P_of_sum(x, x)[0], expected, atol=1e-10)
    np.testing.assert_allclose(projector.part_of_P(x), expected, atol=1e-10)
    np.testing.assert_allclose(projector.remove_rigid_motion(x, x)[0], expected, atol=1e-10)
    for Qx in projector.part_of_Q(x):
        np.testing.assert_allclose(Qx, x - expected, atol=1e-10)


@each_face
def test_generalized_inverse_of_the_coarse_matrix(face):
    projector, rows, _ = on_face(face)
    G = np.where(rows, SYSTEM.G, 0.0)
    coarse = projector.without_free_motions(np.random.default_rng(1).standard_normal(SPACE.size))
    x = projector.least_norm(coarse)
    np.testing.assert_allclose(G @ x, coarse, atol=1e-12)
    np.testing.assert_allclose(G.T @ projector.coefficients(x), x, atol=1e-12)
    np.testing.assert_allclose(projector.free.T @ coarse, 0.0, atol=1e-13)


def test_subdomain_without_rigid_modes():
    """There is no coarse unknown then, and P is the identity."""
    block = cube(2)
    held = dataclasses.replace(block, stiffness=(block.stiffness + sp.identity(81)).tocsr())
    system = dataclasses.replace(column(), subdomains=[held], contacts=ContactRows.none(3))
    bottom = block.nodes[block.coordinates[:, 2] == 0]
    fixed = Prescribed(bottom, np.zeros(bottom.size, dtype=int), np.zeros(bottom.size))
    projector = TornSolver(dataclasses.replace(system, prescribed=fixed)).setup.projector
    x = np.arange(float(bottom.size))
    assert projector.coarse_space.size == 0
    np.testing.assert_array_equal(projector.P(x), x)
    np.testing.assert_array_equal(projector.part_of_Q(x)[1], 0.0)
    assert projector.P_of_sum(x, x)[1] == x @ x


def test_load_on_motions_that_no_row_resists():
    """Without contact rows the upper cube may rise; the lower body is held."""
    projector, lower = on_face("none")[0], SOLVER.system.subdomains[0].size
    for at, unresisted in ((slice(lower), False), (slice(-lower, None), True)):
        load = np.zeros_like(SOLVER.data.load)
        load[at][2::3] = 1.0
        e, size = SPACE.coarse_load(load), SPACE.coarse_load_size(load)
        assert projector.unresisted(e, size).any() == unresisted
        # rounding of a load is none
        assert not projector.unresisted(e, 1e16 * size).any()


# -- sites of friction that stick, and that slip with a force that turns ---------------------------


@pytest.mark.parametrize("sticking", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("turning", [False, True])
@pytest.mark.parametrize("system", [pushed_block, blocks_that_do_not_match])
def test_friction_on_a_face(system, turning, sticking):
    """S takes rows of sites that stick, and of the others the part across the force."""
    solver, rng = TornSolver(system()), np.random.default_rng(1)
    dense, constraints = DenseSystem.of(solver), solver.setup.constraints
    friction = constraints.friction
    active = rng.random(constraints.inequality.size) < 0.7
    stick = np.arange(friction.size) < sticking * friction.size
    forces = rng.standard_normal(constraints.size)
    face = Face.of(constraints, active, stick, forces)
    S = np.diag(face.rows.astype(float))
    for rows, sticks in zip(friction.rows, stick, strict=True):
        if turning and not sticks:
            t = np.array([-forces[rows[1]], forces[rows[0]]])
            S[np.ix_(rows, rows)] = np.outer(t, t) / (t @ t)
    G = dense.G @ S
    P = S - np.linalg.pinv(G, rcond=1e-10) @ G
    face = face.with_turning_forces() if turning else face
    projector = Projector.build(solver.setup.projector.coarse_space, face)
    x, y = rng.standard_normal((2, constraints.size))
    np.testing.assert_allclose(projector.face.part(x), S @ x, atol=1e-13)
    np.testing.assert_allclose(projector.P(S @ x), P @ x, atol=1e-11)
    np.testing.assert_allclose(projector.P_of_sum(y, x)[0], P @ y, atol=1e-11)
    np.testing.assert_allclose(projector.part_of_P(y), P @ y, atol=1e-11)
    free = np.linalg.matrix_rank(dense.G @ dense.G.T) - np.linalg.matrix_rank(G, tol=1e-9)
    assert projector.free.shape[1] == free


@pytest.mark.parametrize("held", [True, False])
def test_motions_are_looked_for_once_where_equality_rows_resist_all(monkeypatch, held):
    faces, find = [], space.weak_motions
    monkeypatch.setattr(space, "weak_motions", lambda *args: faces.append(args) or find(*args))
    TornSolver(column(contact=not held)).solve()
    assert (len(faces) == 1) == held

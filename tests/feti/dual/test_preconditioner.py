"""Lumped and Dirichlet preconditioners against dense algebra."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
import scipy.linalg
from dense import DenseSystem
from friction_problems import in_a_corner
from sparse_rows import clamped, interpolated, random_rows, two_blocks
from torn import column

from fenics_tfeti.feti import Options, Prescribed, TornSolver, TornSystem
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.constraints.row_table import Kind
from fenics_tfeti.feti.dual.preconditioner import Choice
from fenics_tfeti.qp import balls


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


def preconditioned(solver: TornSolver, active: np.ndarray) -> np.ndarray:
    """Return the preconditioner of a face as a matrix."""
    apply = solver.setup.preconditioner.on(Face.of(solver.setup.constraints, active))
    return np.stack([apply(unit) for unit in np.eye(solver.setup.constraints.size)], axis=1)


@pytest.mark.parametrize("kind", ["lumped", "dirichlet"])
@pytest.mark.parametrize("seed", range(3))
def test_scaling_of_coupled_rows_is_exact_on_every_face(seed, kind):
    """B_D = (B_R D^{-1} B_R')^{-1} B_R D^{-1} of the rows R of the face."""
    rng, blocks = np.random.default_rng(seed), two_blocks(2, 2)
    contacts, tied = random_rows(blocks, rng, 15), random_rows(blocks, rng, 6)
    held = clamped(blocks, (2, 0.0), (2, 2.0))
    solver = TornSolver(
        TornSystem(blocks, held, contacts, 3, tied=tied), Options(preconditioner=kind)
    )
    constraints, system = solver.setup.constraints, DenseSystem.of(solver)
    active = rng.random(15) < 0.6
    on_face = constraints.equality
    on_face[constraints.inequality] = active
    B = system.B[on_face]
    D = np.linalg.inv(system.D)
    B_D = np.linalg.solve(B @ D @ B.T, B @ D)
    plain = solver.setup.preconditioner.apply
    unscaled = np.stack([plain(unit) for unit in np.eye(len(system.B))], axis=1)
    # S from B D^{-1} S D^{-1} B' of all rows, which span all interface unknowns in the range of B'
    span = D @ system.B.T
    left = np.linalg.pinv(span, rcond=1e-12)
    S = left.T @ unscaled @ left
    found = preconditioned(solver, active)[np.ix_(on_face, on_face)]
    exact = B_D @ S @ B_D.T
    np.testing.assert_allclose(found, exact, rtol=0.0, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize("seed", range(3))
def test_what_it_maps_to_zero_is_the_kernel_of_the_rows(seed):
    """More rows at the nodes of a surface than these have components: B_R'y = o for some y."""
    rng, blocks = np.random.default_rng(seed), two_blocks(1, 1)
    contacts = random_rows(blocks, rng, 60)
    held = clamped(blocks, (2, 0.0), (2, 2.0))
    solver = TornSolver(TornSystem(blocks, held, contacts, 3))
    constraints, preconditioner = solver.setup.constraints, solver.setup.preconditioner
    active = rng.random(constraints.inequality.size) < 0.95
    on_face = np.zeros(constraints.size, dtype=bool)
    on_face[constraints.inequality[active]] = True
    y = np.where(on_face, rng.normal(size=constraints.size), 0.0)
    face = Face.of(constraints, active)
    part = preconditioner.kernel_part(y, face)
    B = constraints.matrix.toarray()
    N = scipy.linalg.null_space(B[on_face].T)
    assert N.shape[1] > 0
    np.testing.assert_allclose(part[on_face], N @ (N.T @ y[on_face]), atol=1e-9)
    assert not part[~on_face].any()
    zero = preconditioner.on(face)(part)
    np.testing.assert_allclose(zero, 0.0, atol=1e-8 * np.abs(B).max())


@pytest.mark.parametrize("seed", range(6))
def test_forces_that_turn_by_rounding_do_not_see_the_kernel(seed):
    """Rows of floor and wall that depend on each other act along z and y at the edge of both.

    Forces of the floor along y turn along x. In tangents at any angle rounding leaves something of
    what vanishes; with its square as Hessian the preconditioner would be 10^30.
    """
    solver = TornSolver(in_a_corner(seed), Options(preconditioner="lumped"))
    constraints, preconditioner = solver.setup.constraints, solver.setup.preconditioner
    on_floor = constraints.friction.contact == 0
    active = constraints.rows.of(Kind.CONTACT).contact == 0
    # the component along y of each tangent of the floor
    tangents = np.where(on_floor[:, None], solver.system.friction.tangents[:, :, 1], 0.0)
    across = balls.tangents(balls.directions(tangents))
    face = Face.of(constraints, active, ~on_floor, curvature=np.where(on_floor, 1.0, 0.0))
    assert preconditioner.on_kernel(replace(face, tangents=across)) is None
    # forces along x turn along y, where those of the wall stick: the kernel is seen. They may have
    # a little along y
    tangents = balls.tangents(across) + 1e-8 * across
    turned = preconditioner.on_kernel(replace(face, tangents=tangents))
    x = np.random.default_rng(seed).standard_normal(constraints.size)
    assert 0.0 < np.abs(turned(x)).max() <= 10.0


@pytest.mark.parametrize(("kind", "limit"), [("lumped", 3.0), ("dirichlet", 2.3)])
@pytest.mark.parametrize(("stiffness", "without_W"), [(1e-2, 1.0), (1.0, 6.0), (1e2, 1e4)])
def test_condition_number_of_meshes_that_do_not_match(stiffness, without_W, kind, limit):
    """W keeps that of meshes that match (1.9); without it a fine and stiff slave makes it large."""
    blocks = two_blocks(2, 3, stiffness=stiffness)
    rows = interpolated(blocks, 2, np.array([0.0, 0.0, -1.0]))
    system = TornSystem(blocks, clamped(blocks, (2, 0.0), (2, 2.0)), rows, 3)
    solver = TornSolver(system, Options(preconditioner=kind))
    dense = DenseSystem.of(solver)
    P = dense.projector()
    PFP = P @ dense.F @ P

    def condition(M: np.ndarray) -> float:
        values = np.linalg.eigvals(P @ M @ PFP).real
        there = values > 1e-8 * values.max()
        assert there.sum() == np.linalg.matrix_rank(PFP, tol=1e-10 * np.abs(PFP).max())
        return values[there].max() / values[there].min()

    plain = solver.setup.preconditioner.apply
    unscaled = np.stack([plain(unit) for unit in np.eye(len(dense.B))], axis=1)
    assert condition(preconditioned(solver, np.ones(rows.size, dtype=bool))) <= limit
    assert condition(unscaled) >= without_W


def test_without_preconditioner():
    assert TornSolver(column(), Options(preconditioner="none")).setup.preconditioner is None


@pytest.mark.parametrize(("ratio", "excess", "kind", "reason"), [
    (2.2, 1.0, "lumped", ""),
    (2.2, 5.0, "dirichlet", "flat or graded cells at interfaces"),
    (30.0, 1.0, "dirichlet", "nearly incompressible material"),
])  # fmt: skip
def test_auto(ratio, excess, kind, reason):
    assert Choice.by_data(MPI.COMM_WORLD, [1.0, ratio], [excess, 0.5]) == Choice(kind, reason)
    assert Choice.by_data(MPI.COMM_SELF, [], []).kind == "lumped"

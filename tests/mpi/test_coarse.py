"""The coarse problem on several ranks: redundant and distributed, to equal results."""

from __future__ import annotations

from functools import lru_cache

from mpi4py import MPI

import numpy as np
import pytest
import scipy.sparse as sp
from scenes import Scene, stack_on_ground, two_beams, two_materials
from sparse_rows import distributed
from torn import column

from fenics_tfeti.errors import FactorizationError
from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.coarse.by_rows import AgglomeratedCholesky
from fenics_tfeti.feti.coarse.face_cache import FaceCache
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.factors import cholesky
from fenics_tfeti.report import ContactReport

comm = MPI.COMM_WORLD
pytestmark = pytest.mark.ranks(2, 3)
KINDS = ("redundant", "distributed")
SCENES = {
    "beams": lambda: two_beams(comm, "tetrahedron", 3),
    "materials": lambda: two_materials(comm, "hexahedron", 2),
    "stack": lambda: stack_on_ground(comm, "quadrilateral", 8),
}


def solved(scene: Scene, kind: str) -> tuple[np.ndarray, ContactReport]:
    # conjugate gradients lose orthogonality to converged modes, and then multiply rounding (on the
    # stack by five a step): at 1e-6 it is far below the tolerance, from 1e-8 on it costs steps
    options = {"rtol": 1e-6, "subdomain_size": 150, "coarse_solver": kind}
    problem = scene.problem(options=options)
    return problem.solve().x.array, problem.report


@lru_cache(maxsize=None)
def column_solver(kind: str) -> TornSolver:
    return TornSolver(distributed(column(height=2), comm), Options(coarse_solver=kind))


@pytest.mark.parametrize("name", SCENES)
def test_same_displacement_and_products(name):
    """On one mesh for all kinds of coarse solver.

    On three ranks and more dolfinx may distribute the same mesh in another way when it is made
    again: PT-SCOTCH depends on the order in which messages come.
    """
    scene = SCENES[name]()
    (one, report), *others = (solved(scene, kind) for kind in KINDS)
    size = comm.allreduce(np.abs(one).max(initial=0.0), MPI.MAX)
    for kind, (other, found) in zip(KINDS[1:], others, strict=True):
        np.testing.assert_allclose(other, one, rtol=0.0, atol=1e-8 * size, err_msg=kind)
        assert found.products == report.products, kind


@pytest.mark.parametrize("kind", KINDS)
def test_smalbe_converges(kind):
    options = Options(method="smalbe", coarse_solver=kind)
    assert TornSolver(distributed(column(), comm), options).solve().report.converged


@pytest.mark.parametrize("kind", KINDS)
def test_projections_of_a_sum_of_parts(kind):
    """P, Q and, on a face, y - G'a with the least motion a, here from dense algebra."""
    solver = column_solver(kind)
    constraints, projector = solver.setup.constraints, solver.setup.projector
    layout, space = constraints.layout, projector.coarse_space
    part = np.random.default_rng(comm.rank).standard_normal(layout.numbers.size)
    y = layout.sum(part)
    np.testing.assert_allclose(projector.P_of_sum(part, y)[0], projector.P(y), atol=1e-12)
    square = layout.space.dots((y, y))[0]
    assert projector.remove_rigid_motion(part, y)[1] == pytest.approx(square, rel=1e-13)
    own, Qy = projector.part_of_Q(y)
    np.testing.assert_allclose(Qy, projector.Q(y), atol=1e-13)
    np.testing.assert_allclose(layout.sum(own), Qy, atol=1e-13)
    face = Projector.build(space, Face.supports(constraints))
    G = np.stack([space.prolong(a) for a in np.eye(space.size)], axis=1)
    chosen = constraints.equality & (np.arange(y.size) < layout.owned)
    gram = comm.allreduce(G[chosen].T @ G[chosen])
    a = np.linalg.pinv(gram, rcond=1e-10) @ comm.allreduce(G[chosen].T @ y[chosen])
    np.testing.assert_allclose(face.remove_rigid_motion(part, y)[0], y - G @ a, atol=1e-11)


def test_only_own_rows_are_kept_of_a_distributed_matrix():
    space = column_solver("distributed").setup.projector.coarse_space
    assert space.equality.shape == (space.layout.counts[comm.rank], space.size)


each_number_of_groups = pytest.mark.parametrize("groups", range(1, comm.size + 1))


def own_rows(matrix: sp.csr_matrix) -> sp.csr_matrix:
    """Return two rows for each rank."""
    return matrix[2 * comm.rank : 2 * comm.rank + 2]


@each_number_of_groups
def test_solution_by_the_first_ranks_of_groups(groups):
    """An indefinite matrix is an error on all ranks."""
    n = 2 * comm.size
    matrix = sp.diags(
        [-np.ones(n - 1), np.arange(3.0, n + 3), -np.ones(n - 1)], [-1, 0, 1], format="csr"
    )
    x = np.random.default_rng(0).standard_normal(n)
    own = slice(2 * comm.rank, 2 * comm.rank + 2)
    found = AgglomeratedCholesky(comm, own_rows(matrix), groups).solve((matrix @ x)[own])
    np.testing.assert_allclose(found, x[own], atol=1e-14)
    rows = sp.diags(np.where(np.arange(n) == 1, -1.0, 1.0), format="csr")
    with pytest.raises(FactorizationError, match="not positive definite"):
        AgglomeratedCholesky(comm, own_rows(rows), groups)


def test_workspace_of_mumps_is_increased_where_it_is_too_small(monkeypatch):
    n = 50 * comm.size
    D = sp.diags([-np.ones(n - 1), np.full(n, 3.0), -np.ones(n - 1)], [-1, 0, 1], format="csr")
    matrix = sp.csr_matrix(D @ D @ D @ D)
    own = slice(50 * comm.rank, 50 * comm.rank + 50)
    monkeypatch.setattr(cholesky, "_WORKSPACES", (-90,))
    with pytest.raises(FactorizationError, match="useless"):
        cholesky.DistributedCholesky(comm, matrix[own])
    monkeypatch.setattr(cholesky, "_WORKSPACES", (-90, 100))
    x = cholesky.DistributedCholesky(comm, matrix[own]).solve((matrix @ np.ones(n))[own])
    np.testing.assert_allclose(x, 1.0, atol=1e-12)


def test_faces_are_known_again_on_all_ranks_or_on_none():
    cache = FaceCache(comm)
    constraints = column_solver("redundant").setup.constraints
    none, whole = Face.supports(constraints), Face.whole(constraints)
    cache.keep(none, 0)
    cache.keep(whole, 1)
    assert cache.find(none) == 0
    assert cache.find(whole if comm.rank == comm.size - 1 else none) is None

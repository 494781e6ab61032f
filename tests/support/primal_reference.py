"""The same discrete contact problem, solved without subdomains and without a dual.

Everything here is deliberately naive: one global matrix, node matching by comparing all distances,
a primal-dual active set whose every step is one sparse direct solve of the full Karush-Kuhn-Tucker
system. The package gives the description of contacts only, so agreement with it is evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti import ContactPair, Plane, RigidObstacle, Sphere
from fenics_tfeti.petsc import PETSc

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class PrimalSolution:
    """Minimiser of 1/2 u'Ku - f'u over u = prescribed on the fixed dofs, C u <= gap."""

    displacement: Vector  # (n,)
    forces: Vector  # (m,), >= 0, K u + C' forces = f on the free dofs
    active: NDArray[np.bool_]  # (m,)
    energy: float
    steps: int  # linear systems solved


def primal_active_set(
    K: sp.spmatrix,
    f: Vector,
    fixed_dofs: Numbers,
    fixed_values: Vector,
    C: sp.spmatrix,
    gap: Vector,
    max_steps: int = 60,
    tolerance: float = 1e-10,
) -> PrimalSolution:
    """Solve by the primal-dual active set (semismooth Newton) method and assert the KKT conditions.

    All rows are active at first: a body that only contact holds is then held, and the rows that
    would pull are dropped in the next step. An active set that comes back, or more than `max_steps`
    of them, is an error. All tolerances are relative.
    """
    K, C = sp.csr_matrix(K), sp.csr_matrix(C)
    C.eliminate_zeros()
    f, gap = np.asarray(f, dtype=float), np.asarray(gap, dtype=float)
    n, m = K.shape[0], C.shape[0]
    is_free = np.ones(n, dtype=bool)
    is_free[fixed_dofs] = False
    free = np.flatnonzero(is_free)
    u = np.zeros(n)
    u[fixed_dofs] = fixed_values

    K_ff, C_f = K[free][:, free], C[:, free]
    load, bound = f[free] - (K @ u)[free], gap - C @ u
    # A row between prescribed dofs only cannot be solved for, it can only be true.
    movable = np.diff(C_f.indptr) > 0
    force, active = np.zeros(m), movable.copy()
    stiffness = float(K.diagonal().mean())

    seen: set[bytes] = set()
    steps = 0
    while True:
        if active.tobytes() in seen:
            raise RuntimeError(f"the active set method cycles after {steps} steps")
        if steps == max_steps:
            raise RuntimeError(f"no solution within {max_steps} active set steps")
        seen.add(active.tobytes())
        rows = np.flatnonzero(active)
        u[free], force[:] = 0.0, 0.0
        u[free], force[rows] = _solve_kkt(K_ff, load, C_f[rows], bound[rows], stiffness)
        steps += 1
        indicator = force + stiffness * (C @ u - gap)
        new = movable & (indicator > 0.0)
        # Rounding may flip a row whose force and opening are both zero: it is right either way.
        if np.all(np.abs(indicator[new != active]) <= _noise(force, f, tolerance)):
            break
        active = new

    force = np.where(force > 0.0, force, 0.0)
    _assert_kkt(K, f, free, C, gap, u, force, tolerance)
    return PrimalSolution(u, force, active, float(0.5 * u @ (K @ u) - f @ u), steps)


def _noise(force: Vector, f: Vector, tolerance: float) -> float:
    return tolerance * float(max(np.abs(force).max(initial=0.0), np.abs(f).max(initial=0.0)))


def _solve_kkt(
    K: sp.csr_matrix, load: Vector, C: sp.csr_matrix, bound: Vector, scale: float
) -> tuple[Vector, Vector]:
    """Solve [K C'; C 0] [u; force] = [load; bound] by MUMPS with iterative refinement."""
    n, m = K.shape[0], C.shape[0]
    # The rows are scaled to the stiffness, for pivots of one size.
    matrix = sp.bmat([[K, scale * C.T], [scale * C, sp.csr_matrix((m, m))]], format="csr")
    matrix.sort_indices()
    right = np.concatenate([load, scale * bound])
    petsc_int = PETSc.IntType
    mat = PETSc.Mat().createAIJ(
        matrix.shape,
        csr=(matrix.indptr.astype(petsc_int), matrix.indices.astype(petsc_int), matrix.data),
        comm=MPI.COMM_SELF,
    )
    mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    solver = PETSc.KSP().create(MPI.COMM_SELF)
    solver.setOperators(mat)
    solver.setType("preonly")
    solver.getPC().setType("cholesky")
    solver.getPC().setFactorSolverType("mumps")
    x, residual, correction = np.zeros(n + m), right.copy(), mat.createVecLeft()
    for _ in range(4):
        solver.solve(PETSc.Vec().createWithArray(residual, comm=MPI.COMM_SELF), correction)
        x += correction.array_r
        residual = right - matrix @ x
    solver.destroy()
    mat.destroy()
    if not np.linalg.norm(residual) <= 1e-8 * (np.linalg.norm(right) + np.finfo(float).tiny):
        raise RuntimeError("singular system: the active rows do not hold the bodies")
    return x[:n], scale * x[n:]


def _assert_kkt(
    K: sp.csr_matrix,
    f: Vector,
    free: Numbers,
    C: sp.csr_matrix,
    gap: Vector,
    u: Vector,
    force: Vector,
    tolerance: float,
) -> None:
    residual = (K @ u - f + C.T @ force)[free]
    # Measured against what is balanced: the load may be zero where displacements are prescribed.
    # A body that only moves has nothing to balance but the rounding of its stiffness.
    forces = max(np.linalg.norm(f), np.linalg.norm(K @ u))
    rounding = 1e-14 * np.linalg.norm(K.diagonal() * u)
    length = max(np.abs(u).max(initial=0.0), np.abs(gap).max(initial=0.0))
    opening = gap - C @ u
    largest = force.max(initial=0.0)
    assert np.linalg.norm(residual) <= tolerance * forces + rounding, "equilibrium"
    assert opening.min(initial=0.0) >= -tolerance * length, "non-penetration"
    assert force.min(initial=0.0) >= 0.0, "sign of the contact forces"
    assert np.abs(force * opening).max(initial=0.0) <= tolerance * largest * length, (
        "complementarity"
    )


# -- from dolfinx objects to K, f, C, gap ---------------------------------------------------------


@dataclass(frozen=True)
class ContactForces:
    """One contact's nodal forces, by the slave nodes' block dof numbers, ascending."""

    nodes: Numbers  # (k,)
    coordinates: Vector  # (k, 3)
    normal: Vector  # (k, gdim)
    gap: Vector  # (k,)
    forces: Vector  # (k,)


@dataclass(frozen=True)
class ReferenceSolution:
    """What a contact solver has to reproduce."""

    displacement: Vector  # (n,), the order of V's dofs
    contacts: list[ContactForces]
    energy: float
    steps: int


def reference_solution(
    V: Any, a: Any, L: Any, bcs: Sequence[Any], contacts: Sequence[ContactPair | RigidObstacle]
) -> ReferenceSolution:
    """Assemble the user's problem as a whole and solve it by `primal_active_set`.

    `V` is a vector space of degree 1 on one process, so block dofs are nodes. Of the contacts' data
    tags and obstacles are used.
    """
    from dolfinx import fem
    from dolfinx.fem import petsc

    assert V.mesh.comm.size == 1, "the reference is serial"
    matrix = petsc.assemble_matrix(fem.form(a))
    matrix.assemble()
    indptr, indices, data = matrix.getValuesCSR()
    K = sp.csr_matrix((data, indices, indptr), shape=matrix.getSize())
    f = petsc.assemble_vector(fem.form(L)).array.copy() if L != 0 else np.zeros(K.shape[0])
    prescribed = prescribed_values(V, bcs)
    fixed = np.flatnonzero(~np.isnan(prescribed))

    rows = [_rows(V, contact) for contact in contacts]
    C = sp.vstack([row[0] for row in rows], format="csr")
    gap = np.concatenate([row[1].gap for row in rows])
    solution = primal_active_set(K, f, fixed, prescribed[fixed], C, gap)

    ends = np.cumsum([row[1].gap.size for row in rows])
    parts = np.split(solution.forces, ends[:-1])
    found = [
        ContactForces(row[1].nodes, row[1].coordinates, row[1].normal, row[1].gap, part)
        for row, part in zip(rows, parts, strict=True)
    ]
    return ReferenceSolution(solution.displacement, found, solution.energy, solution.steps)


def prescribed_values(V: Any, bcs: Sequence[Any]) -> Vector:
    """Return the Dirichlet values in V's dof order, NaN where a dof is free."""
    from dolfinx.fem import petsc

    n = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
    values = PETSc.Vec().createWithArray(np.full(n, np.nan), comm=MPI.COMM_SELF)
    petsc.set_bc(values, list(bcs))
    return values.array.copy()


def nodes_of(V: Any, facets: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the block dofs on facets, ascending."""
    from dolfinx import fem

    topology = V.mesh.topology
    topology.create_connectivity(topology.dim - 1, topology.dim)
    return np.unique(fem.locate_dofs_topological(V, topology.dim - 1, facets))


def _surface(obstacle: Any, x: Vector) -> tuple[Vector, Vector]:
    """Return gaps (k,) and outward normals (gdim or 3, k) of an obstacle at points x (3, k)."""
    if isinstance(obstacle, Plane):
        normal = np.array(obstacle.normal) / np.linalg.norm(obstacle.normal)
        gap = normal @ (x[: normal.size] - np.array(obstacle.point)[:, None])
        return gap, np.tile(normal[:, None], x.shape[1])
    if isinstance(obstacle, Sphere):
        away = x[: len(obstacle.centre)] - np.array(obstacle.centre)[:, None]
        distance = np.linalg.norm(away, axis=0)
        return distance - obstacle.radius, away / distance
    return obstacle(x)


def _rows(V: Any, contact: ContactPair | RigidObstacle) -> tuple[sp.csr_matrix, ContactForces]:
    gdim, x = V.mesh.geometry.dim, V.tabulate_dof_coordinates()
    size = V.dofmap.index_map.size_local * gdim
    facets = contact.facet_tags.find(contact.slave)
    slave = nodes_of(V, facets)
    count = slave.size
    if isinstance(contact, RigidObstacle):
        gap, outward = _surface(contact.obstacle, x[slave].T)
        normal = -np.asarray(outward).T[:, :gdim]  # out of the body, as for pairs
        C = _selection(slave, normal, size)
    else:
        master = nodes_of(V, contact.facet_tags.find(contact.master))
        distances = np.linalg.norm(x[slave][:, None, :] - x[master][None, :, :], axis=2)
        master = master[distances.argmin(axis=1)]
        assert np.unique(master).size == count, "two slave nodes share a master node"
        normal = nodal_normals(V, facets, slave)
        gap = np.sum((x[master] - x[slave])[:, :gdim] * normal, axis=1)
        C = _selection(slave, normal, size) - _selection(master, normal, size)
    empty = np.zeros(count)
    return C, ContactForces(slave.astype(np.int64), x[slave], normal, np.asarray(gap), empty)


def _selection(nodes: Numbers, vectors: Vector, size: int) -> sp.csr_matrix:
    """Return the matrix whose row k maps u to u(nodes[k]) . vectors[k]."""
    count, gdim = vectors.shape
    columns = gdim * np.asarray(nodes)[:, None] + np.arange(gdim)
    indptr = gdim * np.arange(count + 1)
    return sp.csr_matrix((vectors.ravel().copy(), columns.ravel(), indptr), shape=(count, size))


def nodal_normals(V: Any, facets: NDArray[np.int32], nodes: NDArray[np.int32]) -> Vector:
    """Return the unit means (k, gdim) of the vector areas of the facets around each node."""
    topology, gdim = V.mesh.topology, V.mesh.geometry.dim
    x = V.tabulate_dof_coordinates()
    topology.create_connectivity(topology.dim - 1, topology.dim)
    to_cells = topology.connectivity(topology.dim - 1, topology.dim)
    sums = np.zeros((x.shape[0], 3))
    for facet in facets:
        corners = nodes_of(V, np.array([facet], dtype=np.int32))
        (cell,) = to_cells.links(int(facet))
        inside = x[V.dofmap.cell_dofs(int(cell))].mean(axis=0)
        sums[corners] += _vector_area(x[corners], inside) / corners.size
    normals = sums[nodes]
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True))[:, :gdim]


def _vector_area(corners: Vector, inside: Vector) -> Vector:
    """Return the integral of the outward normal over a segment, triangle or quadrilateral."""
    centre = corners.mean(axis=0)
    if len(corners) == 2:
        tangent = corners[1] - corners[0]
        area = np.array([tangent[1], -tangent[0], 0.0])
    else:
        # The corners come in no order; sorted by angle in their plane they form the polygon.
        first, second = np.linalg.svd(corners - centre)[2][:2]
        angle = np.arctan2((corners - centre) @ second, (corners - centre) @ first)
        ring = corners[np.argsort(angle)] - centre
        area = 0.5 * np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0)
    return area if area @ (centre - inside) > 0.0 else -area

"""The problem that a fuzz case states, without subdomains: what the oracle is given."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class Springs:
    """Elastic supports: energy 1/2 sum_j stiffness_j (rows_j u)^2."""

    rows: sp.csr_matrix  # (k, n), of any length
    stiffness: Vector  # (k,), positive [N/m]

    def matrix(self) -> sp.csr_matrix:
        """Return the stiffness matrix (n, n)."""
        return (self.rows.T @ sp.diags(self.stiffness) @ self.rows).tocsr()


@dataclass(frozen=True)
class GluedFriction:
    """Friction at some contact rows: |t| <= bound + coefficient * lambda against slips."""

    row: Numbers  # (k,), the contact row of each site
    # S, ((gdim - 1) k, n): tangents at slave nodes, minus those at master nodes
    rows: sp.csr_matrix
    before: Vector  # (k, gdim - 1) [m]; a slip is S u - before
    bound: Vector  # (k,) slip bound [N]
    coefficient: Vector  # (k,), of Coulomb's law

    @property
    def size(self) -> int:
        """Number of sites."""
        return int(self.row.size)

    def slips(self, u: Vector) -> Vector:
        """Return S u - before, (k, gdim - 1)."""
        return (self.rows @ u).reshape(self.before.shape) - self.before

    def at(self, sites: NDArray[np.bool_]) -> GluedFriction:
        """Return some of the sites."""
        rows = self.rows[np.flatnonzero(np.repeat(sites, self.before.shape[1]))]
        return GluedFriction(
            self.row[sites], rows, self.before[sites], self.bound[sites], self.coefficient[sites]
        )


@dataclass(frozen=True)
class GluedProblem:
    """min 1/2 u'(K + springs)u - f'u over u = value on the fixed unknowns, C u <= gap, T u = jump.

    With friction of given bounds r the sum of r |s| of the slips s is added.
    """

    coordinates: Vector  # (nodes, gdim); unknown gdim * node + component is of this node
    body: Numbers  # (nodes,); a node belongs to one body, and bodies are connected
    elastic: sp.csr_matrix  # (n, n), K without springs; its kernel are rigid motions of bodies
    springs: Springs
    load: Vector  # (n,), f
    fixed: Numbers  # (k,), the unknowns with a prescribed value
    values: Vector  # (k,)
    rows: sp.csr_matrix  # (m, n), C: unit normals of slave nodes, minus those of master nodes
    gap: Vector  # (m,), infinite where there is no condition
    contact: Numbers  # (m,), number of the contact
    gap_rounding: Vector  # (m,), rounding of gaps that are differences of coordinates
    tied: sp.csr_matrix = field(default_factory=lambda: sp.csr_matrix((0, 0)))  # (t, n), T
    tied_jump: Vector = field(default_factory=lambda: np.zeros(0))  # (t,)
    friction: GluedFriction | None = None

    def __post_init__(self) -> None:
        """Give the default of T its columns."""
        if self.tied.shape == (0, 0):
            object.__setattr__(self, "tied", sp.csr_matrix((0, self.load.size)))

    @property
    def gdim(self) -> int:
        """2 or 3."""
        return int(self.coordinates.shape[1])

    @property
    def bodies(self) -> int:
        """Number of bodies."""
        return int(self.body.max()) + 1

    @property
    def known(self) -> Vector:
        """The prescribed displacements, zero on free unknowns."""
        u = np.zeros(self.load.size)
        u[self.fixed] = self.values
        return u

    @property
    def is_free(self) -> NDArray[np.bool_]:
        """Where nothing is prescribed."""
        free = np.ones(self.load.size, dtype=bool)
        free[self.fixed] = False
        return free

    def unknowns(self, body: int) -> Numbers:
        """Return the unknowns of a body, ascending."""
        return unknowns_of(np.flatnonzero(self.body == body), self.gdim)

    def body_of_springs(self) -> Numbers:
        """Return the body of each spring."""
        rows = abs(self.springs.rows)
        columns = np.asarray(rows.argmax(axis=1)).ravel() if rows.shape[0] else np.zeros(0, int)
        return self.body[columns // self.gdim]

    def determined_rows(self) -> NDArray[np.bool_]:
        """Tell for which rows no combination of others gives the same forces on free unknowns."""
        C = sp.vstack([self.rows, self.tied]).tocsr()[:, self.is_free].toarray()
        C[: self.gap.size][~np.isfinite(self.gap)] = 0.0
        lengths = np.linalg.norm(C, axis=1)
        C = C / np.maximum(lengths, 1e-300)[:, None]
        gram = C @ C.T
        blocks, block = connected_components(np.abs(gram) > 1e-12, directed=False)
        determined = lengths > 1e-10
        for b in range(blocks):
            at = np.flatnonzero(block == b)
            if at.size > 1 and np.linalg.eigvalsh(gram[np.ix_(at, at)])[0] < 1e-8:
                determined[at] = False
        return determined[: self.gap.size]


def unknowns_of(nodes: Numbers, gdim: int) -> Numbers:
    """Return the unknowns of nodes, node by node."""
    unknowns: Numbers = (gdim * nodes[:, None] + np.arange(gdim)).ravel()
    return unknowns


def rigid_modes(coordinates: Vector) -> Vector:
    """Return an orthonormal basis (n, 3 or 6) of the rigid motions of some nodes."""
    nodes, gdim = coordinates.shape
    x = coordinates - coordinates.mean(axis=0)
    x = x / np.abs(x).max()
    translations = np.tile(np.eye(gdim), (nodes, 1))
    spins = []
    for i, j in [(0, 1)] if gdim == 2 else [(0, 1), (1, 2), (2, 0)]:
        spin = np.zeros((nodes, gdim))
        spin[:, i], spin[:, j] = -x[:, j], x[:, i]
        spins.append(spin.ravel())
    return np.linalg.qr(np.column_stack([translations, *spins]))[0]

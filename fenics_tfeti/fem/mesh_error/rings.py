"""Better tractions between cells, by conjugate gradients preconditioned with facets and rings.

Any change of the moments without a resultant on a cell leaves it in equilibrium, and the sum of the
cells' energies a bound; a few steps of conjugate gradients make it smaller. The preconditioner is
additive. Its unknowns are the tractions without resultant on each facet, and what passes once
around each ring of cells, around a vertex in two dimensions and an edge in three: forces and
moments. Where a ring ends at supports, they are all changes without a resultant on its cells.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

import basix

from fenics_tfeti.fem.geometry.batches import batches
from fenics_tfeti.fem.mesh_error.cell_loops import add_energies
from fenics_tfeti.fem.mesh_error.faces import CellFaces
from fenics_tfeti.fem.mesh_error.neumann import CellEnergies, axes, rotations
from fenics_tfeti.typing import Mask, Numbers, Vector

# numbers in the matrices of rings that are inverted at once
_ENTRIES = 2**20
# stiffness added to a block, relative to its mean: changes of moments may have no energy
_SHIFT = 1e-8
# how forces pass a ring
_CLOSED, _OPEN, _CUT = 0, 1, 2
# singular values, relative to the largest one, that are zero
_SINGULAR = 1e-9


@dataclass(frozen=True)
class Block:
    """Blocks of the preconditioner with the same numbers of facets and unknowns."""

    facets: Numbers  # (r, j)
    basis: Vector  # (r, j * m, z): changes of the moments
    inverse: Vector  # (r, z, z): of their energy
    sums: sp.csr_matrix  # (facets, r * j): of values at the blocks' facets


@dataclass(frozen=True)
class Rings:
    """The rings of equally many cells c: their cells, and in each the two facets at the ring."""

    cells: Numbers  # (r, c)
    local: Numbers  # (r, c, 2)


class FacetMap:
    """Changes of moments on facets, the same seen from both sides, and on cells.

    Facets of g cells are numbered; their m moments are in the order of the nodes' numbers.
    """

    def __init__(self, faces: CellFaces, rows: Numbers, free: Mask) -> None:
        """Take g cells, and the moments (g, f, d) on their facets that may change."""
        d, nodes = faces.dim, faces.facet_nodes(rows)
        g, f, t = nodes.shape
        _, numbers = np.unique(faces.facets[rows], return_inverse=True)
        self.facets: Numbers = numbers.reshape(g, f)
        self.count, self.moments = int(self.facets.max(initial=-1)) + 1, t * d
        order = np.argsort(nodes, axis=2)
        # places of a facet's moments among those of a cell
        of_facet = (order[..., None] * d + np.arange(d)).reshape(g, f, t * d)
        self.places: Numbers = of_facet + t * d * np.arange(f)[:, None]
        first = np.full(self.count, g)
        cell = np.broadcast_to(np.arange(g)[:, None], (g, f))
        np.minimum.at(first, self.facets, cell)
        self.is_single: Mask = np.bincount(self.facets.ravel(), minlength=self.count) == 1
        self.sign: Vector = np.where(first[self.facets] == cell, 1.0, -1.0)
        may_change = np.zeros((self.count, t, d), dtype=bool)
        may_change[self.facets] = free[:, :, None, :]
        self.free: Mask = may_change.reshape(self.count, t * d)
        x = faces.node_points(faces.degree, rows)[:, faces.closure]
        self.points = np.zeros((self.count, t, d))
        self.points[self.facets] = np.take_along_axis(x, order[..., None], axis=2)
        self._sides = self._matrix()

    def _matrix(self) -> sp.csr_matrix:
        """Return the matrix (g * f * m, facets * m) from facets to the sides of cells."""
        g, f, m = self.places.shape
        columns = np.empty((g, f * m), dtype=np.int32)
        of_facets = m * self.facets[..., None] + np.arange(m)
        np.put_along_axis(columns, self.places.reshape(g, -1), of_facets.reshape(g, -1), axis=1)
        values = np.repeat(self.sign.ravel(), m)
        ends = np.arange(columns.size + 1)
        return sp.csr_matrix((values, columns.ravel(), ends), (columns.size, self.count * m))

    def to_facets(self, values: Vector) -> Vector:
        """Sum up values (g, f * m, v) of cells on facets (facets, m, v)."""
        v = values.shape[2]
        return np.asarray(self._sides.T @ values.reshape(-1, v)).reshape(-1, self.moments, v)

    def to_cells(self, values: Vector) -> Vector:
        """Return values (facets, m, v) from the sides of the cells (g, f * m, v)."""
        v = values.shape[2]
        return np.asarray(self._sides @ values.reshape(-1, v)).reshape(len(self.facets), -1, v)

    def cells(self) -> tuple[Numbers, Numbers]:
        """Return the one or two cells (facets, 2) at each facet, or -1, and its number in them."""
        order = np.argsort(self.facets.ravel(), kind="stable")
        first = np.searchsorted(self.facets.ravel()[order], np.arange(self.count))
        at = order[np.stack([first, first + np.where(self.is_single, 0, 1)], axis=1)]
        cell, local = np.divmod(at, self.facets.shape[1])
        cell[self.is_single, 1] = -1
        return cell, local


def improved_energies(
    faces: CellFaces, rows: Numbers, free: Mask, energies: CellEnergies, steps: int
) -> list[Vector]:
    """Return the energies (g, v) of some cells after 0, 1, ... steps of conjugate gradients.

    `free` (g, f, d) are the moments that may change: none between these cells and others.
    """
    facets = FacetMap(faces, rows, free)
    blocks = list(_blocks(facets, _rings(faces, rows), energies.matrix))
    g, Q = energies.gradient, energies.matrix
    dm, Qdm, r = np.zeros_like(g), np.zeros_like(g), -facets.to_facets(g)
    history, p, old = [energies.constant], np.zeros_like(r), np.ones(g.shape[2])
    for _ in range(steps):
        z = _preconditioned(blocks, r)
        rho = _dots(r, z)
        p = z + rho / old * p
        old = np.where(rho > 0.0, rho, 1.0)
        pc = facets.to_cells(p)
        Qp = Q @ pc
        curvature = _dots(pc, Qp)
        alpha = np.where(curvature > 0.0, rho / np.where(curvature > 0.0, curvature, 1.0), 0.0)
        dm, Qdm, r = dm + alpha * pc, Qdm + alpha * Qp, r - alpha * facets.to_facets(Qp)
        change = np.einsum("ksv,ksv->kv", dm, 2.0 * g + Qdm)
        history.append(energies.constant + change)
    return history


def _preconditioned(blocks: list[Block], r: Vector) -> Vector:
    total = np.zeros((len(r), r[0].size))
    for block in blocks:
        n, j = block.facets.shape
        local = r[block.facets].reshape(n, -1, r.shape[2])
        y = block.basis @ (block.inverse @ (block.basis.transpose(0, 2, 1) @ local))
        total += block.sums @ y.reshape(n * j, -1)
    return total.reshape(r.shape)


def _dots(x: Vector, y: Vector) -> Vector:
    """Return the products (v,) of the columns of x and y (k, m, v)."""
    return np.array([np.vdot(x[..., i], y[..., i]) for i in range(x.shape[2])])


def _rings(faces: CellFaces, rows: Numbers) -> Iterator[Rings]:
    """Yield the rings of some cells; cells are numbered among them."""
    d, domain = faces.dim, faces.space.mesh
    entities = basix.topology(getattr(basix.CellType, faces.kind.name))[d - 2]
    at_entity = np.array(
        [[f for f, v in enumerate(faces.kind.facets) if set(e) <= set(v)] for e in entities]
    )
    domain.topology.create_entities(d - 2)
    domain.topology.create_connectivity(d, d - 2)
    table = np.asarray(domain.topology.connectivity(d, d - 2).array).reshape(-1, len(at_entity))
    entity = table[faces.cells[rows]].ravel()
    cell, local = np.divmod(np.arange(entity.size), len(at_entity))
    by_entity = np.argsort(entity, kind="stable")
    first = np.flatnonzero(np.diff(entity[by_entity], prepend=-1))
    count = np.diff(np.append(first, entity.size))
    for c in np.unique(count):
        pairs = by_entity[first[count == c][:, None] + np.arange(c)]
        yield Rings(cell[pairs], at_entity[local[pairs]])


def _blocks(facets: FacetMap, rings: Iterator[Rings], Q: Vector) -> Iterator[Block]:
    """Yield the blocks of all facets and rings, equally large ones at once."""
    statics = _Statics(facets)
    may_change = facets.free.all(axis=1)[:, None, None]
    cell, local = facets.cells()
    of_facets = np.arange(facets.count)[:, None]
    basis = (statics.without * may_change)[:, None]
    yield from _inverted(facets, of_facets, Rings(cell, local[..., None]), basis, Q)
    for ring in rings:
        of_ring = facets.facets[ring.cells[..., None], ring.local].reshape(len(ring.cells), -1)
        of_ring = np.sort(of_ring, axis=1)
        is_new = np.diff(of_ring, axis=1, prepend=-1) != 0
        number = np.count_nonzero(is_new, axis=1)
        passed = _passes(facets, ring, number)
        for j, how in np.unique(np.column_stack([number, passed]), axis=0):
            if how == _CUT:
                continue
            same = np.flatnonzero((number == j) & (passed == how))
            for batch in batches(same.size, max(1, _ENTRIES // int(j * facets.moments) ** 2)):
                chosen = same[batch]
                own = of_ring[chosen][is_new[chosen]].reshape(-1, j)
                part = Rings(ring.cells[chosen], ring.local[chosen])
                changes = _RingChanges(facets, statics, part, own)
                basis = changes.closed() if how == _CLOSED else changes.open()
                yield from _inverted(facets, own, part, basis, Q)


def _inverted(
    facets: FacetMap, own: Numbers, at: Rings, basis: Vector, Q: Vector
) -> Iterator[Block]:
    """Yield the blocks of changes (r, j, m, z) on facets (r, j), where they have energy."""
    if not basis.size:
        return
    r, j, m, z = basis.shape
    energy = np.zeros((r, z, z))
    cells = at.cells[..., None]
    place = (facets.facets[cells, at.local][..., None] == own[:, None, None, :]).argmax(axis=3)
    sign, places = facets.sign[cells, at.local], facets.places[cells, at.local]
    add_energies(energy, at.cells, places, place, sign, basis, Q)
    trace = np.trace(energy, axis1=1, axis2=2)
    live = trace > 0.0
    if live.any():
        energy = energy[live]
        # changes without energy have no gradient
        energy[:, np.arange(z), np.arange(z)] += _SHIFT * trace[live, None] / z
        own = own[live]
        ends = np.arange(own.size + 1)
        sums = sp.csc_matrix((np.ones(own.size), own.ravel(), ends), (facets.count, own.size))
        basis = basis[live].reshape(-1, j * m, z)
        yield Block(own, basis, np.linalg.inv(energy), sums.tocsr())


def _passes(facets: FacetMap, rings: Rings, number: Numbers) -> Numbers:
    """Tell how forces pass rings (r,) with some numbers of facets.

    They do once around closed ones, not at all where no end is supported, or in some way.
    """
    of_cells = facets.facets[rings.cells[..., None], rings.local]
    is_end_free = facets.is_single[of_cells] & facets.free[of_cells].any(axis=3)
    is_closed = number == rings.cells.shape[1]
    return np.where(is_closed, _CLOSED, np.where(is_end_free.any(axis=(1, 2)), _OPEN, _CUT))


class _Statics:
    """Resultants of tractions on facets."""

    def __init__(self, facets: FacetMap) -> None:
        x, d = facets.points, facets.points.shape[2]
        self.middle = x.mean(axis=1)
        arms = np.linalg.norm(x - self.middle[:, None], axis=2)
        self.length = arms.max(initial=0.0) or 1.0
        forces = np.tile(np.eye(d), (len(x), x.shape[1], 1))
        moments = rotations(x) / self.length
        # (facets, m, resultants)
        resultants = np.concatenate([forces, moments], axis=2)
        self.number = n = resultants.shape[2]
        self.of_facets = resultants.transpose(0, 2, 1)
        # tractions without a resultant, and those with unit ones
        Q, R = np.linalg.qr(resultants, mode="complete")
        self.without = Q[:, :, n:]
        self.unit = Q[:, :, :n] @ np.linalg.inv(R[:, :n]).transpose(0, 2, 1)


class _RingChanges:
    """Changes of the moments on the j facets of r rings without resultant on any of their cells."""

    def __init__(self, facets: FacetMap, statics: _Statics, rings: Rings, of_ring: Numbers) -> None:
        self._facets, self._statics, self._own = facets, statics, of_ring
        own = facets.facets[rings.cells[..., None], rings.local]
        # place (r, c, 2) of the facets of each cell among those of the ring
        self._place = (own[..., None] == of_ring[:, None, None, :]).argmax(axis=3)
        self._sign = facets.sign[rings.cells[..., None], rings.local]
        middle = statics.middle[of_ring]
        self._arm = (middle - middle.mean(axis=1, keepdims=True)) / statics.length

    def _shifted(self, matrix: Vector, j: int) -> Vector:
        """Return resultants (r, n, m) on a facet about the middle of the ring."""
        d, about = self._arm.shape[2], matrix.copy()
        for q, (a, b) in enumerate(axes(d)):
            about[:, d + q] += self._arm[:, j, a, None] * matrix[:, b]
            about[:, d + q] -= self._arm[:, j, b, None] * matrix[:, a]
        return about

    def closed(self) -> Vector:
        """Return the changes (r, j, m, n) of unit forces and moments that pass once around."""
        statics, (r, j) = self._statics, self._own.shape
        Z = np.zeros((r, j, self._facets.moments, statics.number))
        sense = self._senses()
        back = np.tile(np.eye(statics.number), (r, 1, 1))
        for k in range(j):
            # unit resultants about the middle of the ring, by those about the facet's
            shift = 2.0 * back - self._shifted(back, k)
            Z[:, k] = sense[:, k, None, None] * (statics.unit[self._own[:, k]] @ shift)
        return Z

    def _senses(self) -> Vector:
        """Return the sense (r, j) in which a force passes each facet, found by walking around."""
        r, j = self._own.shape
        sense, every = np.zeros((r, j)), np.arange(r)
        sense[every, self._place[:, 0, 0]] = 1.0
        for _ in range(j):
            for q in range(j):
                turn = -self._sign[:, q, 0] * self._sign[:, q, 1]
                for one, other in ((0, 1), (1, 0)):
                    a, b = self._place[:, q, one], self._place[:, q, other]
                    new = turn * sense[every, a]
                    sense[every, b] = np.where(sense[every, b] == 0.0, new, sense[every, b])
        return sense

    def open(self) -> Vector:
        """Return changes (r, j, m, z) of moments that may change, without resultants on cells.

        The ring ends at the boundary, where some components may be supported.
        """
        statics, (r, j) = self._statics, self._own.shape
        c, m = self._place.shape[1], self._facets.moments
        G = np.zeros((r, c, statics.number, j, m))
        free = self._facets.free[self._own]
        for k in range(j):
            about = self._shifted(statics.of_facets[self._own[:, k]], k) * free[:, k, None]
            for q in range(c):
                for side in range(2):
                    here = self._place[:, q, side] == k
                    G[here, q, :, k] += self._sign[here, q, side, None, None] * about[here]
        _, values, rows = np.linalg.svd(G.reshape(r, -1, j * m))
        values = np.pad(values, ((0, 0), (0, j * m - values.shape[1])))
        largest = np.maximum(values.max(axis=1, keepdims=True), np.finfo(float).tiny)
        Z = np.where((values < _SINGULAR * largest)[..., None], rows, 0.0).transpose(0, 2, 1)
        Z = (Z * free.reshape(r, -1, 1)).reshape(r, j, m, -1)
        return np.asarray(Z[..., np.abs(Z).max(axis=(0, 1, 2)) > 0.0])

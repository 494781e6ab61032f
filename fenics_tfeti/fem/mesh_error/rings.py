"""Better tractions between cells, by conjugate gradients preconditioned with rings of cells.

Any change of the moments without a resultant on a cell leaves it in equilibrium, and the sum of the
cells' energies a bound; a few steps of conjugate gradients make it smaller. The preconditioner is
additive: a ring are the cells around a vertex in two dimensions, around an edge in three. Its
unknowns are the tractions without resultant on each of its facets, and the forces and moments that
pass once around a closed ring.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import basix

from fenics_tfeti.fem.mesh_error.faces import CellFaces, add_rows
from fenics_tfeti.fem.mesh_error.neumann import CellEnergies, axes, rotations
from fenics_tfeti.fem.topology import batches
from fenics_tfeti.typing import Mask, Numbers, Vector

# numbers in the matrices of the rings that are inverted at once
_ENTRIES = 2**20
# stiffness added to a ring, relative to its mean: changes of moments may have no energy
_SHIFT = 1e-8
# how forces pass a ring
_CLOSED, _OPEN, _CUT = 0, 1, 2
# singular values, relative to the largest one, that are zero
_SINGULAR = 1e-9


@dataclass(frozen=True)
class RingBlock:
    """Blocks of rings with the same numbers of facets and unknowns."""

    facets: Numbers  # (r, j)
    basis: Vector  # (r, j * m, z): changes of the moments
    inverse: Vector  # (r, z, z): of their energy


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
        t = nodes.shape[2]
        _, numbers = np.unique(faces.facets[rows], return_inverse=True)
        self.facets: Numbers = numbers.reshape(faces.facets[rows].shape)  # (g, f)
        self.count, self.moments = int(self.facets.max(initial=-1)) + 1, t * d
        order = np.argsort(nodes, axis=2)
        self.order = (order[..., None] * d + np.arange(d)).reshape(*self.facets.shape, t * d)
        first = np.full(self.count, rows.size)
        cell = np.broadcast_to(np.arange(rows.size)[:, None], self.facets.shape)
        np.minimum.at(first, self.facets, cell)
        self.is_single: Mask = np.bincount(self.facets.ravel(), minlength=self.count) == 1
        self.sign: Vector = np.where(first[self.facets] == cell, 1.0, -1.0)
        may_change = np.zeros((self.count, t, d), dtype=bool)
        may_change[self.facets] = free[:, :, None, :]
        self.free: Mask = may_change.reshape(self.count, t * d)
        x = faces.node_points(faces.degree, rows)[:, faces.closure]
        self.points = np.zeros((self.count, t, d))
        self.points[self.facets] = np.take_along_axis(x, order[..., None], axis=2)

    def to_facets(self, values: Vector) -> Vector:
        """Sum up values (g, f * m, v) of cells on facets (facets, m, v)."""
        total = np.zeros((self.count, self.moments, values.shape[2]))
        values = values.reshape(*self.order.shape, -1)
        for f in range(self.facets.shape[1]):
            ordered = np.take_along_axis(values[:, f], self.order[:, f, :, None], axis=1)
            add_rows(total, self.facets[:, f], self.sign[:, f, None, None] * ordered)
        return total

    def to_cells(self, values: Vector) -> Vector:
        """Return values (facets, m, v) from the sides of the cells (g, f * m, v)."""
        cells = np.zeros((*self.order.shape, values.shape[2]))
        for f in range(self.facets.shape[1]):
            own = self.sign[:, f, None, None] * values[self.facets[:, f]]
            np.put_along_axis(cells[:, f], self.order[:, f, :, None], own, axis=1)
        return cells.reshape(len(cells), -1, values.shape[2])


def improved_energies(
    faces: CellFaces, rows: Numbers, free: Mask, energies: CellEnergies, steps: int
) -> list[Vector]:
    """Return the energies (g, v) of some cells after 0, 1, ... steps of conjugate gradients.

    `free` (g, f, d) are the moments that may change: none between these cells and others.
    """
    facets = FacetMap(faces, rows, free)
    blocks = list(_blocks(facets, list(_rings(faces, rows)), energies.matrix))
    g, Q = energies.gradient, energies.matrix
    dm, Qdm, r = np.zeros_like(g), np.zeros_like(g), -facets.to_facets(g)
    history, p, old = [energies.constant], np.zeros_like(r), np.ones(g.shape[2])
    for _ in range(steps):
        z = _preconditioned(blocks, r)
        rho = np.sum(r * z, axis=(0, 1))
        p = z + rho / old * p
        old = np.where(rho > 0.0, rho, 1.0)
        pc = facets.to_cells(p)
        Qp = Q @ pc
        curvature = np.sum(pc * Qp, axis=(0, 1))
        alpha = np.where(curvature > 0.0, rho / np.where(curvature > 0.0, curvature, 1.0), 0.0)
        dm, Qdm, r = dm + alpha * pc, Qdm + alpha * Qp, r - alpha * facets.to_facets(Qp)
        change = 2.0 * np.sum(g * dm, axis=1) + np.sum(dm * Qdm, axis=1)
        history.append(energies.constant + change)
    return history


def _preconditioned(blocks: list[RingBlock], r: Vector) -> Vector:
    total = np.zeros_like(r)
    for block in blocks:
        n, j = block.facets.shape
        local = r[block.facets].reshape(n, -1, r.shape[2])
        y = block.basis @ (block.inverse @ (block.basis.transpose(0, 2, 1) @ local))
        add_rows(total, block.facets.ravel(), y.reshape(n * j, -1))
    return total


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


def _blocks(facets: FacetMap, rings: list[Rings], Q: Vector) -> Iterator[RingBlock]:
    """Yield the blocks of all rings, equally large ones at once."""
    statics = _Statics(facets)
    f = facets.facets.shape[1]
    Q = Q.reshape(len(Q), f, facets.moments, f, facets.moments)
    for ring in rings:
        of_ring = facets.facets[ring.cells[..., None], ring.local].reshape(len(ring.cells), -1)
        of_ring = np.sort(of_ring, axis=1)
        is_new = np.diff(of_ring, axis=1, prepend=-1) != 0
        number = np.count_nonzero(is_new, axis=1)
        passed = _passes(facets, ring, number)
        for j, how in np.unique(np.column_stack([number, passed]), axis=0):
            same = np.flatnonzero((number == j) & (passed == how))
            for batch in batches(same.size, max(1, _ENTRIES // int(j * facets.moments) ** 2)):
                chosen = same[batch]
                own = of_ring[chosen][is_new[chosen]].reshape(-1, j)
                part = Rings(ring.cells[chosen], ring.local[chosen])
                yield from _RingBasis(facets, statics, part, own, int(how)).inverted(Q)


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
        # (facets, resultants, m)
        self.of_facets = np.concatenate([forces, moments], axis=2).transpose(0, 2, 1)
        self.number = self.of_facets.shape[1]
        # tractions without a resultant, and those with unit ones
        self.without = np.linalg.svd(self.of_facets)[2][:, self.number :].transpose(0, 2, 1)
        self.unit = np.linalg.pinv(self.of_facets)


class _RingBasis:
    """Changes of the moments on the facets of r rings without resultant on any of their cells."""

    def __init__(
        self, facets: FacetMap, statics: _Statics, rings: Rings, of_ring: Numbers, how: int
    ) -> None:
        self._facets, self._statics, self._rings, self._own = facets, statics, rings, of_ring
        cells, local = rings.cells, rings.local
        own = facets.facets[cells[..., None], local]
        # place (r, c, 2) of the facets of each cell among those of the ring
        self._place = (own[..., None] == of_ring[:, None, None, :]).argmax(axis=3)
        self._sign = facets.sign[cells[..., None], local]
        middle = statics.middle[of_ring]
        self._arm = (middle - middle.mean(axis=1, keepdims=True)) / statics.length
        make = {_CLOSED: self._closed, _OPEN: self._open, _CUT: self._cut}[how]
        self.basis: Vector = make()  # (r, j, m, z)

    def _shifted(self, matrix: Vector, j: int) -> Vector:
        """Return resultants (r, n, m) on a facet about the middle of the ring."""
        d, about = self._arm.shape[2], matrix.copy()
        for q, (a, b) in enumerate(axes(d)):
            about[:, d + q] += self._arm[:, j, a, None] * matrix[:, b]
            about[:, d + q] -= self._arm[:, j, b, None] * matrix[:, a]
        return about

    def _closed(self) -> Vector:
        """Return tractions without resultant on each facet, and those that pass once around."""
        statics, (r, j) = self._statics, self._own.shape
        n, free = statics.number, statics.without.shape[2]
        m = self._facets.moments
        Z = np.zeros((r, j, m, j * free + n))
        sense = self._senses()
        back = np.tile(np.eye(n), (r, 1, 1))
        for k in range(j):
            Z[:, k, :, k * free : (k + 1) * free] = statics.without[self._own[:, k]]
            # unit resultants about the middle of the ring, by those about the facet's
            shift = 2.0 * back - self._shifted(back, k)
            Z[:, k, :, j * free :] = sense[:, k, None, None] * (
                statics.unit[self._own[:, k]] @ shift
            )
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

    def _cut(self) -> Vector:
        """Return tractions without resultant on each facet that may change."""
        statics, (r, j) = self._statics, self._own.shape
        free = statics.without.shape[2]
        Z = np.zeros((r, j, self._facets.moments, j * free))
        may_change = self._facets.free[self._own].all(axis=2)
        for k in range(j):
            on_facet = statics.without[self._own[:, k]] * may_change[:, k, None, None]
            Z[:, k, :, k * free : (k + 1) * free] = on_facet
        return Z

    def _open(self) -> Vector:
        """Return the null space of the resultants on the cells, of moments that may change.

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

    def inverted(self, Q: Vector) -> Iterator[RingBlock]:
        """Yield the blocks with the inverses of their energies, where there is any."""
        if not self.basis.size:
            return
        cells, local, (r, j, m, z) = self._rings.cells, self._rings.local, self.basis.shape
        every, energy = np.arange(r), np.zeros((r, z, z))
        for q in range(cells.shape[1]):
            of_cell = np.zeros((r, 2, m, z))
            for side in range(2):
                values = (
                    self._sign[:, q, side, None, None] * self.basis[every, self._place[:, q, side]]
                )
                order = self._facets.order[cells[:, q], local[:, q, side]]
                order = np.broadcast_to(order[..., None], values.shape)
                np.put_along_axis(of_cell[:, side], order, values, axis=1)
            of_cell = of_cell.reshape(r, 2 * m, z)
            pairs = cells[:, q, None, None], local[:, q, :, None], local[:, q, None, :]
            of_pairs = Q[pairs[0], pairs[1], :, pairs[2], :].transpose(0, 1, 3, 2, 4)
            energy += of_cell.transpose(0, 2, 1) @ of_pairs.reshape(r, 2 * m, 2 * m) @ of_cell
        live = np.trace(energy, axis1=1, axis2=2) > 0.0
        if live.any():
            basis = self.basis[live].reshape(-1, j * m, z)
            energy = energy[live]
            # changes without energy have no gradient
            shift = _SHIFT * np.trace(energy, axis1=1, axis2=2) / z
            energy[:, np.arange(z), np.arange(z)] += shift[:, None]
            yield RingBlock(self._own[live], basis, np.linalg.inv(energy))

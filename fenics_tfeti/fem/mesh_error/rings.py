"""Better tractions between cells, by conjugate gradients preconditioned with facets and rings.

Any change of the moments without a resultant on a cell leaves it in equilibrium, and the sum of the
cells' energies a bound; a few steps of conjugate gradients make it smaller. The preconditioner is
additive. Its unknowns are the tractions without resultant on each facet, and what passes once
around each ring of cells, around a vertex in two dimensions and an edge in three: forces and
moments. Where a ring ends at supports, or at cells that springs hold, they are all changes without
a resultant on its cells that moves these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

import basix

from fenics_tfeti.fem.mesh_error.cell_loops import CellLoops, numbered, ordered
from fenics_tfeti.fem.mesh_error.faces import CellFaces
from fenics_tfeti.fem.mesh_error.neumann import CellEnergies, NeumannProblems, motions
from fenics_tfeti.fem.mesh_error.tractions import FacetKinds
from fenics_tfeti.typing import Array, Indices, Numbers, Vector

# stiffness added to a block, relative to each entry: changes of moments may have no energy
_SHIFT = 1e-8
# how forces pass a ring, as in the C code: in some way between supported ends
_OPEN = 1
# singular values, relative to the largest one, that are zero
_SINGULAR = 1e-9


class FacetMap:
    """The facets of g cells, numbered, with their m moments in the order of the nodes' numbers."""

    def __init__(
        self, neumann: NeumannProblems, rows: Numbers, kinds: FacetKinds, energies: CellEnergies
    ) -> None:
        """Take some cells; no moments change between these and others."""
        faces = neumann.faces
        self.neumann, self.rows = neumann, rows
        d, f = faces.dim, len(faces.closure)
        self.facets, self._side, self._place = numbered(faces.facets[rows], faces.facet_nodes(rows))
        self.is_single = self._side[:, 1] < 0
        cell, local = np.divmod(self._side[:, 0], f)
        nodes = faces.closure[local[:, None], self._place[cell, local]]
        x = faces.node_points(faces.degree, rows)[cell[:, None], nodes]
        self.points, self.middle = x, np.ascontiguousarray(x.mean(axis=1))
        arms = np.linalg.norm(x - self.middle[:, None], axis=2)
        self.length = float(arms.max(initial=0.0)) or 1.0
        at = rows[cell], local
        is_end = self.is_single & kinds.single[at]
        self.free = kinds.free[at] & (~self.is_single | is_end)[:, None]
        # forces may end at supports, and at cells that springs hold
        self.may_end = is_end & (self.free.any(axis=1) | energies.resisted[cell])
        self.moments, self.energies = x.shape[1] * d, energies
        matrices, v = (energies.number, energies.matrix), energies.constant.shape[1]
        self.loops = CellLoops(
            self.facets, self._side, self._place, matrices, self.middle, self.length, v
        )

    def places(self, cells: Numbers, local: Numbers) -> Numbers:
        """Return the places (..., m) of facets' moments among those of some cells."""
        d, t = self.free.shape[1], self._place.shape[2]
        order = self._place[cells, local]
        places = (local[..., None] * t + order)[..., None] * d + np.arange(d)
        return places.reshape(*order.shape[:-1], self.moments)

    def to_cells(self, values: Vector) -> Vector:
        """Return values (facets, m, v) from the sides of the cells (g, s, v)."""
        g, f = self.facets.shape
        cells, local = np.arange(g)[:, None], np.broadcast_to(np.arange(f), (g, f))
        out = np.empty((g, f * self.moments, values.shape[2]))
        signs = self.sign(cells, local)[..., None, None]
        out[cells[..., None], self.places(cells, local)] = signs * values[self.facets]
        return out

    def sign(self, cells: Numbers, local: Numbers) -> Vector:
        """Return the signs (...) of the sides of some cells."""
        f = self.facets.shape[1]
        is_first = self._side[self.facets[cells, local], 0] == cells * f + local
        return np.where(is_first, 1.0, -1.0)


def improved_energies(
    neumann: NeumannProblems, rows: Numbers, kinds: FacetKinds, energies: CellEnergies, steps: int
) -> tuple[Vector, Callable[[], Vector]]:
    """Return the energies (g, v) of some cells after steps of conjugate gradients.

    The energies and gradients given change. The function that is returned, too, computes the
    changes (g, s, v) of the moments.
    """
    facets = FacetMap(neumann, rows, kinds, energies)
    loops = facets.loops
    preconditioner = _Preconditioner(facets, *_rings(neumann.faces, rows))
    v = energies.constant.shape[1]
    p, old = np.zeros((len(facets.free), facets.moments, v)), np.ones(v)
    change = np.zeros_like(p)
    r = -loops.to_facets(energies.gradient)
    for _ in range(steps):
        z = preconditioner(r)
        rho = _dots(r, z)
        p = z + rho / old * p
        old = np.where(rho > 0.0, rho, 1.0)
        Qp = loops.stiffness(p)
        total = loops.to_facets(Qp)
        curvature = _dots(p, total)
        alpha = np.where(curvature > 0.0, rho / np.where(curvature > 0.0, curvature, 1.0), 0.0)
        loops.advance(alpha, p, Qp, energies.gradient, energies.constant)
        change += alpha * p
        r -= alpha * total
    return energies.constant, lambda: facets.to_cells(change)


def _dots(x: Vector, y: Vector) -> Vector:
    """Return the products (v,) of the columns of x and y (k, m, v)."""
    return np.array([np.vdot(x[..., i], y[..., i]) for i in range(x.shape[2])])


def _rings(faces: CellFaces, rows: Numbers) -> tuple[Indices, Indices]:
    """Return the entities (g, e) around which there are rings, numbered, and the facets at each.

    They are vertices in two dimensions, edges in three, told apart by their vertices' nodes.
    """
    entities = basix.topology(getattr(basix.CellType, faces.kind.name))[faces.dim - 2]
    at_entity = np.array(
        [[f for f, v in enumerate(faces.kind.facets) if set(e) <= set(v)] for e in entities],
        dtype=np.int32,
    )
    vertices = np.sort(faces.nodes[rows][:, np.array(entities)], axis=2).astype(np.int64)
    keys = vertices[..., 0] * faces.node_count + vertices[..., -1]
    _, number = np.unique(keys, return_inverse=True)
    return number.reshape(rows.size, -1).astype(np.int32), at_entity


class _Preconditioner:
    """The inverses of the energies of changes on facets and around rings."""

    def __init__(self, facets: FacetMap, entities: Indices, at_entity: Indices) -> None:
        loops = self._loops = facets.loops
        order, first = ordered(entities, int(entities.max(initial=-1)) + 1)
        tractions = loops.facet_tractions(facets.points)
        facet, sense, how, middle = loops.walk(first, order, at_entity, facets.may_end)
        rings, may_change = (entities, at_entity, how, middle), facets.free.all(axis=1)
        inverses = loops.inverses(rings, may_change, tractions, _SHIFT)
        self._rings: tuple[Array, ...] = (first, facet, sense, how, middle, *tractions, *inverses)
        self._open = list(_open_rings(facets, order, first, how, at_entity))

    def __call__(self, r: Vector) -> Vector:
        """Return the sum of what all inverses give for a residual (facets, m, v)."""
        total = self._loops.preconditioned(r, self._rings)
        for block in self._open:
            block.add(r, total)
        return total


@dataclass(frozen=True)
class _Block:
    """Rings with the same numbers of facets and changes."""

    facets: Numbers  # (r, j)
    basis: Vector  # (r, j * m, z): changes of the moments
    inverse: Vector  # (r, z, z): of their energy

    def add(self, residual: Vector, total: Vector) -> None:
        (r, j), (_, m, v) = self.facets.shape, residual.shape
        local = residual[self.facets].reshape(r, j * m, v)
        y = self.basis @ (self.inverse @ (self.basis.transpose(0, 2, 1) @ local))
        np.add.at(total, self.facets.ravel(), y.reshape(r * j, m, v))


def _open_rings(
    facets: FacetMap, order: Indices, first: Indices, how: Indices, at_entity: Indices
) -> Iterator[_Block]:
    """Yield the blocks of rings with supported ends, those with equally many cells at once."""
    count = np.diff(first)
    for c in np.unique(count[how == _OPEN]):
        places = order[first[:-1][(how == _OPEN) & (count == c)][:, None] + np.arange(c)]
        cells, local = np.divmod(places, len(at_entity))
        local = at_entity[local]
        of_ring = np.sort(facets.facets[cells[..., None], local].reshape(len(cells), -1), axis=1)
        is_new = np.diff(of_ring, axis=1, prepend=-1) != 0
        number = np.count_nonzero(is_new, axis=1)
        for j in np.unique(number):
            same = number == j
            own = of_ring[same][is_new[same]].reshape(-1, j)
            basis = _without_resultants(facets, own, cells[same], local[same])
            if basis.shape[2]:
                energy = _energies(facets, own, cells[same], local[same], basis)
                yield _Block(own, basis, _inverse(energy))


def _without_resultants(facets: FacetMap, own: Numbers, cells: Numbers, local: Numbers) -> Vector:
    """Return changes (r, j * m, z) of moments that may change, without resultants on cells.

    The r rings have the facets `own` (r, j), and in their cells (r, c) the facets `local`
    (r, c, 2).
    """
    (r, j), c, d, m = own.shape, cells.shape[1], facets.free.shape[1], facets.moments
    x, length = facets.points[own], facets.length
    middle = x.mean(axis=(1, 2))
    arm = (x - middle[:, None, None]) / length
    resultants = motions(arm.reshape(r, -1, d)).reshape(r, j, m, -1)
    may = np.tile(facets.free[own], m // d)[..., None]
    G = np.zeros((r, c, resultants.shape[3], j, m))
    on = (resultants * may).transpose(0, 1, 3, 2)
    every = np.arange(r)
    for q in range(c):
        for side in range(2):
            at = cells[:, q], local[:, q, side]
            k = (facets.facets[at][:, None] == own).argmax(axis=1)
            G[every, q, :, k] += facets.sign(*at)[:, None, None] * on[every, k]
        held = np.flatnonzero(facets.energies.resisted[cells[:, q]])
        if held.size:
            of_cells = facets.rows[cells[held, q]]
            free = facets.neumann.free_motions(of_cells, middle[held], length)
            G[held, q] = np.einsum("rab,rbjm->rajm", free, G[held, q])
    _, values, rows = np.linalg.svd(G.reshape(r, -1, j * m))
    values = np.pad(values, ((0, 0), (0, j * m - values.shape[1])))
    largest = np.maximum(values.max(axis=1, keepdims=True), np.finfo(float).tiny)
    Z = np.where((values < _SINGULAR * largest)[..., None], rows, 0.0).transpose(0, 2, 1)
    # of those that may not change at all, rounding is left
    Z = Z * may.reshape(r, -1, 1)
    Z = np.where(np.abs(Z).max(axis=1, keepdims=True) > _SINGULAR, Z, 0.0)
    return np.asarray(Z[..., np.abs(Z).max(axis=(0, 1)) > 0.0])


def _energies(
    facets: FacetMap, own: Numbers, cells: Numbers, local: Numbers, basis: Vector
) -> Vector:
    """Return the energies (r, z, z) of changes on the facets of rings."""
    (r, j), m, every = own.shape, facets.moments, np.arange(len(own))
    changes = basis.reshape(r, j, m, -1)
    energy = np.zeros((r, basis.shape[2], basis.shape[2]))
    for q in range(cells.shape[1]):
        Z, rows = [], []
        for side in range(2):
            at = cells[:, q], local[:, q, side]
            k = (facets.facets[at][:, None] == own).argmax(axis=1)
            Z.append(facets.sign(*at)[:, None, None] * changes[every, k])
            rows.append(facets.places(*at))
        of_cell, at_rows = np.concatenate(Z, axis=1), np.concatenate(rows, axis=1)
        number = facets.energies.number[cells[:, q]][:, None, None]
        Q = facets.energies.matrix[number, at_rows[:, :, None], at_rows[:, None, :]]
        energy += of_cell.transpose(0, 2, 1) @ Q @ of_cell
    return energy


def _inverse(energy: Vector) -> Vector:
    """Return inverses (r, z, z), zero where changes have no energy: these have no gradient."""
    z = energy.shape[1]
    trace = np.trace(energy, axis1=1, axis2=2)
    energy[:, np.arange(z), np.arange(z)] += np.where(trace > 0.0, _SHIFT * trace / z, 1.0)[:, None]
    return np.asarray(np.linalg.inv(energy) * (trace > 0.0)[:, None, None])

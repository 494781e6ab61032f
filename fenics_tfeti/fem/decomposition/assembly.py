"""Stiffness matrices K_i and loads f_i of torn subdomains, from the user's forms (sec. 11.5).

No subdomain has a mesh of its own: the forms are integrated on cells of the user's mesh. K_i
and f_i are sums of element matrices and vectors, which the compiled kernels of the forms give.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp

import ufl
from dolfinx.fem import FunctionSpace

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.decomposition.forms import PreparedForm, prepare_form
from fenics_tfeti.fem.decomposition.parts import Part, find_equal, number_parts, samples
from fenics_tfeti.fem.geometry.batches import batches
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import exterior_cell_facets
from fenics_tfeti.feti.system import Subdomain
from fenics_tfeti.feti.timer import Timer
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Indices, Numbers, Vector

logger = logging.getLogger(__name__)

# numbers in the element matrices of the cells that are assembled at once: 4 MB stay in the cache
_ENTRIES = 2**19
# cells whose element vectors are added at once
_CELLS = 2**13


# copies of the values of the coefficients and constants of a and L, to notice changes
FormValues = tuple[list[Vector], list[Vector]]


@dataclass(frozen=True)
class PreparedForms:
    """The user's forms a and L, ready to be assembled on this rank's subdomains."""

    space: FunctionSpace
    bilinear: PreparedForm
    linear: PreparedForm

    def subdomains(
        self,
        parts: Sequence[Part],
        known: Sequence[Subdomain] | None = None,
        x: Vector | None = None,
    ) -> list[Subdomain]:
        """Assemble K_i and f_i of this rank's subdomains, or only f_i of known ones. Collective.

        `x` are the coordinates (dofs, 3) of the blocked degrees of freedom [m], where they are
        known. Subdomains share K_i if they are congruent, their coefficients and tags are equal and
        `a` is translation invariant; those that are rotated or mirrored, if the matrices of their
        cells are.
        """
        loads = self.loads(parts)
        if known is not None:
            return [replace(old, load=load) for old, load in zip(known, loads, strict=True)]
        x = self.space.tabulate_dof_coordinates() if x is None else x
        x = x[:, : self.space.mesh.geometry.dim]
        to_global = NodeMap(self.space).to_global
        first, stiffness = self._stiffnesses(parts, x)
        return [
            Subdomain(
                stiffness[j],
                load,
                np.ascontiguousarray(x[part.nodes]),
                to_global(part.nodes),
                part.body,
                _frame(part, parts[j]),
            )
            for part, j, load in zip(parts, first, loads, strict=True)
        ]

    def loads(self, parts: Sequence[Part]) -> list[Vector]:
        """Assemble f_i of this rank's subdomains."""
        block, ends = self.space.dofmap.index_map_bs, [0]
        cells, tables = [np.zeros(0, dtype=np.int32)], [np.zeros((0, 1), dtype=np.int32)]
        for part in parts:
            rows = self.linear.integrated(part.cells)
            cells.append(part.cells[rows])
            tables.append(part.table[rows] + ends[-1])
            ends.append(ends[-1] + part.nodes.size)
        load, chosen = np.zeros(block * ends[-1]), np.concatenate(cells)
        nodes = np.concatenate(tables[1:] or tables)
        for batch in batches(chosen.size, _CELLS):
            vectors = self.cell_loads(chosen[batch])
            unknowns = block * nodes[batch, :, None] + np.arange(block)
            # cells are part by part: few parts at once
            first = unknowns.min()
            added = np.bincount((unknowns - first).ravel(), vectors.ravel())
            load[first : first + added.size] += added
        return [load[block * i : block * j].copy() for i, j in pairwise(ends)]

    def cell_matrices(self, cells: Indices) -> Vector:
        """Return the matrices (m, n, n) of some of this rank's cells, their nodes in order."""
        return self.bilinear.element_tensors(self.space.mesh, self.size, cells)

    def cell_loads(self, cells: Indices) -> Vector:
        """Return the loads (m, n) of some of this rank's cells."""
        return self.linear.element_tensors(self.space.mesh, self.size, cells)

    @property
    def size(self) -> int:
        """The number of unknowns of a cell."""
        return _compat.cell_dofs(self.space).shape[1] * int(self.space.dofmap.index_map_bs)

    def values(self) -> FormValues:
        """Return the present values of the forms' coefficients and constants. Collective."""
        with raise_collectively(self.space.mesh.comm):
            return self.bilinear.values(), self.linear.values()

    def _stiffnesses(
        self, parts: Sequence[Part], x: Vector
    ) -> tuple[list[int], dict[int, sp.csr_matrix]]:
        """Assemble one matrix for all parts with equal data; return the part that it is of."""
        form = self.bilinear
        data = form.cell_data()
        sample_cells = samples(parts, data) if form.translation_invariant else {}
        matrices = self._sample_matrices(parts, sample_cells)
        first = find_equal(parts, x, data, form.translation_invariant, matrices)
        different = sorted(set(first))
        logger.info(
            "rank %d: %d subdomains have %d different stiffness matrices",
            self.space.mesh.comm.rank,
            len(parts),
            len(different),
        )
        return first, {i: self.stiffness(parts[i]) for i in different}

    def stiffness(self, part: Part) -> sp.csr_matrix:
        """Assemble K_i of a part, a few of its cells at a time."""
        block = self.space.dofmap.index_map_bs
        pattern = part.pattern(block)
        data = np.zeros(pattern.indices.size)
        size = (part.table.shape[1] * block) ** 2
        rows = np.flatnonzero(self.bilinear.integrated(part.cells))
        for batch in (rows[some] for some in batches(rows.size, max(1, _ENTRIES // size))):
            pattern.add(data, batch, self.cell_matrices(part.cells[batch]))
        return pattern.matrix(data)

    def _sample_matrices(
        self, parts: Sequence[Part], cells: Mapping[int, Numbers]
    ) -> dict[int, Vector]:
        """Return matrices of cells, by position in a part, in the frames of the parts' shapes."""
        matrices, block = dict[int, Vector](), self.space.dofmap.index_map_bs
        for i, rows in cells.items():
            part = parts[i]
            # in the order that cells of images have, too
            nodes = np.argsort(part.table[rows], axis=1)
            order = (block * nodes[:, :, None] + np.arange(block)).reshape(len(rows), -1)
            K = self.cell_matrices(part.cells[rows])
            K = np.take_along_axis(K, order[:, :, None], axis=1)
            matrices[i] = np.take_along_axis(K, order[:, None, :], axis=2)
            if part.rotation is not None:
                T = np.kron(np.eye(nodes.shape[1]), part.rotation)
                matrices[i] = T.T @ matrices[i] @ T
        return matrices


def prepare_forms(
    space: FunctionSpace, a: ufl.Form, L: ufl.Form, compiler: _compat.CompilerOptions | None = None
) -> PreparedForms:
    """Check and compile the user's forms on the displacement's space. Collective."""
    exterior = exterior_cell_facets(space.mesh)
    return PreparedForms(
        space,
        prepare_form(space.mesh, a, "bilinear form a (the stiffness)", exterior, compiler),
        prepare_form(space.mesh, L, "linear form L (the load)", exterior, compiler),
    )


def same_values(old: Sequence[Vector], new: Sequence[Vector], comm: MPI.Intracomm) -> bool:
    """Tell whether values are unchanged on all ranks. Collective."""
    equal = all(np.array_equal(x, y) for x, y in zip(old, new, strict=True))
    return bool(comm.allreduce(equal, MPI.LAND))


def _frame(part: Part, first: Part) -> Vector | None:
    """Return the matrix that turns the first part of a class to one of its members."""
    if part.rotation is first.rotation:
        return None
    if first.rotation is None:
        return part.rotation
    return first.rotation.T if part.rotation is None else part.rotation @ first.rotation.T


class TornMesh:
    """Subdomains of a mesh, by their cells; collective.

    Those of rigid bodies are left out. The others are assembled again only where something changed.
    Coordinates `x` (dofs, 3) are those of the blocked degrees of freedom [m].
    """

    def __init__(
        self, forms: PreparedForms, bodies: Bodies, cells: list[Indices], x: Vector, timer: Timer
    ) -> None:
        self.forms, self._space, self._bodies, self._timer = forms, forms.space, bodies, timer
        self._cells, self._rigid_cells = list[Indices](), list[Indices]()
        for part in cells:
            is_rigid = bodies.of_cell[part[0]] >= bodies.deformable
            (self._rigid_cells if is_rigid else self._cells).append(part)
        self.place_nodes(x)

    def place_nodes(self, x: Vector) -> None:
        """Take the nodes where they are now; all is assembled anew."""
        with self._timer.phase("partition"):
            self._parts = self._numbered(self._cells, x)
            self._rigid_parts = self._numbered(self._rigid_cells, x)
        self._values: FormValues | None = None  # with which the subdomains were assembled
        self._subdomains: list[Subdomain] = []
        # last: after an error above, the nodes count as moved in the next solve too
        self._nodes, self._x = x, self._space.mesh.geometry.x.copy()

    def _numbered(self, cells: Sequence[Indices], x: Vector) -> list[Part]:
        bodies = [self._bodies.of_cell[part[0]] for part in cells]
        return number_parts(self._space, cells, bodies, x)

    @property
    def subdomains(self) -> list[Subdomain]:
        """The subdomains as they were assembled last."""
        return list(self._subdomains)

    def has_moved(self) -> bool:
        """Tell whether nodes were moved since `place_nodes`."""
        domain = self._space.mesh
        return not same_values([self._x], [domain.geometry.x], domain.comm)

    def has_same_values(self) -> bool:
        """Tell whether the data of the forms are those of the last assembly. Collective."""
        comm, old = self._space.mesh.comm, self._values
        if old is None:
            return False
        new = self.forms.values()
        return same_values(old[0], new[0], comm) and same_values(old[1], new[1], comm)

    def assemble(self, release: Callable[[], None] | None = None) -> list[Subdomain]:
        """Assemble what changed: the loads, or all after `release` of what the caller holds."""
        comm, old, new = self._space.mesh.comm, self._values, self.forms.values()
        self._values = None  # after an error all is assembled anew
        if old is None or not same_values(old[0], new[0], comm):
            self._subdomains = []
            if release is not None:
                release()
            self._subdomains = self._assembled(None)
            if old is None:
                # most problems are assembled once
                for part in self._parts:
                    part.patterns.clear()
        elif not same_values(old[1], new[1], comm):
            self._subdomains = self._assembled(self._subdomains)
        self._values = new
        return self.subdomains

    def _assembled(self, known: Sequence[Subdomain] | None) -> list[Subdomain]:
        with self._timer.phase("assembly"):
            return self.forms.subdomains(self._parts, known, self._nodes)

    def at_cells(self, displacements: Sequence[Vector]) -> tuple[Indices, Vector, Indices]:
        """Return the cells of the subdomains, displacements (nodes, gdim), and rows (cells, n).

        Displacements (n_i,) are those of the subdomains; those of rigid bodies may follow. Rows are
        those of the nodes of cells.
        """
        gdim = self._space.dofmap.index_map_bs
        cells, values = [np.zeros(0, dtype=np.int32)], [np.zeros((0, gdim))]
        rows = [np.zeros((0, _compat.cell_dofs(self._space).shape[1]), dtype=np.int32)]
        first = 0
        for part, u in zip(self._parts, displacements, strict=False):
            cells.append(part.cells)
            values.append(u.reshape(-1, gdim))
            rows.append(part.table + np.int32(first))
            first += len(values[-1])
        return np.concatenate(cells), np.concatenate(values), np.concatenate(rows)

    def matrices(self, forms: PreparedForms) -> list[sp.csr_matrix]:
        """Return the matrices of other forms on the subdomains. Collective."""
        with self._timer.phase("assembly"):
            return [forms.stiffness(part) for part in self._parts]

    def load(self, forms: PreparedForms | None = None, rigid: bool = False) -> Vector:
        """Return the load (nodes, gdim) at the nodes that this rank owns now [N]. Collective.

        It is that on the subdomains, or on the cells of rigid bodies.
        """
        nodes, parts = NodeMap(self._space), self._rigid_parts if rigid else self._parts
        with self._timer.phase("assembly"):
            loads = (forms or self.forms).loads(parts)
            at = [np.zeros(0, dtype=np.int32), *(part.nodes for part in parts)]
            values = np.concatenate([np.zeros(0), *loads]).reshape(-1, nodes.components)
            return nodes.reduce_at_owners(nodes.to_global(np.concatenate(at)), values)

"""Stiffness matrices K_i and loads f_i of torn subdomains, from the user's forms (sec. 11.5).

No subdomain has a mesh of its own: the forms are integrated on the user's mesh with a torn space,
in which cells share nodes within a subdomain only. The matrix on it is block diagonal, with K_i as
blocks.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

import ufl
from dolfinx.fem import FunctionSpace

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.forms import PreparedForm, prepare_form
from fenics_tfeti.fem.decomposition.parts import Part, find_equal, samples
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import exterior_cell_facets
from fenics_tfeti.feti.system import Subdomain
from fenics_tfeti.parallel import raise_collectively

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class FormValues:
    """Copies of the values of the coefficients and constants of a and L, to notice changes."""

    bilinear: list[NDArray[np.float64]]
    linear: list[NDArray[np.float64]]


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
        x: NDArray[np.float64] | None = None,
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

    def loads(self, parts: Sequence[Part]) -> list[NDArray[np.float64]]:
        """Assemble f_i of this rank's subdomains. Collective."""
        V, ends = self._torn_space(parts)
        load = _compat.assemble_load(self.linear.bind([V], [part.cells for part in parts]))
        return [load[begin:end].copy() for begin, end in pairwise(ends)]

    def cell_matrices(self, cells: NDArray[np.int32]) -> list[NDArray[np.float64]]:
        """Return the matrices of some of this rank's cells, their nodes in order. Collective."""
        nodes = _compat.cell_dofs(self.space)[cells]
        table = np.arange(nodes.shape[1], dtype=np.int32)[None]
        parts = [Part(cells[i : i + 1], nodes[i], table, 0) for i in range(len(cells))]
        return [K.toarray() for K in self._assembled(parts)]

    def values(self) -> FormValues:
        """Return the present values of the forms' coefficients and constants. Collective."""
        with raise_collectively(self.space.mesh.comm):
            return FormValues(self.bilinear.values(), self.linear.values())

    def _stiffnesses(
        self, parts: Sequence[Part], x: NDArray[np.float64]
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
        blocks = self._assembled([parts[i] for i in different])
        return first, dict(zip(different, blocks, strict=True))

    def _assembled(self, parts: Sequence[Part]) -> list[sp.csr_matrix]:
        V, ends = self._torn_space(parts)
        bound = self.bilinear.bind([V, V], [part.cells for part in parts])
        indptr, indices, values = _compat.assemble_stiffness(bound)
        return [
            _diagonal_block(indptr, indices, values, begin, end) for begin, end in pairwise(ends)
        ]

    def _sample_matrices(
        self, parts: Sequence[Part], cells: Mapping[int, NDArray[np.int64]]
    ) -> dict[int, NDArray[np.float64]]:
        """Return the matrices of some cells of some parts, in the frames of the parts' shapes.

        Collective, also for ranks without such parts. `cells` are positions, for each of these
        parts.
        """
        torn = list[Part]()
        for i, rows in cells.items():
            # in the order that cells of images have, too
            order = np.argsort(parts[i].table[rows], axis=1)
            table = np.empty_like(order, dtype=np.int32)
            np.put_along_axis(table, order, np.arange(order.size).reshape(order.shape), axis=1)
            nodes = np.take_along_axis(parts[i].table[rows], order, axis=1)
            torn.append(Part(parts[i].cells[rows], parts[i].nodes[nodes.ravel()], table, 0))
        matrices = dict[int, NDArray[np.float64]]()
        if not self.space.mesh.comm.allreduce(bool(torn), MPI.LOR):
            return matrices
        for i, K, part in zip(cells, self._assembled(torn), torn, strict=True):
            count, nodes_of_cell = part.table.shape
            size = K.shape[0] // count
            entries = K.tocoo()
            matrices[i] = np.zeros((count, size, size))
            matrices[i][entries.row // size, entries.row % size, entries.col % size] = entries.data
            rotation = parts[i].rotation
            if rotation is not None:
                T = np.kron(np.eye(nodes_of_cell), rotation)
                matrices[i] = T.T @ matrices[i] @ T
        return matrices

    def _torn_space(self, parts: Sequence[Part]) -> tuple[FunctionSpace, list[int]]:
        """Return a space with the parts' nodes, part by part, and the parts' first unknowns."""
        ends = np.cumsum([0, *(part.nodes.size for part in parts)])
        # dolfinx needs nodes on all cells: those of no part share one node behind all others
        dofs = np.full(_compat.cell_dofs(self.space).shape, ends[-1], dtype=np.int32)
        for part, begin in zip(parts, ends, strict=False):
            dofs[part.cells] = part.table + begin
        block = self.space.dofmap.index_map_bs
        return _compat.space_with_dofs(self.space, dofs, int(ends[-1]) + 1), list(block * ends)


def prepare_forms(
    space: FunctionSpace,
    a: ufl.Form,
    L: ufl.Form,
    compiler: _compat.CompilerOptions | None = None,
) -> PreparedForms:
    """Check and compile the user's forms on the displacement's space. Collective."""
    exterior = exterior_cell_facets(space.mesh)
    return PreparedForms(
        space,
        prepare_form(space, a, "bilinear form a (the stiffness)", exterior, compiler),
        prepare_form(space, L, "linear form L (the load)", exterior, compiler),
    )


def same_values(
    old: Sequence[NDArray[np.float64]], new: Sequence[NDArray[np.float64]], comm: MPI.Intracomm
) -> bool:
    """Tell whether values are unchanged on all ranks. Collective."""
    equal = all(np.array_equal(x, y) for x, y in zip(old, new, strict=True))
    return bool(comm.allreduce(equal, MPI.LAND))


def _frame(part: Part, first: Part) -> NDArray[np.float64] | None:
    """Return the matrix that turns the first part of a class to one of its members."""
    if part.rotation is first.rotation:
        return None
    if first.rotation is None:
        return part.rotation
    return first.rotation.T if part.rotation is None else part.rotation @ first.rotation.T


def _diagonal_block(
    indptr: NDArray[Any], indices: NDArray[Any], data: NDArray[np.float64], begin: int, end: int
) -> sp.csr_matrix:
    """Return a diagonal block of a block diagonal matrix; its data are a view."""
    entries = slice(indptr[begin], indptr[end])
    local = (data[entries], indices[entries] - begin, indptr[begin : end + 1] - indptr[begin])
    return sp.csr_matrix(local, shape=(end - begin, end - begin))

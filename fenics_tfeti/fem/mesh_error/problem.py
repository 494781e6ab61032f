"""The problems of all cells of a solution: tractions in equilibrium, energies of errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.solution.solved import SolvedContacts
from fenics_tfeti.fem.decomposition.round_parts import cut_into_slabs
from fenics_tfeti.fem.displacement import prescribed_components
from fenics_tfeti.fem.geometry.batches import batches
from fenics_tfeti.fem.mesh_error.cell_loops import ordered, subtract_internal
from fenics_tfeti.fem.mesh_error.contact import facets_of, gap_energies, remarks
from fenics_tfeti.fem.mesh_error.faces import CellFaces
from fenics_tfeti.fem.mesh_error.neumann import NeumannProblems
from fenics_tfeti.fem.mesh_error.rings import improved_energies
from fenics_tfeti.fem.mesh_error.stress import CellStress
from fenics_tfeti.fem.mesh_error.tractions import (
    FacetKinds,
    Tractions,
    equilibrated_tractions,
    over_ranks,
    own_moments,
)
from fenics_tfeti.fem.topology import exterior_facets
from fenics_tfeti.fem.torn_problem import TornProblem
from fenics_tfeti.typing import Indices, Numbers, Vector

# steps of conjugate gradients: more of them make the estimate smaller by a hundredth
_STEPS = 5
# bytes of the matrices of the cells that are kept at once
_BYTES = 2**25
# numbers of the matrices with which forces are computed at once
_NUMBERS = 2**18
# forces of a cell, relative to those of its stiffness and displacements one by one, that are none
_ROUNDING = 1e-12


class MeshErrorProblem:
    """The problems of all cells of a solution, with tractions in equilibrium. Collective.

    `displacements` are those of the subdomains, torn: their forces balance the multipliers. With
    finite strains the forms are those at the total displacement, `linearised_at`, where only the
    load is not zero.
    """

    def __init__(
        self,
        torn: TornProblem,
        solved: SolvedContacts,
        displacements: Sequence[Vector],
        is_exact: bool,
        linearised_at: Function | None = None,
    ) -> None:
        self.torn, self.nodes, self.solved, self.is_exact = torn, torn.nodes, solved, is_exact
        self.is_linearised = linearised_at is not None
        cells, self._displacements, self._of_cells = torn.torn.at_cells(displacements)
        moves = None
        if linearised_at is not None:
            nodal = linearised_at.x.array.reshape(-1, torn.space.mesh.geometry.dim)
            moves = nodal[_compat.cell_dofs(torn.space)[cells]]
        self._moves = moves
        self.faces = CellFaces(torn.space, cells, moves)
        forms = torn.torn.forms
        self.neumann = NeumannProblems(
            self.faces,
            forms.bilinear.form,
            forms.linear.form,
            torn.compiler,
            self.is_linearised,
        )
        self._groups = self._in_groups()
        self.kinds = self._kinds()
        self.tractions = self._tractions()

    def u(self, rows: Numbers | slice) -> Vector:
        """Return the displacements (g, n, d) of some cells, zero at finite strains [m]."""
        u = self._displacements[self._of_cells[rows]]
        return np.zeros_like(u) if self.is_linearised else u

    def _total(self, rows: Numbers | slice, u: Vector) -> Vector:
        """Return the total displacements, at finite strains other ones."""
        return u if self._moves is None else self._moves[rows]

    def _kinds(self) -> FacetKinds:
        """Find what acts on facets. Collective."""
        faces, contact_set = self.faces, self.solved.contact_set
        self.surfaces = {
            entry.number: facets_of(faces, self.nodes, entry) for entry in contact_set.entries
        }
        exterior = exterior_facets(faces.space.mesh)[faces.facets]
        contact = np.zeros_like(exterior)
        for mask in self.surfaces.values():
            contact |= mask & exterior
        fixed = prescribed_components(self.nodes, contact_set.prescribed)
        fixed = over_ranks(self.nodes, fixed, np.logical_or)
        return FacetKinds.of(faces, self.nodes, contact, exterior, fixed)

    def _tractions(self) -> Tractions:
        """Find tractions in equilibrium. Collective."""
        own = own_moments(self.faces, self._stress())
        residual, rounding = self._forces()
        return equilibrated_tractions(self.faces, self.nodes, self.kinds, own, residual, rounding)

    def _stress(self) -> CellStress:
        """Return the stress of the torn displacements. Collective."""
        faces, forms = self.faces, self.torn.torn.forms
        W = _compat.lagrange_space(faces.space.mesh, faces.degree, faces.dim, discontinuous=True)
        w = Function(W)
        values, dofs = w.x.array.reshape(-1, faces.dim), _compat.cell_dofs(W)
        for batch in batches(faces.size, max(1, _NUMBERS // faces.closure.size)):
            values[dofs[faces.cells[batch]]] = self.u(batch)
        points = faces.stress_rule.points.reshape(-1, faces.dim)
        return CellStress(forms.bilinear, forms.linear, w, points)

    def _forces(self) -> tuple[Vector, float]:
        """Return the forces L - a(u, .) (k, n, d) of each cell, and what rounding may make [N]."""
        faces, forms = self.faces, self.torn.torn.forms
        residual, rounding = np.zeros((*faces.nodes.shape, faces.dim)), 0.0
        forces_of_cell = faces.nodes.shape[1] * faces.dim
        for batch in batches(faces.size, max(1, _NUMBERS // forces_of_cell**2)):
            cells, u = faces.cells[batch], self.u(batch)
            A, load = forms.cell_matrices(cells), forms.cell_loads(cells)
            number = np.arange(len(u), dtype=np.int32)
            subtract_internal(number, A, u.reshape(len(u), -1), load[:, :, None])
            residual[batch] = load.reshape(u.shape)
            total = np.abs(self._total(batch, u)).reshape(len(u), -1)
            sizes = np.zeros_like(load)
            subtract_internal(number, np.abs(A), total, sizes[:, :, None])
            rounding = max(rounding, -_ROUNDING * float(sizes.min(initial=0.0)))
        return residual, rounding

    def energies(
        self, steps: int = _STEPS, use: Callable[[Numbers, Vector], None] | None = None
    ) -> tuple[Vector, Vector]:
        """Return the squares (k, 2) of the errors after some steps, and energies (k,) [J].

        The squares are those with contact forces shared in two ways. The moments (g, f, t, d, v) of
        some cells are given to `use`, with their rows.
        """
        errors, energies = np.zeros((self.faces.size, 2)), np.zeros(self.faces.size)
        order, first = self._groups
        for begin, end in pairwise(first):
            rows = order[begin:end].astype(np.int64)
            u = self.u(rows)
            moments = self.tractions.of(rows)
            of_group = self.neumann.energies(rows, u, self._total(rows, u), moments)
            energies[rows] = of_group.solution
            errors[rows], changes = improved_energies(
                self.neumann, rows, self.kinds, of_group, steps
            )
            if use is not None:
                use(rows, moments + changes().reshape(moments.shape))
        return errors, energies

    def gap_energies(self) -> Vector:
        """Return the energies (k, 2) of contact pressures over gaps [J]. Collective."""
        return gap_energies(self.faces, self.nodes, self.solved, self.is_exact)

    def remarks(self) -> tuple[str, ...]:
        """Say at which contacts the estimate is too small. Collective."""
        return tuple(remarks(self.faces, self.nodes, self.solved, self.is_exact))

    def _in_groups(self) -> tuple[Indices, Indices]:
        """Return the rows of cells, group by group of neighbours, and the first of each group.

        The matrices of a group are kept at once.
        """
        faces = self.faces
        count = -(-faces.size * self.neumann.bytes // _BYTES)
        if count <= 1:
            return np.arange(faces.size, dtype=np.int32), np.array([0, faces.size], dtype=np.int32)
        graph = self.torn.bodies.graph[faces.cells][:, faces.cells]
        label = cut_into_slabs(graph, faces.node_points(1).mean(axis=1), count)
        return ordered(label, int(label.max()) + 1)

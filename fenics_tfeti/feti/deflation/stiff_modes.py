"""Stiff modes of nearly incompressible subdomains: large eigenvalues of S v = theta D v.

S is the Schur complement of the interface unknowns of a subdomain, and D, the weights, the
stiffness of shear. Displacements of the interface that change the volume of the subdomain, or of
cells that the interior cannot make up for, cost the bulk modulus: theta is up to kappa / mu. The
Dirichlet preconditioner is as large, since B_D'r has such parts, while F is moderate.

The preconditioner takes weights with these modes (`dual.deluxe_scaling`). Where they are too many
for that, theta is replaced by a moderate number in it, which then is too small for forces
that act on these modes: pressures. The one that matters most, the constant pressure in a subdomain,
is deflated: with the force f of a dilatation, deflating B D^{-1} f leaves f'D^{-1} B'r = o on the
equality rows. To deflate all large modes takes fewer products, but more time, and the modes of
neighbours depend on each other so nearly that accuracy is lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.constraints.dual_layout import seeded_vector
from fenics_tfeti.feti.constraints.interface import Interface
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.deflation.local_spectra import LocalVectors, new_directions
from fenics_tfeti.feti.local.congruence import of_subdomains
from fenics_tfeti.typing import Numbers, Operator, Vector

# the largest theta in the preconditioner: 30 to 100 take about as many products
CAP = 50.0
# vectors of all subdomains that are deflated at most
MOST = 600
# columns of a block of the Lanczos method, products with it, and those after which a subdomain
# without stiff modes is given up
_BLOCK, _STEPS, _TRIAL = 10, 12, 3
# modes, of the columns of all blocks, that are too many: there are others, of which the Lanczos
# method knows nothing yet. Where displacements lock they are a large part of all
_MANY = 60
# entries of a vector, relative to its largest, that are left out
_SMALL = 1e-8


@dataclass(frozen=True)
class StiffModes:
    """Eigenvectors of D^{-1/2} S D^{-1/2} of a class of congruent subdomains."""

    values: Vector  # (k,): theta, descending
    vectors: Vector  # (b, k): orthonormal
    root: Vector  # (b,): D^{1/2} of the interface unknowns
    dilatation: Vector  # (k,): of the vectors, the forces that a dilatation of the subdomain takes

    @staticmethod
    def build(reaction: Operator, weights: Vector, coordinates: Vector) -> StiffModes:
        """Find the modes with theta above the cap by a block Lanczos method.

        The reaction is S for rows (k, b), the weights (b,) are D [N/m], and the coordinates (b,)
        those components of the nodes that the unknowns are of [m].
        """
        root = np.sqrt(weights)
        forces = reaction(coordinates[None])[0] / root
        seeds = np.arange(root.size * (_BLOCK - 1)).reshape(root.size, _BLOCK - 1)
        block = np.column_stack([forces, seeded_vector(seeds)])
        basis, images = np.zeros((root.size, 0)), np.zeros((root.size, 0))
        values, vectors = np.zeros(0), np.zeros((0, 0))
        for step in range(1, _STEPS + 1):
            block = new_directions(basis, block)
            if block.shape[1]:
                image = reaction((block / root[:, None]).T).T / root[:, None]
                basis, images = np.hstack([basis, block]), np.hstack([images, image])
            if step in (_TRIAL, _STEPS) or not block.shape[1]:
                gram = basis.T @ images
                values, vectors = np.linalg.eigh(0.5 * (gram + gram.T))
                if not block.shape[1] or values.max(initial=0.0) <= CAP:
                    break
            block = image
        stiff = np.flatnonzero(values > CAP)[::-1]
        if stiff.size > _MANY:
            stiff = stiff[:0]
        modes = basis @ vectors[:, stiff]
        return StiffModes(values[stiff], modes, root, modes.T @ forces)

    def capped(self, reaction: Operator) -> Operator:
        """Return S with theta cut off at the cap: positive semidefinite for any vectors."""
        forces, displacements = self.root[:, None] * self.vectors, self.vectors / self.root[:, None]

        def apply(u: Vector) -> Vector:
            size = u @ forces
            result = reaction(u - size @ displacements.T)
            result -= (result @ displacements - CAP * size) @ forces.T
            return result

        return apply

    @property
    def deflated(self) -> Vector:
        """The part D^{-1/2} v (b,) of a dilatation in the modes, zero if there are none."""
        return self.vectors @ self.dilatation / self.root


def deflated_vectors(
    constraints: Constraints, interface: Interface, modes: Sequence[StiffModes | None]
) -> LocalVectors:
    """Return B D^{-1} f on the equality rows, f of the dilatations of all subdomains."""
    columns = [
        sp.csr_matrix((unknowns.size, 0)) if stiff is None else sp.csr_matrix(stiff.deflated).T
        for unknowns, stiff in zip(interface.unknowns, modes, strict=True)
    ]
    blocks = [sp.csr_matrix((0, 0)), *of_subdomains(interface.classes, columns)]
    equality = np.flatnonzero(constraints.equality)
    C = (interface.matrix[equality] @ sp.block_diag(blocks, format="csr")).tocsc()
    numbers = constraints.layout.numbers[equality]
    rows, entries = list[Numbers](), list[Vector]()
    for begin, end in zip(C.indptr[:-1], C.indptr[1:], strict=True):
        column, places = C.data[begin:end], C.indices[begin:end]
        kept = np.abs(column) > _SMALL * np.abs(column).max(initial=0.0)
        if kept.any():
            rows.append(numbers[places[kept]])
            entries.append(column[kept] / np.linalg.norm(column[kept]))
    return LocalVectors(rows, entries, np.ones(len(rows)), 0, twice=False)

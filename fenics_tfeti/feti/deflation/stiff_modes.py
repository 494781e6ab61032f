"""Stiff modes of nearly incompressible subdomains: large eigenvalues of S v = theta D v.

S is the Schur complement of the interface unknowns of a subdomain, and D, the weights, the
stiffness of shear. Displacements of the interface that change the volume of the subdomain, or of
cells that the interior cannot make up for, cost the bulk modulus: theta is up to kappa / mu. The
Dirichlet preconditioner is as large, since B_D'r has such parts, while F is moderate.

The preconditioner takes weights with these modes (`dual.deluxe_scaling`). To deflate them takes
fewer products, but more time, and the modes of neighbours depend on each other so nearly that
accuracy is lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_tfeti.feti.constraints.dual_layout import seeded_vector
from fenics_tfeti.feti.deflation.local_spectra import new_directions
from fenics_tfeti.typing import Operator, Vector

# theta above which a mode is stiff: 30 to 100 take about as many products
STIFF = 50.0
# columns of a block of the Lanczos method, products with it, and those after which a subdomain
# without stiff modes is given up
_BLOCK, _STEPS, _TRIAL = 10, 12, 3
# modes, of the columns of all blocks, that are too many: there are others, of which the Lanczos
# method knows nothing yet. Where displacements lock they are a large part of all
_MANY = 60


@dataclass(frozen=True)
class StiffModes:
    """Eigenvectors of D^{-1/2} S D^{-1/2} of a class of congruent subdomains."""

    values: Vector  # (k,): theta, descending
    vectors: Vector  # (b, k): orthonormal
    root: Vector  # (b,): D^{1/2} of the interface unknowns

    @staticmethod
    def build(reaction: Operator, weights: Vector, coordinates: Vector) -> StiffModes:
        """Find the modes with large theta by a block Lanczos method.

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
                if not block.shape[1] or values.max(initial=0.0) <= STIFF:
                    break
            block = image
        stiff = np.flatnonzero(values > STIFF)[::-1]
        if stiff.size > _MANY:
            stiff = stiff[:0]
        return StiffModes(values[stiff], basis @ vectors[:, stiff], root)

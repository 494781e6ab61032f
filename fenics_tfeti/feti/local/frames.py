"""Components of torn vectors in the frames of rotated or mirrored subdomains.

With the orthogonal matrix T of a subdomain at each of its nodes, u = T u'. Where K = T K' T', the
factor of K' serves in place of that of K: right-hand sides and solutions are turned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.local.fixing_nodes import unknowns_of_nodes
from fenics_tfeti.typing import Numbers, Vector


def in_frame(values: Vector, frame: Vector | None) -> Vector:
    """Return T'u at each node.

    u (gdim * nodes, ...) are vectors of the nodes of a subdomain, or columns of them; the frame is
    T (gdim, gdim), None for the identity.
    """
    return values if frame is None else out_of_frame(values, frame.T)


def out_of_frame(values: Vector, frame: Vector | None) -> Vector:
    """Return Tu' at each node; see `in_frame`."""
    if frame is None:
        return values
    nodal = values.reshape(len(values) // len(frame), len(frame), -1)
    return (frame @ nodal).reshape(values.shape)


@dataclass(frozen=True)
class Frames:
    """The frames of subdomains with equal numbers of nodes."""

    turns: Vector  # T of each (k, gdim, gdim)
    nodes: int  # of each; further unknowns of a subdomain are not turned

    def __getitem__(self, batch: slice) -> Frames:
        """Return the frames of a part of the subdomains."""
        return Frames(self.turns[batch], self.nodes)

    def to_frame(self, rows: Vector) -> Vector:
        """Return T'u of each subdomain's row of a (k, n) matrix."""
        return self._turned(rows, self.turns)

    def from_frame(self, rows: Vector) -> Vector:
        """Return Tu' of each subdomain's row of a (k, n) matrix."""
        return self._turned(rows, self.turns.transpose(0, 2, 1))

    def _turned(self, rows: Vector, matrices: Vector) -> Vector:
        k, gdim, _ = self.turns.shape
        end = gdim * self.nodes
        nodal = rows[:, :end].reshape(k, self.nodes, gdim) @ matrices
        return np.hstack([nodal.reshape(k, end), rows[:, end:]])

    def whole_nodes(self, unknowns: Numbers) -> Numbers:
        """Return ascending unknowns with the missing ones of their nodes."""
        gdim = self.turns.shape[1]
        turned = unknowns < gdim * self.nodes
        nodes = np.unique(unknowns[turned] // gdim)
        return np.concatenate([unknowns_of_nodes(nodes, gdim), unknowns[~turned]])

    def matrix(self, unknowns: Numbers) -> sp.csr_matrix:
        """Return the block diagonal matrix of T on these unknowns, of whole nodes, of each."""
        gdim = self.turns.shape[1]
        nodal = np.count_nonzero(unknowns < gdim * self.nodes)
        identity, further = sp.identity(nodal // gdim), sp.identity(unknowns.size - nodal)
        blocks = [
            block
            for turn in self.turns
            for block in (sp.kron(identity, turn), further)
            if block.nnz
        ]
        size = len(self.turns) * unknowns.size
        return sp.block_diag(blocks, format="csr") if blocks else sp.csr_matrix((size, size))

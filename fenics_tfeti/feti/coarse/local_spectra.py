"""Large eigenvalues of the subdomains' dual operators P_s F_s P_s, by a block Lanczos method.

F_s = B_s K_s^+ B_s' of the gluing, Dirichlet and tied rows of one subdomain, measured in units in
which the weights D are stiffnesses, has eigenvalues of moderate size: those of a stiffness relative
to its diagonal. Where a stiff part of the material ends at the subdomain's boundary, embedded in a
soft part, it moves as a rigid body at the soft part's cost, while the jump at its end counts with
the stiff weight: some isolated eigenvalues are larger by the ratio of the moduli. Contact rows are
left out, since their multipliers have bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import eigh, qr

from fenics_tfeti.feti.constraints.dual_layout import seeded_vector
from fenics_tfeti.feti.constraints.interface import Interface

__all__ = ["LocalVectors", "TornRows", "local_vectors", "threshold"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
Mask = NDArray[np.bool_]
Operator = Callable[[Vector], Vector]

# columns of a block and number of products with it: as many vectors as 32 steps of the Lanczos
# method, but for the price of a third, as right-hand sides share the factors
_BLOCK, _STEPS = 4, 8
# products after which a subdomain whose eigenvalues all seem to be moderate is given up
_TRIAL = 2
# vectors of a subdomain
_MOST = 20
# relative size of what is left of vectors that depend on the ones before
_DEPENDENT = 1e-10
# right-hand sides at once
_COLUMNS = 128


def threshold(gdim: int, nodes: int) -> float:
    """Return tau, above which an eigenvalue of P_s F_s P_s is large.

    Eigenvalues of a uniform material are a small multiple of H / h.

    Parameters
    ----------
    gdim : int
        2 or 3.
    nodes : int
        Nodes of the subdomain.

    Examples
    --------
    >>> threshold(3, 1000), threshold(2, 100)
    (120.0, 40.0)
    """
    return round((12.0 if gdim == 3 else 4.0) * nodes ** (1.0 / gdim), 6)


@dataclass(frozen=True)
class TornRows:
    """The equality rows of each subdomain: rows that several subdomains share, once for each.

    Subdomains are in the order of the packed interface unknowns.

    Attributes
    ----------
    rows : list of integer arrays
        Local positions of the equality rows with an entry in each subdomain.
    unknowns : (subdomains + 1,) integer array
        First packed interface unknown of each subdomain, and the end of the last.
    matrices : list of (r, b) scipy.sparse.csr_matrix
        B_s of these rows on the packed interface unknowns of the subdomain.
    """

    rows: list[Numbers]
    unknowns: Numbers
    matrices: list[sp.csr_matrix]

    @staticmethod
    def build(interface: Interface, equality: Mask) -> TornRows:
        """Split B.

        Parameters
        ----------
        interface : Interface
            B by packed unknowns.
        equality : (m,) bool array
            The rows that count.
        """
        sizes = [
            np.full(c.members.size, u.size)
            for c, u in zip(interface.classes, interface.unknowns, strict=True)
        ]
        unknowns = np.cumsum(np.concatenate([[0], *sizes])).astype(np.int64)
        rows, matrices = [], []
        transposed = interface.transposed
        for begin, end in zip(unknowns[:-1], unknowns[1:], strict=True):
            part = transposed[begin:end].T.tocsr()
            own = np.flatnonzero((np.diff(part.indptr) > 0) & equality)
            rows.append(own)
            matrices.append(part[own])
        return TornRows(rows, unknowns, matrices)


@dataclass(frozen=True)
class LocalVectors:
    """Ritz vectors of the subdomains' dual operators.

    Attributes
    ----------
    rows : list of (r,) integer arrays
        Global numbers of the rows of each vector.
    values : list of (r,) arrays
        The vector on these rows, of length 1.
    excess : (k,) array
        Ritz value relative to the threshold.
    solves : int
        Solves with K_s^+ that this took.
    """

    rows: list[Numbers]
    values: list[Vector]
    excess: Vector
    solves: int

    def chosen(self, kept: Mask) -> LocalVectors:
        """Return some of the vectors."""
        at = np.flatnonzero(kept)
        return LocalVectors(
            [self.rows[i] for i in at],
            [self.values[i] for i in at],
            self.excess[at],
            self.solves,
        )


def local_vectors(
    torn: TornRows,
    interface: Interface,
    on_interface: Sequence[Operator],
    kernels: Sequence[Vector],
    *,
    numbers: Numbers,
    unit: float,
    limits: Vector,
    chosen: Mask,
) -> LocalVectors:
    """Return Ritz vectors of P_s F_s P_s with values above a limit.

    Parameters
    ----------
    torn : TornRows
        The rows of each subdomain.
    interface : Interface
        The classes of congruent subdomains.
    on_interface : sequence of callable
        K_i^+ between interface unknowns of each class, (k, b) -> (k, b).
    kernels : sequence of (b, k) arrays
        R_i on the interface unknowns of each class.
    numbers : (m,) integer array
        Global numbers of the rows.
    unit : float
        The stiffness that a weight of 1 stands for [N/m].
    limits : (subdomains,) array
        tau of each subdomain.
    chosen : (subdomains,) bool array
        The subdomains that are asked.
    """
    found: list[_Subspace] = []
    place = 0
    for congruent, operator, kernel in zip(interface.classes, on_interface, kernels, strict=True):
        members = range(place, place + congruent.members.size)
        place += congruent.members.size
        spaces = [
            _Subspace.start(torn.matrices[s], kernel, numbers[torn.rows[s]], limits[s])
            for s in members
            if chosen[s] and torn.rows[s].size
        ]
        _enlarge(spaces, operator, unit)
        found += spaces
    rows, values, excess = list[Numbers](), list[Vector](), [np.zeros(0)]
    for space in found:
        size, vectors = space.large()
        rows += [space.numbers] * size.size
        values += list(vectors.T)
        excess.append(size / space.limit)
    solves = sum(space.basis.shape[1] for space in found)
    return LocalVectors(rows, values, np.concatenate(excess), solves)


@dataclass
class _Subspace:
    """A Krylov subspace of one subdomain.

    Attributes
    ----------
    matrix, transposed : scipy.sparse.csr_matrix
        B_s and B_s'.
    motions : (r, k) array
        Orthonormal basis of the range of G_s'.
    numbers : (r,) integer array
        Global numbers of the rows.
    limit : float
        tau.
    basis, images : (r, j) arrays
        Orthonormal basis, and P_s F_s P_s times it.
    block : (r, b) array
        The next columns of the basis; without columns when the subspace is large enough.
    """

    matrix: sp.csr_matrix
    transposed: sp.csr_matrix
    motions: Vector
    numbers: Numbers
    limit: float
    basis: Vector
    images: Vector
    block: Vector

    @staticmethod
    def start(B: sp.csr_matrix, R: Vector, numbers: Numbers, limit: float) -> _Subspace:
        """Return the empty subspace, with a first block that depends on the rows' numbers only."""
        U, sizes, _ = np.linalg.svd(B @ R, full_matrices=False)
        motions = U[:, sizes > _DEPENDENT * sizes.max(initial=0.0)]
        first = seeded_vector(_BLOCK * np.repeat(numbers, _BLOCK) + np.tile(np.arange(_BLOCK), numbers.size))
        none = np.zeros((numbers.size, 0))
        space = _Subspace(B, B.T.tocsr(), motions, numbers, limit, none, none, none)
        space.block = space.new_directions(first.reshape(-1, _BLOCK))
        return space

    def new_directions(self, x: Vector) -> Vector:
        """Return an orthonormal basis of what x adds to the subspace."""
        size = np.linalg.norm(x, axis=0).max(initial=0.0)
        # once more for what rounding leaves
        for _ in range(2):
            for known in (self.motions, self.basis):
                x = x - known @ (known.T @ x)
        Q, R = qr(x, mode="economic", pivoting=True)[:2]
        new: Vector = Q[:, np.abs(np.diag(R)) > _DEPENDENT * size]
        return new

    def take(self, jumps: Vector) -> None:
        """Add the block to the basis, given F_s times it; find the next one."""
        image = jumps - self.motions @ (self.motions.T @ jumps)
        self.basis = np.hstack([self.basis, self.block])
        self.images = np.hstack([self.images, image])
        self.block = self.new_directions(image)
        columns = self.basis.shape[1]
        if columns >= _STEPS * _BLOCK or (
            columns >= _TRIAL * _BLOCK and not self.large()[0].size
        ):
            self.block = self.block[:, :0]

    def large(self) -> tuple[Vector, Vector]:
        """Return the Ritz values above the limit, in descending order, and their vectors."""
        gram = self.basis.T @ self.images
        values, vectors = eigh(0.5 * (gram + gram.T))
        at = np.flatnonzero(values > self.limit)[::-1][:_MOST]
        return values[at], self.basis @ vectors[:, at]


def _enlarge(spaces: Sequence[_Subspace], operator: Operator, unit: float) -> None:
    """Enlarge the subspaces of congruent subdomains, all by solves with the same factor."""
    growing = [space for space in spaces if space.block.shape[1]]
    while growing:
        forces = np.concatenate([(space.transposed @ space.block).T for space in growing])
        displacements = np.concatenate(
            [operator(forces[i : i + _COLUMNS]) for i in range(0, len(forces), _COLUMNS)]
        )
        widths = [space.block.shape[1] for space in growing]
        parts = np.split(displacements, np.cumsum(widths)[:-1])
        for space, part in zip(growing, parts, strict=True):
            space.take(unit * (space.matrix @ part.T))
        growing = [space for space in growing if space.block.shape[1]]

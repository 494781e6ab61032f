"""Large eigenvalues of the subdomains' dual operators P_s F_s P_s, by a block Lanczos method.

F_s = B_s K_s^+ B_s' of the gluing, Dirichlet and tied rows of one subdomain, measured in units in
which the weights D are stiffnesses, has eigenvalues of moderate size: those of a stiffness relative
to its diagonal. Where a stiff part of the material ends at the subdomain's boundary, embedded in a
soft part, it moves as a rigid body at the soft part's cost, while the jump at its end counts with
the stiff weight: some isolated eigenvalues are larger by the ratio of the moduli. Contact rows are
left out, since their multipliers have bounds.

Of an indefinite tangent K_s, F_s has negative eigenvalues too, one for each of K_s if the subdomain
is stable when its rows hold it. Rotations that compression drives, or that tension resists, and
buckling of the torn subdomain make isolated eigenvalues, large in magnitude.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.constraints.dual_layout import seeded_vector
from fenics_tfeti.feti.constraints.interface import Interface
from fenics_tfeti.feti.costs import COLUMNS
from fenics_tfeti.feti.local.congruence import of_subdomains
from fenics_tfeti.feti.tolerances import ZERO
from fenics_tfeti.typing import Mask, Numbers, Operator, Vector

# columns of a block and number of products with it: as many vectors as 32 steps of the Lanczos
# method for the price of ten, since right-hand sides share the factors
_BLOCK, _STEPS = 8, 4
# products with a block, as long as negative eigenvalues are missing
_MOST_STEPS = 16
# products after which a subdomain whose eigenvalues all seem to be moderate is given up
_TRIAL = 2
# vectors of a subdomain with positive eigenvalues
_MOST = 20


def threshold(gdim: int, nodes: int) -> float:
    """Return tau, above which an eigenvalue of P_s F_s P_s is large.

    Eigenvalues of a uniform material are a small multiple of H / h.

    Examples
    --------
    >>> threshold(3, 1000), threshold(2, 100)
    (120.0, 40.0)
    """
    tau: float = (12.0 if gdim == 3 else 4.0) * nodes ** (1.0 / gdim)
    return round(tau, 6)


@dataclass(frozen=True)
class TornRows:
    """The equality rows of some subdomains; rows that several of them share, once for each.

    Subdomains are in the order of the packed interface unknowns.
    """

    rows: Numbers  # (r,): local positions, subdomain by subdomain
    ends: Numbers  # (subdomains + 1,): first row of each, and the end; others have none
    # block diagonal matrix (r, b) of the B_s, on the packed interface unknowns
    matrix: sp.csr_matrix
    transposed: sp.csr_matrix

    @staticmethod
    def build(interface: Interface, equality: Mask, chosen: Mask) -> TornRows:
        """Split B (m, b) into the matrices B_s of the chosen subdomains."""
        entries, m = interface.matrix.tocoo(), equality.size
        of_unknown = np.repeat(np.arange(chosen.size), np.diff(interface.ends))
        kept = equality[entries.row] & chosen[of_unknown[entries.col]]
        row, column = entries.row[kept].astype(np.int64), entries.col[kept]
        keys, position = np.unique(of_unknown[column] * m + row, return_inverse=True)
        matrix = sp.csr_matrix(
            (entries.data[kept], (position, column)), (keys.size, interface.columns.size)
        )
        ends = np.searchsorted(keys, m * np.arange(chosen.size + 1)).astype(np.int64)
        return TornRows(keys % max(m, 1), ends, matrix, matrix.T.tocsr())


@dataclass(frozen=True)
class LocalVectors:
    """Multipliers to be deflated, such as Ritz vectors of the subdomains' dual operators."""

    rows: list[Numbers]  # (r,) each: global numbers of rows
    values: list[Vector]  # (r,) each, of length 1, on these rows
    # (k,): their eigenvalue relative to the threshold; infinite for those that have to be deflated
    excess: Vector
    solves: int  # with K_s^+, for all vectors

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
    negative: Sequence[int],
) -> LocalVectors:
    """Return Ritz vectors of P_s F_s P_s with values above a limit, or negative.

    The operators apply K_i^+ between the interface unknowns of each class, (k, b) -> (k, b), and
    the kernels are R_i (b, k) there. The numbers (m,) of rows are global; unit is the stiffness
    that a weight of 1 stands for [N/m], the limits (subdomains,) are tau, and `negative`
    (subdomains,) are the numbers of negative eigenvalues of K_s.
    """
    numbers = numbers[torn.rows]
    spaces = _first_subspaces(torn, interface, kernels, numbers, limits, negative)
    solves = 0
    for step in range(1, _MOST_STEPS + 1):
        growing = [space for space in spaces if space.block.shape[1]]
        if not growing:
            break
        block = np.zeros((torn.rows.size, _BLOCK))
        for space in growing:
            block[space.rows, : space.block.shape[1]] = space.block
            solves += space.block.shape[1]
        jumps = torn.matrix @ _solved(interface, on_interface, torn.transposed @ block)
        jumps *= unit
        for space in growing:
            space.take(jumps[space.rows])
            finished = step >= _STEPS or (step == _TRIAL and not space.large()[0].size)
            if finished and space.has_all_negative:
                space.block = space.block[:, :0]
    rows, values, excess = list[Numbers](), list[Vector](), [np.zeros(0)]
    for space in spaces:
        sizes, vectors = space.large()
        rows += [numbers[space.rows]] * sizes.size
        values += list(vectors.T)
        excess.append(np.where(sizes > 0.0, sizes / space.limit, np.inf))
    return LocalVectors(rows, values, np.concatenate(excess), solves)


@dataclass
class _Subspace:
    """A Krylov subspace of one subdomain."""

    rows: slice  # among those of all subdomains
    limit: float  # tau
    negative: int  # negative eigenvalues of K_s
    motions: Vector  # (r, k): orthonormal basis of the range of G_s'
    basis: Vector  # (r, j): orthonormal
    images: Vector  # (r, j): P_s F_s P_s times the basis
    block: Vector  # (r, b): next columns of the basis; b = 0 when it is large enough

    def take(self, jumps: Vector) -> None:
        """Add the block to the basis, given F_s times it; find the next one."""
        jumps = jumps[:, : self.block.shape[1]]
        image = jumps - self.motions @ (self.motions.T @ jumps)
        self.basis = np.hstack([self.basis, self.block])
        self.images = np.hstack([self.images, image])
        self.block = new_directions(np.hstack([self.motions, self.basis]), image)

    @property
    def has_all_negative(self) -> bool:
        """True if as many Ritz values are negative as eigenvalues of K_s."""
        return np.count_nonzero(self.large()[0] < 0.0) >= self.negative

    def large(self) -> tuple[Vector, Vector]:
        """Return the Ritz values above the limit, then the negative ones, and their vectors."""
        gram = self.basis.T @ self.images
        values, vectors = np.linalg.eigh(0.5 * (gram + gram.T))
        at = np.flatnonzero(values > self.limit)[::-1][:_MOST]
        if self.negative:
            below = -ZERO * np.abs(values).max(initial=0.0)
            at = np.append(at, np.flatnonzero(values < below))
        return values[at], self.basis @ vectors[:, at]


def new_directions(basis: Vector, x: Vector) -> Vector:
    """Return an orthonormal basis of what columns x add to an orthonormal basis."""
    size = np.linalg.norm(x, axis=0).max(initial=0.0)
    # once more for what rounding leaves
    for _ in range(2):
        x = x - basis @ (basis.T @ x)
    Q, R = np.linalg.qr(x)
    return Q[:, np.abs(np.diag(R)) > ZERO * size]


def _first_subspaces(
    torn: TornRows,
    interface: Interface,
    kernels: Sequence[Vector],
    numbers: Numbers,
    limits: Vector,
    negative: Sequence[int],
) -> list[_Subspace]:
    """Return empty subspaces, with first blocks that depend on the numbers of the rows only."""
    first = seeded_vector(_BLOCK * numbers[:, None] + np.arange(_BLOCK))
    spaces = list[_Subspace]()
    modes = max((R.shape[1] for R in kernels), default=0)
    # kernels of fewer motions get columns of zeros
    padded = [np.pad(R, ((0, 0), (0, modes - R.shape[1]))) for R in kernels]
    whole = [np.zeros((0, modes)), *of_subdomains(interface.classes, padded)]
    G = torn.matrix @ np.concatenate(whole)
    for s in np.flatnonzero(np.diff(torn.ends)):
        rows = slice(int(torn.ends[s]), int(torn.ends[s + 1]))
        U, sizes, _ = np.linalg.svd(G[rows], full_matrices=False)
        motions = U[:, sizes > ZERO * sizes.max(initial=0.0)]
        none = np.zeros((rows.stop - rows.start, 0))
        block = new_directions(motions, first[rows])
        spaces.append(_Subspace(rows, float(limits[s]), negative[s], motions, none, none, block))
    return spaces


def _solved(interface: Interface, on_interface: Sequence[Operator], forces: Vector) -> Vector:
    """Apply K^+ between the packed interface unknowns to the columns (b, k) of a matrix."""
    result, width, end = np.empty_like(forces), forces.shape[1], 0
    together = max(1, COLUMNS // width)
    for congruent, local, operator in zip(
        interface.classes, interface.unknowns, on_interface, strict=True
    ):
        for first in range(0, congruent.members.size, together):
            members = min(together, congruent.members.size - first)
            begin, end = end, end + members * local.size
            block = forces[begin:end].reshape(members, local.size, width).transpose(0, 2, 1)
            solved = operator(block.reshape(members * width, local.size))
            solved = solved.reshape(members, width, local.size).transpose(0, 2, 1)
            result[begin:end] = solved.reshape(members * local.size, width)
    return result

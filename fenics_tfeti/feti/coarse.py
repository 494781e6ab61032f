"""The natural coarse space: G = R'B', the projectors P and Q, and what G leaves free (sec. 11.8).

G with orthonormal rows is needed only through Q = G~'(G~G~')^{-1}G~ of G~ = R'B', so the coarse
matrix G~G~' is factored and T never formed. Where some rigid motions meet no constraint at all, the
coarse matrix is singular and a generalised inverse takes its place; Q is the same for all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import block_diag, qr

from fenics_tfeti.feti.coarse_solver import (
    CoarseFactor,
    CoarseLayout,
    CoarseSolverKind,
    distribution_pays,
)
from fenics_tfeti.feti.congruence import Boundary, Congruent
from fenics_tfeti.feti.constraints import Constraints
from fenics_tfeti.feti.exchange import first_of_rank
from fenics_tfeti.feti.rigid_body_modes import describe_motion, raw_modes
from fenics_tfeti.feti.torn_system import TornSystem

__all__ = ["BodyMotions", "CoarseSpace", "Projector", "describe_body_motion"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# ||B R xi||^2 / ||R xi||^2 of a rigid motion of a body below which no constraint resists it
_UNRESISTED = 1e-12
# what rounding leaves of rigid motions of a body in its gluing rows
_TRACE = 1e-13


@dataclass(frozen=True)
class BodyMotions:
    """Rigid motions of whole bodies, in terms of the subdomains' modes.

    Attributes
    ----------
    basis : (coarse, modes * bodies) scipy.sparse.csr_matrix
        T: R T z moves each body rigidly, orthonormal columns for each body.
    held : (modes * bodies, modes * bodies) array
        How elastic supports and the equality rows of B resist the motions, as a Gram matrix. Rows
        are taken with unit length: what resists is a matter of geometry.
    contact : (modes * bodies, owned inequality rows) scipy.sparse.csr_matrix
        What the motions do to the contact rows, again of unit length.
    """

    basis: sp.csr_matrix
    held: Vector
    contact: sp.csr_matrix


@dataclass(frozen=True)
class CoarseSpace:
    """G = R'B' on this rank, and the bodies' rigid motions.

    G is applied as R' after B'; only its columns for contact rows, those shared with other ranks'
    subdomains, and GG' of the equality rows are kept as matrices.

    Attributes
    ----------
    boundary : Boundary
        B and the classes of congruent subdomains.
    kernels : sequence of (n_i, k_i) arrays
        R_i of this rank's subdomains; congruent ones share it.
    ends : (subdomains + 1,) integer array
        Where the subdomains' coarse unknowns begin among this rank's, and where they end.
    layout : CoarseLayout
        Whose the coarse unknowns are, and where coarse matrices are.
    theirs : (h, m) scipy.sparse.csr_matrix
        The rows of G of other ranks' subdomains in the columns that this rank holds.
    contact : (coarse, i) scipy.sparse.csr_matrix
        All rows of G in the inequality columns that this rank holds.
    equality : (coarse or own, coarse) scipy.sparse.csr_matrix
        GG' of the equality rows alone, the rows that this rank keeps.
    bodies : BodyMotions
        Rigid motions of bodies.
    constraints : Constraints
        The columns.
    """

    boundary: Boundary
    kernels: Sequence[Vector]
    ends: Numbers
    layout: CoarseLayout
    theirs: sp.csr_matrix
    contact: sp.csr_matrix
    equality: sp.csr_matrix
    bodies: BodyMotions
    constraints: Constraints

    @staticmethod
    def build(
        system: TornSystem,
        constraints: Constraints,
        boundary: Boundary,
        kernels: Sequence[Vector],
        package: str,
        solver: CoarseSolverKind = "auto",
    ) -> CoarseSpace:
        """Form G, exchange its shared columns with the neighbours, keep what is needed of it.

        Parameters
        ----------
        system : TornSystem
            The subdomains.
        constraints : Constraints
            B.
        boundary : Boundary
            Its packed columns.
        kernels : sequence of (n_i, k_i) arrays
            R_i of this rank's subdomains.
        package : str
            Package for the factors of coarse matrices that are whole on every rank.
        solver : {"auto", "redundant", "distributed"}
            Where coarse matrices are.
        """
        ends = np.cumsum([0, *(R.shape[1] for R in kernels)])
        first, size = first_of_rank(system.comm, int(ends[-1]))
        # G' with this rank's rows of G as columns, then with those of all
        own = (boundary.matrix @ _packed_kernels(boundary, kernels, ends)).tocsr()
        everyone = _with_neighbours(constraints, own, first, size)
        equality = constraints.equality
        rows = (own.T.tocsr()[:, equality] @ everyone[equality]).tocsr()
        theirs = np.setdiff1d(everyone.indices, first + np.arange(ends[-1]))
        layout = CoarseLayout.build(
            system.comm,
            int(ends[-1]),
            theirs.astype(np.int64),
            solver == "distributed"
            or (solver == "auto" and distribution_pays(system.comm.size, size)),
            package,
        )
        return CoarseSpace(
            boundary,
            kernels,
            ends,
            layout,
            everyone.T.tocsr()[theirs],
            everyone[constraints.inequality].T.tocsr(),
            layout.rows(rows),
            _body_motions(system, kernels, constraints, everyone),
            constraints,
        )

    @property
    def size(self) -> int:
        """Number of coarse unknowns of all ranks."""
        return self.layout.size

    @property
    def comm(self) -> MPI.Intracomm:
        """The ranks."""
        return self.constraints.multipliers.comm

    def restrict(self, x: Vector) -> Vector:
        """Return Gx for the coarse unknowns of all ranks; one gathering."""
        return self.layout.gather(self.restrict_own(x))

    def restrict_own(self, x: Vector) -> Vector:
        """Return Gx for this rank's coarse unknowns."""
        packed = self.boundary.blocks(self.boundary.transposed @ x)
        part = np.empty(int(self.ends[-1]))
        for congruent, local, rows in zip(
            self.boundary.classes, self.boundary.unknowns, packed, strict=True
        ):
            part[self._places(congruent)] = rows @ self.kernels[congruent.first][local]
        return part

    def prolong(self, coarse: Vector) -> Vector:
        """Return G'a for a coarse vector of all ranks; one neighbour exchange."""
        return self.constraints.multipliers.sum(self.prolong_own(self.own_part(coarse)))

    def prolong_own(self, own: Vector) -> Vector:
        """Return what this rank's coarse unknowns add to G'a."""
        blocks = [
            own[self._places(congruent)] @ self.kernels[congruent.first][local].T
            for congruent, local in zip(self.boundary.classes, self.boundary.unknowns, strict=True)
        ]
        part: Vector = self.boundary.matrix @ self.boundary.pack(blocks)
        return part

    def work(self, forces: Vector) -> Vector:
        """Return R'f for the coarse unknowns of all ranks; one gathering."""
        part = np.empty(int(self.ends[-1]))
        for congruent in self.boundary.classes:
            part[self._places(congruent)] = congruent.rows(forces) @ self.kernels[congruent.first]
        return self.layout.gather(part)

    def motion(self, coarse: Vector) -> Vector:
        """Return R a on this rank's torn unknowns for a coarse vector of all ranks."""
        own = self.own_part(coarse)
        displacement = np.empty(self.constraints.matrix.shape[1])
        for congruent in self.boundary.classes:
            rows = own[self._places(congruent)] @ self.kernels[congruent.first].T
            congruent.put(displacement, rows)
        return displacement

    def own_part(self, coarse: Vector) -> Vector:
        """Return this rank's part of a coarse vector."""
        return coarse[self.layout.mine]

    def _places(self, congruent: Congruent) -> Numbers:
        modes = self.kernels[congruent.first].shape[1]
        places: Numbers = self.ends[congruent.members][:, None] + np.arange(modes)
        return places

    def unresisted(self, active: Mask) -> Vector:
        """Return the rigid motions of bodies that the equality and some contact rows do not resist.

        Parameters
        ----------
        active : (i,) bool array
            The contact rows.

        Returns
        -------
        (coarse, k) array
            Orthonormal basis of the kernel of these rows' G'.
        """
        chosen = np.flatnonzero(active[: self.constraints.owned_inequalities])
        resisted = self.bodies.contact[:, chosen]
        sum_over_ranks = self.constraints.multipliers.space.sum_over_ranks
        gram = sum_over_ranks((resisted @ resisted.T).toarray()) + self.bodies.held
        resistance, motions = np.linalg.eigh(gram)
        free: Vector = self.bodies.basis @ motions[:, resistance <= _UNRESISTED]
        return np.linalg.qr(free)[0]


@dataclass(frozen=True)
class Projector:
    """Q and P for the equality rows and some contact rows (all of them, none, the active ones).

    Attributes
    ----------
    space : CoarseSpace
        G.
    columns : (m,) bool array
        The columns of G used.
    free : (coarse, k) array
        Orthonormal basis of the kernel of the coarse matrix.
    factor : CoarseFactor or None
        That of the coarse matrix; None where no subdomain can move.
    """

    space: CoarseSpace
    columns: Mask
    free: Vector
    factor: CoarseFactor | None

    @staticmethod
    def build(space: CoarseSpace, active: Mask | None = None) -> Projector:
        """Factor the coarse matrix GG' of the equality rows and the chosen contact rows.

        Parameters
        ----------
        space : CoarseSpace
            G.
        active : (i,) bool array, optional
            The contact rows; all by default.
        """
        constraints = space.constraints
        chosen = np.ones(constraints.inequality.size, dtype=bool) if active is None else active
        columns = constraints.equality
        columns[constraints.inequality] = chosen
        free = space.unresisted(chosen)
        contact = space.contact[:, np.flatnonzero(chosen)]
        layout = space.layout
        rows = space.equality + layout.rows((contact[layout.mine] @ contact.T).tocsr())
        if free.shape[1]:
            # no row at all leaves a zero matrix
            stiffness = layout.largest_diagonal(rows) or 1.0
            rows = layout.add_to_diagonal(rows, _pins(free), stiffness)
        return Projector(space, columns, free, layout.factor(rows) if layout.size else None)

    def coefficients(self, x: Vector) -> Vector:
        """Return (GG')^+ G x for all subdomains, G with the chosen columns."""
        return self.solve(self.space.restrict(np.where(self.columns, x, 0.0)))

    def solve(self, coarse: Vector) -> Vector:
        """Return (GG')^+ applied to a coarse vector in the range of G."""
        return coarse if self.factor is None else self.factor.solve(coarse)

    def expand(self, coarse: Vector) -> Vector:
        """Return G' applied to a coarse vector of all subdomains, in the chosen columns."""
        return np.where(self.columns, self.space.prolong(coarse), 0.0)

    def coarse(self, x: Vector) -> Vector:
        """Return Qx = G'(GG')^{-1}Gx."""
        return self.expand(self.coefficients(x))

    def complement(self, x: Vector) -> Vector:
        """Return Px = x - Qx."""
        return x - self.coarse(x)

    def complement_of_sum(self, part: Vector, x: Vector) -> tuple[Vector, float]:
        """Return Py in the chosen columns and x'y, y the sum of the ranks' parts; one exchange."""
        motion, xy = self._own_motion(part, x)
        return self._sum(self.keep(part - motion)), xy

    def part_of_complement(self, part: Vector) -> Vector:
        """Return this rank's part of Py in the chosen columns, y the sum of the ranks' parts."""
        return self.keep(part - self._own_motion(part)[0])

    def coarse_by_parts(self, x: Vector) -> tuple[Vector, Vector]:
        """Return this rank's part of Qx, and Qx itself without an exchange of multipliers.

        The latter is not bitwise the same on all ranks that hold a component: good for products
        that are summed, not for what is compared with bounds.
        """
        if self.factor is None:
            return np.zeros_like(x), np.zeros_like(x)
        own, theirs = self.factor.solve_own(self.space.restrict_own(self.keep(x)))
        part = self.keep(self.space.prolong_own(own))
        return part, part + self.keep(self.space.theirs.T @ theirs)

    def relax(self, part: Vector, x: Vector) -> tuple[Vector, float]:
        """Return y - G'a, y the sum of the ranks' parts, with the motions a = (GG')^+ Gy; and x'y.

        That is Py in the chosen columns; in the others it says what the motions do there. Of the
        motions that the chosen columns leave free, a has none. One neighbour exchange; x'y is
        summed along with Gy.

        Parameters
        ----------
        part : (m,) array
            This rank's part of y.
        x : (m,) array
            A vector whose inner product with y is wanted.
        """
        motion, xy = self._own_motion(part, x, resisted=True)
        return self._sum(part - motion), xy

    def keep(self, x: Vector) -> Vector:
        """Return x with zeros outside the chosen columns."""
        return np.where(self.columns, x, 0.0)

    def resisted(self, coarse: Vector) -> Vector:
        """Return a coarse vector of all subdomains without its part in the free motions."""
        part: Vector = coarse - self.free @ (self.free.T @ coarse)
        return part

    def _own_motion(
        self, part: Vector, x: Vector | None = None, resisted: bool = False
    ) -> tuple[Vector, float]:
        """Return what this rank's subdomains add to G'(GG')^+ Gy, and x'y (zero without x)."""
        sum_over_ranks = self.space.constraints.multipliers.space.sum_over_ranks
        # all holders of a component have the same of x, so each may multiply its part of y
        numbers = np.zeros(0) if x is None else np.array([x @ part])
        if self.factor is None:
            return np.zeros_like(part), float(sum_over_ranks(numbers).sum())
        chosen = self.keep(part)
        own, numbers = self.factor.solve_sum(
            self.space.restrict_own(chosen), self.space.theirs @ chosen, numbers
        )
        if resisted and self.free.shape[1]:
            free = self.space.own_part(self.free)
            own = own - free @ sum_over_ranks(free.T @ own)
        return self.space.prolong_own(own), float(numbers.sum())

    def _sum(self, part: Vector) -> Vector:
        return self.space.constraints.multipliers.sum(part)


def _packed_kernels(boundary: Boundary, kernels: Sequence[Vector], ends: Numbers) -> sp.csr_matrix:
    """Return R on the packed boundary unknowns, a column for each own coarse unknown."""
    data, columns, counts = [np.zeros(0)], [np.zeros(0, dtype=np.int32)], [np.zeros(0, dtype=int)]
    for congruent, local in zip(boundary.classes, boundary.unknowns, strict=True):
        R = kernels[congruent.first][local]
        k = congruent.members.size
        places = ends[congruent.members][:, None, None] + np.arange(R.shape[1])
        data.append(np.tile(R.ravel(), k))
        columns.append(np.broadcast_to(places, (k, *R.shape)).ravel().astype(np.int32))
        counts.append(np.full(k * local.size, R.shape[1]))
    indptr = np.concatenate([[0], np.cumsum(np.concatenate(counts))])
    return sp.csr_matrix(
        (np.concatenate(data), np.concatenate(columns), indptr),
        shape=(boundary.columns.size, int(ends[-1])),
    )


def _with_neighbours(
    constraints: Constraints, own: sp.csr_matrix, first: int, size: int
) -> sp.csr_matrix:
    """Return G' with the columns of all ranks, in the rows (of G') that this rank holds."""
    if constraints.multipliers.comm.size == 1:
        return own
    coo = own.tocoo()
    columns, rows = coo.col.astype(np.int64) + first, coo.row.astype(np.int64)
    theirs = constraints.multipliers.shared_entries(columns, rows, coo.data)
    return sp.csr_matrix(
        (
            np.concatenate([coo.data, theirs[2]]),
            (np.concatenate([rows, theirs[1]]), np.concatenate([columns, theirs[0]])),
        ),
        shape=(own.shape[0], size),
    )


def _pins(free: Vector) -> Numbers:
    """Return one coarse unknown for each free motion, to pin by a number on the diagonal.

    The coarse matrix is definite then, and for right-hand sides without a part in `free` the
    pinned unknowns are zero: its inverse is a generalised inverse of the coarse matrix.
    """
    pivots: Numbers = qr(free.T, mode="economic", pivoting=True)[2][: free.shape[1]]
    return pivots.astype(np.int64)


def _body_motions(
    system: TornSystem,
    kernels: Sequence[Vector],
    constraints: Constraints,
    everyone: sp.csr_matrix,
) -> BodyMotions:
    basis, energy = _motions_and_energy(system, kernels)
    owned = constraints.multipliers.owned
    # (rows of B, motions): what each motion does to rows of unit length
    moved = sp.diags(1.0 / constraints.row_lengths[:owned]) @ (everyone[:owned] @ basis)
    # gluing rows resist no motion of a whole body; rounding leaves traces of them
    moved.data[np.abs(moved.data) <= _TRACE] = 0.0
    moved.eliminate_zeros()
    equality = constraints.equality[:owned]
    held = moved[np.flatnonzero(equality)]
    return BodyMotions(
        basis,
        system.comm.allreduce((held.T @ held).toarray()) + energy,
        moved[np.flatnonzero(~equality)].T.tocsr(),
    )


def _motions_and_energy(
    system: TornSystem, kernels: Sequence[Vector]
) -> tuple[sp.csr_matrix, Vector]:
    """Return T, and the energy of the motions outside the kernel of K (elastic supports)."""
    comm = system.comm
    gdim = system.gdim
    bodies = comm.allreduce(max((s.body + 1 for s in system.subdomains), default=0), MPI.MAX)
    modes = 3 if gdim == 2 else 6
    centres, sizes = _centres_and_sizes(system, bodies)

    blocks, gram, energy = [], np.zeros((bodies, modes, modes)), np.zeros((bodies, modes, modes))
    for subdomain, R in zip(system.subdomains, kernels, strict=True):
        body = subdomain.body
        raw = raw_modes((subdomain.coordinates - centres[body]) / sizes[body], np.zeros(gdim))
        inside = R.T @ raw
        blocks.append((body, inside))
        gram[body] += raw.T @ raw
        energy[body] += raw.T @ raw - inside.T @ inside
    gram, energy = comm.allreduce(gram), comm.allreduce(energy)

    # orthonormal motions of each body over its torn nodes
    inverse = [np.linalg.inv(np.linalg.cholesky(g)).T if g.any() else g for g in gram]
    rows = [sp.csr_matrix((0, modes * bodies))]
    for body, inside in blocks:
        data = (inside @ inverse[body]).ravel()
        columns = np.tile(body * modes + np.arange(modes), len(inside))
        indptr = modes * np.arange(len(inside) + 1)
        shape = (len(inside), modes * bodies)
        rows.append(sp.csr_matrix((data, columns, indptr), shape=shape))
    basis = sp.vstack(comm.allgather(sp.vstack(rows, format="csr")), format="csr")
    scaled = [t.T @ e @ t for t, e in zip(inverse, energy, strict=True)]
    # rounding leaves traces of 1e-16 in what should vanish
    scaled = [np.where(np.abs(e) > _UNRESISTED, e, 0.0) for e in scaled]
    return basis, block_diag(*scaled) if bodies else np.zeros((0, 0))


def _centres_and_sizes(system: TornSystem, bodies: int) -> tuple[Vector, Vector]:
    sums, counts = np.zeros((bodies, system.gdim)), np.zeros(bodies)
    for subdomain in system.subdomains:
        sums[subdomain.body] += subdomain.coordinates.sum(axis=0)
        counts[subdomain.body] += subdomain.nodes.size
    counts = np.maximum(system.comm.allreduce(counts), 1.0)
    centres = system.comm.allreduce(sums) / counts[:, None]
    sizes = np.zeros(bodies)
    for subdomain in system.subdomains:
        reach = np.abs(subdomain.coordinates - centres[subdomain.body]).max()
        sizes[subdomain.body] = max(sizes[subdomain.body], reach)
    system.comm.Allreduce(MPI.IN_PLACE, sizes, MPI.MAX)
    return centres, np.where(sizes > 0.0, sizes, 1.0)


def describe_body_motion(
    system: TornSystem, kernels: Sequence[Vector], own_motion: Vector, either_way: bool = False
) -> list[str]:
    """Name the bodies that take part in a motion, and how each of them moves.

    Parameters
    ----------
    system : TornSystem
        The subdomains.
    kernels : sequence of (n_i, k_i) arrays
        R_i of this rank's subdomains.
    own_motion : array
        This rank's part of the coarse vector xi of the motion R xi.
    either_way : bool
        Whether the opposite motion is meant as well.

    Returns
    -------
    list of str
        "body: motion" for each body, on all ranks.
    """
    ends = np.cumsum([0, *(R.shape[1] for R in kernels)])
    parts: dict[int, tuple[float, str]] = {}
    for i, (subdomain, R) in enumerate(zip(system.subdomains, kernels, strict=True)):
        displacement = R @ own_motion[ends[i] : ends[i + 1]]
        size = float(np.abs(displacement).max(initial=0.0))
        if size > parts.get(subdomain.body, (0.0, ""))[0]:
            words = describe_motion(subdomain.coordinates, displacement, either_way)
            parts[subdomain.body] = size, words
    merged: dict[int, tuple[float, str]] = {}
    for part in system.comm.allgather(parts):
        for body, value in part.items():
            merged[body] = max(value, merged.get(body, (0.0, "")))
    largest = max((size for size, _ in merged.values()), default=0.0)
    return [
        f"{system.body_name(body)}: {words}"
        for body, (size, words) in sorted(merged.items())
        if size > 1e-6 * largest
    ]

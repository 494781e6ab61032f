"""The dual operator F = BK^+B', its load d, and the norm of PFP (11.31), (11.36)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.feti.coarse import Projector
from fenics_tfeti.feti.congruence import Boundary, apply_by_class
from fenics_tfeti.feti.constraints import Constraints
from fenics_tfeti.feti.pseudoinverse import Pseudoinverse
from fenics_tfeti.qp import lanczos_upper_bound

__all__ = [
    "DualOperator",
    "DualOperatorKind",
    "OperatorPrecision",
    "SinglePrecision",
    "norm_of_projected",
    "seeded_vector",
]

Vector = NDArray[np.float64]
Single = NDArray[np.float32]
Array = NDArray[Any]
DualOperatorKind = Literal["auto", "implicit", "explicit"]
OperatorPrecision = Literal["double", "single"]

# right-hand sides at once for the explicit matrix
_COLUMNS = 512
# by how much several right-hand sides make a triangular solve and a dense product cheaper, measured
_SHARING_OF_SOLVES = 3
_SHARING_OF_PRODUCTS = 8
# products of a typical solve
_PRODUCTS = 50


@dataclass(frozen=True)
class SinglePrecision:
    """What a product with F in single precision needs.

    Attributes
    ----------
    boundary : Boundary
        B in float32.
    on_boundary : sequence of callable
        The part of K_i^+ between boundary unknowns of each class, (k, b) -> (k, b) in float32.
    """

    boundary: Boundary
    on_boundary: Sequence[Callable[[Single], Single]]


@dataclass(frozen=True)
class DualOperator:
    """F and what else K^+ is needed for, on this rank's subdomains.

    Attributes
    ----------
    constraints : Constraints
        B, c.
    boundary : Boundary
        B on the unknowns that it acts on, and the classes of congruent subdomains.
    inverses : sequence of Pseudoinverse
        K_i^+ of each class.
    on_boundary : sequence of callable
        The part of K_i^+ between boundary unknowns of each class, (k, b) -> (k, b).
    explicit : int
        Classes with a dense matrix.
    single : SinglePrecision or None
        For `rough_part`; None on all ranks if no rank has a dense matrix in single precision.
    """

    constraints: Constraints
    boundary: Boundary
    inverses: Sequence[Pseudoinverse]
    on_boundary: Sequence[Callable[[Vector], Vector]]
    explicit: int
    single: SinglePrecision | None = None

    @staticmethod
    def build(
        constraints: Constraints,
        boundary: Boundary,
        inverses: Sequence[Pseudoinverse],
        kind: DualOperatorKind = "auto",
        precision: OperatorPrecision = "double",
    ) -> DualOperator:
        """Make the operator, with explicit matrices or solves as asked for; one small reduction.

        Parameters
        ----------
        constraints : Constraints
            B, c.
        boundary : Boundary
            Its packed columns.
        inverses : sequence of Pseudoinverse
            K_i^+ of each class.
        kind : {"auto", "implicit", "explicit"}
            Sparse solves, or a dense matrix for each class; auto counts bytes.
        precision : {"double", "single"}
            Of the dense matrices. Where they are single, products in double are solves.
        """
        dtype = np.float32 if precision == "single" else np.float64
        implicit, matrices = [], []
        for inverse, local, congruent in zip(
            inverses, boundary.unknowns, boundary.classes, strict=True
        ):
            pays = kind == "auto" and _explicit_pays(
                inverse, local.size, congruent.members.size, np.dtype(dtype).itemsize
            )
            dense = kind == "explicit" or pays
            implicit.append(_implicit(inverse, local, congruent.size))
            matrices.append(_boundary_inverse(inverse, local, dtype) if dense else None)
        explicit = sum(matrix is not None for matrix in matrices)
        comm = constraints.multipliers.comm
        single = precision == "single" and bool(comm.allreduce(explicit > 0, MPI.LOR))
        pairs = list(zip(implicit, matrices, strict=True))
        return DualOperator(
            constraints,
            boundary,
            inverses,
            implicit if single else [f if A is None else _times(A) for f, A in pairs],
            explicit,
            SinglePrecision(
                boundary.in_single_precision(),
                [_rounded(f) if A is None else _times(A) for f, A in pairs],
            )
            if single
            else None,
        )

    def __call__(self, multipliers: Vector) -> Vector:
        """Return F lambda; one neighbour exchange."""
        return self.constraints.multipliers.sum(self.part(multipliers))

    def part(self, multipliers: Vector) -> Vector:
        """Return what this rank's subdomains add to F lambda: a solve or product for each class."""
        boundary = self.boundary
        jumps: Vector = boundary.matrix @ boundary.apply(
            self.on_boundary, boundary.transposed @ multipliers
        )
        return jumps

    def rough_part(self, multipliers: Vector) -> Vector:
        """Return this rank's part of F lambda by operators in single precision, if there are any.

        The relative error is some units of rounding of float32; the ranks' parts add up in double.
        """
        if self.single is None:
            return self.part(multipliers)
        boundary = self.single.boundary
        displacements = boundary.apply(
            self.single.on_boundary, boundary.transposed @ multipliers.astype(np.float32)
        )
        jumps: Vector = (boundary.matrix @ displacements).astype(np.float64)
        return jumps

    def constraint_forces(self, multipliers: Vector) -> Vector:
        """Return B'lambda on this rank's torn unknowns."""
        forces = np.zeros(self.constraints.matrix.shape[1])
        forces[self.boundary.columns] = self.boundary.transposed @ multipliers
        return forces

    def jumps(self, displacement: Vector) -> Vector:
        """Return Bu of a torn displacement; one neighbour exchange."""
        part = self.boundary.matrix @ displacement[self.boundary.columns]
        return self.constraints.multipliers.sum(part)

    def generalised_inverse(self, forces: Vector) -> Vector:
        """Return K^+ forces for torn forces."""
        operators = [partial(_solve_rows, inverse) for inverse in self.inverses]
        return apply_by_class(self.boundary.classes, operators, forces)

    def load(self, forces: Vector) -> Vector:
        """Return d = BK^+f - c."""
        return self.jumps(self.generalised_inverse(forces)) - self.constraints.rhs


def _solve_rows(inverse: Pseudoinverse, rows: Vector) -> Vector:
    """Apply K^+ to the rows of a matrix, without those that vanish."""
    result = np.zeros_like(rows)
    loaded = np.flatnonzero(rows.any(axis=1))
    if loaded.size == 1:
        result[loaded[0]] = inverse.solve(rows[loaded[0]])
    elif loaded.size:
        result[loaded] = inverse.solve(rows[loaded].T).T
    return result


def _implicit(
    inverse: Pseudoinverse, local: NDArray[np.int64], size: int
) -> Callable[[Vector], Vector]:
    def solve(rows: Vector) -> Vector:
        forces = np.zeros((len(rows), size))
        forces[:, local] = rows
        return _solve_rows(inverse, forces)[:, local]

    return solve


def _rounded(operator: Callable[[Vector], Vector]) -> Callable[[Single], Single]:
    return lambda rows: operator(rows.astype(np.float64)).astype(np.float32)


def _times(matrix: Array) -> Callable[[Array], Array]:
    # symmetric but for rounding
    return lambda rows: rows @ matrix


def _boundary_inverse(
    inverse: Pseudoinverse, local: NDArray[np.int64], dtype: type[np.float64 | np.float32]
) -> Array:
    """Return the part of K^+ between boundary unknowns."""
    columns = np.empty((local.size, local.size), dtype)
    for start in range(0, local.size, _COLUMNS):
        some = local[start : start + _COLUMNS]
        unit = np.zeros((inverse.size, some.size), order="F")
        unit[some, np.arange(some.size)] = 1.0
        columns[:, start : start + some.size] = inverse.solve(unit)[local]
    return columns


def _explicit_pays(inverse: Pseudoinverse, boundary: int, members: int, entry: int) -> bool:
    """Count the bytes that all products of a solve move, with solves and with a dense matrix.

    A solve reads the factor (value and index) twice, but several right-hand sides share that; so
    they do with a dense matrix (`entry` bytes each), which also has to be computed first.
    """
    solve = 24.0 * inverse.entries / min(members, _SHARING_OF_SOLVES)
    product = entry * boundary**2 / min(members, _SHARING_OF_PRODUCTS)
    set_up = boundary * 24.0 * inverse.entries / _SHARING_OF_SOLVES
    return set_up + _PRODUCTS * members * product < _PRODUCTS * members * solve


def seeded_vector(numbers: NDArray[np.int64], seed: int) -> Vector:
    """Return pseudo-random components in (-1, 1) that depend on global numbers and seed only.

    All holders of a component get the same value, on any number of ranks, without communication.
    The mixing function is that of splitmix64.
    """
    z = numbers.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(seed)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        z = (z ^ (z >> np.uint64(shift))) * np.uint64(factor)
    z ^= z >> np.uint64(31)
    values: Vector = z / 2.0**63 - 1.0
    return values


def norm_of_projected(F: DualOperator, projector: Projector, steps: int, seed: int) -> float:
    """Bound ||PFP|| from above by the Lanczos method.

    Parameters
    ----------
    F : DualOperator
        The operator; in single precision where it has that, far within the bound's margin.
    projector : Projector
        P.
    steps : int
        Products with F to spend.
    seed : int
        Seed of the start vector.

    Returns
    -------
    float
        An upper bound, close to the norm [m/N].
    """
    multipliers = F.constraints.multipliers
    return lanczos_upper_bound(
        lambda x: projector.complement_of_sum(F.rough_part(x), x)[0],
        projector.complement(seeded_vector(multipliers.numbers, seed)),
        steps,
        multipliers.space,
    )

"""The dual operator F = BK^+B', its load d, and the norm of PFP (11.31), (11.36)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.feti.constraints import Constraints
from fenics_tfeti.feti.pseudoinverse import Pseudoinverse
from fenics_tfeti.feti.torn_system import Subdomain
from fenics_tfeti.qp import lanczos_upper_bound

__all__ = ["DualOperator", "norm_of_projected", "seeded_vector"]

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class DualOperator:
    """F and what else K^+ is needed for, on this rank's subdomains.

    Attributes
    ----------
    constraints : Constraints
        B, c.
    inverses : sequence of Pseudoinverse
        K_i^+ of this rank's subdomains.
    slices : sequence of slice
        The subdomains' parts of the torn unknowns.
    """

    constraints: Constraints
    inverses: Sequence[Pseudoinverse]
    slices: Sequence[slice]

    @staticmethod
    def build(
        constraints: Constraints,
        subdomains: Sequence[Subdomain],
        inverses: Sequence[Pseudoinverse],
    ) -> DualOperator:
        """Make the operator from the subdomains in their order."""
        ends = np.cumsum([0, *(s.size for s in subdomains)])
        return DualOperator(
            constraints, inverses, [slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]
        )

    def __call__(self, multipliers: Vector) -> Vector:
        """Return F lambda: one solve for each subdomain, one neighbour exchange."""
        B = self.constraints.matrix
        jumps = B @ self.generalised_inverse(B.T @ multipliers)
        return self.constraints.multipliers.sum(jumps)

    def generalised_inverse(self, forces: Vector) -> Vector:
        """Return K^+ forces for torn forces."""
        displacement = np.empty_like(forces)
        for inverse, part in zip(self.inverses, self.slices, strict=True):
            displacement[part] = inverse.solve(forces[part])
        return displacement

    def load(self, forces: Vector) -> Vector:
        """Return d = BK^+f - c."""
        jumps = self.constraints.matrix @ self.generalised_inverse(forces)
        return self.constraints.multipliers.sum(jumps) - self.constraints.rhs


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


def norm_of_projected(
    F: DualOperator, complement: Callable[[Vector], Vector], steps: int, seed: int
) -> float:
    """Bound ||PFP|| from above by the Lanczos method.

    Parameters
    ----------
    F : DualOperator
        The operator.
    complement : callable
        The projector P.
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
        lambda x: complement(F(x)),
        complement(seeded_vector(multipliers.numbers, seed)),
        steps,
        multipliers.space,
    )

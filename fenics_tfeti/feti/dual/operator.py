"""The dual operator F = BK^+B', its load d, and the norm of PFP (11.31), (11.36)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Literal

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.dual_layout import seeded_vector
from fenics_tfeti.feti.constraints.interface import Interface
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.dual.explicit import ExplicitInverse, Orbits
from fenics_tfeti.feti.local.congruence import apply_by_class
from fenics_tfeti.feti.local.generalized_inverse import GeneralizedInverse
from fenics_tfeti.feti.tolerances import rounding
from fenics_tfeti.qp import lanczos_estimate
from fenics_tfeti.typing import Vector

DualOperatorKind = Literal["auto", "implicit", "explicit"]


@dataclass(frozen=True)
class DualOperator:
    """F and what else K^+ is needed for, on this rank's subdomains."""

    constraints: Constraints  # B, c
    interface: Interface  # B on the unknowns that it acts on
    inverses: Sequence[GeneralizedInverse]  # K_i^+ of each class of congruent subdomains
    # K_i^+ between interface unknowns of each class, (k, b) -> (k, b)
    on_interface: Sequence[Callable[[Vector], Vector]]
    explicit: int  # classes with a dense matrix

    @staticmethod
    def build(
        constraints: Constraints,
        interface: Interface,
        inverses: Sequence[GeneralizedInverse],
        kind: DualOperatorKind = "auto",
    ) -> DualOperator:
        """Make the operator, with explicit matrices or solves as asked for.

        The kind "auto" counts bytes to choose sparse solves or a dense matrix for each class.
        """
        on_interface, explicit = [], 0
        for inverse, local, congruent in zip(
            inverses, interface.unknowns, interface.classes, strict=True
        ):
            orbits = Orbits.build(inverse.symmetries, local)
            dense = kind == "explicit" or (
                kind == "auto" and orbits.pays(inverse, congruent.members.size)
            )
            explicit += dense
            on_interface.append(
                ExplicitInverse.build(inverse, orbits)
                if dense
                else inverse.between(local) or _implicit(inverse, local, congruent.size)
            )
        return DualOperator(constraints, interface, inverses, on_interface, explicit)

    def __call__(self, multipliers: Vector) -> Vector:
        """Return F lambda; one neighbour exchange."""
        return self.constraints.layout.sum(self.part(multipliers))

    def part(self, multipliers: Vector) -> Vector:
        """Return what this rank's subdomains add to F lambda: a solve or product for each class."""
        interface = self.interface
        return interface.matrix @ self.packed(interface.transposed @ multipliers)

    def packed(self, forces: Vector) -> Vector:
        """Return K^+ forces for packed forces on the interface."""
        return self.interface.apply(self.on_interface, forces)

    def constraint_forces(self, multipliers: Vector) -> Vector:
        """Return B'lambda on this rank's torn unknowns."""
        return self._transposed @ multipliers

    @cached_property
    def _transposed(self) -> sp.csc_matrix:
        return self.constraints.matrix.T

    def jumps(self, displacement: Vector) -> Vector:
        """Return Bu of a torn displacement; one neighbour exchange."""
        return self.constraints.layout.sum(self.constraints.matrix @ displacement)

    def generalized_inverse(self, forces: Vector) -> Vector:
        """Return K^+ forces for torn forces."""
        operators = [partial(_solve_rows, inverse) for inverse in self.inverses]
        return apply_by_class(self.interface.classes, operators, forces)

    def load(self, forces: Vector, c: Vector) -> Vector:
        """Return d = BK^+f - c (11.31)."""
        return self.jumps(self.generalized_inverse(forces)) - c


def _solve_rows(inverse: GeneralizedInverse, rows: Vector) -> Vector:
    """Apply K^+ to the rows of a matrix, without those that vanish."""
    result = np.zeros_like(rows)
    loaded = np.flatnonzero(rows.any(axis=1))
    if loaded.size == 1:
        result[loaded[0]] = inverse.solve(rows[loaded[0]])
    elif loaded.size:
        result[loaded] = inverse.solve(rows[loaded].T).T
    return result


def _implicit(
    inverse: GeneralizedInverse, local: NDArray[np.int64], size: int
) -> Callable[[Vector], Vector]:
    def solve(rows: Vector) -> Vector:
        if len(rows) == 1:
            force = np.zeros(size)
            force[local] = rows[0]
            return inverse.solve(force)[local][None] if rows.any() else np.zeros_like(rows)
        forces = np.zeros((len(rows), size))
        forces[:, local] = rows
        return _solve_rows(inverse, forces)[:, local]

    return solve


class ProjectedNorm:
    """An upper bound of ||PFP||, estimated when it is asked for and kept.

    `part` is x -> this rank's part of Fx. `flexibility` is the size of F without P, roughly [m/N]:
    where P leaves nothing, its rounding is the bound. `products` counts those with F that the
    estimates took.
    """

    def __init__(
        self, part: Callable[[Vector], Vector], projector: Projector, flexibility: float
    ) -> None:
        self._part, self._projector = part, projector
        self._least = rounding(flexibility)
        self._steps, self._value = 0, 0.0
        self.products = 0

    def __call__(self, steps: int) -> float:
        """Return the bound by at least that many Lanczos steps [m/N]."""
        if self._steps < steps:
            layout = self._projector.coarse_space.constraints.layout
            value = lanczos_estimate(
                lambda x: self._projector.P_of_sum(self._part(x), x)[0],
                self._projector.P(seeded_vector(layout.numbers)),
                steps,
                layout.space,
            )
            self._value = max(value, self._least)
            self._steps = steps
            self.products += steps
        return self._value

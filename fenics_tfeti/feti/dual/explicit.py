"""The part of K_i^+ between interface unknowns as a dense matrix, and when that pays.

Where the subdomain is symmetric the matrix commutes with a group of signed permutations. With unit
vectors e_j, one of each orbit, the vectors psi_j = sum_g chi(g) g e_j of a character chi are taken
to combinations of themselves: the matrix falls into a block for each character, and one column for
each orbit makes them all. Eight blocks of an eighth of the size are eight times as cheap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_tfeti.feti.costs import COLUMNS, ROWS
from fenics_tfeti.feti.local.generalized_inverse import GeneralizedInverse
from fenics_tfeti.feti.local.symmetry import SymmetryGroup
from fenics_tfeti.feti.tolerances import MANY, rounding
from fenics_tfeti.typing import Numbers, Vector

# by how much several right-hand sides make a triangular solve and a dense product cheaper, measured
_SHARING_OF_SOLVES = 3
_SHARING_OF_PRODUCTS = 8
# products of a typical solve
_PRODUCTS = 50


@dataclass(frozen=True)
class Orbits:
    """The interface unknowns of a subdomain as orbits of unit vectors under its symmetries.

    A vector x has the coordinates <g e_j, x>, those of e_j once for each element that leaves it.
    """

    unknowns: Numbers  # (b,): interface unknowns of the subdomain
    group: SymmetryGroup  # of these b unknowns
    representatives: Numbers  # (r,): first unknown of each orbit, among the b

    @staticmethod
    def build(group: SymmetryGroup, unknowns: Numbers) -> Orbits:
        """Find the orbits of some unknowns; `group` is that of all unknowns of the subdomain."""
        within = group.on(unknowns)
        return Orbits(unknowns, within, np.unique(within.images.min(axis=0)))

    @property
    def entries(self) -> int:
        """Entries of the blocks of a matrix."""
        return self.group.order * self.representatives.size**2

    def pays(self, inverse: GeneralizedInverse, members: int) -> bool:
        """Count the bytes that all products of a solve move, with solves and with a dense matrix.

        A solve reads the factor (value and index) twice, but several right-hand sides share that;
        so they do with a dense matrix which also has to be computed first.
        """
        solve = 24.0 * inverse.entries / min(members, _SHARING_OF_SOLVES)
        product = 8.0 * self.entries / min(members, _SHARING_OF_PRODUCTS)
        set_up = self.representatives.size * 24.0 * inverse.entries / _SHARING_OF_SOLVES
        return set_up + _PRODUCTS * members * product < _PRODUCTS * members * solve


@dataclass(frozen=True)
class ExplicitInverse:
    """The part of K_i^+ between interface unknowns, in blocks."""

    orbits: Orbits
    blocks: Vector  # (g, r, r): a block for each character, times 1/g, multiplied from the left

    @staticmethod
    def build(inverse: GeneralizedInverse, orbits: Orbits) -> ExplicitInverse:
        """Solve for the unit vectors of the representatives.

        Where the material jumps, rounding makes K^+ less symmetric than the blocks; then all unit
        vectors are solved for, as without symmetries.
        """
        explicit = ExplicitInverse._of_orbits(inverse, orbits)
        if orbits.group.order == 1 or explicit._agrees_with(inverse):
            return explicit
        none = SymmetryGroup.trivial(inverse.size)
        return ExplicitInverse._of_orbits(inverse, Orbits.build(none, orbits.unknowns))

    @staticmethod
    def _of_orbits(inverse: GeneralizedInverse, orbits: Orbits) -> ExplicitInverse:
        group, chosen = orbits.group, orbits.representatives
        columns = np.empty((orbits.unknowns.size, chosen.size))
        for start in range(0, chosen.size, COLUMNS):
            some = orbits.unknowns[chosen[start : start + COLUMNS]]
            unit = np.zeros((inverse.size, some.size), order="F")
            unit[some, np.arange(some.size)] = 1.0
            columns[:, start : start + some.size] = inverse.solve(unit)[orbits.unknowns]
        # <g e_l, K^+ e_j>, and their sums over g with each character
        images, signs = group.images[:, chosen], group.signs[:, chosen]
        coordinates = signs[:, :, None] * columns[images]
        blocks = np.tensordot(group.characters, coordinates.transpose(0, 2, 1), axes=1)
        # the representatives that several elements leave would count as often
        often = np.count_nonzero(images == chosen, axis=0)
        return ExplicitInverse(orbits, blocks / (group.order * often[:, None]))

    def _agrees_with(self, inverse: GeneralizedInverse) -> bool:
        forces = np.zeros(inverse.size)
        forces[self.orbits.unknowns] = np.random.default_rng(0).standard_normal(
            self.orbits.unknowns.size
        )
        expected = inverse.solve(forces)[self.orbits.unknowns]
        found = self(forces[self.orbits.unknowns][None])[0]
        largest = np.abs(expected).max(initial=0.0)
        # a dual operator that disagrees with the recovery by more limits its accuracy
        return bool(np.abs(found - expected).max(initial=0.0) <= rounding(largest, MANY))

    def __call__(self, rows: Vector) -> Vector:
        """Apply it to each row of a (k, b) matrix."""
        if self.orbits.group.order == 1:
            return rows @ self.blocks[0]
        result = np.empty_like(rows)
        for start in range(0, len(rows), ROWS):
            some = slice(start, start + ROWS)
            result[some] = self._by_characters(rows[some])
        return result

    def _by_characters(self, rows: Vector) -> Vector:
        group, chosen = self.orbits.group, self.orbits.representatives
        places, signs = group.images[:, chosen].ravel(), group.signs[:, chosen].ravel()
        g, k = group.order, len(rows)
        coordinates = np.take(rows, places, axis=1)
        coordinates *= signs
        parts = group.characters @ coordinates.reshape(k, g, -1)
        parts = parts.transpose(1, 0, 2) @ self.blocks
        coordinates = np.tensordot(group.characters, parts, axes=1)
        result = np.empty_like(rows)
        # equal but for rounding where several elements lead to the same unknown
        result[:, places] = coordinates.transpose(1, 0, 2).reshape(k, -1) * signs
        return result

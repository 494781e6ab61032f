"""The bilinear law of cohesive bonds at nodes: traction, damage and energy over the jump.

A jump (k, 1 + gdim) has the opening across the surfaces, zero where they are closed, and the slip
along them, zero where the bond does not hold there. Its length is g, and the share of shear is
B = |slip|^2 / g^2. With the damage d the traction is (1 - d) K times the jump. Up to g = d0 there
is no damage, at g = df nothing is left:

    d = df (r - d0) / (r (df - d0)),

where r is the largest length so far. With the strengths t and s and the energies G and H of pure
opening and pure shear, the law of Benzeggagh and Kenane has

    d0^2 = (t^2 + (s^2 - t^2) B^n) / K^2,    d0 df = 2 (G + (H - G) B^n) / K

(Turon, Camanho, Costa, Davila, Mechanics of Materials 38 (2006) 1072-1089). What is kept is the
damage: the openings d0 and df change with B.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from fenics_tfeti.typing import Array, Mask, Vector

# stiffness that is not given, in strength^2 / energy: a tenth of the failure's opening is elastic
DEFAULT_STIFFNESS = 10.0


@dataclass(frozen=True)
class Bonds:
    """The law at k nodes; where the strength is zero nothing is bonded."""

    area: Vector  # (k,) [m^2 or m]
    stiffness: Vector  # K (k,) [Pa/m]
    strength: Vector  # t (k,) [Pa]
    energy: Vector  # G (k,) [J/m^2]
    shear_strength: Vector  # s (k,) [Pa]
    shear_energy: Vector  # H (k,) [J/m^2]
    exponent: Vector  # n (k,)

    @staticmethod
    def concatenate(parts: Sequence[Bonds]) -> Bonds:
        """Return the bonds of all parts, one part after the other."""
        names = [field.name for field in fields(Bonds)]
        return Bonds(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def columns(self) -> Array:
        """Return all data as columns (k, 7), which `from_columns` takes."""
        return np.stack([getattr(self, field.name) for field in fields(self)], axis=1)

    @staticmethod
    def from_columns(columns: Array) -> Bonds:
        """Return bonds of data as columns (k, 7)."""
        return Bonds(*columns.T)

    @property
    def bonded(self) -> Mask:
        """Where there is a bond (k,)."""
        return (self.strength > 0.0) & (self.area > 0.0)

    @property
    def ductility(self) -> Vector:
        """The opening at failure over the elastic one (k,), in the mode where that is larger."""
        data = ((self.strength, self.energy), (self.shear_strength, self.shear_energy))
        parts = [
            np.divide(2.0 * self.stiffness * g, s**2, out=np.zeros_like(s), where=s > 0.0)
            for s, g in data
        ]
        return np.maximum(*parts)

    def intact(self) -> Vector:
        """Return the damage (k,) of bonds that nothing has loaded: 1 where there is none."""
        return np.where(self.bonded, 0.0, 1.0)

    def stiffness_at(self, damage: Vector) -> Vector:
        """Return the stiffness (1 - d) K times the area (k,) [N/m]."""
        return np.where(self.bonded, (1.0 - damage) * self.stiffness * self.area, 0.0)

    def stiffness_along(self, damage: Vector) -> Vector:
        """Return the stiffness (k,) along the surface [N/m]: the same, if bonds hold there."""
        return np.where(self.shear_strength > 0.0, self.stiffness_at(damage), 0.0)

    def at(self, jump: Vector) -> BondsAtMode:
        """Return the law at the share of shear of jumps (k, 1 + gdim)."""
        squares = np.sum(jump**2, axis=1)
        shear = np.sum(jump[:, 1:] ** 2, axis=1)
        share = np.divide(shear, squares, out=np.zeros_like(shear), where=squares > 0.0)
        part, bonded = share**self.exponent, self.bonded
        stiffness = np.where(bonded, self.stiffness, 1.0)
        strength2 = self.strength**2 + part * (self.shear_strength**2 - self.strength**2)
        energy = self.energy + part * (self.shear_energy - self.energy)
        # nothing is left of what is not bonded: its openings do not matter
        elastic = np.where(bonded, np.sqrt(strength2) / stiffness, 1.0)
        failure = np.where(bonded, 2.0 * energy / (stiffness * elastic), 2.0)
        return BondsAtMode(self, np.sqrt(squares), elastic, failure, np.where(bonded, energy, 0.0))


@dataclass(frozen=True)
class BondsAtMode:
    """The law at jumps, by their lengths; lengths of damage are those at which it was reached."""

    bonds: Bonds
    size: Vector  # lengths of the jumps (k,) [m]
    elastic: Vector  # d0 (k,) [m]
    failure: Vector  # df (k,) [m]
    energy: Vector  # of the failure (k,) [J/m^2]

    def damage(self, length: Vector) -> Vector:
        """Return the damage (k,) of bonds whose largest lengths were these (k,)."""
        length = np.clip(length, self.elastic, self.failure)
        d = self.failure * (length - self.elastic) / (length * (self.failure - self.elastic))
        return np.where(self.bonds.bonded, d, 1.0)

    def length(self, damage: Vector) -> Vector:
        """Return the lengths (k,) at which a damage was reached."""
        r = self.failure * self.elastic
        r = r / (self.failure - damage * (self.failure - self.elastic))
        return np.clip(r, self.elastic, self.failure)

    def energies(self, length: Vector) -> Vector:
        """Return the energies (k,) [J] that it takes to damage bonds up to lengths (k,)."""
        part = (length - self.elastic) / (self.failure - self.elastic)
        return self.bonds.area * self.energy * np.clip(part, 0.0, 1.0)

    def dissipated(self, length: Vector) -> float:
        """Return the energy [J] that it takes to damage all bonds up to lengths (k,)."""
        return float(np.sum(self.energies(length)))

    def misfit(self, damage: Vector, factor: float, wanted: Vector) -> float:
        """Return the largest error of tractions with a damage in place of what the law wants.

        It is relative to the strength.
        """
        change = np.abs(wanted - damage) * np.minimum(factor * self.size, self.failure)
        return float((np.where(self.bonds.bonded, change, 0.0) / self.elastic).max(initial=0.0))

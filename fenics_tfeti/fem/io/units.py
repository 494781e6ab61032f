"""Units that reports, pages and pictures write beside numbers; nothing is converted for a solve."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from fenics_tfeti.errors import InputError

UnitSystem = Literal["SI", "mm-N-MPa"]

# units in SI units, by what they measure
_IN_SI = {
    "length": {"m": 1.0, "mm": 1e-3, "µm": 1e-6},
    "pressure": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9},
    "force": {"N": 1.0, "kN": 1e3, "MN": 1e6},
}


@dataclass(frozen=True)
class Units:
    """Names of the units of a consistent system."""

    length: str
    force: str
    pressure: str
    energy: str
    moment: str

    def factor(self, unit: str) -> float:
        """Return the number by which values of this system are multiplied to be in a unit.

        Raises `InputError` for a unit that is not known; "" converts nothing.
        """
        if not unit:
            return 1.0
        for quantity, units in _IN_SI.items():
            if unit in units:
                return units[getattr(self, quantity)] / units[unit]
        known = ", ".join(unit for units in _IN_SI.values() for unit in units)
        raise InputError(f"unknown unit '{unit}'; choose one of {known}")

    def readable(self, quantity: str, largest: float) -> str:
        """Return the largest unit of a length, pressure or force in which a value is 1 or more.

        It is the unit of this system if the value is less than 1 in all of them.
        """
        own = getattr(self, quantity)
        fitting = [unit for unit in _IN_SI[quantity] if largest * self.factor(unit) >= 1.0]
        return max(fitting, key=_IN_SI[quantity].__getitem__, default=own)


_SYSTEMS: dict[str, Units] = {
    "SI": Units("m", "N", "Pa", "J", "N m"),
    "mm-N-MPa": Units("mm", "N", "MPa", "mJ", "N mm"),
}


def units_of(system: str, per_length: bool = False) -> Units:
    """Return the units of a system by its name; an `InputError` lists the known ones.

    In plane problems forces, moments and energies are those of a unit of length.
    """
    if system not in _SYSTEMS:
        raise InputError(f"unknown units '{system}'; choose one of {', '.join(_SYSTEMS)}")
    units = _SYSTEMS[system]
    if not per_length:
        return units
    force, energy = (f"{unit}/{units.length}" for unit in (units.force, units.energy))
    return replace(units, force=force, energy=energy, moment=units.force)

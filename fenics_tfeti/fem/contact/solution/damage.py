"""The damage of cohesive bonds in a load step: a walk by dissipated energy to the present loads.

With a fixed damage, bonds are springs, and the problem is positively homogeneous: at all of its
loads, prescribed displacements and gaps times a factor s > 0 the solution is s times that of s = 1.
A pass solves it at s = 1, and updates the damage by the law at the factor at which this dissipates
a wanted energy; passes are accelerated (Anderson 1965, memory 1). Steps of equal energy, the length
of few elements each, follow the crack whatever the loads do: the factor may fall, and rise again.
The first time that it reaches 1 is the load step's solution: passes at that factor end the walk.

No pass changes the stiffness of the bodies, and each starts from the forces of the last one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import brentq

from fenics_tfeti.errors import DamageNotFound, NotConverged, UnresistedMotion
from fenics_tfeti.fem.contact.conditions.bonds import Bonds, BondsAtMode
from fenics_tfeti.typing import Vector

# energy of a step in rows of nodes across the way of a crack
_ROWS = 2.0
# limits on passes of a step by energy, and at the present loads
_MOST, _MOST_AT_LOADS = 40, 12
# passes at the present loads count with no more than this energy, relative to that of a step:
# others may have passed an equilibrium
_NEAR = 1.5
# distance of a factor from 1 at which passes at the loads are tried
_CLOSE = 2e-3
# passes after which those at the loads are given up if the first one was better by a factor
_PATIENCE, _WORSE = 2, 1.5
# factor beyond the one at which damage begins, from which on it has no limit
_LARGEST = 1e6
# shortest step, relative to the first, and number of passes that is easy enough for longer ones
_SHORTEST, _EASY = 2.0**-6, 8
# part of a step in which the present loads are looked for; limit on steps
_INSIDE = (0.05, 0.95)
_MOST_STEPS = 10_000

# misfit for which passes are solved that know no better one
_UNKNOWN = 0.1

Solve = Callable[[Vector, float], Vector]


@dataclass(frozen=True)
class PathPoint:
    """An equilibrium on the way to the present loads, from the one on where damage grows."""

    factor: float  # its loads over the present ones
    dissipated: float  # since the beginning [J]
    number: int  # of the pass that has found it, from 0


@dataclass(frozen=True)
class Damaged:
    """The damage (k,) at which a walk has ended, and how it went."""

    damage: Vector
    path: list[PathPoint]  # the last one has the factor 1
    dissipated: Vector  # (k,) since the beginning [J]
    passes: int


@dataclass(frozen=True)
class _Equilibrium:
    """A damage with which the law holds at a factor of the loads, to the tolerance."""

    damage: Vector
    reached: Vector  # what the law makes of it: steps go on from there
    jump: Vector  # (k, 1 + gdim) at the factor 1
    factor: float
    passes: int  # that have found it
    number: int  # of the last one among all


def damaged(bonds: Bonds, solve: Solve, before: Vector, rtol: float, dimension: int) -> Damaged:
    """Return the damage at the present loads.

    Parameters
    ----------
    bonds : Bonds
        The law at k nodes.
    solve : callable
        Returns the jumps (k, 1 + gdim) at the present loads for a damage (k,), see `Bonds` [m]. It
        is given the misfit of tractions, relative to the strength, beside which errors are to be
        small, 0 for a solution.
    before : (k,) array
        The damage of the last step.
    rtol : float
        Error of tractions relative to the strength.
    dimension : int
        Of the surfaces: 1 or 2.

    Raises
    ------
    DamageNotFound
        At a limit on passes, or if the bonds carry less than the loads.
    """
    return _Walk(bonds, solve, before, rtol, dimension).run()


def damaged_at_loads(bonds: Bonds, solve: Solve, before: Vector, rtol: float) -> Damaged:
    """Return the damage at the present loads by passes there alone, whatever they dissipate.

    For problems that are not homogeneous. Arguments are those of `damaged`.

    Raises
    ------
    DamageNotFound
        At the limit on passes, or if a solve fails.
    """
    walk = _Walk(bonds, solve, before, rtol, 1)
    found = walk.at_loads()
    law = bonds.at(found.jump)
    spent = law.energies(law.length(found.damage)) - law.energies(law.length(before))
    grows = bool(np.any(found.damage > before))
    path = [PathPoint(1.0, float(spent.sum()), found.number)] if grows else []
    return Damaged(found.damage, path, spent, walk.passes)


@dataclass
class _Walk:
    bonds: Bonds
    solve: Solve
    before: Vector
    rtol: float
    dimension: int
    passes: int = 0
    onset: float = 0.0  # the factor at which damage begins to grow
    path: list[PathPoint] = field(default_factory=list)
    slope: float = 0.0  # of the factor over the energy, in the last step
    from_last: float = 1.0  # energy of the last step
    end: _Equilibrium | None = None  # beyond the present loads
    to_end: float = 0.0  # energy from here to there
    beyond: int = 0  # how many ends there were since the last equilibrium
    failure: UnresistedMotion | NotConverged | None = None  # of the last solve

    def __post_init__(self) -> None:
        self.spent, self.last = np.zeros_like(self.before), self.before

    def run(self) -> Damaged:
        jump = self.solve(self.before, 0.0)
        self.passes += 1
        law = self.bonds.at(jump)
        wanted = self._wanted(law, self.before, 1.0)
        self.now = _Equilibrium(self.before, self.before, jump, 1.0, 1, 0)
        if law.misfit(self.before, 1.0, wanted) <= self.rtol:
            return self._ended()
        self.onset = self._onset(law)
        self.path.append(PathPoint(self.onset, 0.0, 0))
        self.now = replace(self.now, factor=self.onset)
        longest = energy = self._row_energy()
        # load steps that damage little need no walk
        if self._spent(law, self.before, wanted) <= energy:
            found = self._at_loads(self.before, energy)
            if found is not None:
                return self._ended(found)
        for _ in range(_MOST_STEPS):
            length = self._length(energy)
            found = self._iterate(self.now.reached, self._guess(length), length, _MOST)
            if found is None:
                # at the end fewer bonds are left than a step takes
                is_rest = self._left() <= energy
                found = self._at_loads(self.now.reached, energy) if is_rest else None
                if found is not None:
                    return self._ended(found)
                energy *= 0.5
                breaks = is_rest and isinstance(self.failure, UnresistedMotion)
                if breaks or energy < _SHORTEST * longest:
                    break
                continue
            landed = self._landed(found, energy)
            if landed is not None:
                return self._ended(landed)
            if found.factor >= 1.0:
                self.end, self.to_end, self.beyond = found, length, self.beyond + 1
                continue
            self._accept(found, length)
            if found.passes <= _EASY:
                energy = min(2.0 * energy, longest)
        raise self._not_found() from self.failure

    def at_loads(self) -> _Equilibrium:
        """Return the equilibrium at the present loads by passes there alone."""
        found = self._iterate(self.before, self.before, None, _MOST, np.inf)
        if found is not None:
            return found
        what = "the passes have not ended"
        if self.failure is not None:
            what = f"a solve with a fixed damage has failed: {self.failure}"
        raise DamageNotFound(
            f"the damage of bonds is not found at these loads: {what}. Take smaller load steps, as "
            "problem.steps() finds them, or prescribe displacements in place of forces"
        ) from self.failure

    # -- steps -------------------------------------------------------------------------------------

    def _length(self, energy: float) -> float:
        """Return the energy of the next step, up to a limit: that which is seen to end at 1."""
        lacking = 1.0 - self.now.factor
        if self.end is not None:
            # Illinois: less than by the secant where all ends have been beyond the loads
            lacking *= 0.5 ** (self.beyond - 1)
            share = lacking / (lacking + self.end.factor - 1.0)
            return min(energy, float(np.clip(share, *_INSIDE)) * self.to_end)
        if self.slope > 0.0:
            return min(energy, max(lacking / self.slope, _INSIDE[0] * energy))
        return energy

    def _guess(self, length: float) -> Vector:
        """Return the damage after a step, on the way to its end or as the last step has gone."""
        law = self.bonds.at(self.now.jump)
        begin = law.length(self.now.reached)
        if self.end is not None:
            change = (law.length(self.end.reached) - begin) / self.to_end
        else:
            change = (begin - law.length(self.last)) / self.from_last
        return np.clip(law.damage(begin + length * change), self.now.reached, 1.0)

    def _accept(self, found: _Equilibrium, length: float) -> None:
        """Go on from an equilibrium."""
        self.spent += self._dissipated(self.now, found)
        self.path.append(PathPoint(found.factor, float(self.spent.sum()), found.number))
        self.slope = (found.factor - self.now.factor) / length
        self.last, self.from_last, self.now = self.now.reached, length, found
        if self.end is not None:
            self.to_end, self.beyond = self.to_end - length, 1

    def _ended(self, found: _Equilibrium | None = None) -> Damaged:
        """Return the end of the walk, where damage has grown at an equilibrium."""
        if found is not None:
            self._accept(found, 1.0)
        return Damaged(self.now.damage, self.path, self.spent, self.passes)

    def _at_loads(
        self, guess: Vector, energy: float, misfit: float = _UNKNOWN
    ) -> _Equilibrium | None:
        """Return the equilibrium at the present loads, if that is no farther than a step.

        None at the limit of passes.
        """
        start = self.now.reached
        found = self._iterate(start, guess, None, _MOST_AT_LOADS, misfit=misfit)
        if found is None:
            return None
        spent = self._spent(self.bonds.at(found.jump), start, found.damage)
        return found if spent <= _NEAR * energy else None

    def _landed(self, found: _Equilibrium, energy: float) -> _Equilibrium | None:
        """Return the equilibrium at the present loads beside another one, if that is near."""
        law = self.bonds.at(found.jump)
        wanted = self._wanted(law, self.now.reached, 1.0)
        is_found = law.misfit(found.damage, 1.0, wanted) <= self.rtol
        if is_found and _fails_alike(found.damage, wanted):
            return self._at_loads(found.damage, energy, self.rtol)
        is_close = abs(found.factor - 1.0) <= _CLOSE
        return self._at_loads(found.reached, energy) if is_close else None

    # -- passes ------------------------------------------------------------------------------------

    def _iterate(
        self,
        start: Vector,
        guess: Vector,
        energy: float | None,
        most: int,
        patience: float = _PATIENCE,
        misfit: float = _UNKNOWN,
    ) -> _Equilibrium | None:
        """Return the equilibrium with an energy, or at the present loads, from a damage on.

        None at the limit of passes, and where a damage leaves no solution. Passes at the loads that
        are worse than the first one are given up after some. Each pass is as accurate as the misfit
        of the last one asks for, the first one as a given misfit; at the loads the last one is the
        solution.
        """
        damage, before, first = guess, None, 0.0
        for number in range(1, most + 1):
            is_solution = energy is None and misfit <= self.rtol
            jump = self._jumps(damage, 0.0 if is_solution else misfit)
            if jump is None:
                return None
            law = self.bonds.at(jump)
            factor = 1.0 if energy is None else self._factor(law, start, energy)
            if factor is None:
                return None
            wanted = self._wanted(law, start, factor)
            misfit = law.misfit(damage, factor, wanted)
            first = misfit if number == 1 else first
            if energy is None and number > patience and misfit > _WORSE * first:
                return None
            ends = misfit <= self.rtol and (energy is not None or _fails_alike(damage, wanted))
            if ends and (energy is not None or is_solution):
                return _Equilibrium(damage, wanted, jump, factor, number, self.passes - 1)
            if ends:
                # at the loads the last pass is the solution
                continue
            if misfit <= self.rtol:
                # at its end damage is nearly that of a failure
                damage, before = wanted, None
                continue
            # in terms of lengths, which damage follows with a slope of at most 1 / d0
            x, y = law.length(damage), law.length(wanted)
            following, residual = y, y - x
            if before is not None:
                turn = residual - before[1]
                share = float(turn @ residual) / (float(turn @ turn) or 1.0)
                # at the loads a residual that grows says that the end is ahead, not behind
                if share <= 1.0 or energy is not None:
                    following = y - share * (x - before[0] + turn)
            before = x, residual
            damage = np.clip(law.damage(following), start, 1.0)
        return None

    def _jumps(self, damage: Vector, misfit: float) -> Vector | None:
        """Return the jumps; None where a damage leaves no solution."""
        self.passes += 1
        try:
            jump = self.solve(damage, misfit)
        except (UnresistedMotion, NotConverged) as error:
            self.failure = error
            return None
        self.failure = None
        return jump

    def _factor(self, law: BondsAtMode, start: Vector, energy: float) -> float | None:
        """Return the factor at which the law takes an energy more; None if it never does."""
        first = law.length(start)
        spent = law.dissipated(first)

        def lacking(factor: float) -> float:
            return law.dissipated(np.maximum(first, factor * law.size)) - spent - energy

        least = self._first_growth(law, start)
        if not np.isfinite(least):
            return None
        low, high = least, 2.0 * least
        while lacking(high) < 0.0:
            low, high = high, 2.0 * high
            if high > _LARGEST * least:
                return None
        return float(brentq(lacking, low, high, xtol=1e-14 * low, rtol=1e-13))

    def _first_growth(self, law: BondsAtMode, start: Vector) -> float:
        """Return the factor at which damage begins to grow."""
        growing = (start < 1.0) & (law.size > 0.0)
        return float((law.length(start)[growing] / law.size[growing]).min(initial=np.inf))

    def _wanted(self, law: BondsAtMode, start: Vector, factor: float) -> Vector:
        """Return the damage of the law at a factor; it never heals."""
        return np.maximum(start, law.damage(factor * law.size))

    # -- energies and messages ---------------------------------------------------------------------

    def _onset(self, law: BondsAtMode) -> float:
        """Return the factor at which damage begins to grow by more than the tolerance."""

        def excess(factor: float) -> float:
            wanted = self._wanted(law, self.before, factor)
            return law.misfit(self.before, factor, wanted) - self.rtol

        return float(brentq(excess, 0.0, 1.0, rtol=1e-13))

    def _left(self) -> float:
        """Return the energy that all failures would take."""
        law = self.bonds.at(self.now.jump)
        return self._spent(law, self.now.reached, np.ones_like(self.before))

    def _spent(self, law: BondsAtMode, start: Vector, end: Vector) -> float:
        return law.dissipated(law.length(end)) - law.dissipated(law.length(start))

    def _dissipated(self, first: _Equilibrium, end: _Equilibrium) -> Vector:
        """Return the energies (k,) between equilibria: (t g' - t' g) / 2 of each bond.

        Where all bonds that have grown have failed, they failed at smaller loads than those of the
        end.
        """
        law, grown = self.bonds.at(end.jump), end.damage > first.damage
        factor = end.factor
        if np.all(end.damage[grown] >= 1.0):
            failed = law.failure[grown] / law.size[grown]
            factor = min(factor, float(failed.max(initial=0.0)))
        product = first.factor * factor * np.sum(first.jump * end.jump, axis=1)
        change = self.bonds.stiffness_at(first.damage) - self.bonds.stiffness_at(end.damage)
        return 0.5 * change * product

    def _row_energy(self) -> float:
        """Return the energy of a step: that of few rows of nodes across the surface."""
        bonds, bonded = self.bonds, self.bonds.bonded
        all_of_it = float(np.sum((bonds.area * bonds.energy)[bonded]))
        return _ROWS * all_of_it / np.count_nonzero(bonded) ** (1.0 / self.dimension)

    def _not_found(self) -> DamageNotFound:
        """Return the error at the shortest steps."""
        what = (
            f"the damage of bonds is not found from {self.now.factor:.4g} of the loads on: the "
            "passes of even short steps have not ended"
        )
        if isinstance(self.failure, UnresistedMotion):
            what = "the bonds break before the loads are reached"
        elif self.failure is not None:
            what += f". A solve with a fixed damage has failed: {self.failure}"
        most = max(self.onset, *(point.factor for point in self.path), 0.0)
        return DamageNotFound(
            f"{what}. Of these loads, the largest share that they were seen to carry is "
            f"{most:.4g}. Prescribe displacements in place of forces, take smaller load steps, "
            "refine the mesh or make the bonds' stiffness smaller"
        )


def _fails_alike(damage: Vector, wanted: Vector) -> bool:
    """Tell whether all bonds have failed that the law wants to fail."""
    return bool(np.all(damage[wanted >= 1.0] >= 1.0))

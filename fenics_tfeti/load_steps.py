"""Load steps whose length follows from how hard they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Protocol

from fenics_tfeti.checkpoint import Step
from fenics_tfeti.errors import ContactError, InputError, NotConverged
from fenics_tfeti.fem.displacement import fill_owned, owned_values

# shortest step, as a share of all; no shorter rest is left
_SHORTEST = 1e-3


class SteppedProblem(Protocol):
    """A problem that is solved in load steps."""

    u: Any
    _step: Step

    def solve(self) -> Any:
        """Solve at the present loads."""

    def advance(self) -> None:
        """Accept the last solve as a load step."""


def load_steps(
    problem: SteppedProblem,
    set_load: Callable[[float], Any],
    begin: float,
    end: float,
    first: float | None,
    is_easy: Callable[[], bool],
    is_restored: bool = False,
) -> Iterator[float]:
    """Solve and accept load steps from `begin` to `end`, see `NonlinearContactProblem.steps`.

    A restored problem goes on after the load of its checkpoint.
    """
    length = end - begin if first is None else first
    if not (begin < end and length > 0.0):
        raise InputError(
            f"load steps from {begin:g} to {end:g}, the first of {length:g}: the end has to be "
            "after the beginning, and the first step longer than 0"
        )
    t, easy = begin, 0
    if is_restored and problem._step.load > begin:
        t, length = problem._step.load, problem._step.length
        set_load(min(t, end))
    while t < end:
        rest = end - t
        is_last = rest - length < _SHORTEST * (end - begin)
        step, target = (rest, end) if is_last else (length, t + length)
        try:
            _solve(problem, set_load, target)
        except (InputError, NotConverged) as error:
            # an obstacle may have no gap where the surfaces are before a long step
            length, easy = 0.5 * step, 0
            if length >= _SHORTEST * (end - begin):
                continue
            set_load(t)
            if isinstance(error, InputError):
                raise
            raise NotConverged(
                f"the load step from {t:g} to {target:g} is not solved, nor were longer ones: "
                f"{error}",
                error.solution,
                error.report,
            ) from None
        problem.advance()
        easy = easy + 1 if is_easy() else 0
        t = target
        if easy == 2:
            length, easy = 2.0 * length, 0
        problem._step = replace(problem._step, load=t, length=length)
        yield t


def _solve(problem: SteppedProblem, set_load: Callable[[float], Any], load: float) -> None:
    """Solve at a load; the displacement is that before if there is no solution."""
    start = owned_values(problem.u)
    set_load(load)
    try:
        problem.solve()
    except ContactError:
        fill_owned(problem.u, start)
        raise

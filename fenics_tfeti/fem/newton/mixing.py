"""Anderson mixing of Newton steps: it makes up for what the tangent lacks of contact forces."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np

from fenics_tfeti.typing import Vector


@dataclass(frozen=True)
class Iterate:
    """A displacement, the step that Newton's method proposes from it, and the new multipliers."""

    displacement: Vector  # at the degrees of freedom that this rank owns [m]
    increment: Vector  # of the same shape [m]
    multipliers: Vector  # of contact, at the nodes that this rank owns, flattened


class AndersonMixing:
    """The last few steps with the same pressing nodes, combined for the smallest next step.

    Increments have a relative accuracy. Differences that depend on each other up to that would have
    large coefficients, which the errors of the increments determine. The residual may grow in a
    mixed step that takes a rolling body as far as many plain ones: linear rotations change volumes,
    which the next step corrects.
    """

    def __init__(self, comm: MPI.Intracomm, depth: int, accuracy: float) -> None:
        self._comm, self._accuracy = comm, accuracy
        self._last: deque[Iterate] = deque(maxlen=depth + 1)

    def forget(self) -> None:
        """Start anew, after a change of the pressing nodes."""
        self._last.clear()

    def mix(self, new: Iterate) -> Iterate | None:
        """Return the new step combined with earlier ones; None if it is alone. Collective.

        Its coefficients g minimise |d - dD g|, of the increment d and the differences dD of the
        increments of successive steps.
        """
        self._last.append(new)
        if len(self._last) < 2:
            return None
        increments = _differences([step.increment for step in self._last])
        ends = _differences([step.displacement + step.increment for step in self._last])
        multipliers = _differences([step.multipliers for step in self._last])
        g = self._least_squares(increments, new.increment)
        return Iterate(
            new.displacement, new.increment - ends @ g, new.multipliers - multipliers @ g
        )

    def _least_squares(self, A: Vector, b: Vector) -> Vector:
        """Return the least squares solution for rows on all ranks. Collective."""
        triangle = np.linalg.qr(np.column_stack([A, b]), mode="r")
        rows = np.concatenate(self._comm.allgather(triangle))
        A, b = rows[:, :-1], rows[:, -1]
        size = np.linalg.norm(A, axis=0)
        size[size == 0.0] = 1.0
        return np.linalg.lstsq(A / size, b, rcond=self._accuracy)[0] / size


def _differences(values: list[Vector]) -> Vector:
    """Return the differences of successive vectors as columns."""
    return np.diff(np.column_stack(values), axis=1)

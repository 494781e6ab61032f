"""The list of mistakes, and the problem in which most of them are made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mpi4py import MPI

import scenes

from fenics_tfeti.errors import InputError

Pose = Callable[[MPI.Comm], object]


@dataclass(frozen=True)
class Mistake:
    """A problem with one mistake, and what the error has to say about it.

    Attributes
    ----------
    pose : callable
        Sets up and solves the problem on a communicator.
    words : tuple of str
        Regular expressions that the message contains.
    error : type
        The exact type of the error.
    """

    pose: Pose
    words: tuple[str, ...]
    error: type[Exception]

    @property
    def name(self) -> str:
        return self.pose.__name__


MISTAKES: list[Mistake] = []


def mistake(*words: str, error: type[Exception] = InputError) -> Callable[[Pose], Pose]:
    """Enter the decorated function into the list of mistakes."""

    def enter(pose: Pose) -> Pose:
        MISTAKES.append(Mistake(pose, words, error))
        return pose

    return enter


def beams(comm: MPI.Comm) -> scenes.Scene:
    """Return the problem without a mistake: 5 slave nodes at y = 1, x = 1, 1.25, ..., 2."""
    return scenes.two_beams(comm, "quadrilateral", 4)

"""Tables of mistakes, and the problem in which most of them are made."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from mpi4py import MPI

import scenes

from fenics_tfeti.errors import InputError

Pose = Callable[[MPI.Comm], object]


class Mistake(NamedTuple):
    """A problem with one mistake; the page of errors has what the error says about it."""

    subject: str  # heading of the page of errors
    name: str
    pose: Pose  # sets up and solves the problem
    error: type[Exception]  # exactly this one


def table(
    subject: str, *rows: tuple[str, Pose], error: type[Exception] = InputError
) -> list[Mistake]:
    """Return the mistakes of rows (name, pose)."""
    return [Mistake(subject, name, pose, error) for name, pose in rows]


_MESHES: dict[int, scenes.Scene] = {}


def beams(comm: MPI.Comm) -> scenes.Scene:
    """Return the problem without a mistake: 5 slave nodes at y = 1, x = 1, 1.25, ..., 2.

    All problems on a communicator are on one mesh, `other_beams` are on one of their own.
    """
    if comm.size not in _MESHES:
        _MESHES[comm.size] = other_beams(comm)
    scene = scenes.Scene.of(_MESHES[comm.size])
    scenes.support_beams(scene)
    scene.add_pair()
    return scenes.loaded_beams(scene)


def other_beams(comm: MPI.Comm) -> scenes.Scene:
    return scenes.two_beams(comm, "quadrilateral", 4)


def posed(is_solved: bool = False, **parts: Any) -> Pose:
    """Return what poses the beams with forms `a` and `L` or other arguments.

    They are values, or functions of the scene.
    """

    def pose(comm: MPI.Comm) -> object:
        scene = beams(comm)
        given = {name: part(scene) if callable(part) else part for name, part in parts.items()}
        scene.a, scene.L = given.pop("a", scene.a), given.pop("L", scene.L)
        problem = scene.problem(**given)
        return problem.solve() if is_solved else problem

    return pose


def solved(**parts: Any) -> Pose:
    """Return what poses the beams as `posed` does, and solves them."""
    return posed(True, **parts)

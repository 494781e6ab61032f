"""The errors that a user can meet, each with a message that names the thing and the remedy."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from math import floor, isfinite, log10
from pathlib import Path
from typing import Any

_DIGITS = 6
# files whose lines are not the user's: the package, and where its context managers end
_PACKAGE = (f"{Path(__file__).parent}{os.sep}", contextlib.__file__)

# the list that warnings are added to, see `keep_warnings`
_KEPT: ContextVar[list[str] | None] = ContextVar("kept warnings", default=None)

# what comes with FEniCSx, in the order in which it is imported
_FENICSX = ("mpi4py", "petsc4py", "numpy", "scipy", "basix", "ffcx", "ufl", "dolfinx")


class ContactError(Exception):
    """Base class of all errors that fenics_tfeti raises on purpose."""


class InputError(ContactError, ValueError):
    """The data of a problem are wrong or contradict each other."""


class UnresistedMotion(InputError):
    """The load pushes a body where no support, no glue and no contact holds it, (11.16).

    Examples
    --------
    >>> try:  # doctest: +SKIP
    ...     problem.solve()
    ... except UnresistedMotion as error:
    ...     print(error)  # the bodies, and how they move
    """


class FactorizationError(ContactError, RuntimeError):
    """A sparse Cholesky factor could not be computed."""


class OutOfMemory(ContactError, MemoryError):
    """There is not enough memory for a sparse factor."""


class UnstableTangent(ContactError, RuntimeError):
    """The glued tangent is not positive: near buckling, or where only contact holds a body."""


class _WithIterate(BaseException):
    """An error that has the last iterate of a solve, and its report."""

    def __init__(self, message: str, solution: Any = None, report: Any = None) -> None:
        super().__init__(message)
        self.solution = solution
        self.report = report


class NotConverged(_WithIterate, ContactError, RuntimeError):
    """The iterations stopped at a limit before the requested accuracy was certified.

    Attributes
    ----------
    solution : object
        The iterate with the smallest certificate, as the solver returns it on convergence.
    report : object
        The report of the solve, with ``converged`` False and the ``reason``.

    Examples
    --------
    >>> try:  # doctest: +SKIP
    ...     problem.solve()
    ... except NotConverged as error:
    ...     print(error.report, error.solution)  # the last iterate
    """


class DamageNotFound(NotConverged):
    """The damage of bonds at the loads was not found, or they carry less; nothing has changed.

    Displacement, results and damage are those of the last solve that has ended.
    """


class Interrupted(_WithIterate, KeyboardInterrupt):
    """Ctrl-C, or SIGINT to a rank, has ended a solve on all ranks.

    Not a `ContactError`: a script that goes on after those still ends.

    Attributes
    ----------
    solution : object
        The last iterate, in the form of a solution; None if there was none.
    report : object
        The report of the solve, with the ``reason``; None if there was no iterate.
    """


def wrong_type(name: str, value: Any, expected: str) -> InputError:
    """Return the error that an argument is of another type than is expected."""
    return InputError(f"{name} is a {type(value).__name__}; {expected} is expected")


def check_value(fits: bool, name: str, value: object, expected: str) -> None:
    """Raise the error that an argument has another value than is expected, unless it fits."""
    if not fits:
        raise InputError(f"{name} is {value!r}; {expected} is expected")


@contextmanager
def keep_warnings(messages: list[str]) -> Iterator[None]:
    """Add the texts of the package's warnings in a block to a list, once each.

    >>> messages = []
    >>> with keep_warnings(messages), warnings.catch_warnings(action="ignore"):
    ...     warn_user("the slave is stiffer")
    >>> messages
    ['the slave is stiffer']
    """
    token = _KEPT.set(messages)
    try:
        yield
    finally:
        _KEPT.reset(token)


def warn_user(message: str) -> None:
    """Warn with the place of the user's line that has called the package."""
    kept = _KEPT.get()
    if kept is not None and message not in kept:
        kept.append(message)
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level)


def first_few(texts: Sequence[str], few: int, what: str) -> list[str]:
    """Return some texts, and in place of those after the first few how many others there are.

    Examples
    --------
    >>> ", ".join(first_few(["red", "green", "blue", "white"], 2, "colours"))
    'red, green, and 2 other colours'
    """
    others = len(texts) - few
    return [*texts[:few], f"and {others} other {what}"] if others > 0 else list(texts)


def without_places(text: str) -> str:
    """Shorten "body 1 (pin) in [0, 2] x [0, 1]" to "body 1 (pin)" wherever a text has it."""
    return re.sub(r"(body \d+ \([^()]*\)) in \[[^\]]*\](?: x \[[^\]]*\])*", r"\1", text)


def format_point(point: Iterable[float], size: float = 0.0) -> str:
    """Write coordinates for a message, without the rounding errors that they carry.

    Six digits are kept of the largest coordinate or of `size`, that of what surrounds a point near
    the origin.

    >>> format_point((1 / 3, 1.0, 1.4e-17))
    '(0.333333, 1, 0)'
    >>> format_point((1.4e-17, 0.0), size=1.0)
    '(0, 0)'
    """
    numbers = [float(x) for x in point]
    largest = max((abs(x) for x in (*numbers, size) if isfinite(x)), default=0.0)
    decimals = _DIGITS - floor(log10(largest)) if largest > 0.0 else 0
    # adding 0.0 turns -0.0 into 0.0
    return "(" + ", ".join(f"{round(x, decimals) + 0.0:.{_DIGITS}g}" for x in numbers) + ")"


@contextmanager
def needs_fenicsx(what: str) -> Iterator[None]:
    """Say how to install FEniCSx where an import in the block misses one of its packages."""
    try:
        yield
    except ModuleNotFoundError as error:
        missing = (error.name or "").split(".")[0]
        if missing not in _FENICSX:
            raise
        version = ".".join(map(str, sys.version_info[:2]))
        raise ImportError(
            f"{what} needs FEniCSx, but the package '{missing}' is missing from {sys.executable} "
            f"(Python {version}). Use the Python that has it (after 'make env': "
            "'. .venv/bin/activate'), or install it by 'apt install python3-dolfinx-real "
            "python3-petsc4py-real' (Debian, Ubuntu), 'conda install -c conda-forge fenics-dolfinx "
            "petsc4py mpi4py', or 'pip install dolfinx-solver-real' (Python 3.12 or later)"
        ) from error

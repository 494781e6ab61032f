"""The errors that a user can meet, each with a message that names the thing and the remedy."""

from __future__ import annotations

from typing import Any

__all__ = ["ContactError", "FactorizationError", "InputError", "NotConverged", "UnresistedMotion"]


class ContactError(Exception):
    """Base class of all errors that fenics_tfeti raises on purpose."""


class InputError(ContactError, ValueError):
    """The data of a problem are wrong or contradict each other."""


class UnresistedMotion(InputError):
    """The load pushes a body where no support, no glue and no contact holds it, (11.16)."""


class FactorizationError(ContactError, RuntimeError):
    """A sparse Cholesky factor could not be computed."""


class NotConverged(ContactError, RuntimeError):
    """The iterations stopped at a limit before the requested accuracy was certified.

    Attributes
    ----------
    solution : object
        The last iterate: what the solver would have returned on convergence.
    report : object
        The report of the solve, with ``converged`` False and the ``reason``.
    """

    def __init__(self, message: str, solution: Any = None, report: Any = None) -> None:
        super().__init__(message)
        self.solution = solution
        self.report = report

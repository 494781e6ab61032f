"""Options of Total FETI, grouped by prefix as those of PERMON and PETSc."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from math import isinf
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti.coarse.factor import CoarseSolverKind
from fenics_tfeti.feti.constraints.scaling import Scaling
from fenics_tfeti.feti.deflation.space import DeflationKind
from fenics_tfeti.feti.dual.operator import DualOperatorKind
from fenics_tfeti.feti.dual.preconditioner import PreconditionerKind
from fenics_tfeti.feti.factors.cholesky import Package
from fenics_tfeti.qp.proportioning import Expansion

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")


@dataclass(frozen=True)
class Options:
    """Options of `TornSolver`.

    Attributes
    ----------
    rtol : float
        Relative error of the displacement in the energy norm, of the whole and of each body, and
        the limit of every other number of the certificate.
    method : {"active_set", "smalbe"}
        The primal-dual active set method first, continued by SMALBE-M where it cycles; or SMALBE-M
        first, continued by the active set method where it is slow. SMALBE-M is over MPRGP, for
        friction in three dimensions over MPGP.
    preconditioner : {"auto", "lumped", "dirichlet", "none"}
        Preconditioner in the face; auto takes Dirichlet for nearly incompressible materials, and
        for flat or graded cells at interfaces.
    scaling : {"stiffness", "multiplicity"}
        D in B D^{-1} B' = I: the diagonal of the stiffness, or the identity as in (11.22).
    dual_operator : {"auto", "implicit", "explicit"}
        F by sparse solves, or by a dense matrix between the interface unknowns of each class of
        congruent subdomains; auto counts the bytes that either moves.
    factor : {"auto", "cholmod", "rslab", "mumps"}
        Package of the sparse Cholesky factors; auto takes the first that is available.
    coarse_solver : {"auto", "redundant", "distributed"}
        Factors of coarse matrices on every rank, or shared by some ranks with MUMPS; auto takes the
        one that moves less.
    deflation : {"auto", "on", "off"}
        Deflation of the directions in which subdomains make F large: of slender subdomains and
        those on whose interface the material jumps (with weights of stiffness), of all, or of none
        (which leaves slow faces to conjugate gradients, too).
    max_products : int
        Limit on the products with F.
    smalbe_rho, smalbe_M0, smalbe_beta, smalbe_eta : float
        Penalty (relative to ||PFP||), initial balance, its reduction, and the limit of the inner
        gradient relative to ||b|| in SMALBE-M, theorem 11.2.
    smalbe_max_it : int
        Limit on the outer iterations of SMALBE-M, with Coulomb's law of each step.
    smalbe_patience : int
        Outer iterations in a row that do not halve ||Gx||, after which SMALBE-M counts as slow.
    mprgp_gamma, mprgp_alpha : float
        Proportioning constant Gamma of MPRGP, and its fixed step length relative to 1 / ||A||, in
        (0, 2).
    mprgp_expansion : {"projected_cg", "standard"}
        Expansion step of MPRGP: the projected conjugate gradient step with the standard one as
        fall-back, or the half step and fixed step of algorithm 8.2.
    print_progress : bool
        Print a line for each step of the iterations, on rank 0.
    error_if_not_converged : bool
        Raise `NotConverged`, or else return the iterate with the smallest certificate, with
        ``converged`` false.
    """

    rtol: float = 1e-6
    method: Literal["active_set", "smalbe"] = "active_set"
    preconditioner: PreconditionerKind = "auto"
    scaling: Scaling = "stiffness"
    dual_operator: DualOperatorKind = "auto"
    factor: Package = "auto"
    coarse_solver: CoarseSolverKind = "auto"
    deflation: DeflationKind = "auto"
    max_products: int = 10_000
    smalbe_rho: float = 1.0
    smalbe_M0: float = 3.0
    smalbe_beta: float = 0.5
    smalbe_eta: float = 0.1
    smalbe_max_it: int = 1000
    smalbe_patience: int = 20
    mprgp_gamma: float = 1.0
    mprgp_alpha: float = 1.9
    mprgp_expansion: Expansion = "projected_cg"
    print_progress: bool = False
    error_if_not_converged: bool = True

    @property
    def is_plain(self) -> bool:
        """Whether F, the preconditioner and conjugate gradients on faces stay as they are.

        There is then no deflation, and neither weights of stiff modes nor direct solvers of faces.
        """
        return self.deflation == "off"

    def __post_init__(self) -> None:
        """Check the ranges of numbers."""
        for name in ("rtol", "smalbe_beta"):
            check_range(self, name, 0.0, 1.0)
        for name in ("max_products", "smalbe_max_it", "smalbe_patience"):
            check_range(self, name, 0, float("inf"))
        for name in ("smalbe_rho", "smalbe_M0", "mprgp_gamma"):
            check_range(self, name, 0.0, float("inf"))
        check_range(self, "smalbe_eta", 0.0, 1.0, closed=True)
        check_range(self, "mprgp_alpha", 0.0, 2.0)


def check_range(options: Any, name: str, low: float, high: float, closed: bool = False) -> None:
    """Raise an `InputError` unless an option is between two numbers, or at a `closed` upper end."""
    value = getattr(options, name)
    if not (low < value < high or (closed and value == high)):
        limit = "" if isinf(high) else f" and {'at most' if closed else 'below'} {high:g}"
        raise InputError(f"option {name!r} is {value}, it has to be above {low:g}{limit}")


def refuse_unknown(options: Mapping[str, Any], names: list[str]) -> None:
    """Raise an `InputError` for the first unknown name, with the nearest known one."""
    for name in options:
        if name not in names:
            close = difflib.get_close_matches(str(name), names, n=1)
            hint = f" Did you mean {close[0]!r}?" if close else ""
            raise InputError(f"unknown option {name!r}.{hint} Options are: {', '.join(names)}")


def parse_options(options: Mapping[str, Any]) -> Options:
    """Make options from a mapping; strings as of a command line are converted.

    Parameters
    ----------
    options : mapping
        Names and values.

    Returns
    -------
    Options
        With defaults for those that are not in the mapping.

    Raises
    ------
    InputError
        For an unknown name, with the nearest known one, or a value of the wrong kind.

    Examples
    --------
    >>> parse_options({"rtol": "1e-4", "mprgp_expansion": "standard"}).rtol
    0.0001
    """
    refuse_unknown(options, [f.name for f in fields(Options)])
    return convert(Options(), options)


def convert(defaults: T, values: Mapping[str, Any]) -> T:
    """Return options with some changed, by names that they have and values of any kind.

    Raises
    ------
    InputError
        For a value of the wrong kind or out of range.
    """
    hints = get_type_hints(type(defaults))
    new = {name: _convert(name, value, hints[name]) for name, value in values.items()}
    return replace(defaults, **new)


def _convert(name: str, value: Any, kind: Any) -> Any:
    if get_origin(kind) is Literal:
        if value not in get_args(kind):
            choices = ", ".join(repr(choice) for choice in get_args(kind))
            raise InputError(f"option {name!r} is {value!r}, it has to be one of {choices}")
        return value
    if kind is bool:
        truth = {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}
        # an option without a value, as -tfeti_print_progress
        word = str(value).lower() or "true"
        if word not in truth:
            raise InputError(f"option {name!r} is {value!r}, it has to be true or false")
        return truth[word]
    try:
        number = float(value)
        if kind is int and number != int(number):
            raise ValueError
        return kind(number)
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            f"option {name!r} is {value!r}, it has to be of type {kind.__name__}"
        ) from None

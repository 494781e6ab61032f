"""The solver's options."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args, get_origin, get_type_hints

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti.coarse.factor import CoarseSolverKind
from fenics_tfeti.feti.constraints.scaling import Scaling
from fenics_tfeti.feti.dual.operator import DualOperatorKind
from fenics_tfeti.feti.local.cholesky import Package
from fenics_tfeti.qp.mprgp import Expansion

__all__ = ["Options", "Partitioner", "parse_options"]

Partitioner = Literal["auto", "scotch"]


@dataclass(frozen=True)
class Options:
    """All options, with their defaults; the same names after ``-tfeti_`` on the command line.

    Attributes
    ----------
    rtol : float
        Relative tolerance: eps of the dual stopping test (11.47) and the limit of every number of
        the certificate.
    subdomain_size : int
        Unknowns of a subdomain that the partition aims at.
    partitioner : {"auto", "scotch"}
        Subdomains by SCOTCH, or, where the nodes of a body (of the part of it that a rank has) are
        a grid along the axes, by blocks of it: equal ones share their factors.
    fixing_nodes : int
        M of algorithm 11.1.
    factor : {"auto", "cholmod", "mumps"}
        Package of the sparse Cholesky factors; auto takes the first that PETSc has.
    dual_operator : {"auto", "implicit", "explicit"}
        F by sparse solves, or by a dense matrix between the interface unknowns of each class of
        congruent subdomains; auto counts the bytes that either moves.
    coarse_solver : {"auto", "redundant", "distributed"}
        Coarse matrices whole on every rank, or by rows on all of them, with MUMPS; auto counts.
    method : {"active_set", "smalbe"}
        SMALBE-M over MPRGP alone, or started from where a primal-dual active set method leads.
    preconditioner : {"none", "lumped", "dirichlet"}
        Preconditioner in the face.
    scaling : {"stiffness", "multiplicity"}
        D in B D^{-1} B' = I: the diagonal of the stiffness, or the identity as in (11.22).
    expansion : {"standard", "projected_cg"}
        Expansion step of MPRGP: the half step and fixed step of algorithm 8.2, or the projected
        conjugate gradient step with fall-back on the former.
    rho, M0, beta, eta : float
        Penalty, initial balance, its reduction and the limit of the inner gradient relative to
        ||b|| in SMALBE-M, theorem 11.2. rho is relative to ||PFP||.
    Gamma, step_length : float
        Proportioning constant of MPRGP, and its fixed step length relative to 1 / ||A||, in (0, 2).
    max_outer, max_products : int
        Limits on the outer iterations and on the products with F.
    norm_steps : int
        Lanczos steps for ||PFP||, by which SMALBE-M is scaled.
    seed : int
        Seed of the start vector of these.
    non_penetration : {"linearised", "exact"}
        Contact conditions with the normals and gaps of the undeformed surfaces, or corrected until
        the deformed surfaces touch.
    penetration_tolerance : float
        Penetration and separation of the deformed surfaces that count as none, relative to the
        largest displacement.
    max_passes : int
        Limit on the solutions with corrected normals and gaps.
    error_if_not_converged : bool
        Raise `NotConverged`, or else return the last iterate marked as such in the report.
    """

    rtol: float = 1e-6
    subdomain_size: int = 3000
    partitioner: Partitioner = "auto"
    fixing_nodes: int = 8
    factor: Package = "auto"
    dual_operator: DualOperatorKind = "auto"
    coarse_solver: CoarseSolverKind = "auto"
    method: Literal["active_set", "smalbe"] = "active_set"
    preconditioner: Literal["none", "lumped", "dirichlet"] = "lumped"
    scaling: Scaling = "stiffness"
    expansion: Expansion = "projected_cg"
    rho: float = 1.0
    M0: float = 3.0
    beta: float = 0.5
    eta: float = 0.1
    Gamma: float = 1.0
    step_length: float = 1.9
    max_outer: int = 1000
    max_products: int = 10_000
    norm_steps: int = 15
    seed: int = 0
    non_penetration: Literal["linearised", "exact"] = "linearised"
    penetration_tolerance: float = 1e-3
    max_passes: int = 20
    error_if_not_converged: bool = True

    def __post_init__(self) -> None:
        """Check the ranges of numbers."""
        _check_ranges(self)


# name: (exclusive lower limit, exclusive upper limit)
_RANGES: dict[str, tuple[float, float]] = {
    "rtol": (0.0, 1.0),
    "subdomain_size": (0, float("inf")),
    "fixing_nodes": (2, float("inf")),
    "rho": (0.0, float("inf")),
    "M0": (0.0, float("inf")),
    "beta": (0.0, 1.0),
    "eta": (0.0, 1.0 + 1e-12),
    "Gamma": (0.0, float("inf")),
    "step_length": (0.0, 2.0),
    "max_outer": (0, float("inf")),
    "max_products": (0, float("inf")),
    "penetration_tolerance": (0.0, float("inf")),
    "max_passes": (0, float("inf")),
    "norm_steps": (0, float("inf")),
    "seed": (-1, 2**63),
}


def _check_ranges(options: Options) -> None:
    for name, (low, high) in _RANGES.items():
        value = getattr(options, name)
        if not low < value < high:
            raise InputError(f"option {name!r} is {value}, it has to be between {low} and {high}")


def parse_options(given: Mapping[str, Any]) -> Options:
    """Make options from a mapping; strings as of a command line are converted.

    Parameters
    ----------
    given : mapping
        Names and values.

    Returns
    -------
    Options
        The given ones, defaults for the others.

    Raises
    ------
    InputError
        For an unknown name, with the nearest known one, or a value of the wrong kind.

    Examples
    --------
    >>> parse_options({"rtol": "1e-4", "expansion": "standard"}).rtol
    0.0001
    """
    hints = get_type_hints(Options)
    names = [f.name for f in fields(Options)]
    for name in given:
        if name not in names:
            close = difflib.get_close_matches(name, names, n=1)
            hint = f" Did you mean {close[0]!r}?" if close else ""
            raise InputError(f"unknown option {name!r}.{hint} Options are: {', '.join(names)}")
    return Options(**{name: _convert(name, value, hints[name]) for name, value in given.items()})


def _convert(name: str, value: Any, kind: Any) -> Any:
    if get_origin(kind) is Literal:
        if value not in get_args(kind):
            choices = ", ".join(repr(choice) for choice in get_args(kind))
            raise InputError(f"option {name!r} is {value!r}, it has to be one of {choices}")
        return value
    if kind is bool:
        known = {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}
        word = str(value).lower()
        if word not in known:
            raise InputError(f"option {name!r} is {value!r}, it has to be true or false")
        return known[word]
    try:
        number = float(value)
        if kind is int and number != int(number):
            raise ValueError
        return kind(number)
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            f"option {name!r} is {value!r}, it has to be of type {kind.__name__}"
        ) from None

"""Options of a contact problem: those of the partition, and those of the solver."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from typing import Any, TypeVar

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.decomposition.partition import SUBDOMAIN_SIZE, Partitioner
from fenics_tfeti.fem.io.units import UnitSystem
from fenics_tfeti.feti import TangentKind
from fenics_tfeti.feti.options import Options, check_range, convert, refuse_unknown
from fenics_tfeti.petsc import PETSc


@dataclass(frozen=True)
class ContactOptions:
    """Options of `ContactProblem`.

    Attributes
    ----------
    solver : Options
        Options of Total FETI, given by their names in the same mapping.
    subdomain_size : int
        Unknowns of a subdomain that the partition aims at.
    partitioner : {"auto", "scotch", "slabs"}
        Subdomains by the graph partitioner SCOTCH, or by cuts across the longest axes, of a number
        that makes them round. "auto" makes blocks where the nodes of a body (of the part of it that
        a rank has) are a grid along the axes, since equal ones share their factors, else whichever
        is rounder: slabs, or the parts of SCOTCH after they have been rounded.
    units : {"SI", "mm-N-MPa"}
        Units of the mesh, the loads and the material, which reports and their pages write beside
        numbers; of forces in plane problems they are per unit of length.
    damage_rtol : float
        Error of the tractions of cohesive bonds, relative to their strength, at which passes on
        the damage end.
    view : bool
        Print a summary of the report at the end of each solve, on rank 0.

    Examples
    --------
    >>> ContactProblem(a, L, options={"rtol": 1e-8, "subdomain_size": 5000})  # doctest: +SKIP
    """

    solver: Options = field(default_factory=Options)
    subdomain_size: int = SUBDOMAIN_SIZE
    partitioner: Partitioner = "auto"
    units: UnitSystem = "SI"
    damage_rtol: float = 1e-3
    view: bool = False

    def __post_init__(self) -> None:
        check_range(self, "subdomain_size", 0, float("inf"))
        check_range(self, "damage_rtol", 0.0, 1.0)

    def as_dict(self) -> dict[str, Any]:
        """Return all options but those of the solver, by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "solver"}


@dataclass(frozen=True)
class NewtonOptions(ContactOptions):
    """Options of `NonlinearContactProblem`: those of `ContactOptions`, and of Newton's method.

    By default ``rtol``, the accuracy of each linearised problem, is 1e-3; with friction they are
    solved more accurately near the end.

    Attributes
    ----------
    newton_rtol : float
        Residual and violation of the law of friction relative to reactions and contact forces, and
        penetration and separation relative to the largest displacement, at which Newton's method
        ends.
    newton_max_it : int
        Limit on the Newton steps of a load step.
    newton_step_limit : float
        Largest ``|grad du F^-1|`` of a Newton step, strain or rotation [rad]; longer steps are cut.
        In materials that are nearly incompressible when the problem is posed, ``|tr((grad du
        F^-1)^2)|`` is at most ``2 mu / kappa``, of the shear and the bulk modulus: stretches are at
        most 0.2 for Poisson's ratio 0.49, 0.063 for 0.499; simple shear is not cut.
    tangent : {"auto", "exact", "projected"}
        Tangents of subdomains: exact ones, which may be indefinite, or projected on those with all
        rigid motions as kernel, which are positive semidefinite; auto takes exact ones in bodies
        that supports hold without contact.

    Examples
    --------
    >>> NonlinearContactProblem(F, u, options={"newton_rtol": 1e-8})  # doctest: +SKIP
    """

    solver: Options = field(default_factory=lambda: Options(rtol=1e-3))
    newton_rtol: float = 1e-6
    newton_max_it: int = 30
    newton_step_limit: float = 0.3
    tangent: TangentKind = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "newton_rtol", 0.0, 1.0)
        for name in ("newton_max_it", "newton_step_limit"):
            check_range(self, name, 0, float("inf"))


_Kind = TypeVar("_Kind", bound=ContactOptions)


def contact_options(kind: type[_Kind], options: Mapping[str, Any] | None, prefix: str) -> _Kind:
    """Make options from a mapping, and from PETSc's database and the command line under a prefix.

    ``-<prefix><name> value`` on the command line overrides the mapping; strings are converted. An
    unknown name is an error, with the nearest known one.
    """
    if not isinstance(prefix, str) or not prefix or prefix.startswith("-"):
        raise InputError(
            f"options_prefix is {prefix!r}; expected a word such as 'tfeti_', without a dash"
        )
    if not isinstance(options, Mapping | None):
        raise InputError(
            f"options is a {type(options).__name__}; expected a dictionary of names and values"
        )
    merged = {**(options or {}), **_command_line(prefix)}
    contact = [f.name for f in fields(kind) if f.name != "solver"]
    solver = [f.name for f in fields(Options)]
    refuse_unknown(merged, [*solver, *contact])
    defaults = kind()
    chosen = convert(defaults.solver, {k: v for k, v in merged.items() if k in solver})
    defaults = convert(defaults, {k: v for k, v in merged.items() if k in contact})
    return replace(defaults, solver=chosen)


def _command_line(prefix: str) -> dict[str, str]:
    """Return the options given as ``-<prefix>name value`` to PETSc or to the script."""
    # PETSc too takes a word after a dash as an option, and a number after one as a value; a program
    # that embeds Python may have no command line
    options = {
        word[1 + len(prefix) :]: "" if re.match("-[A-Za-z]", following) else following
        for word, following in pairwise([*getattr(sys, "argv", [])[1:], ""])
        if word.startswith(f"-{prefix}")
    }
    # PETSc knows the command line only if petsc4py was started with it
    if PETSc is None:
        return options
    database = PETSc.Options(prefix)
    return options | {name: database.getString(name) for name in database.getAll()}

"""ContactProblem: the way from the user's forms and tags to displacements and contact forces."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

from mpi4py import MPI

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx.fem import Function

from fenics_tfeti.errors import NotConverged
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact import (
    Contact,
    ContactResult,
    MatchedContact,
    check_contacts,
    contact_rows,
    match_contact,
)
from fenics_tfeti.fem.displacement import (
    average_of_copies,
    displacement_space,
    prescribed_values,
)
from fenics_tfeti.fem.mesh_checks import check_mesh
from fenics_tfeti.fem.partition import find_bodies, given_subdomains, split_into_subdomains
from fenics_tfeti.fem.subdomain import prepare_forms
from fenics_tfeti.feti import Report, Timer, TornSolution, TornSolver, TornSystem, parse_options
from fenics_tfeti.feti.exchange import together

__all__ = ["ContactProblem"]


class ContactProblem:
    """Frictionless contact of linear elastic bodies, solved by Total FETI.

    Parameters
    ----------
    a, L : ufl.Form
        Bilinear and linear form on one space of Lagrange elements of degree 1 with a component for
        each dimension, with integrals over cells (``dx``) and the boundary (``ds``). SI units are
        meant in what follows; any consistent ones will do.
    bcs : sequence of dolfinx.fem.DirichletBC
        Prescribed displacements, on the space or its components, of any value.
    contacts : sequence of ContactPair or RigidObstacle
        What may touch.
    cell_tags : MeshTags, optional
        A tag for every cell, where bodies are to be told apart by tags: each tag is one body, its
        cells connected through facets. Bodies that share facets are glued there. By default the
        bodies are the connected parts of the mesh, which tells bodies apart that have nodes of
        their own. Tags of materials, which may be in several places, belong into ``dx`` alone.
    subdomains : sequence of int, optional
        A label for each cell that this rank owns: cells with the same label make a subdomain. By
        default each rank splits its cells by a graph partitioner.
    options : mapping, optional
        See `fenics_tfeti.feti.Options`; ``-tfeti_...`` on the command line comes first.

    Attributes
    ----------
    contact : list of ContactResult
        For each contact the nodes with gaps, normals, forces and pressures, after `solve`.
    report : Report
        Sizes, iterations, residuals and times, after `solve`.

    Raises
    ------
    InputError
        On all ranks together, for data that are wrong or contradict each other.

    Examples
    --------
    >>> problem = ContactProblem(  # doctest: +SKIP
    ...     a, L, bcs=[clamped], contacts=[ContactPair(facet_tags, slave=5, master=6)]
    ... )
    >>> uh = problem.solve()  # doctest: +SKIP
    """

    contact: list[ContactResult]
    report: Report

    def __init__(
        self,
        a: ufl.Form,
        L: ufl.Form,
        bcs: Sequence[Any] = (),
        contacts: Sequence[Contact] = (),
        cell_tags: Any | None = None,
        subdomains: Sequence[int] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        self.options = parse_options({**(options or {}), **_command_line()})
        self._timer = Timer()
        self.space = displacement_space(a, L)
        prescribed = prescribed_values(self.space, bcs)
        with self._timer.phase("partition"):
            bodies = find_bodies(self.space.mesh, cell_tags)
            check_mesh(self.space.mesh, bodies, contacts)
        with self._timer.phase("contact search"):
            check_contacts(contacts, self.space.mesh.comm)
            self._matched = [match_contact(self.space, c, i) for i, c in enumerate(contacts)]
        with self._timer.phase("compilation"):
            forms = prepare_forms(self.space, a, L)
        with self._timer.phase("partition"):
            if subdomains is None:
                cells = split_into_subdomains(self.space, bodies, self.options.subdomain_size)
            else:
                cells = given_subdomains(self.space.mesh, bodies, subdomains)
        with self._timer.phase("assembly"), together(self.space.mesh.comm):
            torn = [forms.subdomain(part, int(bodies.of_cell[part[0]])) for part in cells]
        gdim = self.space.mesh.geometry.dim
        self.system = TornSystem(
            torn,
            prescribed,
            contact_rows(self._matched, gdim),
            gdim,
            bodies.names,
            [matched.name for matched in self._matched],
            self.space.mesh.comm,
        )

    def solve(self) -> Function:
        """Solve the problem.

        Returns
        -------
        Function
            The displacement on the user's space [m].

        Raises
        ------
        InputError
            Wrong or contradictory data that only their assembly shows.
        UnresistedMotion
            A load pushes a body where nothing holds it.
        FactorizationError
            The form is not positive on a subdomain.
        NotConverged
            At a limit on iterations; its ``solution`` is the last iterate, `contact` and `report`
            are that one's. With the option ``error_if_not_converged`` false, it is returned.
        """
        try:
            solution = TornSolver(self.system, self.options, self._timer).solve()
        except NotConverged as error:
            error.solution = self._take(error.solution)
            error.report = self.report
            raise
        return self._take(solution)

    def _take(self, solution: TornSolution) -> Function:
        versions = {**solution.report.versions, "dolfinx": _compat.version()}
        self.report = replace(solution.report, versions=versions)
        ends = np.cumsum([matched.slave.size for matched in self._matched])[:-1]
        forces = np.split(solution.normal_force, ends)
        self.contact = [
            _contact_result(matched, force, self.space.mesh.comm)
            for matched, force in zip(self._matched, forces, strict=False)
        ]
        return average_of_copies(self.space, self.system.subdomains, solution.displacements)


def _contact_result(
    matched: MatchedContact, force: NDArray[np.float64], comm: MPI.Intracomm
) -> ContactResult:
    return ContactResult(
        matched.name,
        matched.slave,
        matched.coordinates,
        matched.gap,
        matched.normal,
        normal_force=force,
        pressure=force / matched.area,
        active=force > 0.0,
        comm=comm,
    )


def _command_line() -> dict[str, str]:
    """Return the options given as ``-tfeti_name value`` to PETSc or to the script."""
    database = PETSc.Options("tfeti_")
    # a program that embeds Python may have no command line
    for word, following in pairwise([*getattr(sys, "argv", [])[1:], ""]):
        # PETSc knows the command line only if petsc4py was started with it
        if word.startswith("-tfeti_") and not database.hasName(word.removeprefix("-tfeti_")):
            database.setValue(word.removeprefix("-tfeti_"), following)
    return {name: database.getString(name) for name in database.getAll()}

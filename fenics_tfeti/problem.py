"""ContactProblem: from the user's forms and tags to displacements and contact forces."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

import ufl
from dolfinx.fem import Function

from fenics_tfeti.continuation import Step, read_step, write_step
from fenics_tfeti.errors import InputError, Interrupted, NotConverged
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.arguments import (
    as_conditions,
    as_contacts,
    as_forms,
    as_tied_pairs,
    check_function,
)
from fenics_tfeti.fem.contact.contact import Contact, ContactPair, contact_name
from fenics_tfeti.fem.contact.contact_set import ContactSearch, ContactSet, SolvedContacts
from fenics_tfeti.fem.contact.deformed import GeometryPass, geometry_pass
from fenics_tfeti.fem.contact.result import ContactResult
from fenics_tfeti.fem.contact.slip import SlipOrigin
from fenics_tfeti.fem.contact.tied import TiedPair, tied_name
from fenics_tfeti.fem.contact.transfer import check_same_contacts, expected_contact
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.fem.decomposition.torn_mesh import TornMesh
from fenics_tfeti.fem.displacement import (
    displacement_function,
    fill_owned,
    owned_values,
    prescribed_values,
    space_of_forms,
)
from fenics_tfeti.fem.locking import warn_of_locking
from fenics_tfeti.fem.mesh_checks import check_mesh
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.strains import warn_of_large_gradients
from fenics_tfeti.feti import (
    ContactGuess,
    MonitorFunction,
    Timer,
    TornSolution,
    TornSolver,
    TornSystem,
    interruption,
)
from fenics_tfeti.feti.local.cholesky import check_real_numbers
from fenics_tfeti.options import contact_options
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.report import ContactReport


class ContactProblem:
    """Contact of linear elastic bodies, with or without friction, solved by Total FETI.

    Parameters
    ----------
    a, L : ufl.Form
        Bilinear and linear form on one space of Lagrange elements of degree 1 or 2 with a component
        for each dimension, with integrals over cells (``dx``) and the boundary (``ds``). Cells may
        be curved, of degree 2, with displacements of degree 2. SI units are meant in what follows;
        any consistent ones will do. ``L = 0`` is no load. Where the forms multiply ``ds`` by a
        weight, as axisymmetric ones do, the contacts need it as well.
    bcs : sequence of dolfinx.fem.DirichletBC, one of them, or None
        Prescribed displacements, on the space or its components, of any value.
    contacts : sequence of ContactPair or RigidObstacle, one of them, or None
        What may touch.
    tied : sequence of TiedPair, one of them, or None
        Surfaces that stay together.
    cell_tags : MeshTags, optional
        A tag for every cell, where bodies are to be told apart by tags: each tag is one body, its
        cells connected through facets. Bodies that share facets are glued there. By default the
        bodies are the connected parts of the mesh, which tells bodies apart that have nodes of
        their own. Tags of materials, which may be in several places, belong into ``dx`` alone.
    subdomains : sequence of int, optional
        A label for each cell that this rank owns: cells with the same label make a subdomain. By
        default each rank splits its cells into blocks or by a graph partitioner, see the option
        ``partitioner``.
    options : mapping, optional
        Names and values, see `fenics_tfeti.options.ContactOptions` and
        `fenics_tfeti.feti.Options`.
    options_prefix : str
        ``-<prefix><name> value`` on the command line, or in PETSc's database, overrides `options`.
        Problems of one script that are to differ need different prefixes.
    u : Function, optional
        The function on the displacement's space that each solve fills and returns, as for a file
        that a time loop writes to. By default each solve returns a new one.

    Attributes
    ----------
    contact : list of ContactResult
        For each contact the nodes with gaps, normals, forces and pressures, and with friction its
        forces and slips, after `solve`.
    report : ContactReport
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
    report: ContactReport

    def __init__(
        self,
        a: ufl.Form,
        L: ufl.Form | float,
        bcs: Sequence[Any] | Any | None = (),
        contacts: Sequence[Contact] | Contact | None = (),
        cell_tags: Any | None = None,
        subdomains: Sequence[int] | None = None,
        options: Mapping[str, Any] | None = None,
        options_prefix: str = "tfeti_",
        tied: Sequence[TiedPair] | TiedPair | None = (),
        u: Function | None = None,
    ) -> None:
        check_real_numbers()
        self.options = contact_options(options, options_prefix)
        self._timer = Timer()
        a, L = as_forms(a, L)
        self.space = space_of_forms(a, L)
        self._nodes = NodeMap(self.space)
        self.bcs, self.contacts = as_conditions(bcs), as_contacts(contacts)
        self.tied = as_tied_pairs(tied)
        self.u = check_function(u, self.space)
        with self._timer.phase("partition"):
            self._bodies = find_bodies(self.space.mesh, cell_tags)
            check_mesh(self.space.mesh, self._bodies, self.contacts)
        self._search = ContactSearch(self.space, self._bodies, self._timer)
        origin = SlipOrigin.undeformed(self.space, len(self.contacts))
        self._step = Step(origin.displacement, np.zeros((0, 0)), origin)
        self._is_restored = self._has_warned = False
        self._deformed: ContactSet | None = None  # after the last pass
        self._solved: SolvedContacts | None = None
        self._solver: TornSolver | None = None
        found = self._find_contacts()
        self._torn = TornMesh(
            self.space,
            a,
            L,
            self._bodies,
            self._search.boundary.coordinates,
            subdomains,
            self.options.subdomain_size,
            self.options.partitioner,
            self._timer,
        )
        with self._timer.phase("assembly"):
            warn_of_locking(self._torn.forms, self._bodies)
        self._assemble(found)

    def solve(
        self,
        coarse: ContactProblem | None = None,
        monitor: MonitorFunction | None = None,
        checkpoint: str | os.PathLike[str] | None = None,
    ) -> Function:
        """Solve the problem, at the present values of loads, prescribed displacements and contacts.

        For load steps, change the values of constants and functions in `L` and in the Dirichlet
        conditions, or the entries of ``contacts`` (obstacles are evaluated anew in any case), and
        solve again: what did not change is reused, and the iterations start from the last contact
        forces. Changed data of `a` and moved nodes (``mesh.geometry.x``) are noticed too, and cost
        a new assembly and factorisation.

        With friction each solve that converges is a load step: the next one counts slip from its
        end. `reset_slip` and moved nodes make the undeformed state the origin again.

        Parameters
        ----------
        coarse : ContactProblem, optional
            The same problem on a coarser mesh (any mesh will do), solved: its contact, pressures
            and gaps transferred to this mesh, is where the iterations start. With elements twice
            as large it leaves hardly more of them than a problem whose contact is known. That pays
            where the coarse problem is solved anyway, or is much smaller. The contacts have to be
            the same, in the same order and under the same names. The surfaces of the coarse mesh
            are gathered on all ranks.
        monitor : callable, optional
            Called on all ranks with an `ActiveSetStep` for each face of the active set method and
            an `OuterIteration` for each outer iteration of SMALBE-M, when they end. The option
            ``monitor`` prints them.
        checkpoint : path-like, optional
            File to write or replace at the end of the solve and of each pass with exact
            non-penetration, and after an interruption, see `restore`.

        Returns
        -------
        Function
            The displacement on the user's space [m].

        Raises
        ------
        InputError
            Wrong or contradictory data that only their assembly shows; a `coarse` that is not
            solved, has other contacts or another dimension, or comes with ``method="smalbe"``.
        UnresistedMotion
            A load pushes a body where nothing holds it.
        FactorizationError
            The form is not positive on a subdomain.
        NotConverged
            At a limit on iterations or on geometry passes; its ``solution`` is the last iterate,
            `contact` and `report` are that one's. With the option ``error_if_not_converged`` false,
            it is returned.
        Interrupted
            After Ctrl-C or SIGINT to one rank, on all of them; its ``solution`` is the last iterate
            if there is one, `contact` and `report` are that one's. Solving again goes on from it.
        OSError
            If the checkpoint cannot be written; an old one is left as it is.
        """
        with interruption.deferred():
            try:
                uh = self._solve(coarse, monitor, checkpoint)
            except Interrupted as error:
                if error.solution is not None:
                    self._save(checkpoint)
                raise
            finally:
                self._timer.restart()
            if not self._has_warned:
                energy = [body.energy_norm**2 for body in self.report.certificate.bodies]
                self._has_warned = warn_of_large_gradients(uh, self._bodies, energy)
            step = replace(self._step, solves=self._step.solves + 1, passes=())
            if self.report.converged:
                displacements = self._undeformed.obstacle_displacements()
                step = replace(step, origin=SlipOrigin(step.displacement, displacements))
            self._step = step
            self._save(checkpoint)
            try:
                interruption.check(self.space.mesh.comm)
            except Interrupted:
                raise Interrupted("interrupted", uh, self.report) from None
        if self.options.view and self.space.mesh.comm.rank == 0:
            print(self.report, flush=True)
        return uh

    def reset_slip(self) -> None:
        """Count slip from the undeformed state in the next solve, as in the first one."""
        origin = SlipOrigin.undeformed(self.space, len(self.contacts))
        self._step = replace(self._step, origin=origin)

    def restore(self, checkpoint: str | os.PathLike[str]) -> int:
        """Go on from a checkpoint that an earlier run of the same problem has written. Collective.

        The next solve starts from the saved contact forces and, with exact non-penetration, from
        the saved pass. A checkpoint changes where iterations start, not what they end with: loads,
        prescribed values, obstacles and materials are those that the problem has now.

        Parameters
        ----------
        checkpoint : path-like
            The file. A run on as many ranks, whose mesh dolfinx distributes alike, starts from
            all multipliers, any other one from the contact forces. The cells of the mesh have to
            be given in the same order.

        Returns
        -------
        int
            How many calls of `solve` were finished: the load step to go on with.

        Raises
        ------
        InputError
            If the file is no checkpoint, damaged, or that of another problem; if this problem was
            solved already.
        OSError
            If the file cannot be read.

        Examples
        --------
        >>> begin = problem.restore(file) if Path(file).exists() else 0  # doctest: +SKIP
        >>> for step in range(begin, len(loads)):  # doctest: +SKIP
        ...     load.value = loads[step]
        ...     uh = problem.solve(checkpoint=file)
        """
        if self._solver is not None:
            raise InputError("a checkpoint is for a problem that was not solved yet")
        self._step = read_step(checkpoint, self.system, self._nodes, len(self.contacts))
        self._is_restored = True
        return self._step.solves

    def _save(self, checkpoint: str | os.PathLike[str] | None) -> None:
        """Write the checkpoint, if there is to be one."""
        if checkpoint is not None and self._solver is not None:
            step = replace(self._step, state=self._solver.state)
            write_step(checkpoint, self.system, self._nodes, step)

    # -- the present data --------------------------------------------------------------------------

    def _find_contacts(self) -> ContactSet:
        prescribed = prescribed_values(self.space, self.bcs)
        return self._search.find(self.contacts, self.tied, prescribed)

    def _assemble(self, found: ContactSet) -> None:
        """Make the torn system from the conditions of contacts, which may exchange roles."""
        torn = self._torn.assemble(self._release)
        self._undeformed = found = self._search.with_roles(found, torn)
        self.system = TornSystem(
            torn,
            found.prescribed,
            found.rows(),
            self.space.mesh.geometry.dim,
            self._bodies.names,
            found.names,
            self.space.mesh.comm,
            [f"Dirichlet condition {i}" for i in range(len(self.bcs))],
            found.tied_rows(),
            found.friction_rows(self._step.origin),
        )

    def _refresh(self) -> None:
        """Update the system by all that changed since the last solve or the set-up."""
        with raise_collectively(self.space.mesh.comm):
            self.bcs, self.contacts = as_conditions(self.bcs), as_contacts(self.contacts)
            self.tied = as_tied_pairs(self.tied)
        origin = self._step.origin.resized(len(self.contacts))
        self._step = replace(self._step, origin=origin)
        if self._torn.has_moved():
            check_mesh(self.space.mesh, self._bodies, self.contacts)
            self._search.forget()
            self._deformed = None
            self.reset_slip()
            self._torn.place_nodes(self._search.boundary.coordinates)
        self._assemble(self._find_contacts())

    def _release(self) -> None:
        """Free the last stiffness matrices and factors, before others take their place."""
        if hasattr(self, "system"):
            self.system = replace(self.system, subdomains=[])
        if self._solver is not None:
            self._solver.release()

    def _check_coarse(self, coarse: Any) -> None:
        with raise_collectively(self.space.mesh.comm):
            if not isinstance(coarse, ContactProblem):
                raise InputError(
                    f"coarse is a {type(coarse).__name__}; a ContactProblem is expected, solved on "
                    "another mesh"
                )
            if coarse.system.gdim != self.system.gdim:
                raise InputError(
                    f"the coarse problem has {coarse.system.gdim} dimensions, this one has "
                    f"{self.system.gdim}"
                )
            names = [contact_name(c, i) for i, c in enumerate(self.contacts)]
            names += [tied_name(pair, i) for i, pair in enumerate(self.tied)]
            check_same_contacts(coarse.system.contact_names, names)
            if self.options.solver.method != "active_set":
                raise InputError(
                    "a coarse problem is a start for method='active_set'; with "
                    f"{self.options.solver.method!r} leave it out"
                )
            if coarse._solved is None:
                raise InputError("the coarse problem is not solved; call its solve() first")

    # -- solutions ---------------------------------------------------------------------------------

    def _solve(
        self,
        coarse: ContactProblem | None,
        monitor: MonitorFunction | None,
        checkpoint: str | os.PathLike[str] | None,
    ) -> Function:
        if coarse is not None:
            self._check_coarse(coarse)
        # also at first: values may have changed since the problem was set up
        self._refresh()
        if self.options.non_penetration == "linearised":
            return self._solve_linearised(self._undeformed, coarse, monitor)
        return self._solve_exactly(coarse, monitor, checkpoint)

    def _solve_linearised(
        self,
        conditions: ContactSet,
        coarse: ContactProblem | None,
        monitor: MonitorFunction | None,
    ) -> Function:
        friction = conditions.friction_rows(self._step.origin)
        system = replace(self.system, contacts=conditions.rows(), friction=friction)
        guess = self._guess(coarse, conditions)
        solver, start = self.options.solver, self._step.state
        self._solver = TornSolver(system, solver, self._timer, self._solver, guess, start)
        self._is_restored = False
        try:
            solution = self._solver.solve(monitor)
        except (NotConverged, Interrupted) as error:
            if error.solution is None:
                raise
            error.solution = self._store_results(error.solution, conditions)
            error.report = self.report
            raise
        return self._store_results(solution, conditions)

    def _guess(self, coarse: ContactProblem | None, conditions: ContactSet) -> ContactGuess | None:
        """Return the contact of a coarse problem, or that of a checkpoint of other subdomains."""
        if coarse is not None and coarse._solved is not None:
            with self._timer.phase("coarse contact"):
                return expected_contact(coarse._solved.gathered(), conditions.pairings)
        has_state = self._step.state is not None
        if not self._is_restored or has_state or self.options.solver.method != "active_set":
            return None
        return self._step.guess(conditions.pairings, self._nodes.first)

    def _solve_exactly(
        self,
        coarse: ContactProblem | None,
        monitor: MonitorFunction | None,
        checkpoint: str | os.PathLike[str] | None,
    ) -> Function:
        """Repeat with normals, gaps and partners of the deformed surfaces, sec. 11.1, 11.11.2."""
        self._check_initial_gaps()
        conditions, comm = self._first_conditions(), self.space.mesh.comm
        passes = list(self._step.passes) if self._is_restored else []
        while True:
            self._step = replace(self._step, passes=passes)
            uh = self._solve_linearised(conditions, None if passes else coarse, monitor)
            with self._timer.phase("deformed surfaces"):
                self._deformed, measured = conditions.deformed(uh)
            assert self._solved is not None
            products = self.report.products["total"]
            new_pass = geometry_pass(measured, self._solved.results, uh, products)
            passes = [*passes, replace(new_pass, seconds=self._timer.lap(comm))]
            seconds = self._timer.slowest(comm)
            self.report = replace(self.report, passes=passes, seconds=seconds)
            if passes[-1].error <= self.options.non_penetration_tolerance:
                return uh
            if len(passes) >= self.options.non_penetration_max_it:
                return self._not_exact(uh, passes[-1])
            self._step = replace(self._step, passes=passes)
            self._save(checkpoint)
            conditions = self._deformed.with_friction()

    def _first_conditions(self) -> ContactSet:
        """Return the conditions where the last solution ended, nearer than the undeformed ones."""
        undeformed = self._undeformed
        if self._is_restored:
            uh = fill_owned(Function(self.space), self._step.displacement)
            with self._timer.phase("deformed surfaces"):
                self._deformed, _ = undeformed.deformed(uh)
        if self._deformed is None or not undeformed.has_same_contacts(self._deformed):
            return undeformed
        return undeformed.at_conditions_of(self._deformed)

    def _check_initial_gaps(self) -> None:
        with raise_collectively(self.space.mesh.comm):
            for number, contact in enumerate(self.contacts):
                if isinstance(contact, ContactPair) and contact.initial_gap != "geometric":
                    raise InputError(
                        f"{contact_name(contact, number)}: initial_gap={contact.initial_gap!r} "
                        "replaces the gap of the mesh, but non_penetration='exact' measures gaps "
                        "on the deformed mesh. Leave out one of them"
                    )

    def _not_exact(self, uh: Function, last: GeometryPass) -> Function:
        reason = (
            f"limit of {self.options.non_penetration_max_it} geometry passes "
            "(non_penetration_max_it): the deformed surfaces penetrate or gape by "
            f"{last.error:.1e} of the largest displacement"
        )
        self.report = replace(self.report, converged=False, reason=reason)
        if self.options.solver.error_if_not_converged:
            raise NotConverged(
                f"no exact non-penetration to {self.options.non_penetration_tolerance:g}: "
                f"{reason}. Raise the limit or non_penetration_tolerance, or set "
                "error_if_not_converged to false",
                uh,
                self.report,
            )
        return uh

    def _store_results(self, solution: TornSolution, conditions: ContactSet) -> Function:
        report = solution.report
        on_slaves, on_masters = conditions.as_given(report.on_slaves, report.on_masters)
        self.report = ContactReport(
            **{
                **vars(report),
                "on_slaves": on_slaves,
                "on_masters": on_masters,
                "contact_forces": [side.force for side in on_slaves],
                "versions": {**report.versions, "dolfinx": _compat.version()},
                "options": {**report.options, **self.options.as_dict()},
            },
            pairing=self._search.pairing_entries(conditions),
        )
        uh = displacement_function(
            self.space, self.system.subdomains, solution.displacements, self.u
        )
        self._solved = solved = conditions.solved(solution, uh)
        self.contact = solved.as_given()
        displacement, force = owned_values(uh), solved.nodal_forces()
        self._step = replace(self._step, displacement=displacement, force=force)
        return uh

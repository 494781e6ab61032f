"""ContactProblem: the way from the user's forms and tags to displacements and contact forces."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx.fem import Function

from fenics_tfeti.continuation import (
    Continuation,
    nodal_forces,
    read_continuation,
    write_continuation,
)
from fenics_tfeti.errors import InputError, Interrupted, NotConverged
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.arguments import (
    as_conditions,
    as_contacts,
    as_forms,
    as_tied_pairs,
    check_function,
)
from fenics_tfeti.fem.contact.checks import check_depth
from fenics_tfeti.fem.contact.contact import (
    Contact,
    ContactPair,
    ContactPairing,
    ContactResult,
    FrictionResult,
    contact_name,
)
from fenics_tfeti.fem.contact.deformed import (
    DeformedContact,
    GeometryPass,
    deformed_contact,
    geometry_pass,
)
from fenics_tfeti.fem.contact.matching import contact_rows, match_contacts
from fenics_tfeti.fem.contact.opening import openings
from fenics_tfeti.fem.contact.pairing_summary import warn_of_deviation
from fenics_tfeti.fem.contact.roles import (
    describe_roles,
    exchanged,
    prefers_exchange,
    roles_ratio,
    warn_of_roles,
)
from fenics_tfeti.fem.contact.slip import (
    NodalFriction,
    SlipOrigin,
    friction_result,
    friction_rows,
    moved_obstacles,
    nodal_friction,
)
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.fem.contact.tied import TiedPair, TiedPairing, tie_pairs, tied_name, tied_rows
from fenics_tfeti.fem.contact.transfer import check_same_contacts, expected_contact, gather_solved
from fenics_tfeti.fem.decomposition.assembly import prepare_forms, same_values
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.fem.decomposition.partition import as_subdomains, split_into_subdomains
from fenics_tfeti.fem.decomposition.parts import Part, number_parts
from fenics_tfeti.fem.displacement import (
    displacement_function,
    fill_owned,
    owned_values,
    prescribed_values,
    space_of_forms,
)
from fenics_tfeti.fem.input_numbers import OwnedNodes, input_numbers
from fenics_tfeti.fem.locking import warn_of_locking
from fenics_tfeti.fem.mesh_checks import check_mesh
from fenics_tfeti.fem.strains import warn_of_large_gradients
from fenics_tfeti.feti import (
    ContactGuess,
    MonitorFunction,
    Prescribed,
    Report,
    Subdomain,
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
        self.bcs, self.contacts = as_conditions(bcs), as_contacts(contacts)
        self.tied = as_tied_pairs(tied)
        self.u = check_function(u, self.space)
        self._tied: list[tuple[TiedPair, TiedPairing]] = []
        # pairs whose roles were exchanged, by the identity of the user's
        self._exchanged: dict[int, tuple[Contact, Contact]] = {}
        # the pairs whose roles were judged, and what the report says of them
        self._judged: list[tuple[Contact, dict[str, Any]]] = []
        self._searched: list[Contact] = []
        self._matched: list[ContactPairing] = []
        self._moved: list[ContactPairing] = []
        self._used: list[ContactPairing] = []
        # friction at the conditions of `_matched`
        self._rubbing: list[NodalFriction | None] = []
        self._solver: TornSolver | None = None
        self._displacement: Function | None = None
        self._monitor: MonitorFunction | None = None
        self._checkpoint: str | os.PathLike[str] | None = None
        self._continued: Continuation | None = None
        self._warned_of_gradients = False
        self._solves = 0
        self._passes = list[GeometryPass]()
        self._origin = SlipOrigin.undeformed(self.space, len(self.contacts))
        prescribed = prescribed_values(self.space, self.bcs)
        with self._timer.phase("partition"):
            bodies = self._bodies = find_bodies(self.space.mesh, cell_tags)
            check_mesh(self.space.mesh, bodies, self.contacts)
        with self._timer.phase("contact search"):
            self._boundary = MeshBoundary.of(self.space)
        self._match_contacts(prescribed)
        with self._timer.phase("compilation"):
            self._forms = prepare_forms(self.space, a, L)
        with self._timer.phase("partition"):
            if subdomains is None:
                size, partitioner = self.options.subdomain_size, self.options.partitioner
                cells = split_into_subdomains(self.space, bodies, size, partitioner)
            else:
                cells = as_subdomains(self.space.mesh, bodies, subdomains)
            self._cells = cells
            self._parts = self._numbered_parts()
        self._body_names = bodies.names
        self._x = self.space.mesh.geometry.x.copy()
        self._values = self._forms.values()
        with self._timer.phase("assembly"):
            warn_of_locking(self._forms, bodies)
        torn = self._assemble()
        self._judge_roles(torn, prescribed)
        self.system = self._torn_system(torn, prescribed)
        self._stale = False
        self._solved_before = False

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
        self._monitor, self._checkpoint = monitor, checkpoint
        with interruption.deferred():
            try:
                uh = self._solve(coarse)
            except Interrupted as error:
                if error.solution is not None:
                    self._save(error.solution, self._passes)
                raise
            self._solves += 1
            if not self._warned_of_gradients:
                energy = [body.energy_norm**2 for body in self.report.certificate.bodies]
                self._warned_of_gradients = warn_of_large_gradients(uh, self._bodies, energy)
            if self.report.converged:
                moved = moved_obstacles(self.space, self._matched, self._rubbing)
                self._origin = SlipOrigin(owned_values(uh), moved)
            self._save(uh, [])
            try:
                interruption.check(self.space.mesh.comm)
            except Interrupted:
                raise Interrupted("interrupted", uh, self.report) from None
        if self.options.view and self.space.mesh.comm.rank == 0:
            print(self.report, flush=True)
        return uh

    def reset_slip(self) -> None:
        """Count slip from the undeformed state in the next solve, as in the first one."""
        self._origin = SlipOrigin.undeformed(self.space, len(self.contacts))

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
        if self._solved_before:
            raise InputError("a checkpoint is for a problem that was not solved yet")
        nodes = OwnedNodes.from_space(self.space, self._input_numbers)
        saved = read_continuation(checkpoint, self.system, nodes, len(self.contacts))
        self._continued, self._solves = saved, saved.solves
        self._origin = saved.origin
        return saved.solves

    def _save(self, uh: Function, passes: Sequence[GeometryPass]) -> None:
        """Write the checkpoint, if there is to be one."""
        if self._checkpoint is not None and self._solver is not None:
            nodes = OwnedNodes.from_space(self.space, self._input_numbers)
            saved = Continuation(
                self._solver.state,
                owned_values(uh),
                nodal_forces(nodes, self.contact),
                self._solves,
                self._origin,
                passes,
            )
            write_continuation(self._checkpoint, self.system, nodes, saved)

    @cached_property
    def _input_numbers(self) -> NDArray[np.int64] | None:
        return input_numbers(self.space)

    def _solve(self, coarse: ContactProblem | None) -> Function:
        if self._solved_before:
            self._timer = Timer()
        self._solved_before = True
        if coarse is not None:
            self._check_coarse(coarse)
        # also at first: values may have changed since the problem was set up
        self._refresh()
        if self.options.non_penetration == "linearised":
            return self._solve_linearised(self._matched, coarse)
        return self._solve_exactly(coarse)

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
            if coarse._displacement is None:
                raise InputError("the coarse problem is not solved; call its solve() first")

    def _guess(
        self, coarse: ContactProblem | None, matched: Sequence[ContactPairing]
    ) -> ContactGuess | None:
        if coarse is None or coarse._displacement is None:
            return self._restored_guess(matched)
        with self._timer.phase("coarse contact"):
            solved = gather_solved(
                coarse._boundary,
                coarse._searched,
                coarse._used,
                coarse.contact,
                coarse._displacement,
            )
            return expected_contact(solved, matched)

    def _restored_guess(self, matched: Sequence[ContactPairing]) -> ContactGuess | None:
        """Return the contact forces of a checkpoint whose multipliers are those of other ranks."""
        saved = self._continued
        if saved is None or saved.state is not None or self.options.solver.method != "active_set":
            return None
        return saved.guess(matched, self.space.dofmap.index_map.local_range[0])

    def _match_contacts(self, prescribed: Prescribed) -> None:
        with self._timer.phase("contact search"):
            contacts = [self._exchanged.get(id(c), (c, c))[1] for c in self.contacts]
            known = list(zip(self._searched, self._matched, strict=True))
            if [id(c) for c in self._searched] != [id(c) for c in contacts]:
                self._moved = []
            matched = match_contacts(self._boundary, contacts, known, prescribed)
            check_depth(self.space, self._bodies, matched)
            self._searched, self._matched = contacts, matched
            self._rubbing = self._nodal_friction(self._matched, prescribed)
            self._tied = tie_pairs(self._boundary, self.tied, self._tied, prescribed)

    def _nodal_friction(
        self, matched: Sequence[ContactPairing], prescribed: Prescribed
    ) -> list[NodalFriction | None]:
        return [
            nodal_friction(self.space, contact, match, prescribed)
            for contact, match in zip(self._searched, matched, strict=True)
        ]

    def _judge_roles(self, torn: Sequence[Subdomain], prescribed: Prescribed) -> None:
        """Exchange slave and master of new pairs where that is better and wanted, or warn."""
        comm = self.space.mesh.comm
        known = {id(contact) for contact, _ in self._judged}
        for number, contact in enumerate(self.contacts):
            if id(contact) in known or not isinstance(contact, ContactPair):
                continue
            match, obstacle = self._matched[number], None
            ratio = roles_ratio(comm, match, torn)
            exchange = prefers_exchange(contact, ratio)
            if exchange:
                obstacle = self._exchange_roles(contact, prescribed)
                exchange = obstacle is None
            roles = describe_roles(contact, ratio, exchange, obstacle)
            if ratio is not None and exchange:
                ratio = 1.0 / ratio
            self._judged.append((contact, {"roles_ratio": ratio, "roles": roles}))
            with raise_collectively(comm):
                if ratio is not None and comm.rank == 0:
                    warn_of_roles(match.name, ratio)
        with raise_collectively(comm):
            for contact, match in zip(self.contacts, self._matched, strict=True):
                if comm.rank == 0 and id(contact) not in known:
                    warn_of_deviation(match.summary)

    def _exchange_roles(self, contact: ContactPair, prescribed: Prescribed) -> str | None:
        """Exchange the roles of a pair; return the error, if any, with which they are as given."""
        self._exchanged[id(contact)] = (contact, exchanged(contact))
        try:
            self._match_contacts(prescribed)
        except InputError as error:
            # surfaces that can be masters only, such as folded ones, or masters of other pairs
            del self._exchanged[id(contact)]
            self._match_contacts(prescribed)
            return str(error)
        return None

    def _pairing_entries(self) -> list[dict[str, Any]]:
        nothing = {"roles_ratio": None, "roles": None}
        judged = {id(contact): roles for contact, roles in self._judged}
        entries = [
            {**match.summary, **judged.get(id(contact), nothing)}
            for contact, match in zip(self.contacts, self._matched, strict=True)
        ]
        return entries + [pairing.summary for _, pairing in self._tied]

    def _resultants(self, report: Report) -> dict[str, list[Any]]:
        """Return the forces and moments on slaves and masters as the user gave them."""
        sides = [report.on_slaves.copy(), report.on_masters.copy()]
        for number, contact in enumerate(self.contacts):
            if id(contact) in self._exchanged:
                for side, other in zip(sides, (report.on_masters, report.on_slaves), strict=True):
                    side[number] = other[number]
        forces = [side.force for side in sides[0]]
        return {"on_slaves": sides[0], "on_masters": sides[1], "contact_forces": forces}

    def _assemble(self, known: Sequence[Subdomain] | None = None) -> list[Subdomain]:
        """Assemble the subdomains, or only the loads of known ones."""
        with self._timer.phase("assembly"):
            return self._forms.subdomains(self._parts, known, self._boundary.coordinates)

    def _torn_system(self, torn: Sequence[Subdomain], prescribed: Prescribed) -> TornSystem:
        gdim = self.space.mesh.geometry.dim
        rows = contact_rows(self._matched, gdim)
        return TornSystem(
            torn,
            prescribed,
            rows,
            gdim,
            self._body_names,
            [*(matched.name for matched in self._matched), *(one.name for _, one in self._tied)],
            self.space.mesh.comm,
            [f"Dirichlet condition {i}" for i in range(len(self.bcs))],
            tied_rows([one for _, one in self._tied], gdim, len(self._matched)),
            friction_rows(self.space, rows, self._matched, self._rubbing, self._origin),
        )

    def _refresh(self) -> None:
        """Take in what changed since the last solve, or since the problem was set up."""
        with raise_collectively(self.space.mesh.comm):
            self.bcs, self.contacts = as_conditions(self.bcs), as_contacts(self.contacts)
            self.tied = as_tied_pairs(self.tied)
        self._origin = self._origin.of_contacts(len(self.contacts))
        moved = self._take_moved_mesh()
        prescribed = prescribed_values(self.space, self.bcs)
        self._match_contacts(prescribed)
        before, now = self._values, self._forms.values()
        comm = self.space.mesh.comm
        if moved or self._stale or not same_values(before.bilinear, now.bilinear, comm):
            self._release()
            torn = self._assemble()
        elif not same_values(before.linear, now.linear, comm):
            torn = self._assemble(self.system.subdomains)
        else:
            torn = list(self.system.subdomains)
        self._values, self._stale = now, False
        self._judge_roles(torn, prescribed)
        self.system = self._torn_system(torn, prescribed)

    def _release(self) -> None:
        """Free the last stiffness matrices and factors, before others take their place."""
        self._stale = True
        self.system = replace(self.system, subdomains=[])
        if self._solver is not None:
            self._solver.release()

    def _numbered_parts(self) -> list[Part]:
        bodies = [self._bodies.of_cell[cells[0]] for cells in self._cells]
        return number_parts(self.space, self._cells, bodies, self._boundary.coordinates)

    def _take_moved_mesh(self) -> bool:
        """Tell whether nodes were moved since the last solve; then nothing found on them holds."""
        domain = self.space.mesh
        if same_values([self._x], [domain.geometry.x], domain.comm):
            return False
        self._stale = True
        check_mesh(domain, self._bodies, self.contacts)
        with self._timer.phase("contact search"):
            self._boundary = MeshBoundary.of(self.space)
        self._searched, self._matched, self._moved, self._tied = [], [], [], []
        self.reset_slip()
        with self._timer.phase("partition"):
            self._parts = self._numbered_parts()
        # last: after an error above, the nodes count as moved in the next solve too
        self._x = domain.geometry.x.copy()
        return True

    def _solve_linearised(
        self, matched: Sequence[ContactPairing], coarse: ContactProblem | None = None
    ) -> Function:
        rows = contact_rows(matched, self.system.gdim)
        rubbing = self._rubbing
        if matched is not self._matched:
            rubbing = self._nodal_friction(matched, self.system.prescribed)
        friction = friction_rows(self.space, rows, matched, rubbing, self._origin)
        system = replace(self.system, contacts=rows, friction=friction)
        guess = self._guess(coarse, matched)
        start = None if self._continued is None else self._continued.state
        solver = self.options.solver
        self._solver = TornSolver(system, solver, self._timer, self._solver, guess, start)
        self._continued = None
        try:
            solution = self._solver.solve(self._monitor)
        except (NotConverged, Interrupted) as error:
            if error.solution is None:
                raise
            error.solution = self._take(error.solution, matched, rubbing)
            error.report = self.report
            raise
        return self._take(solution, matched, rubbing)

    def _solve_exactly(self, coarse: ContactProblem | None) -> Function:
        """Repeat with normals, gaps and partners of the deformed surfaces, sec. 11.1, 11.11.2."""
        self._check_initial_gaps()
        passes = self._passes = list[GeometryPass]()
        if self._continued is not None:
            passes += self._continued.passes
            uh = fill_owned(Function(self.space), self._continued.displacement)
            deformed = self._deformed(self._matched, uh)
            self._moved = _pairings(self._matched, deformed)
        of_other_runs = sum(earlier.seconds for earlier in passes)
        # where the last solution ended is nearer to the present one than the undeformed state
        matched = self._moved or self._matched
        while True:
            uh = self._solve_linearised(matched, None if passes else coarse)
            deformed = self._deformed(matched, uh)
            products = self.report.products["total"]
            seconds = self._timer.slowest(self.space.mesh.comm)
            new_pass = geometry_pass(deformed, self._results, uh, products)
            spent = seconds["total"] + of_other_runs - sum(earlier.seconds for earlier in passes)
            passes.append(replace(new_pass, seconds=spent))
            self.report = replace(self.report, passes=passes, seconds=seconds)
            matched = self._moved = _pairings(matched, deformed)
            if passes[-1].error <= self.options.non_penetration_tolerance:
                return uh
            if len(passes) == self.options.non_penetration_max_it:
                return self._not_exact(uh, passes[-1])
            self._save(uh, passes)

    def _deformed(self, matched: Sequence[ContactPairing], uh: Function) -> list[DeformedContact]:
        with self._timer.phase("deformed surfaces"):
            return [
                deformed_contact(self._boundary, contact, match, uh, _gives_normals(contact))
                for contact, match in zip(self._searched, matched, strict=True)
            ]

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

    def _take(
        self,
        solution: TornSolution,
        matched: Sequence[ContactPairing],
        rubbing: Sequence[NodalFriction | None],
    ) -> Function:
        versions = {**solution.report.versions, "dolfinx": _compat.version()}
        pairing = self._pairing_entries()
        self.report = ContactReport(
            **{
                **vars(solution.report),
                **self._resultants(solution.report),
                "versions": versions,
                "options": {**solution.report.options, **self.options.as_dict()},
            },
            pairing=pairing,
        )
        forces = _split(solution.normal_force, [match.slave.size for match in matched])
        sizes = [0 if one is None else one.bound.size for one in rubbing]
        of_friction = zip(
            _split(solution.tangential_force, sizes),
            _split(solution.slip, sizes),
            _split(solution.sticking, sizes),
            _split(solution.slip_bound, sizes),
            strict=True,
        )
        self._displacement = displacement_function(
            self.space, self.system.subdomains, solution.displacements, self.u
        )
        self._results = [
            # the gap of the undeformed surfaces, with the normal that the force acts along
            _contact_result(
                _with_gap_of(match, first),
                opening,
                force,
                friction_result(one, match, *values),
                self.space.mesh.comm,
            )
            for match, first, opening, force, one, values in zip(
                matched,
                self._matched,
                openings(self.space, matched, owned_values(self._displacement)),
                forces,
                rubbing,
                of_friction,
                strict=True,
            )
        ]
        self.contact = [
            result.seen_from_master() if id(contact) in self._exchanged else result
            for contact, result in zip(self.contacts, self._results, strict=True)
        ]
        self._used = list(matched)
        return self._displacement


def _pairings(
    matched: Sequence[ContactPairing], deformed: Sequence[DeformedContact]
) -> list[ContactPairing]:
    return [new.pairing(match) for match, new in zip(matched, deformed, strict=True)]


def _gives_normals(contact: Contact) -> bool:
    return isinstance(contact, ContactPair) and contact.normal is not None


def _with_gap_of(match: ContactPairing, first: ContactPairing) -> ContactPairing:
    """Return conditions with the gaps of others; infinite at nodes that these do not have."""
    _, here, there = np.intersect1d(match.slave, first.slave, return_indices=True)
    gap = np.full(match.slave.size, np.inf)
    gap[here] = first.gap[there]
    return replace(match, gap=gap)


def _split(values: NDArray[Any], sizes: Sequence[int]) -> list[NDArray[Any]]:
    """Split rows into parts of these sizes."""
    parts: list[NDArray[Any]] = np.split(values, np.cumsum([0, *sizes])[1:])[: len(sizes)]
    return parts


def _contact_result(
    matched: ContactPairing,
    opening: NDArray[np.float64],
    force: NDArray[np.float64],
    friction: FrictionResult | None,
    comm: MPI.Intracomm,
) -> ContactResult:
    return ContactResult(
        matched.name,
        matched.slave,
        matched.coordinates,
        matched.gap,
        opening,
        matched.normal,
        normal_force=force,
        pressure=force / matched.area,
        active=force > 0.0,
        area=matched.area,
        coverage=np.ones_like(force) if matched.coverage is None else matched.coverage,
        friction=friction,
        comm=comm,
    )

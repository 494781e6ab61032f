"""ContactProblem: from the user's forms and tags to displacements and contact forces."""

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
from fenics_tfeti.fem.contact.contact import ContactPairing, ContactResult, FrictionResult
from fenics_tfeti.fem.contact.deformed import (
    DeformedContact,
    GeometryPass,
    deformed_contact,
    geometry_pass,
)
from fenics_tfeti.fem.contact.description import (
    Contact,
    ContactPair,
    TiedPair,
    contact_name,
    tied_name,
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
    nodal_friction,
    obstacle_displacements,
)
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.fem.contact.tied import TiedPairing, tie_pairs, tied_rows
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
        weight, as axisymmetric ones do, it is `measure_weight`.
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
    measure_weight : UFL expression or number, optional
        Factor of ``ds`` in the forms, by which nodal forces become pressures: ``2 * pi * r`` or
        ``r``, with ``r = SpatialCoordinate(mesh)[0]``, in axisymmetric forms, the thickness in
        forms of a thin sheet. By default 1. Mortar conditions integrate with it, linearly
        interpolated between the nodes of a facet. Its values may change between solves.

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
        measure_weight: Any = None,
    ) -> None:
        check_real_numbers()
        self.options = contact_options(options, options_prefix)
        self._timer = Timer()
        a, L = as_forms(a, L)
        self.space = space_of_forms(a, L)
        self.bcs, self.contacts = as_conditions(bcs), as_contacts(contacts)
        self.tied = as_tied_pairs(tied)
        self.u = check_function(u, self.space)
        self._measure_weight = measure_weight
        self._tied: list[tuple[TiedPair, TiedPairing]] = []
        # the user's pairs whose roles were exchanged, by identity, with the exchanged ones
        self._exchanged: dict[int, tuple[Contact, Contact]] = {}
        # pairs whose roles were decided, with the entries of the report
        self._roles: list[tuple[Contact, dict[str, Any]]] = []
        self._oriented: list[Contact] = []  # the contacts, some with exchanged roles
        self._conditions: list[ContactPairing] = []
        self._deformed_conditions: list[ContactPairing] = []
        self._solved_conditions: list[ContactPairing] = []
        self._friction: list[NodalFriction | None] = []  # at `_conditions`
        self._solver: TornSolver | None = None
        self._displacement: Function | None = None
        self._monitor: MonitorFunction | None = None
        self._checkpoint: str | os.PathLike[str] | None = None
        self._restored: Continuation | None = None
        self._warned_of_gradients = False
        self._solves = 0
        self._passes = list[GeometryPass]()
        self._origin = SlipOrigin.undeformed(self.space, len(self.contacts))
        prescribed = prescribed_values(self.space, self.bcs)
        with self._timer.phase("partition"):
            self._bodies = find_bodies(self.space.mesh, cell_tags)
            check_mesh(self.space.mesh, self._bodies, self.contacts)
        with self._timer.phase("contact search"):
            self._boundary = MeshBoundary.of(self.space, self._measure_weight)
        self._find_conditions(prescribed)
        with self._timer.phase("compilation"):
            self._forms = prepare_forms(self.space, a, L)
        with self._timer.phase("partition"):
            self._cells = self._split_cells(subdomains)
            self._parts = self._numbered_parts()
        self._x = self.space.mesh.geometry.x.copy()
        self._values = self._forms.values()
        with self._timer.phase("assembly"):
            warn_of_locking(self._forms, self._bodies)
        torn = self._assemble()
        self._choose_roles(torn, prescribed)
        self.system = self._torn_system(torn, prescribed)
        self._stale = self._has_solved = False

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
                displacements = obstacle_displacements(self.space, self._conditions, self._friction)
                self._origin = SlipOrigin(owned_values(uh), displacements)
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
        if self._has_solved:
            raise InputError("a checkpoint is for a problem that was not solved yet")
        nodes = OwnedNodes.from_space(self.space, self._input_numbers)
        saved = read_continuation(checkpoint, self.system, nodes, len(self.contacts))
        self._restored, self._solves = saved, saved.solves
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
        if self._has_solved:
            self._timer = Timer()
        self._has_solved = True
        if coarse is not None:
            self._check_coarse(coarse)
        # also at first: values may have changed since the problem was set up
        self._refresh()
        if self.options.non_penetration == "linearised":
            return self._solve_linearised(self._conditions, coarse)
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
        self, coarse: ContactProblem | None, conditions: Sequence[ContactPairing]
    ) -> ContactGuess | None:
        if coarse is None or coarse._displacement is None:
            return self._restored_guess(conditions)
        with self._timer.phase("coarse contact"):
            solved = gather_solved(
                coarse._boundary,
                coarse._oriented,
                coarse._solved_conditions,
                coarse.contact,
                coarse._displacement,
            )
            return expected_contact(solved, conditions)

    def _restored_guess(self, conditions: Sequence[ContactPairing]) -> ContactGuess | None:
        """Return the contact forces of a checkpoint whose multipliers are those of other ranks."""
        saved = self._restored
        if saved is None or saved.state is not None or self.options.solver.method != "active_set":
            return None
        return saved.guess(conditions, self.space.dofmap.index_map.local_range[0])

    def _find_conditions(self, prescribed: Prescribed) -> None:
        with self._timer.phase("contact search"):
            contacts = [self._exchanged.get(id(c), (c, c))[1] for c in self.contacts]
            earlier = list(zip(self._oriented, self._conditions, strict=True))
            if [id(c) for c in self._oriented] != [id(c) for c in contacts]:
                self._deformed_conditions = []
            conditions = match_contacts(self._boundary, contacts, earlier, prescribed)
            check_depth(self.space, self._bodies, conditions)
            self._oriented, self._conditions = contacts, conditions
            self._friction = self._nodal_friction(self._conditions, prescribed)
            self._tied = tie_pairs(self._boundary, self.tied, self._tied, prescribed)

    def _nodal_friction(
        self, conditions: Sequence[ContactPairing], prescribed: Prescribed
    ) -> list[NodalFriction | None]:
        return [
            nodal_friction(self.space, contact, pairing, prescribed)
            for contact, pairing in zip(self._oriented, conditions, strict=True)
        ]

    def _choose_roles(self, torn: Sequence[Subdomain], prescribed: Prescribed) -> None:
        """Exchange slave and master of new pairs where that is better and wanted, or warn."""
        comm = self.space.mesh.comm
        decided = {id(contact) for contact, _ in self._roles}
        for number, contact in enumerate(self.contacts):
            if id(contact) in decided or not isinstance(contact, ContactPair):
                continue
            pairing, error = self._conditions[number], None
            ratio = roles_ratio(comm, pairing, torn)
            exchanges = prefers_exchange(contact, ratio)
            if exchanges:
                error = self._exchange_roles(contact, prescribed)
                exchanges = error is None
            roles = describe_roles(contact, ratio, exchanges, error)
            if ratio is not None and exchanges:
                ratio = 1.0 / ratio
            self._roles.append((contact, {"roles_ratio": ratio, "roles": roles}))
            with raise_collectively(comm):
                if ratio is not None and comm.rank == 0:
                    warn_of_roles(pairing.name, ratio)
        with raise_collectively(comm):
            for contact, pairing in zip(self.contacts, self._conditions, strict=True):
                if comm.rank == 0 and id(contact) not in decided:
                    warn_of_deviation(pairing.summary)

    def _exchange_roles(self, contact: ContactPair, prescribed: Prescribed) -> str | None:
        """Exchange the roles of a pair; return the error, if any, with which they are as given."""
        self._exchanged[id(contact)] = (contact, exchanged(contact))
        try:
            self._find_conditions(prescribed)
        except InputError as error:
            # surfaces that can be masters only, such as folded ones, or masters of other pairs
            del self._exchanged[id(contact)]
            self._find_conditions(prescribed)
            return str(error)
        return None

    def _pairing_entries(self) -> list[dict[str, Any]]:
        nothing = {"roles_ratio": None, "roles": None}
        decided = {id(contact): roles for contact, roles in self._roles}
        entries = [
            {**pairing.summary, **decided.get(id(contact), nothing)}
            for contact, pairing in zip(self.contacts, self._conditions, strict=True)
        ]
        return entries + [pairing.summary for _, pairing in self._tied]

    def _resultants(self, report: Report) -> dict[str, list[Any]]:
        """Return the forces and moments on slaves and masters as the user gave them."""
        sides = [report.on_slaves.copy(), report.on_masters.copy()]
        for number, contact in enumerate(self.contacts):
            if id(contact) in self._exchanged:
                for side, opposite in zip(
                    sides, (report.on_masters, report.on_slaves), strict=True
                ):
                    side[number] = opposite[number]
        forces = [side.force for side in sides[0]]
        return {"on_slaves": sides[0], "on_masters": sides[1], "contact_forces": forces}

    def _assemble(self, known: Sequence[Subdomain] | None = None) -> list[Subdomain]:
        """Assemble the subdomains, or only the loads of known ones."""
        with self._timer.phase("assembly"):
            return self._forms.subdomains(self._parts, known, self._boundary.coordinates)

    def _torn_system(self, torn: Sequence[Subdomain], prescribed: Prescribed) -> TornSystem:
        gdim = self.space.mesh.geometry.dim
        rows = contact_rows(self._conditions, gdim)
        ties = [tie for _, tie in self._tied]
        return TornSystem(
            torn,
            prescribed,
            rows,
            gdim,
            self._bodies.names,
            [*(pairing.name for pairing in self._conditions), *(tie.name for tie in ties)],
            self.space.mesh.comm,
            [f"Dirichlet condition {i}" for i in range(len(self.bcs))],
            tied_rows(ties, gdim, len(self._conditions)),
            friction_rows(self.space, rows, self._conditions, self._friction, self._origin),
        )

    def _refresh(self) -> None:
        """Update the system by all that changed since the last solve or the set-up."""
        with raise_collectively(self.space.mesh.comm):
            self.bcs, self.contacts = as_conditions(self.bcs), as_contacts(self.contacts)
            self.tied = as_tied_pairs(self.tied)
        self._origin = self._origin.resized(len(self.contacts))
        is_moved = self._refresh_geometry()
        prescribed = prescribed_values(self.space, self.bcs)
        self._find_conditions(prescribed)
        old, new = self._values, self._forms.values()
        comm = self.space.mesh.comm
        if is_moved or self._stale or not same_values(old.bilinear, new.bilinear, comm):
            self._release()
            torn = self._assemble()
        elif not same_values(old.linear, new.linear, comm):
            torn = self._assemble(self.system.subdomains)
        else:
            torn = list(self.system.subdomains)
        self._values, self._stale = new, False
        self._choose_roles(torn, prescribed)
        self.system = self._torn_system(torn, prescribed)

    def _release(self) -> None:
        """Free the last stiffness matrices and factors, before others take their place."""
        self._stale = True
        self.system = replace(self.system, subdomains=[])
        if self._solver is not None:
            self._solver.release()

    def _split_cells(self, labels: Sequence[int] | None) -> list[NDArray[np.int32]]:
        if labels is not None:
            return as_subdomains(self.space.mesh, self._bodies, labels)
        size, partitioner = self.options.subdomain_size, self.options.partitioner
        return split_into_subdomains(self.space, self._bodies, size, partitioner)

    def _numbered_parts(self) -> list[Part]:
        bodies = [self._bodies.of_cell[cells[0]] for cells in self._cells]
        return number_parts(self.space, self._cells, bodies, self._boundary.coordinates)

    def _refresh_geometry(self) -> bool:
        """Set the geometry up anew if nodes were moved since the last solve; tell whether."""
        domain = self.space.mesh
        if same_values([self._x], [domain.geometry.x], domain.comm):
            return False
        self._stale = True
        check_mesh(domain, self._bodies, self.contacts)
        with self._timer.phase("contact search"):
            self._boundary = MeshBoundary.of(self.space, self._measure_weight)
        self._oriented, self._conditions, self._deformed_conditions, self._tied = [], [], [], []
        self.reset_slip()
        with self._timer.phase("partition"):
            self._parts = self._numbered_parts()
        # last: after an error above, the nodes count as moved in the next solve too
        self._x = domain.geometry.x.copy()
        return True

    def _solve_linearised(
        self, conditions: Sequence[ContactPairing], coarse: ContactProblem | None = None
    ) -> Function:
        rows = contact_rows(conditions, self.system.gdim)
        friction = self._friction
        if conditions is not self._conditions:
            friction = self._nodal_friction(conditions, self.system.prescribed)
        rows_of_friction = friction_rows(self.space, rows, conditions, friction, self._origin)
        system = replace(self.system, contacts=rows, friction=rows_of_friction)
        guess = self._guess(coarse, conditions)
        start = None if self._restored is None else self._restored.state
        solver = self.options.solver
        self._solver = TornSolver(system, solver, self._timer, self._solver, guess, start)
        self._restored = None
        try:
            solution = self._solver.solve(self._monitor)
        except (NotConverged, Interrupted) as error:
            if error.solution is None:
                raise
            error.solution = self._store_results(error.solution, conditions, friction)
            error.report = self.report
            raise
        return self._store_results(solution, conditions, friction)

    def _solve_exactly(self, coarse: ContactProblem | None) -> Function:
        """Repeat with normals, gaps and partners of the deformed surfaces, sec. 11.1, 11.11.2."""
        self._check_initial_gaps()
        passes = self._passes = list[GeometryPass]()
        if self._restored is not None:
            passes += self._restored.passes
            uh = fill_owned(Function(self.space), self._restored.displacement)
            deformed = self._deformed_contacts(self._conditions, uh)
            self._deformed_conditions = _pairings(self._conditions, deformed)
        earlier_seconds = sum(earlier.seconds for earlier in passes)
        # where the last solution ended is nearer to the present one than the undeformed state
        conditions = self._deformed_conditions or self._conditions
        while True:
            uh = self._solve_linearised(conditions, None if passes else coarse)
            deformed = self._deformed_contacts(conditions, uh)
            products = self.report.products["total"]
            seconds = self._timer.slowest(self.space.mesh.comm)
            new_pass = geometry_pass(deformed, self._results, uh, products)
            spent = seconds["total"] + earlier_seconds - sum(earlier.seconds for earlier in passes)
            passes.append(replace(new_pass, seconds=spent))
            self.report = replace(self.report, passes=passes, seconds=seconds)
            conditions = self._deformed_conditions = _pairings(conditions, deformed)
            if passes[-1].error <= self.options.non_penetration_tolerance:
                return uh
            if len(passes) == self.options.non_penetration_max_it:
                return self._not_exact(uh, passes[-1])
            self._save(uh, passes)

    def _deformed_contacts(
        self, conditions: Sequence[ContactPairing], uh: Function
    ) -> list[DeformedContact]:
        with self._timer.phase("deformed surfaces"):
            return [
                deformed_contact(self._boundary, contact, pairing, uh, _gives_normals(contact))
                for contact, pairing in zip(self._oriented, conditions, strict=True)
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

    def _store_results(
        self,
        solution: TornSolution,
        conditions: Sequence[ContactPairing],
        friction: Sequence[NodalFriction | None],
    ) -> Function:
        versions = {**solution.report.versions, "dolfinx": _compat.version()}
        entries = self._pairing_entries()
        self.report = ContactReport(
            **{
                **vars(solution.report),
                **self._resultants(solution.report),
                "versions": versions,
                "options": {**solution.report.options, **self.options.as_dict()},
            },
            pairing=entries,
        )
        forces = _split(solution.normal_force, [pairing.slave.size for pairing in conditions])
        sizes = [0 if nodal is None else nodal.bound.size for nodal in friction]
        friction_values = zip(
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
                _with_gaps(pairing, undeformed),
                opening,
                force,
                friction_result(nodal, pairing, *values),
                self.space.mesh.comm,
            )
            for pairing, undeformed, opening, force, nodal, values in zip(
                conditions,
                self._conditions,
                openings(self.space, conditions, owned_values(self._displacement)),
                forces,
                friction,
                friction_values,
                strict=True,
            )
        ]
        self.contact = [
            result.seen_from_master() if id(contact) in self._exchanged else result
            for contact, result in zip(self.contacts, self._results, strict=True)
        ]
        self._solved_conditions = list(conditions)
        return self._displacement


def _pairings(
    conditions: Sequence[ContactPairing], deformed: Sequence[DeformedContact]
) -> list[ContactPairing]:
    return [contact.pairing(pairing) for pairing, contact in zip(conditions, deformed, strict=True)]


def _gives_normals(contact: Contact) -> bool:
    return isinstance(contact, ContactPair) and contact.normal is not None


def _with_gaps(pairing: ContactPairing, undeformed: ContactPairing) -> ContactPairing:
    """Return conditions with the gaps of others; infinite at nodes that these do not have."""
    _, rows, rows_of_gaps = np.intersect1d(pairing.slave, undeformed.slave, return_indices=True)
    gap = np.full(pairing.slave.size, np.inf)
    gap[rows] = undeformed.gap[rows_of_gaps]
    return replace(pairing, gap=gap)


def _split(values: NDArray[Any], sizes: Sequence[int]) -> list[NDArray[Any]]:
    """Split rows into parts of these sizes."""
    pieces: list[NDArray[Any]] = np.split(values, np.cumsum([0, *sizes])[1:])[: len(sizes)]
    return pieces


def _contact_result(
    pairing: ContactPairing,
    opening: NDArray[np.float64],
    force: NDArray[np.float64],
    friction: FrictionResult | None,
    comm: MPI.Intracomm,
) -> ContactResult:
    return ContactResult(
        pairing.name,
        pairing.slave,
        pairing.coordinates,
        pairing.gap,
        opening,
        pairing.normal,
        normal_force=force,
        pressure=force / pairing.area,
        active=force > 0.0,
        area=pairing.area,
        coverage=np.ones_like(force) if pairing.coverage is None else pairing.coverage,
        friction=friction,
        comm=comm,
    )

"""ContactProblem: from the user's forms and tags to displacements and contact forces."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np

import ufl
from dolfinx.fem import Constant, Function

from fenics_tfeti.errors import InputError, Interrupted, NotConverged
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.conditions.friction import SlipOrigin
from fenics_tfeti.fem.contact.contact_set import ContactSet
from fenics_tfeti.fem.contact.descriptions.arguments import as_forms, as_gaps, check_hard_or_soft
from fenics_tfeti.fem.contact.descriptions.contacts import Contact, Deformed
from fenics_tfeti.fem.contact.descriptions.laws import (
    Adhesive,
    ElasticBond,
    RoughContact,
    SoftContact,
)
from fenics_tfeti.fem.contact.descriptions.rigid_body import RigidBody
from fenics_tfeti.fem.contact.descriptions.surfaces import contact_name
from fenics_tfeti.fem.contact.descriptions.ties import Tie
from fenics_tfeti.fem.contact.solution.adhesion import solve_adhesive
from fenics_tfeti.fem.contact.solution.bonded import BondedContacts
from fenics_tfeti.fem.contact.solution.damage import damaged
from fenics_tfeti.fem.contact.solution.geometry_pass import GeometryPass, geometry_pass
from fenics_tfeti.fem.contact.solution.rough import solve_rough
from fenics_tfeti.fem.contact.solution.solved import SolvedContacts
from fenics_tfeti.fem.contact.solution.transfer import SolvedContact, expected_contact
from fenics_tfeti.fem.displacement import fill_displacement, fill_owned, owned_values
from fenics_tfeti.fem.gradients import CellStrains, large_gradients
from fenics_tfeti.fem.mesh_error.estimate import MeshError, estimate_mesh_error
from fenics_tfeti.fem.mesh_error.problem import MeshErrorProblem
from fenics_tfeti.feti import (
    ContactGuess,
    MonitorFunction,
    Options,
    TornSolution,
    TornSolver,
    interruption,
)
from fenics_tfeti.feti.factors.cholesky import check_real_numbers
from fenics_tfeti.findings import large_rotations
from fenics_tfeti.load_steps import SteppedProblem
from fenics_tfeti.newton.equilibrium import DeformedRows, Multipliers, misfit_of_forces
from fenics_tfeti.newton.rounding import Rounding
from fenics_tfeti.options import ContactOptions, contact_options
from fenics_tfeti.parallel import meet, raise_collectively
from fenics_tfeti.report import ContactReport, DamageEntry, DamageStep
from fenics_tfeti.sensitivities.adjoint import Adjoint, Functional, form_and_forces
from fenics_tfeti.sensitivities.deformed import DeformedAdjoint, DeformedState, DeformedTangent
from fenics_tfeti.sensitivities.forms import CHANGED, FormsAtSolution, check_functional
from fenics_tfeti.sensitivities.state import SolvedState
from fenics_tfeti.sensitivities.tangent import Change, Tangent
from fenics_tfeti.typing import Array, Vector

# tolerance of passes on the damage of bonds, relative to the misfit of their tractions, and the
# loosest one
_BESIDE_MISFIT, _LOOSEST = 0.01, 1e-3


class ContactProblem(SteppedProblem[ContactReport]):
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
    contacts : sequence of contacts and ties, one of them, "auto" or None
        What may touch: ContactPair, RigidObstacle; and what stays together: TiedPair, PeriodicPair,
        BoltPreload, LinearRows. "auto" is `find_contacts` of the mesh and `cell_tags`, with whole
        faces if there are `gaps`: ``contacts`` of the problem has the pairs.
    cell_tags : MeshTags, optional
        A tag for every cell, where bodies are to be told apart by tags: each tag is one body, its
        cells connected through facets. Bodies that share facets are glued there. By default the
        bodies are the connected parts of the mesh, which tells bodies apart that have nodes of
        their own. Tags of materials, which may be in several places, belong into ``dx`` alone.
    subdomains : sequence of int, optional
        A label for each cell that this rank owns: cells with the same label make a subdomain. By
        default each rank splits its cells into blocks or by a graph partitioner, see the option
        ``partitioner``.
    gaps : Deformed, optional
        Whether the normals and gaps of contacts are those of the undeformed surfaces, which is for
        displacements along them that are small beside the facets, or are corrected until the
        deformed surfaces touch.
    options : mapping, optional
        Names and values, see `fenics_tfeti.options.ContactOptions` and
        `fenics_tfeti.feti.Options`.
    options_prefix : str
        ``-<prefix><name> value`` on the command line, or in PETSc's database, overrides `options`.
        Problems of one script that are to differ need different prefixes.
    u : Function, optional
        The function on the displacement's space that each solve fills and returns; by default one
        is made.
    measure_weight : UFL expression or number, optional
        Factor of ``ds`` in the forms, by which nodal forces become pressures: ``2 * pi * r`` or
        ``r``, with ``r = SpatialCoordinate(mesh)[0]``, in axisymmetric forms, the thickness in
        forms of a thin sheet. By default 1. Mortar conditions integrate with it, linearly
        interpolated between the nodes of a facet. Its values may change between solves. With
        `gaps` and finite strains x in it is the deformed place; functions move with the nodes.
    rigid_bodies : mapping of int to RigidBody, optional
        Rigid bodies by the tags of their cells in `cell_tags`. Their stiffness is not assembled,
        and their surfaces are masters of contact pairs and ties; `L` acts on them.
    form_compiler_options, jit_options : mapping, optional
        Options of FFCx and of the just-in-time compiler for `a` and `L`, see `dolfinx.jit`.

    Attributes
    ----------
    u : Function
        The displacement [m], filled by each solve.
    results : Results
        For each contact, by number or name, a `ContactResult`: the nodes with gaps, normals, forces
        and pressures, with friction its forces and slips, and their sums; of tied pairs a
        `TiedResult`. Empty before the first solve.
    rigid_bodies : Results
        For each rigid body, by number or name, a `RigidBodyResult`: its motion and the forces on
        it. Bodies are numbered in the order of `rigid_bodies`, then of the obstacles.
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

    _kind = "ContactProblem"
    _report_type = ContactReport
    _state = (*SteppedProblem._state, "_deformed")

    def __init__(
        self,
        a: ufl.Form,
        L: ufl.Form | float,
        *,
        bcs: Sequence[Any] | Any | None = (),
        contacts: Sequence[Contact | Tie] | Contact | Tie | Literal["auto"] | None = (),
        cell_tags: Any | None = None,
        u: Function | None = None,
        subdomains: Sequence[int] | None = None,
        options: Mapping[str, Any] | None = None,
        options_prefix: str = "tfeti_",
        gaps: Deformed | None = None,
        measure_weight: Any = None,
        rigid_bodies: Mapping[int, RigidBody] | None = None,
        form_compiler_options: Mapping[str, Any] | None = None,
        jit_options: Mapping[str, Any] | None = None,
    ) -> None:
        check_real_numbers()
        _return_free_memory()
        self.gaps = as_gaps(gaps)
        super().__init__(
            *as_forms(a, L),
            u,
            contact_options(ContactOptions, options, options_prefix),
            bcs=bcs,
            contacts=contacts,
            cell_tags=cell_tags,
            rigid_bodies=rigid_bodies,
            subdomains=subdomains,
            measure_weight=measure_weight,
            compiler=_compat.CompilerOptions(form_compiler_options, jit_options),
            displacement=None,
        )
        self.system = self._torn.system(self._accepted.origin)
        _return_free_memory()
        self._deformed: ContactSet | None = None  # after the last pass
        # of the last solve with gaps whose derivatives were taken
        self._derivative: tuple[Any, DeformedState] | None = None

    def solve(
        self,
        *,
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

        A repeated solve gives the same answer. With friction slip is counted from the last step
        that `advance` has accepted; moved nodes make the undeformed state the origin again.

        Parameters
        ----------
        coarse : ContactProblem, optional
            The same problem on a coarser mesh (any mesh will do), solved: its contact, pressures
            and gaps transferred to this mesh, is where the iterations start. With elements twice
            as large it leaves hardly more of them than a problem whose contact is known. That pays
            where the coarse problem is solved anyway, or is much smaller. The contacts have to have
            the same kinds and names or, without names, tags. The surfaces of the coarse mesh are
            gathered on all ranks.
        monitor : callable, optional
            Called on all ranks with an `ActiveSetStep` for each face of the active set method and
            an `OuterIteration` for each outer iteration of SMALBE-M, when they end. The option
            ``monitor`` prints them.
        checkpoint : path-like, optional
            File to write or replace at the end of the solve and of each pass with exact
            non-penetration, and after an interruption: `restore` goes on with this solve. `save`
            is for steps that were accepted.

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
            `results` and `report` are that one's. With the option ``error_if_not_converged`` false,
            it is returned.
        Interrupted
            After Ctrl-C or SIGINT to one rank, on all of them; its ``solution`` is the last iterate
            if there is one, `results` and `report` are that one's. Solving again goes on from it.
        OSError
            If the checkpoint cannot be written; an old one is left as it is.
        """
        with interruption.deferred():
            try:
                with self._looking_over():
                    uh = self._solve(coarse, monitor, checkpoint)
                    if self.gaps is not None:
                        self._solve_where_surfaces_met(
                            lambda: self._solve(None, monitor, checkpoint)
                        )
            except Interrupted as error:
                if error.solution is not None:
                    self._save(checkpoint)
                raise
            finally:
                self._timer.restart()
            self._is_solved = self.report.converged
            if self._is_solved:
                self._accepted = replace(self._accepted, passes=())
                self._save(checkpoint)
            try:
                interruption.check(self.space.mesh.comm)
            except Interrupted:
                raise Interrupted("interrupted", uh, self.report) from None
        self._view()
        return uh

    def mesh_error(self, bound: bool = False) -> MeshError:
        """Estimate the error of the mesh of the last solve, in the energy norm. Collective.

        It is the distance to the solution on an infinitely fine mesh, without the error of facets
        against the true surfaces. Estimates are usually between 0.8 and 1.6 times the error, less
        for curved surfaces in contact with degree 2. The report of the solve has them afterwards.

        Parameters
        ----------
        bound : bool
            Whether to look for a bound in place of the estimate, for triangles and tetrahedra of
            degree 1. It is one where `MeshError.guaranteed`; else `MeshError.reasons` tell what is
            against it.

        Raises
        ------
        InputError
            If nothing was solved, or forces act on nodes whose facets are neither supported nor of
            a contact or tie: supports and loads at points.

        Examples
        --------
        >>> estimate = problem.mesh_error()  # doctest: +SKIP
        >>> print(estimate.error, estimate.bodies["lug"].error)  # doctest: +SKIP
        """
        comm = self.space.mesh.comm
        if self._solved is None or self._solution is None:
            raise InputError("mesh_error() is of a solution; call solve() first")
        check_hard_or_soft(self.contacts, "mesh_error() is")
        meet(comm, "mesh_error()")
        with self._timer.phase("mesh error"):
            cells = MeshErrorProblem(
                self._torn,
                self._solved,
                self._solution.torn_displacements,
                self.gaps is not None,
            )
            estimate = estimate_mesh_error(cells, self.report.certificate.error, bound)
        self._report = replace(self.report, mesh_error=estimate.entry)
        return estimate

    def adjoint(
        self,
        J: ufl.Form | Function | Mapping[str | int, Any] | None = None,
        *,
        forces: Mapping[str | int, Any] | None = None,
        normal_forces: Mapping[str | int, Any] | None = None,
        rtol: float | None = None,
    ) -> Adjoint | DeformedAdjoint:
        """Return the derivatives of a functional of the solution by the data. Collective.

        The functional is J plus the weighted forces. It costs one linear solve, with the factors of
        the solve, whatever the number of parameters; with Coulomb's law a few.

        Parameters
        ----------
        J : ufl.Form, Function, or mapping as `forces`, optional
            Functional of `u`, of rank 0; as a Function on the space of `u` its derivatives by the
            values of `u`, such as 1 where the displacement of a node is J.
        forces : mapping, optional
            By name or number of the contact a direction (gdim,), or a vector for each of the nodes
            of ``results[name]``, (k, gdim): weights of the forces on the slave.
        normal_forces : mapping, optional
            By contact a weight, or one (k,) for each of the nodes: of their normal forces.
        rtol : float, optional
            Tolerance of the linear solve, by default that of the problem.

        Returns
        -------
        Adjoint, or DeformedAdjoint with `gaps`
            Its methods give the derivatives.

        Raises
        ------
        InputError
            The problem is not solved, or has changed since; J is not a functional; with `gaps`, a
            rigid body or a bolt has motions.
        UnresistedMotion
            J changes by a motion that nothing resists.
        NotConverged
            The tolerance was not reached.

        Examples
        --------
        >>> adjoint = problem.adjoint(ufl.dot(problem.u, problem.u) * ds(4))  # doctest: +SKIP
        >>> adjoint.by(E), adjoint.by_gap("joint")  # doctest: +SKIP
        >>> problem.adjoint(forces={"joint": (0.0, 1.0)}).by(traction)  # doctest: +SKIP
        """
        J, forces = form_and_forces(J, forces)
        state = self._state_for_derivatives(J)
        functional = Functional.of(state.forms, state.contact_set, forces, normal_forces or {})
        rtol = self.options.solver.rtol if rtol is None else rtol
        if isinstance(state, DeformedState):
            return DeformedAdjoint(state, functional, rtol)
        return Adjoint(state, functional, rtol)

    def tangent(
        self,
        data: Mapping[Function | Constant, Any] | None = None,
        *,
        gaps: Mapping[str | int, Any] | None = None,
        slip_bounds: Mapping[str | int, Any] | None = None,
        coefficients: Mapping[str | int, Any] | None = None,
        one_sided: bool = False,
        rtol: float | None = None,
    ) -> Tangent | DeformedTangent:
        """Return what the solution changes by along changes of the data. Collective.

        Parameters
        ----------
        data : mapping, optional
            Of Functions and Constants of the forms and Dirichlet conditions to changes of their
            values: a Function or array, or for Constants numbers.
        gaps, slip_bounds, coefficients : mapping, optional
            By contact a change, or one (k,) for each of the nodes of ``results[name]``, of the gap
            [m], of the slip bound [Pa], of Coulomb's coefficient.
        one_sided : bool
            Whether nodes that touch without a force press or open as the change asks for; by
            default they open. It costs a linear solve for each of them.
        rtol : float, optional
            Tolerance of the linear solves, by default that of the problem.

        Returns
        -------
        Tangent, or DeformedTangent with `gaps`
            The change of the displacement and of the forces.

        Raises
        ------
        InputError, UnresistedMotion, NotConverged
            As `adjoint`.

        Examples
        --------
        >>> tangent = problem.tangent({E: dE}, gaps={"joint": 1e-6})  # doctest: +SKIP
        >>> tangent.u, tangent.nodal_normal_force("joint")  # doctest: +SKIP
        """
        state = self._state_for_derivatives(None)
        change = Change.of(state, data or {}, gaps or {}, slip_bounds or {}, coefficients or {})
        rtol = self.options.solver.rtol if rtol is None else rtol
        if not isinstance(state, DeformedState):
            return Tangent(state, change, one_sided, rtol)
        if one_sided:
            raise InputError(
                "one_sided with gaps=Deformed(): derivatives of one side are those of undeformed "
                "surfaces. Leave one_sided out, or change the data a little"
            )
        return DeformedTangent(state, change, rtol)

    def _state_for_derivatives(self, J: ufl.Form | Function | None) -> SolvedState | DeformedState:
        """Return the solved problem for its derivatives, after checking that it is one."""
        with raise_collectively(self.space.mesh.comm):
            self._check_laws()
            if self._solved is None or self._solution is None or not self.report.converged:
                raise InputError("there is nothing to differentiate: call solve(), and let it end")
            if not self._is_solved:
                raise InputError(
                    "the step was accepted by advance(): take derivatives before it. How later "
                    "steps depend on this one, by its slips, is not differentiated"
                )
            check_functional(J, self.u)
        solved, solver = self._solved, self._solver
        assert solver is not None

        def is_current() -> bool:
            return self._solved is solved and self._is_current()

        if not is_current():
            raise InputError(CHANGED)
        prepared = self._torn.torn.forms
        forms = FormsAtSolution(prepared.bilinear.form, prepared.linear.form, J, self.u)
        linear = solver.linear_problem()
        last = SolvedState(
            self._torn, forms, is_current, solved, self._solution, linear, self._accepted.origin
        )
        if self.gaps is None:
            return last
        assert self._deformed is not None
        if self._derivative is None or self._derivative[0] is not solved:
            self._derivative = solved, DeformedState.with_exact_gaps(last, self._deformed)
        return replace(self._derivative[1], forms=forms)

    def _is_current(self) -> bool:
        """Tell whether the problem is as it was solved. Collective."""
        return self._is_solved and self._torn.is_as_found(self.bcs, list(self.contacts))

    def _check_laws(self) -> None:
        """Check that derivatives know the laws of interfaces."""
        for number, contact in enumerate(self.contacts):
            law = getattr(contact, "law", None)
            ends = isinstance(law, Adhesive) and law.energy is not None
            if ends or not isinstance(
                law, SoftContact | RoughContact | Adhesive | ElasticBond | None
            ):
                what = type(law).__name__ + (" with an energy" if ends else "")
                raise InputError(
                    f"{contact_name(contact, number)}: derivatives know no law {what}. Leave it "
                    "out, or difference solves"
                )

    # -- the present data --------------------------------------------------------------------------

    @property
    def _exact(self) -> str:
        return "" if self.gaps is None else "gaps=Deformed()"

    def _first_origin(self) -> SlipOrigin:
        return SlipOrigin.at(Function(self.space))

    def _update(self) -> None:
        if self._torn.torn.has_moved():
            self._deformed = None
        self._torn.update(self.bcs, self.contacts, self._release)
        self.system = self._torn.system(self._accepted.origin)

    def _release(self) -> None:
        """Free the last stiffness matrices and factors, before others take their place."""
        self.system = replace(self.system, subdomains=[])
        if self._solver is not None:
            self._solver.release()

    # -- solutions ---------------------------------------------------------------------------------

    def _large_motions(self, strains: CellStrains) -> list[str]:
        of_mesh, certified = self._torn.bodies, self.report.certificate.bodies
        energy = [body.energy_norm**2 for body in certified[: of_mesh.deformable]]
        energy += [0.0] * (len(of_mesh.names) - of_mesh.deformable)
        bodies = self.rigid_bodies if self.gaps is None else ()
        comm, weak = self.space.mesh.comm, self.report.weak_motions
        return [*large_rotations(bodies), *large_gradients(comm, strains, of_mesh, energy, weak)]

    def _solve(
        self,
        coarse: ContactProblem | None,
        monitor: MonitorFunction | None,
        checkpoint: str | os.PathLike[str] | None,
    ) -> Function:
        # derivatives are those of a solution: the memory of the last one is for this solve
        self._is_solved, self._solution = False, None
        # also at first: values may have changed since the problem was set up
        self._refresh()
        solved = None if coarse is None else self._solved_on(coarse)
        if self.gaps is None:
            contact_set = self._torn.undeformed
            bonded = BondedContacts.of(contact_set, self._accepted.damage)
            if bonded is not None:
                return self._solve_bonded(bonded, solved, monitor)
            if contact_set.adhesive:
                return self._solve_adhesive(contact_set, solved, monitor)
            if contact_set.rough:
                return self._solve_rough(contact_set, solved, monitor)
            self._solve_linearised(contact_set, solved, monitor)
            return self.u
        return self._solve_exactly(self.gaps, solved, monitor, checkpoint)

    def _passes(
        self, coarse: list[SolvedContact] | None, monitor: MonitorFunction | None
    ) -> tuple[Callable[..., SolvedContacts], list[ContactReport]]:
        """Return what solves with conditions, and options, and the reports of its solves.

        Only the first one starts from a coarse solution.
        """
        reports = list[ContactReport]()

        def solve(contact_set: ContactSet, options: Options | None = None) -> SolvedContacts:
            start = None if reports else coarse
            self._solve_linearised(contact_set, start, monitor, options)
            reports.append(self.report)
            assert self._solved is not None
            return self._solved

        return solve, reports

    def _solve_rough(
        self,
        contact_set: ContactSet,
        coarse: list[SolvedContact] | None,
        monitor: MonitorFunction | None,
    ) -> Function:
        """Solve with the laws of rough contacts; an error leaves all as it was."""
        solve, reports = self._passes(coarse, monitor)
        with self._as_before_errors():
            solve_rough(contact_set, contact_set.at_conditions(self._accepted.force), solve)
        products = tuple(report.products["total"] for report in reports)
        self._report = replace(self.report, rough_products=products)
        return self.u

    def _solve_adhesive(
        self,
        contact_set: ContactSet,
        coarse: list[SolvedContact] | None,
        monitor: MonitorFunction | None,
    ) -> Function:
        """Solve with adhesion that ends; an error leaves all as it was."""
        solve, reports = self._passes(coarse, monitor)
        before = None if self._accepted.number == 0 else self._accepted.damage
        with self._as_before_errors():
            dissipated, failed = solve_adhesive(contact_set, before, solve)
        products = sum(report.products["total"] for report in reports)
        entry = DamageEntry(dissipated, failed, [], 0, len(reports), products)
        self._report = replace(self.report, damage=entry)
        return self.u

    def _solve_bonded(
        self,
        bonded: BondedContacts,
        coarse: list[SolvedContact] | None,
        monitor: MonitorFunction | None,
    ) -> Function:
        """Walk to the present loads with the damage of bonds; an error leaves all as it was."""
        solve_pass, reports = self._passes(coarse, monitor)

        def solve(damage: Vector, misfit: float) -> Array:
            options = self.options.solver
            rtol = max(options.rtol, min(_LOOSEST, _BESIDE_MISFIT * misfit))
            passed = solve_pass(bonded.with_damage(damage), replace(options, rtol=rtol))
            return bonded.jumps(passed)

        dimension = self.space.mesh.topology.dim - 1
        with self._as_before_errors():
            found = damaged(bonded.bonds, solve, bonded.before, self.options.damage_rtol, dimension)
        path = [
            DamageStep(
                point.factor,
                point.dissipated,
                [
                    (point.factor * np.array(r.force)).tolist()
                    for r in reports[point.number].reactions
                ],
            )
            for point in found.path
        ]
        entry = DamageEntry(
            bonded.by_contact(found.dissipated),
            bonded.failed(found.damage),
            path,
            sum(after.factor < before.factor for before, after in pairwise(path)),
            found.passes,
            sum(report.products["total"] for report in reports),
        )
        self._report = replace(self.report, damage=entry)
        return self.u

    def _check_coarse(self, coarse: Any) -> None:
        if (method := self.options.solver.method) != "active_set":
            raise InputError(
                f"a coarse problem is a start for method='active_set'; with {method!r} leave it out"
            )
        super()._check_coarse(coarse)

    def _solve_linearised(
        self,
        contact_set: ContactSet,
        coarse: list[SolvedContact] | None,
        monitor: MonitorFunction | None,
        options: Options | None = None,
    ) -> TornSolution:
        """Solve with conditions, and store the results."""
        system = self.system
        if contact_set is not self._torn.undeformed:
            system = self._torn.system(self._accepted.origin, contact_set)
        guess = self._guess(coarse, contact_set)
        options = options or self.options.solver
        self._solver = TornSolver(system, options, self._timer, self._solver, guess)
        self._is_restored = False
        try:
            solution = self._solver.solve(monitor)
        except (NotConverged, Interrupted) as error:
            if error.solution is None:
                raise
            error.solution = self._store_results(error.solution, contact_set)
            error.report = self.report
            raise
        self._store_results(solution, contact_set, is_last=self.gaps is None)
        return solution

    def _guess(
        self, coarse: list[SolvedContact] | None, contact_set: ContactSet
    ) -> ContactGuess | None:
        """Return the contact of a coarse problem, or that of a checkpoint."""
        if coarse is not None:
            with self._timer.phase("coarse contact"):
                return expected_contact(coarse, contact_set.all_conditions)
        if not self._is_restored or self.options.solver.method != "active_set":
            return None
        return self._accepted.guess(contact_set)

    def _solve_exactly(
        self,
        gaps: Deformed,
        coarse: list[SolvedContact] | None,
        monitor: MonitorFunction | None,
        checkpoint: str | os.PathLike[str] | None,
    ) -> Function:
        """Repeat with normals, gaps and partners of the deformed surfaces, sec. 11.1, 11.11.2."""
        contact_set, comm = self._first_contact_set(), self.space.mesh.comm
        known = self._is_restored and not contact_set.bodies.frames
        passes = list(self._accepted.passes) if known else []
        # loads on cells of rigid bodies have other moments where these have turned
        contact_set = replace(contact_set, bodies=self._torn.loaded(contact_set.bodies))
        while True:
            self._accepted = replace(self._accepted, passes=passes)
            solution = self._solve_linearised(contact_set, None if passes else coarse, monitor)
            new_pass = self._geometry_pass(contact_set, solution)
            passes = [*passes, replace(new_pass, seconds=self._timer.lap(comm))]
            is_exact = new_pass.error <= gaps.tolerance
            is_last = is_exact or len(passes) >= gaps.max_passes
            if is_last:
                self._store_results(solution, contact_set)
            seconds = self._timer.slowest(comm)
            self._report = replace(self.report, passes=passes, seconds=seconds)
            if is_last:
                return self.u if is_exact else self._not_exact(gaps, self.u, passes[-1])
            self._accepted = replace(self._accepted, passes=passes)
            self._save(checkpoint)
            assert self._deformed is not None
            contact_set = self._deformed

    def _geometry_pass(self, contact_set: ContactSet, solution: TornSolution) -> GeometryPass:
        """Measure the deformed surfaces, with the conditions for the next pass, and the misfit."""
        assert self._solved is not None
        uh, origin, forces = self.u, self._accepted.origin, (0.0, 0.0)
        with self._timer.phase("deformed surfaces"):
            bodies = self._torn.loaded(self._solved.bodies)
            deformed, measured = contact_set.deformed(uh, bodies)
            self._deformed = deformed.with_friction(uh)
            if bodies.frames or any(found.friction is not None for found in contact_set.contacts):
                before, now = (
                    DeformedRows.of(c, uh, origin) for c in (contact_set, self._deformed)
                )
                multipliers = Multipliers.of(before, solution)
                rounding = Rounding.of(self._torn.torn.subdomains, self._torn.nodes)
                forces = misfit_of_forces(now, multipliers, owned_values(uh), rounding)
        products = self.report.products["total"]
        return geometry_pass(measured, self._solved.contacts, uh, products, *forces)

    def _first_contact_set(self) -> ContactSet:
        """Return the conditions where the last solution ended, nearer than the undeformed ones."""
        undeformed, last = self._torn.undeformed, self._deformed
        if self._is_restored and not undeformed.bodies.frames:
            last = undeformed
        if last is None:
            return undeformed
        # measured anew: obstacles and the weight of the measure may have changed
        uh = fill_owned(Function(self.space), self._accepted.displacement)
        bodies = undeformed.bodies.restored(last.bodies.saved())
        if not undeformed.has_same_contacts(last):
            last = undeformed
        with self._timer.phase("deformed surfaces"):
            return undeformed.deformed(uh, bodies, last)[0].with_friction(uh)

    def _not_exact(self, gaps: Deformed, uh: Function, last: GeometryPass) -> Function:
        reason = (
            f"limit of {gaps.max_passes} geometry passes (max_passes): the misfit of the "
            "deformed surfaces (penetration and separation relative to the largest displacement, "
            f"slip, tilt, imbalance of rigid bodies, friction) is {last.error:.1e}"
        )
        self._report = replace(self.report, converged=False, reason=reason)
        if self.options.solver.error_if_not_converged:
            raise NotConverged(
                f"no exact non-penetration to {gaps.tolerance:g}: {reason}. Raise "
                "max_passes or the tolerance of Deformed, or set error_if_not_converged to false",
                uh,
                self.report,
            )
        return uh

    def _store_results(
        self, solution: TornSolution, contact_set: ContactSet, is_last: bool = True
    ) -> Function:
        uh = fill_displacement(self.u, self._torn.torn.subdomains, solution.displacements)
        bodies = contact_set.bodies.moved(contact_set.motions_after(solution.displacements))
        uh = self._torn.fill(uh, bodies, is_small=self.gaps is None)
        self._store(solution, contact_set, bodies, is_last)
        self._accepted = replace(self._accepted, displacement=owned_values(uh))
        return uh


def _return_free_memory() -> None:
    """Give memory that is free back to the system, where the C library can (glibc).

    Reading and distributing a mesh, and the assembly, leave more of it than what they have made; in
    pieces, of which large arrays take none.
    """
    library = ctypes.CDLL(None)
    if hasattr(library, "malloc_trim"):
        library.malloc_trim(0)

"""NonlinearContactProblem: contact of bodies with finite strains, rotations and large sliding."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

import ufl
from dolfinx.fem import Constant, Function

from fenics_tfeti.errors import InputError, Interrupted, NotConverged, wrong_type
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.conditions.contact_conditions import SlaveValues
from fenics_tfeti.fem.contact.conditions.friction import SlipOrigin
from fenics_tfeti.fem.contact.descriptions.arguments import as_residual, check_hard_or_soft
from fenics_tfeti.fem.contact.descriptions.contacts import Contact
from fenics_tfeti.fem.contact.descriptions.laws import Cohesive
from fenics_tfeti.fem.contact.descriptions.rigid_body import RigidBody
from fenics_tfeti.fem.contact.descriptions.surfaces import contact_name
from fenics_tfeti.fem.contact.descriptions.ties import Tie
from fenics_tfeti.fem.contact.solution.bonded import BondedContacts
from fenics_tfeti.fem.contact.solution.damage import damaged_at_loads
from fenics_tfeti.fem.contact.solution.transfer import expected_contact
from fenics_tfeti.fem.displacement import fill_owned, owned_values
from fenics_tfeti.fem.gradients import CellGradients
from fenics_tfeti.fem.mesh_error.estimate import MeshError, estimate_mesh_error
from fenics_tfeti.fem.mesh_error.problem import MeshErrorProblem
from fenics_tfeti.fem.other_mesh import interpolated
from fenics_tfeti.fem.user_data import check_positive
from fenics_tfeti.feti import interruption
from fenics_tfeti.feti.factors.cholesky import check_real_numbers
from fenics_tfeti.feti.local.moduli import compressibility
from fenics_tfeti.load_steps import SteppedProblem
from fenics_tfeti.newton.arc_length import Arc, ArcIteration
from fenics_tfeti.newton.iteration import Monitor, NewtonIteration, NewtonStep
from fenics_tfeti.newton.last_state import solution_at
from fenics_tfeti.newton.load_case import LoadCase, NewtonState
from fenics_tfeti.newton.rounding import Rounding
from fenics_tfeti.newton.stability import instability
from fenics_tfeti.options import NewtonOptions, contact_options
from fenics_tfeti.parallel import largest_of_ranks, meet, raise_collectively
from fenics_tfeti.report import ContactReport, DamageEntry, DamageStep
from fenics_tfeti.sensitivities.adjoint import Functional, form_and_forces
from fenics_tfeti.sensitivities.deformed import (
    DeformedAdjoint,
    DeformedState,
    DeformedTangent,
    is_as_solved,
)
from fenics_tfeti.sensitivities.forms import CHANGED, FormsAtSolution, check_functional
from fenics_tfeti.sensitivities.tangent import Change
from fenics_tfeti.typing import Array, Vector

# Newton steps up to which longer load steps are tried, and above which shorter ones
_EASY, _HARD = 6, 15


@dataclass(frozen=True)
class NonlinearReport(ContactReport):
    """The report of the last linearised problem, with the steps of Newton's method.

    Attributes
    ----------
    newton : list of NewtonStep
        One entry for each Newton step; products, history and certificate of the report are those of
        the last one with a set-up of its own, its seconds those of all. Forces are those after the
        last step, in equilibrium with `u` as far as its residual says. Among `free_motions` are
        those that only the tilt of deformed surfaces resists.
    """

    newton: list[NewtonStep] = field(default_factory=list)


class NonlinearContactProblem(SteppedProblem[NonlinearReport]):
    """Contact of bodies with finite strains, solved by Newton's method and Total FETI.

    Rotations and sliding may be large: in each step contact conditions are those of the deformed
    surfaces.

    Parameters
    ----------
    F : ufl.Form
        Residual of the equilibrium, linear in its test function: the derivative of the energy with
        respect to `u`, less the loads. Integrals are over the undeformed cells and boundary.
    u : Function
        The total displacement [m], from which `solve` starts and which it fills. Lagrange elements
        of degree 1 or 2 with a component for each dimension.
    bcs : sequence of dolfinx.fem.DirichletBC, one of them, or None
        Prescribed total displacements, as for `ContactProblem`.
    contacts : sequence of contacts and ties, one of them, "auto" or None
        What may touch, and what stays together, as for `ContactProblem`.
    J : ufl.Form, optional
        Tangent, by default the derivative of `F` with respect to `u`. It need not be symmetric, as
        with `fenics_tfeti.models.follower_pressure`.
    cell_tags, subdomains, measure_weight, rigid_bodies, form_compiler_options, jit_options
        As for `ContactProblem`.
    options : mapping, optional
        Names and values, see `fenics_tfeti.options.NewtonOptions`.
    options_prefix : str
        ``-<prefix><name> value`` on the command line, or in PETSc's database, overrides `options`.

    Attributes
    ----------
    u : Function
        The displacement [m].
    results, rigid_bodies : Results
        For each contact and each rigid body, by number or name, its result, as of
        `ContactProblem`. Bodies turn by any angle; moments are about the moved reference point.
    report : NonlinearReport
        Newton steps, sizes, iterations and times, after `solve`.

    Raises
    ------
    InputError
        On all ranks together, for data that are wrong or contradict each other.

    Examples
    --------
    >>> F = ufl.derivative(energy, u, ufl.TestFunction(V))  # doctest: +SKIP
    >>> problem = NonlinearContactProblem(F, u, bcs=bcs, contacts=contacts)  # doctest: +SKIP
    >>> for t in problem.steps(set_load, 0.0, 1.0, first=0.25):  # doctest: +SKIP
    ...     print(t, problem.results[0].force)
    """

    options: NewtonOptions
    _arc: Arc | None = None  # the step of a path that is being solved

    _exact = _kind = "NonlinearContactProblem"
    _report_type = NonlinearReport
    _has_finite_strains = True

    def __init__(
        self,
        F: ufl.Form,
        u: Function,
        *,
        bcs: Sequence[Any] | Any | None = (),
        contacts: Sequence[Contact | Tie] | Contact | Tie | Literal["auto"] | None = (),
        J: ufl.Form | None = None,
        cell_tags: Any | None = None,
        subdomains: Sequence[int] | None = None,
        options: Mapping[str, Any] | None = None,
        options_prefix: str = "tfeti_",
        measure_weight: Any = None,
        rigid_bodies: Mapping[int, RigidBody] | None = None,
        form_compiler_options: Mapping[str, Any] | None = None,
        jit_options: Mapping[str, Any] | None = None,
    ) -> None:
        check_real_numbers()
        super().__init__(
            *as_residual(F, u, J),
            u,
            contact_options(NewtonOptions, options, options_prefix),
            bcs=bcs,
            contacts=contacts,
            cell_tags=cell_tags,
            rigid_bodies=rigid_bodies,
            subdomains=subdomains,
            measure_weight=measure_weight,
            compiler=_compat.CompilerOptions(form_compiler_options, jit_options),
            displacement=u,
        )
        self._instability: list[str] = []
        self._end: tuple[LoadCase, NewtonState] | None = None  # of the last solve
        # of the last solve whose derivatives were taken
        self._derivative: tuple[Any, DeformedState] | None = None
        self._gradients = CellGradients(self.space)
        ratios = list(compressibility(self._torn.torn.subdomains).values())
        largest = largest_of_ranks(self.space.mesh.comm, ratios) or 1.0
        self._shear_over_bulk = 1.0 / largest  # mu / kappa of the least compressible subdomain

    def solve(
        self,
        *,
        coarse: NonlinearContactProblem | None = None,
        monitor: Monitor | None = None,
        checkpoint: str | os.PathLike[str] | None = None,
    ) -> Function:
        """Find the equilibrium at the present loads and supports, starting from `u`.

        Parameters
        ----------
        coarse : NonlinearContactProblem, optional
            The same problem on a coarser mesh (any mesh will do), solved at the same load: its
            displacement, interpolated, and its pressures, with the motions of rigid bodies, are
            where the Newton steps start. The contacts have to have the same kinds and names or,
            without names, tags; the bodies of both meshes are in the same places. Slip is counted
            from where it is without.
        monitor : callable, optional
            Called on all ranks as by `ContactProblem.solve`, and with a `NewtonStep` after each.
        checkpoint : path-like, optional
            File to write or replace after each Newton step: `restore` goes on with this solve.

        Returns
        -------
        Function
            `u`.

        Raises
        ------
        InputError
            Wrong or contradictory data; a `u` with inverted cells; a `coarse` that is not solved,
            or has other contacts, bodies, or dimensions.
        UnresistedMotion
            A load pushes a body where nothing holds it.
        NotConverged
            Newton's method found no equilibrium; `u` and `results` are what they were before, the
            error's ``solution`` is the last iterate. With the option ``error_if_not_converged``
            false, that is returned, `results` and `report` are its own.
        Interrupted
            After Ctrl-C or SIGINT to one rank, on all of them; `u` is the last iterate, from which
            solving again goes on.
        """
        with interruption.deferred():
            try:
                with self._as_before_errors(), self._looking_over():
                    self._solve(coarse, monitor, checkpoint)
                    self._solve_where_surfaces_met(lambda: self._solve(None, monitor, checkpoint))
            finally:
                self._timer.restart()
        self._view()
        return self.u

    def follow(
        self, set_load: Callable[[float], Any], begin: float, *, length: float, steps: int
    ) -> Iterator[float]:
        """Follow the path of equilibria past limit points of the load, and yield after each step.

        The load of each step is found: it grows up to a limit point, falls beyond it, and may grow
        again, as where an arch snaps through. Steps have a length in displacements; each is
        accepted by `advance`, and halved where it fails. After two with at most 6 Newton steps they
        are twice as long again, up to `length`. Equilibria need not be stable.

        Parameters
        ----------
        set_load : callable
            Called with a load t: sets values of the forms, such as those of Constants, or what
            obstacles read. Prescribed displacements, loads on rigid bodies and the list of contacts
            do not depend on t.
        begin : float
            The load at the present `u`, an equilibrium; the path goes towards larger loads.
        length : float
            The largest step: the root of the mean square of displacements of nodes [m].
        steps : int
            Number of steps. Leave the loop to end before.

        Yields
        ------
        float
            The load of an accepted step, which `set_load` was last called with.

        Raises
        ------
        InputError
            If nothing depends on the load, or prescribed displacements do; of a wrong argument.
        NotConverged
            That of a step of a thousandth of `length`; loads and `u` are at the last accepted step.

        Examples
        --------
        >>> for t in problem.follow(set_load, 0.0, length=0.01, steps=40):  # doctest: +SKIP
        ...     print(t, problem.results["floor"].force)
        """
        if not callable(set_load):
            raise wrong_type("follow: set_load", set_load, "a function of the load")
        check_positive(length, "follow: length")
        for number, contact in enumerate(self.contacts):
            if isinstance(getattr(contact, "law", None), Cohesive):
                raise InputError(
                    f"{contact_name(contact, number)}: follow() knows no bonds that break. Take "
                    "steps() with prescribed displacements"
                )
        arc, easy = Arc(set_load, begin, owned_values(self.u), length), 0
        for _ in range(steps):
            try:
                while True:
                    set_load(arc.load)
                    self._arc = arc
                    try:
                        self._solve_step()
                        break
                    except NotConverged:
                        set_load(arc.load)
                        if arc.length < 2e-3 * length:
                            raise
                        arc, easy = replace(arc, length=0.5 * arc.length), 0
            finally:
                self._arc = None
            assert isinstance(self._iteration, ArcIteration)
            load = self._iteration.load
            arc = arc.followed_by(self._torn.nodes, load, owned_values(self.u))
            self.advance()
            easy = easy + 1 if self._was_easy() else 0
            if easy == 2:
                arc, easy = replace(arc, length=min(2.0 * arc.length, length)), 0
            yield load

    def mesh_error(self) -> MeshError:
        """Estimate the error of the mesh of the last solve. Collective.

        As `ContactProblem.mesh_error`, of the problem linearised at `u`: the energy norm is that of
        the tangent, and `energy_norm` that of `u` in it. Tangents of cells that are compressed may
        have negative eigenvalues, which count by their magnitude.

        Raises
        ------
        InputError
            As there.
        """
        if not self._is_solved or self._solved is None or self._solution is None:
            raise InputError("mesh_error() is of a solution; call solve() first")
        check_hard_or_soft(self.contacts, "mesh_error() is")
        meet(self.space.mesh.comm, "mesh_error()")
        with self._timer.phase("mesh error"):
            cells = MeshErrorProblem(
                self._torn, self._solved, self._solution.torn_displacements, True, self.u
            )
            estimate = estimate_mesh_error(cells, self.report.newton[-1].residual)
        self._report = replace(self.report, mesh_error=estimate.entry)
        return estimate

    def _state_findings(self) -> list[str]:
        return self._instability

    def _first_origin(self) -> SlipOrigin:
        return SlipOrigin.at(self.u)

    def _was_easy(self) -> bool:
        return len(self.report.newton) <= min(_EASY, 0.5 * self.options.newton_max_it)

    def _was_hard(self) -> bool:
        return len(self.report.newton) > _HARD

    def tangent(
        self,
        data: Mapping[Function | Constant, Any] | None = None,
        *,
        gaps: Mapping[str | int, Any] | None = None,
        slip_bounds: Mapping[str | int, Any] | None = None,
        coefficients: Mapping[str | int, Any] | None = None,
        rtol: float = 1e-8,
    ) -> DeformedTangent:
        """Return what the solution changes by along changes of the data. Collective.

        It is one linear solve with the whole derivative at the last state, contact that turns and
        moves with both surfaces included, on the conditions that press and stick there.

        Parameters
        ----------
        data : mapping, optional
            Of Functions and Constants of F and of Dirichlet conditions to changes of their values:
            a Function or array, or for Constants numbers.
        gaps, slip_bounds, coefficients : mapping, optional
            As of `ContactProblem.tangent`, on the present surfaces.
        rtol : float
            Part of the right-hand side that GMRES leaves.

        Returns
        -------
        DeformedTangent
            The change of the displacement and of the normal forces.

        Raises
        ------
        InputError
            The problem is not solved, or has changed since; a rigid body or a bolt has motions.
        NotConverged
            The tolerance was not reached.

        Examples
        --------
        >>> tangent = problem.tangent({E: 1e6, pressure: -1e3})  # doctest: +SKIP
        >>> tangent.u, tangent.nodal_normal_force("joint")  # doctest: +SKIP
        """
        state = self._state_for_derivatives(None)
        change = Change.of(state, data or {}, gaps or {}, slip_bounds or {}, coefficients or {})
        return DeformedTangent(state, change, rtol)

    def adjoint(
        self,
        J: ufl.Form | Function | Mapping[str | int, Any] | None = None,
        *,
        forces: Mapping[str | int, Any] | None = None,
        normal_forces: Mapping[str | int, Any] | None = None,
        rtol: float = 1e-8,
    ) -> DeformedAdjoint:
        """Return the derivatives of a functional of the solution by the data. Collective.

        It is `tangent` transposed: one linear solve, whatever the number of parameters.

        Parameters
        ----------
        J, forces, normal_forces
            As of `ContactProblem.adjoint`, of the present surfaces.
        rtol : float
            Part of the right-hand side that GMRES leaves.

        Returns
        -------
        DeformedAdjoint
            Its methods give the derivatives.

        Raises
        ------
        InputError
            As `tangent`; J is not a functional.
        NotConverged
            The tolerance was not reached.

        Examples
        --------
        >>> adjoint = problem.adjoint(ufl.dot(u, u) * ufl.dx)  # doctest: +SKIP
        >>> adjoint.by(E), adjoint.by(pressure)  # doctest: +SKIP
        """
        J, forces = form_and_forces(J, forces)
        state = self._state_for_derivatives(J)
        functional = Functional.of(state.forms, state.contact_set, forces, normal_forces or {})
        return DeformedAdjoint(state, functional, rtol)

    def _state_for_derivatives(self, J: ufl.Form | Function | None) -> DeformedState:
        """Return the last state with its derivative. Collective."""
        with raise_collectively(self.space.mesh.comm):
            if self._end is None or not (self._is_solved and self.report.converged):
                raise InputError("there is nothing to differentiate: call solve(), and let it end")
            check_functional(J, self.u)
            for number, contact in enumerate(self.contacts):
                if (law := getattr(contact, "law", None)) is not None:
                    raise InputError(
                        f"{contact_name(contact, number)}: derivatives at finite strains know no "
                        f"{type(law).__name__}. Leave it out, or difference solves"
                    )
        end = self._end
        forms = FormsAtSolution(None, self._torn.torn.forms.linear.form, J, self.u)
        if not self._is_current():
            raise InputError(CHANGED)
        if self._derivative is None or self._derivative[0] is not end:
            state = DeformedState.with_finite_strains(
                *end, self._iteration, forms, lambda: self._end is end and self._is_current()
            )
            self._derivative = end, state
            self._solver = self._iteration.solver
        return replace(self._derivative[1], forms=forms)

    def _is_current(self) -> bool:
        """Tell whether the problem is as it was solved, at `u`. Collective."""
        if not self._is_solved or self._end is None:
            return False
        has_conditions = self._torn.has_conditions(self.bcs, list(self.contacts))
        return has_conditions and is_as_solved(*self._end)

    def _solve(
        self,
        coarse: NonlinearContactProblem | None,
        monitor: Monitor | None,
        checkpoint: str | os.PathLike[str] | None,
    ) -> None:
        self._is_solved, self._instability, self._end = False, [], None
        self._refresh()
        if coarse is not None:
            self._start_from(coarse)
        bonded = BondedContacts.of(self._torn.undeformed, self._accepted.damage)
        if bonded is None:
            self._find_equilibrium(SlaveValues(), monitor, checkpoint)
        else:
            self._find_damage(bonded, monitor, checkpoint)

    def _find_damage(
        self,
        bonded: BondedContacts,
        monitor: Monitor | None,
        checkpoint: str | os.PathLike[str] | None,
    ) -> None:
        """Find the equilibrium with the damage of bonds, by passes with a fixed one."""
        reports = list[NonlinearReport]()

        def solve(damage: Vector, _: float) -> Array:
            self._find_equilibrium(bonded.damage_at_nodes(damage), monitor, checkpoint)
            if not self.report.converged:
                raise NotConverged(self.report.reason, self.u, self.report)
            reports.append(self.report)
            assert self._solved is not None
            return bonded.jumps(self._solved)

        found = damaged_at_loads(bonded.bonds, solve, bonded.before, self.options.damage_rtol)
        path = [
            DamageStep(1.0, point.dissipated, [list(r.force) for r in self.report.reactions])
            for point in found.path
        ]
        products = sum(step.products for report in reports for step in report.newton)
        dissipated, failed = bonded.by_contact(found.dissipated), bonded.failed(found.damage)
        entry = DamageEntry(dissipated, failed, path, 0, found.passes, products)
        self._report = replace(self.report, damage=entry)

    def _find_equilibrium(
        self,
        damage: SlaveValues,
        monitor: Monitor | None,
        checkpoint: str | os.PathLike[str] | None,
    ) -> None:
        """Find the equilibrium with a damage (k,) of bonds by Newton's method."""
        bodies = self._torn.undeformed.bodies.restored(self._accepted.bodies)
        load_case = LoadCase(
            self._torn,
            self.u,
            self._accepted.origin,
            self._gradients,
            self._shear_over_bulk,
            Rounding.none(self._torn.nodes),
            damage,
        )
        try:
            start = np.concatenate([owned_values(self.u), bodies.as_vector(bodies.motions)])
            first = load_case.state_at(start, self._accepted.force, bodies)
        except NotConverged as error:
            raise InputError(f"u cannot be the start of Newton's method: {error}") from None
        rounding = Rounding.of(self._torn.torn.assemble(), self._torn.nodes)
        load_case = replace(load_case, rounding=rounding)
        iteration = self._iteration = self._new_iteration(load_case)
        state: NewtonState | None = None
        try:
            for state in iteration.run(first, monitor):
                if checkpoint is not None:
                    self._store_state(state, iteration, is_last=False)
                    self._save(checkpoint)
        except Interrupted:
            if state is not None:
                self._store_state(state, iteration, is_last=False)
            raise
        except NotConverged as error:
            if state is None:
                raise
            self._store_state(state, iteration, is_last=False)
            self._report = replace(self.report, converged=False, reason=str(error))
            error.solution, error.report = self.u, self.report
            if self.options.solver.error_if_not_converged:
                raise
            return
        finally:
            self._solver = iteration.solver
        assert state is not None
        self._store_state(state, iteration)
        if iteration.has_unstable_tangents and (set_up := iteration.set_up) is not None:
            self._instability = instability(load_case, state, set_up)
        reason = f"equilibrium: {iteration.steps[-1]}"
        self._report = replace(self.report, converged=True, reason=reason)
        self._is_solved, self._end = True, (load_case, state)

    def _new_iteration(self, load_case: LoadCase) -> NewtonIteration:
        """Return Newton's method at the present load, or along the path that is followed."""
        data = load_case, self.options, self._timer, self._solver
        return NewtonIteration(*data) if self._arc is None else ArcIteration(*data, self._arc)

    def _start_from(self, coarse: NonlinearContactProblem) -> None:
        """Take displacement, contact forces and places of rigid bodies of another mesh."""
        solved = self._solved_on(coarse)
        undeformed = self._torn.undeformed
        with self._timer.phase("coarse contact"):
            start = interpolated(coarse.u, coarse._torn.bodies, self.u, self._torn.bodies)
            fill_owned(self.u, start)
            bodies = undeformed.bodies.restored(coarse._accepted.bodies)
            self._torn.fill(self.u, bodies, is_small=False)
            # areas, and the nodes that meet something, are those of the deformed surfaces
            contact_set = undeformed.deformed(self.u, replace(bodies, from_here=True))[0]
            force = expected_contact(solved, contact_set.all_conditions).normal_force
        forces = contact_set.slave_values(force)
        self._accepted = replace(self._accepted, force=forces, bodies=bodies.saved())

    def _store_state(
        self, state: NewtonState, iteration: NewtonIteration, is_last: bool = True
    ) -> None:
        # a step that failed has changed u
        fill_owned(self.u, state.nodal_displacement.ravel())
        solution = solution_at(
            state.rows,
            state.multipliers,
            state.internal,
            state.nodal_displacement,
            iteration.described_solution(),
        )
        contact_set = state.rows.contact_set
        self._store(solution, contact_set, state.bodies, is_last, newton=list(iteration.steps))
        self._accepted = replace(
            self._accepted, displacement=owned_values(self.u), bodies=state.bodies.saved()
        )

    def _update(self) -> None:
        if not self._torn.update_supports(self.bcs, self.contacts):
            self._torn.update(self.bcs, self.contacts)

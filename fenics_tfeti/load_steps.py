"""Load steps: accepted, saved and restored, and of a length that follows their cost."""

from __future__ import annotations

import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any, Generic, TypeVar

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import (
    InputError,
    Interrupted,
    NotConverged,
    UnresistedMotion,
    keep_warnings,
    wrong_type,
)
from fenics_tfeti.fem._compat import CompilerOptions
from fenics_tfeti.fem.checks.locking import warn_of_locking
from fenics_tfeti.fem.contact.conditions.friction import SlipOrigin
from fenics_tfeti.fem.contact.contact_set import ContactSet
from fenics_tfeti.fem.contact.descriptions.arguments import (
    as_conditions,
    as_contacts,
    as_displacement,
    as_rigid_bodies,
)
from fenics_tfeti.fem.contact.descriptions.contacts import RigidObstacle, SelfContact
from fenics_tfeti.fem.contact.rigid.frames import RigidBodies
from fenics_tfeti.fem.contact.search.automatic import find_contacts
from fenics_tfeti.fem.contact.solution.apart import wrong_side
from fenics_tfeti.fem.contact.solution.results import Results
from fenics_tfeti.fem.contact.solution.solved import SolvedContacts
from fenics_tfeti.fem.contact.solution.transfer import SolvedContact
from fenics_tfeti.fem.displacement import fill_owned, owned_values, space_of_forms
from fenics_tfeti.fem.gradients import CellStrains
from fenics_tfeti.fem.io.fields import contact_fields
from fenics_tfeti.fem.io.pictures import draw_deformed
from fenics_tfeti.fem.torn_problem import TornProblem
from fenics_tfeti.feti import Timer, TornSolution, TornSolver
from fenics_tfeti.findings import (
    apart_findings,
    bond_findings,
    contact_findings,
    self_findings,
    strain_findings,
    unaccepted_step,
)
from fenics_tfeti.newton.iteration import SMALLER
from fenics_tfeti.options import ContactOptions
from fenics_tfeti.parallel import (
    largest_of_ranks,
    meet,
    print_on_first_rank,
    raise_collectively,
    warn_on_first_rank,
)
from fenics_tfeti.report import ContactReport
from fenics_tfeti.saved_state import AcceptedState, read_state, write_state
from fenics_tfeti.typing import Vector

# shortest step, as a share of all; no shorter rest is left
_SHORTEST = 1e-3
# solves of one load, after each of which a surface touches itself elsewhere
_MOST_PATCHES = 5


AnyReport = TypeVar("AnyReport", bound=ContactReport)


class SteppedProblem(ABC, Generic[AnyReport]):
    """A contact problem that is solved in load steps; its data, and what was solved last."""

    options: ContactOptions

    _kind: str  # in checkpoints
    _report_type: type[AnyReport]
    _report: AnyReport | None = None
    _is_solved = _is_restored = _has_warned = False
    _has_finite_strains = False
    _last_origin: SlipOrigin | None = None  # of slips in the last solve
    _solved: SolvedContacts | None = None
    _solution: TornSolution | None = None  # of the torn system, for derivatives
    _solver: TornSolver | None = None
    # what belongs to `u`
    _state: tuple[str, ...] = ("results", "rigid_bodies", "_solved", "_solution", "_accepted")

    def __init__(
        self,
        a: Any,
        L: Any,
        u: Any,
        options: ContactOptions,
        *,
        bcs: Any,
        contacts: Any,
        cell_tags: Any,
        rigid_bodies: Any,
        subdomains: Sequence[int] | None,
        measure_weight: Any,
        compiler: CompilerOptions,
        displacement: Function | None,
    ) -> None:
        self.options, self.space, self._timer = options, space_of_forms(a, L), Timer()
        self._warned: set[str] = set()  # of what was said about bonds, without numbers
        self._warnings: list[str] = []  # of what was found and assembled
        with keep_warnings(self._warnings):
            if isinstance(contacts, str) and contacts == "auto":
                with self._timer.phase("contact search"):
                    exact = bool(self._exact)
                    contacts = find_contacts(self.space.mesh, cell_tags, whole_faces=exact)
            self.bcs, self.contacts, self.u = bcs, contacts, as_displacement(u, self.space)
            self._check_data()
            self.results = self.rigid_bodies = Results()
            self._torn = TornProblem(
                self.space,
                a,
                L,
                bcs=self.bcs,
                contacts=list(self.contacts),
                cell_tags=cell_tags,
                rigid_bodies=as_rigid_bodies(rigid_bodies),
                subdomains=subdomains,
                subdomain_size=options.subdomain_size,
                partitioner=options.partitioner,
                measure_weight=measure_weight,
                compiler=compiler,
                displacement=displacement,
                deformed_by=self.u if self._exact else None,
                timer=self._timer,
            )
            with self._timer.phase("assembly"):
                warn_of_locking(self._torn.torn.forms, self._torn.bodies)
        self._accepted = AcceptedState.at(self._first_origin())

    @property
    def report(self) -> AnyReport:
        """The report of the last solve."""
        if self._report is None:
            raise InputError("there is no report: call solve() first")
        return self._report

    @property
    @abstractmethod
    def _exact(self) -> str:
        """The argument by which gaps are measured on the deformed mesh; empty if none are."""

    @abstractmethod
    def _first_origin(self) -> SlipOrigin:
        """Return from where slip is counted before a step is accepted."""

    @abstractmethod
    def solve(self) -> Any:
        """Solve at the present loads."""

    def advance(self) -> None:
        """Accept the last solve as a load step: friction counts slip from its end, damage stays.

        Raises
        ------
        InputError
            If nothing was solved since the last step, or the last solve has not converged.

        Examples
        --------
        >>> for load.value in loads:  # doctest: +SKIP
        ...     problem.solve()
        ...     problem.advance()
        """
        if not self._is_solved:
            reason = "there is no step to accept"
            if self._report is not None and not self._report.converged:
                reason += f": the last solve has not converged ({self._report.reason})"
            raise InputError(f"{reason}; call solve() before advance(), and let it converge")
        assert self._solved is not None
        self._accepted = self._accepted.accepted(
            self._solved.obstacle_displacements(), self._solved.damage()
        )
        self._is_solved = False

    def draw(
        self, path: str | os.PathLike[str], colour: Function | None = None, **options: Any
    ) -> None:
        """Draw the deformed bodies, by default coloured by the contact pressure. Collective.

        Parameters
        ----------
        path : path-like
            The .png file.
        colour : dolfinx.fem.Function, optional
            Another scalar. By default the contact pressure on the slaves, or the size of the
            displacement where nothing presses, in the unit that suits its largest value.
        **options
            Those of `fenics_tfeti.io.draw_deformed`, such as `section`, `cells` and `limits`. With
            finite strains the scale is 1 by default, and rigid obstacles that do not move are
            drawn.

        Raises
        ------
        InputError
            If nothing was solved, or an argument is wrong; see `draw_deformed` for other errors.

        Examples
        --------
        >>> problem.draw("pressure.png", cells=cell_tags.find(1))  # doctest: +SKIP
        """
        units = self.report.units
        defaults: dict[str, Any] = {"units": self.options.units}
        if self._has_finite_strains:
            defaults["scale"] = 1.0
        defaults["obstacles"] = [
            contact.obstacle
            for contact in self.contacts
            if isinstance(contact, RigidObstacle)
            and contact.displacement is None
            and contact.rigid_body is None
        ]
        if colour is None:
            quantity, largest, colour = "length", self.report.largest_displacement, self._pressure()
            if colour is not None:
                quantity = "pressure"
                largest = largest_of_ranks(self.space.mesh.comm, colour.x.array)
            defaults["unit"] = units.readable(quantity, largest)
        draw_deformed(path, self.u, colour, **defaults | options)

    def to_html(
        self,
        path: str | os.PathLike[str],
        fields: Sequence[Function] | None = None,
        title: str = "Contact problem",
    ) -> None:
        """Write the report with the deformed bodies as a page for a browser. Collective.

        Parameters
        ----------
        path : path-like
            File to write or replace.
        fields : sequence of dolfinx.fem.Function, optional
            Scalars to colour the bodies by; the first one is seen first. By default the contact
            pressure on the slaves, where anything presses.
        title : str
            The heading.

        Raises
        ------
        InputError
            If nothing was solved, or an argument is wrong; see `ContactReport.to_html` for other
            errors.

        Examples
        --------
        >>> problem.to_html("joint.html", title="Joint under 5 kN")  # doctest: +SKIP
        """
        if fields is None:
            pressure = self._pressure()
            fields = [] if pressure is None else [pressure]
        self.report.to_html(path, self.u, fields, title)

    def _pressure(self) -> Function | None:
        """Return the contact pressure on the slaves; None where nothing presses. Collective."""
        pressure = contact_fields(self.space, self.results).pressure
        largest = largest_of_ranks(self.space.mesh.comm, pressure.x.array)
        return pressure if largest > 0.0 else None

    def reset_slip(self) -> None:
        """Count slip in the next solve as in the first one.

        That is from the undeformed state, with finite strains from the present `u`.
        """
        self._accepted = replace(self._accepted, origin=self._first_origin())

    def steps(
        self,
        set_load: Callable[[float], Any],
        begin: float,
        end: float,
        *,
        first: float | None = None,
    ) -> Iterator[float]:
        """Solve in load steps, each accepted by `advance`, and yield after each of them.

        A step that fails is halved; after two easy ones in a row, the next ones are twice as long.
        With finite strains a step is easy that took no more than 6 steps of Newton's method, and no
        more than half of ``newton_max_it``; after one with more than 15 the next ones are half as
        long. Otherwise each is easy that did not fail. A step that has not converged fails,
        whatever the option ``error_if_not_converged``. Where a step of a thousandth of all fails,
        loads, `u` and `results` are left at the last accepted step.

        After `restore` of a checkpoint that was saved between such steps they go on from its load,
        with steps as long as they would have been; nothing is solved, but `set_load` called, where
        that is at or behind `end`. Of several calls in one script, these should be in one
        direction: a load that rises and falls is a function of a time that rises.

        Parameters
        ----------
        set_load : callable
            Called with a number between `begin` and `end`: sets loads, prescribed displacements and
            obstacles. The loads of a step that fails are set back by the next call. Its own errors
            end the steps.
        begin, end : float
            The present load, which is not solved for, and that of the last step, which may be the
            smaller one.
        first : float, optional
            Length of the first step, by default all in one.

        Yields
        ------
        float
            The load of an accepted step; `end` in the last one.

        Raises
        ------
        NotConverged, InputError
            That of the shortest step, if it fails too. Supports and contacts of a wrong type, and
            loads that nothing resists on undeformed surfaces without friction, end the steps at
            once.

        Examples
        --------
        >>> def set_load(t):
        ...     traction.value = (0.0, -1e5 * t)
        >>> for t in problem.steps(set_load, 0.0, 1.0, first=0.25):  # doctest: +SKIP
        ...     print(t, problem.results["seal"].force)
        ...     problem.save(file)
        """
        if not callable(set_load):
            raise wrong_type("steps: set_load", set_load, "a function of the load")
        total = abs(end - begin)
        length = total if first is None else first
        if not (total > 0.0 and length > 0.0):
            raise InputError(
                f"load steps from {begin:g} to {end:g}, the first of {length:g}: the end has to "
                "differ from the beginning, and the first step has to be longer than 0"
            )
        sign = 1.0 if end > begin else -1.0
        t, length, easy = self._start_of_steps(begin, sign, length)
        if t != begin:
            set_load(min(t, end, key=lambda load: sign * load))
        while sign * (end - t) > 0.0:
            rest = sign * (end - t)
            is_last = rest - length < _SHORTEST * total
            step, target = (rest, end) if is_last else (length, t + sign * length)
            set_load(target)
            self._check_data()
            try:
                self._solve_step()
            except (InputError, NotConverged) as error:
                # an obstacle may have no gap where the surfaces are before a long step
                length, easy = 0.5 * step, 0
                if length >= _SHORTEST * total and self._may_help(error):
                    continue
                set_load(t)
                if isinstance(error, InputError):
                    raise
                raise type(error)(
                    f"the load step from {t:g} to {target:g} is not solved, nor were longer ones: "
                    f"{error}",
                    error.solution,
                    error.report,
                ) from None
            self.advance()
            easy = easy + 1 if self._was_easy() else 0
            t = target
            if easy == 2:
                length, easy = 2.0 * length, 0
            elif self._was_hard():
                length = max(0.5 * length, _SHORTEST * total)
            self._accepted = replace(
                self._accepted, load=t, length=sign * length, easy=easy, end=end
            )
            yield t

    def _start_of_steps(self, begin: float, sign: float, first: float) -> tuple[float, float, int]:
        """Return the load that steps start from, the length of the first, and the easy ones before.

        They are those of a checkpoint that was restored, if it was saved between the same steps.
        """
        load, length = self._accepted.load, self._accepted.length
        is_restored = self._solved is None and sign * (load - begin) >= 0.0
        if not is_restored or load == begin == self._accepted.end:
            return begin, first, 0
        if sign * length < 0.0:
            raise InputError(
                f"load steps from {begin:g} have another direction than those of the checkpoint, "
                f"which was saved at the load {load:g} of steps to {self._accepted.end:g}: call "
                "these steps first"
            )
        return load, abs(length), self._accepted.easy

    def _check_data(self) -> None:
        """Check the present supports, contacts and displacement, which the user may have set."""
        with raise_collectively(self.space.mesh.comm):
            self.bcs = as_conditions(self.bcs)
            self.contacts = as_contacts(self.contacts, self._exact, self._has_finite_strains)
            self.u = as_displacement(self.u, self.space)

    def _check_coarse(self, coarse: Any) -> None:
        """Check that a problem is the same one on another mesh, whatever the user gave as one."""
        if not isinstance(coarse, type(self)):
            raise InputError(
                f"coarse is a {type(coarse).__name__}; a {self._kind} is expected, solved on "
                "another mesh"
            )
        own, other = (problem.space.mesh.geometry.dim for problem in (self, coarse))
        if other != own:
            raise InputError(f"the coarse problem has {other} dimensions, this one has {own}")
        keys, own_keys = coarse._torn.undeformed.keys, self._torn.undeformed.keys
        if sorted(keys) != sorted(own_keys):
            raise InputError(
                f"the coarse problem has the contacts {keys}, this one has {own_keys}: give "
                "both problems the same contacts under the same names"
            )
        if coarse._solved is None:
            raise InputError("the coarse problem is not solved; call its solve() first")
        for contact in self.contacts:
            if isinstance(contact, SelfContact):
                raise InputError(
                    "coarse: contact of a surface with itself is not taken over from another mesh, "
                    "whose facets meet elsewhere; leave coarse out"
                )

    def _solved_on(self, coarse: Any) -> list[SolvedContact]:
        """Return the contact of a problem on another mesh. Collective."""
        with raise_collectively(self.space.mesh.comm):
            self._check_coarse(coarse)
        with self._timer.phase("coarse contact"):
            gathered = coarse._solved.gathered()
        return [gathered[key] for key in self._torn.undeformed.keys]

    def _solve_where_surfaces_met(self, solve: Callable[[], Any]) -> None:
        """Solve again while a surface has come near itself where it had no conditions.

        Collective.
        """
        for _ in range(_MOST_PATCHES):
            if not self.report.converged or not self._torn.lacks_contact(self.u):
                return
            solve()
        if self._torn.lacks_contact(self.u):
            self._is_solved = False
            raise NotConverged(
                "a surface that touches itself comes near itself elsewhere after each of "
                f"{_MOST_PATCHES} solves of the same load: {SMALLER}",
                self.u,
                self.report,
            )

    def _refresh(self) -> None:
        """Take what has changed since the last solve or the set-up."""
        self._check_data()
        if self._torn.torn.has_moved():
            self.reset_slip()
        with keep_warnings(self._warnings):
            self._update()

    @abstractmethod
    def _update(self) -> None:
        """Find and assemble what has changed."""

    def _store(
        self,
        solution: TornSolution,
        contact_set: ContactSet,
        bodies: RigidBodies,
        is_last: bool = True,
        **report: Any,
    ) -> None:
        """Keep the solution that was found with conditions, and has moved rigid bodies.

        Only of the last one of a solve nodes without a condition are looked at.
        """
        self._solution = solution
        solved = SolvedContacts.of(contact_set, solution, self.u, bodies, bool(self._exact))
        self._solved = solved = solved.with_penetration() if is_last else solved
        self.results, self.rigid_bodies = solved.as_given(), Results(solved.body_results)
        self._report = self._report_type.of(
            solution.report,
            self.results,
            self.options.as_dict(),
            rigid_bodies=solved.body_results,
            per_length=self.space.mesh.geometry.dim == 2 and contact_set.boundary.weight is None,
            **report,
        )
        self._accepted = replace(self._accepted, force=solved.nodal_forces())

    @contextmanager
    def _looking_over(self) -> Iterator[None]:
        """Put what there is to check, and warnings, into the report of a solve in the block.

        Surfaces that have not met, and look the same way, are an error once the solve has ended.
        """
        texts, before = list[str](), self._accepted.displacement
        is_next = self._is_solved and self._accepted.origin is self._last_origin
        try:
            with keep_warnings(texts):
                yield
        except (NotConverged, UnresistedMotion) as error:
            self._check_sides(error)
            if isinstance(error, NotConverged) and error.report is not None:
                self._look_over(texts, before if is_next else None)
                error.report = self._report
            raise
        self._check_sides()
        large = self._look_over(texts, before if is_next else None)
        bonds = bond_findings(self._solved, self.report.units.length) if self._solved else []
        self._report = replace(self.report, to_check=(*self.report.to_check, *bonds))
        # numbers change from step to step
        new = [text for text in bonds if _without_numbers(text) not in self._warned]
        self._warned |= {_without_numbers(text) for text in new}
        if not self._has_warned:
            new += large
        warn_on_first_rank(self.space.mesh.comm, *new)
        self._has_warned = self._has_warned or bool(large)

    def _check_sides(self, failure: Exception | None = None) -> None:
        """Check contacts that have not met, in the last state or after a failure in the first."""
        if not self._exact:
            return
        solved, error = self._solved if failure is None else None, None
        contact_set = self._torn.undeformed if solved is None else solved.contact_set
        # obstacles of the user may have no value where a failure has left the surfaces
        with suppress(InputError):
            error = wrong_side(contact_set, self.u, self._torn.bodies)
        if error is not None:
            self._is_solved = False
            raise error from failure

    def _look_over(self, texts: list[str], before: Vector | None) -> list[str]:
        """Complete the report; return what it says of large motions. Collective.

        The displacement `before` is that of the last solve, if that was not accepted.
        """
        assert self._solved is not None
        comm, bodies = self.space.mesh.comm, self._torn.bodies
        u = owned_values(self.u)
        strains = CellStrains.of(self.u, self._has_finite_strains)
        sizes = np.linalg.norm(u.reshape(-1, self.space.dofmap.index_map_bs), axis=1)
        strain = largest_of_ranks(comm, strains.strain[bodies.of_cell < bodies.deformable])
        large = self._large_motions(strains)
        texts += contact_findings(self._solved, bodies, self.report.units.length)
        texts += apart_findings(self._solved) if self._exact else []
        texts += self_findings(self._torn.left_inside(self.u), self.report.units.length)
        texts += strain_findings(strain)
        texts += unaccepted_step(self._solved, u, before)
        texts += self._state_findings()
        # what rank 0 alone has warned of is in its list
        texts = comm.bcast([*self._warnings, *texts, *large])
        self._last_origin = self._accepted.origin
        self._report = replace(
            self.report,
            to_check=tuple(dict.fromkeys(texts)),
            largest_displacement=largest_of_ranks(comm, sizes),
            largest_strain=strain,
        )
        return large

    def _large_motions(self, strains: CellStrains) -> list[str]:
        """Return what there is to say of strains and rotations that are not small. Collective."""
        return []

    def _state_findings(self) -> list[str]:
        """Return what there is to check about the state of a solve; the same on all ranks."""
        return []

    def _view(self) -> None:
        """Print the report, if the user wants it."""
        if self.options.view:
            print_on_first_rank(self.space.mesh.comm, str(self.report))

    def _was_easy(self) -> bool:
        """Tell whether a step that did not fail was an easy one."""
        return True

    def _was_hard(self) -> bool:
        """Tell whether the steps after one that did not fail should be shorter."""
        return False

    def _solve_step(self) -> None:
        """Solve at the present load; an error leaves the problem as it was before."""
        with self._as_before_errors():
            self.solve()
            if not self.report.converged:
                raise NotConverged(self.report.reason, self.u, self.report)

    @contextmanager
    def _as_before_errors(self) -> Iterator[None]:
        """Set displacement and results back to those before where the block raises an error.

        The displacement of an interruption stays.
        """
        start, kept = owned_values(self.u), {name: getattr(self, name) for name in self._state}
        try:
            yield
        except Interrupted:
            raise
        except BaseException as error:
            if isinstance(error, NotConverged) and error.solution is self.u:
                error.solution = self.u.copy()
            fill_owned(self.u, start)
            vars(self).update(kept)
            raise

    def _may_help(self, error: Exception) -> bool:
        """Tell whether a shorter step may succeed where a longer one has failed with an error."""
        has_friction = any(getattr(contact, "friction", None) for contact in self.contacts)
        is_unresisted = isinstance(error, UnresistedMotion)
        return not is_unresisted or has_friction or bool(self._exact)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a checkpoint for `restore`, or leave an old one as it is. Collective.

        It has the displacement, the contact forces at the nodes, from where slip is counted, and
        the number of steps that were accepted.

        Raises
        ------
        InputError
            If nothing was solved.
        OSError
            On all ranks, if rank 0 cannot write the file.
        """
        if self._solved is None:
            raise InputError("there is nothing to save; call solve() first")
        meet(self.space.mesh.comm, "save()")
        self._save(path)

    def restore(self, path: str | os.PathLike[str]) -> int:
        """Go on from a checkpoint that an earlier run of the same problem has written. Collective.

        `u` is filled. The next solve starts from the saved contact forces and, with finite strains
        or exact non-penetration, from the saved displacement or pass. A checkpoint changes where
        iterations start and from where slip is counted, no more: loads, supports, obstacles and
        materials are those that the problem has now.

        Parameters
        ----------
        path : path-like
            A file of `save` or ``solve(checkpoint=...)``, of a run on any number of ranks. The
            cells of the mesh have to be given in the same order.

        Returns
        -------
        int
            How many steps `advance` has accepted: the load step to go on with.

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
        ...     problem.advance()
        ...     problem.save(file)
        """
        if self._solved is not None:
            raise InputError("a checkpoint is for a problem that was not solved yet")
        self._accepted = read_state(path, self._kind, self._torn.undeformed)
        self._is_restored = True
        fill_owned(self.u, self._accepted.displacement)
        return self._accepted.number

    def _save(self, checkpoint: str | os.PathLike[str] | None) -> None:
        """Write the checkpoint, if there is to be one."""
        if checkpoint is not None:
            write_state(checkpoint, self._kind, self._torn.undeformed, self._accepted)


def _without_numbers(text: str) -> str:
    return re.sub(r"[\d.e+-]+", "", text)

"""The report of a contact problem: that of the solver, the matching and the geometry passes."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any, Self

from mpi4py import MPI

from fenics_tfeti.errors import InputError, first_few, format_point
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.solution.geometry_pass import GeometryPass
from fenics_tfeti.fem.contact.solution.results import ContactEntry, Results, RigidBodyResult
from fenics_tfeti.fem.io.scene import gather_scene
from fenics_tfeti.fem.io.units import Units, units_of
from fenics_tfeti.fem.mesh_error.estimate import MeshErrorEntry
from fenics_tfeti.feti import Report
from fenics_tfeti.feti.files.arrays import write_whole
from fenics_tfeti.feti.report.report import FEW_LINES, as_lines, without_nan
from fenics_tfeti.parallel import meet, raise_collectively


@dataclass(frozen=True)
class DamageStep:
    """An equilibrium on the way to the loads of a solve, from where damage begins to grow.

    Attributes
    ----------
    factor : float
        Its loads, prescribed displacements and gaps over those of the solve: its displacement and
        forces are this factor times those of the pass that has found it.
    dissipated : float
        Energy that the bonds have taken since the last load step [J].
    reactions : list of (gdim,) lists
        Force of each Dirichlet condition there [N], in the order of ``report.reactions``.
    """

    factor: float
    dissipated: float
    reactions: list[list[float]]


@dataclass(frozen=True)
class DamageEntry:
    """How the damage of bonds has grown in a solve, or where adhesion has ended.

    Attributes
    ----------
    dissipated : dict of str to float
        Energy that the bonds of each contact have taken since the last load step, by increments
        (t g' - t' g) / 2 of tractions and jumps along `path`: the work of the loads less what is
        stored [J]. Adhesion takes its energy where it ends; work beyond this moves the surfaces.
    failed : dict of str to int
        How many bonds of each contact have failed, at nodes.
    path : list of DamageStep
        The equilibria on the way to the loads, if damage has grown: the first one is where it
        begins to, the last one at the loads. Of adhesion there are none, and with finite strains
        the last one alone.
    steps_back : int
        How many of these have smaller loads than the one before: the crack runs by itself.
    passes, products : int
        Solves with a fixed damage, and their products with F. Other figures of the report are those
        of the last one.
    """

    dissipated: dict[str, float]
    failed: dict[str, int]
    path: list[DamageStep]
    steps_back: int
    passes: int
    products: int

    def __str__(self) -> str:
        """Return the entry as a line to read."""
        text = f"{sum(self.dissipated.values()):.4g} dissipated, {sum(self.failed.values())} bonds "
        text += f"failed; {self.passes} passes, {self.products} products"
        if self.steps_back:
            least = min(point.factor for point in self.path)
            text += (
                f"; {self.steps_back} of {len(self.path)} steps back, to {least:.3g} of the loads"
            )
        return text


@dataclass(frozen=True)
class ContactReport(Report):
    """The solver's report with what belongs to the geometry; equal on all ranks.

    Attributes
    ----------
    passes : list of GeometryPass
        One entry for each solution with exact non-penetration; products and history of the report
        are those of the last one, its seconds those of all passes.
    contacts : sequence of ContactEntry
        Forces, moments, the work of friction and the matching of each contact and tied pair.
    rigid_bodies : list of RigidBodyResult
        Motion of each rigid body, and the forces on it.
    to_check : tuple of str
        What the user should look at: that nothing touches, few nodes across what presses, meshes
        that overlap, contacts without unknowns, obstacles deeper than bodies, strains out of all
        proportion, friction without `advance`, and all warnings of the set-up and of the solve.
    largest_displacement, largest_strain : float
        The largest displacement of a node [m], and the largest principal strain by magnitude at
        midpoints of cells, with finite strains that of Green and Lagrange.
    mesh_error : MeshErrorEntry or None
        The error of the mesh, once `ContactProblem.mesh_error` was called.
    damage : DamageEntry or None
        How the damage of bonds has grown in the solve; None of problems without bonds or adhesion
        that can fail.
    rough_products : tuple of int
        The products of each solve with the laws of rough contacts; other figures of the report are
        those of the last one. Empty of problems without such contacts.
    per_length : bool
        Whether forces, moments and energies are those of a unit of length: in two dimensions, if
        the problem has no `measure_weight`.

    Examples
    --------
    >>> print(problem.report)  # doctest: +SKIP
    >>> problem.report.contacts[0].normal_force, problem.report.products["total"]  # doctest: +SKIP
    >>> problem.report.to_html("report.html", uh)  # doctest: +SKIP
    """

    contacts: Sequence[ContactEntry]
    passes: list[GeometryPass] = field(default_factory=list)
    rigid_bodies: list[RigidBodyResult] = field(default_factory=list)
    per_length: bool = False
    to_check: tuple[str, ...] = ()
    largest_displacement: float = 0.0
    largest_strain: float = 0.0
    mesh_error: MeshErrorEntry | None = None
    damage: DamageEntry | None = None
    rough_products: tuple[int, ...] = ()

    @classmethod
    def of(cls, report: Report, results: Results, options: Mapping[str, Any], **more: Any) -> Self:
        """Return the solver's report with what the contacts and options of a problem add."""
        added = {
            "contacts": [result.entry for result in results],
            "versions": {**report.versions, "dolfinx": _compat.version()},
            "options": {**report.options, **options},
        }
        return cls(**{**vars(report), **added, **more})

    def __str__(self) -> str:
        """Return lines to read: what to check, the result, forces and gaps, then the solver."""
        roles = [f"{entry.name}: {entry.roles}" for entry in self.contacts if entry.roles]
        size = f"displacement {self.largest_displacement:.3g} {self.units.length}"
        lines = [("to check", finding) for finding in self.to_check]
        lines += [*self.result_lines(), *self._mesh_error_lines()]
        lines.append(("largest", f"{size}, strain {self.largest_strain:.2g}"))
        if self.damage is not None:
            lines.append(("damage", str(self.damage)))
        if self.rough_products:
            solves, products = len(self.rough_products), sum(self.rough_products)
            lines.append(("rough contact", f"{solves} solves, {products} iterations in all"))
        parts = [as_lines(lines), self.force_table(), self.matching_table(FEW_LINES)]
        parts += ["\n".join(first_few(roles, FEW_LINES, "contacts"))]
        parts += [as_lines(self.solver_lines())]
        return "\n\n".join(part for part in parts if part)

    def _mesh_error_lines(self) -> list[tuple[str, str]]:
        if self.mesh_error is None:
            return []
        is_larger = self.mesh_error.error >= self.certificate.error
        advice = "the mesh is larger: refine it" if is_larger else "the iterations is larger"
        return [
            ("error of mesh", str(self.mesh_error)),
            ("", f"of both errors that of {advice}"),
        ]

    def force_table(self) -> str:
        """Return the forces of the first contacts, of the load and of supports as a table."""
        force, pressure = self.units.force, self.units.pressure
        rows = [["force of", f"force [{force}]", f"largest pressure [{pressure}]", "nodes press"]]
        for contact in self.contacts[:FEW_LINES]:
            largest = contact.largest_pressure
            pressed = ["-", "-"] if largest is None else [f"{largest:.4g}", str(contact.pressing)]
            rows.append([f"{contact.name} on slave", format_point(contact.force), *pressed])
        if len(self.contacts) > FEW_LINES:
            rows.append([f"... and {len(self.contacts) - FEW_LINES} more contacts", "", "", ""])
        for entry in (self.load, *self.reactions, self.springs):
            if any(entry.force):
                rows.append([entry.name, format_point(entry.force), "", ""])
        return _table(rows) if len(rows) > 1 else ""

    def to_html(
        self,
        path: str | os.PathLike[str],
        displacement: Any | None = None,
        fields: Sequence[Any] = (),
        title: str = "Contact problem",
    ) -> None:
        """Write the report as a page for a browser, which needs no other file. Collective.

        The page has what to check, the deformed bodies, to be turned and coloured, contacts with
        forces and pressures, load and supports; then the solver: the convergence, the certificate
        and the times of the phases. It contains Plotly, compressed to 2 MB, which browsers since
        2023 unpack; places are rounded to a ten-thousandth of the bodies' size, and fields to four
        digits.

        Parameters
        ----------
        path : path-like
            File to write or replace.
        displacement : dolfinx.fem.Function, optional
            The solution; its outer faces are gathered on rank 0. Without it the page has no bodies.
        fields : sequence of dolfinx.fem.Function
            Scalars to colour the bodies by beside the size of the displacement, such as the contact
            pressure of `fenics_tfeti.io.contact_fields`. The first one is seen first.
        title : str
            The heading.

        Raises
        ------
        InputError
            If a field is wrong, or there are fields without a displacement.
        ImportError
            If Plotly is missing.
        OSError
            If rank 0 cannot write the file; all errors are raised on all ranks.
        """
        comm = self.comm or MPI.COMM_SELF
        meet(comm, "to_html()")
        with raise_collectively(comm):
            if displacement is None and len(fields):
                raise InputError("fields are drawn on the deformed bodies: pass the displacement")
        scene = None if displacement is None else gather_scene(displacement, fields)
        with raise_collectively(comm):
            if comm.rank == 0:
                if find_spec("plotly") is None:
                    raise ImportError("the page needs the Python module plotly: pip install plotly")
                from fenics_tfeti.fem.io.page import report_page

                page = report_page(without_nan(self.to_dict()), title, scene)
                write_whole(path, "the page", lambda file: file.write(page.encode()))

    def matching_table(self, most: int | None = None) -> str:
        """Return how each contact was matched, or `most` of them, as a table to read.

        Names are cut to 30 characters, columns without an entry are left out, and columns beyond
        the width of 90 characters stand in a table below.
        """
        if not self.contacts:
            return ""
        length = f"[{self.units.length}]"
        rows = [[title.replace("[L]", length) for title in _COLUMNS.values()]]
        for entry in self.contacts[:most]:
            rows.append([_word(entry.matching[key]) for key in _COLUMNS])
        used = [set(column) != {"-"} for column in zip(*rows[1:], strict=True)]
        rows = [[word for word, is_used in zip(row, used, strict=True) if is_used] for row in rows]
        text = _table(rows)
        more = len(self.contacts) - len(rows) + 1
        return f"{text}\n... and {more} more contacts" if more else text

    @property
    def units(self) -> Units:
        """The names of the units of the options."""
        return units_of(self.options["units"], self.per_length)


# with the unit of length in place of L
_COLUMNS = {
    "contact": "contact",
    "discretisation": "discretisation",
    "pairs": "pairs",
    "unmatched": "unmatched",
    "largest_distance": "distance [L]",
    "largest_relative_distance": "of a facet",
    "largest_angle": "angle [deg]",
    "smallest_gap": "gap from [L]",
    "largest_gap": "to [L]",
    "covered_area": "area",
    "deviation": "deviation [L]",
}


def _table(rows: Sequence[Sequence[str]]) -> str:
    """Return rows, the first of them titles, as a table of 90 characters, or as several of them."""
    width, longest = 90, 30
    names, *columns = [list(column) for column in zip(*rows, strict=True)]
    names = [f"{name[: longest - 3]}..." if len(name) > longest else name for name in names]
    names = [name.ljust(max(map(len, names))) for name in names]
    tables = [names]
    for column in columns:
        wide = max(map(len, column))
        if len(tables[-1][0]) + 2 + wide > width:
            tables.append(names)
        lines = zip(tables[-1], column, strict=True)
        tables[-1] = [f"{line}  {word.rjust(wide)}" for line, word in lines]
    return "\n".join(line.rstrip() for table in tables for line in table)


def _word(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)

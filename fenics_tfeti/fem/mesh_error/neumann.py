"""Neumann problems of single cells, with displacements one degree higher than the solution's."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import ufl

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.forms import PreparedForm, prepare_form
from fenics_tfeti.fem.geometry.batches import batches
from fenics_tfeti.fem.geometry.reference_cells import lagrange_points, shape_values
from fenics_tfeti.fem.mesh_error.cell_loops import (
    PACK,
    hold_motions,
    ordered,
    products,
    subtract_internal,
)
from fenics_tfeti.fem.mesh_error.faces import CellFaces
from fenics_tfeti.fem.topology import exterior_cell_facets
from fenics_tfeti.typing import Indices, Mask, Numbers, Vector

# numbers in the matrices of the cells that are solved with at once
_ENTRIES = 2**19
# coordinates relative to a cell's size, that are equal
_SAME_PLACE = 1e-11
# decimals of the numbers that stand for coordinates and data
_DIGITS = 9
# classes, relative to the number of cells, that are few; cells that are looked at first
_FEW, _SAMPLE = 0.5, 256
# energy of a rigid motion of a cell, relative to its stiffness, that is more than rounding
_RESISTED = 1e-9


@dataclass(frozen=True)
class CellEnergies:
    """Energies a(e, e) = constant + 2 gradient . dm + dm . matrix dm of the errors e of g cells.

    They depend on changes dm (s,) of the moments on a cell's facets; the constants and gradients
    are those of v load cases. Congruent cells share their matrix.
    """

    number: Indices  # (g,): the matrix of each cell
    matrix: Vector  # (c, s, s) [1/N * m]
    gradient: Vector  # (g, s, v) [m]
    constant: Vector  # (g, v) [J]
    resisted: Mask  # (g,): springs or the form resist rigid motions
    solution: Vector  # (g,): a(u, u) of the solution [J]


class NeumannProblems:
    """The problems of all cells; making them compiles the forms, and is collective.

    Tangents may be negative in cells that are compressed: their eigenvalues count by magnitude.
    """

    def __init__(
        self,
        faces: CellFaces,
        a: ufl.Form,
        L: ufl.Form,
        compiler: _compat.CompilerOptions | None = None,
        is_tangent: bool = False,
    ) -> None:
        self.faces, self._is_tangent, domain = faces, is_tangent, faces.space.mesh
        degree, d = faces.degree + 1, faces.dim
        space = _compat.symbolic_space(domain, degree, d)
        v, u = ufl.TestFunction(space), ufl.TrialFunction(space)
        arguments = dict(zip(a.arguments(), (v, u), strict=True))
        exterior = exterior_cell_facets(domain)
        self.bilinear, self.linear = (
            prepare_form(domain, _raised(form), name, exterior, compiler)
            for form, name in (
                (ufl.replace(a, arguments), "bilinear form a (the stiffness)"),
                (ufl.replace(L, {L.arguments()[0]: v}), "linear form L (the load)"),
            )
        )
        name, points = faces.kind.name, lagrange_points(faces.kind.name, degree)
        self._interpolation = shape_values(name, faces.degree, points)
        lifts = np.stack(list(self._lifts(degree)), axis=1)  # (w, f, t)
        lift = lifts[:, None, :, :, None] * np.eye(d)[None, :, None, None, :]
        self.lift = lift.reshape(points.shape[0] * d, -1)  # (w * d, s)
        self._degree, self._data = degree, self.bilinear.cell_data()

    def _lifts(self, degree: int) -> Iterator[Vector]:
        """Yield for each facet the matrix from moments to functionals of traces of a degree.

        They are the same for all cells, whatever their shapes.
        """
        rule, name = self.faces.rule, self.faces.kind.name
        for points, traces in zip(rule.points, rule.traces, strict=True):
            weighted = rule.weights[:, None] * shape_values(name, degree, points)
            mass = (rule.weights[:, None] * traces).T @ traces
            yield weighted.T @ traces @ np.linalg.inv(mass)

    @property
    def bytes(self) -> int:
        """The memory that the energies of a cell and its part of the preconditioner take."""
        f, m = len(self.faces.closure), self.lift.shape[1] // len(self.faces.closure)
        return 8 * (self.lift.shape[1] ** 2 + f * m * (m + PACK))

    def energies(self, rows: Numbers, u: Vector, total: Vector, moments: Vector) -> CellEnergies:
        """Return the energies of some cells with displacements u (g, n, d) [m] and moments.

        The energy of the solution is that of `total` (g, n, d), at finite strains another one.
        """
        s, v, first, number = self.lift.shape[1], moments.shape[-1], *self._classes(rows)
        energies = CellEnergies(
            number,
            np.empty((first.size, s, s)),
            np.empty((rows.size, s, v)),
            np.empty((rows.size, v)),
            np.zeros(rows.size, dtype=bool),
            np.empty(rows.size),
        )
        order, ends = ordered(number, first.size)
        step = max(1, _ENTRIES // self.lift.size)
        for batch in batches(first.size, step):
            begin, end = int(ends[batch.start]), int(ends[min(batch.stop, first.size)])
            cells = order[begin:end]
            A = self.stiffness(rows[first[batch]])
            load = self._external(rows[cells], moments[cells])
            fine = self._interpolated(total[cells])
            of_batch = number[cells] - number.dtype.type(batch.start)
            energies.solution[cells] = subtract_internal(
                of_batch, A, fine, load if total is u else np.zeros_like(load)
            )
            if total is not u:
                subtract_internal(of_batch, A, self._interpolated(u[cells]), load)
            energies.resisted[cells] = self._hold_motions(A, rows[first[batch]])[of_batch]
            members = np.arange(cells.size, dtype=np.int32), ends[batch.start :] - ends[batch.start]
            Q = energies.matrix[batch]
            gradient, constant = np.empty((cells.size, s, v)), np.empty((cells.size, v))
            positive = products(members, A, self.lift, load, (Q, gradient, constant))
            if positive < len(A):
                wrong = rows[first[batch.start + positive]]
                middle = self.faces.node_points(1, np.array([wrong])).mean(axis=1)[0]
                raise InputError(
                    "the error of the mesh cannot be estimated: the bilinear form of the cell at "
                    f"{format_point(middle)} alone is not positive but for rigid motions"
                )
            energies.gradient[cells], energies.constant[cells] = gradient, constant
        return energies

    def _classes(self, rows: Numbers) -> tuple[Numbers, Indices]:
        """Return the first cell (c,) of each class of congruent cells, and the class of each (g,).

        Congruent cells are translated, with the same coefficients and tags. Where there are hardly
        any, also among a few of the cells, each cell is a class of its own.
        """
        every, number = np.arange(rows.size), np.arange(rows.size, dtype=np.int32)
        if self._is_tangent or not self.bilinear.translation_invariant:
            return every, number
        sample = rows[:: max(1, rows.size // _SAMPLE)]
        for some in (sample, rows):
            columns, coordinates = self._cell_data(some)
            weights = np.random.default_rng(0).uniform(1.0, 2.0, columns.shape[1])
            mixed = np.round(columns @ weights, _DIGITS)
            _, first, classes = np.unique(mixed, return_index=True, return_inverse=True)
            if first.size > _FEW * some.size:
                return every, number
        # the numbers stand for the data, which decide
        tolerance = np.where(np.arange(columns.shape[1]) < coordinates, _SAME_PLACE, 0.0)
        differs = (np.abs(columns - columns[first[classes]]) > tolerance).any(axis=1)
        own = np.flatnonzero(differs)
        classes[own] = first.size + np.arange(own.size)
        return np.append(first, own), classes.astype(np.int32)

    def _cell_data(self, rows: Numbers) -> tuple[Vector, int]:
        """Return what cells differ in: relative coordinates, in so many columns, and other data."""
        x = self.faces.node_points(self.faces.geometry_degree, rows)
        x = (x - x[:, :1]).reshape(rows.size, -1)
        x /= np.abs(x).max(initial=0.0) or 1.0
        cells = self.faces.cells[rows]
        data = [x, *(values[cells].reshape(rows.size, -1) for values in self._data)]
        return np.hstack(data), x.shape[1]

    def stiffness(self, rows: Numbers) -> Vector:
        """Return the stiffness matrices (g, w, w) of some cells."""
        return self._tensors(self.bilinear, rows)

    def _tensors(self, form: PreparedForm, rows: Numbers) -> Vector:
        faces = self.faces
        return form.element_tensors(faces.space.mesh, self.lift.shape[0], faces.cells[rows])

    def part_of_load(self, rows: Numbers, kind: str, facet: int | None = None) -> Vector:
        """Return the part of L (g, w) over some cells, or over facets with a local number [N]."""
        return self._tensors(self.linear.restricted(kind, facet), rows)

    def restricted(self, load: Vector) -> Vector:
        """Return loads (g, w) in terms of the solution's own functions (g, n * d) [N]."""
        nodal = self._interpolation.T @ load.reshape(len(load), -1, self.faces.dim)
        return np.asarray(nodal.reshape(len(load), -1))

    def loads(self, rows: Numbers, u: Vector, moments: Vector) -> Vector:
        """Return the loads (k, w, v) of the problems of some cells [N]."""
        return (
            self._external(rows, moments) - self.stiffness(rows) @ self._interpolated(u)[..., None]
        )

    def _interpolated(self, u: Vector) -> Vector:
        """Return displacements (g, w) in terms of the functions of one degree more."""
        return np.asarray((self._interpolation @ u).reshape(len(u), -1))

    def _external(self, rows: Numbers, moments: Vector) -> Vector:
        load = self._tensors(self.linear, rows)
        on_facets = np.moveaxis(moments.reshape(rows.size, self.lift.shape[1], -1), 2, 0)
        return np.stack([load + part @ self.lift.T for part in on_facets], axis=2)

    def free_motions(self, rows: Numbers, middle: Vector, length: float) -> Vector:
        """Return the projectors (g, n, n) on the rigid motions that cells alone do not resist.

        They are translations and rotations about middles (g, d), over a length [m].
        """
        A = self.stiffness(rows)
        R = motions((self.faces.node_points(self._degree, rows) - middle[:, None]) / length)
        values, modes = np.linalg.eigh(R.transpose(0, 2, 1) @ A @ R)
        limit = _RESISTED * np.trace(A, axis1=1, axis2=2)
        free = modes * (values < limit[:, None])[:, None, :]
        return np.asarray(free @ free.transpose(0, 2, 1))

    def _hold_motions(self, A: Vector, rows: Numbers) -> Mask:
        """Add stiffness against the rigid motions of cells, which loads in balance do not move.

        Returns which cells resist some of them, but for tangents.
        """
        x = self.faces.node_points(self._degree, rows)
        resisted = np.zeros(rows.size, dtype=bool)
        if self._is_tangent:
            # pressures that follow the surface have tangents that are not symmetric
            A[:] = 0.5 * (A + A.transpose(0, 2, 1))
            self._hold_free_motions(A, x)
            A[:] = _magnitudes(A)
        elif (resisted := hold_motions(A, x, _RESISTED)).any():
            some = A[resisted]
            self._hold_free_motions(some, x[resisted])
            A[resisted] = some
        return resisted

    @staticmethod
    def _hold_free_motions(A: Vector, x: Vector) -> None:
        """Do so for cells that may resist some of their motions."""
        scale = np.trace(A, axis1=1, axis2=2)
        R = rigid_motions(x)
        energy = R.transpose(0, 2, 1) @ A @ R
        limit = _RESISTED * scale
        # springs and axisymmetric forms leave fewer motions free
        resisted = np.abs(energy).max(axis=(1, 2)) >= limit
        if resisted.any():
            R[resisted] = np.linalg.qr(R[resisted])[0]
            energy = R[resisted].transpose(0, 2, 1) @ A[resisted] @ R[resisted]
            values, modes = np.linalg.eigh(energy)
            R[resisted] = (R[resisted] @ modes) * (values < limit[resisted, None])[:, None, :]
        A += (scale / A.shape[1])[:, None, None] * (R @ R.transpose(0, 2, 1))


def _raised(form: ufl.Form) -> ufl.Form:
    """Return a form with rules that suit functions one degree higher, where it names rules."""
    integrals = []
    for integral in form.integrals():
        metadata = dict(integral.metadata())
        if isinstance(metadata.get("quadrature_degree"), int):
            metadata["quadrature_degree"] += 2
        integrals.append(integral.reconstruct(metadata=metadata))
    return ufl.Form(integrals)


def _magnitudes(A: Vector) -> Vector:
    """Return symmetric matrices (k, w, w) with the magnitudes of their eigenvalues."""
    values, vectors = np.linalg.eigh(A)
    return np.asarray((vectors * np.abs(values)[:, None, :]) @ vectors.transpose(0, 2, 1))


def rigid_motions(x: Vector) -> Vector:
    """Return rigid motions (k, n * d, modes) of unit length of nodes (k, n, d)."""
    (k, n, d), turns = x.shape, rotations(x)
    turns = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    moves = np.broadcast_to(np.tile(np.eye(d), (n, 1)) / np.sqrt(n), (k, n * d, d))
    return np.concatenate([moves, turns], axis=2)


def axes(dim: int) -> tuple[tuple[int, int], ...]:
    """Return the planes in which there are rotations."""
    return ((0, 1),) if dim == 2 else ((0, 1), (1, 2), (2, 0))


def rotations(x: Vector) -> Vector:
    """Return the rotations (k, n * d, axes) of nodes (k, n, d) around their mean."""
    return motions(x - x.mean(axis=1, keepdims=True))[..., x.shape[2] :]


def motions(arm: Vector) -> Vector:
    """Return translations and rotations (k, n * d, motions) of nodes at arms (k, n, d)."""
    k, n, d = arm.shape
    moved = np.zeros((k, n, d, d + len(axes(d))))
    moved[..., :d] = np.eye(d)
    for number, (a, b) in enumerate(axes(d)):
        moved[:, :, a, d + number], moved[:, :, b, d + number] = -arm[..., b], arm[..., a]
    return moved.reshape(k, n * d, -1)

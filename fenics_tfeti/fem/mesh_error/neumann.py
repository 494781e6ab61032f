"""Neumann problems of single cells, with displacements one degree higher than the solution's."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import ufl

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.forms import prepare_form
from fenics_tfeti.fem.geometry.batches import batches
from fenics_tfeti.fem.geometry.reference_cells import lagrange_points, shape_values
from fenics_tfeti.fem.mesh_error.cell_loops import products
from fenics_tfeti.fem.mesh_error.faces import CellFaces
from fenics_tfeti.fem.topology import exterior_cell_facets
from fenics_tfeti.typing import Numbers, Vector

# numbers in the matrices of the cells that are solved with at once
_ENTRIES = 2**19
# energy of a rigid motion of a cell, relative to its stiffness, that is more than rounding
_RESISTED = 1e-9


@dataclass(frozen=True)
class CellEnergies:
    """Energies a(e, e) = constant + 2 gradient . dm + dm . matrix dm of the errors e of k cells.

    They depend on changes dm (s,) of the moments on a cell's facets; the constants and gradients
    are those of v load cases.
    """

    matrix: Vector  # (k, s, s) [1/N * m]
    gradient: Vector  # (k, s, v) [m]
    constant: Vector  # (k, v) [J]
    solution: Vector  # (k,): a(u, u) of the solution [J]


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
        self._faces, self._is_tangent, domain = faces, is_tangent, faces.space.mesh
        degree, d = faces.degree + 1, faces.dim
        self.space = space = _compat.lagrange_space(domain, degree, d, discontinuous=True)
        v, u = ufl.TestFunction(space), ufl.TrialFunction(space)
        arguments = dict(zip(a.arguments(), (v, u), strict=True))
        exterior = exterior_cell_facets(domain)
        self.bilinear, self.linear = (
            prepare_form(space, _raised(form), name, exterior, compiler)
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
        self._degree = degree

    def _lifts(self, degree: int) -> Iterator[Vector]:
        """Yield for each facet the matrix from moments to functionals of traces of a degree.

        They are the same for all cells, whatever their shapes.
        """
        rule, name = self._faces.rule, self._faces.kind.name
        for points, traces in zip(rule.points, rule.traces, strict=True):
            weighted = rule.weights[:, None] * shape_values(name, degree, points)
            mass = (rule.weights[:, None] * traces).T @ traces
            yield weighted.T @ traces @ np.linalg.inv(mass)

    @property
    def bytes(self) -> int:
        """The memory that the energies of a cell take."""
        return 8 * self.lift.shape[1] ** 2

    def energies(self, rows: Numbers, u: Vector, total: Vector, moments: Vector) -> CellEnergies:
        """Return the energies of some cells with displacements u (k, n, d) [m] and moments.

        The energy of the solution is that of `total` (k, n, d), at finite strains another one.
        """
        s, v = self.lift.shape[1], moments.shape[-1]
        Q, c = np.zeros((rows.size, s, s)), np.zeros((rows.size, v))
        g, solution = np.zeros((rows.size, s, v)), np.zeros(rows.size)
        for batch in batches(rows.size, max(1, _ENTRIES // self.lift.size)):
            chosen = rows[batch]
            A, internal = self._internal(chosen, u[batch])
            fine = self._interpolated(total[batch])
            solution[batch] = np.sum(fine * (A @ fine), axis=(1, 2))
            load = self._external(chosen, moments[batch]) - internal
            if self._is_tangent:
                # pressures that follow the surface have tangents that are not symmetric
                A = 0.5 * (A + A.transpose(0, 2, 1))
            self._hold_motions(A, chosen)
            if self._is_tangent:
                A = _magnitudes(A)
            held = products(A, self.lift, load, (Q[batch], g[batch], c[batch]))
            if held < chosen.size:
                middle = self._faces.node_points(1, chosen[held : held + 1]).mean(axis=1)[0]
                raise InputError(
                    "the error of the mesh cannot be estimated: the bilinear form of the cell at "
                    f"{format_point(middle)} alone is not positive but for rigid motions"
                )
        return CellEnergies(Q, g, c, solution)

    def loads(self, rows: Numbers, u: Vector, moments: Vector) -> Vector:
        """Return the loads (k, w, v) of the problems of some cells [N]."""
        return self._external(rows, moments) - self._internal(rows, u)[1]

    def _internal(self, rows: Numbers, u: Vector) -> tuple[Vector, Vector]:
        """Return stiffness matrices and internal forces (k, w, 1)."""
        A = self.bilinear.element_tensors(self.space, self._faces.cells[rows])
        return A, A @ self._interpolated(u)

    def _interpolated(self, u: Vector) -> Vector:
        """Return displacements (k, w, 1) in terms of the functions of one degree more."""
        return np.asarray((self._interpolation @ u).reshape(len(u), -1, 1))

    def _external(self, rows: Numbers, moments: Vector) -> Vector:
        load = self.linear.element_tensors(self.space, self._faces.cells[rows])
        on_facets = moments.reshape(rows.size, self.lift.shape[1], -1)
        return load[:, :, None] + self.lift @ on_facets

    def _hold_motions(self, A: Vector, rows: Numbers) -> None:
        """Add stiffness against the rigid motions of cells, which loads in balance do not move."""
        scale = np.trace(A, axis1=1, axis2=2)
        x = self._faces.node_points(self._degree, rows)
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
    k, n, d = x.shape
    arm = x - x.mean(axis=1, keepdims=True)
    moved = np.zeros((k, n, d, len(axes(d))))
    for number, (a, b) in enumerate(axes(d)):
        moved[:, :, a, number], moved[:, :, b, number] = -arm[..., b], arm[..., a]
    return moved.reshape(k, n * d, -1)

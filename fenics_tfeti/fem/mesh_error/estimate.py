"""The error of the mesh in the energy norm, by cell, body and contact.

Total FETI continued down to single cells: each cell is torn out, with tractions on its facets in
equilibrium. The energies of the cells' Neumann problems bound the distance to the solution of one
degree more; with the work of contact pressures over gaps they estimate the error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function, FunctionSpace

from fenics_tfeti.errors import InputError, check_value
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.solution.solved import SolvedContacts
from fenics_tfeti.fem.decomposition.round_parts import cut_into_slabs
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.displacement import prescribed_components
from fenics_tfeti.fem.geometry.batches import batches
from fenics_tfeti.fem.mesh_error.cell_loops import ordered, subtract_internal
from fenics_tfeti.fem.mesh_error.contact import at_local_nodes, facets_of, gap_energies
from fenics_tfeti.fem.mesh_error.faces import CellFaces
from fenics_tfeti.fem.mesh_error.neumann import NeumannProblems
from fenics_tfeti.fem.mesh_error.rings import improved_energies
from fenics_tfeti.fem.mesh_error.stress import CellStress
from fenics_tfeti.fem.mesh_error.tractions import (
    FacetKinds,
    Tractions,
    equilibrated_tractions,
    over_ranks,
    own_moments,
)
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import exterior_facets, owned_cells, vertex_nodes
from fenics_tfeti.fem.torn_problem import TornProblem
from fenics_tfeti.fem.user_data import check_positive
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Indices, Numbers, Vector

# steps of conjugate gradients: more of them make the estimate smaller by a hundredth
_STEPS = 5
# bytes of the matrices of the cells that are kept at once
_BYTES = 2**25
# cells whose forces are computed at once
_CELLS = 2**12
# forces of a cell, relative to those of its stiffness and displacements one by one, that are none
_ROUNDING = 1e-12
# a cell's new size relative to the old one
_SMALLER, _LARGER = 0.25, 2.0

T = TypeVar("T")


class ByName(dict[str, T]):
    """Errors by name; a name that is missing is an error with those that there are."""

    def __missing__(self, name: str) -> T:
        raise InputError(f"there is no mesh error of {name!r}; the names are {sorted(self)}")


@dataclass(frozen=True)
class BodyMeshError:
    """The error of the mesh of a body.

    Attributes
    ----------
    error : float
        In the energy norm, relative to that of the body.
    share : float
        In the energy norm, relative to that of all bodies.
    """

    error: float
    share: float


@dataclass(frozen=True)
class ContactMeshError:
    """The error of the mesh at a contact or tie.

    Attributes
    ----------
    error : float
        In the energy norm, in the cells at its surfaces, relative to their energy.
    at_largest_pressure : float or None
        The same in the cells at the node with the largest pressure. The error of this pressure is
        usually smaller. None without a pressure.
    """

    error: float
    at_largest_pressure: float | None


@dataclass(frozen=True)
class MeshErrorEntry:
    """The error of the mesh in the report, see `MeshError`.

    Attributes
    ----------
    error, total : float
        In the energy norm, relative to that of the displacement; `total` with the error that the
        iterations have left.
    guaranteed : bool
        Whether it is a bound.
    linearised : bool
        Whether it is that of the problem linearised at a displacement with finite strains.
    bodies : dict of str to BodyMeshError
        By name of the body.
    contacts : dict of str to ContactMeshError
        By name of the contact or tie.
    """

    error: float
    total: float
    guaranteed: bool
    linearised: bool
    bodies: Mapping[str, BodyMeshError]
    contacts: Mapping[str, ContactMeshError]

    def __str__(self) -> str:
        """Return the errors as a line to read."""
        of = " of the linearised problem" if self.linearised else ""
        text = f"about {_percent(self.error)} % in the energy norm{of}"
        if len(self.bodies) > 1:
            largest = sorted(self.bodies.items(), key=lambda item: -item[1].share)[:4]
            text += f" ({', '.join(f'{name} {_percent(e.error)}' for name, e in largest)})"
        pressed = {
            name: entry.at_largest_pressure
            for name, entry in self.contacts.items()
            if entry.at_largest_pressure is not None
        }
        if pressed:
            name, error = max(pressed.items(), key=lambda item: item[1] or 0.0)
            text += f"; {_percent(error or 0.0)} % at the largest pressure of {name!r}"
        return text


def _percent(error: float) -> str:
    return f"{100.0 * error:.2g}" if error < 0.995 else f"{100.0 * error:.0f}"


@dataclass(frozen=True)
class MeshError:
    """The estimated error of the mesh, in the energy norm.

    It is the distance of the solution from that of the same problem on an infinitely fine mesh. The
    error of facets against the true surfaces is not part of it.

    Attributes
    ----------
    error : float
        Relative to the energy norm of the displacement.
    total : float
        The same with the error that the iterations have left, by the certificate of the report.
    guaranteed : bool
        Whether it is a bound; False: it is an estimate.
    linearised : bool
        Whether it is that of the problem linearised at the displacement, which has finite strains;
        the energy norm is that of its tangent.
    bodies : dict of str to BodyMeshError
        By the name of the body's cells, or ``"body 0"``.
    contacts : dict of str to ContactMeshError
        By the name of the contact or tie.
    cells : Function
        The error of each cell [sqrt(J)], of degree 0; the root of their sum of squares is that of
        all.
    energy_norm : float
        That of the displacement [sqrt(J)].
    space : FunctionSpace
        That of the displacement.

    Examples
    --------
    >>> estimate = problem.mesh_error()  # doctest: +SKIP
    >>> estimate.error, estimate.contacts["joint"].at_largest_pressure  # doctest: +SKIP
    >>> fine = io.refine(parts, estimate.mark(0.5))  # doctest: +SKIP
    """

    error: float
    total: float
    guaranteed: bool
    linearised: bool
    bodies: ByName[BodyMeshError]
    contacts: ByName[ContactMeshError]
    cells: Function
    energy_norm: float
    space: FunctionSpace

    @property
    def entry(self) -> MeshErrorEntry:
        """Its numbers in the report."""
        return MeshErrorEntry(
            self.error,
            self.total,
            self.guaranteed,
            self.linearised,
            dict(self.bodies),
            dict(self.contacts),
        )

    def __str__(self) -> str:
        """Return the errors as a line to read."""
        return f"error of the mesh {self.entry}"

    @property
    def density(self) -> Function:
        """How the error is distributed, of degree 0, for pictures.

        The logarithm to the base 10 of the square of a cell's error over its volume, relative to
        the mean energy density: large and small cells compare. At least -12.
        """
        W = self.cells.function_space
        faces = CellFaces(self.space, np.arange(owned_cells(W.mesh), dtype=np.int32))
        volumes = faces.volumes()
        mean = self.energy_norm**2 / self._comm.allreduce(volumes.sum())
        relative = self._squares / (volumes * (mean or 1.0))
        density = Function(W)
        dofs = _compat.cell_dofs(W)[: volumes.size, 0]
        density.x.array[dofs] = np.log10(np.maximum(relative, 1e-12))
        density.x.scatter_forward()
        density.name = "mesh_error_density"
        return density

    def mark(self, share: float = 0.5) -> Indices:
        """Return the cells of this rank that have a share of the error, and are few. Collective.

        Parameters
        ----------
        share : float
            The share in the sum of squares over the cells of all ranks that the marked cells have;
            cells with larger errors are marked first.

        Returns
        -------
        array
            Local numbers of owned cells, ascending.
        """
        comm, squares = self._comm, self._squares
        with raise_collectively(comm):
            check_value(0.0 < share <= 1.0, "mark: share", share, "a number in (0, 1]")
        total, largest = (
            comm.allreduce(squares.sum()),
            comm.allreduce(squares.max(initial=0.0), MPI.MAX),
        )
        low, high = 0.0, largest
        # the largest limit above which the cells have the share
        while low < (middle := 0.5 * (low + high)) < high:
            if comm.allreduce(squares[squares >= middle].sum()) >= share * total:
                low = middle
            else:
                high = middle
        limit = high if comm.allreduce(squares[squares >= high].sum()) >= share * total else low
        return np.flatnonzero((squares >= limit) & (squares > 0.0)).astype(np.int32)

    def sizes(self, error: float) -> Function:
        """Return the cell sizes with which a new mesh has an error. Collective.

        Each cell of the new mesh has the same error. Sizes are the edges of equilateral cells, for
        a background field of Gmsh; they are between a quarter of and twice the present ones.

        Parameters
        ----------
        error : float
            The wanted `error`, relative to the energy norm.

        Returns
        -------
        Function
            Of degree 1 [m].
        """
        space = self.space
        with raise_collectively(self._comm):
            check_positive(error, "sizes: error")
        faces = CellFaces(space, np.arange(owned_cells(space.mesh), dtype=np.int32))
        d, power = faces.dim, 2 * faces.degree + faces.dim
        eta = np.sqrt(self._squares)
        number = self._comm.allreduce(np.sum(eta ** (2.0 * d / power)))
        if number == 0.0:
            number = np.finfo(float).tiny
        wanted = (error * self.energy_norm) ** 2 / number
        target = wanted ** (power / (4.0 * faces.degree))
        factor = (target / np.maximum(eta, np.finfo(float).tiny)) ** (2.0 / power)
        volume = _EQUILATERAL[faces.kind.name]
        h = (faces.volumes() / volume) ** (1.0 / d) * np.clip(factor, _SMALLER, _LARGER)
        result = Function(_compat.lagrange_space(space.mesh, 1))
        nodes = NodeMap(result.function_space)
        at = vertex_nodes(result.function_space)[: h.size]
        values = np.zeros((nodes.size, 2))
        np.add.at(values, at, np.column_stack([np.log(h), np.ones_like(h)])[:, None])
        logarithm, count = over_ranks(nodes, values).T
        result.x.array[: nodes.owned] = np.exp(logarithm / np.maximum(count, 1.0))[: nodes.owned]
        result.x.scatter_forward()
        result.name = "cell_size"
        return result

    @property
    def _comm(self) -> MPI.Intracomm:
        return self.cells.function_space.mesh.comm

    @property
    def _squares(self) -> Vector:
        """The squares of the errors of owned cells [J]."""
        W = self.cells.function_space
        dofs = _compat.cell_dofs(W)[: owned_cells(W.mesh), 0]
        return np.asarray(self.cells.x.array[dofs] ** 2, dtype=float)


# volumes of equilateral cells with edges of length 1
_EQUILATERAL = {
    "triangle": np.sqrt(3.0) / 4.0,
    "quadrilateral": 1.0,
    "tetrahedron": 1.0 / (6.0 * np.sqrt(2.0)),
    "hexahedron": 1.0,
}


class MeshErrorProblem:
    """The problems of all cells of a solution, with tractions in equilibrium. Collective.

    `displacements` are those of the subdomains, torn: their forces balance the multipliers. With
    finite strains the forms are those at the total displacement, `linearised_at`, where only the
    load is not zero.
    """

    def __init__(
        self,
        torn: TornProblem,
        solved: SolvedContacts,
        displacements: Sequence[Vector],
        is_exact: bool,
        linearised_at: Function | None = None,
    ) -> None:
        self.torn, self.nodes, self.solved, self._is_exact = torn, torn.nodes, solved, is_exact
        self.is_linearised = linearised_at is not None
        cells, self._displacements, self._of_cells = torn.torn.at_cells(displacements)
        moves = None
        if linearised_at is not None:
            nodal = linearised_at.x.array.reshape(-1, torn.space.mesh.geometry.dim)
            moves = nodal[_compat.cell_dofs(torn.space)[cells]]
        self._moves = moves
        self.faces = CellFaces(torn.space, cells, moves)
        forms = torn.torn.forms
        self.neumann = NeumannProblems(
            self.faces,
            forms.bilinear.form,
            forms.linear.form,
            torn.compiler,
            self.is_linearised,
        )
        self._groups = self._in_groups()
        self.kinds = self._kinds()
        self.tractions = self._tractions()

    def u(self, rows: Numbers | slice) -> Vector:
        """Return the displacements (g, n, d) of some cells, zero at finite strains [m]."""
        u = self._displacements[self._of_cells[rows]]
        return np.zeros_like(u) if self.is_linearised else u

    def _total(self, rows: Numbers | slice, u: Vector) -> Vector:
        """Return the total displacements, at finite strains other ones."""
        return u if self._moves is None else self._moves[rows]

    def _kinds(self) -> FacetKinds:
        """Find what acts on facets. Collective."""
        faces, contact_set = self.faces, self.solved.contact_set
        self.surfaces = {
            entry.number: facets_of(faces, self.nodes, entry) for entry in contact_set.entries
        }
        exterior = exterior_facets(faces.space.mesh)[faces.facets]
        contact = np.zeros_like(exterior)
        for mask in self.surfaces.values():
            contact |= mask & exterior
        fixed = prescribed_components(self.nodes, contact_set.prescribed)
        fixed = over_ranks(self.nodes, fixed, np.logical_or)
        return FacetKinds.of(faces, self.nodes, contact, exterior, fixed)

    def _tractions(self) -> Tractions:
        """Find tractions in equilibrium. Collective."""
        own = own_moments(self.faces, self._stress())
        residual, rounding = self._forces()
        return equilibrated_tractions(self.faces, self.nodes, self.kinds, own, residual, rounding)

    def _stress(self) -> CellStress:
        """Return the stress of the torn displacements. Collective."""
        faces, forms = self.faces, self.torn.torn.forms
        W = _compat.lagrange_space(faces.space.mesh, faces.degree, faces.dim, discontinuous=True)
        w = Function(W)
        values, dofs = w.x.array.reshape(-1, faces.dim), _compat.cell_dofs(W)
        for batch in batches(faces.size, _CELLS):
            values[dofs[faces.cells[batch]]] = self.u(batch)
        points = faces.stress_rule.points.reshape(-1, faces.dim)
        return CellStress(forms.bilinear, forms.linear, w, points)

    def _forces(self) -> tuple[Vector, float]:
        """Return the forces L - a(u, .) (k, n, d) of each cell, and what rounding may make [N]."""
        faces, forms = self.faces, self.torn.torn.forms
        residual, rounding = np.zeros((*faces.nodes.shape, faces.dim)), 0.0
        for batch in batches(faces.size, _CELLS):
            cells, u = faces.cells[batch], self.u(batch)
            A, load = forms.cell_matrices(cells), forms.cell_loads(cells)
            number = np.arange(len(u), dtype=np.int32)
            subtract_internal(number, A, u.reshape(len(u), -1), load[:, :, None])
            residual[batch] = load.reshape(u.shape)
            total = np.abs(self._total(batch, u)).reshape(len(u), -1)
            sizes = np.zeros_like(load)
            subtract_internal(number, np.abs(A), total, sizes[:, :, None])
            rounding = max(rounding, -_ROUNDING * float(sizes.min(initial=0.0)))
        return residual, rounding

    def energies(self, steps: int = _STEPS) -> tuple[Vector, Vector]:
        """Return the squares (k, 2) of the errors after some steps, and energies (k,) [J].

        The squares are those with contact forces shared in two ways.
        """
        errors, energies = np.zeros((self.faces.size, 2)), np.zeros(self.faces.size)
        order, first = self._groups
        for begin, end in pairwise(first):
            rows = order[begin:end].astype(np.int64)
            u = self.u(rows)
            moments = self.tractions.of(rows)
            of_group = self.neumann.energies(rows, u, self._total(rows, u), moments)
            energies[rows] = of_group.solution
            errors[rows] = improved_energies(self.neumann, rows, self.kinds, of_group, steps)
        return errors, energies

    def gap_energies(self) -> Vector:
        """Return the energies (k, 2) of contact pressures over gaps [J]. Collective."""
        return gap_energies(self.faces, self.nodes, self.solved, self._is_exact)

    def _in_groups(self) -> tuple[Indices, Indices]:
        """Return the rows of cells, group by group of neighbours, and the first of each group.

        The matrices of a group are kept at once.
        """
        faces = self.faces
        count = -(-faces.size * self.neumann.bytes // _BYTES)
        if count <= 1:
            return np.arange(faces.size, dtype=np.int32), np.array([0, faces.size], dtype=np.int32)
        graph = self.torn.bodies.graph[faces.cells][:, faces.cells]
        label = cut_into_slabs(graph, faces.node_points(1).mean(axis=1), count)
        return ordered(label, int(label.max()) + 1)


def estimate_mesh_error(problem: MeshErrorProblem, iterations: float) -> MeshError:
    """Estimate the error of the mesh, beside that of the iterations. Collective."""
    comm, faces = problem.nodes.comm, problem.faces
    squares, energies = problem.energies()
    squares = np.maximum(squares, 0.0) + problem.gap_energies()
    # the better of two ways to share contact forces
    totals = comm.allreduce(squares.sum(axis=0))
    squares = squares[:, int(totals.argmin())]
    energy = comm.allreduce(energies.sum())
    cells = Function(_compat.lagrange_space(faces.space.mesh, 0, discontinuous=True))
    dofs = _compat.cell_dofs(cells.function_space)[faces.cells, 0]
    cells.x.array[dofs] = np.sqrt(squares)
    cells.x.scatter_forward()
    cells.name = "mesh_error"
    error = _ratio(totals.min(), energy)
    return MeshError(
        error,
        error + iterations,
        False,
        problem.is_linearised,
        _body_errors(comm, problem.torn.bodies, faces.cells, squares, energies),
        _contact_errors(problem, squares, energies),
        cells,
        float(np.sqrt(energy)),
        faces.space,
    )


def _ratio(squares: float, energy: float) -> float:
    return float(np.sqrt(squares / energy)) if energy > 0.0 else 0.0


def _body_errors(
    comm: MPI.Intracomm, bodies: Bodies, cells: Indices, squares: Vector, energies: Vector
) -> ByName[BodyMeshError]:
    """Return the errors of all deformable bodies. Collective."""
    body, count = bodies.of_cell[cells], bodies.deformable
    sums = np.array([np.bincount(body, values, count) for values in (squares, energies)])
    sums = comm.allreduce(sums)
    total = sums[1].sum()
    # the name of the cells alone, where no other body has it
    short = [label.partition("(")[2].rstrip(")") or label for label in bodies.labels[:count]]
    labels = zip(short, bodies.labels, strict=False)
    names = [name if short.count(name) == 1 else label for name, label in labels]
    return ByName(
        {
            name: BodyMeshError(_ratio(error, energy), _ratio(error, total))
            for name, error, energy in zip(names, *sums.tolist(), strict=True)
        }
    )


def _contact_errors(
    problem: MeshErrorProblem, squares: Vector, energies: Vector
) -> ByName[ContactMeshError]:
    """Return the errors at all contacts and ties. Collective."""
    solved, comm = problem.solved, problem.nodes.comm
    sums, largest = dict[int, Vector](), dict[int, float]()
    columns = np.stack([squares, energies])
    for number, mask in problem.surfaces.items():
        sums[number] = comm.allreduce(columns[:, mask.any(axis=1)].sum(axis=1))
    for found, result in zip(solved.contact_set.contacts, solved.contacts, strict=True):
        top = comm.allreduce(result.pressure.max(initial=0.0), MPI.MAX)
        if top <= max(0.0, largest.get(found.number, 0.0)):
            continue
        largest[found.number] = top
        marks = (result.pressure == top).astype(float)
        at_top = at_local_nodes(problem.nodes, result.dofs, marks)[problem.faces.nodes] > 0.0
        sums[-1 - found.number] = comm.allreduce(columns[:, at_top.any(axis=1)].sum(axis=1))
    names = {entry.number: entry.conditions.name for entry in solved.contact_set.entries}
    return ByName(
        {
            name: ContactMeshError(
                _ratio(*sums[number]),
                _ratio(*sums[-1 - number]) if -1 - number in sums else None,
            )
            for number, name in names.items()
        }
    )

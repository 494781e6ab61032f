"""The error of the mesh in the energy norm, by cell, body and contact.

Total FETI continued down to single cells: each cell is torn out, with tractions on its facets in
equilibrium. The energies of the cells' Neumann problems bound the distance to the solution of one
degree more; with the work of contact pressures over gaps they estimate the error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function, FunctionSpace

from fenics_tfeti.errors import InputError, check_value
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.mesh_error.bound import strict_bound
from fenics_tfeti.fem.mesh_error.contact import at_local_nodes
from fenics_tfeti.fem.mesh_error.faces import CellFaces
from fenics_tfeti.fem.mesh_error.problem import MeshErrorProblem
from fenics_tfeti.fem.mesh_error.tractions import over_ranks
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import owned_cells, vertex_nodes
from fenics_tfeti.fem.user_data import check_positive
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Indices, Vector

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
    reasons : sequence of str
        Why it is none, where one was asked for.
    remarks : sequence of str
        Where it is too small, with degree 2: by a factor of up to two at curved surfaces in
        contact, and of up to five where the gap to an obstacle jumps.
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
    reasons: Sequence[str]
    remarks: Sequence[str]
    linearised: bool
    bodies: Mapping[str, BodyMeshError]
    contacts: Mapping[str, ContactMeshError]

    def __str__(self) -> str:
        """Return the errors as a line to read."""
        of = " of the linearised problem" if self.linearised else ""
        how = "at most" if self.guaranteed else "about"
        text = f"{how} {_percent(self.error)} % in the energy norm{of}"
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
        text += "".join(f"; {remark}" for remark in self.remarks)
        if self.reasons:
            text += f"; no bound: {', '.join(self.reasons)}"
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
    reasons : sequence of str
        Why it is none, where one was asked for.
    remarks : sequence of str
        Where it is too small, with degree 2: by a factor of up to two at curved surfaces in
        contact, and of up to five where the gap to an obstacle jumps.
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
    reasons: Sequence[str]
    remarks: Sequence[str]
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
            self.reasons,
            self.remarks,
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


def estimate_mesh_error(
    problem: MeshErrorProblem, iterations: float, bound: bool = False
) -> MeshError:
    """Estimate, or bound, the error of the mesh, beside that of the iterations. Collective."""
    comm, faces = problem.nodes.comm, problem.faces
    strict = strict_bound(problem) if bound else None
    if strict is not None and not strict.reasons:
        squares, energies, correction = strict.squares, strict.energies, strict.correction
        total = comm.allreduce(squares.sum())
    else:
        of_ways, energies = problem.energies()
        of_ways = np.maximum(of_ways, 0.0) + problem.gap_energies()
        # the better of two ways to share contact forces
        totals = comm.allreduce(of_ways.sum(axis=0))
        squares, total, correction = of_ways[:, int(totals.argmin())], totals.min(), 0.0
    energy = comm.allreduce(energies.sum())
    cells = Function(_compat.lagrange_space(faces.space.mesh, 0, discontinuous=True))
    dofs = _compat.cell_dofs(cells.function_space)[faces.cells, 0]
    cells.x.array[dofs] = np.sqrt(squares)
    cells.x.scatter_forward()
    cells.name = "mesh_error"
    error = _ratio((np.sqrt(total) + correction) ** 2, energy)
    guaranteed = strict is not None and not strict.reasons
    return MeshError(
        error,
        # the bound has the error of the iterations
        error if guaranteed else error + iterations,
        guaranteed,
        strict.reasons if strict is not None else (),
        problem.remarks(),
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

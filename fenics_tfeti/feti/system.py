"""The torn problem (11.21): the input of the Total FETI solver."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from fenics_tfeti.errors import InputError
from fenics_tfeti.typing import Array, Mask, Numbers, Vector

Kernel = Literal["rigid", "translations"]


@dataclass(frozen=True)
class Subdomain:
    """One torn subdomain: K_i, f_i, and the nodes that glue it to others.

    The displacements of a node are consecutive: unknown ``gdim * node + component``.

    Attributes
    ----------
    stiffness : (n, n) scipy.sparse.csr_matrix
        K_i, symmetric [N/m]; positive semidefinite, unless the kernel is "translations". Entries
        are sorted in place if they are not.
    load : (n,) array
        f_i [N].
    coordinates : (nodes, gdim) array
        [m].
    nodes : (nodes,) integer array
        Global node numbers, distinct within the subdomain; equal numbers are glued.
    body : int
        The body that the subdomain is a part of; bodies are numbered 0, 1, ... without gaps. A
        body's subdomains have to be glued so that they can only move rigidly together, as those
        of meshes connected by facets are.
    frame : (gdim, gdim) array, optional
        Orthogonal matrix T if `stiffness` is not K_i but K' with K_i = T K' T', T at each node:
        subdomains that are rotated or mirrored images of each other share K' and its factor. Loads,
        coordinates and displacements are not turned.
    kernel : {"rigid", "translations"} or (n, k) array
        Motions that K_i does not resist, but for elastic supports: all rigid ones, as in linear
        elasticity, or translations and those rotations for which K_i is zero. The latter is for
        tangents of finite strains, which may be indefinite: the stress of a torn subdomain resists
        rotations, or drives them. See `prepare_tangents`. An array is for rigid bodies, see
        `Subdomain.rigid`.
    load_size : (n,) array, optional
        Size of the forces whose sum the load is, which its rounding is relative to: ``|f_i|`` by
        default, stresses where the load is what they leave out of balance [N].
    """

    stiffness: sp.csr_matrix
    load: Vector
    coordinates: Vector
    nodes: Numbers
    body: int
    frame: Vector | None = None
    kernel: Kernel | Vector = "rigid"
    load_size: Vector | None = None

    @staticmethod
    def rigid(
        load: ArrayLike,
        coordinates: ArrayLike,
        nodes: ArrayLike,
        body: int,
        kernel: ArrayLike | None = None,
    ) -> Subdomain:
        """Return a rigid body: a subdomain without stiffness that moves in its kernel alone.

        Its generalized inverse is zero, u_i = R_i alpha_i. A few nodes are enough, as rows can name
        them with the coefficients of any other point.

        Parameters
        ----------
        load : (gdim * nodes,) array-like
            f_i; resultant and moment alone matter [N].
        coordinates : (nodes, gdim) array-like
            [m].
        nodes : (nodes,) integers
            Global node numbers.
        body : int
            The body.
        kernel : (gdim * nodes, k) array-like, optional
            Independent rigid motions of the nodes: those that are free; all of them by default.
        """
        f = np.asarray(load, dtype=np.float64)
        motions: Kernel | Vector = (
            "rigid" if kernel is None else np.asarray(kernel, dtype=np.float64)
        )
        nothing = sp.csr_matrix((f.size, f.size))
        return Subdomain(
            nothing, f, np.asarray(coordinates), np.asarray(nodes), body, None, motions
        )

    @property
    def is_rigid(self) -> bool:
        """Whether the stiffness has no entry."""
        return bool(self.stiffness.nnz == 0)

    @property
    def is_unknown(self) -> bool:
        """Whether it is one unknown of rows, a node with one motion: its load is internal."""
        return (
            self.nodes.size == 1 and not isinstance(self.kernel, str) and self.kernel.shape[1] == 1
        )

    @property
    def is_tangent(self) -> bool:
        """Whether the kernel is that of a tangent of finite strains."""
        return isinstance(self.kernel, str) and self.kernel == "translations"

    def has_kernel_of(self, other: Subdomain) -> bool:
        """Tell whether the kernels are described alike."""
        return bool(np.array_equal(self.kernel, other.kernel))

    def __post_init__(self) -> None:
        """Convert lists and other types of numbers to arrays; sort the entries of K."""
        _convert(self, load=np.float64, coordinates=np.float64, nodes=np.int64)
        for name in ("frame", "load_size"):
            if getattr(self, name) is not None:
                _convert(self, **{name: np.float64})
        _set(self, "body", _integer(self.body))
        K = self.stiffness
        if sp.issparse(K) and K.format == "csr":
            # read-only arrays are left to the check
            with suppress(ValueError):
                K.sum_duplicates()

    @property
    def size_of_load(self) -> Vector:
        """The size of the forces whose sum the load is [N]."""
        return np.abs(self.load) if self.load_size is None else self.load_size

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.load.size)

    def stiffness_times(self, u: Vector, transposed: bool = False) -> Vector:
        """Return K_i u or K_i'u, whatever the frame of the stiffness [N]."""
        stiffness = self.stiffness.T if transposed else self.stiffness
        if self.frame is None:
            return np.asarray(stiffness @ u)
        turned = (u.reshape(-1, len(self.frame)) @ self.frame).ravel()
        return ((stiffness @ turned).reshape(-1, len(self.frame)) @ self.frame.T).ravel()

    @property
    def coordinates_in_frame(self) -> Vector:
        """Coordinates in the frame of the stiffness [m]."""
        return self.coordinates if self.frame is None else self.coordinates @ self.frame


@dataclass(frozen=True)
class Prescribed:
    """Prescribed displacements: component ``components[k]`` of node ``nodes[k]`` is ``values[k]``.

    Attributes
    ----------
    nodes, components : (k,) integer arrays
        Global node numbers and components.
    values : (k,) array
        [m].
    condition : (k,) integer array, optional
        Number of the Dirichlet condition that each is from, for the reactions; 0 by default. Of
        several conditions for one displacement the one with the largest number counts.
    """

    nodes: Numbers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    components: Numbers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    values: Vector = field(default_factory=lambda: np.zeros(0))
    condition: Numbers | None = None

    def __post_init__(self) -> None:
        """Convert lists and other types of numbers to arrays."""
        _convert(self, nodes=np.int64, components=np.int64, values=np.float64)
        if self.condition is None:
            _set(self, "condition", np.zeros(np.shape(self.nodes), dtype=np.int64))
        _convert(self, condition=np.int64)


@dataclass(frozen=True)
class ContactRows:
    """Conditions sum_k c_k'u(node_k) <= gap: linearised non-penetration (11.1), (11.7).

    The first term of each row is the slave node's; further nodes of the slave follow, then those of
    the master. The sum of the slave's coefficients has the direction of the row's unit normal n,
    outward from the slave's body, and any length D > 0: the area that belongs to the node in a
    mortar row, 1 where a node touches a node or an obstacle. The gap is in the same unit, so
    gap / D is a distance, and D times the multiplier of the row is the normal force.

    Attributes
    ----------
    offsets : (rows + 1,) integer array
        The terms of row i are those from ``offsets[i]`` up to, without, ``offsets[i + 1]``; each
        row has one at least.
    nodes : (terms,) integer array
        Global node numbers, distinct among a row's slave nodes and among its master nodes. A node
        that is both, as the tip of a crack, counts with both coefficients.
    coefficients : (terms, gdim) array
        c_k.
    gap : (rows,) array
        [m] times the unit of the coefficients; infinite where there is nothing to touch: such a row
        is left out.
    contact : (rows,) integer array
        Number of the contact that the row belongs to, for the sums of forces.
    slaves : (rows,) integer array, optional
        How many of the row's terms, from the first on, are those of the slave's nodes; by default
        1.
    area : (rows,) array, optional
        Area of the slave's surface that belongs to the row, by default D; NaN stands for D. Rows
        that are the same condition share its force by these areas.
    held : (rows,) bool array, optional
        Contact rows that hold with equality, whatever the sign of their force: those of a face of
        the contact problem, in the steps of Newton's method. None by default.
    compliance : (rows, 2) array, optional
        Springs between the surfaces of contact rows: how far a unit of force closes the row where
        it presses, and opens it where it pulls [m/N]. Zero is rigid, infinity in the second column
        lets surfaces come apart: 0 and infinity, the default, are those of contact. The force of a
        row is that of its node; gaps are counted from ``gap``. A spring of less than 1e-12 of the
        stiffness of a node is none.
    adhesion : (rows,) array, optional
        Force that contact rows without springs can pull with before the surfaces come apart [N]: it
        acts where they are apart, too. 0 by default.

    Examples
    --------
    Node 0 over the middle of an edge between the nodes 1 and 2, with a gap of 0.1 m.

    >>> rows = ContactRows(
    ...     offsets=[0, 3],
    ...     nodes=[0, 1, 2],
    ...     coefficients=[[0.0, -2.0], [0.0, 1.0], [0.0, 1.0]],
    ...     gap=[0.2],
    ...     contact=[0],
    ... )
    >>> rows.slave.tolist(), rows.normal.tolist(), (rows.gap / rows.length).tolist()
    ([0], [[0.0, -1.0]], [0.1])
    """

    offsets: Numbers
    nodes: Numbers
    coefficients: Vector
    gap: Vector
    contact: Numbers
    slaves: Numbers | None = None
    area: Vector | None = None
    held: Mask | None = None
    compliance: Vector | None = None
    adhesion: Vector | None = None

    def __post_init__(self) -> None:
        """Convert lists and other types of numbers to arrays."""
        if self.held is None:
            _set(self, "held", np.zeros(np.shape(self.gap), dtype=bool))
        if self.compliance is None:
            _set(self, "compliance", np.tile([0.0, np.inf], (*np.shape(self.gap), 1)))
        if self.adhesion is None:
            _set(self, "adhesion", np.zeros(np.shape(self.gap)))
        if self.slaves is None:
            _set(self, "slaves", np.ones(np.shape(self.gap), dtype=np.int64))
        if self.area is None:
            _set(self, "area", np.full(np.shape(self.gap), np.nan))
        _convert(self, offsets=np.int64, nodes=np.int64, contact=np.int64, slaves=np.int64)
        _convert(self, coefficients=np.float64, gap=np.float64, area=np.float64, held=np.bool_)
        _convert(self, compliance=np.float64, adhesion=np.float64)

    @staticmethod
    def none(gdim: int) -> ContactRows:
        """Return no rows."""
        empty = np.zeros(0, dtype=np.int64)
        start = np.zeros(1, dtype=np.int64)
        return ContactRows(start, empty, np.zeros((0, gdim)), np.zeros(0), empty)

    @staticmethod
    def node_to_node(
        slave: ArrayLike,
        master: ArrayLike,
        normal: ArrayLike,
        gap: ArrayLike,
        contact: ArrayLike,
    ) -> ContactRows:
        """Return the conditions (u_slave - u_master)'n <= gap of pairs of nodes.

        Parameters
        ----------
        slave : (k,) integers
            Global node numbers.
        master : (k,) integers
            Global node numbers; -1 for a rigid obstacle.
        normal : (k, gdim) array-like
            Normals n, outward from the slave's body; they are divided by their lengths.
        gap : (k,) array-like
            [m].
        contact : (k,) integers
            Number of the contact of each row.

        Raises
        ------
        InputError
            On this rank, if the shapes do not fit.
        """
        n = np.asarray(normal, dtype=np.float64)
        slaves, masters = np.asarray(slave), np.asarray(master)
        if n.ndim != 2 or (len(n),) != slaves.shape or (len(n),) != masters.shape:
            raise InputError(
                f"contact rows from node to node: got slaves of shape {slaves.shape}, masters of "
                f"shape {masters.shape} and normals of shape {n.shape}, expected (k,), (k,) and "
                "(k, gdim). Give one of each for every row"
            )
        ends = np.column_stack([slaves, masters])
        lengths = np.linalg.norm(n, axis=1, keepdims=True)
        n = n / np.where(lengths > 0.0, lengths, 1.0)
        exists = ends != -1
        exists[:, 0] = True
        offsets = np.append(0, np.cumsum(exists.sum(axis=1)))
        coefficients = np.stack([n, -n], axis=1)[exists]
        return ContactRows(
            offsets, ends[exists], coefficients, np.asarray(gap), np.asarray(contact)
        )

    @staticmethod
    def concatenate(parts: Sequence[ContactRows]) -> ContactRows:
        """Return the rows of all parts, one part after the other."""
        if len(parts) == 1:
            return parts[0]
        terms = np.concatenate([np.diff(part.offsets) for part in parts])
        return ContactRows(
            np.append(0, np.cumsum(terms)),
            np.concatenate([part.nodes for part in parts]),
            np.concatenate([part.coefficients for part in parts]),
            np.concatenate([part.gap for part in parts]),
            np.concatenate([part.contact for part in parts]),
            np.concatenate([np.asarray(part.slaves) for part in parts]),
            np.concatenate([np.asarray(part.area) for part in parts]),
            np.concatenate([np.asarray(part.held) for part in parts]),
            np.concatenate([np.asarray(part.compliance) for part in parts]),
            np.concatenate([np.asarray(part.adhesion) for part in parts]),
        )

    def chosen(self, rows: Numbers) -> ContactRows:
        """Return the rows at some positions."""
        terms = np.diff(self.offsets)[rows]
        offsets = np.append(0, np.cumsum(terms))
        positions = np.repeat(self.offsets[rows] - offsets[:-1], terms) + np.arange(offsets[-1])
        return ContactRows(
            offsets,
            self.nodes[positions],
            self.coefficients[positions],
            self.gap[rows],
            self.contact[rows],
            np.asarray(self.slaves)[rows],
            np.asarray(self.area)[rows],
            np.asarray(self.held)[rows],
            np.asarray(self.compliance)[rows],
            np.asarray(self.adhesion)[rows],
        )

    def with_terms(self, row: Numbers, nodes: Numbers, coefficients: Vector) -> ContactRows:
        """Return the rows with further terms (t,), the last ones of their rows."""
        order = np.argsort(np.append(self.row, row), kind="stable")
        number = np.diff(self.offsets) + np.bincount(row, minlength=self.size)
        return replace(
            self,
            offsets=np.append(0, np.cumsum(number)),
            nodes=np.append(self.nodes, nodes)[order],
            coefficients=np.concatenate([self.coefficients, coefficients])[order],
        )

    def with_slave_terms(self, row: Numbers, nodes: Numbers, coefficients: Vector) -> ContactRows:
        """Return the rows with terms (t,) at nodes of their slaves added to those there are."""
        row, nodes = np.append(self.row, row), np.append(self.nodes, nodes)
        coefficients = np.concatenate([self.coefficients, coefficients])
        on_master = np.append(~self.on_slave, np.zeros(row.size - self.row.size, dtype=bool))
        order = np.lexsort((nodes, nodes != self.slave[row], on_master, row))
        row, nodes, on_master = row[order], nodes[order], on_master[order]
        is_first = np.diff(row, prepend=-1) | np.diff(nodes, prepend=-1) != 0
        first = np.flatnonzero(is_first)
        if not first.size:
            return self
        row, on_master = row[first], on_master[first]
        return replace(
            self,
            offsets=np.append(0, np.cumsum(np.bincount(row, minlength=self.size))),
            nodes=nodes[first],
            coefficients=np.add.reduceat(coefficients[order], first, axis=0),
            slaves=np.bincount(row[~on_master], minlength=self.size),
        )

    @property
    def size(self) -> int:
        """Number of rows."""
        return int(self.gap.size)

    @property
    def row(self) -> Numbers:
        """The row of each term, (terms,)."""
        return rows_of_terms(self.offsets)

    @property
    def slave(self) -> Numbers:
        """The slave node of each row, (rows,)."""
        return self.nodes[self.offsets[:-1]]

    @property
    def has_springs(self) -> Mask:
        """Whether each row has a spring, (rows,)."""
        return (np.asarray(self.compliance) != [0.0, np.inf]).any(axis=1)

    @property
    def on_slave(self) -> NDArray[np.bool_]:
        """Whether each term is that of a slave node, (terms,)."""
        return terms_of_slaves(self.offsets, np.asarray(self.slaves))

    @cached_property
    def length(self) -> Vector:
        """The length D of the sum of the slave's coefficients in each row, (rows,)."""
        return np.linalg.norm(self._sum_of_slave, axis=1)

    @cached_property
    def normal(self) -> Vector:
        """The unit normal of each row, (rows, gdim)."""
        return self._sum_of_slave / self.length[:, None]

    @cached_property
    def _sum_of_slave(self) -> Vector:
        of_slave = np.where(self.on_slave[:, None], self.coefficients, 0.0)
        return sum_by_row(self.row, of_slave, self.size)


@dataclass(frozen=True)
class Friction:
    """Friction at some of this rank's contact rows: with a given bound (Tresca), or Coulomb's.

    The tangential force at such a row is at most the bound plus the coefficient times the normal
    force. Below it nothing slips; at it the slave slips along its force on the master. The slip is
    that of the nodes of the row, with the weights of the row, and counted from `slip`: in a
    sequence of loads, from the last step.

    Attributes
    ----------
    row : (k,) integer array
        Position of each among the contact rows of this rank, ascending.
    tangents : (k, gdim - 1, gdim) array
        Orthonormal, and orthogonal to the normal of the row. Where the same component is prescribed
        at all nodes of a row, each is along or across it, in three dimensions.
    bound : (k,) array
        Slip bound [N]: the tangential force at which the node slips; infinite, with a compliance,
        for a spring along the surface.
    slip : (k, gdim - 1) array, optional
        Tangential displacement of the slave relative to the master, in the directions of the
        tangents, from which slip is counted [m]; 0 by default.
    coefficient : (k,) array, optional
        Coefficient of friction (Coulomb); 0 by default.
    compliance : (k,) array, optional
        Elastic slip: slip over tangential force below the bound [m/N]; 0 by default. What slips
        beyond it stays when the force is taken away: in a sequence of loads that part of the slip,
        without the elastic one, is counted from.

    Examples
    --------
    >>> Friction(row=[0], tangents=[[[1.0, 0.0]]], bound=[2.0]).slip.tolist()
    [[0.0]]
    """

    row: Numbers
    tangents: Vector
    bound: Vector
    slip: Vector | None = None
    coefficient: Vector | None = None
    compliance: Vector | None = None

    def __post_init__(self) -> None:
        """Convert lists and other types of numbers to arrays."""
        _convert(self, row=np.int64, tangents=np.float64, bound=np.float64)
        if self.slip is None:
            _set(self, "slip", np.zeros(np.shape(self.tangents)[:2]))
        if self.coefficient is None:
            _set(self, "coefficient", np.zeros(np.shape(self.bound)))
        if self.compliance is None:
            _set(self, "compliance", np.zeros(np.shape(self.bound)))
        _convert(self, slip=np.float64, coefficient=np.float64, compliance=np.float64)

    @staticmethod
    def none(gdim: int) -> Friction:
        """Return no friction."""
        empty = np.zeros(0, dtype=np.int64)
        return Friction(empty, np.zeros((0, gdim - 1, gdim)), np.zeros(0))

    @property
    def size(self) -> int:
        """Number of rows with friction."""
        return int(self.bound.size)

    def tangential_rows(self, contacts: ContactRows) -> ContactRows:
        """Return sum_k (c_k'n) t'u(node_k) = D slip for each tangent t, row by row.

        Parameters
        ----------
        contacts : ContactRows
            The contact rows of this rank, with normals n and lengths D.
        """
        directions = self.tangents.shape[1]
        rows = contacts.chosen(np.repeat(self.row, directions))
        weight = np.sum(rows.coefficients * rows.normal[rows.row], axis=1)
        tangents = self.tangents.reshape(-1, self.tangents.shape[2])
        coefficients = weight[:, None] * tangents[rows.row]
        gap = rows.length * np.asarray(self.slip).ravel()
        return ContactRows(rows.offsets, rows.nodes, coefficients, gap, rows.contact, rows.slaves)


@dataclass(frozen=True)
class ContactGuess:
    """Expected force and gap of each contact row of this rank, such as those of a coarser mesh.

    A row is active at first if the force is more than what closes the gap against the stiffness of
    its nodes alone; near the edge of a contact, a guess may have both a force and a gap.

    Attributes
    ----------
    normal_force : (k,) array
        Nodal normal forces [N].
    gap : (k,) array
        Remaining gaps [m]; infinite where nothing is known.
    """

    normal_force: Vector
    gap: Vector

    def __post_init__(self) -> None:
        """Convert lists and other types of numbers to arrays."""
        _convert(self, normal_force=np.float64, gap=np.float64)


@dataclass(frozen=True)
class TornSystem:
    """The torn problem (11.21), each rank with its own subdomains.

    Attributes
    ----------
    subdomains : sequence of Subdomain
        The subdomains of this rank.
    prescribed : Prescribed
        Prescribed displacements; several ranks may give the same one.
    contacts : ContactRows
        Contact rows; each row is given by one rank, which need not hold its nodes.
    gdim : int
        2 or 3.
    body_names : sequence of str
        Names of the bodies for messages, by number.
    contact_names : sequence of str
        Names of the contacts, by number.
    comm : MPI.Intracomm
        The ranks.
    condition_names : sequence of str
        Names of the Dirichlet conditions, by number.
    tied : ContactRows, optional
        The same rows as equalities sum_k c_k'u(node_k) = gap: surfaces that stay together. A slave
        node has as many rows as components; the direction of the slave's sum is any, its length the
        node's area. Contacts and tied pairs are numbered together. None by default.
    friction : Friction, optional
        At which contact rows there is friction. None by default.
    """

    subdomains: Sequence[Subdomain]
    prescribed: Prescribed
    contacts: ContactRows
    gdim: int
    body_names: Sequence[str] = ()
    contact_names: Sequence[str] = ()
    comm: MPI.Intracomm = field(default_factory=lambda: MPI.COMM_SELF)
    condition_names: Sequence[str] = ()
    tied: ContactRows = field(default_factory=lambda: ContactRows.none(0))
    friction: Friction = field(default_factory=lambda: Friction.none(1))

    @property
    def nodes(self) -> Numbers:
        """The global node number of each copy of a node, subdomain by subdomain."""
        none = np.zeros(0, dtype=np.int64)
        return np.concatenate([none, *(s.nodes for s in self.subdomains)])

    @property
    def coordinates(self) -> Vector:
        """The coordinates of the copies, (copies, gdim) [m]."""
        none = np.zeros((0, self.gdim))
        return np.concatenate([none, *(s.coordinates for s in self.subdomains)])

    @property
    def bodies(self) -> Numbers:
        """The body of each subdomain."""
        return np.array([s.body for s in self.subdomains], dtype=np.int64)

    def at_copies(self, of_subdomains: Array) -> Array:
        """Return a value (subdomains,) of each subdomain at its copies of nodes, (copies,)."""
        sizes = np.array([s.nodes.size for s in self.subdomains], dtype=np.int64)
        return np.repeat(of_subdomains, sizes)

    def chosen_copies(self, chosen: Mask) -> tuple[Numbers, Vector]:
        """Return the numbers and coordinates (k, gdim) of some of the copies (copies,) of nodes."""
        ends = np.cumsum([s.nodes.size for s in self.subdomains])
        parts = (
            list(zip(self.subdomains, np.split(chosen, ends[:-1]), strict=True))
            if ends.size
            else []
        )
        nodes = [np.zeros(0, dtype=np.int64), *(s.nodes[part] for s, part in parts)]
        x = [np.zeros((0, self.gdim)), *(s.coordinates[part] for s, part in parts)]
        return np.concatenate(nodes), np.concatenate(x)

    def body_name(self, body: int) -> str:
        """Return the name of a body."""
        has_name = isinstance(body, int | np.integer) and 0 <= body < len(self.body_names)
        return self.body_names[body] if has_name else f"body {body}"

    def contact_name(self, contact: int) -> str:
        """Return the name of a contact or tied pair."""
        names = self.contact_names
        return names[contact] if contact < len(names) else f"contact {contact}"

    def __post_init__(self) -> None:
        """Check the communicator, without which no error reaches the other ranks.

        `InputError` is raised on this rank.
        """
        if not isinstance(self.comm, MPI.Intracomm) or self.comm == MPI.COMM_NULL:
            raise InputError(f"comm: got {self.comm!r}, expected an intracommunicator of mpi4py")
        _set(self, "gdim", _integer(self.gdim))
        if isinstance(self.tied, ContactRows) and np.shape(self.tied.coefficients) == (0, 0):
            # the default
            _set(self, "tied", ContactRows.none(self.gdim if isinstance(self.gdim, int) else 0))
        if isinstance(self.friction, Friction) and np.shape(self.friction.tangents) == (0, 0, 1):
            _set(self, "friction", Friction.none(self.gdim if isinstance(self.gdim, int) else 1))


def rows_of_terms(offsets: Numbers) -> Numbers:
    """Return the row of each term of sparse rows, (terms,); the offsets are (rows + 1,)."""
    return np.repeat(np.arange(offsets.size - 1), np.diff(offsets))


def sum_by_row(row: Numbers, values: Vector, size: int) -> Vector:
    """Sum the values (terms, k) of terms by their row, (size, k)."""
    sums = [np.bincount(row, column, size) for column in values.T]
    return np.stack(sums, axis=1).astype(np.float64, copy=False)


def terms_of_slaves(offsets: Numbers, slaves: Numbers) -> NDArray[np.bool_]:
    """Tell of which terms the nodes are slaves, (terms,): the first ones (rows,) of each row."""
    row = rows_of_terms(offsets)
    return np.arange(row.size) - offsets[row] < slaves[row]


def node_graph(stiffness: sp.csr_matrix, gdim: int) -> sp.csr_matrix:
    """Return the adjacency matrix of a subdomain's nodes from the pattern of its stiffness matrix.

    It has ones, also on the diagonal; K_i is (gdim * nodes, gdim * nodes).
    """
    blocks = stiffness.tobsr(blocksize=(gdim, gdim))
    ones = np.ones(blocks.indices.size)
    nodes = stiffness.shape[0] // gdim
    return sp.csr_matrix((ones, blocks.indices, blocks.indptr), shape=(nodes, nodes))


@dataclass(frozen=True)
class RowValues:
    """Values of the conditions that this rank gave."""

    normal: Vector  # (contact rows,)
    tangential: Vector  # (sites, gdim - 1), along the tangents
    tied: Vector  # (tied rows,)

    def plus(self, factor: float, other: RowValues) -> RowValues:
        """Return the sum with a multiple of others."""
        return RowValues(
            self.normal + factor * other.normal,
            self.tangential + factor * other.tangential,
            self.tied + factor * other.tied,
        )

    @staticmethod
    def zeros(system: TornSystem) -> RowValues:
        """Return zeros for the conditions of a system."""
        sites = system.friction.size, system.gdim - 1
        return RowValues(
            np.zeros(system.contacts.size), np.zeros(sites), np.zeros(system.tied.size)
        )


# kinds of NumPy's types that are converted to a type
_KINDS: dict[type[np.generic], str] = {np.int64: "i", np.float64: "iuf", np.bool_: "b"}


def _convert(part: Any, **dtypes: type[np.generic]) -> None:
    """Convert lists to arrays, integers to int64, integers and shorter floats to float64.

    Fields with other numbers are left to the check, and arrays of the right type as they are.
    """
    for name, dtype in dtypes.items():
        given = getattr(part, name)
        if isinstance(given, np.ndarray) and given.dtype == dtype:
            continue
        try:
            values = np.asarray(given)
        except ValueError:
            continue
        integers = issubclass(dtype, np.integer)
        if values.size == 0 and values.dtype == np.float64:
            # an empty list
            values = values.astype(dtype)
        elif values.dtype.kind in _KINDS[dtype] and values.dtype.itemsize <= 8:
            values = values.astype(dtype, copy=False)
        elif integers and values.dtype.kind == "u" and values.dtype.itemsize < 8:
            values = values.astype(dtype)
        if values.dtype == dtype:
            _set(part, name, values)


def _integer(value: Any) -> Any:
    """Return integers of any kind as int, other values as they are."""
    return int(value) if isinstance(value, np.integer) else value


def _set(part: Any, name: str, value: Any) -> None:
    """Set a field of a frozen data class while it is being made."""
    object.__setattr__(part, name, value)


def are_same(subdomains: Sequence[Subdomain], others: Sequence[Subdomain]) -> bool:
    """Tell whether subdomains have the same matrices, nodes and bodies."""
    return len(subdomains) == len(others) and all(
        np.array_equal(s.nodes, t.nodes)
        and np.array_equal(s.coordinates, t.coordinates)
        and s.body == t.body
        and s.has_kernel_of(t)
        and (s.stiffness != t.stiffness).nnz == 0
        for s, t in zip(subdomains, others, strict=True)
    )

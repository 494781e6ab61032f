"""The torn problem (11.21): the input of the Total FETI solver."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.errors import InputError

__all__ = ["ContactGuess", "ContactRows", "Prescribed", "Subdomain", "TornSystem"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class Subdomain:
    """One torn subdomain: K_i, f_i, and the nodes that glue it to others.

    The displacements of a node are consecutive: unknown ``gdim * node + component``.

    Attributes
    ----------
    stiffness : (n, n) scipy.sparse.csr_matrix
        K_i, symmetric positive semidefinite [N/m]; entries are sorted in place if they are not.
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
    """

    stiffness: sp.csr_matrix
    load: Vector
    coordinates: Vector
    nodes: Numbers
    body: int

    def __post_init__(self) -> None:
        """Convert lists and other types of numbers to arrays; sort the entries of K."""
        _convert(self, load=np.float64, coordinates=np.float64, nodes=np.int64)
        _set(self, "body", _integer(self.body))
        K = self.stiffness
        if sp.issparse(K) and K.format == "csr":
            # read-only arrays are left to the check
            with suppress(ValueError):
                K.sum_duplicates()

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.load.size)


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
    """Linearised non-penetration (u_slave - u_master)'n <= gap, (11.1), (11.7).

    Attributes
    ----------
    slave : (k,) integer array
        Global node numbers.
    master : (k,) integer array
        Global node numbers; -1 for a rigid obstacle.
    normal : (k, gdim) array
        Unit normals n, outward from the slave's body.
    gap : (k,) array
        [m]; infinite where there is nothing to touch: such a row is left out.
    contact : (k,) integer array
        Number of the contact that the row belongs to, for the sums of forces.
    """

    slave: Numbers
    master: Numbers
    normal: Vector
    gap: Vector
    contact: Numbers

    def __post_init__(self) -> None:
        """Convert lists and other types of numbers to arrays."""
        _convert(self, slave=np.int64, master=np.int64, contact=np.int64)
        _convert(self, normal=np.float64, gap=np.float64)

    @staticmethod
    def none(gdim: int) -> ContactRows:
        """Return no rows."""
        empty = np.zeros(0, dtype=np.int64)
        return ContactRows(empty, empty, np.zeros((0, gdim)), np.zeros(0), empty)


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
    """

    subdomains: Sequence[Subdomain]
    prescribed: Prescribed
    contacts: ContactRows
    gdim: int
    body_names: Sequence[str] = ()
    contact_names: Sequence[str] = ()
    comm: MPI.Intracomm = field(default_factory=lambda: MPI.COMM_SELF)
    condition_names: Sequence[str] = ()

    def body_name(self, body: int) -> str:
        """Return the name of a body."""
        known = isinstance(body, int | np.integer) and 0 <= body < len(self.body_names)
        return self.body_names[body] if known else f"body {body}"

    def __post_init__(self) -> None:
        """Check the communicator, without which no error reaches the other ranks.

        Raises
        ------
        InputError
            On this rank.
        """
        if not isinstance(self.comm, MPI.Intracomm) or self.comm == MPI.COMM_NULL:
            raise InputError(f"comm: got {self.comm!r}, expected an intracommunicator of mpi4py")
        _set(self, "gdim", _integer(self.gdim))


def _convert(part: Any, **dtypes: type[np.generic]) -> None:
    """Convert fields that hold the right numbers in another form; leave others to the check.

    Lists become arrays, integers int64, integers and shorter floating point numbers float64. An
    array of the right type stays the same object.
    """
    for name, dtype in dtypes.items():
        try:
            values = np.asarray(getattr(part, name))
        except ValueError:
            continue
        integers = issubclass(dtype, np.integer)
        if values.size == 0 and values.dtype == np.float64:
            # an empty list
            values = values.astype(dtype)
        elif values.dtype.kind in ("i" if integers else "iuf") and values.dtype.itemsize <= 8:
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

"""The torn problem (11.21): all that the TFETI solver is given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti.tolerances import SYMMETRIC
from fenics_tfeti.parallel import raise_collectively

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
        K_i, symmetric positive semidefinite [N/m].
    load : (n,) array
        f_i [N].
    coordinates : (nodes, gdim) array
        [m].
    nodes : (nodes,) integer array
        Global node numbers, distinct within the subdomain; equal numbers are glued.
    body : int
        The body that the subdomain is a part of. A body's subdomains must be glued so that they can
        only move rigidly together (face-connected meshes are).
    """

    stiffness: sp.csr_matrix
    load: Vector
    coordinates: Vector
    nodes: Numbers
    body: int

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
    """

    nodes: Numbers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    components: Numbers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    values: Vector = field(default_factory=lambda: np.zeros(0))


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
        [m].
    contact : (k,) integer array
        Number of the contact that the row belongs to, for the sums of forces.
    """

    slave: Numbers
    master: Numbers
    normal: Vector
    gap: Vector
    contact: Numbers

    @staticmethod
    def none(gdim: int) -> ContactRows:
        """Return no rows."""
        empty = np.zeros(0, dtype=np.int64)
        return ContactRows(empty, empty, np.zeros((0, gdim)), np.zeros(0), empty)


@dataclass(frozen=True)
class ContactGuess:
    """What is expected of each contact row that this rank gives, such as on a coarser mesh.

    A row counts as pressing if the force is more than what would close the gap against the
    stiffness of its nodes alone. Near the edge of a contact, where a guess has a bit of both, that
    says on which side of it a row is.

    Attributes
    ----------
    normal_force : (k,) array
        Nodal normal forces [N].
    gap : (k,) array
        Gaps that remain [m]; infinite where nothing is known.
    """

    normal_force: Vector
    gap: Vector

    def check(self, rows: int) -> None:
        """Check shapes and numbers; `rows` is how many contact rows this rank gives.

        Raises
        ------
        InputError
            On this rank, with what is wrong.
        """
        for what, values in (("normal forces", self.normal_force), ("gaps", self.gap)):
            if np.shape(values) != (rows,):
                raise InputError(
                    f"{what} of the contact guess have shape {np.shape(values)}, expected "
                    f"({rows},): one for each contact row of this rank"
                )
        _check_finite("normal forces of the contact guess", self.normal_force)
        if np.isnan(self.gap).any():
            raise InputError(
                f"gaps of the contact guess: {np.count_nonzero(np.isnan(self.gap))} are NaN"
            )


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
    """

    subdomains: Sequence[Subdomain]
    prescribed: Prescribed
    contacts: ContactRows
    gdim: int
    body_names: Sequence[str] = ()
    contact_names: Sequence[str] = ()
    comm: MPI.Intracomm = field(default_factory=lambda: MPI.COMM_SELF)

    def body_name(self, body: int) -> str:
        """Return the name of a body."""
        return self.body_names[body] if body < len(self.body_names) else f"body {body}"

    def check(self, stiffness: bool = True) -> None:
        """Check shapes, numbers and symmetry.

        Parameters
        ----------
        stiffness : bool
            Whether to look at the stiffness matrices too; false where that was done before.

        Raises
        ------
        InputError
            On all ranks, naming the subdomain or row and what is wrong with it.
        """
        with raise_collectively(self.comm):
            known: set[int] = set()
            for number, subdomain in enumerate(self.subdomains):
                _check_subdomain(number, subdomain, self.gdim)
                if stiffness and id(subdomain.stiffness) not in known:
                    _check_stiffness(number, subdomain)
                    known.add(id(subdomain.stiffness))
            _check_finite("prescribed displacements", self.prescribed.values)
            _check_finite("contact gaps", self.contacts.gap)
            _check_finite("contact normals", self.contacts.normal)
            _check_normals(self.contacts)


def _check_subdomain(number: int, subdomain: Subdomain, gdim: int) -> None:
    name = _name(number, subdomain)
    n = gdim * subdomain.nodes.size
    shapes = {
        "stiffness": (subdomain.stiffness.shape, (n, n)),
        "load": (subdomain.load.shape, (n,)),
        "coordinates": (subdomain.coordinates.shape, (subdomain.nodes.size, gdim)),
    }
    for what, (shape, expected) in shapes.items():
        if tuple(shape) != expected:
            raise InputError(f"{name}: {what} has shape {shape}, expected {expected}")
    _check_finite(f"load of {name}", subdomain.load, "a traction or body force?")
    _check_finite(f"coordinates of {name}", subdomain.coordinates)


def _name(number: int, subdomain: Subdomain) -> str:
    return f"subdomain {number} (body {subdomain.body})"


def _check_stiffness(number: int, subdomain: Subdomain) -> None:
    K, name = subdomain.stiffness, _name(number, subdomain)
    _check_finite(f"stiffness of {name}", K.data, "a material coefficient?")
    skew = abs(K - K.T).max() if K.nnz else 0.0
    if skew > SYMMETRIC * abs(K).max():
        raise InputError(
            f"the bilinear form is not symmetric: in {name} |K - K'| is {skew:.3e} where |K| is "
            f"{abs(K).max():.3e}. Contact by minimisation needs a symmetric form a(u, v) = a(v, u)"
        )


def _check_finite(what: str, values: Vector, hint: str = "") -> None:
    bad = np.flatnonzero(~np.isfinite(values).ravel())
    if bad.size:
        raise InputError(
            f"{what}: {bad.size} of {values.size} numbers are NaN or infinite. {hint}".rstrip()
        )


def _check_normals(contacts: ContactRows) -> None:
    lengths = np.linalg.norm(contacts.normal, axis=1)
    wrong = np.flatnonzero(np.abs(lengths - 1.0) > 1e-6)
    if wrong.size:
        raise InputError(
            f"{wrong.size} contact normals are not of unit length, the first at slave node "
            f"{contacts.slave[wrong[0]]} with length {lengths[wrong[0]]:.3e}"
        )

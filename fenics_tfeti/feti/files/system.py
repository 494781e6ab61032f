"""Torn systems in files, for matrices from any program: an npz file of named arrays.

docs/solver_alone.rst has the table of the names.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti.checks.system import check_system
from fenics_tfeti.feti.files.arrays import ArrayFile, open_arrays, write_arrays
from fenics_tfeti.feti.system import ContactRows, Friction, Prescribed, Subdomain, TornSystem
from fenics_tfeti.parallel import raise_collectively

Arrays = dict[str, NDArray[Any]]

_FORMAT = "fenics_tfeti torn system 1"
_SUBDOMAIN = (
    "matrix",
    "load",
    "coordinates",
    "nodes",
    "body",
    "frame",
    "kernel",
    "motions",
    "load_size",
)
_ROWS = (
    "offsets",
    "nodes",
    "coefficients",
    "gap",
    "contact",
    "slaves",
    "area",
    "held",
    "compliance",
    "adhesion",
)
_FRICTION = ("row", "tangents", "bound", "slip", "coefficient", "compliance")
_PRESCRIBED = ("nodes", "components", "values", "condition")
# patterns of all names; k is a number
_NAMES = [
    "gdim",
    *(f"matrices/k/{name}" for name in ("data", "indices", "indptr")),
    *(f"subdomains/k/{name}" for name in _SUBDOMAIN),
    *(f"prescribed/{name}" for name in _PRESCRIBED),
    *(f"{rows}/{name}" for rows in ("contacts", "tied") for name in _ROWS),
    *(f"friction/{name}" for name in _FRICTION),
    *(f"names/{things}" for things in ("bodies", "contacts", "conditions")),
]


def save_system(path: str | os.PathLike[str], system: TornSystem) -> None:
    """Write a torn system to a file, or nothing. Collective; rank 0 writes.

    Subdomains, contact rows and tied rows are written in the order of ranks. Subdomains of a rank
    that share a stiffness matrix share it in the file.

    Parameters
    ----------
    path : path-like
        File to write or replace.
    system : TornSystem
        The system. It is checked first.

    Raises
    ------
    InputError
        On all ranks, if the system is wrong.
    OSError
        On all ranks, if rank 0 cannot write the file; a file that exists is left as it is.
    """
    check_system(system)
    comm = system.comm
    parts = comm.gather((_parts_of_subdomains(system), _conditions(system)))
    with raise_collectively(comm):
        if parts is not None:
            arrays = {"gdim": np.array(system.gdim), **_names(system)}
            arrays |= _numbered([subdomains for subdomains, _ in parts])
            arrays |= _joined([conditions for _, conditions in parts])
            write_arrays(path, "the torn system", _FORMAT, arrays)


def load_system(path: str | os.PathLike[str], comm: MPI.Intracomm | None = None) -> TornSystem:
    """Read a torn system from a file. Collective; every rank reads its part.

    Each rank gets as many subdomains, contact rows and tied rows as the others, in the order of the
    file, so that the results of the ranks one after the other are in this order too.

    Parameters
    ----------
    path : path-like
        The file, of `save_system` or of another program.
    comm : MPI.Intracomm, optional
        The ranks; by default this rank alone.

    Raises
    ------
    InputError
        On all ranks, if the file is of another format, damaged or incomplete, or if an array has an
        unknown name or is of another type or shape.
    OSError
        On all ranks, if the file cannot be read.
    """
    comm = MPI.COMM_SELF if comm is None else comm
    system: TornSystem | None = None
    with raise_collectively(comm), open_arrays(path, _FORMAT) as file:
        system = _read(file, comm)
    assert system is not None
    return system


def _parts_of_subdomains(system: TornSystem) -> tuple[list[Arrays], list[Arrays]]:
    """Return the distinct matrices, and the subdomains with the positions of theirs."""
    matrices: dict[int, int] = {}
    stored, subdomains = list[Arrays](), list[Arrays]()
    for s in system.subdomains:
        K = s.stiffness
        if id(K) not in matrices:
            matrices[id(K)] = len(stored)
            stored.append({"data": K.data, "indices": K.indices, "indptr": K.indptr})
        subdomains.append(
            {
                "matrix": np.array(matrices[id(K)]),
                "load": s.load,
                "coordinates": s.coordinates,
                "nodes": s.nodes,
                "body": np.array(s.body),
                **({} if s.frame is None else {"frame": s.frame}),
                **_kernel(s),
                **({} if s.load_size is None else {"load_size": s.load_size}),
            }
        )
    return stored, subdomains


def _kernel(subdomain: Subdomain) -> Arrays:
    """Return the kernel as an array, if it is not the default."""
    kernel = subdomain.kernel
    if not isinstance(kernel, str):
        return {"motions": kernel}
    return {} if kernel == "rigid" else {"kernel": np.array([kernel])}


def _conditions(system: TornSystem) -> Mapping[str, Arrays]:
    parts: list[tuple[str, Any, Sequence[str]]] = [
        ("prescribed", system.prescribed, _PRESCRIBED),
        ("contacts", system.contacts, _ROWS),
        ("tied", system.tied, _ROWS),
        ("friction", system.friction, _FRICTION),
    ]
    return {part: {name: getattr(fields, name) for name in names} for part, fields, names in parts}


def _names(system: TornSystem) -> Arrays:
    lists = {
        "bodies": system.body_names,
        "contacts": system.contact_names,
        "conditions": system.condition_names,
    }
    return {
        f"names/{things}": np.array(list(names), dtype=np.str_) for things, names in lists.items()
    }


def _numbered(ranks: Sequence[tuple[list[Arrays], list[Arrays]]]) -> Arrays:
    """Return the matrices and subdomains of all ranks, numbered one after the other."""
    arrays, matrices, count = Arrays(), 0, 0
    for stored, subdomains in ranks:
        for number, matrix in enumerate(stored, matrices):
            arrays |= {f"matrices/{number}/{name}": array for name, array in matrix.items()}
        for number, subdomain in enumerate(subdomains, count):
            shifted = {**subdomain, "matrix": subdomain["matrix"] + matrices}
            arrays |= {f"subdomains/{number}/{name}": array for name, array in shifted.items()}
        matrices, count = matrices + len(stored), count + len(subdomains)
    return arrays


def _joined(ranks: Sequence[Mapping[str, Arrays]]) -> Arrays:
    """Return prescribed displacements and rows of all ranks, one after the other."""
    arrays = Arrays()
    for rows in ("contacts", "tied"):
        rows_of_ranks = ContactRows.concatenate([ContactRows(**rank[rows]) for rank in ranks])
        arrays |= {f"{rows}/{name}": getattr(rows_of_ranks, name) for name in _ROWS}
    for name in _PRESCRIBED:
        arrays[f"prescribed/{name}"] = np.concatenate([rank["prescribed"][name] for rank in ranks])
    for name in _FRICTION:
        arrays[f"friction/{name}"] = np.concatenate([rank["friction"][name] for rank in ranks])
    # positions among the contact rows of all ranks
    sizes = [rank["contacts"]["gap"].size for rank in ranks]
    offset = np.repeat(
        np.cumsum([0, *sizes[:-1]]), [rank["friction"]["row"].size for rank in ranks]
    )
    arrays["friction/row"] = arrays["friction/row"] + offset
    return arrays


def _read(file: ArrayFile, comm: MPI.Intracomm) -> TornSystem:
    """Return this rank's part of the system."""
    _check_names(file)
    gdim = file.integer("gdim")
    if gdim not in (2, 3):
        raise InputError(f"{file.path}: 'gdim' is {gdim}, expected 2 or 3")
    numbers = np.array_split(np.arange(_count(file, "subdomains")), comm.size)[comm.rank]
    matrices: dict[int, sp.csr_matrix] = {}
    return TornSystem(
        [_subdomain(file, int(number), gdim, matrices) for number in numbers],
        _prescribed(file),
        _rows(file, "contacts", gdim, comm),
        gdim,
        file.strings("names/bodies"),
        file.strings("names/contacts"),
        comm,
        file.strings("names/conditions"),
        _rows(file, "tied", gdim, comm),
        _friction(file, gdim, comm),
    )


def _check_names(file: ArrayFile) -> None:
    """Refuse arrays that nothing reads, such as optional ones with a misspelt name."""
    patterns = {name: re.sub(r"(?<=/)\d+(?=/)", "k", name) for name in file.names}
    unknown = sorted(name for name, pattern in patterns.items() if pattern not in _NAMES)
    if unknown:
        close = difflib.get_close_matches(patterns[unknown[0]], _NAMES, n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise InputError(f"{file.path}: there is no array {unknown[0]!r} in this format.{hint}")


def _count(file: ArrayFile, things: str) -> int:
    """Return how many matrices or subdomains there are, numbered from 0 without gaps."""
    numbers = {int(name.split("/")[1]) for name in file.names if name.startswith(f"{things}/")}
    missing = sorted(set(range(len(numbers))) - numbers)
    if missing:
        raise InputError(
            f"{file.path}: '{things}/{missing[0]}' is missing; {max(numbers)} is there"
        )
    return len(numbers)


def _subdomain(
    file: ArrayFile, number: int, gdim: int, matrices: dict[int, sp.csr_matrix]
) -> Subdomain:
    path = f"subdomains/{number}"
    nodes = file.read(f"{path}/nodes", "integers", (None,))
    matrix, n = file.integer(f"{path}/matrix"), gdim * nodes.size
    if matrix not in matrices:
        matrices[matrix] = _matrix(file, matrix)
    if matrices[matrix].shape != (n, n):
        raise InputError(
            f"{file.path}: 'matrices/{matrix}' has {matrices[matrix].shape[0]} rows, but "
            f"subdomain {number} has {nodes.size} nodes with {gdim} unknowns each"
        )
    kernel: Any = [*file.strings(f"{path}/kernel"), "rigid"][0]
    motions = file.optional(f"{path}/motions", "numbers", (n, None))
    return Subdomain(
        matrices[matrix],
        file.read(f"{path}/load", "numbers", (n,)),
        file.read(f"{path}/coordinates", "numbers", (nodes.size, gdim)),
        nodes,
        file.integer(f"{path}/body"),
        file.optional(f"{path}/frame", "numbers", (gdim, gdim)),
        kernel if motions is None else motions,
        file.optional(f"{path}/load_size", "numbers", (n,)),
    )


def _matrix(file: ArrayFile, number: int) -> sp.csr_matrix:
    path = f"matrices/{number}"
    indptr = file.read(f"{path}/indptr", "integers", (None,))
    indices = file.read(f"{path}/indices", "integers", (None,))
    data = file.read(f"{path}/data", "numbers", indices.shape).astype(np.float64, copy=False)
    n = indptr.size - 1
    try:
        matrix = sp.csr_matrix((data, indices, indptr), shape=(n, n))
        matrix.check_format(full_check=True)
    except ValueError as error:
        raise InputError(f"{file.path}: '{path}' is not a csr matrix: {error}") from None
    return matrix


def _prescribed(file: ArrayFile) -> Prescribed:
    if not file.has_part("prescribed"):
        return Prescribed()
    nodes = file.read("prescribed/nodes", "integers", (None,))
    return Prescribed(
        nodes,
        file.read("prescribed/components", "integers", nodes.shape),
        file.read("prescribed/values", "numbers", nodes.shape),
        file.optional("prescribed/condition", "integers", nodes.shape),
    )


def _rows(file: ArrayFile, part: str, gdim: int, comm: MPI.Intracomm) -> ContactRows:
    """Return this rank's contact or tied rows."""
    if not file.has_part(part):
        return ContactRows.none(gdim)
    gap = file.read(f"{part}/gap", "numbers", (None,))
    nodes = file.read(f"{part}/nodes", "integers", (None,))
    offsets = file.read(f"{part}/offsets", "integers", (gap.size + 1,)).astype(np.int64)
    if offsets[0] != 0 or offsets[-1] != nodes.size or (np.diff(offsets) < 1).any():
        raise InputError(
            f"{file.path}: '{part}/offsets' has to begin with 0, to end with the number of nodes, "
            f"{nodes.size}, and to increase in between"
        )
    coefficients = file.read(f"{part}/coefficients", "numbers", (nodes.size, gdim))
    contact = file.read(f"{part}/contact", "integers", gap.shape)
    slaves = file.optional(f"{part}/slaves", "integers", gap.shape)
    area = file.optional(f"{part}/area", "numbers", gap.shape)
    held = file.optional(f"{part}/held", "truth values", gap.shape)
    compliance = file.optional(f"{part}/compliance", "numbers", (gap.size, 2))
    adhesion = file.optional(f"{part}/adhesion", "numbers", gap.shape)
    rows = ContactRows(
        offsets, nodes, coefficients, gap, contact, slaves, area, held, compliance, adhesion
    )
    return rows.chosen(np.array_split(np.arange(rows.size), comm.size)[comm.rank])


def _friction(file: ArrayFile, gdim: int, comm: MPI.Intracomm) -> Friction:
    """Return the friction of this rank's contact rows."""
    if not file.has_part("friction") or not file.read("friction/row", "integers", (None,)).size:
        return Friction.none(gdim)
    contacts = file.read("contacts/gap", "numbers", (None,)).size
    row = file.read("friction/row", "integers", (None,)).astype(np.int64)
    tangents = file.read("friction/tangents", "numbers", (row.size, gdim - 1, gdim))
    bound = file.read("friction/bound", "numbers", row.shape)
    slip = file.optional("friction/slip", "numbers", (row.size, gdim - 1))
    coefficient = file.optional("friction/coefficient", "numbers", row.shape)
    compliance = file.optional("friction/compliance", "numbers", row.shape)
    outside = np.flatnonzero((row < 0) | (row >= contacts))
    if outside.size:
        raise InputError(
            f"{file.path}: 'friction/row' has {row[outside[0]]}, but there are {contacts} contact "
            "rows, numbered from 0"
        )
    local_rows = np.array_split(np.arange(contacts), comm.size)[comm.rank]
    local = np.flatnonzero(np.isin(row, local_rows))
    first = int(local_rows[0]) if local_rows.size else 0
    more = (None if x is None else x[local] for x in (slip, coefficient, compliance))
    return Friction(row[local] - first, tangents[local], bound[local], *more)

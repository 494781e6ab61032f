"""The checkpoint of a contact problem: load steps and geometry passes beside the multipliers.

Multipliers belong to subdomains, and these to ranks. Where another run of the same script has
other ones, because it has another number of ranks or because dolfinx distributes the mesh in
another way, it starts from the contact forces at the nodes, by their numbers in the input.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.contact import ContactPairing, ContactResult
from fenics_tfeti.fem.contact.deformed import GeometryPass
from fenics_tfeti.fem.contact.slip import SlipOrigin
from fenics_tfeti.fem.input_numbers import OwnedNodes
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.feti import ContactGuess, SavedState, TornSystem, save_checkpoint
from fenics_tfeti.feti.files.checkpoint import OtherSystem, load_checkpoint, open_checkpoint
from fenics_tfeti.parallel import raise_collectively, values_of_owners
from fenics_tfeti.typing import Array, Numbers, Vector

# what a file has of each node, and of some nodes of each contact: one number or a vector
_NODAL = ("coordinates", "displacement", "slip_origin")
_ENTRIES = {"force": 0, "obstacle": 1}


@dataclass(frozen=True)
class Continuation:
    """Where a later run of the same script goes on.

    Attributes
    ----------
    state : SavedState or None
        Start of the iterations; None if they were those of other subdomains.
    displacement : (n,) array
        The last displacement at the degrees of freedom that this rank owns [m].
    force : (contacts, nodes) array
        The last normal forces at the nodes that this rank owns [N].
    solves : int
        Finished calls of `solve`.
    origin : SlipOrigin
        From where friction counts slip.
    passes : list of GeometryPass
        The finished passes of the call that was not.
    """

    state: SavedState | None
    displacement: Vector
    force: Vector
    solves: int
    origin: SlipOrigin
    passes: Sequence[GeometryPass] = ()

    def guess(self, pairings: Sequence[ContactPairing], first_node: int) -> ContactGuess:
        """Return the last forces, as those of closed gaps, at the conditions of this rank.

        Parameters
        ----------
        pairings : sequence of ContactPairing
            The conditions of each contact.
        first_node : int
            The first node that this rank owns.
        """
        parts = [np.zeros(0)]
        parts += [f[p.slave - first_node] for f, p in zip(self.force, pairings, strict=True)]
        force = np.concatenate(parts)
        return ContactGuess(force, np.where(force > 0.0, 0.0, np.inf))


def nodal_forces(nodes: OwnedNodes, results: Sequence[ContactResult]) -> Vector:
    """Return the normal forces (contacts, nodes) at the nodes that this rank owns [N].

    Parameters
    ----------
    nodes : OwnedNodes
        The nodes.
    results : sequence of ContactResult
        Of each contact.
    """
    force = np.zeros((len(results), len(nodes.coordinates)))
    for values, result in zip(force, results, strict=True):
        values[result.nodes - nodes.first] = result.normal_force
    return force


def write_continuation(
    path: str | os.PathLike[str],
    system: TornSystem,
    nodes: OwnedNodes,
    continuation: Continuation,
) -> None:
    """Write a checkpoint, or leave the old one as it is. Collective; rank 0 writes.

    Parameters
    ----------
    path : path-like
        The file.
    system : TornSystem
        The problem.
    nodes : OwnedNodes
        The nodes of this rank.
    continuation : Continuation
        What is written; with a state.

    Raises
    ------
    OSError
        On all ranks, if rank 0 cannot write the file.
    """
    state = continuation.state
    assert state is not None
    rows = np.array([astuple(p) for p in continuation.passes])
    common = {
        "solves": np.array(continuation.solves),
        "passes": rows.reshape(-1, len(fields(GeometryPass))),
    }
    own = _arrays(continuation, nodes.coordinates)
    if nodes.numbers is not None:
        own["numbers"] = nodes.numbers
        sums = _check_sums(system, nodes.first, nodes.numbers)
        common |= {f"check sum/{name}": np.array(text) for name, text in sums.items()}
    save_checkpoint(path, system, state, own, common)


def _arrays(continuation: Continuation, coordinates: Vector) -> dict[str, Array]:
    """Return what is written for each rank."""
    force, origin = continuation.force, continuation.origin
    n, gdim = coordinates.shape
    moved = origin.obstacles.reshape(len(origin.obstacles), n, gdim)
    pressed, carried = np.nonzero(force), np.nonzero(moved.any(axis=2))
    return {
        "coordinates": coordinates,
        "displacement": continuation.displacement.reshape(n, gdim),
        "slip_origin": origin.displacement.reshape(n, gdim),
        "force": force[pressed],
        "force_contact": pressed[0],
        "force_node": pressed[1],
        "obstacle": moved[carried],
        "obstacle_contact": carried[0],
        "obstacle_node": carried[1],
    }


def read_continuation(
    path: str | os.PathLike[str],
    system: TornSystem,
    nodes: OwnedNodes,
    contacts: int,
) -> Continuation:
    """Read the part of this rank from a checkpoint. Collective.

    Parameters
    ----------
    path : path-like
        The file.
    system : TornSystem
        The problem.
    nodes : OwnedNodes
        The nodes of this rank; without numbers the subdomains have to be those of the file.
    contacts : int
        Number of contacts.

    Raises
    ------
    InputError
        On all ranks, if the file is not a checkpoint of this problem, or damaged.
    OSError
        On all ranks, if the file cannot be read.
    """
    try:
        alike = load_checkpoint(path, system)
    except OtherSystem:
        if nodes.numbers is None:
            raise
        return _redistributed(path, system, nodes, nodes.numbers, contacts)
    local = np.arange(len(nodes.coordinates))
    with raise_collectively(system.comm):
        parts = [{**alike.own, "numbers": local}]
        found = _continuation(path, parts, alike.common, local, nodes.coordinates, contacts)
    return replace(found, state=alike.state)


def _redistributed(
    path: str | os.PathLike[str],
    system: TornSystem,
    nodes: OwnedNodes,
    numbers: Numbers,
    contacts: int,
) -> Continuation:
    """Read what a checkpoint of the same problem with other subdomains has for this rank."""
    sums = _check_sums(system, nodes.first, numbers)
    with raise_collectively(system.comm), open_checkpoint(path) as file:
        common = file.read_all("common/")
        for name, text in sums.items():
            if str(common.get(f"check sum/{name}", "")) != text:
                raise _of_another_problem(path, name)
        shares = (file.read_all(f"{rank}/own/") for rank in range(file.integer("ranks")))
        found = _continuation(path, shares, common, numbers, nodes.coordinates, contacts)
    return found


def _check_sums(system: TornSystem, first: int, numbers: Numbers) -> dict[str, str]:
    """Return what a checkpoint has to agree in with a problem on any ranks. Collective."""
    comm, owned = system.comm, (first, first + numbers.size)

    def numbers_of(nodes: Numbers) -> Numbers:
        distinct, at = np.unique(nodes, return_inverse=True)
        found: Numbers = values_of_owners(comm, owned, numbers, distinct)[at]
        return found

    held, names = system.prescribed, len(system.contact_names)
    codes = {
        "nodes": numbers,
        "supports": numbers_of(held.nodes) * system.gdim + held.components,
        "contacts": numbers_of(system.contacts.slave) * names + system.contacts.contact,
        "tied surfaces": numbers_of(system.tied.slave) * names + system.tied.contact,
    }
    gathered = {name: comm.gather(code) for name, code in codes.items()}
    sums = None
    if comm.rank == 0:
        sums = {
            name: hashlib.sha256(np.unique(np.concatenate(parts or [])).tobytes()).hexdigest()
            for name, parts in gathered.items()
        }
    found: dict[str, str] = comm.bcast(sums)
    return found


def _not_of_problem(path: str | os.PathLike[str]) -> InputError:
    return InputError(f"{path}: the checkpoint is not one of a ContactProblem")


def _of_another_problem(path: str | os.PathLike[str], name: str) -> InputError:
    return InputError(f"{path}: the checkpoint is that of another problem: the {name} differ")


def _continuation(
    path: str | os.PathLike[str],
    parts: Iterable[Mapping[str, Array]],
    common: Mapping[str, Array],
    numbers: Numbers,
    coordinates: Vector,
    contacts: int,
) -> Continuation:
    """Return what the parts of a file have for the nodes of this rank, without a state."""
    n, gdim = coordinates.shape
    passes = common.get("passes", np.zeros(0))
    if passes.ndim != 2 or passes.shape[1] != len(fields(GeometryPass)) or "solves" not in common:
        raise _not_of_problem(path)
    nodal = {name: np.full((n, gdim), np.nan) for name in _NODAL}
    entries = {"force": np.zeros((contacts, n)), "obstacle": np.zeros((contacts, n, gdim))}
    order = np.argsort(numbers)
    for part in parts:
        if not _is_of_problem(part, gdim, contacts):
            raise _not_of_problem(path)
        _take(part, _positions(numbers, order, part["numbers"]), nodal, entries)
    far = np.abs(nodal["coordinates"] - coordinates).max(initial=0.0)
    if not far <= RELATIVE_ROUNDING * np.abs(coordinates).max(initial=0.0):
        raise _of_another_problem(path, "coordinates")
    finished = [GeometryPass(*row) for row in passes.tolist()]
    return Continuation(
        None,
        nodal["displacement"].ravel(),
        entries["force"],
        int(common["solves"]),
        SlipOrigin(nodal["slip_origin"].ravel(), entries["obstacle"].reshape(contacts, n * gdim)),
        [replace(one, products=int(one.products)) for one in finished],
    )


def _take(
    part: Mapping[str, Array],
    at: Numbers,
    nodal: Mapping[str, Vector],
    entries: Mapping[str, Vector],
) -> None:
    """Take the values of a part at those of its nodes that have a position on this rank."""
    here = at >= 0
    for name, values in nodal.items():
        values[at[here]] = part[name][here]
    for name, values in entries.items():
        node = at[part[f"{name}_node"]]
        mine = node >= 0
        values[part[f"{name}_contact"][mine], node[mine]] = part[name][mine]


def _positions(numbers: Numbers, order: NDArray[np.intp], wanted: Numbers) -> Numbers:
    """Return the positions of wanted numbers among some that an order sorts, -1 for others."""
    if numbers.size == 0:
        return np.full(wanted.size, -1, dtype=np.int64)
    at = np.searchsorted(numbers, wanted, sorter=order)
    at = order[np.minimum(at, numbers.size - 1)]
    return np.where(numbers[at] == wanted, at, -1)


def _is_of_problem(part: Mapping[str, Array], gdim: int, contacts: int) -> bool:
    """Tell whether a part of a file has the arrays of a contact problem, in their shapes."""
    integers = {"numbers", *(f"{name}_{of}" for name in _ENTRIES for of in ("contact", "node"))}
    if not part.keys() >= {*integers, *_NODAL, *_ENTRIES}:
        return False
    n = part["numbers"].size
    shapes: dict[str, tuple[int, ...]] = {"numbers": (n,), **dict.fromkeys(_NODAL, (n, gdim))}
    ranges: dict[str, int] = {}
    for name, components in _ENTRIES.items():
        k = part[f"{name}_node"].size
        shapes |= {name: (k, gdim)[: 1 + components], f"{name}_contact": (k,), f"{name}_node": (k,)}
        ranges |= {f"{name}_contact": contacts, f"{name}_node": n}
    return all(
        part[name].shape == shape and part[name].dtype.kind == ("i" if name in integers else "f")
        for name, shape in shapes.items()
    ) and all(np.all((part[name] >= 0) & (part[name] < end)) for name, end in ranges.items())

"""The checkpoint of a contact problem: load steps and geometry passes beside the multipliers.

Multipliers belong to subdomains, and these to ranks. Where another run of the same script has other
ones, because it has another number of ranks or because dolfinx distributes the mesh in another way,
it starts from the contact forces at the nodes, by their numbers in the input.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.contact import ContactPairing
from fenics_tfeti.fem.contact.deformed import GeometryPass
from fenics_tfeti.fem.contact.slip import SlipOrigin
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.feti import ContactGuess, SavedState, TornSystem, save_checkpoint
from fenics_tfeti.feti.files.checkpoint import OtherSystem, load_checkpoint, open_checkpoint
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Array, Numbers, Vector

# what a file has of each node, and of some nodes of each contact: one number or a vector
_NODAL = ("coordinates", "displacement", "slip_origin")
_ENTRIES = {"force": 0, "obstacle": 1}


@dataclass(frozen=True)
class Step:
    """A load step as far as it was solved: where later solves start, saved and restored."""

    displacement: Vector  # the last one, at owned degrees of freedom [m]
    force: Vector  # (contacts, nodes), the last normal forces at owned nodes [N]
    origin: SlipOrigin  # from where friction counts slip
    solves: int = 0  # finished calls of `solve`
    passes: Sequence[GeometryPass] = ()  # finished passes of the call that was not
    state: SavedState | None = None  # of the dual problem; None if that has other subdomains

    def guess(self, pairings: Sequence[ContactPairing], first_node: int) -> ContactGuess:
        """Return the last forces, as those of closed gaps, at the conditions of this rank."""
        forces = [np.zeros(0)]
        forces += [
            nodal[pairing.slave - first_node]
            for nodal, pairing in zip(self.force, pairings, strict=True)
        ]
        force = np.concatenate(forces)
        return ContactGuess(force, np.where(force > 0.0, 0.0, np.inf))


def write_step(
    path: str | os.PathLike[str],
    system: TornSystem,
    nodes: NodeMap,
    step: Step,
) -> None:
    """Write a checkpoint, or leave the old one as it is. Collective; rank 0 writes.

    The step has a state. If rank 0 cannot write the file, all ranks raise.
    """
    state = step.state
    assert state is not None
    rows = np.array([astuple(p) for p in step.passes])
    common = {
        "solves": np.array(step.solves),
        "passes": rows.reshape(-1, len(fields(GeometryPass))),
    }
    arrays = _arrays(step, nodes.coordinates)
    if nodes.input_numbers is not None:
        arrays["numbers"] = nodes.input_numbers
        sums = _check_sums(system, nodes, nodes.input_numbers)
        common |= {f"check sum/{name}": np.array(text) for name, text in sums.items()}
    save_checkpoint(path, system, state, arrays, common)


def _arrays(step: Step, coordinates: Vector) -> dict[str, Array]:
    """Return the entries of the file for each rank."""
    force, origin = step.force, step.origin
    n, gdim = coordinates.shape
    obstacles = origin.obstacles.reshape(len(origin.obstacles), n, gdim)
    pressed, displaced = np.nonzero(force), np.nonzero(obstacles.any(axis=2))
    return {
        "coordinates": coordinates,
        "displacement": step.displacement.reshape(n, gdim),
        "slip_origin": origin.displacement.reshape(n, gdim),
        "force": force[pressed],
        "force_contact": pressed[0],
        "force_node": pressed[1],
        "obstacle": obstacles[displaced],
        "obstacle_contact": displaced[0],
        "obstacle_node": displaced[1],
    }


def read_step(
    path: str | os.PathLike[str],
    system: TornSystem,
    nodes: NodeMap,
    contacts: int,
) -> Step:
    """Read the part of this rank from a checkpoint. Collective.

    Without numbers of the nodes the subdomains have to be those of the file.
    """
    try:
        checkpoint = load_checkpoint(path, system)
    except OtherSystem:
        if nodes.input_numbers is None:
            raise
        return _redistributed(path, system, nodes, nodes.input_numbers, contacts)
    local = np.arange(len(nodes.coordinates))
    with raise_collectively(system.comm):
        shares = [{**checkpoint.own, "numbers": local}]
        step = _joined(path, shares, checkpoint.common, local, nodes.coordinates, contacts)
    return replace(step, state=checkpoint.state)


def _redistributed(
    path: str | os.PathLike[str],
    system: TornSystem,
    nodes: NodeMap,
    numbers: Numbers,
    contacts: int,
) -> Step:
    """Read this rank's part of a checkpoint of the same problem with other subdomains."""
    sums = _check_sums(system, nodes, numbers)
    with raise_collectively(system.comm), open_checkpoint(path) as file:
        common = file.read_all("common/")
        for name, text in sums.items():
            if str(common.get(f"check sum/{name}", "")) != text:
                raise _of_another_problem(path, name)
        shares = (file.read_all(f"{rank}/own/") for rank in range(file.integer("ranks")))
        step = _joined(path, shares, common, numbers, nodes.coordinates, contacts)
    return step


def _check_sums(system: TornSystem, nodes: NodeMap, numbers: Numbers) -> dict[str, str]:
    """Return the hashes in which checkpoints of a problem agree on any ranks. Collective."""
    comm = system.comm
    prescribed, names = system.prescribed, len(system.contact_names)
    supports = nodes.values_at(numbers, prescribed.nodes)
    contacts, tied = (
        nodes.values_at(numbers, rows.slave) * names + rows.contact
        for rows in (system.contacts, system.tied)
    )
    codes = {
        "nodes": numbers,
        "supports": supports * system.gdim + prescribed.components,
        "contacts": contacts,
        "tied surfaces": tied,
    }
    gathered = {name: comm.gather(code) for name, code in codes.items()}
    sums = None
    if comm.rank == 0:
        sums = {
            name: hashlib.sha256(np.unique(np.concatenate(arrays or [])).tobytes()).hexdigest()
            for name, arrays in gathered.items()
        }
    hashes: dict[str, str] = comm.bcast(sums)
    return hashes


def _not_of_problem(path: str | os.PathLike[str]) -> InputError:
    return InputError(f"{path}: the checkpoint is not one of a ContactProblem")


def _of_another_problem(path: str | os.PathLike[str], name: str) -> InputError:
    return InputError(f"{path}: the checkpoint is that of another problem: the {name} differ")


def _joined(
    path: str | os.PathLike[str],
    shares: Iterable[Mapping[str, Array]],
    common: Mapping[str, Array],
    numbers: Numbers,
    coordinates: Vector,
    contacts: int,
) -> Step:
    """Join the shares of a file at the nodes of this rank, without a state."""
    n, gdim = coordinates.shape
    passes = common.get("passes", np.zeros(0))
    if passes.ndim != 2 or passes.shape[1] != len(fields(GeometryPass)) or "solves" not in common:
        raise _not_of_problem(path)
    nodal = {name: np.full((n, gdim), np.nan) for name in _NODAL}
    entries = {"force": np.zeros((contacts, n)), "obstacle": np.zeros((contacts, n, gdim))}
    order = np.argsort(numbers)
    for share in shares:
        if not _is_of_problem(share, gdim, contacts):
            raise _not_of_problem(path)
        _take(share, _positions(numbers, order, share["numbers"]), nodal, entries)
    distance = np.abs(nodal["coordinates"] - coordinates).max(initial=0.0)
    if not distance <= RELATIVE_ROUNDING * np.abs(coordinates).max(initial=0.0):
        raise _of_another_problem(path, "coordinates")
    finished = [GeometryPass(*row) for row in passes.tolist()]
    return Step(
        nodal["displacement"].ravel(),
        entries["force"],
        SlipOrigin(nodal["slip_origin"].ravel(), entries["obstacle"].reshape(contacts, n * gdim)),
        int(common["solves"]),
        [replace(entry, products=int(entry.products)) for entry in finished],
    )


def _take(
    share: Mapping[str, Array],
    position: Numbers,
    nodal: Mapping[str, Vector],
    entries: Mapping[str, Vector],
) -> None:
    """Copy the values of a share at those of its nodes that have a position on this rank."""
    present = position >= 0
    for name, values in nodal.items():
        values[position[present]] = share[name][present]
    for name, values in entries.items():
        node = position[share[f"{name}_node"]]
        present_nodes = node >= 0
        contact = share[f"{name}_contact"][present_nodes]
        values[contact, node[present_nodes]] = share[name][present_nodes]


def _positions(numbers: Numbers, order: NDArray[np.intp], values: Numbers) -> Numbers:
    """Return the positions of values among numbers that an order sorts, -1 for others."""
    if numbers.size == 0:
        return np.full(values.size, -1, dtype=np.int64)
    position = np.searchsorted(numbers, values, sorter=order)
    position = order[np.minimum(position, numbers.size - 1)]
    return np.where(numbers[position] == values, position, -1)


def _is_of_problem(share: Mapping[str, Array], gdim: int, contacts: int) -> bool:
    """Tell whether a share of a file has the arrays of a contact problem, in their shapes."""
    integers = {
        "numbers",
        *(f"{name}_{column}" for name in _ENTRIES for column in ("contact", "node")),
    }
    if not share.keys() >= {*integers, *_NODAL, *_ENTRIES}:
        return False
    n = share["numbers"].size
    shapes: dict[str, tuple[int, ...]] = {"numbers": (n,), **dict.fromkeys(_NODAL, (n, gdim))}
    ranges: dict[str, int] = {}
    for name, components in _ENTRIES.items():
        k = share[f"{name}_node"].size
        shapes |= {name: (k, gdim)[: 1 + components], f"{name}_contact": (k,), f"{name}_node": (k,)}
        ranges |= {f"{name}_contact": contacts, f"{name}_node": n}
    return all(
        share[name].shape == shape and share[name].dtype.kind == ("i" if name in integers else "f")
        for name, shape in shapes.items()
    ) and all(np.all((share[name] >= 0) & (share[name] < end)) for name, end in ranges.items())

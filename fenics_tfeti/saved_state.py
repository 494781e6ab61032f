"""The checkpoint of a contact problem: a load step at the nodes, by their numbers in the input.

Any number of ranks may read it, whatever subdomains they have.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, fields, replace

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.contact_conditions import SlaveValues
from fenics_tfeti.fem.contact.conditions.friction import SlipOrigin
from fenics_tfeti.fem.contact.contact_set import ContactSet
from fenics_tfeti.fem.contact.solution.geometry_pass import GeometryPass
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.feti import ContactGuess
from fenics_tfeti.feti.files.arrays import ArrayFile, open_arrays, write_arrays
from fenics_tfeti.parallel import positions, raise_collectively
from fenics_tfeti.typing import Array, Numbers, Vector

_FORMAT = "fenics_tfeti step 3"


@dataclass(frozen=True)
class AcceptedState:
    """A load step as far as it was solved: where later solves start, saved and restored."""

    displacement: Vector  # the last one, at owned degrees of freedom [m]
    force: SlaveValues  # (k,): the last normal forces [N]
    origin: SlipOrigin  # from where friction counts slip
    number: int = 0  # of accepted steps
    damage: SlaveValues = field(
        default_factory=SlaveValues
    )  # (k,) of bonds, at the last step's end
    passes: Sequence[GeometryPass] = ()  # finished passes of a solve that was not
    # of adaptive steps the load of the last one, the length of the next one, negative towards
    # smaller loads, the load at the end of all, NaN without; and how many easy ones are the last
    load: float = np.nan
    length: float = np.nan
    end: float = np.nan
    easy: int = 0
    # places of rigid bodies with finite strains, see `RigidBodies.saved`; the same on all ranks
    bodies: Mapping[str, Vector] = field(default_factory=dict)

    @staticmethod
    def at(origin: SlipOrigin) -> AcceptedState:
        """Return the step before the first one."""
        return AcceptedState(origin.displacement, SlaveValues(), origin)

    def accepted(self, obstacles: SlaveValues, damage: SlaveValues) -> AcceptedState:
        """Return the step that follows: it has the damage of this one, and counts slip from it."""
        origin = SlipOrigin(self.displacement, obstacles)
        return replace(self, origin=origin, damage=damage, number=self.number + 1)

    def guess(self, contact_set: ContactSet) -> ContactGuess:
        """Return the last forces, as those of closed gaps, at the conditions of this rank."""
        force = contact_set.at_conditions(self.force)
        return ContactGuess(force, np.where(force > 0.0, 0.0, np.inf))


def write_state(
    path: str | os.PathLike[str], kind: str, contact_set: ContactSet, step: AcceptedState
) -> None:
    """Write a checkpoint of a kind of problem on rank 0, or leave the old one. Collective."""
    nodes = contact_set.boundary.nodes
    parts = nodes.comm.gather(_arrays(step, nodes, contact_set.histories))
    with raise_collectively(nodes.comm):
        if parts is not None:
            arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
            order = np.argsort(arrays["numbers"])
            nodal = ("numbers", "coordinates", "displacement", "slip_origin")
            arrays |= {name: arrays[name][order] for name in nodal}
            passes = np.array([astuple(p) for p in step.passes])
            bodies = [*step.bodies.values()]
            arrays |= {
                "problem": np.array([kind]),
                "contacts": np.array(contact_set.histories, dtype=np.str_),
                "number": np.array(step.number),
                "load": np.array([step.load, step.length, step.end]),
                "easy": np.array(step.easy),
                "passes": passes.reshape(-1, len(fields(GeometryPass))),
                "body_names": np.array([*step.bodies], dtype=np.str_),
                "bodies": np.array(bodies).reshape(len(bodies), -1 if bodies else 0),
            }
            write_arrays(path, "the checkpoint", _FORMAT, arrays)


def _arrays(step: AcceptedState, nodes: NodeMap, keys: Sequence[str]) -> dict[str, Array]:
    """Return this rank's part of a file: values at all nodes, and at some of each contact."""
    numbers, shape = nodes.input_numbers, (nodes.owned, nodes.components)
    arrays: dict[str, Array] = {
        "numbers": numbers,
        "coordinates": nodes.coordinates,
        "displacement": step.displacement.reshape(shape),
        "slip_origin": step.origin.displacement.reshape(shape),
    }
    for name, values in (
        ("force", step.force),
        ("obstacle", step.origin.obstacles),
        ("damage", step.damage),
    ):
        none = np.zeros(0, dtype=np.int64), np.zeros((0, *values.shape))
        parts = [none, *(values.of_contact.get(key, none) for key in keys)]
        size = [rows.size for rows, _ in parts]
        local, arrays[name] = (np.concatenate(column) for column in zip(*parts, strict=True))
        arrays[f"{name}_node"] = numbers[local]
        arrays[f"{name}_contact"] = np.repeat(np.arange(-1, len(keys)), size)
    return arrays


def read_state(path: str | os.PathLike[str], kind: str, contact_set: ContactSet) -> AcceptedState:
    """Read the part of this rank from a checkpoint of the same kind of problem. Collective.

    It is of the same mesh and has the same contacts, in any order.
    """
    nodes = contact_set.boundary.nodes
    own = nodes.input_numbers  # collective
    with raise_collectively(nodes.comm), open_arrays(path, _FORMAT) as file:
        step = _read(file, kind, contact_set, own)
    return step


def _read(file: ArrayFile, kind: str, contact_set: ContactSet, own: Numbers) -> AcceptedState:
    nodes = contact_set.boundary.nodes
    coordinates, gdim = nodes.coordinates, nodes.components
    numbers = file.read("numbers", "integers", (None,))
    rows = positions(numbers, own)
    _check_same(file, "kinds", file.strings("problem"), [kind])
    keys = file.strings("contacts")
    _check_same(file, "contacts", keys, contact_set.histories)
    bodies = _bodies(file)
    if bodies:
        _check_same(file, "rigid bodies", [*bodies], [f.key for f in contact_set.bodies.frames])
    if np.any(rows < 0) or numbers.size != nodes.total:
        raise _of_another_problem(file, "nodes")

    def nodal(name: str) -> Vector:
        return file.read(name, "numbers", (numbers.size, gdim))[rows]

    distance = np.abs(nodal("coordinates") - coordinates).max(initial=0.0)
    if not distance <= RELATIVE_ROUNDING * np.abs(coordinates).max(initial=0.0):
        raise _of_another_problem(file, "coordinates")
    order = np.argsort(own)

    def of_contacts(name: str, *shape: int) -> SlaveValues:
        node = file.read(f"{name}_node", "integers", (None,))
        contact = file.read(f"{name}_contact", "integers", (node.size,))
        entries = file.read(name, "numbers", (node.size, *shape))
        if np.any((contact < 0) | (contact >= len(keys))):
            raise InputError(f"{file.path}: the array '{name}_contact' has numbers of no contact")
        row = positions(own[order], node)
        here = [np.flatnonzero((row >= 0) & (contact == k)) for k in range(len(keys))]
        parts = ((order[row[chosen]], entries[chosen]) for chosen in here)
        return SlaveValues(dict(zip(keys, parts, strict=True)), shape)

    passes = file.read("passes", "numbers", (None, len(fields(GeometryPass)))).tolist()
    finished = [GeometryPass(*row) for row in passes]
    load: tuple[float, float, float] = tuple(file.read("load", "numbers", (3,)).tolist())
    return AcceptedState(
        nodal("displacement").ravel(),
        of_contacts("force"),
        SlipOrigin(nodal("slip_origin").ravel(), of_contacts("obstacle", gdim)),
        file.integer("number"),
        of_contacts("damage"),
        [replace(entry, products=int(entry.products)) for entry in finished],
        *load,
        easy=file.integer("easy"),
        bodies=bodies,
    )


def _bodies(file: ArrayFile) -> dict[str, Vector]:
    """Return the places of rigid bodies by key."""
    names = file.strings("body_names")
    places = file.read("bodies", "numbers", (len(names), None))
    return dict(zip(names, places, strict=True))


def _check_same(file: ArrayFile, what: str, there: Sequence[str], here: Sequence[str]) -> None:
    """Check that a file has the same names as the problem, in any order."""
    if sorted(there) != sorted(here):
        names = f": it has {', '.join(there) or 'none'}, this problem {', '.join(here) or 'none'}"
        raise _of_another_problem(file, what, names)


def _of_another_problem(file: ArrayFile, what: str, names: str = "") -> InputError:
    return InputError(
        f"{file.path}: the checkpoint is that of another problem: the {what} differ{names}"
    )

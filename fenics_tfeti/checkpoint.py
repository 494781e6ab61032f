"""The checkpoint of a contact problem: a load step at the nodes, by their numbers in the input.

Any number of ranks may read it, whatever subdomains they have.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import astuple, dataclass, field, fields, replace

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.deformed import GeometryPass
from fenics_tfeti.fem.contact.conditions.friction import SlipOrigin
from fenics_tfeti.fem.contact.conditions.pairing import ContactPairing, SlaveValues
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.feti import ContactGuess
from fenics_tfeti.feti.files.arrays import ArrayFile, open_arrays, write_arrays
from fenics_tfeti.parallel import positions, raise_collectively
from fenics_tfeti.typing import Array, Numbers, Vector

_FORMAT = "fenics_tfeti step 1"


@dataclass(frozen=True)
class Step:
    """A load step as far as it was solved: where later solves start, saved and restored."""

    displacement: Vector  # the last one, at owned degrees of freedom [m]
    force: SlaveValues  # (k,): the last normal forces [N]
    origin: SlipOrigin  # from where friction counts slip
    number: int = 0  # of accepted steps
    passes: Sequence[GeometryPass] = ()  # finished passes of a solve that was not
    # the load of the last of adaptive steps and the length of the next one, NaN without
    load: float = np.nan
    length: float = np.nan
    # places of rigid bodies with finite strains, see `RigidBodies.saved`; the same on all ranks
    bodies: Vector = field(default_factory=lambda: np.zeros((0, 0)))

    @staticmethod
    def at(origin: SlipOrigin) -> Step:
        """Return the step before the first one."""
        return Step(origin.displacement, SlaveValues.of([]), origin)

    def of_first(self, contacts: int) -> Step:
        """Return the step without contacts that are no longer there."""
        origin = replace(self.origin, obstacles=self.origin.obstacles.of_first(contacts))
        return replace(self, force=self.force.of_first(contacts), origin=origin)

    def accepted(self, obstacles: SlaveValues) -> Step:
        """Return the step that follows: friction counts slip from the end of this one."""
        origin = SlipOrigin(self.displacement, obstacles)
        return replace(self, origin=origin, number=self.number + 1)

    def guess(self, pairings: Sequence[ContactPairing]) -> ContactGuess:
        """Return the last forces, as those of closed gaps, at the conditions of this rank."""
        force = self.force.at_conditions(pairings)
        return ContactGuess(force, np.where(force > 0.0, 0.0, np.inf))


def write_step(
    path: str | os.PathLike[str], nodes: NodeMap, contacts: Sequence[str], step: Step
) -> None:
    """Write a checkpoint on rank 0, with the contacts' names, or leave the old one. Collective."""
    parts = nodes.comm.gather(_arrays(step, nodes))
    with raise_collectively(nodes.comm):
        if parts is not None:
            arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
            order = np.argsort(arrays["numbers"])
            nodal = ("numbers", "coordinates", "displacement", "slip_origin")
            arrays |= {name: arrays[name][order] for name in nodal}
            passes = np.array([astuple(p) for p in step.passes])
            arrays |= {
                "contacts": np.array(contacts, dtype=np.str_),
                "number": np.array(step.number),
                "load": np.array([step.load, step.length]),
                "passes": passes.reshape(-1, len(fields(GeometryPass))),
                "bodies": step.bodies,
            }
            write_arrays(path, "the checkpoint", _FORMAT, arrays)


def _arrays(step: Step, nodes: NodeMap) -> dict[str, Array]:
    """Return this rank's part of a file: values at all nodes, and at some of each contact."""
    numbers, shape = nodes.input_numbers, (nodes.owned, nodes.components)
    arrays: dict[str, Array] = {
        "numbers": numbers,
        "coordinates": nodes.coordinates,
        "displacement": step.displacement.reshape(shape),
        "slip_origin": step.origin.displacement.reshape(shape),
    }
    for name, values in (("force", step.force), ("obstacle", step.origin.obstacles)):
        arrays[name], arrays[f"{name}_contact"] = values.values, values.contact
        arrays[f"{name}_node"] = numbers[values.nodes]
    return arrays


def read_step(path: str | os.PathLike[str], nodes: NodeMap, contacts: Sequence[str]) -> Step:
    """Read the part of this rank from a checkpoint of the same mesh and contacts. Collective."""
    own = nodes.input_numbers  # collective
    with raise_collectively(nodes.comm), open_arrays(path, _FORMAT) as file:
        step = _read(file, nodes, own, contacts)
    return step


def _read(file: ArrayFile, nodes: NodeMap, own: Numbers, contacts: Sequence[str]) -> Step:
    coordinates, gdim = nodes.coordinates, nodes.components
    numbers = file.read("numbers", "integers", (None,))
    rows = positions(numbers, own)
    if file.strings("contacts") != list(contacts):
        raise _of_another_problem(file, "contacts")
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
        if np.any((contact < 0) | (contact >= len(contacts))):
            raise InputError(f"{file.path}: the array '{name}_contact' has numbers of no contact")
        row = positions(own[order], node)
        here = row >= 0
        return SlaveValues(contact[here], order[row[here]], entries[here])

    passes = file.read("passes", "numbers", (None, len(fields(GeometryPass)))).tolist()
    finished = [GeometryPass(*row) for row in passes]
    load: tuple[float, float] = tuple(file.read("load", "numbers", (2,)).tolist())
    return Step(
        nodal("displacement").ravel(),
        of_contacts("force"),
        SlipOrigin(nodal("slip_origin").ravel(), of_contacts("obstacle", gdim)),
        file.integer("number"),
        [replace(entry, products=int(entry.products)) for entry in finished],
        *load,
        bodies=file.read("bodies", "numbers", (None, None)),
    )


def _of_another_problem(file: ArrayFile, name: str) -> InputError:
    return InputError(f"{file.path}: the checkpoint is that of another problem: the {name} differ")

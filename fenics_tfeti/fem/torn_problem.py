"""The user's forms, supports and contacts as a torn system, kept up to date between solves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import ufl
from dolfinx.fem import FunctionSpace

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.contact_set import ContactSearch, ContactSet
from fenics_tfeti.fem.contact.description import Contact, TiedPair
from fenics_tfeti.fem.contact.slip import SlipOrigin
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.fem.decomposition.partition import Partitioner
from fenics_tfeti.fem.decomposition.torn_mesh import TornMesh
from fenics_tfeti.fem.displacement import prescribed_values
from fenics_tfeti.fem.mesh_checks import check_mesh
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.feti import Timer, TornSystem


@dataclass(frozen=True)
class ProblemData:
    """What the user gave for a problem beside its forms, checked."""

    bcs: list[Any]
    contacts: list[Contact | TiedPair]
    cell_tags: Any = None
    subdomains: Sequence[int] | None = None
    measure_weight: Any = None
    compiler: _compat.CompilerOptions = _compat.CompilerOptions()

    @property
    def touching(self) -> list[Contact]:
        """The contacts without tied pairs."""
        return [contact for contact in self.contacts if not isinstance(contact, TiedPair)]


class TornProblem:
    """A problem torn into subdomains, with its contacts on undeformed surfaces."""

    undeformed: ContactSet

    def __init__(
        self,
        space: FunctionSpace,
        a: ufl.Form,
        L: ufl.Form,
        data: ProblemData,
        size: int,
        partitioner: Partitioner,
        timer: Timer,
    ) -> None:
        self.space, self.nodes, self.data, self._timer = space, NodeMap(space), data, timer
        with timer.phase("partition"):
            self.bodies = find_bodies(space.mesh, data.cell_tags)
            check_mesh(space.mesh, self.bodies, data.touching)
        self._search = ContactSearch(space, self.bodies, data.measure_weight, timer)
        found = self._find()
        self.torn = TornMesh(
            space,
            a,
            L,
            data.compiler,
            self.bodies,
            self._search.boundary.coordinates,
            data.subdomains,
            size,
            partitioner,
            timer,
        )
        self._assemble(found)

    @property
    def names(self) -> list[str]:
        """The names of the contacts without tied pairs."""
        return [pairing.name for pairing in self.undeformed.pairings]

    def update(
        self,
        bcs: list[Any],
        contacts: list[Contact | TiedPair],
        release: Callable[[], None] | None = None,
    ) -> None:
        """Take the present data; find, and assemble after `release`, what changed. Collective."""
        self.data = replace(self.data, bcs=bcs, contacts=contacts)
        if self.torn.has_moved():
            check_mesh(self.space.mesh, self.bodies, self.data.touching)
            self._search.forget()
            self.torn.place_nodes(self._search.boundary.coordinates)
        self._assemble(self._find(), release)

    def _find(self) -> ContactSet:
        prescribed = prescribed_values(self.space, self.data.bcs)
        return self._search.find(self.data.contacts, prescribed)

    def _assemble(self, found: ContactSet, release: Callable[[], None] | None = None) -> None:
        """Assemble the subdomains, after which slave and master may be exchanged."""
        subdomains = self.torn.assemble(release or (lambda: None))
        self.undeformed = self._search.with_roles(found, self.data.contacts, subdomains)

    def system(self, origin: SlipOrigin) -> TornSystem:
        """Return the torn system, with slip counted from its origin. Collective."""
        return TornSystem(
            self.torn.subdomains,
            self.undeformed.prescribed,
            self.undeformed.rows(),
            self.space.mesh.geometry.dim,
            self.bodies.names,
            self.undeformed.names,
            self.space.mesh.comm,
            [f"Dirichlet condition {i}" for i in range(len(self.data.bcs))],
            self.undeformed.tied_rows(),
            self.undeformed.friction_rows(origin),
        )

"""The user's forms, supports and contacts as a torn system, kept up to date between solves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx.fem import Function, FunctionSpace

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.contact_set import ContactSearch, ContactSet
from fenics_tfeti.fem.contact.description import Contact, TiedPair
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.fem.decomposition.partition import Partitioner
from fenics_tfeti.fem.decomposition.torn_mesh import TornMesh
from fenics_tfeti.fem.displacement import prescribed_values
from fenics_tfeti.fem.mesh_checks import check_mesh
from fenics_tfeti.fem.newton.equilibrium import DeformedRows
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.feti import Prescribed, Timer, TornSystem


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
        prescribed = prescribed_values(space, data.bcs)
        found = self._search.find(data.contacts, prescribed)
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
        torn = self.torn.assemble(lambda: None)
        self.undeformed = self._search.with_roles(found, data.contacts, torn)

    def update(self, bcs: list[Any], contacts: list[Contact | TiedPair]) -> bool:
        """Take the present data; tell whether nodes of the mesh were moved. Collective."""
        last, self.data = self.data, replace(self.data, bcs=bcs, contacts=contacts)
        moved = self.torn.has_moved()
        if moved:
            check_mesh(self.space.mesh, self.bodies, self.data.touching)
            self._search.forget()
            self.torn.place_nodes(self._search.boundary.coordinates)
        prescribed = prescribed_values(self.space, bcs)
        same = len(contacts) == len(last.contacts) and all(
            new is old for new, old in zip(contacts, last.contacts, strict=True)
        )
        if same and not moved:
            self.undeformed = replace(self.undeformed, prescribed=prescribed)
            return False
        found = self._search.find(contacts, prescribed)
        torn = self.torn.assemble(lambda: None)
        self.undeformed = self._search.with_roles(found, contacts, torn)
        return moved

    def system_at(self, u: Function, rows: DeformedRows, prescribed: Prescribed) -> TornSystem:
        """Return the tangents and loads at a displacement, for an increment of it. Collective."""
        values = self.nodes.values(u)
        subdomains = [
            replace(s, coordinates=s.coordinates + values[self.nodes.to_local(s.nodes)])
            for s in self.torn.assemble(lambda: None)
        ]
        conditions, comm = rows.conditions, self.space.mesh.comm
        local = self.nodes.to_local(prescribed.nodes)
        increment = prescribed.values - values[local, prescribed.components]
        return TornSystem(
            subdomains,
            replace(prescribed, values=increment),
            rows.contacts,
            self.space.mesh.geometry.dim,
            self.bodies.names,
            conditions.names,
            comm,
            [f"Dirichlet condition {i}" for i in range(len(self.data.bcs))],
            rows.tied,
            rows.friction,
        )

    def internal_force(self) -> Any:
        """Return F(u) (nodes, gdim) at the nodes that this rank owns [N]. Collective."""
        return np.negative(self.torn.load())

    def largest_stiffness(self) -> float:
        """Return the largest entry of the subdomains' matrices [N/m]. Collective."""
        entries = [np.abs(s.stiffness.data).max() for s in self.torn.assemble(lambda: None)]
        return float(self.space.mesh.comm.allreduce(max(entries, default=0.0), MPI.MAX))

"""The user's forms, supports and contacts as a torn system, kept up to date between solves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from operator import is_
from typing import Any

import numpy as np

import ufl
from dolfinx.fem import Function, FunctionSpace

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.checks.mesh import check_mesh
from fenics_tfeti.fem.contact.conditions.friction import SlipOrigin
from fenics_tfeti.fem.contact.conditions.ties import TiedConditions
from fenics_tfeti.fem.contact.contact_set import ContactSet
from fenics_tfeti.fem.contact.descriptions.contacts import Contact
from fenics_tfeti.fem.contact.descriptions.rigid_body import RigidBody
from fenics_tfeti.fem.contact.descriptions.ties import Tie
from fenics_tfeti.fem.contact.rigid.frames import RigidBodies
from fenics_tfeti.fem.contact.search.contact_search import ContactSearch
from fenics_tfeti.fem.decomposition.assembly import TornMesh, prepare_forms
from fenics_tfeti.fem.decomposition.bodies import Bodies, find_bodies
from fenics_tfeti.fem.decomposition.partition import (
    Partitioner,
    as_subdomains,
    split_into_subdomains,
)
from fenics_tfeti.fem.displacement import (
    fill_displacement,
    fill_owned,
    owned_values,
    prescribed_values,
)
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.feti import ContactRows, Friction, Prescribed, Subdomain, Timer, TornSystem
from fenics_tfeti.parallel import any_rank
from fenics_tfeti.typing import Vector


class TornProblem:
    """A problem torn into subdomains, with its contacts on undeformed surfaces."""

    undeformed: ContactSet

    def __init__(
        self,
        space: FunctionSpace,
        a: ufl.Form,
        L: ufl.Form,
        *,
        bcs: list[Any],
        contacts: list[Contact | Tie],
        cell_tags: Any,
        rigid_bodies: Mapping[int, RigidBody],  # by tag of their cells
        subdomains: Sequence[int] | None,  # labels of cells
        subdomain_size: int,  # of those without labels, in unknowns
        partitioner: Partitioner,
        measure_weight: Any,
        compiler: _compat.CompilerOptions,
        displacement: Function | None,  # of the surfaces where obstacles are evaluated
        deformed_by: Function | None,  # of the surfaces that contacts follow, if they do
        timer: Timer,
    ) -> None:
        self.space, self.nodes, self.compiler = space, NodeMap(space), compiler
        self.bcs, self.contacts, self._rigid_bodies = bcs, contacts, rigid_bodies
        with timer.phase("partition"):
            self.bodies = find_bodies(space.mesh, cell_tags, rigid_bodies)
            _check_rigid_tags(space, self.bodies, rigid_bodies)
            check_mesh(space.mesh, self.bodies, contacts)
        self._search = ContactSearch(
            space, self.bodies, measure_weight, timer, displacement, rigid_bodies, deformed_by
        )
        self._is_updated = False
        found = self._find(self._search, bcs, contacts)
        with timer.phase("compilation"):
            forms = prepare_forms(space, a, L, compiler)
        x = self._search.boundary.coordinates
        with timer.phase("partition"):
            cells = (
                split_into_subdomains(space, self.bodies, subdomain_size, partitioner, x)
                if subdomains is None
                else as_subdomains(space.mesh, self.bodies, subdomains)
            )
        self.torn = TornMesh(forms, self.bodies, cells, x, timer)
        self._assemble(found, bcs, contacts)

    def update(
        self,
        bcs: list[Any],
        contacts: list[Contact | Tie],
        release: Callable[[], None] | None = None,
    ) -> None:
        """Take the present data; find, and assemble after `release`, what changed. Collective.

        After an error the data are the earlier ones, and the next update does all of it again.
        """
        self._is_updated = False
        contacts, search = list(contacts), self._search
        if has_moved := self.torn.has_moved():
            check_mesh(self.space.mesh, self.bodies, contacts)
            search = search.on_moved_nodes()
        found = self._find(search, bcs, contacts)
        if has_moved:
            self.torn.place_nodes(search.boundary.coordinates)
        self._search = search
        self._assemble(found, bcs, contacts, release)

    def update_supports(self, bcs: list[Any], contacts: list[Contact | Tie]) -> bool:
        """Take the values of supports if nothing else has changed; tell whether. Collective.

        Contacts are those that were found.
        """
        known, before = self.contacts, self.undeformed.prescribed
        has_same_contacts = len(known) == len(contacts) and all(map(is_, known, contacts))
        if not (self._is_updated and has_same_contacts) or self.torn.has_moved():
            return False
        if not self._search.has_all_patches():
            return False
        prescribed = prescribed_values(self.space, bcs)
        pairs = (before.nodes, prescribed.nodes), (before.components, prescribed.components)
        if any_rank(self.nodes.comm, [not np.array_equal(*pair) for pair in pairs]):
            return False
        self.bcs = bcs
        self.undeformed = replace(self.undeformed, prescribed=prescribed)
        return True

    def lacks_contact(self, uh: Function) -> bool:
        """Tell whether a surface has come near itself where it has no conditions. Collective."""
        return self._search.lacks_contact(uh)

    def left_inside(self, uh: Function) -> dict[str, float]:
        """Return how deep surfaces are in themselves where no patch can be, by key. Collective."""
        return self._search.left_inside(uh)

    def found_anew(
        self, contacts: Sequence[Contact | Tie], kept: Mapping[int, TiedConditions] | None = None
    ) -> ContactSet:
        """Return the conditions of contacts on the nodes as they are now. Collective.

        The problem keeps those that it has. Ties with the numbers of those kept stay as they are.
        """
        search = self._search.on_moved_nodes()
        return search.find(list(contacts), prescribed_values(self.space, self.bcs), kept)

    def _find(
        self, search: ContactSearch, bcs: list[Any], contacts: list[Contact | Tie]
    ) -> ContactSet:
        return search.find(contacts, prescribed_values(self.space, bcs))

    def _assemble(
        self,
        found: ContactSet,
        bcs: list[Any],
        contacts: list[Contact | Tie],
        release: Callable[[], None] | None = None,
    ) -> None:
        """Assemble the subdomains, after which slave and master may be exchanged."""
        subdomains = self.torn.assemble(release)
        found = self._search.with_roles(found, contacts, subdomains)
        self.undeformed = replace(found, bodies=self.loaded(found.bodies))
        self.bcs, self.contacts, self._is_updated = bcs, contacts, True

    def loaded(self, bodies: RigidBodies) -> RigidBodies:
        """Return rigid bodies with the present loads on their cells. Collective."""
        if not self._rigid_bodies:
            return bodies
        return bodies.loaded(self._search.rigid.resultants(self.torn.load(rigid=True), bodies))

    def fill(self, uh: Function, bodies: RigidBodies, is_small: bool) -> Function:
        """Fill a displacement at nodes of rigid bodies, of small rotations or any. Collective."""
        return self._search.rigid.fill(uh, bodies, is_small)

    def resultants(self, force: Vector, bodies: RigidBodies) -> Vector:
        """Return forces and moments on rigid bodies of nodal forces (n,). Collective."""
        return self._search.rigid.resultants(force.reshape(-1, self.nodes.components), bodies)

    def is_as_found(self, bcs: list[Any], contacts: list[Contact | Tie]) -> bool:
        """Tell whether all data are those of the last update. Collective."""
        return self.has_conditions(bcs, contacts) and self.torn.has_same_values()

    def has_conditions(self, bcs: list[Any], contacts: list[Contact | Tie]) -> bool:
        """Tell whether supports, contacts and nodes are those of the last update. Collective."""
        known, before = self.contacts, self.undeformed.prescribed
        if not (
            self._is_updated and len(known) == len(contacts) and all(map(is_, known, contacts))
        ):
            return False
        if self.torn.has_moved():
            return False
        now = prescribed_values(self.space, bcs)
        pairs = ((getattr(before, k), getattr(now, k)) for k in ("nodes", "components", "values"))
        return not any_rank(self.nodes.comm, [not np.array_equal(*pair) for pair in pairs])

    def system(self, origin: SlipOrigin, contact_set: ContactSet | None = None) -> TornSystem:
        """Return the torn system, with slip counted from its origin. Collective."""
        contact_set = contact_set or self.undeformed
        subdomains = contact_set.added_subdomains(self.bodies.deformable)
        return self.system_of(
            contact_set,
            [*self.torn.subdomains, *subdomains],
            contact_set.prescribed,
            contact_set.rows(),
            contact_set.tied_rows(),
            contact_set.friction_rows(origin),
        )

    def system_of(
        self,
        contact_set: ContactSet,
        subdomains: Sequence[Subdomain],
        prescribed: Prescribed,
        contacts: ContactRows,
        tied: ContactRows,
        friction: Friction,
    ) -> TornSystem:
        """Return the torn system of subdomains and rows, with the names of bodies and contacts."""
        return TornSystem(
            subdomains,
            prescribed,
            contacts,
            self.space.mesh.geometry.dim,
            [*self.bodies.names[: self.bodies.deformable], *contact_set.added_names],
            contact_set.names,
            self.nodes.comm,
            [f"Dirichlet condition {i}" for i in range(len(self.bcs))],
            tied,
            friction,
        )

    def tangents(self, contact_set: ContactSet) -> list[Subdomain]:
        """Return the subdomains with the present tangents and bodies. Collective."""
        return [*self.torn.assemble(), *contact_set.added_subdomains(self.bodies.deformable)]

    def spread(
        self, subdomains: Sequence[Subdomain], force: Vector, beyond: Vector
    ) -> list[Vector]:
        """Return nodal forces as loads of subdomains, shared at common nodes. Collective.

        The forces (owned, gdim) are at the nodes that this rank owns, those `beyond` (b, gdim) at
        nodes that are not of the mesh, the same on all ranks.
        """
        nodes, loads, known = self.nodes, list[Vector](), set[int]()
        shares = fill_owned(Function(self.space), (force / self._copies).ravel())
        values = nodes.values(shares)
        for s in subdomains:
            if s.nodes[0] < nodes.total:
                loads.append(values[nodes.to_local(s.nodes)].ravel())
                continue
            # of several subdomains at the nodes of a rigid body the first one
            is_first = int(s.nodes[0]) not in known
            known.add(int(s.nodes[0]))
            loads.append(is_first * beyond[s.nodes - nodes.total].ravel())
        return loads

    def at_owned_nodes(self, displacements: Sequence[Vector]) -> Vector:
        """Return displacements of subdomains at the degrees of freedom of this rank. Collective."""
        subdomains = self.torn.subdomains
        filled = fill_displacement(Function(self.space), subdomains, displacements)
        return owned_values(filled)

    def sum_at_nodes(self, subdomains: Sequence[Subdomain], forces: Sequence[Vector]) -> Vector:
        """Return the sums (owned, gdim) of forces on subdomains at the mesh's nodes. Collective."""
        nodes = self.nodes
        at = np.concatenate([np.zeros(0, dtype=np.int64), *(s.nodes for s in subdomains)])
        values = np.concatenate([np.zeros(0), *forces]).reshape(-1, nodes.components)
        in_mesh = at < nodes.total
        return nodes.reduce_at_owners(at[in_mesh], values[in_mesh])

    @cached_property
    def _copies(self) -> Vector:
        """The number of subdomains (owned, 1) that each node belongs to, at least 1. Collective."""
        at = np.concatenate([np.zeros(0, dtype=np.int64), *(s.nodes for s in self.torn.subdomains)])
        return np.maximum(self.nodes.reduce_at_owners(at, np.ones((at.size, 1))), 1.0)


def _check_rigid_tags(space: FunctionSpace, bodies: Bodies, rigid: Mapping[int, RigidBody]) -> None:
    """Check that rigid bodies have cells, and leave some to others; the same on all ranks."""
    if not rigid:
        return
    tags = [] if bodies.tags is None else np.unique(bodies.tags).tolist()
    for tag, body in rigid.items():
        if tag not in tags:
            raise InputError(
                f"rigid_bodies: {tag!r} is no tag of cell_tags, which have {tags}"
                if tags
                else "rigid_bodies: the bodies are those of the tags of cells; pass cell_tags too"
            )
        if body.gdim != space.mesh.geometry.dim:
            raise InputError(
                f"rigid_bodies: the reference point of the body with tag {tag} has {body.gdim} "
                f"coordinates, the mesh {space.mesh.geometry.dim}"
            )
    if not bodies.deformable:
        raise InputError("rigid_bodies: all bodies are rigid; leave a deformable one at least")

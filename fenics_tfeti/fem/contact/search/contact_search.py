"""The search for the conditions of contacts and ties (sec. 11.1, 11.5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, TypeVar

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function, FunctionSpace

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.checks import (
    check_depth,
    check_different_surfaces,
    check_opposite,
)
from fenics_tfeti.fem.contact.conditions.contact_conditions import ContactConditions
from fenics_tfeti.fem.contact.conditions.obstacle import match_obstacles
from fenics_tfeti.fem.contact.conditions.summary import warn_of_deviation
from fenics_tfeti.fem.contact.conditions.surface_pairs import NamedPair, match_pairs, user_gaps
from fenics_tfeti.fem.contact.conditions.ties import TiedConditions, rows_of_tie
from fenics_tfeti.fem.contact.contact_set import ContactSet, FoundContact, FoundTie
from fenics_tfeti.fem.contact.descriptions.contacts import (
    Contact,
    ContactPair,
    Patch,
    RigidObstacle,
    SelfContact,
)
from fenics_tfeti.fem.contact.descriptions.rigid_body import RigidBody
from fenics_tfeti.fem.contact.descriptions.roles import Roles
from fenics_tfeti.fem.contact.descriptions.surfaces import (
    SurfacePair,
    contact_keys,
    contact_name,
    free_key,
    surface_tags,
)
from fenics_tfeti.fem.contact.descriptions.ties import Tie, with_bonds
from fenics_tfeti.fem.contact.rigid.frames import BodyFrame, RigidBodies
from fenics_tfeti.fem.contact.rigid.nodes import RigidNodes
from fenics_tfeti.fem.contact.search.roles import nodal_stiffness, roles_ratios
from fenics_tfeti.fem.contact.search.self_contact import SelfPatches
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.displacement import prescribed_components
from fenics_tfeti.feti.system import Prescribed, Subdomain
from fenics_tfeti.feti.timer import Timer
from fenics_tfeti.parallel import raise_collectively, warn_on_first_rank
from fenics_tfeti.typing import Mask, Vector

Key = TypeVar("Key")
Pairing = TypeVar("Pairing", ContactConditions, TiedConditions)


class ContactSearch:
    """The search for the conditions of a problem's contacts and tied pairs.

    What was found is used again as long as the user's contacts and the nodes of the mesh are the
    same. It also decides, once for each pair, whether slave and master are exchanged. Obstacles are
    evaluated on the surfaces deformed by a displacement, if one is given. Where contacts follow the
    surfaces `deformed_by` another one, parts that face each other there are patches, and pairs that
    are not opposite each other have no conditions yet; otherwise they are an error.
    """

    def __init__(
        self,
        space: FunctionSpace,
        bodies: Bodies,
        measure_weight: Any,
        timer: Timer,
        displacement: Function | None = None,
        rigid: Mapping[int, RigidBody] | None = None,
        deformed_by: Function | None = None,
    ) -> None:
        self._deformed_by = deformed_by
        self._space, self._bodies, self._timer = space, bodies, timer
        self._rigid_tags = rigid or {}
        self._displacement = displacement
        self._measure_weight = measure_weight
        self._roles = dict[str, Roles]()  # of the last contacts, by key
        self._patches = dict[str, SelfPatches]()  # of surfaces that touch themselves, by key
        self._last: ContactSet | None = None
        self._find_boundary()

    def on_moved_nodes(self) -> ContactSearch:
        """Return the search on the mesh as it is now; roles are kept. Collective."""
        search = copy(self)
        search._last, search._patches = None, {}
        search._find_boundary()
        return search

    def _find_boundary(self) -> None:
        with self._timer.phase("contact search"):
            self.boundary = MeshBoundary.of(self._space, self._measure_weight)
            self.rigid = RigidNodes.of(
                self._space, self._bodies, self._rigid_tags, self.boundary.coordinates
            )

    def find(
        self,
        contacts: Sequence[Contact | Tie],
        prescribed: Prescribed,
        kept: Mapping[int, TiedConditions] | None = None,
    ) -> ContactSet:
        """Return the undeformed conditions; only what changed is searched again. Collective.

        Ties that are kept, by number, are not searched.
        """
        contacts = with_bonds(contacts)
        ties = {k: tie for k, tie in enumerate(contacts) if isinstance(tie, Tie)}
        given = {k: contact for k, contact in enumerate(contacts) if not isinstance(contact, Tie)}
        last_contacts = self._last.contacts if self._last else []
        known_keys: list[tuple[Any, str]] = [
            *((f.roles.given, f.contact_key) for f in last_contacts),
            *((patches.contact, key) for key, patches in self._patches.items()),
        ]
        keys = dict(zip(given, contact_keys([*given.values()], known_keys), strict=True))
        self.rigid.check_supports(prescribed)
        with self._timer.phase("contact search"):
            none = RigidBodies(self._space.mesh.comm, self._space.mesh.geometry.dim)
            last = self._last or ContactSet(self.boundary, [], [], prescribed, none, self.rigid)
            known = [(found.contact, found.undeformed) for found in last.contacts]
            others = {
                k: contact for k, contact in enumerate(contacts) if isinstance(contact, SurfacePair)
            }
            self._patches = self._patches_of(given, keys, others)
            touching = [
                (k, patch, roles)
                for k, contact in given.items()
                for patch, roles in enumerate(self._roles_of(contact, keys[k]))
            ]
            matched = match_parts(
                self.boundary,
                [roles.used for *_, roles in touching],
                known,
                prescribed,
                [contact_name(given[k], k) for k, *_ in touching],
                self._displacement,
            )
            # patches were found in the state that they are for
            of_tags = [
                parts
                for (*_, roles), parts in zip(touching, matched, strict=True)
                if not isinstance(roles.given, Patch)
            ]
            if self._deformed_by is None:
                check_opposite(of_tags)
            checked = {id(conditions) for _, conditions in known}
            new = [
                conditions
                for parts in of_tags
                for conditions in parts
                if id(conditions) not in checked
            ]
            check_depth(self._space, self._bodies, new)
            found_contacts = [
                FoundContact(
                    k, keys[k], roles, conditions, conditions, part=part, patch=patch
                ).placed(self.rigid)
                for (k, patch, roles), parts in zip(touching, matched, strict=True)
                for part, conditions in enumerate(parts)
            ]
            fixed = prescribed_components(self.boundary.nodes, prescribed)
            mortar = {id(f.tie): f.conditions for f in last.ties if f.conditions.is_mortar}
            old = {k: mortar[id(tie)] for k, tie in ties.items() if id(tie) in mortar}
            unchanged, found_ties = _unchanged(self.boundary, old, fixed) | dict(kept or {}), []
            preloads = {found.number: found.conditions.preload for found in last.ties}
            for k, tie in ties.items():
                tied = unchanged.get(k) or rows_of_tie(
                    self.boundary, tie, k, contact_name(tie, k), fixed, preloads.get(k)
                )
                master = self.rigid.master_of(tied.rows, tied.name)
                found_ties.append(FoundTie(k, tie, tied, master))
            bodies = self._rigid_bodies(found_contacts, last.bodies, len(contacts))
            found = ContactSet(
                self.boundary, found_contacts, found_ties, prescribed, bodies, self.rigid
            ).with_friction()
        self._last, self._roles = found, {f.contact_key: f.roles for f in found.contacts}
        return found

    def _patches_of(
        self,
        contacts: Mapping[int, Contact],
        keys: Mapping[int, str],
        others: Mapping[int, SurfacePair],
    ) -> dict[str, SelfPatches]:
        """Return the present patches of surfaces that touch themselves, by key. Collective."""
        patches = dict[str, SelfPatches]()
        for k, contact in contacts.items():
            if isinstance(contact, SelfContact):
                known, name = self._patches.get(keys[k]), contact_name(contact, k)
                if known is None or not known.is_for(contact, others):
                    is_far = self._deformed_by is not None
                    known = SelfPatches.of(self.boundary, contact, name, is_far, others)
                patches[keys[k]] = known = known.at(self._deformed_by)
                if known.is_empty and self._deformed_by is None:
                    warn_on_first_rank(
                        self._space.mesh.comm,
                        f"{name}: no part of the surface faces another one within "
                        f"{known.reach.max():.3g}, so nothing can meet: with small strains a "
                        "surface touches itself at cracks and slots only. Give it a larger "
                        "distance, or use NonlinearContactProblem",
                    )
        return patches

    def has_all_patches(self) -> bool:
        """Tell whether surfaces that touch themselves do so in their patches only. Collective."""
        return all(known.at(self._deformed_by) is known for known in self._patches.values())

    def lacks_contact(self, displacement: Function) -> bool:
        """Tell whether a surface has come near itself where it has no patch. Collective."""
        return any(known.lacks_contact(displacement) for known in self._patches.values())

    def left_inside(self, displacement: Function) -> dict[str, float]:
        """Return how deep surfaces are in themselves where no patch can be, by key. Collective."""
        depths = {key: known.left_inside(displacement) for key, known in self._patches.items()}
        return {key: depth for key, depth in depths.items() if depth > 0.0}

    def _roles_of(self, contact: Contact, key: str) -> list[Roles]:
        """Return the roles of a contact, or of its patches. Collective."""
        if isinstance(contact, SelfContact):
            pairs = self._patches[key].pairs
            return [Roles(pair, pair, are_decided=True) for pair in pairs]
        return [self._roles_of_contact(contact, key)]

    def _roles_of_contact(self, contact: Contact, key: str) -> Roles:
        """Return the roles of a contact; of a pair a rigid surface is the master. Collective."""
        roles = self._roles.get(key)
        if roles is not None and roles.given is contact:
            return roles
        roles = Roles(contact, contact)
        if isinstance(contact, ContactPair):
            is_rigid = [
                self.rigid.on_surface(contact.facet_tags, tag) for tag in surface_tags(contact)
            ]
            if is_rigid == [True, False] and roles.may_exchange:
                return roles.exchanged()
        return roles

    def _rigid_bodies(
        self, contacts: Sequence[FoundContact], known: RigidBodies, bolts: int
    ) -> RigidBodies:
        """Return the rigid bodies, with nodes after those of the mesh and of bolts. Collective."""
        comm, gdim = self._space.mesh.comm, self._space.mesh.geometry.dim
        of_contacts = [found.body for found in contacts if found.body is not None]
        bodies = list(dict.fromkeys([*self.rigid.bodies, *of_contacts]))
        for found in contacts:
            if found.body is not None and found.body.gdim != gdim:
                raise InputError(
                    f"{found.conditions.name}: the reference point of the body has "
                    f"{found.body.gdim} coordinates, the mesh {gdim}"
                )

        def box_of(body: RigidBody) -> Vector:
            on = [found.on_body for found in contacts if found.body is body]
            parts = [part.places for part in on if part is not None]
            x = np.concatenate([*parts, self.rigid.places_of(body)])
            box = np.array([x.min(axis=0, initial=np.inf), -x.max(axis=0, initial=-np.inf)])
            comm.Allreduce(MPI.IN_PLACE, box, MPI.MIN)
            return np.array([box[0], -box[1]])

        keys = list[str]()
        for body in bodies:
            keys.append(free_key(self._label(body, contacts), keys))
        frames = [
            BodyFrame.undeformed(
                body,
                keys[k],
                body.name or f"rigid body {k}",
                box_of(body),
                self.boundary.nodes.total + bolts + k * (gdim + 1),
                self._bodies.deformable + k,
                known.frames[k] if k < len(known.frames) else None,
            )
            for k, body in enumerate(bodies)
        ]
        return RigidBodies(comm, gdim, frames)

    def _label(self, body: RigidBody, contacts: Sequence[FoundContact]) -> str:
        """Return by what a body is known: its name, the tag of its cells, or its first contact."""
        if body.name:
            return repr(body.name)
        labels = [f"cells with tag {tag}" for tag, b in self._rigid_tags.items() if b is body]
        return [*labels, *(f"body of {f.key}" for f in contacts if f.body is body)][0]

    def with_roles(
        self, found: ContactSet, contacts: Sequence[Contact | Tie], torn: Sequence[Subdomain]
    ) -> ContactSet:
        """Exchange slave and master of new pairs where that is better and wanted, or warn."""
        comm = self._space.mesh.comm
        new = [
            index
            for index, entry in enumerate(found.contacts)
            if isinstance(entry.contact, ContactPair) and not entry.roles.are_decided
        ]
        if not new:
            return found
        stiffness = nodal_stiffness(self.boundary.nodes, torn)
        all_conditions = [found.contacts[index].undeformed for index in new]
        ratios, poor = roles_ratios(comm, all_conditions, stiffness), dict[str, Roles]()
        of_contacts: dict[str, tuple[Roles, list[float]]] = {}
        for index, of_part in zip(new, ratios, strict=True):
            entry = found.contacts[index]
            of_parts = of_contacts.setdefault(entry.contact_key, (entry.roles, []))[1]
            of_parts += [] if of_part is None else [of_part]
        for key, (undecided, of_parts) in of_contacts.items():
            roles, ratio = replace(undecided, are_decided=True), max(of_parts, default=None)
            if roles.used is roles.given and ratio is not None:
                roles = replace(roles, ratio=ratio).kept()
                if roles.are_better_exchanged:
                    poor[key] = roles
            self._roles[key] = roles
        found = self._with_exchanged(found, contacts, poor)
        decided = list(found.contacts)
        for index in new:
            decided[index] = replace(decided[index], roles=self._roles[decided[index].contact_key])
        with raise_collectively(comm):
            for index in new if comm.rank == 0 else ():
                entry = decided[index]
                entry.roles.warn(entry.conditions.name)
                warn_of_deviation(entry.undeformed.summary)
        return replace(found, contacts=decided)

    def _with_exchanged(
        self, found: ContactSet, contacts: Sequence[Contact | Tie], poor: Mapping[str, Roles]
    ) -> ContactSet:
        """Find conditions anew with poor roles of pairs exchanged, where that is possible.

        Some surfaces can be masters only, as folded ones, or masters of other pairs: those pairs
        are found by halves.
        """
        if not poor:
            return found
        self._roles |= {key: roles.exchanged() for key, roles in poor.items()}
        try:
            exchanged = self.find(contacts, found.prescribed)
            of_poor: dict[str, list[ContactConditions]] = {key: [] for key in poor}
            for part in exchanged.contacts:
                of_poor.get(part.contact_key, []).append(part.conditions)
            check_opposite([*of_poor.values()])
            return exchanged
        except InputError as error:
            obstacle = str(error)
        self._roles |= {key: roles.kept(obstacle) for key, roles in poor.items()}
        if len(poor) == 1:
            return found
        pairs, half = list(poor.items()), len(poor) // 2
        found = self._with_exchanged(found, contacts, dict(pairs[:half]))
        return self._with_exchanged(found, contacts, dict(pairs[half:]))


def match_parts(
    boundary: MeshBoundary,
    contacts: Sequence[Contact],
    known: Sequence[tuple[Contact, ContactConditions]] = (),
    prescribed: Prescribed | None = None,
    names: Sequence[str] | None = None,
    displacement: Function | None = None,
) -> list[list[ContactConditions]]:
    """Match the surfaces of all contacts, and check that new ones join no others. Collective.

    Each contact has one or more parts, see `match_pairs`. Of the known results, pairs are not
    searched again, obstacles are evaluated again. Prescribed displacements of this rank's nodes
    tell planes of symmetry. By default contacts without a name get one by their place. Obstacles
    are evaluated on surfaces deformed by a displacement, if one is given.
    """
    comm, earlier = boundary.nodes.comm, dict[int, list[ContactConditions]]()
    for contact, conditions in known:
        earlier.setdefault(id(contact), []).append(conditions)
    deformed = None
    if displacement is not None:
        displacement.x.scatter_forward()
        deformed = boundary.deformed(displacement)
    if any(id(contact) not in earlier for contact in contacts):
        check_different_surfaces(contacts, comm)
    names = names or [contact_name(contact, k) for k, contact in enumerate(contacts)]
    pairs = {
        k: (name, contact)
        for k, (name, contact) in enumerate(zip(names, contacts, strict=True))
        if isinstance(contact, ContactPair)
    }
    fixed = prescribed_components(boundary.nodes, prescribed or Prescribed())
    old = {
        (k, part): conditions
        for k, (_, pair) in pairs.items()
        for part, conditions in enumerate(earlier.get(id(pair), []))
    }
    unchanged = _unchanged(boundary, old, fixed)
    changed = {k for k, _ in old.keys() - unchanged.keys()}
    found: dict[int, list[ContactConditions]] = {}
    for (k, _), conditions in unchanged.items():
        if k not in changed:
            found.setdefault(k, []).append(_refreshed(pairs[k], conditions))
    pairs = {k: pair for k, pair in pairs.items() if k not in found}
    found |= dict(zip(pairs, match_pairs(boundary, [*pairs.values()], fixed), strict=True))
    obstacles = {
        k: (name, contact)
        for k, (name, contact) in enumerate(zip(names, contacts, strict=True))
        if isinstance(contact, RigidObstacle)
    }
    last = [next(iter(earlier.get(id(contact), [])), None) for _, contact in obstacles.values()]
    matched = match_obstacles(boundary, [*obstacles.values()], last, deformed)
    found |= {k: [conditions] for k, conditions in zip(obstacles, matched, strict=True)}
    return [found[k] for k in range(len(contacts))]


def _unchanged(
    boundary: MeshBoundary, known: Mapping[Key, Pairing], fixed: Mask
) -> dict[Key, Pairing]:
    """Return the earlier results that hold still. Collective.

    They are pairs of nodes, but for areas with a weight, which may have changed, and mortar
    conditions if they have no weight and the same components are prescribed.
    """
    holds = np.ones(len(known), dtype=bool)
    for row, old in enumerate(known.values()):
        if old.prescribed is not None:
            assert old.surface is not None
            same = np.array_equal(fixed[old.surface.local], old.prescribed)
            holds[row] = boundary.weight is None and same
    boundary.nodes.comm.Allreduce(MPI.IN_PLACE, holds, MPI.LAND)
    return {k: old for (k, old), kept in zip(known.items(), holds, strict=True) if kept}


def _refreshed(pair: NamedPair, old: ContactConditions) -> ContactConditions:
    """Return earlier conditions with what may have changed of the user's data. Collective."""
    (name, contact), surface = pair, old.surface
    if callable(contact.initial_gap):
        gap = user_gaps(surface.comm, contact.initial_gap, old.coordinates, name)
        old = replace(old, gap=gap)
    if surface.boundary.weight is None:
        return old
    return replace(old, area=surface.areas(old.covered)[old.on_surface])

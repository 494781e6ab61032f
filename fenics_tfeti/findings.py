"""Findings after a solve that a user should look at: the list *to check* of the report.

A finding is a sentence with the names of contacts or bodies, the same on all ranks. The texts of
warnings are findings, too (`fenics_tfeti.errors.keep_warnings`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from fenics_tfeti.errors import InputError, first_few
from fenics_tfeti.fem.contact.contact_set import FoundContact
from fenics_tfeti.fem.contact.descriptions.contacts import ContactPair, RigidObstacle
from fenics_tfeti.fem.contact.solution.apart import contacts_apart
from fenics_tfeti.fem.contact.solution.results import RigidBodyResult
from fenics_tfeti.fem.contact.solution.solved import SolvedContacts
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.displacement import prescribed_components
from fenics_tfeti.fem.gradients import LARGE_GRADIENT
from fenics_tfeti.fem.nodes import ContactNodes
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.parallel import any_rank, largest_of_groups, largest_of_ranks
from fenics_tfeti.typing import Array, Mask, Numbers, Vector

# contacts that a sentence names
_NAMES = 4
# depth of an overlap of meshes, relative to the size of facets, that is more than their deviation
_OVERLAP = 0.1
# nodes across a region that presses from which on its pressures are resolved
_RESOLVED = 5
# contacts are told with a larger share of their force in narrower regions, and a larger force
# relative to the largest one of a contact
_NARROW, _LOADED = 0.5, 0.01
# difference of solutions of the same problem, relative to the displacement
_SAME = 1e-4
# opening of a node that is open, relative to the displacement
_OPEN = 1e-6
# nodes between bonds that have failed and those without damage from which on cracks are resolved;
# opening at failure, relative to the elastic one, beyond which passes on the damage may not end
_ZONE, _STIFF = 3, 50.0
# strains that are more than rounding, and less than those of structures that carry a load
_UNSTRAINED = (1e-13, 1e-8)


def contact_findings(solved: SolvedContacts, bodies: Bodies, length: str) -> list[str]:
    """Return what there is to check about contacts, lengths with a unit. Collective."""
    if not solved.contacts:
        return []
    contacts = _Contacts(solved)
    return [
        *contacts.without_unknowns(),
        *contacts.untouched(length),
        *contacts.unresolved(),
        *contacts.overlapping(length),
        *contacts.deep_obstacles(bodies, length),
    ]


def bond_findings(solved: SolvedContacts, length: str) -> list[str]:
    """Return what there is to check about bonds that break. Collective."""
    bonded = solved.contact_set.bonded
    if not bonded:
        return []
    comm, texts = solved.contact_set.boundary.nodes.comm, list[str]()
    for found, bonds, _ in bonded:
        largest = largest_of_ranks(comm, bonds.ductility)
        if largest > _STIFF:
            texts.append(
                f"{found.conditions.name!r} has bonds that fail at {largest:.0f} times the opening "
                "at which they soften: many passes, or none that end. Give them a smaller "
                "stiffness, or leave it out: closed surfaces are hard in any case"
            )
    if any_rank(comm, [np.any(bonds.bonded & (damage >= 1.0)) for _, bonds, damage in bonded]):
        texts += _Contacts(solved).short_zones(length)
    return texts


def apart_findings(solved: SolvedContacts) -> list[str]:
    """Name contacts whose deformed surfaces are opposite nothing. Collective."""
    apart = list[list[FoundContact]]()
    # obstacles of the user may have no value where a failure has left the surfaces
    with suppress(InputError):
        apart = contacts_apart(solved.contact_set, solved.displacement)
    return [
        f"{parts[0].conditions.name!r} has not met anything: its surfaces are nowhere opposite "
        "each other"
        for parts in apart
    ]


def self_findings(depths: Mapping[str, float], length: str) -> list[str]:
    """Say how deep surfaces are in themselves where they have no conditions, by their keys."""
    return [
        f"{key}: the surface is inside itself by up to {depth:.2g} {length}, at a turn or end "
        "where facets would be slave and master at once: refine the mesh there"
        for key, depth in depths.items()
    ]


def strain_findings(largest_strain: float) -> list[str]:
    """Return what there is to check about strains out of all proportion."""
    least, small = _UNSTRAINED
    if not least < largest_strain < small:
        return []
    return [
        f"the largest strain is {largest_strain:.1g}: do the units fit? With lengths in mm, "
        "Young's modulus is in MPa"
    ]


def unaccepted_step(solved: SolvedContacts, u: Vector, before: Vector | None) -> list[str]:
    """Return what there is to check about the history in another step than the last. Collective.

    The displacements (n,) of this rank are those of both solves, if the last was not accepted.
    """
    contacts = solved.contact_set.contacts
    rubs = any(found.friction is not None for found in contacts)
    breaks = any(found.law is not None and found.law.damage is not None for found in contacts)
    if before is None or not (rubs or breaks):
        return []
    comm = solved.contact_set.boundary.nodes.comm
    if largest_of_ranks(comm, np.abs(u - before)) <= _SAME * largest_of_ranks(comm, np.abs(u)):
        return []
    what = " and ".join(["friction counts slip"] * rubs + ["damage grows"] * breaks)
    return [f"{what} from the same state as the last solve: advance() accepts a load step"]


class _Contacts:
    """The conditions of all contacts of a solution, one contact after the other."""

    def __init__(self, solved: SolvedContacts) -> None:
        self._solved, self._found = solved, solved.contact_set.contacts
        self._nodes = solved.contact_set.boundary.nodes
        self._comm = self._nodes.comm
        self._names = {found.number: repr(found.conditions.name) for found in self._found}
        results = solved.contacts
        self._number = self._numbers([result.active.size for result in results])
        self._acts = np.concatenate([result.nodal_normal_force != 0.0 for result in results])
        self._opening = np.concatenate([result.opening for result in results])

    def untouched(self, length: str) -> list[str]:
        """Say how far the nearest contact is open where none presses or pulls. Collective."""
        if any_rank(self._comm, self._acts) or self.without_unknowns():
            return []
        gaps = -self._extremes(-self._opening, self._number, -np.inf)
        nearest = min(self._names, key=gaps.__getitem__)
        gap, name = gaps[nearest], self._names[nearest]
        if gap <= _least_opening(self._solved):
            return [f"nothing presses: {name} is closed without a force"]
        how = f"is open by {gap:.3g} {length}" if np.isfinite(gap) else "is opposite nothing"
        return [f"nothing touches: {name} {how}"]

    def without_unknowns(self) -> list[str]:
        """Name contacts with prescribed displacements in all conditions. Collective."""
        terms = [found.conditions.terms for found in self._found]
        prescribed = prescribed_components(self._nodes, self._solved.contact_set.prescribed)
        fixed = self._nodes.values_at(prescribed, np.concatenate([t.nodes for t in terms]))
        normal = np.concatenate([f.conditions.normal[f.conditions.terms.row] for f in self._found])
        moves = (~fixed & (np.abs(normal) > RELATIVE_ROUNDING)).any(axis=1)
        of_body = [f.on_body is not None or f.rigid_master is not None for f in self._found]
        moves |= np.repeat(of_body, [t.nodes.size for t in terms])
        number = self._numbers([t.nodes.size for t in terms])
        conditions, moving = self._sums((self._number, None), (number, moves))
        return [
            f"{name}: displacements are prescribed in all of its {conditions[k]:.0f} conditions: "
            "none is left"
            for k, name in self._names.items()
            if conditions[k] and not moving[k]
        ]

    def overlapping(self, length: str) -> list[str]:
        """Say how far meshes overlap by more than their facets do. Collective."""
        undeformed = [found.undeformed for found in self._found]
        gap = np.concatenate([conditions.gap for conditions in undeformed])
        size = np.concatenate([p.surface.size[p.on_surface] for p in undeformed])
        sizes = [conditions.gap.size for conditions in undeformed]
        number = self._numbers(sizes)
        is_drawn = np.repeat([_has_drawn_gap(found) for found in self._found], sizes)
        deep = is_drawn & (gap < -_OVERLAP * size)
        counts, overlaps = self._sums((number, None), (number, deep))
        depth = self._extremes(-gap, number, 0.0)
        return [
            f"{name}: the bodies overlap by up to {depth[k]:.3g} {length} at {overlaps[k]:.0f} of "
            f"{counts[k]:.0f} nodes: drawn so?"
            for k, name in self._names.items()
            if overlaps[k]
        ]

    def unresolved(self) -> list[str]:
        """Name contacts that press with few nodes across. Collective."""
        depth, resolved, pressing = self._depths()
        narrow = pressing.mask & ~resolved
        force, in_narrow = self._sums(
            (pressing.contact, pressing.force), (pressing.contact, pressing.force * narrow)
        )
        told = (in_narrow > _NARROW * force) & (force > _LOADED * force.max())
        # a node in the middle, or a facet between two
        deepest = self._extremes(depth * narrow, pressing.contact, 0.0)
        is_deepest = narrow & (depth == deepest[pressing.contact])
        of_facets = pressing.at_corners(is_deepest).all(axis=1)
        is_even = self._extremes(of_facets.astype(float), pressing.facet_contact, 0.0)
        vertices = 2.0 * deepest - 1.0 + is_even
        across = self._solved.contact_set.boundary.degree * (vertices - 1.0) + 1.0
        names = [f"{name} ({across[k]:.0f})" for k, name in self._names.items() if told[k]]
        if not names:
            return []
        listed = ", ".join(first_few(names, _NAMES, "contacts"))
        return [
            f"fewer than {_RESOLVED} nodes press across {listed}: pressures there are not "
            "resolved, refine the mesh"
        ]

    def _depths(self) -> tuple[Vector, Mask, _Pressing]:
        """Return how many facets inside what presses nodes are, and which of it is wide.

        Depths count up to what is resolved. Where a surface ends in what presses, it ends there or
        at a plane of symmetry. Collective.
        """
        pressing = _Pressing.of(self._solved)
        degree = self._solved.contact_set.boundary.degree
        layers = (_RESOLVED - 1) // (2 * degree)
        depth, near = np.ones(pressing.mask.size), pressing.is_open
        for _ in range(layers):
            near = pressing.passed_on(near)
            depth += pressing.mask & ~near
        wide = pressing.mask & ~near
        for _ in range(layers):
            wide = pressing.passed_on(wide)
        return depth, wide, pressing

    def short_zones(self, length: str) -> list[str]:
        """Name contacts with few nodes where bonds soften before a crack. Collective."""
        surfaces = _Pressing.of(self._solved)
        failed, intact = (np.zeros(surfaces.contact.size, dtype=bool) for _ in range(2))
        size, numbers = np.zeros(surfaces.contact.size), dict[int, Numbers]()
        for found, rows in zip(self._found, self._solved.contact_set.positions, strict=True):
            numbers[id(found)] = surfaces.place[rows]
        for found, bonds, damage in self._solved.contact_set.bonded:
            place = numbers[id(found)]
            size[place] = found.conditions.surface.size[found.conditions.on_surface]
            failed[place] = bonds.bonded & (damage >= 1.0)
            intact[place] = bonds.bonded & (damage <= 0.0)
        texts, near = dict[int, str](), failed
        for softening in range(_ZONE):
            near = surfaces.passed_on(near)
            met = self._extremes(np.where(near & intact, size, 0.0), surfaces.contact, 0.0)
            for k, name in self._names.items():
                if met[k] > 0.0 and k not in texts:
                    texts[k] = (
                        f"{name} softens at {softening} nodes before its crack, over about "
                        f"{(softening + 1) * met[k]:.2g} {length} with facets of {met[k]:.2g} "
                        f"{length}: bodies are too strong where it is fewer than {_ZONE}. Refine "
                        "the mesh along the bond, or take a smaller strength with the same energy"
                    )
        return list(texts.values())

    def deep_obstacles(self, bodies: Bodies, length: str) -> list[str]:
        """Name obstacles that are deeper in a body than this is long. Collective."""
        obstacles = [f for f in self._found if isinstance(f.contact, RigidObstacle)]
        if not any_rank(self._comm, [(f.undeformed.gap < 0.0).any() for f in obstacles]):
            return []
        body_of = self._nodes.reduced_over_cells(bodies.of_cell, np.minimum)
        size, deepest = bodies.extent.max(axis=1), dict[int, tuple[float, int]]()
        for found in obstacles:
            conditions = found.undeformed
            body = body_of[conditions.slave - self._nodes.first]
            excess = -conditions.gap - size[body]
            if excess.max(initial=0.0) > 0.0:
                k = int(excess.argmax())
                own = (float(-conditions.gap[k]), int(body[k]))
                deepest[found.number] = max(deepest.get(found.number, own), own)
        merged: dict[int, tuple[float, int]] = {}
        for of_rank in self._comm.allgather(deepest):
            for number, entry in of_rank.items():
                merged[number] = max(merged.get(number, entry), entry)
        return [
            f"{self._names[number]}: the obstacle is {depth:.4g} {length} deep in "
            f"{bodies.labels[body]}, which is {size[body]:.4g} {length} long: is it in its place?"
            for number, (depth, body) in sorted(merged.items())
        ]

    def _numbers(self, sizes: Sequence[int]) -> Numbers:
        """Return the contact of each of some rows of the found contacts."""
        return np.repeat([found.number for found in self._found], sizes)

    def _sums(self, *columns: tuple[Numbers, Array | None]) -> Vector:
        """Return the sums of values, by default of ones, of each contact. Collective."""
        count = max(self._names) + 1
        sums = [np.bincount(numbers, values, count) for numbers, values in columns]
        return self._comm.allreduce(np.array(sums, dtype=float))

    def _extremes(self, values: Vector, number: Numbers, least: float) -> Vector:
        """Return the largest value of each contact, and no less. Collective."""
        return largest_of_groups(self._comm, values, number, max(self._names) + 1, least)


@dataclass(frozen=True)
class _Pressing:
    """Where contacts press and where they are open, at the nodes of their slaves' surfaces.

    Each contact has nodes of its own, of which this rank owns n; those without a condition neither
    press nor are open.
    """

    nodes: ContactNodes
    vertices: Numbers  # (f, v): the nodes of this rank's facets
    facet_contact: Numbers  # (f,)
    contact: Numbers  # (n,)
    mask: Mask  # (n,): where it presses
    is_open: Mask  # (n,)
    force: Vector  # (n,) [N]
    place: Numbers  # of the conditions of all contacts, one after the other, among the nodes

    @staticmethod
    def of(solved: SolvedContacts) -> _Pressing:
        """Find the facets of all slaves, and what their nodes do. Collective."""
        found, results = solved.contact_set.contacts, solved.contacts
        mesh_nodes, surfaces = (
            solved.contact_set.boundary.nodes,
            [f.conditions.surface for f in found],
        )
        numbers = np.array([f.number for f in found])
        facet_contact = np.repeat(numbers, [len(surface.vertices) for surface in surfaces])
        local = np.concatenate([surface.vertices for surface in surfaces])
        nodes = ContactNodes(mesh_nodes, local, facet_contact)
        assert nodes.contact is not None
        contact = nodes.contact[: nodes.owned]
        originals = nodes.copied(np.arange(mesh_nodes.size))[: nodes.owned]
        keys = np.repeat(numbers, [r.dofs.size for r in results]) * mesh_nodes.size
        keys += np.concatenate([r.dofs for r in results])
        place = np.searchsorted(contact * mesh_nodes.size + originals, keys)
        least = _least_opening(solved)
        opening = np.concatenate([r.opening for r in results])
        force = np.zeros(nodes.owned)
        np.add.at(force, place, np.concatenate([r.nodal_normal_force for r in results]))
        is_open = np.zeros(nodes.owned, dtype=bool)
        is_open[place[opening > least]] = True
        mask = force > 0.0
        vertices = nodes.to_global(nodes.facet_nodes)
        is_open &= ~mask
        return _Pressing(nodes, vertices, facet_contact, contact, mask, is_open, force, place)

    def at_corners(self, values: Array) -> Array:
        """Return values (n,) at the corners of facets (f, v). Collective."""
        return self.nodes.values_at(values, self.vertices)

    def passed_on(self, mask: Mask) -> Mask:
        """Return the nodes (n,) of facets with a node in a mask. Collective."""
        any_corner = self.at_corners(mask).any(axis=1)
        flat = np.repeat(any_corner, self.vertices.shape[1])
        return self.nodes.reduce_at_owners(self.vertices.ravel(), flat, np.logical_or)


def _least_opening(solved: SolvedContacts) -> float:
    """Return the opening [m] of nodes that are open, not closed without a force. Collective."""
    comm = solved.contact_set.boundary.nodes.comm
    return _OPEN * largest_of_ranks(comm, np.abs(solved.displacement.x.array))


def _has_drawn_gap(found: FoundContact) -> bool:
    """Tell whether the gap is that of the meshes of two deformable bodies."""
    contact = found.contact
    return isinstance(contact, ContactPair) and contact.initial_gap == "geometric"


def large_rotations(bodies: Iterable[RigidBodyResult]) -> list[str]:
    """Name rigid bodies whose rotation is not small; the same on all ranks."""
    angles = {body.name: float(np.linalg.norm(body.rotation)) for body in bodies}
    return [
        f"{name} turns by {angle:.2g} rad, but rotations are small here: its points move along "
        "straight lines, and normals stay as they are. gaps=Deformed() turns it by any angle"
        for name, angle in angles.items()
        if angle > LARGE_GRADIENT
    ]

"""Surfaces that stay together: the mortar conditions of all components as equalities."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fenics_tfeti.fem.contact.checks import check_separate
from fenics_tfeti.fem.contact.contact import Conditions
from fenics_tfeti.fem.contact.description import TiedPair
from fenics_tfeti.fem.contact.mortar.conditions import MortarConditions, tied_conditions
from fenics_tfeti.fem.contact.mortar.pairing import check_covered
from fenics_tfeti.fem.contact.pairing_summary import pairing_summary
from fenics_tfeti.fem.contact.surfaces.nearby import gather_nearby
from fenics_tfeti.fem.contact.surfaces.symmetry_planes import prescribed_components, still_holds
from fenics_tfeti.fem.contact.surfaces.tagged import (
    MeshBoundary,
    Surface,
    tagged_surface,
)
from fenics_tfeti.fem.messages import raise_where
from fenics_tfeti.feti.system import ContactRows, Prescribed, Subdomain
from fenics_tfeti.parallel import concatenate_ranks, raise_collectively
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class Preload:
    """The shortening of a bolt, given or an unknown of the torn system."""

    axis: Vector  # (gdim,), on the side of the slave's outward normal
    shortening: float | None  # [m]
    # without load: the body that the shortening moves along the axis where the force is given
    body: Subdomain | None = None
    force: float = 0.0  # [N]

    def subdomain(self, number: int) -> Subdomain:
        """Return the body with a number and the present load."""
        assert self.body is not None
        return replace(self.body, body=number, load=self.force * self.axis)


@dataclass(frozen=True)
class TiedPairing:
    """The equality rows of a tie whose slave nodes this rank owns."""

    name: str
    rows: ContactRows  # the normals are directions of the slave's displacement
    nodes: Numbers  # (k,): slave nodes, ascending
    coordinates: Vector  # (k, 3): of the slave nodes [m]
    area: Vector  # (k,): that belongs to each; NaN where there is none [m^2 or m]
    summary: dict[str, Any]  # the tie's entry of `Report.pairing`
    # of mortar conditions the slave's surface, and the components (s, gdim) prescribed at its nodes
    surface: Surface | None = None
    prescribed: Mask | None = None
    preload: Preload | None = None  # of bolts

    def forces(self, row_forces: Vector) -> Vector:
        """Return the forces (k, gdim) on the slave nodes of those of the rows [N]."""
        force = np.zeros((self.nodes.size, self.rows.coefficients.shape[1]))
        # the force of a row acts on the slave against its direction
        position = np.searchsorted(self.nodes, self.rows.slave)
        np.subtract.at(force, position, row_forces[:, None] * self.rows.normal)
        return force

    def still_holds(self, prescribed: Prescribed) -> bool:
        """Tell whether mortar conditions hold that were found with other supports. Collective."""
        if self.surface is None or self.prescribed is None:
            return False
        return still_holds(self.surface, prescribed, self.prescribed)


def tie_surfaces(
    boundary: MeshBoundary, pair: TiedPair, name: str, prescribed: Prescribed
) -> TiedPairing:
    """Find the conditions of a tied pair. Collective."""
    tags, comm = pair.facet_tags, boundary.nodes.comm
    slave = tagged_surface(boundary, tags, pair.slave, f"slave of {name}")
    tagged_master = tagged_surface(boundary, tags, pair.master, f"master of {name}")
    master = gather_nearby(tagged_master, slave)
    with raise_collectively(comm):
        master.check_not_folded(name)
    check_separate(
        slave,
        master.nodes,
        name,
        "Surfaces that share nodes are one already: leave the pair out, or give each part nodes of "
        "its own by fenics_tfeti.io.split_interfaces",
    )
    fixed = prescribed_components(slave, prescribed)
    conditions = tied_conditions(slave, slave.oriented_part(), master, fixed)
    # nodes where a component is prescribed have no condition for it
    largest = int(np.argmax([comm.allreduce(component.slave.size) for component in conditions]))
    fullest = conditions[largest]
    check_covered(fullest, slave, name)
    _check_together(fullest, slave, name)
    rows = np.searchsorted(slave.nodes, fullest.slave)
    gap = np.sum(fullest.gap * slave.normal[rows], axis=1)
    summary = pairing_summary(
        comm,
        name,
        "tied",
        gap,
        fullest.angle,
        slave.nodes.size,
        area=fullest.area,
        covered_area=fullest.covered_area,
    )
    nodes = np.unique(np.concatenate([part.slave for part in conditions]))
    area = np.zeros(nodes.size)
    for part in conditions:
        area[np.searchsorted(nodes, part.slave)] = part.area
    components = [
        Conditions(c.terms, np.tile(axis, (c.slave.size, 1)), np.zeros(c.slave.size), c.area)
        for c, axis in zip(conditions, np.eye(len(conditions)), strict=True)
    ]
    return TiedPairing(
        name,
        ContactRows.concatenate([component.rows(0) for component in components]),
        nodes,
        slave.coordinates[np.searchsorted(slave.nodes, nodes)],
        area,
        summary,
        slave,
        fixed,
    )


def _check_together(conditions: MortarConditions, slave: Surface, name: str) -> None:
    """Check that surfaces are no farther apart than facets are large: rotations would be held."""
    rows = np.searchsorted(slave.nodes, conditions.slave)
    distance = np.linalg.norm(conditions.gap, axis=1)
    largest = concatenate_ranks(slave.comm, distance).max(initial=0.0)
    raise_where(
        slave.comm,
        distance > 0.5 * slave.size[rows],
        slave.points[rows],
        lambda number, place: (
            f"{name}: the surfaces are apart, or overlap, by more than half a facet at {number} "
            f"slave nodes, by up to {largest:.3g}, the first at {place}. Tie surfaces that lie on "
            "each other"
        ),
    )

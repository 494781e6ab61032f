"""Surfaces that stay together: the mortar conditions of all components as equalities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.fem.contact.contact import Conditions
from fenics_tfeti.fem.contact.description import TiedPair, tied_name
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
from fenics_tfeti.feti.system import ContactRows, Prescribed
from fenics_tfeti.parallel import concatenate_ranks, raise_collectively


@dataclass(frozen=True)
class TiedPairing:
    """The conditions of a tied pair at the slave nodes that this rank owns."""

    name: str
    components: list[Conditions]  # equalities for each component of the displacement
    summary: dict[str, Any]  # the pair's entry of `Report.pairing`
    surface: Surface  # that of the slave
    prescribed: NDArray[np.bool_]  # (s, gdim): components prescribed at its nodes


def tie(boundary: MeshBoundary, pair: TiedPair, number: int, prescribed: Prescribed) -> TiedPairing:
    """Find the conditions of a tied pair. Collective."""
    name, tags, comm = tied_name(pair, number), pair.facet_tags, boundary.nodes.comm
    slave = tagged_surface(boundary, tags, pair.slave, f"slave of {name}")
    tagged_master = tagged_surface(boundary, tags, pair.master, f"master of {name}")
    master = gather_nearby(tagged_master, slave)
    with raise_collectively(comm):
        master.check_not_folded(name)
    _check_separate(slave, master.nodes, name)
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
    components = [
        Conditions(c.terms, np.tile(axis, (c.slave.size, 1)), np.zeros(c.slave.size), c.area)
        for c, axis in zip(conditions, np.eye(len(conditions)), strict=True)
    ]
    return TiedPairing(name, components, summary, slave, fixed)


def tie_pairs(
    boundary: MeshBoundary,
    pairs: Mapping[int, TiedPair],
    known: Sequence[tuple[TiedPair, TiedPairing]],
    prescribed: Prescribed,
) -> dict[int, TiedPairing]:
    """Find the conditions of all tied pairs, by number. Collective.

    Known results hold as long as the same components are prescribed.
    """
    earlier = {id(pair): pairing for pair, pairing in known}
    pairings = {}
    for number, pair in pairs.items():
        pairing = earlier.get(id(pair))
        if pairing is None or not still_holds(pairing.surface, prescribed, pairing.prescribed):
            pairing = tie(boundary, pair, number, prescribed)
        pairings[number] = pairing
    return pairings


def tied_rows(pairings: Sequence[TiedPairing], gdim: int) -> ContactRows:
    """Return the conditions of all tied pairs, the components of a pair one after the other."""
    if not pairings:
        return ContactRows.none(gdim)
    return ContactRows.concatenate(
        [
            conditions.rows(number)
            for number, pairing in enumerate(pairings)
            for conditions in pairing.components
        ]
    )


def _check_separate(slave: Surface, master: NDArray[np.int64], name: str) -> None:
    raise_where(
        slave.comm,
        np.isin(slave.nodes, master),
        slave.points,
        lambda number, place: (
            f"{name}: slave and master share {number} nodes, the first at {place}. Surfaces that "
            "share nodes are one already: leave the pair out, or give each part nodes of its own "
            "by fenics_tfeti.io.split_interfaces"
        ),
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

"""Checks of surfaces that mortar conditions couple."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.mortar.conditions import MortarConditions, SlaveFacets
from fenics_tfeti.fem.contact.mortar.facets import Planes
from fenics_tfeti.fem.contact.surfaces.tagged import Surface
from fenics_tfeti.fem.messages import raise_where
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.parallel import Directory


def check_covered(
    comm: MPI.Intracomm, conditions: MortarConditions, slave: Surface, name: str
) -> None:
    """Check that the master covers a part of the slave, and more than slivers. Collective."""
    facets, rows = comm.allreduce(
        np.array([int(conditions.covered.sum()), conditions.slave.size])
    ).tolist()
    if not facets:
        raise InputError(
            f"{name}: no facet of the slave has a facet of the master opposite it: along the "
            "normals the surfaces never meet, or they face away from each other. Surfaces that "
            "touch face each other: is one of the tags on the far side of its body, or on another "
            "body?"
        )
    if not rows:
        raise_where(
            comm,
            np.ones(slave.nodes.size, dtype=bool),
            slave.points,
            lambda number, place: (
                f"{name}: the master covers slivers of {facets} slave facets only, too little for "
                f"any of the {number} slave nodes, the first at {place}. Tag surfaces that lie "
                "over each other, not ones that meet at an edge"
            ),
        )


def check_folds(comm: MPI.Intracomm, slave: SlaveFacets, name: str) -> None:
    """Check that neighbouring facets of the slave are folded by 90 degrees at most. Collective."""
    corners, points = slave.facets.pieces, slave.facets.points
    normal = Planes.of(slave.facets.coordinates()).normal
    v, gdim = corners.shape[1], points.shape[1]
    ends = np.stack([corners, corners if v == 2 else np.roll(corners, -1, axis=1)], axis=2)
    middle = points[ends].mean(axis=2).reshape(-1, gdim)
    edges = np.sort(slave.nodes[ends.reshape(-1, 2)], axis=1)
    directory = Directory(comm, np.unique(slave.nodes))
    low, high, middle, normal = directory.collect(
        edges[:, 0], edges[:, 1], middle, np.repeat(normal, v, axis=0)
    )
    order = np.lexsort((high, low))
    low, high, middle, normal = low[order], high[order], middle[order], normal[order]
    same = (low[1:] == low[:-1]) & (high[1:] == high[:-1])
    folded = same & (np.sum(normal[1:] * normal[:-1], axis=1) < -RELATIVE_ROUNDING)
    raise_where(
        comm,
        folded,
        middle[1:],
        lambda number, place: (
            f"{name}: the slave's surface is folded by more than 90 degrees at {number} edges, the "
            f"first at {place}. Tag the two sides of a sharp edge as surfaces of two contacts, or "
            "make the other surface the slave"
        ),
    )

"""Patches of surfaces: smooth faces, with colours to tell them apart.

At a sharp edge of a slave, and above a sharp edge of a master or the border between two masters, a
node has one condition for each face: a mean over them is none of their gaps, and may be negative
where none of these is. Patches that meet at a node have different colours; those of one colour are
matched as one surface.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from fenics_tfeti.fem.contact.surfaces.tagged import Surface
from fenics_tfeti.fem.topology import connected_labels, distinct_rows
from fenics_tfeti.parallel import Directory, concatenate_ranks, first_of_rank, largest_of_groups
from fenics_tfeti.typing import Numbers, Vector

# cosine of the angle by which the normals of facets in one smooth face turn at an edge, at most
LEAST_COSINE = 0.5


def connected_facets(
    comm: MPI.Intracomm, keys: Numbers, facet: Numbers, number: int, normal: Vector | None = None
) -> Numbers:
    """Return the patch, over all ranks, that each facet of this rank (number,) is in. Collective.

    Facets (n,) with equal keys (n, k), such as an edge, are connected, if they have normals (n,
    gdim) only where these turn by 60 degrees at most. The first keys are not negative.
    """
    directions = np.ones((facet.size, 1)) if normal is None else normal
    part = connected_labels(_links(keys, directions, facet), number)
    if comm.size == 1:
        return part
    # patches of this rank, numbered over all ranks, then joined through their keys
    first, total = first_of_rank(comm, int(part.max(initial=-1)) + 1)
    directory = Directory(comm, np.unique(keys[:, 0]))
    _, *columns = directory.collect(keys[:, 0], keys, directions, first + part[facet])
    joined = distinct_rows(_links(*columns))[0]
    return connected_labels(concatenate_ranks(comm, joined), total)[first + part]


def _links(keys: Numbers, normal: Vector, label: Numbers) -> Numbers:
    """Return pairs (p, 2) of different labels with equal keys, where normals are about the same."""
    order = np.lexsort(keys.T)
    keys, normal, label = keys[order], normal[order], label[order]
    smooth = np.sum(normal[1:] * normal[:-1], axis=1) > LEAST_COSINE
    meet = (keys[1:] == keys[:-1]).all(axis=1) & smooth & (label[1:] != label[:-1])
    return np.column_stack([label[:-1][meet], label[1:][meet]])


def patch_colours(surface: Surface, patch: Numbers, node: Numbers, at_node: Numbers) -> Numbers:
    """Return the colours of the patches (f,) of facets, different where they meet. Collective.

    Patches (n,) meet at global nodes (n,), which may be another surface's. Their order is that of
    their places, not that of the ranks.
    """
    nodes, comm = surface.boundary.nodes, surface.comm
    total = comm.allreduce(int(patch.max(initial=-1)), MPI.MAX) + 1
    x = surface.corners
    ends = np.column_stack([-x.min(axis=1), x.max(axis=1)])
    places = largest_of_groups(comm, ends, patch, total, -np.inf)
    places[:, : x.shape[2]] *= -1.0
    local, at_node = nodes.to_owners(node, at_node)
    rows = distinct_rows(np.column_stack([local, at_node]))[0]
    meetings = [np.zeros((0, 2), dtype=np.int64)]
    for step in range(1, len(rows)):
        meet = rows[step:, 0] == rows[:-step, 0]
        if not meet.any():
            break
        meetings.append(np.column_stack([rows[step:][meet, 1], rows[:-step][meet, 1]]))
    neighbours: dict[int, set[int]] = {}
    for ends_of in concatenate_ranks(comm, np.concatenate(meetings)).tolist():
        for first, second in (ends_of, ends_of[::-1]):
            neighbours.setdefault(first, set()).add(second)
    colour = np.full(total, -1)
    for label in np.lexsort(places.T[::-1]).tolist():
        taken = {int(colour[other]) for other in neighbours.get(label, ())}
        colour[label] = min(set(range(len(taken) + 1)) - taken)
    return colour[patch]

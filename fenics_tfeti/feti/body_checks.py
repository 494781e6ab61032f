"""Check that glued nodes coincide and that the subdomains of a body are connected rigidly."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.feti.constraints.nodes import count_copies
from fenics_tfeti.feti.local.rigid_body_modes import raw_modes
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.feti.tolerances import NEGLIGIBLE, ZERO
from fenics_tfeti.parallel import Directory, first_of_rank, raise_collectively
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class _SharedNodes:
    """Nodes that two subdomains of one body share; a subdomain is known by a global number.

    Attributes
    ----------
    first, second : (k,) integer arrays
        The subdomains, first < second.
    x : (k, gdim) array
        Coordinates of the node.
    """

    first: Numbers
    second: Numbers
    x: Vector

    @property
    def size(self) -> int:
        return int(self.first.size)

    def chosen(self, at: Numbers) -> _SharedNodes:
        return _SharedNodes(self.first[at], self.second[at], self.x[at])


def check_bodies(system: TornSystem) -> None:
    """Check the gluing of subdomains. Collective.

    Raises
    ------
    InputError
        On all ranks: copies of a node at different places; a body whose subdomains can move against
        each other.
    """
    comm = system.comm
    first = first_of_rank(comm, len(system.subdomains))[0]
    shared = _shared_nodes(system, first)
    # three points carry all that a pair's shared nodes prevent
    shared = shared.chosen(np.unique(_spanning_points(shared)[0]))
    bodies = np.array([s.body for s in system.subdomains], dtype=np.int64)
    gathered = comm.gather((shared, bodies))
    with raise_collectively(comm):
        if gathered is not None:
            parts, lists = zip(*gathered, strict=True)
            every = _SharedNodes(
                np.concatenate([part.first for part in parts]),
                np.concatenate([part.second for part in parts]),
                np.concatenate([part.x for part in parts]),
            )
            ends = np.cumsum([part.size for part in lists])
            _check_rigid(system, every, np.concatenate(lists), ends)


def _shared_nodes(system: TornSystem, first: int) -> _SharedNodes:
    """Return the shared nodes at home on this rank, once for each pair of subdomains."""
    subdomains = system.subdomains
    every = np.concatenate([np.zeros(0, dtype=np.int64), *(s.nodes for s in subdomains)])
    directory, shared = _find_shared(system.comm, every)
    chosen = np.split(shared, np.cumsum([s.nodes.size for s in subdomains])[:-1])
    of_subdomain = list(zip(subdomains, chosen, strict=True)) if subdomains else []
    none = np.zeros((0, system.gdim))
    x = np.concatenate([none, *(s.coordinates[own] for s, own in of_subdomain)])
    sizes = [np.count_nonzero(own) for _, own in of_subdomain]
    number = np.repeat(first + np.arange(len(sizes), dtype=np.int64), sizes)
    body = np.repeat(np.array([s.body for s in subdomains], dtype=np.int64), sizes)
    size = np.repeat([float(np.ptp(s.coordinates, axis=0).max()) for s in subdomains], sizes)
    columns = directory.collect(every[shared], number, body, x, size)
    # copies arrive by ascending subdomain, and a stable sort keeps that order within a node
    order = np.argsort(columns[0], kind="stable")
    nodes, number, body, x, size = (column[order] for column in columns)

    pairs = list(_pairs_of_copies(nodes))
    one = np.concatenate([np.zeros(0, dtype=np.int64), *(pair[0] for pair in pairs)])
    two = np.concatenate([np.zeros(0, dtype=np.int64), *(pair[1] for pair in pairs)])
    with raise_collectively(system.comm):
        _check_places(nodes, x, size, one, two)
    same_body = body[one] == body[two]
    one, two = one[same_body], two[same_body]
    return _SharedNodes(number[one], number[two], x[one])


def _find_shared(comm: MPI.Intracomm, nodes: Numbers) -> tuple[Directory, Mask]:
    """Return a directory of the nodes, and which of them have copies; most have none."""
    held, position, count = count_copies(nodes)
    directory = Directory(comm, held)
    keys, counts = directory.collect(held, count)
    copies = np.bincount(directory.position(keys), weights=counts, minlength=directory.keys.size)
    return directory, directory.lookup(held, copies)[1][position] > 1


def _pairs_of_copies(nodes: Numbers) -> Iterator[tuple[Numbers, Numbers]]:
    """Yield all pairs of positions with equal numbers in a sorted array."""
    one = np.arange(nodes.size)
    for distance in range(1, nodes.size):
        one = one[one + distance < nodes.size]
        # a number that ends within one distance has no copy at a larger one
        one = one[nodes[one] == nodes[one + distance]]
        if one.size == 0:
            return
        yield one, one + distance


def _check_places(nodes: Numbers, x: Vector, size: Vector, one: Numbers, two: Numbers) -> None:
    distance = np.abs(x[one] - x[two]).max(axis=1, initial=0.0)
    wrong = np.flatnonzero(distance > NEGLIGIBLE * np.minimum(size[one], size[two]))
    if wrong.size:
        i, j = one[wrong[0]], two[wrong[0]]
        raise InputError(
            f"coordinates of glued nodes: {np.unique(nodes[one[wrong]]).size} node numbers are at "
            f"different places in different subdomains, the first is {nodes[i]} at "
            f"{format_point(x[i])} and at {format_point(x[j])}. Node numbers are global: give "
            "nodes at different places different numbers"
        )


def _spanning_points(shared: _SharedNodes) -> tuple[Numbers, Vector, Vector]:
    """Choose three points of each pair's shared nodes that span the line or plane of all.

    Returns
    -------
    at : (3, pairs) integer array
        Positions in `shared`: the first point, the farthest one from it, and the farthest one from
        the line through both.
    length, height : (pairs,) arrays
        The two distances.
    """
    number = max(int(shared.second.max(initial=0)) + 1, 1)
    group = np.unique(shared.first * number + shared.second, return_inverse=True)[1].ravel()
    x = shared.x
    first = _last_of_groups(np.zeros(group.size), group)
    away = x - x[first[group]]
    length = np.linalg.norm(away, axis=1)
    second = _last_of_groups(length, group)
    direction = away[second] / np.maximum(length[second], np.finfo(float).tiny)[:, None]
    along = np.sum(away * direction[group], axis=1)
    height = np.linalg.norm(away - along[:, None] * direction[group], axis=1)
    third = _last_of_groups(height, group)
    return np.array([first, second, third]), length[second], height[third]


def _last_of_groups(value: Vector, group: Numbers) -> Numbers:
    """Return the position of the largest value of each group 0, 1, ..."""
    order = np.lexsort((value, group))
    last = np.append(np.diff(group[order]) != 0, True)[: group.size]
    positions: Numbers = order[last]
    return positions


def _check_rigid(system: TornSystem, shared: _SharedNodes, bodies: Numbers, ends: Numbers) -> None:
    """Check the bodies' connections; `ends` are the ends of the ranks' subdomains."""
    at, length, height = _spanning_points(shared)
    rigid = (length > 0.0) & ((system.gdim == 2) | (height > NEGLIGIBLE * length))
    shape = bodies.size, bodies.size
    first, second = shared.first[at[0]], shared.second[at[0]]
    graph = sp.coo_matrix((np.ones(rigid.sum()), (first[rigid], second[rigid])), shape)
    clusters, cluster = connected_components(graph, directed=False)
    if clusters == np.unique(bodies).size:
        return
    graph = sp.coo_matrix((np.ones(first.size), (first, second)), shape)
    piece = connected_components(graph, directed=False)[1]
    for body in np.unique(bodies):
        members = np.flatnonzero(bodies == body)
        if np.unique(cluster[members]).size == 1:
            continue
        other = members[piece[members] != piece[members[0]]]
        if other.size:
            raise InputError(
                f"{system.body_name(body)}: {other.size} of its {members.size} subdomains share no "
                f"node with {_name(members[0], ends)} or its neighbours, the first is "
                f"{_name(other[0], ends)}. Glue them by equal node numbers, or give every part a "
                "body number of its own"
            )
        own = np.flatnonzero(np.isin(shared.first, members))
        _check_motions(system, shared.chosen(own), cluster, body, ends)


def _check_motions(
    system: TornSystem, shared: _SharedNodes, cluster: Numbers, body: int, ends: Numbers
) -> None:
    """Check that shared nodes leave no relative motion between clusters of a body."""
    between = cluster[shared.first] != cluster[shared.second]
    shared = shared.chosen(np.flatnonzero(between))
    number = np.unique([cluster[shared.first], cluster[shared.second]], return_inverse=True)[1]
    one, two = number.reshape(2, -1)
    centred = shared.x - shared.x.mean(axis=0)
    centred /= max(float(np.abs(centred).max()), np.finfo(float).tiny)
    motions = raw_modes(centred, np.zeros(system.gdim)).reshape(shared.size, system.gdim, -1)
    modes, clusters = motions.shape[2], int(number.max()) + 1
    jumps = np.zeros((shared.size, system.gdim, clusters, modes))
    at = np.arange(shared.size)
    jumps[at, :, one] += motions
    jumps[at, :, two] -= motions
    values = np.linalg.svd(jumps.reshape(-1, clusters * modes), compute_uv=False)
    if clusters * modes - np.count_nonzero(values > ZERO * values[0]) > modes:
        i = shared.first[0], shared.second[0]
        raise InputError(
            f"{system.body_name(body)}: its subdomains can move against each other as if hinged: "
            f"{_name(i[0], ends)} and {_name(i[1], ends)} share too few nodes, one of them at "
            f"{format_point(shared.x[0])}. Subdomains of a body have to share 2 nodes, in three "
            "dimensions 3 that are not on a line, as cells with a common facet do; or give every "
            "part that moves a body number of its own"
        )


def _name(subdomain: int, ends: Numbers) -> str:
    """Return the local name of a global number."""
    rank = int(np.searchsorted(ends, subdomain, side="right"))
    local = subdomain - (ends[rank - 1] if rank else 0)
    return f"subdomain {local} of rank {rank}" if ends.size > 1 else f"subdomain {local}"

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
    """Pairs of subdomains of one body, by global numbers, and the coordinates of a shared node."""

    first: Numbers
    second: Numbers
    x: Vector

    @property
    def size(self) -> int:
        return int(self.first.size)

    def chosen(self, positions: Numbers | Mask) -> _SharedNodes:
        return _SharedNodes(self.first[positions], self.second[positions], self.x[positions])


def check_bodies(system: TornSystem) -> None:
    """Check the gluing of subdomains. Collective.

    `InputError` is raised on all ranks if copies of a node are at different places, or if the
    subdomains of a body can move against each other.
    """
    comm = system.comm
    first = first_of_rank(comm, len(system.subdomains))[0]
    shared = _shared_nodes(system, first)
    # three points carry all that a pair's shared nodes prevent
    shared = shared.chosen(np.unique(_spanning_points(shared)[0]))
    gathered = comm.gather((shared, system.bodies))
    with raise_collectively(comm):
        if gathered is not None:
            parts, lists = zip(*gathered, strict=True)
            fields = ([getattr(part, name) for part in parts] for name in ("first", "second", "x"))
            shared = _SharedNodes(*map(np.concatenate, fields))
            ends = np.cumsum([part.size for part in lists])
            _check_rigid(system, shared, np.concatenate(lists), ends)


def _shared_nodes(system: TornSystem, first: int) -> _SharedNodes:
    """Return the shared nodes at home on this rank, once for each pair of subdomains."""
    subdomains = system.subdomains
    nodes = system.nodes
    directory, shared = _find_shared(system.comm, nodes)
    local = system.at_copies(np.arange(len(subdomains)))[shared]
    widths = np.array([np.ptp(s.coordinates, axis=0).max() for s in subdomains], dtype=np.float64)
    arrived = directory.collect(
        nodes[shared],
        first + local,
        system.bodies[local],
        system.coordinates[shared],
        widths[local],
    )
    # copies arrive by ascending subdomain, and a stable sort keeps that order within a node
    order = np.argsort(arrived[0], kind="stable")
    nodes, number, body, points, width = (column[order] for column in arrived)

    pairs = [np.zeros((2, 0), dtype=np.int64), *_pairs_of_copies(nodes)]
    i, j = np.concatenate(pairs, axis=1)
    with raise_collectively(system.comm):
        _check_places(nodes, points, width, i, j)
    return _SharedNodes(number[i], number[j], points[i]).chosen(body[i] == body[j])


def _find_shared(comm: MPI.Intracomm, nodes: Numbers) -> tuple[Directory, Mask]:
    """Return a directory of the nodes, and which of them have copies; most have none."""
    distinct, position, count = count_copies(nodes)
    directory = Directory(comm, distinct)
    copies = directory.sums(distinct, count.astype(float))
    return directory, directory.lookup(distinct, copies)[1][position] > 1


def _pairs_of_copies(nodes: Numbers) -> Iterator[Numbers]:
    """Yield all pairs (2, k) of positions with equal numbers in a sorted array."""
    position = np.arange(nodes.size)
    for distance in range(1, nodes.size):
        position = position[position + distance < nodes.size]
        # a number that ends within one distance has no copy at a larger one
        position = position[nodes[position] == nodes[position + distance]]
        if position.size == 0:
            return
        yield np.array([position, position + distance])


def _check_places(nodes: Numbers, x: Vector, width: Vector, i: Numbers, j: Numbers) -> None:
    """Check that the copies i and j of nodes are at the same place."""
    distance = np.abs(x[i] - x[j]).max(axis=1, initial=0.0)
    wrong = np.flatnonzero(distance > NEGLIGIBLE * np.minimum(width[i], width[j]))
    if wrong.size:
        i, j = i[wrong], j[wrong]
        raise InputError(
            f"coordinates of glued nodes: {np.unique(nodes[i]).size} node numbers are at "
            f"different places in different subdomains, the first is {nodes[i[0]]} at "
            f"{format_point(x[i[0]])} and at {format_point(x[j[0]])}. Node numbers are global: "
            "give nodes at different places different numbers"
        )


def _spanning_points(shared: _SharedNodes) -> tuple[Numbers, Vector, Vector]:
    """Choose three points of each pair's shared nodes that span the line or plane of all.

    They are a first point, the farthest one from it, and the farthest one from the line through
    both; returned are their positions (3, pairs) and the two distances (pairs,).
    """
    number = max(int(shared.second.max(initial=0)) + 1, 1)
    group = np.unique(shared.first * number + shared.second, return_inverse=True)[1].ravel()
    first = _last_of_groups(np.zeros(group.size), group)
    offset = shared.x - shared.x[first[group]]
    length = np.linalg.norm(offset, axis=1)
    second = _last_of_groups(length, group)
    direction = offset[second] / np.maximum(length[second], np.finfo(float).tiny)[:, None]
    component = np.sum(offset * direction[group], axis=1)
    height = np.linalg.norm(offset - component[:, None] * direction[group], axis=1)
    third = _last_of_groups(height, group)
    return np.array([first, second, third]), length[second], height[third]


def _last_of_groups(value: Vector, group: Numbers) -> Numbers:
    """Return the position of the largest value of each group 0, 1, ..."""
    order = np.lexsort((value, group))
    last = np.append(np.diff(group[order]) != 0, True)[: group.size]
    return order[last]


def _check_rigid(system: TornSystem, shared: _SharedNodes, bodies: Numbers, ends: Numbers) -> None:
    """Check the bodies' connections; `ends` are the ends of the ranks' subdomains."""
    points, length, height = _spanning_points(shared)
    rigid = (length > 0.0) & ((system.gdim == 2) | (height > NEGLIGIBLE * length))
    shape = bodies.size, bodies.size
    first, second = shared.first[points[0]], shared.second[points[0]]
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
        apart = members[piece[members] != piece[members[0]]]
        if apart.size:
            raise InputError(
                f"{system.body_name(body)}: {apart.size} of its {members.size} subdomains share no "
                f"node with {_name(members[0], ends)} or its neighbours, the first is "
                f"{_name(apart[0], ends)}. Glue them by equal node numbers, or give every part a "
                "body number of its own"
            )
        inside = np.isin(shared.first, members)
        _check_motions(system, shared.chosen(inside), cluster, body, ends)


def _check_motions(
    system: TornSystem, shared: _SharedNodes, cluster: Numbers, body: int, ends: Numbers
) -> None:
    """Check that shared nodes leave no relative motion between clusters of a body."""
    shared = shared.chosen(cluster[shared.first] != cluster[shared.second])
    number = np.unique([cluster[shared.first], cluster[shared.second]], return_inverse=True)[1]
    first, second = number.reshape(2, -1)
    centred = shared.x - shared.x.mean(axis=0)
    centred /= max(float(np.abs(centred).max()), np.finfo(float).tiny)
    motions = raw_modes(centred, np.zeros(system.gdim)).reshape(shared.size, system.gdim, -1)
    modes, clusters = motions.shape[2], int(number.max()) + 1
    jumps = np.zeros((shared.size, system.gdim, clusters, modes))
    point = np.arange(shared.size)
    jumps[point, :, first] += motions
    jumps[point, :, second] -= motions
    values = np.linalg.svd(jumps.reshape(-1, clusters * modes), compute_uv=False)
    if clusters * modes - np.count_nonzero(values > ZERO * values[0]) > modes:
        raise InputError(
            f"{system.body_name(body)}: its subdomains can move against each other as if hinged: "
            f"{_name(shared.first[0], ends)} and {_name(shared.second[0], ends)} share too few "
            f"nodes, one of them at {format_point(shared.x[0])}. Subdomains of a body have to "
            "share 2 nodes, in three dimensions 3 that are not on a line, as cells with a common "
            "facet do; or give every part that moves a body number of its own"
        )


def _name(subdomain: int, ends: Numbers) -> str:
    """Return the local name of a global number."""
    rank = int(np.searchsorted(ends, subdomain, side="right"))
    local = subdomain - (ends[rank - 1] if rank else 0)
    return f"subdomain {local} of rank {rank}" if ends.size > 1 else f"subdomain {local}"

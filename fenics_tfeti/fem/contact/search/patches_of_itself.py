"""Facets of one surface that face each other: roles of their nodes, and patches.

No node can be of a slave and of a master. Pairs of facets in the order of their gaps give their
nodes roles; one that contradicts nearer ones is left out: closed loops and the turns of folds are
cut where gaps are largest. Nothing here uses dolfinx or communicates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from fenics_tfeti.fem.contact.surfaces.patches import LEAST_COSINE
from fenics_tfeti.fem.geometry.normals import facet_normals
from fenics_tfeti.fem.geometry.vectors import unit
from fenics_tfeti.fem.topology import connected_labels
from fenics_tfeti.typing import Mask, Numbers, Vector

# roles of facets and nodes
NONE, SLAVE, MASTER = 0, 1, 2
# by how much facets on one side are larger, that it becomes the slave
_LARGER = 1.001


@dataclass(frozen=True)
class Patches:
    """Parts of a surface that face each other, each with a slave and a master."""

    slave: Mask  # (patches, f)
    master: Mask  # (patches, f)
    left_out: int = 0  # pairs of facets that contradict nearer ones

    @staticmethod
    def none(facets: int) -> Patches:
        """Return no patches of a surface with a number of facets."""
        return Patches(*np.zeros((2, 0, facets), dtype=bool))

    @property
    def roles(self) -> Numbers:
        """The role of each facet, (f,)."""
        of_slave, of_master = self.slave.any(axis=0), self.master.any(axis=0)
        return np.where(of_slave, SLAVE, np.where(of_master, MASTER, NONE))

    def has(self, pairs: Numbers) -> Mask:
        """Tell which pairs (p, 2) of facets are in a patch, in either role."""
        found = np.zeros(len(pairs), dtype=bool)
        for slave, master in zip(self.slave, self.master, strict=True):
            s, m = slave[pairs], master[pairs]
            found |= (s[:, 0] & m[:, 1]) | (s[:, 1] & m[:, 0])
        return found

    def cannot_have(self, pairs: Numbers, nodes: Numbers) -> Mask:
        """Tell which pairs (p, 2) of facets with nodes (f, v) contradict the roles of nodes.

        No facet of the two can be the slave of the other one.
        """
        of_nodes = np.zeros((int(nodes.max(initial=-1)) + 1, 2), dtype=bool)
        for column, side in enumerate((self.slave, self.master)):
            of_nodes[nodes[side.any(axis=0)], column] = True
        first, second = np.moveaxis(of_nodes[nodes[pairs]].any(axis=2), 1, 0)
        # the one is of no master, the other of no slave
        return (first[:, 1] | second[:, 0]) & (first[:, 0] | second[:, 1])


def beside_opposed(pairs: Numbers, normal: Vector) -> Mask:
    """Tell which pairs (p, 2) of facets graze each other, while one of them is opposed to another.

    They are sides of corners that are near a face, or have entered it, with their other side. The
    facets have normals (f, gdim).
    """
    is_opposed = np.sum(normal[pairs[:, 0]] * normal[pairs[:, 1]], axis=1) <= -LEAST_COSINE
    has_opposed = np.zeros(len(normal), dtype=bool)
    has_opposed[pairs[is_opposed]] = True
    beside: Mask = ~is_opposed & has_opposed[pairs].any(axis=1)
    return beside


def find_patches(
    pairs: Numbers, gap: Vector, nodes: Numbers, area: Vector, before: Numbers
) -> tuple[Patches, Numbers]:
    """Return the patches of pairs (p, 2) of facets with gaps (p,), and roles (n,) of nodes.

    Facets have nodes (f, v), areas (f,) and the roles (f,) before, which they keep; of new patches
    the side with the larger facets is the slave.
    """
    order = np.argsort(gap, kind="stable")
    pairs = pairs[order]
    side, part = _sides(pairs, nodes)
    of_facets = side[nodes]
    is_one = (of_facets == of_facets[:, :1]).all(axis=1)
    fits = is_one[pairs].all(axis=1) & (of_facets[pairs[:, 0], 0] != of_facets[pairs[:, 1], 0])
    kept = pairs[fits]
    role = _roles(kept, of_facets[:, 0], part[nodes[:, 0]], area, before)
    of_nodes = np.zeros(side.size, dtype=np.int64)
    of_nodes[nodes[kept]] = role[kept][:, :, None]
    kept = np.where((role[kept[:, 0]] == SLAVE)[:, None], kept, kept[:, ::-1])
    patch = _connected(kept, nodes)
    slave, master = np.zeros((2, int(patch.max(initial=-1)) + 1, len(nodes)), dtype=bool)
    slave[patch, kept[:, 0]] = master[patch, kept[:, 1]] = True
    return Patches(slave, master, int(np.count_nonzero(~fits))), of_nodes


def _sides(pairs: Numbers, nodes: Numbers) -> tuple[Numbers, Numbers]:
    """Return on which side, 0 or 1, each node (n,) is, and the part of the surface. Nearest first.

    Nodes of a facet are on one side, those of a pair's two facets on different ones. Nodes are
    joined by a spanning forest of the nearest pairs; the sides of different parts are arbitrary.
    """
    count = int(nodes.max(initial=-1)) + 1
    first, second = nodes[pairs[:, 0]], nodes[pairs[:, 1]]
    ends = [np.stack([first[:, 0], second[:, 0]], axis=1)]
    for facet in (first, second):
        ends += [np.stack([facet[:, 0], column], axis=1) for column in facet.T[1:]]
    edges, other = np.sort(np.concatenate(ends), axis=1), np.zeros(len(ends), dtype=bool)
    other[0] = True
    rank = np.tile(1 + np.arange(len(pairs)), len(ends))
    turns = np.repeat(other, len(pairs))
    # of edges between the same nodes that of the nearest pair
    order = np.lexsort((rank, edges[:, 1], edges[:, 0]))
    edges, rank, turns = edges[order], rank[order], turns[order]
    is_first = np.ones(len(edges), dtype=bool)
    is_first[1:] = (edges[1:] != edges[:-1]).any(axis=1)
    edges, rank, turns = edges[is_first], rank[is_first], turns[is_first]
    graph = sp.csr_matrix((rank.astype(float), tuple(edges.T)), shape=(count, count))
    forest = minimum_spanning_tree(graph).tocoo()
    part = connected_components(forest, directed=False)[1].astype(np.int64)
    # a root joins the trees, to walk through all of them at once
    trees = np.unique(part, return_index=True)[1]
    rows, columns = np.append(forest.row, np.full(trees.size, count)), np.append(forest.col, trees)
    rooted = sp.csr_matrix((np.ones(rows.size), (rows, columns)), shape=(count + 1, count + 1))
    parent = breadth_first_order(rooted, count, directed=False)[1][:count]
    up = np.sort(np.stack([np.arange(count), parent], axis=1), axis=1)
    keys = edges[:, 0] * (count + 1) + edges[:, 1]
    place = np.searchsorted(keys, up[:, 0] * (count + 1) + up[:, 1])
    side = np.zeros(count + 1, dtype=bool)
    in_tree = parent < count
    side[:count][in_tree] = turns[place[in_tree]]
    ancestor = np.append(parent, count).astype(np.int64)
    while (ancestor < count).any():
        side ^= side[ancestor]
        ancestor = ancestor[ancestor]
    return side[:count].astype(np.int64), part


def _roles(pairs: Numbers, side: Numbers, part: Numbers, area: Vector, before: Numbers) -> Numbers:
    """Return the roles (f,) of the facets of pairs, by their sides and parts (f,)."""
    role, facets = np.zeros(side.size, dtype=np.int64), np.unique(pairs)
    count, of = int(part.max(initial=-1)) + 1, part[facets]
    sign = 1.0 - 2.0 * side[facets]  # 1 on side 0
    vote = np.where(before[facets] == SLAVE, sign, np.where(before[facets] == MASTER, -sign, 0.0))
    kept = np.bincount(of, vote, count)
    means = []
    for number in (0, 1):
        there = side[facets] == number
        number_of = np.bincount(of[there], minlength=count)
        means.append(np.bincount(of[there], area[facets][there], count) / np.maximum(number_of, 1))
    is_larger = means[0] * _LARGER >= means[1]
    zero_is_slave = np.where(kept == 0.0, is_larger, kept > 0.0)
    role[facets] = np.where((side[facets] == 0) == zero_is_slave[of], SLAVE, MASTER)
    return role


def _connected(pairs: Numbers, nodes: Numbers) -> Numbers:
    """Return the patch (p,) of each pair: those with common nodes of both facets are in one."""
    if not len(pairs):
        return np.zeros(0, dtype=np.int64)
    first, second = nodes[pairs[:, 0]], nodes[pairs[:, 1]]
    keys = first[:, :, None] * (int(nodes.max()) + 1) + second[:, None, :]
    distinct, key = np.unique(keys.reshape(len(pairs), -1), return_inverse=True)
    row, size = np.repeat(np.arange(len(pairs)), keys[0].size), len(pairs) + distinct.size
    links = np.column_stack([row, len(pairs) + key.ravel()])
    label = connected_labels(links, size)[: len(pairs)]
    # by the nearest of their pairs
    _, place, patch = np.unique(label, return_index=True, return_inverse=True)
    number = np.empty(place.size, dtype=np.int64)
    number[np.argsort(place)] = np.arange(place.size)
    return number[patch]


def widened(
    patches: Patches,
    of_nodes: Numbers,
    x: Vector,
    nodes: Numbers,
    adjacent: sp.csr_matrix,
    rings: int,
) -> Patches:
    """Return the patches with rings of facets around them, over smooth parts, so that they slide.

    The nodes (n, gdim) have roles (n,), which no other facet may contradict.
    """
    normal, role = unit(facet_normals(x[nodes])), of_nodes.copy()
    links = adjacent.tocoo()
    turn = np.sum(normal[links.row] * normal[links.col], axis=1)
    smooth = sp.csr_matrix(((turn > LEAST_COSINE).astype(float), (links.row, links.col)))
    sides = patches.slave.copy(), patches.master.copy()
    for pair in zip(*sides, strict=True):
        for own, facets in zip((SLAVE, MASTER), pair, strict=True):
            for _ in range(rings):
                ring = (smooth @ facets.astype(float) > 0.0) & ~facets
                ring &= ~(role[nodes] == SLAVE + MASTER - own).any(axis=1)
                facets |= ring
                role[nodes[ring]] = own
    return _merged(Patches(*sides, patches.left_out), nodes)


def _merged(patches: Patches, nodes: Numbers) -> Patches:
    """Return the patches with those joined whose slaves, and whose masters, have common nodes."""
    row, column = np.repeat(np.arange(len(nodes)), nodes.shape[1]), nodes.ravel()
    incidence = sp.csr_matrix((np.ones(row.size), (row, column)))
    sides = (patches.slave, patches.master)
    at_nodes = [sp.csr_matrix(side.astype(float)) @ incidence for side in sides]
    common = [(side @ side.T) > 0.0 for side in at_nodes]
    links = np.column_stack(common[0].multiply(common[1]).nonzero())
    group = connected_labels(links, len(patches.slave))
    joined = np.zeros((2, int(group.max(initial=-1)) + 1, len(nodes)), dtype=bool)
    for side, whole in zip(sides, joined, strict=True):
        np.logical_or.at(whole, group, side)
    slave, master = joined
    return Patches(slave, master, patches.left_out)

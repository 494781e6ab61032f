"""Nodes and their copies: multiplicities, weights and prescribed displacements over all ranks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.feti.tolerances import FEW, SAME_VALUE, rounding
from fenics_tfeti.parallel import Directory, first_of_rank, largest_of_ranks, raise_collectively
from fenics_tfeti.typing import Mask, Numbers, Vector

# range of node numbers, in units of their count, up to which counting is faster than sorting
_DENSE = 8


@dataclass(frozen=True)
class Copies:
    """Copies of nodes in the subdomains of this rank, subdomain by subdomain."""

    node: Numbers  # (copies,): position in `nodes`
    unknown: Numbers  # (copies,): first torn unknown
    weight: Vector  # (copies,): entry of D
    nodes: Numbers  # (nodes,): distinct global numbers, ascending
    count: Numbers  # (nodes,): number of copies on this rank

    @staticmethod
    def build(system: TornSystem, weights: Vector | None) -> Copies:
        """Collect the copies; weights are 1 by default."""
        nodes, node, count = count_copies(system.nodes)
        unknown = system.gdim * np.arange(node.size, dtype=np.int64)
        weight = np.ones(node.size) if weights is None else weights
        return Copies(node, unknown, weight, nodes, count)

    def of_nodes(self, chosen: Mask) -> Copies:
        """Return the copies of some of the nodes."""
        kept, position = chosen[self.node], np.cumsum(chosen) - 1
        return Copies(
            position[self.node[kept]],
            self.unknown[kept],
            self.weight[kept],
            self.nodes[chosen],
            self.count[chosen],
        )


@dataclass(frozen=True)
class NodeTable:
    """Data of nodes over all ranks: of those at home on this rank, or of those looked up."""

    multiplicity: Numbers  # (nodes,): number of copies; 0 for a node of no subdomain
    weight: Vector  # (nodes,): sum of the copies' weights
    first_row: Numbers  # (nodes,): global number of the node's first equality row
    prescribed: Mask  # (nodes, gdim): components with a prescribed displacement
    values: Vector  # (nodes, gdim): prescribed displacements, 0 elsewhere [m]

    @staticmethod
    def build(system: TornSystem, directory: Directory, copies: Copies) -> NodeTable:
        """Gather the table at the nodes' home ranks; number the equality rows.

        Raises an InputError on all ranks if prescribed displacements contradict each other or name
        a node of no subdomain.
        """
        homes = directory.keys.size
        weights = np.bincount(copies.node, weights=copies.weight, minlength=copies.nodes.size)
        sums = directory.sums(copies.nodes, np.column_stack([copies.count, weights]))
        multiplicity, weight = sums[:, 0].astype(np.int64), sums[:, 1].copy()

        conditions = system.prescribed
        arrived = directory.collect(conditions.nodes, conditions.components, conditions.values)
        shift = rounding(largest_coordinate(system), FEW)
        with raise_collectively(system.comm):
            prescribed, values = _merge_prescribed(directory, arrived, (homes, system.gdim), shift)
        rows = _equality_rows(multiplicity, prescribed)
        first = first_of_rank(system.comm, int(rows.sum()))[0] + np.cumsum(rows) - rows
        return NodeTable(multiplicity, weight, first.astype(np.int64), prescribed, values)

    def lookup(self, directory: Directory, nodes: Numbers) -> NodeTable:
        """Return the table of any nodes; the multiplicity of unknown ones is 0. Collective."""
        columns = (self.multiplicity, self.weight, self.first_row, self.prescribed, self.values)
        return NodeTable(*directory.lookup(nodes, *columns)[1:])

    @property
    def rows(self) -> Numbers:
        """Number of equality rows of each node."""
        return _equality_rows(self.multiplicity, self.prescribed)


def count_copies(nodes: Numbers) -> tuple[Numbers, Numbers, Numbers]:
    """Return the distinct numbers, ascending, the position of each number in them, and the counts.

    As ``numpy.unique``, but in a quarter of the time where the numbers lie close together.
    """
    lowest, highest = (int(nodes.min()), int(nodes.max())) if nodes.size else (0, 0)
    if highest - lowest > _DENSE * nodes.size:
        distinct, position, count = np.unique(nodes, return_inverse=True, return_counts=True)
        return distinct, position.ravel(), count
    count = np.bincount(nodes - lowest)
    distinct = np.flatnonzero(count)
    position = np.cumsum(count > 0) - 1
    return distinct + lowest, position[nodes - lowest], count[distinct]


def largest_coordinate(system: TornSystem) -> float:
    """Return the largest coordinate in magnitude over all ranks [m]. Collective."""
    return largest_of_ranks(system.comm, np.abs(system.coordinates))


def _equality_rows(multiplicity: Numbers, prescribed: Mask) -> Numbers:
    """Return the number of equality rows of each node: k for prescribed components, else k - 1."""
    k = multiplicity[:, None]
    return np.where(prescribed, k, k - 1).sum(axis=1)


def _merge_prescribed(
    directory: Directory,
    arrived: tuple[NDArray[Any], ...],
    shape: tuple[int, int],
    shift: float,
) -> tuple[Mask, Vector]:
    """Merge (node, component, value) of all ranks; the values of one displacement have to agree."""
    nodes, components, values = arrived
    home = directory.position(nodes)
    if np.any(home < 0):
        raise InputError(
            f"a displacement is prescribed for node {nodes[home < 0][0]}, which is in no subdomain"
        )
    prescribed, merged = np.zeros(shape, dtype=bool), np.zeros(shape)
    prescribed[home, components] = True
    merged[home, components] = values
    largest = np.zeros(shape[0])
    np.maximum.at(largest, home, np.abs(values))
    difference = np.abs(merged[home, components] - values)
    wrong = np.flatnonzero(difference > SAME_VALUE * largest[home] + shift)
    if wrong.size:
        k = wrong[0]
        raise InputError(
            f"contradictory Dirichlet values: component {components[k]} of node {nodes[k]} is "
            f"prescribed as {values[k]:g} and as {merged[home[k], components[k]]:g} "
            f"({wrong.size} such contradictions). Give each displacement one value"
        )
    return prescribed, merged

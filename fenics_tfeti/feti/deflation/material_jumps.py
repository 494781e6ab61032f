"""Subdomains on whose interface the stiffness of the nodes jumps."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from fenics_tfeti.feti.constraints.ground import TornUnknowns
from fenics_tfeti.feti.constraints.interface import Interface
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.system import TornSystem, node_graph
from fenics_tfeti.parallel import Directory
from fenics_tfeti.typing import Mask, Vector

# ratio of the stiffness of nodes. In unstructured tetrahedra of one material it reaches 20: a node
# at a corner of the body beside one within
_JUMP = 50.0


def subdomains_with_jumps(
    system: TornSystem,
    constraints: Constraints,
    interface: Interface,
    unknowns: TornUnknowns,
) -> Mask:
    """Tell which interfaces have neighbouring nodes of very different stiffness. Collective.

    The stiffness of a node is the sum of the weights of its copies: a copy's own is small also
    where few cells of a subdomain meet the node. Nodes of stiff neighbours do not count, and
    neither do nodes far from each other: the stiffness grows with the size of the cells. Subdomains
    are in the order of the packed interface unknowns.
    """
    jumps = _ratios(constraints.weights[interface.columns], interface) > _JUMP
    if system.comm.allreduce(bool(jumps.any()), MPI.LOR):
        whole = constraints.weights.copy()
        own = whole[unknowns.displacements].reshape(-1, system.gdim)[:, 0]
        over_copies = _over_copies(system, own)
        whole[unknowns.displacements] = np.repeat(over_copies, system.gdim)
        jumps &= _ratios(whole[interface.columns], interface) > _JUMP
        for k in np.flatnonzero(jumps):
            jumps[k] = _ratio_of_neighbours(system, interface, int(k), over_copies) > _JUMP
    return jumps


def _ratio_of_neighbours(
    system: TornSystem, interface: Interface, position: int, weights: Vector
) -> float:
    """Return the largest ratio of the weights of two interface nodes that share a cell.

    `position` is that of the subdomain in the packed interface, `weights` are those of the nodes of
    all subdomains, one after the other.
    """
    members = [c.members.size for c in interface.classes]
    of = int(np.searchsorted(np.cumsum(members), position, side="right"))
    number = interface.classes[of].members[position - sum(members[:of])]
    sizes = [subdomain.nodes.size for subdomain in system.subdomains]
    nodes = np.unique(interface.unknowns[of] // system.gdim)
    # the unknowns of the ground come after the displacements
    nodes = nodes[nodes < sizes[number]]
    stiffness = system.subdomains[number].stiffness
    pairs = node_graph(stiffness, system.gdim)[nodes][:, nodes].tocoo()
    own = weights[sum(sizes[:number]) + nodes]
    return float((own[pairs.row] / own[pairs.col]).max(initial=1.0))


def _ratios(weights: Vector, interface: Interface) -> Vector:
    """Return the largest over the smallest weight of each subdomain's interface unknowns."""
    ends = interface.ends
    ratios = np.ones(ends.size - 1)
    some = np.flatnonzero(np.diff(ends))
    if some.size:
        # the next subdomain with unknowns begins where one ends
        least, most = (f.reduceat(weights, ends[some]) for f in (np.minimum, np.maximum))
        ratios[some] = most / least
    return ratios


def _over_copies(system: TornSystem, weights: Vector) -> Vector:
    """Return for each copy of a node the sum over the copies of all ranks. Collective."""
    copies = np.concatenate([np.zeros(0, dtype=np.int64), *(s.nodes for s in system.subdomains)])
    nodes, position = np.unique(copies, return_inverse=True)
    directory = Directory(system.comm, nodes)
    keys, parts = directory.collect(nodes, np.bincount(position, weights, nodes.size))
    home = np.bincount(directory.position(keys), parts, directory.keys.size)
    whole: Vector = directory.lookup(nodes, home)[1][position]
    return whole

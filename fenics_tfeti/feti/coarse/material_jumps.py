"""Subdomains on whose interface the stiffness of the nodes jumps."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.feti.constraints.ground import TornUnknowns
from fenics_tfeti.feti.constraints.interface import Interface
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.parallel import Directory

__all__ = ["subdomains_with_jumps"]

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

# ratio of the largest and the smallest stiffness of a node. In unstructured tetrahedra of one
# material it reaches 20: a node at a corner of the body beside one within
_JUMP = 50.0


def subdomains_with_jumps(
    system: TornSystem,
    constraints: Constraints,
    interface: Interface,
    unknowns: TornUnknowns,
) -> Mask:
    """Tell which subdomains' interfaces have nodes of very different stiffness. Collective.

    The stiffness of a node is the sum of the weights of its copies: a copy's own is small also
    where few cells of a subdomain meet the node. Nodes of stiff neighbours do not count.

    Parameters
    ----------
    system : TornSystem
        The subdomains.
    constraints : Constraints
        B with weights of stiffness.
    interface : Interface
        Its packed columns.
    unknowns : TornUnknowns
        Where the displacements are among the torn unknowns.

    Returns
    -------
    (subdomains,) bool array
        In the order of the packed interface unknowns.
    """
    jumps = _ratios(constraints.weights[interface.columns], interface) > _JUMP
    if system.comm.allreduce(bool(jumps.any()), MPI.LOR):
        whole = constraints.weights.copy()
        own = whole[unknowns.displacements].reshape(-1, system.gdim)[:, 0]
        whole[unknowns.displacements] = np.repeat(_over_copies(system, own), system.gdim)
        jumps &= _ratios(whole[interface.columns], interface) > _JUMP
    return jumps


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

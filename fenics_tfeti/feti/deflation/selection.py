"""Subdomains in which directions to be deflated are looked for: by material, and by shape."""

from __future__ import annotations

import numpy as np

from fenics_tfeti.feti.constraints.ground import TornUnknowns
from fenics_tfeti.feti.constraints.interface import Interface
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.local.congruence import of_subdomains
from fenics_tfeti.feti.local.trial_displacements import TrialDisplacements
from fenics_tfeti.feti.system import TornSystem, node_graph
from fenics_tfeti.parallel import Directory, any_rank
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
    if any_rank(system.comm, jumps):
        whole = constraints.weights.copy()
        own = whole[unknowns.displacements].reshape(-1, system.gdim)[:, 0]
        over_copies = _over_copies(system, own)
        whole[unknowns.displacements] = np.repeat(over_copies, system.gdim)
        jumps &= _ratios(whole[interface.columns], interface) > _JUMP
        for k in np.flatnonzero(jumps):
            jumps[k] = _ratio_of_neighbours(system, interface, int(k), over_copies) > _JUMP
    return jumps


def weights_of_equality_rows(constraints: Constraints, interface: Interface, unit: float) -> Vector:
    """Return D on the packed interface unknowns [N/m], zero where only contact rows act.

    A weight of 1 stands for the stiffness `unit` [N/m].
    """
    weights = unit * constraints.weights[interface.columns]
    weights[interface.matrix[np.flatnonzero(constraints.equality)].getnnz(axis=0) == 0] = 0.0
    return weights


def trial_eigenvalue(trial: TrialDisplacements, weights: Vector, R: Vector) -> float:
    """Return what trial displacements show of the largest eigenvalue of a slender subdomain.

    As x'F_s x >= (x'B_s u)^2 / u'K_s u for any u, and B_s'B_s <= D, there are eigenvalues of
    P_s F_s P_s of about (u - Ra)'D(u - Ra) / u'K_s u, with the rigid motion a that makes it least.
    D (k, b) is that on the interface unknowns of each of k congruent subdomains, without contact
    rows, which are not deflated; R_s is (b, modes).
    """
    # of the members, one inside the body touches most
    root = np.sqrt(weights.max(axis=0))[:, None]
    Q = np.linalg.qr(root * R)[0]
    u = root * trial.values.T
    u = u - Q @ (Q.T @ u)
    return trial.largest(u.T @ u)


def _ratio_of_neighbours(
    system: TornSystem, interface: Interface, position: int, weights: Vector
) -> float:
    """Return the largest ratio of the weights of two interface nodes that share a cell.

    `position` is that of the subdomain in the packed interface, `weights` are those of the nodes of
    all subdomains, one after the other.
    """
    number = int(np.concatenate([c.members for c in interface.classes])[position])
    unknowns = of_subdomains(interface.classes, interface.unknowns)[position]
    sizes = [subdomain.nodes.size for subdomain in system.subdomains]
    nodes = np.unique(unknowns // system.gdim)
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
    nodes, position = np.unique(system.nodes, return_inverse=True)
    directory = Directory(system.comm, nodes)
    part: Vector = np.bincount(position, weights, nodes.size).astype(np.float64)
    sums = directory.sums(nodes, part)
    return directory.lookup(nodes, sums)[1][position]

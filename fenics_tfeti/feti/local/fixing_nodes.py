"""Uniformly distributed fixing nodes of a subdomain (algorithm 11.1)."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from fenics_tfeti.feti.local.rigid_body_modes import rigid_body_modes
from fenics_tfeti.typing import Numbers, Vector

# power steps towards the Perron vector: walks of this length tell a centre from a rim
_WALK_LENGTH = 30
# smallest singular value of R on the fixing nodes, relative to the largest, that holds the body
_HOLDS = 1e-3


def node_graph(stiffness: sp.csr_matrix, gdim: int) -> sp.csr_matrix:
    """Return the adjacency matrix D of the mesh's nodes from the pattern of K.

    Parameters
    ----------
    stiffness : (gdim * nodes, gdim * nodes) scipy.sparse.csr_matrix
        K_i.
    gdim : int
        Unknowns of a node.

    Returns
    -------
    (nodes, nodes) scipy.sparse.csr_matrix
        Ones, also on the diagonal.
    """
    blocks = stiffness.tobsr(blocksize=(gdim, gdim))
    ones = np.ones(blocks.indices.size)
    nodes = stiffness.shape[0] // gdim
    return sp.csr_matrix((ones, blocks.indices, blocks.indptr), shape=(nodes, nodes))


def split_nodes(coordinates: Vector, parts: int) -> list[Numbers]:
    """Split nodes into parts of equal size by recursive coordinate bisection (step 1).

    Parameters
    ----------
    coordinates : (nodes, gdim) array
        [m].
    parts : int
        Their number, at most the number of nodes.

    Returns
    -------
    list of integer arrays
        The nodes of each part.
    """

    def bisect(nodes: Numbers, parts: int) -> list[Numbers]:
        if parts == 1:
            return [nodes]
        x = coordinates[nodes]
        lower = parts // 2
        order = nodes[np.argsort(x[:, np.argmax(np.ptp(x, axis=0))], kind="stable")]
        cut = (nodes.size * lower) // parts
        return bisect(order[:cut], lower) + bisect(order[cut:], parts - lower)

    return bisect(np.arange(coordinates.shape[0]), min(parts, coordinates.shape[0]))


def perron_centres(graph: sp.csr_matrix, part: Numbers) -> Numbers:
    """Return the node of each part's graph where its Perron vector is largest (steps 2, 3).

    Parameters
    ----------
    graph : (nodes, nodes) scipy.sparse.csr_matrix
        Adjacency matrix.
    part : (nodes,) integer array
        The part of each node; of one that falls into pieces, the largest stands for it.

    Returns
    -------
    (parts,) integer array
        Of equal ones the first.
    """
    coo = graph.tocoo()
    inside = part[coo.row] == part[coo.col]
    pieces = sp.csr_matrix((coo.data[inside], (coo.row[inside], coo.col[inside])), coo.shape)
    _, piece = connected_components(pieces, directed=False)
    size = np.bincount(piece)[piece]
    # of all pieces at once: walks do not leave them
    walks = np.ones(part.size)
    for _ in range(_WALK_LENGTH):
        walks = pieces @ walks
    order = np.lexsort((-walks, piece, -size, part))
    centres: Numbers = order[np.unique(part[order], return_index=True)[1]]
    return centres


def fixing_nodes(
    stiffness: sp.csr_matrix, coordinates: Vector, number: int, images: Numbers | None = None
) -> Numbers:
    """Choose fixing nodes near the centres of equal parts of the mesh (algorithm 11.1).

    Parameters
    ----------
    stiffness : (n, n) scipy.sparse.csr_matrix
        K_i.
    coordinates : (nodes, gdim) array
        [m].
    number : int
        M; doubled as often as needed where the nodes found lie near a line.
    images : (g, nodes) integer array, optional
        The images of the nodes under symmetries, which the fixing nodes are to have, too: as many
        of those found as make M together with their images.

    Returns
    -------
    (fixing nodes,) integer array
        Local node numbers, ascending.
    """
    graph = node_graph(stiffness, coordinates.shape[1])
    while True:
        parts = split_nodes(coordinates, number)
        part = np.empty(coordinates.shape[0], dtype=np.int64)
        part[np.concatenate(parts)] = np.repeat(np.arange(len(parts)), [len(p) for p in parts])
        chosen = perron_centres(graph, part)
        if images is not None:
            chosen = _with_images(chosen, images)
        chosen = np.sort(chosen)
        if chosen.size == coordinates.shape[0] or _hold_still(coordinates, chosen):
            return chosen
        number *= 2


def _with_images(chosen: Numbers, images: Numbers) -> Numbers:
    """Return the images of the first few nodes, at least as many as there are nodes."""
    nodes = np.zeros(0, dtype=np.int64)
    for node in chosen:
        if nodes.size >= chosen.size:
            break
        nodes = np.union1d(nodes, images[:, node])
    return nodes


def _hold_still(coordinates: Vector, chosen: Numbers) -> bool:
    """Tell whether fixing the chosen nodes stops every rigid motion well."""
    gdim = coordinates.shape[1]
    R = rigid_body_modes(coordinates).reshape(-1, gdim, 3 * gdim - 3)[chosen]
    if R.shape[0] * gdim < R.shape[2]:
        return False
    values = np.linalg.svd(R.reshape(-1, R.shape[2]), compute_uv=False)
    return bool(values[-1] > _HOLDS * values[0])

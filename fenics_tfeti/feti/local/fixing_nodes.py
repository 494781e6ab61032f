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

    It has ones, also on the diagonal; K_i is (gdim * nodes, gdim * nodes).
    """
    blocks = stiffness.tobsr(blocksize=(gdim, gdim))
    ones = np.ones(blocks.indices.size)
    nodes = stiffness.shape[0] // gdim
    return sp.csr_matrix((ones, blocks.indices, blocks.indptr), shape=(nodes, nodes))


def split_nodes(coordinates: Vector, parts: int) -> list[Numbers]:
    """Split nodes into parts of equal size by recursive coordinate bisection (step 1).

    There are at most as many parts as nodes; the coordinates are (nodes, gdim) [m].
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

    Of a part that falls into pieces, the largest stands for it; of equal entries the first counts.
    `part` is the part of each node (nodes,).
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

    Returns local node numbers, ascending. Their number M is doubled as often as needed where the
    nodes found lie near a line. The fixing nodes are symmetric under the images (g, nodes) of the
    nodes: as many of those found as make M together with their images.
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

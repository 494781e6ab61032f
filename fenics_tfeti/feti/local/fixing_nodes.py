"""Uniformly distributed fixing nodes of a subdomain (algorithm 11.1)."""

from __future__ import annotations

import numpy as np

from fenics_tfeti.typing import Numbers, Vector

# M of algorithm 11.1 if nothing else is asked for
FIXING_NODES = 8

# smallest singular value of R on the fixing nodes, relative to the largest, that holds the body
_HOLDS = 1e-3


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


def fixing_nodes(
    coordinates: Vector, R: Vector, number: int, images: Numbers | None = None
) -> Numbers:
    """Choose fixing nodes near the centres of equal parts of the mesh (algorithm 11.1).

    For steps 2 and 3 the node of a part next to its mean place is taken. Returns local node
    numbers, ascending. Their number M is doubled as often as needed where the nodes found do not
    hold the motions R (n, k) of a body with coordinates (nodes, gdim) [m], such as nodes near a
    line. The fixing nodes are symmetric under the images (g, nodes) of the nodes: as many of those
    found as make M together with their images.
    """
    nodes, gdim = coordinates.shape
    while True:
        chosen = np.array([_centre(coordinates, part) for part in split_nodes(coordinates, number)])
        if images is not None:
            chosen = _with_images(chosen, images)
        chosen = np.sort(chosen)
        if chosen.size == nodes or _hold_still(R, unknowns_of_nodes(chosen, gdim)):
            return chosen
        number *= 2


def unknowns_of_nodes(nodes: Numbers, gdim: int) -> Numbers:
    """Return the unknowns of nodes, node by node."""
    return (gdim * nodes[:, None] + np.arange(gdim)).ravel()


def _centre(coordinates: Vector, part: Numbers) -> int:
    """Return the node of a part next to its mean place; of equal ones the first."""
    x = coordinates[part]
    return int(part[np.argmin(np.sum((x - x.mean(axis=0)) ** 2, axis=1))])


def _with_images(chosen: Numbers, images: Numbers) -> Numbers:
    """Return the images of the first few nodes, at least as many as there are nodes."""
    nodes = np.zeros(0, dtype=np.int64)
    for node in chosen:
        if nodes.size >= chosen.size:
            break
        nodes = np.union1d(nodes, images[:, node])
    return nodes


def _hold_still(R: Vector, fixed: Numbers) -> bool:
    """Tell whether fixing some unknowns stops every motion well."""
    if fixed.size < R.shape[1]:
        return False
    values = np.linalg.svd(R[fixed], compute_uv=False)
    return not values.size or bool(values[-1] > _HOLDS * values[0])

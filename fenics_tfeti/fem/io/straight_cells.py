"""Curved cells that are folded, with sides that are made straight.

Programs for meshes put the nodes between the corners of surface cells onto the surface of the CAD
model. Where that is curved by more than the cells are high, as along fillets, they fold.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fenics_tfeti.errors import format_point
from fenics_tfeti.fem.checks.cells import folded_cells
from fenics_tfeti.fem.geometry.reference_cells import lagrange_points, shape_values
from fenics_tfeti.fem.io.tagged_mesh import WholeMesh
from fenics_tfeti.typing import Vector


def straighten_folded_cells(whole: WholeMesh) -> tuple[WholeMesh, str]:
    """Return a mesh whose folded cells have straight sides, and a message that counts them.

    Neighbours share these sides. Those that fold by that become straight, too. Corners stay, and
    so do all nodes of other cells. The message is empty if no cell is folded.
    """
    if whole.degree == 1:
        return whole, ""
    nodes, kind, x = whole.nodes, whole.kind, whole.x.copy()
    between = slice(kind.vertices, None)
    weights = shape_values(kind.name, 1, lagrange_points(kind.name, 2))[between]
    is_straight, suspect = np.zeros((2, len(nodes)), dtype=bool)
    suspect[:] = True
    while suspect.any():
        tested = np.flatnonzero(suspect)
        folded = tested[folded_cells(kind, nodes[tested], x)]
        moved = nodes[folded, between]
        x[moved] = weights @ x[nodes[folded, : kind.vertices]]
        is_straight[folded] = True
        suspect = np.isin(nodes, moved).any(axis=1) & ~is_straight
    return replace(whole, x=x), _message(whole, is_straight, x)


def _message(whole: WholeMesh, is_straight: Vector, x: Vector) -> str:
    """Tell how many cells were made straight, where, and how far nodes have moved."""
    cells = np.flatnonzero(is_straight)
    if not cells.size:
        return ""
    middle = x[whole.nodes[cells[0], : whole.kind.vertices]].mean(axis=0)
    distance = np.linalg.norm(x - whole.x, axis=1).max()
    return (
        f"made the sides of {cells.size} of {len(whole.nodes)} curved cells straight, which were "
        f"folded, the first around {format_point(middle)}: their nodes moved by up to "
        f"{distance:.2g}. Cells that are finer there follow the surface"
    )

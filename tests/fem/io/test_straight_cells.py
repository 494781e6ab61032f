"""Folded cells of degree 2 get straight sides; all others keep their nodes."""

import numpy as np
import pytest
from scenes import CELLS

from fenics_tfeti.fem.geometry.reference_cells import lagrange_points
from fenics_tfeti.fem.io.straight_cells import straighten_folded_cells
from fenics_tfeti.fem.io.tagged_mesh import WholeMesh


def mesh_of(cell, nodes, x):
    """Return a mesh of degree 2 without tags."""
    return WholeMesh(cell, 2, nodes, x, np.zeros(len(nodes)), np.zeros(nodes.shape), {}, {})


@pytest.mark.parametrize("cell", CELLS)
def test_folded_cell_gets_straight_sides(cell):
    """Of two cells, each on its own; the other one is curved, too, and is not folded."""
    straight = lagrange_points(cell, 2)
    # the first node that is no corner
    first, folded, curved = 2 ** straight.shape[1], straight.copy(), straight + 5.0
    first = first if cell in ("quadrilateral", "hexahedron") else straight.shape[1] + 1
    folded[first] += 0.6 * (straight.mean(axis=0) - straight[first]) / 0.3
    curved[first] += 0.1 * (straight.mean(axis=0) - straight[first])
    nodes = np.arange(2 * len(straight)).reshape(2, -1)
    mended, message = straighten_folded_cells(mesh_of(cell, nodes, np.vstack([folded, curved])))
    np.testing.assert_allclose(mended.x, np.vstack([straight, curved]), atol=1e-15)
    assert "1 of 2 curved cells" in message


def test_neighbour_that_folds_by_that_gets_straight_sides_too():
    """A thin triangle follows the curved side of its neighbour, which is folded elsewhere."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.05], [0.5, 1.0]])
    x = np.vstack([corners, np.zeros((5, 2))])
    # sides of the thin triangle and of the one above it
    sides = {4: (1, 2), 5: (0, 2), 6: (0, 1), 7: (2, 3), 8: (0, 3)}
    for middle, ends in sides.items():
        x[middle] = corners[list(ends)].mean(axis=0)
    nodes = np.array([[0, 1, 2, 4, 5, 6], [0, 2, 3, 7, 8, 5]])
    # both sides along the thin one, which keeps its thickness, and then one of the upper one
    bent = x.copy()
    bent[[5, 6], 1] += 0.1
    assert straighten_folded_cells(mesh_of("triangle", nodes, bent))[1] == ""
    bent[7] = 0.1, 0.2
    mended, message = straighten_folded_cells(mesh_of("triangle", nodes, bent))
    assert "2 of 2 curved cells" in message
    np.testing.assert_allclose(mended.x, x, atol=1e-15)

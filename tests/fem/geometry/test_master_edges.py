"""Gaps beside sharp edges of a master: of each of its faces, and never less than the least one."""

from mpi4py import MPI

import numpy as np
import pytest
from matching import match_contacts
from scenes import MASTER, SLAVE, Scene, at

from dolfinx.fem import Function

from fenics_tfeti import ContactPair, find_contacts
from fenics_tfeti.fem.contact.conditions.deformed import deformed_contacts
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary

pytestmark = pytest.mark.ranks

CELLS = ["quadrilateral", "triangle", "hexahedron", "tetrahedron"]


def leaning(x):
    """Sides that are inclined to the slave by 81 degrees."""
    return np.stack([x[0] + 0.3 * (x[0] - 0.5) * (1.0 - x[-1]), *x[1:]])


def ridge(x):
    return np.stack([*x[:-1], x[-1] * (1.0 - np.abs(x[0] - 0.5))])


def wedge(x):
    """Sides that are inclined to the slave by more than 60 degrees."""
    return np.stack([*x[:-1], x[-1] * (1.0 - 1.9 * np.abs(x[0] - 0.5))])


def step(x):
    """A riser of 0.2 at 0.5, inclined by 87 degrees."""
    return np.stack(
        [
            np.where(np.isclose(x[0], 0.25), 0.49, x[0]),
            *x[1:-1],
            x[-1] * np.where(x[0] < 0.4, 0.8, 1.0),
        ]
    )


def pressed(cell, shape):
    """Return the scene of a table and a wider block above, whose nodes are off the table's edges.

    The table, of the shape, is tagged with its sides.
    """
    g = 2 if cell in ("quadrilateral", "triangle") else 3
    zeros, ones, twos = (0.0,) * (g - 2), (1.0,) * (g - 2), (2,) * (g - 1)
    table = ((0.0,) * g, (1.0,) * g, (4,) * (g - 1) + (2,))
    block = ((-0.6, *zeros, 1.0), (1.4, *ones, 2.0), (4, *twos))
    marks = [(MASTER, at(0, end), 1) for end in (0.0, 1.0)]
    marks += [(MASTER, at(g - 1, 1.0), 1), (SLAVE, at(g - 1, 1.0), 2)]
    scene = Scene.of_boxes(MPI.COMM_WORLD, cell, [table, block], marks)
    nodes, x = scene.nodes(1), scene.mesh.geometry.x
    x[nodes, :g] = shape(x[nodes, :g].T).T
    return scene


def gaps(scene, contacts):
    all_conditions = match_contacts(MeshBoundary.of(scene.V), contacts)
    own = np.concatenate([conditions.gap for conditions in all_conditions])
    return np.concatenate(MPI.COMM_WORLD.allgather(own))


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("shape", [leaning, ridge, wedge, step])
def test_least_gap_is_zero(cell, shape):
    """The mean of a gap with a bend, or a jump, is negative at one node, or positive at all."""
    scene = pressed(cell, shape)
    gap = gaps(scene, [ContactPair(scene.facet_tags, SLAVE, MASTER)])
    assert gap.min() == pytest.approx(0.0, abs=1e-12)
    if shape is step:
        np.testing.assert_allclose(np.abs(gap - 0.1), 0.1, rtol=1e-12)


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_least_gap_of_contacts_that_are_found(cell):
    scene = pressed(cell, leaning)
    contacts = find_contacts(scene.mesh, scene.cell_tags, distance=0.3)
    assert gaps(scene, contacts).min() == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_sides_that_come_to_face_the_slave(cell):
    """As bodies deform, or turn, before which the sides face nothing."""
    scene = pressed(cell, lambda x: x)
    pair = ContactPair(scene.facet_tags, SLAVE, MASTER)
    all_conditions = match_contacts(MeshBoundary.of(scene.V), [pair])
    uh, x = Function(scene.V), scene.V.tabulate_dof_coordinates()
    g = scene.mesh.geometry.dim
    moved = leaning(x[:, :g].T).T - x[:, :g]
    below = (x[:, g - 1] < 1.0 - 1e-9) | (x[:, 0] > -0.1) & (x[:, 0] < 1.1)
    uh.x.array.reshape(-1, g)[below] = moved[below]
    for state in deformed_contacts([(pair, conditions) for conditions in all_conditions], uh):
        least = state.distance.min(initial=0.0)
        assert MPI.COMM_WORLD.allreduce(least, MPI.MIN) == pytest.approx(0.0, abs=1e-12)

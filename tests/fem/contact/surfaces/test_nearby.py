"""Each rank gets of a master's surface what is near its slave facets, and all of that."""

from mpi4py import MPI

import numpy as np
import pytest
from mortar_blocks import LOWER, UPPER, Blocks
from scenes import Scene, at

from dolfinx.fem import Function

from fenics_tfeti.fem.contact.surfaces.nearby import gather_nearby
from fenics_tfeti.fem.contact.surfaces.oriented import oriented_facets
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, tagged_surface
from fenics_tfeti.fem.geometry.cells import MasterTree
from fenics_tfeti.fem.geometry.facets import Facets, Planes
from fenics_tfeti.fem.geometry.integrals import integrate

COMM = MPI.COMM_WORLD


def test_all_of_it_on_one_rank():
    scene = Blocks("triangle", 3, 4).scene()
    boundary, tags = MeshBoundary.of(scene.V), scene.facet_tags
    lower, upper = (tagged_surface(boundary, tags, tag, "") for tag in (LOWER, UPPER))
    near, whole = gather_nearby(upper, lower), upper.gathered()
    for name in ("nodes", "points"):
        np.testing.assert_array_equal(getattr(near, name), getattr(whole, name))
    np.testing.assert_array_equal(near.facets.nodes, whole.facets.nodes)


LENGTH = 40.0


def strip(gap=0.0, cell="quadrilateral"):
    """Return space and tags of two long strips, meshed apart."""
    parts = [
        ((0.0, 0.0), (LENGTH, 1.0), (160, 4)),
        ((0.0, 1.0 + gap), (LENGTH, 2.0 + gap), (200, 5)),
    ]
    marks = [(LOWER, at(1, 1.0), 1), (UPPER, at(1, 1.0 + gap), 2)]
    scene = Scene.of_boxes(COMM, cell, parts, marks)
    return scene.V, scene.facet_tags


def both(gap=0.0, move=(0.0, 0.0)):
    """Return this rank's slave facets, the master near them and the whole one; which is moved."""
    V, tags = strip(gap)
    uh = Function(V)
    places = V.tabulate_dof_coordinates()
    upper = places[:, 1] > 1.0 + 0.5 * gap if gap else np.zeros(len(places), dtype=bool)
    uh.x.array.reshape(-1, 2)[upper] = move
    boundary = MeshBoundary.of(V)
    deformed = boundary.deformed(uh)
    slave, master = (tagged_surface(boundary, tags, tag, "").on(deformed) for tag in (LOWER, UPPER))
    x = places[:, :2] + uh.x.array.reshape(-1, 2)
    found = tags.find(LOWER)
    owned = V.mesh.topology.index_map(1).size_local
    facets = Facets(x, oriented_facets(V, np.sort(found[found < owned])).astype(np.int64))
    return facets, gather_nearby(master, slave), master.gathered(), slave


def pairs(slave, master):
    """Return the pairs of facets over each other, the master's by their nodes."""
    found = integrate(slave, master.facets)
    nodes = np.sort(master.nodes[master.facets.nodes[found.master]], axis=1)
    return {(int(found.facet[k]), *row) for k, row in zip(found.pair, nodes.tolist(), strict=True)}


@pytest.mark.ranks(2, 3)
@pytest.mark.parametrize(("gap", "move"), [(0.0, (0.0, 0.0)), (0.3, (3.3, 0.1)), (2.0, (0.0, 0.0))])
def test_nothing_is_missing(gap, move):
    slave, near, whole, surface = both(gap, move)
    assert pairs(slave, near) == pairs(slave, whole)
    if not len(slave):
        return
    planes = Planes.of(slave.coordinates())
    reach = [MasterTree(part.facets).reach(slave, planes) for part in (near, whole)]
    np.testing.assert_allclose(reach[0], reach[1], rtol=1e-14)
    # normals are those of the whole surface where they are used
    used = np.array(sorted({node for pair in pairs(slave, near) for node in pair[1:]}), dtype=int)
    mine, all_of_them = near.normal, whole.normal
    np.testing.assert_allclose(
        mine[np.searchsorted(near.nodes, used)],
        all_of_them[np.searchsorted(whole.nodes, used)],
        atol=1e-14,
    )
    # also the master node nearest to each slave node that the rank owns
    for x in surface.points:
        closest = whole.nodes[np.linalg.norm(whole.points - x, axis=1).argmin()]
        assert closest in near.nodes


@pytest.mark.ranks(2, 3)
def test_ranks_share_the_surface():
    """Whatever the partition: the slave's facets are on one rank each."""
    _, near, whole, _ = both()
    gathered = COMM.allreduce(len(near.facets))
    assert gathered <= 1.3 * len(whole.facets)

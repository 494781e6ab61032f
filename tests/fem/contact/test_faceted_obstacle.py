"""Rigid obstacles by facets, against the shapes that they are."""

from __future__ import annotations

import struct

from mpi4py import MPI

import numpy as np
import pytest
from scenes import GROUND, LOADED, SLAVE, Scene, at, pressed_block

from fenics_tfeti import FacetedObstacle, InputError, Plane, RigidObstacle
from fenics_tfeti.io import Box, boxes, tag_facets

COMM = MPI.COMM_WORLD
# a square at height 0 that faces upwards
SQUARE = [(-1, -1, 0), (2, -1, 0), (2, 2, 0), (-1, 2, 0)]
TRIANGLES = [(0, 1, 2), (0, 2, 3)]
POINTS = np.random.default_rng(0).uniform(-0.5, 1.5, (3, 50))


def solved(obstacle):
    scene = pressed_block(COMM)
    problem = scene.problem(contacts=[RigidObstacle(scene.facet_tags, GROUND, obstacle)])
    return problem.solve().x.array.copy()


def write_stl(path, binary: bool):
    corners = np.array(SQUARE, dtype=float)[np.array(TRIANGLES)]
    if binary:
        triangles = [np.append(np.zeros(3), c.ravel()) for c in corners]
        body = b"".join(struct.pack("<12fH", *t, 0) for t in triangles)
        path.write_bytes(b"solid".ljust(80) + struct.pack("<I", len(corners)) + body)
    else:
        facets = "\n".join(
            "facet normal 0 0 1\nouter loop\n"
            + "\n".join(f"vertex {x} {y} {z}" for x, y, z in c)
            + "\nendloop\nendfacet"
            for c in corners
        )
        path.write_text(f"solid square\n{facets}\nendsolid square\n")


@pytest.mark.parametrize("binary", [True, False])
def test_stl(binary, tmp_path):
    write_stl(tmp_path / "square.stl", binary)
    obstacle = FacetedObstacle.from_stl(tmp_path / "square.stl", scale=2.0)
    gap, normal = obstacle(POINTS)
    plane_gap, plane_normal = Plane((0, 0, 0), (0, 0, 1))(POINTS)
    assert gap == pytest.approx(plane_gap, abs=1e-12)
    assert normal == pytest.approx(plane_normal, abs=1e-9)
    assert np.abs(np.asarray(obstacle.points)).max() == 4.0


@pytest.mark.ranks
def test_solution_is_that_of_the_plane():
    plane = solved(Plane((0, 0, 0), (0, 0, 1)))
    assert solved(FacetedObstacle(SQUARE, TRIANGLES)) == pytest.approx(plane, abs=1e-12)


@pytest.mark.ranks
@pytest.mark.parametrize("gdim", [2, 3])
def test_surface_of_another_mesh(gdim):
    low, high = (-1.0,) * gdim, (2.0,) * (gdim - 1) + (0.0,)
    cell = "quadrilateral" if gdim == 2 else "hexahedron"
    box = boxes(COMM, [Box(low, high, (2,) * gdim)], cell)
    tags = tag_facets(box.mesh, [(7, at(gdim - 1, 0.0))])
    obstacle = FacetedObstacle.from_mesh(box.mesh, tags, 7)
    gap, normal = obstacle(POINTS)
    assert gap == pytest.approx(POINTS[gdim - 1], abs=1e-12)
    assert normal[-1] == pytest.approx(np.ones(50), abs=1e-9)


MISTAKES = {
    "the facets have shape": lambda: FacetedObstacle(SQUARE, [(0, 1)]),
    "not all rows": lambda: FacetedObstacle(SQUARE, [(0, 1, 4)]),
    "no facet has a size": lambda: FacetedObstacle(SQUARE, [(0, 1, 1)]),
    "the points have shape": lambda: FacetedObstacle([0.0, 1.0], [(0, 1)]),
}


@pytest.mark.parametrize("words", MISTAKES)
def test_wrong_facets(words):
    with pytest.raises(InputError, match=words):
        MISTAKES[words]()


def test_wrong_files(tmp_path):
    path = tmp_path / "text.stl"
    path.write_text("no triangles at all")
    with pytest.raises(InputError, match="not an STL file: no triangles"):
        FacetedObstacle.from_stl(path)
    with pytest.raises(InputError, match="scale is 0"):
        FacetedObstacle.from_stl(path, scale=0)
    with pytest.raises(OSError, match=r"nothing\.stl"):
        FacetedObstacle.from_stl(tmp_path / "nothing.stl")
    scene = Scene.of_boxes(COMM, "quadrilateral", [((0, 0), (1, 1), (2, 2))], [(LOADED, at(1, 0))])
    with pytest.raises(InputError, match=r"the obstacle: tag 5 is on no facet"):
        FacetedObstacle.from_mesh(scene.mesh, scene.facet_tags, SLAVE)

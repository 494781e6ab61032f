"""Subdomains are connected, of about the wanted size, and equal blocks where cells form a grid."""

from mpi4py import MPI

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.fem.decomposition.partition import as_subdomains, split_into_subdomains
from fenics_tfeti.fem.decomposition.parts import number_parts
from fenics_tfeti.fem.decomposition.round_parts import mean_aspect
from fenics_tfeti.io import Box, boxes, displacement_space


def cube(n, cell="hexahedron"):
    return boxes(MPI.COMM_SELF, [Box((0, 0, 0), (1, 1, 1), (n, n, n))], cell).mesh


def split(mesh, unknowns, *partitioner):
    space = displacement_space(mesh)
    return split_into_subdomains(space, find_bodies(mesh, None), unknowns, *partitioner)


def test_blocks_are_equal():
    parts = split(cube(12, "tetrahedron"), 1000)
    assert {part.size for part in parts} == {6 * 6**3}


def test_scotch_can_be_asked_for():
    mesh = cube(16)
    sizes = {part.size for part in split(mesh, 2200, "scotch")}
    assert {part.size for part in split(mesh, 2200)} == {512}
    assert sizes != {512}


def spring(turns):
    """Return a flat strip that is wound up, in quadrilaterals."""
    mesh = boxes(MPI.COMM_SELF, [Box((0, 0), (turns, 1), (60 * turns, 4))], "quadrilateral").mesh
    x = mesh.geometry.x
    angle, radius = 2 * np.pi * x[:, 0], 3.0 * x[:, 0] + x[:, 1] + 4.0
    x[:, 0], x[:, 1] = radius * np.cos(angle), radius * np.sin(angle)
    return mesh


def same(one, other):
    return len(one) == len(other) and all(map(np.array_equal, one, other))


def test_boxes_are_cut_into_slabs():
    """Of a mesh that is no grid."""
    mesh = cube(7, "tetrahedron")
    mesh.geometry.x[:] += 0.02 * np.sin(9 * mesh.geometry.x[:, [1, 2, 0]])
    assert same(split(mesh, 300), split(mesh, 300, "slabs"))
    assert not same(split(mesh, 300), split(mesh, 300, "scotch"))


def test_bodies_that_planes_cut_badly_have_rounder_parts():
    mesh = spring(4)
    bodies = find_bodies(mesh, None)
    midpoints = mesh.geometry.x[_compat.geometry_cells(mesh), :2].mean(axis=1)

    def aspect(partitioner):
        label = np.empty(len(midpoints), dtype=np.int64)
        for number, cells in enumerate(split(mesh, 300, partitioner)):
            label[cells] = number
        return mean_aspect(bodies.graph, midpoints, label)

    chosen, slabs = aspect("auto"), aspect("slabs")
    assert chosen < slabs and chosen < 1.1 * aspect("scotch")


@pytest.mark.parametrize("partitioner", ["auto", "scotch", "slabs"])
def test_subdomains_are_connected_and_cover_all_cells(partitioner):
    mesh = cube(9)
    parts = split(mesh, 600, partitioner)
    graph = find_bodies(mesh, None).graph
    assert sorted(np.concatenate(parts)) == list(range(9**3))
    assert all(connected_components(graph[part][:, part])[0] == 1 for part in parts)


def test_no_subdomain_is_in_two_bodies():
    parts = [Box((0, 0), (1, 1), (4, 4)), Box((0, 1), (1, 2), (4, 4))]
    mesh = boxes(MPI.COMM_SELF, parts, "quadrilateral").mesh
    assert [part.size for part in split(mesh, 10**6)] == [16, 16]


def test_cells_of_one_label_are_one_subdomain():
    mesh = cube(4)
    label = np.arange(4**3) // 32
    found = as_subdomains(mesh, find_bodies(mesh, None), label)
    assert sum(part.size for part in found) == 4**3
    assert all(np.unique(label[part]).size == 1 for part in found)


def test_label_of_separate_cells_gives_several_subdomains():
    mesh = boxes(MPI.COMM_SELF, [Box((0, 0), (5, 1), (5, 1))], "quadrilateral").mesh
    label = np.zeros(5, dtype=int)
    graph = find_bodies(mesh, None).graph
    middle = np.argmax(np.diff(graph.indptr) == 2)  # a cell with two neighbours
    label[middle] = 1
    assert len(as_subdomains(mesh, find_bodies(mesh, None), label)) == 3


def test_bodies_that_are_images_are_cut_equally():
    """A distorted block and its mirror image, turned by 40 degrees: equal cuts, two by two."""
    n = 10
    mesh = boxes(MPI.COMM_SELF, [Box((k, 0), (k + 1, 1), (n, n)) for k in (0, 2)], "triangle").mesh
    x = mesh.geometry.x
    second = np.flatnonzero(x[:, 0] > 1.5)
    first = np.flatnonzero(x[:, 0] < 1.5)
    x[first, 0] += 0.1 * x[first, 1] ** 2
    c, s = np.cos(np.radians(40)), np.sin(np.radians(40))
    # the order of the nodes of both blocks is their own
    at = x[second, 0] - 2, x[second, 1]
    plain = at[0] + 0.1 * at[1] ** 2, -at[1]
    x[second, 0], x[second, 1] = 5 + c * plain[0] - s * plain[1], s * plain[0] + c * plain[1]
    space = displacement_space(mesh)
    parts = split_into_subdomains(space, find_bodies(mesh, None), 60)
    numbered = number_parts(space, parts, range(len(parts)))
    shapes = [part.shape for part in numbered]
    assert len(parts) >= 8 and len(parts) % 2 == 0
    assert len(set(shapes)) <= len(parts) // 2
    assert all(shapes.count(shape) % 2 == 0 for shape in shapes)
    assert sum(part.rotation is not None for part in numbered) >= len(parts) // 2

"""Mistakes in meshes and in the tags of their cells."""

from __future__ import annotations

import numpy as np
from mesh_arrays import concatenated, grid, merged, mesh_of, problem_on, slit, tags_of

from mistakes.catalogue import mistake


@mistake("tag 7", "2 pieces", r"\(0\.5, 0\.5\)", r"\(5\.5, 0\.5\)", "cell_tags", "own")
def tag_on_two_pieces(comm):
    points, cells = concatenated(grid((2, 2)), grid((2, 2), (5.0, 0.0)))
    domain = mesh_of(comm, "quadrilateral", points, cells)
    problem_on(domain, cell_tags=tags_of(domain, np.full(8, 7)))


@mistake("tag 7", "2 pieces", "3 pairs of nodes", "same place", r"\(2, 0\)", "merged")
def tag_on_two_pieces_with_nodes_at_the_same_places(comm):
    points, cells = concatenated(grid((2, 2)), grid((2, 2), (2.0, 0.0)))
    domain = mesh_of(comm, "quadrilateral", points, cells)
    problem_on(domain, cell_tags=tags_of(domain, np.full(8, 7)))


@mistake("tag 7", "2 pieces", r"share 1 node \(at \(2, 2\)\)", "no facet")
def tag_on_two_pieces_that_share_a_vertex(comm):
    points, cells = merged(*concatenated(grid((2, 2)), grid((2, 2), (2.0, 2.0))))
    domain = mesh_of(comm, "quadrilateral", points, cells)
    problem_on(domain, cell_tags=tags_of(domain, np.full(8, 7)))


@mistake("joined through", r"1 node \(at \(2, 2\)\)", "no facet", "body 0", "body 1", "own")
def bodies_that_share_a_vertex(comm):
    points, cells = merged(*concatenated(grid((2, 2)), grid((2, 2), (2.0, 2.0))))
    problem_on(mesh_of(comm, "quadrilateral", points, cells))


@mistake("joined through", r"3 nodes \(the first at \(1, 0, 1\)\)", "cell tag 1.*cell tag 2")
def bodies_that_share_an_edge(comm):
    points, cells = merged(*concatenated(grid((1, 2, 1)), grid((1, 2, 1), (1.0, 0.0, 1.0))))
    domain = mesh_of(comm, "hexahedron", points, cells)
    problem_on(domain, cell_tags=tags_of(domain, [1, 1, 2, 2]))


@mistake(
    "body 0", "2 pairs of nodes", "same place", r"\(2, 0\)", "crack", "(?i)merge", "ContactPair"
)
def nodes_at_the_same_place_in_a_body(comm):
    problem_on(mesh_of(comm, "quadrilateral", *slit(4)))


@mistake("1 of 4 cells", "without area", r"around \(2, 0\)", "body 0", "(?i)mesh")
def cell_without_area(comm):
    points = [(0, 0), (2, 0), (4, 0), (2, 2), (2, -2)]
    cells = [(0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 4)]
    problem_on(mesh_of(comm, "triangle", points, cells))


@mistake("1 of 3 cells", "without volume", r"\(0\.5, 0\.5, 1\)", "body 0")
def cell_without_volume(comm):
    points, cells = grid((1, 1, 3))
    points[points[:, 2] == 2.0, 2] = 1.0
    problem_on(mesh_of(comm, "hexahedron", points, cells))


@mistake("4 of 4 cells", "twisted", "sign", r"\(0\.5, 0\.5\)", "body 0", "order")
def vertices_in_the_order_of_gmsh(comm):
    points, cells = grid((2, 2))
    problem_on(mesh_of(comm, "quadrilateral", points, cells[:, [0, 1, 3, 2]]))


@mistake("cells that overlap", "same side", "body 0", "(?i)mesh")
def vertex_pushed_through_the_opposite_side(comm):
    points, cells = grid((3, 3))
    halves = np.concatenate([cells[:, [0, 1, 2]], cells[:, [1, 2, 3]]])
    points[5] = (2.3, 2.1)
    problem_on(mesh_of(comm, "triangle", points, halves))


@mistake("nodes of the mesh", "coordinates", "NaN")
def nan_in_a_coordinate(comm):
    points, cells = grid((2, 2))
    points[4, 1] = np.nan
    problem_on(mesh_of(comm, "quadrilateral", points, cells))

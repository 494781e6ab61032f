"""The part of a tagged surface that is near a rank's facets of another one, from all ranks.

A mortar condition needs the master's facets over the slave's. Which these can be follows from the
distance of each slave node from the master, so that no search distance has to be given. Ranks tell
each other boxes around their parts, few for each rank, then exchange slave nodes and distances, and
then the master's facets, each only with the ranks whose boxes say so.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from scipy.spatial import cKDTree

from fenics_tfeti.fem.contact.surfaces.surface_facets import SurfaceFacets
from fenics_tfeti.fem.contact.surfaces.tagged import Surface
from fenics_tfeti.fem.geometry.box_tree import BoxTree
from fenics_tfeti.fem.geometry.cells import REACH
from fenics_tfeti.fem.geometry.facets import Facets
from fenics_tfeti.parallel import all_to_all
from fenics_tfeti.typing import Mask, Numbers, Vector

Boxes = tuple[Vector, Vector]


def gather_nearby(surface: Surface, other: Surface, number: Numbers | None = None) -> SurfaceFacets:
    """Gather the part of a surface near this rank's facets and nodes of another one. Collective.

    All facets are there that may lie over a facet that this rank has of the other surface, which
    may be the same, those closest to it, and the ones around each of their nodes, so that normals
    there are those of the whole surface. Of the nodes that the rank owns, the facets may be other
    ranks'. With them come the numbers (f,) of this rank's facets, if they are given.
    """
    comm, boundary = surface.comm, surface.boundary
    if comm.size == 1:
        return surface.part(number=number)
    points = boundary.coordinates[:, : surface.normal.shape[1]]
    rows, nodes = (part.facet_nodes.astype(np.int64) for part in (surface, other))
    facets = Facets(points, rows, boundary.nodes.contact)
    points = facets.apart(np.arange(len(points)))
    tree = BoxTree(points[rows])
    nodes = np.concatenate([nodes, np.repeat(other.local[:, None], nodes.shape[1], axis=1)])
    distance = _distances(comm, points, nodes, facets, tree)
    needed = _needed_boxes(comm, points, nodes, rows, distance)
    chosen = facets_in_boxes(comm, needed, tree)
    messages = [surface.part(rows, number) for rows in chosen]
    return SurfaceFacets.joined(all_to_all(comm, messages))


def _distances(
    comm: MPI.Intracomm, points: Vector, nodes: Numbers, facets: Facets, tree: BoxTree
) -> Vector:
    """Return the distance (n,) of each local node on the other surface's facets from the surface.

    It is that from the surface's nodes and the centres of its facets, as in `MasterTree`; zero at
    other nodes.
    """
    queried = np.unique(nodes)
    x = points[queried]
    boxes = comm.allgather(tree.boxes())
    # the surface is not farther than the farthest point of any box
    nearest, farthest = zip(*(_range(x, low, high) for low, high in boxes), strict=True)
    queries = [np.flatnonzero(part <= np.min(farthest, axis=0)) for part in nearest]
    received = all_to_all(comm, [x[query] for query in queries])
    centres = points[facets.pieces].mean(axis=1)
    places = cKDTree(np.concatenate([points[np.unique(facets.nodes)], centres]))
    answers = [places.query(part)[0] for part in received]
    closest = np.full(len(x), np.inf)
    for query, answer in zip(queries, all_to_all(comm, answers), strict=True):
        closest[query] = np.minimum(closest[query], answer)
    distance = np.zeros(len(points))
    distance[queried] = closest
    return distance


def _needed_boxes(
    comm: MPI.Intracomm, points: Vector, nodes: Numbers, rows: Numbers, distance: Vector
) -> list[Boxes]:
    """Return for each rank boxes around all that it needs of the surface."""
    x = points[rows]
    largest = np.linalg.norm(x.max(axis=1) - x.min(axis=1), axis=1).max(initial=0.0)
    # one facet more: those around the corners of the facets over the slave's
    margin = comm.allreduce(float(largest), MPI.MAX)
    x = points[nodes]
    low, high = x.min(axis=1), x.max(axis=1)
    reach = REACH * distance[nodes].max(axis=1) + np.linalg.norm(high - low, axis=1) + margin
    boxes = np.stack([low - reach[:, None], high + reach[:, None]], axis=1)
    return list(comm.allgather(BoxTree(boxes).boxes()))


def facets_in_boxes(comm: MPI.Intracomm, needed: list[Boxes], tree: BoxTree) -> list[Numbers]:
    """Return this rank's facets of the surface that meet the boxes of each rank."""
    rank = np.repeat(np.arange(comm.size), [len(low) for low, _ in needed])
    low, high = (np.concatenate(ends) for ends in zip(*needed, strict=True))

    def overlaps(query: Numbers, box_low: Vector, box_high: Vector) -> Mask:
        return ((box_low <= high[query]) & (box_high >= low[query])).all(axis=1)

    query, facet = tree.candidates(len(rank), overlaps)
    return [np.unique(facet[rank[query] == destination]) for destination in range(comm.size)]


def _range(x: Vector, low: Vector, high: Vector) -> tuple[Vector, Vector]:
    """Return bounds of the distance (n,) of points from what is in all boxes."""
    nearest, farthest = np.full((2, len(x)), np.inf)
    for bottom, top in zip(low, high, strict=True):
        outside = np.maximum(np.maximum(bottom - x, x - top), 0.0)
        nearest = np.minimum(nearest, np.linalg.norm(outside, axis=1))
        across = np.maximum(np.abs(x - bottom), np.abs(x - top))
        farthest = np.minimum(farthest, np.linalg.norm(across, axis=1))
    return nearest, farthest

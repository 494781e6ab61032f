"""Facets of bodies that are opposite to facets of other bodies along their normals."""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np

from fenics_tfeti.fem.contact.mortar.cells import (
    Cells,
    MasterTree,
    inside,
    nearest_layers,
    overlapping_cells,
)
from fenics_tfeti.fem.contact.mortar.facets import Facets, Planes
from fenics_tfeti.fem.contact.surfaces.box_tree import BoxTree
from fenics_tfeti.fem.contact.surfaces.exterior import ExteriorFacets
from fenics_tfeti.fem.contact.surfaces.faceted import edge_lengths
from fenics_tfeti.fem.contact.surfaces.nearby import facets_in_boxes
from fenics_tfeti.fem.contact.surfaces.surface_facets import SurfaceFacets
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING, SAME_PLACE
from fenics_tfeti.fem.topology import batches
from fenics_tfeti.parallel import all_to_all, first_of_rank
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class OppositeFacets:
    """Facets of this rank, each with one opposite to it of another body."""

    rows: Numbers  # (p, 4): bodies of both, the facet, and the number of the other over all ranks
    ratio: Vector  # (p,): size of the other over that of the facet, by their areas
    gap: Vector  # (p,): distance along the facet's normal [m]
    reach: Vector  # (p,): largest gap that is looked for [m]
    cosine: Vector  # (p,): of the angle by which they are inclined to each other

    @staticmethod
    def find(comm: MPI.Intracomm, facets: ExteriorFacets, distance: float | None) -> OppositeFacets:
        """Find the facets opposite to those of this rank, up to a distance. Collective.

        By default it is the shortest edge of the facet. Of several bodies one behind the other the
        nearest counts.
        """
        x, n = facets.corners, facets.number.size
        v, gdim = x.shape[1:]
        reach = edge_lengths(x).min(axis=1) if distance is None else np.full(n, float(distance))
        chosen = [np.arange(n)]
        if comm.size > 1:
            around = np.stack(
                [x.min(axis=1) - reach[:, None], x.max(axis=1) + reach[:, None]], axis=1
            )
            needed = comm.allgather(BoxTree(around).boxes())
            chosen = facets_in_boxes(comm, needed, BoxTree(x))
        number = first_of_rank(comm, n)[0] + np.arange(n)
        columns = (number, facets.body, facets.vertices, x)
        received = all_to_all(comm, [tuple(column[rows] for column in columns) for rows in chosen])
        number, body, vertices, corners = (np.concatenate(c) for c in zip(*received, strict=True))
        nodes, first, inverse = np.unique(vertices, return_index=True, return_inverse=True)
        points = corners.reshape(-1, gdim)[first]
        others = SurfaceFacets(nodes, Facets(points, inverse.reshape(-1, v)), np.zeros_like(points))
        parts, measures = [np.zeros((0, 4), dtype=np.int64)], [np.zeros((0, 4))]
        if n:
            surface = Facets(x.reshape(-1, gdim), np.arange(n * v).reshape(n, v))
            planes, tree = Planes.of(x), MasterTree(others.facets)
            areas = tree.planes.area
            for block in batches(n, 2048):
                rows = np.arange(block.start, block.stop)
                cells = overlapping_cells(surface, planes, rows, tree, reach)
                cells = cells.select_pairs(body[cells.master] != facets.body[cells.slave])
                cells = cells.select_pairs(_is_near(cells, planes, others, body, reach))
                cells = nearest_layers(cells, planes, tree)
                bodies = (facets.body[cells.slave], body[cells.master])
                parts.append(np.column_stack([*bodies, cells.slave, number[cells.master]]))
                ratio = (areas[cells.master] / planes.area[cells.slave]) ** (1.0 / (gdim - 1))
                normals = planes.normal[cells.slave], tree.planes.normal[cells.master]
                cosine = -np.einsum("pd,pd->p", *normals)
                gap = np.abs(cells.centre[1])
                measures.append(np.column_stack([ratio, gap, reach[cells.slave], cosine]))
        return OppositeFacets(np.concatenate(parts), *np.concatenate(measures).T)

    def chosen(self, kept: Mask) -> OppositeFacets:
        """Return some of the pairs."""
        return OppositeFacets(*(column[kept] for column in vars(self).values()))

    def nearest(self, comm: MPI.Intracomm) -> tuple[float, list[int]]:
        """Return the smallest gap of all ranks, and its bodies; infinite without. Collective."""
        bodies = np.sort(self.rows[:, :2], axis=1)
        pairs = zip(self.gap.tolist(), bodies.tolist(), strict=True)
        return min(comm.allgather(min(pairs, default=(np.inf, []))))


def _is_near(
    cells: Cells, planes: Planes, others: SurfaceFacets, body: Numbers, reach: Vector
) -> Mask:
    """Tell which pairs (p,) of facets are within reach and overlap by more than rounding.

    A facet behind one is near only if its body penetrates there.
    """
    middle, gap = cells.centre
    near: Mask = cells.pair_area > SAME_PLACE * planes.area[cells.slave]
    near &= np.abs(gap) <= reach[cells.slave]
    behind = np.flatnonzero(near & (gap < -RELATIVE_ROUNDING * planes.diameter[cells.slave]))
    facet, master = cells.slave[behind], body[cells.master[behind]]
    in_plane = np.einsum("pa,pad->pd", middle[behind], planes.axes[facet, :-1])
    points = planes.origin[facet] + in_plane
    near[behind] = inside(points, master, others.facets, body)
    return near

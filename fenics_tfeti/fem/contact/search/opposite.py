"""Facets on the boundary of bodies: smooth faces, and facets opposite to those of other bodies."""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np

from dolfinx.mesh import Mesh

from fenics_tfeti.fem.contact.surfaces.nearby import facets_in_boxes
from fenics_tfeti.fem.contact.surfaces.oriented import oriented_corners
from fenics_tfeti.fem.contact.surfaces.patches import connected_facets
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.geometry.batches import batches
from fenics_tfeti.fem.geometry.box_tree import BoxTree
from fenics_tfeti.fem.geometry.cells import (
    Cells,
    MasterTree,
    are_nearest,
    nearest_layers,
    overlapping_cells,
)
from fenics_tfeti.fem.geometry.facets import Facets, Planes
from fenics_tfeti.fem.geometry.normals import facet_normals
from fenics_tfeti.fem.geometry.vectors import edge_lengths, unit
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING, SAME_PLACE
from fenics_tfeti.fem.topology import cell_facets, exterior_cell_facets
from fenics_tfeti.parallel import all_to_all, first_of_rank
from fenics_tfeti.typing import Indices, Mask, Numbers, Vector


@dataclass(frozen=True)
class ExteriorFacets:
    """The facets (f,) on the boundary of the mesh that this rank owns, with straight edges."""

    number: Indices  # local numbers of the facets
    body: Numbers
    vertices: Numbers  # (f, v): numbers in the input of the mesh, oriented outwards as in `Facets`
    corners: Vector  # (f, v, gdim) [m]

    @staticmethod
    def of(domain: Mesh, bodies: Bodies) -> ExteriorFacets:
        """Find the facets of this rank's cells that have no neighbour."""
        cell, facet = np.nonzero(exterior_cell_facets(domain))
        nodes = oriented_corners(domain, cell, facet)
        # the numbers in the input are those of all ranks, see `_surface_nodes`
        input_numbers = np.asarray(domain.geometry.input_global_indices, dtype=np.int64)
        return ExteriorFacets(
            cell_facets(domain)[cell, facet],
            bodies.of_cell[cell],
            input_numbers[nodes],
            domain.geometry.x[nodes, : domain.geometry.dim],
        )

    def faces(self, comm: MPI.Intracomm) -> Numbers:
        """Return the number, over all ranks, of the smooth face that each facet is in. Collective.

        A face ends where normals of neighbours turn by more than 60 degrees.
        """
        v, gdim = self.corners.shape[1:]
        ends = self.vertices[..., None]
        if gdim == 3:
            ends = np.sort(np.stack([self.vertices, np.roll(self.vertices, -1, axis=1)], 2), axis=2)
        edges = ends.reshape(self.number.size * v, gdim - 1)
        facet = np.repeat(np.arange(self.number.size), v)
        keys = np.column_stack([edges, self.body[facet]])
        normal = unit(facet_normals(self.corners))[facet]
        return connected_facets(comm, keys, facet, self.number.size, normal)


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
        first_number = first_of_rank(comm, n)[0]
        columns = (first_number + np.arange(n), facets.body, facets.vertices, x, reach)
        received = all_to_all(comm, [tuple(column[rows] for column in columns) for rows in chosen])
        number, body, vertices, corners, reach = map(np.concatenate, zip(*received, strict=True))
        _, first, inverse = np.unique(vertices, return_index=True, return_inverse=True)
        points = corners.reshape(-1, gdim)[first]
        others = Facets(points, inverse.reshape(-1, v))
        parts, measures = [np.zeros((0, 4), dtype=np.int64)], [np.zeros((0, 4))]
        if n:
            tree = MasterTree(others)
            planes, own = tree.planes, np.searchsorted(number, columns[0])
            for block in batches(n, 2048):
                cells = overlapping_cells(others, planes, own[block], tree, reach)
                cells = cells.select_pairs(body[cells.master] != body[cells.slave])
                cells = cells.select_pairs(_is_near(cells, planes, others, body, reach))
                cells = nearest_layers(cells, planes, tree)
                pair = cells.slave, cells.master
                facet, other = (number[side] for side in pair)
                parts.append(
                    np.column_stack([*(body[side] for side in pair), facet - first_number, other])
                )
                area, other_area = (planes.area[side] for side in pair)
                ratio = (other_area / area) ** (1.0 / (gdim - 1))
                cosine = -np.einsum("pd,pd->p", *(planes.normal[side] for side in pair))
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


def _is_near(cells: Cells, planes: Planes, others: Facets, body: Numbers, reach: Vector) -> Mask:
    """Tell which pairs (p,) of facets are within reach and overlap by more than rounding.

    A facet behind one is near only if the body of that has come in through it.
    """
    gap = cells.centre[1]
    near: Mask = cells.pair_area > SAME_PLACE * planes.area[cells.slave]
    near &= np.abs(gap) <= reach[cells.slave]
    behind = np.flatnonzero(near & (gap < -RELATIVE_ROUNDING * planes.diameter[cells.slave]))
    of_pairs = body[cells.master[behind]]
    near[behind] = are_nearest(cells, behind, planes, of_pairs, others, body)
    return near

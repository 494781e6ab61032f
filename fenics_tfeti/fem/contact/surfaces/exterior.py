"""Facets on the boundary of the mesh, and the smooth faces of bodies that they make up."""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np

from dolfinx.mesh import Mesh

from fenics_tfeti.fem.contact.mortar.facets import facet_normals
from fenics_tfeti.fem.contact.surfaces.faceted import unit
from fenics_tfeti.fem.contact.surfaces.oriented import oriented_corners
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.topology import (
    cell_facets,
    connected_labels,
    distinct_rows,
    exterior_cell_facets,
)
from fenics_tfeti.parallel import Directory, concatenate_ranks, first_of_rank
from fenics_tfeti.typing import Indices, Numbers, Vector


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
        keys = np.column_stack([self.body[facet], edges])
        normal = unit(facet_normals(self.corners))[facet]
        part = connected_labels(_smooth_pairs(keys, normal, facet), self.number.size)
        if comm.size == 1:
            return part
        # parts of faces on this rank, numbered over all ranks, then joined through their edges
        first, total = first_of_rank(comm, int(part.max(initial=-1)) + 1)
        directory = Directory(comm, np.unique(edges[:, 0]))
        _, *columns = directory.collect(edges[:, 0], keys, normal, first + part[facet])
        joined = distinct_rows(_smooth_pairs(*columns))[0]
        return connected_labels(concatenate_ranks(comm, joined), total)[first + part]


def _smooth_pairs(keys: Numbers, normal: Vector, label: Numbers) -> Numbers:
    """Return pairs (p, 2) of different labels of facets that meet smoothly at edges (n, k)."""
    least_cosine = 0.5
    order = np.lexsort(keys.T)
    keys, normal, label = keys[order], normal[order], label[order]
    smooth = np.sum(normal[1:] * normal[:-1], axis=1) > least_cosine
    meet = (keys[1:] == keys[:-1]).all(axis=1) & smooth & (label[1:] != label[:-1])
    return np.column_stack([label[:-1][meet], label[1:][meet]])

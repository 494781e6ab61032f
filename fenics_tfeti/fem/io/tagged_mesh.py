"""Meshes with tagged cells and facets: all of one on rank 0, and distributed body by body."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx.mesh import Mesh, meshtags

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.bodies import adjacency, components
from fenics_tfeti.fem.decomposition.partition import SUBDOMAIN_SIZE
from fenics_tfeti.fem.decomposition.rank_shares import share_among_ranks
from fenics_tfeti.fem.geometry.reference_cells import ReferenceCell, reference_cell
from fenics_tfeti.fem.topology import (
    NO_TAG,
    cell_facets,
    distinct_rows,
    with_tag_names,
)
from fenics_tfeti.typing import Array, Mask, Numbers, Vector


class Names(dict[str, int]):
    """Tags by name; a name that is missing is an error with those that there are."""

    def __missing__(self, name: str) -> int:
        raise InputError(f"no body or surface has the name {name!r}; the names are {sorted(self)}")


@dataclass(frozen=True)
class TaggedMesh:
    """A distributed mesh with integer tags.

    Attributes
    ----------
    mesh : dolfinx.mesh.Mesh
        The mesh, with coordinates in the unit of the file; the documentation of this package
        assumes metres.
    cell_tags : dolfinx.mesh.MeshTags
        The tag of each cell, usually the number of its body. They carry the names of the bodies,
        which reports and messages have then.
    facet_tags : dolfinx.mesh.MeshTags
        The tags of facets; those without a tag are left out. They carry the names of the surfaces.
    names : dict of str to int
        Name -> tag of cells or facets; the same on all ranks.

    Examples
    --------
    >>> parts = read_msh("pump.msh", MPI.COMM_WORLD)  # doctest: +SKIP
    >>> parts.facet_tags.find(parts.names["seat"])  # doctest: +SKIP
    """

    mesh: Mesh
    cell_tags: Any
    facet_tags: Any
    names: Names


def sorted_tags(mesh: Mesh, dim: int, entities: Array, values: Array) -> Any:
    """Return mesh tags of entities of this rank that are in any order."""
    order = np.argsort(entities)
    return meshtags(mesh, dim, entities[order].astype(np.int32), values[order].astype(np.int32))


@dataclass(frozen=True)
class WholeMesh:
    """All m cells of a mesh, with nodes in the order of dolfinx, and the tags of their facets."""

    cell: str
    degree: int
    nodes: Numbers  # (m, n)
    x: Vector  # (k, gdim) of the nodes [m]
    cell_tag: Numbers  # (m,)
    facet_tag: Numbers  # (m, f)
    names: dict[str, int]
    body_names: dict[int, str]

    @property
    def kind(self) -> ReferenceCell:
        """The type of the cells."""
        return reference_cell(self.cell)

    def without_cells(self) -> WholeMesh:
        """Return what other ranks have of it."""
        none: dict[str, Any] = {
            k: v[:0] for k, v in vars(self).items() if isinstance(v, np.ndarray)
        }
        return replace(self, **none)


def tags_by_corners(
    cell: str, nodes: Numbers, corners: Numbers, values: Numbers
) -> tuple[Numbers, Mask]:
    """Return tags (m, f) of facets from those of corners (k, t), and which are a facet's."""
    facets = np.sort(nodes[:, np.array(reference_cell(cell).facets)], axis=2)
    marked = np.zeros(nodes.max() + 1, dtype=bool)
    marked[corners[corners >= 0]] = True
    near = marked[facets].all(axis=2)
    number = distinct_rows(np.concatenate([np.sort(corners, axis=1), facets[near]]))[1]
    given, found = np.split(number, [len(corners)])
    tag = np.full(int(number.max(initial=-1)) + 1, NO_TAG, dtype=np.int64)
    tag[given] = values
    facet_tag = np.full(near.shape, NO_TAG, dtype=np.int64)
    facet_tag[near] = tag[found]
    return facet_tag, np.isin(given, found)


def _rank_of_cells(whole: WholeMesh, ranks: int) -> Numbers | None:
    """Return the rank that each cell goes to, body by body; None for one body."""
    nodes, cells = whole.nodes, len(whole.nodes)
    corners = nodes[:, : whole.kind.vertices]
    facets = np.sort(corners[:, np.array(whole.kind.facets)], axis=2)
    number = distinct_rows(facets.reshape(-1, facets.shape[2]))[1]
    graph = adjacency(number.reshape(facets.shape[:2]))
    if components(graph, whole.cell_tag)[0] == 1:
        # which a graph partitioner cuts as well
        return None
    part = cells * SUBDOMAIN_SIZE / whole.x.size
    return share_among_ranks(graph, whole.x[corners].mean(axis=1), whole.cell_tag, ranks, part)


def distribute(comm: MPI.Intracomm, whole: WholeMesh | None) -> TaggedMesh:
    """Distribute a mesh that rank 0 has; it is None on other ranks. Collective."""
    empty = comm.bcast(None if whole is None else whole.without_cells())
    share = empty if whole is None else whole
    ranks = _rank_of_cells(whole, comm.size) if whole is not None and comm.size > 1 else None
    if comm.bcast(ranks is not None) and ranks is None:
        ranks = np.zeros(0, dtype=np.int64)
    mesh = _compat.distributed_mesh(comm, share.nodes, share.x, share.cell, share.degree, ranks)
    dim, cells_of_ranks = mesh.topology.dim, comm.gather(mesh.topology.original_cell_index) or []
    tags = [(share.cell_tag[cells], share.facet_tag[cells]) for cells in cells_of_ranks]
    cell_tag, tags_of_facets = comm.scatter(tags)
    facets = cell_facets(mesh)
    # `locate_dofs_topological` of tagged facets needs it, from dolfinx 0.9 on
    mesh.topology.create_connectivity(dim - 1, dim)
    facet_map = mesh.topology.index_map(dim - 1)
    facet_tag = np.full(facet_map.size_local + facet_map.num_ghosts, NO_TAG, dtype=np.int64)
    facet_tag[facets] = tags_of_facets
    cell_tags, facet_tags = (
        sorted_tags(mesh, d, tagged := np.flatnonzero(tag != NO_TAG), tag[tagged])
        for d, tag in ((dim, cell_tag), (dim - 1, facet_tag))
    )
    bodies = set(share.body_names.values())
    surfaces = {tag: name for name, tag in share.names.items() if name not in bodies}
    return TaggedMesh(
        mesh,
        with_tag_names(cell_tags, share.body_names),
        with_tag_names(facet_tags, surfaces),
        Names(share.names),
    )

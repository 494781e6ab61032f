"""Pairs of surfaces that a single rank matches, each pair another one.

Of many pairs, each is small: one rank gets both surfaces, matches them without communication, and
sends the conditions to the ranks that own the slave's nodes. All pairs have their data in one
message to each rank. A pair that is larger than a rank's share of all facets is left to all ranks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from mpi4py import MPI

import numpy as np

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.contact import ContactPairing, Terms
from fenics_tfeti.fem.contact.description import ContactPair
from fenics_tfeti.fem.contact.surfaces.oriented import oriented_facets, owned_facets
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, Surface, surface_of
from fenics_tfeti.fem.nodes import LocalNodes
from fenics_tfeti.feti.system import Prescribed
from fenics_tfeti.parallel import all_to_all, raise_collectively
from fenics_tfeti.typing import Indices, Mask, Numbers, Vector

Pairs = Mapping[int, tuple[str, ContactPair]]  # names and pairs by place among all contacts
# finds the conditions of a pair with slave, master, and the components prescribed on the slave
Match = Callable[[str, ContactPair, Surface, Surface, Mask], ContactPairing]


@dataclass(frozen=True)
class _Part:
    """A rank's facets of the surfaces of a pair, slave first."""

    nodes: Numbers  # (n,): global nodes, ascending
    x: Vector  # (n, 3): their places [m]
    prescribed: Mask  # (n, gdim): prescribed components
    facets: list[Indices]  # of either surface (f, t), as rows of `nodes`

    @staticmethod
    def joined(parts: Sequence[_Part]) -> _Part:
        """Join parts of several ranks, in order."""
        nodes, first = np.unique(np.concatenate([p.nodes for p in parts]), return_index=True)
        x, prescribed = (
            np.concatenate(columns)[first]
            for columns in zip(*((p.x, p.prescribed) for p in parts), strict=True)
        )
        facets = [
            np.searchsorted(nodes, np.concatenate([p.nodes[p.facets[k]] for p in parts]))
            for k in range(2)
        ]
        return _Part(nodes, x, prescribed, facets)


@dataclass(frozen=True)
class _Found:
    """The part of the conditions of a pair that a rank gets: arrays as in `ContactPairing`."""

    terms: Terms  # of global nodes
    of_conditions: list[Vector]  # normals, gaps, areas, coverage
    surfaces: list[list[Any]]  # of either surface global nodes, normals, areas, sizes, extent
    covered: Mask
    prescribed: Mask | None
    summary: dict[str, Any]

    def pairing(
        self, boundary: MeshBoundary, name: str, facets: Sequence[Indices]
    ) -> ContactPairing:
        """Return the rank's part of the conditions, given its facets of either surface."""
        slave, master = (
            Surface(boundary, nodes, normal, area, size, facet_nodes, extent)
            for (nodes, normal, area, size, extent), facet_nodes in zip(
                self.surfaces, facets, strict=True
            )
        )
        normal, gap, area, coverage = self.of_conditions
        return ContactPairing(
            self.terms,
            normal,
            gap,
            area,
            name,
            self.summary,
            slave,
            self.covered,
            coverage,
            self.prescribed,
            master,
        )


def match_on_single_ranks(
    boundary: MeshBoundary, pairs: Pairs, prescribed: Prescribed, match: Match
) -> dict[int, ContactPairing]:
    """Match pairs that are small enough, by place; others are not there. Collective.

    The error of the first pair that has one is raised on all ranks.
    """
    comm, nodes = boundary.nodes.comm, boundary.nodes
    if not pairs:
        return {}
    facets = {k: _facets_of(boundary, pair) for k, (_, pair) in pairs.items()}
    home_of = _homes(boundary, facets)
    held = np.zeros((nodes.owned, nodes.components), dtype=bool)
    local = prescribed.nodes - nodes.first
    owned = (local >= 0) & (local < nodes.owned)
    held[local[owned], prescribed.components[owned]] = True
    facet_nodes = {k: [oriented_facets(boundary.space, f) for f in facets[k]] for k in home_of}
    parts = _parts(boundary, facet_nodes, held)
    arrived = all_to_all(
        comm, [{k: part for k, part in parts.items() if home_of[k] == r} for r in range(comm.size)]
    )
    answers: list[dict[int, _Found]] = [{} for _ in range(comm.size)]
    errors, others = dict[int, Exception](), dict[int, _Found]()
    for k in (k for k, home in home_of.items() if home == comm.rank):
        of_ranks = [rank for rank in range(comm.size) if k in arrived[rank]]
        try:
            sent = [arrived[rank][k] for rank in of_ranks]
            found, whole = _matched(boundary, *pairs[k], sent, match)
        except Exception as error:
            errors[k] = error
            continue
        facet_ranks = np.repeat(of_ranks, [len(part.facets[0]) for part in sent])
        owner = nodes.owners(whole.nodes)
        for rank in {*of_ranks, *owner.tolist()}:
            answers[rank][k] = _share(found, whole, owner == rank, facet_ranks == rank)
        others[k] = _share(found, whole, owner < 0, facet_ranks < 0)
    first = comm.allreduce(min(errors, default=np.inf), MPI.MIN)
    with raise_collectively(comm):
        if first in errors:
            raise errors[first]
    own = {k: found for part in all_to_all(comm, answers) for k, found in part.items()}
    if comm.size > 1:
        own = {k: found for part in comm.allgather(others) for k, found in part.items()} | own
    return {k: own[k].pairing(boundary, pairs[k][0], facet_nodes[k]) for k in home_of}


def _facets_of(boundary: MeshBoundary, pair: ContactPair) -> list[Indices]:
    """Return this rank's facets of slave and master; none where the tags are not of the mesh."""
    domain, tags = boundary.space.mesh, pair.facet_tags
    if not _compat.tags_are_on(tags, domain) or tags.dim != domain.topology.dim - 1:
        return [np.zeros(0, dtype=np.int32)] * 2
    return [owned_facets(domain, tags, tag) for tag in (pair.slave, pair.master)]


def _homes(boundary: MeshBoundary, facets: Mapping[int, Sequence[Indices]]) -> dict[int, int]:
    """Return the rank that matches each pair, by place; others are not there. Collective.

    Left out are pairs of many facets, and those with a surface without facets, or with facets
    inside the mesh: what is wrong with them is found out by all ranks.
    """
    comm = boundary.nodes.comm
    counts = np.zeros((len(facets), 3, comm.size), dtype=np.int64)
    for row, parts in enumerate(facets.values()):
        inside = sum(int((~boundary.exterior[part]).sum()) for part in parts)
        counts[row, :, comm.rank] = [*map(len, parts), inside]
    comm.Allreduce(MPI.IN_PLACE, counts)
    of_ranks = counts[:, :2].sum(axis=1)
    size, total = of_ranks.sum(axis=1), counts.sum(axis=2)
    single = (total[:, :2] > 0).all(axis=1) & (total[:, 2] == 0)
    single &= size * comm.size <= size.sum()
    load, homes, places = np.zeros(comm.size, dtype=np.int64), dict[int, int](), [*facets]
    for row in np.argsort(-size, kind="stable").tolist():
        if single[row]:
            # equal loads, where the rank has most of the facets itself
            home = int(np.argmin(load - of_ranks[row]))
            load[home] += size[row]
            homes[places[row]] = home
    return dict(sorted(homes.items()))


def _parts(
    boundary: MeshBoundary, facet_nodes: Mapping[int, Sequence[Indices]], held: Mask
) -> dict[int, _Part]:
    """Return this rank's part of each pair that it has facets of. Collective.

    `held` (owned, gdim) are the prescribed components of the nodes that it owns.
    """
    nodes, parts = boundary.nodes, dict[int, _Part]()
    every = [
        np.zeros(0, dtype=np.int32),
        *(f.ravel() for both in facet_nodes.values() for f in both),
    ]
    local = np.unique(np.concatenate(every))
    numbers = nodes.to_global(local)
    at_nodes = np.zeros((nodes.size, nodes.components), dtype=bool)
    at_nodes[local] = nodes.values_at(held, numbers)
    number_of = np.zeros(nodes.size, dtype=np.int64)
    number_of[local] = numbers
    for k, (slave, master) in facet_nodes.items():
        if not len(slave) + len(master):
            continue
        distinct, inverse = np.unique(
            np.concatenate([slave.ravel(), master.ravel()]), return_inverse=True
        )
        order = np.argsort(number_of[distinct])
        row_of = np.argsort(order)[inverse]
        rows = np.split(row_of.reshape(-1, slave.shape[1]), [len(slave)])
        distinct = distinct[order]
        x = boundary.coordinates[distinct]
        parts[k] = _Part(number_of[distinct], x, at_nodes[distinct], rows)
    return parts


def _matched(
    boundary: MeshBoundary, name: str, pair: ContactPair, parts: Sequence[_Part], match: Match
) -> tuple[ContactPairing, _Part]:
    """Match a pair, whose nodes are numbered by rows of the joined parts."""
    whole = parts[0] if len(parts) == 1 else _Part.joined(parts)
    alone = replace(
        boundary, nodes=LocalNodes(boundary.nodes, whole.nodes.size), coordinates=whole.x
    )
    slave, master = (
        surface_of(alone, facets, f"{role} of {name}")
        for facets, role in zip(whole.facets, ("slave", "master"), strict=True)
    )
    return match(name, pair, slave, master, whole.prescribed[slave.nodes]), whole


def _share(found: ContactPairing, whole: _Part, owned: Mask, own_facets: Mask) -> _Found:
    """Return what a rank gets that owns some of the nodes and of the slave's facets."""
    terms, columns = found.terms, (found.normal, found.gap, found.area, found.coverage)
    rows = np.flatnonzero(owned[terms.slave])
    terms = terms.of_rows(rows)
    surfaces = []
    for surface in (found.surface, found.master_surface):
        assert surface is not None
        at = owned[surface.nodes]
        arrays = (surface.normal, surface.area, surface.size)
        nodes = whole.nodes[surface.nodes[at]]
        surfaces.append([nodes, *(array[at] for array in arrays), surface.extent])
    prescribed = found.prescribed
    return _Found(
        replace(terms, nodes=whole.nodes[terms.nodes]),
        [column[rows] for column in columns if column is not None],
        surfaces,
        found.covered[own_facets],
        None if prescribed is None else prescribed[owned[found.surface.nodes]],
        found.summary,
    )

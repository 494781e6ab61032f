"""Pairs are those of one process, on any number of ranks."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from scenes import GROUND, MASTER, SLAVE

from fenics_tfeti import Along, ContactPair, Mapped, Points, RigidObstacle, Sphere
from fenics_tfeti.fem.contact.matching import match_contact
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.parallel import concatenate_ranks

comm = MPI.COMM_WORLD
X = np.array([[x, y, 1.1] for x in (1.0, 1.25, 1.5, 1.75, 2.0) for y in (0, 0.25, 0.5, 0.75, 1)])
UP = np.array([0.0, 0.0, 1.0])

ARGUMENTS = {
    "nearest": {},
    "direction": {"partners": Along(UP)},
    "direction at points": {"partners": Along(lambda x: np.tile(UP[:, None], x.shape[1]))},
    "mapping": {"partners": Mapped(lambda x: x - 0.1 * UP[:, None])},
    "points": {"partners": Points(X[::-1], X[::-1] - 0.1 * UP)},
    "partial": {"partners": Points(X[::2], X[::2] - 0.1 * UP), "partial": True},
    "normal": {"normal": lambda x: np.array([0 * x[0], 0.1 * x[1], -x[0]])},
    "moved": {"partners": Mapped(lambda x: x - 0.1 * UP[:, None] + 0.01 * np.sin(9 * x))},
}


def gathered(on, arguments):
    """Match; return the pairs by the slave's coordinates, and the entry of the pairing table."""
    scene = scenes.two_beams(on, "hexahedron", 4, gap=0.1)
    pairing = match_contact(
        MeshBoundary.of(scene.V), ContactPair(scene.facet_tags, SLAVE, MASTER, **arguments), 0
    )
    points = scene.V.tabulate_dof_coordinates()
    own = scene.V.dofmap.index_map.size_local
    node = concatenate_ranks(
        on, scene.V.dofmap.index_map.local_to_global(np.arange(own, dtype="i"))
    )
    place = np.empty((node.size, 3))
    place[node] = concatenate_ranks(on, points[:own])
    columns = [pairing.coordinates, pairing.normal, pairing.gap, pairing.area]
    columns = [concatenate_ranks(on, column) for column in columns]
    columns.append(place[concatenate_ranks(on, pairing.master)])
    order = np.lexsort(np.round(columns[0], 9).T)
    return [column[order] for column in columns], pairing.summary


def rounded(entry):
    return {
        key: float(f"{value:.9g}") if isinstance(value, float) else value
        for key, value in entry.items()
    }


@pytest.mark.parametrize("way", ARGUMENTS)
def test_pairs_do_not_depend_on_the_ranks(way):
    ours, entry = gathered(comm, ARGUMENTS[way])
    alone, entry_alone = gathered(MPI.COMM_SELF, ARGUMENTS[way])
    assert len(ours[0]) == (13 if way == "partial" else 25)
    for a, b in zip(ours, alone, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-13)
    assert rounded(entry) == rounded(entry_alone)


@pytest.mark.parametrize("way", ARGUMENTS)
def test_pairing_is_the_same_on_all_ranks(way):
    entry = gathered(comm, ARGUMENTS[way])[1]
    assert all(other == entry for other in comm.allgather(entry))


def test_pairing_of_an_obstacle():
    def entry(on):
        scene = scenes.block_on_ball(on, "tetrahedron", 3)
        ball = Sphere((0.4, 0.5, -10.0), 10.0)
        return match_contact(
            MeshBoundary.of(scene.V), RigidObstacle(scene.facet_tags, GROUND, ball), 0
        ).summary

    assert rounded(entry(comm)) == rounded(entry(MPI.COMM_SELF))


def test_points_that_differ_between_ranks_are_refused():
    scene = scenes.two_beams(comm, "hexahedron", 4, gap=0.1)
    points = Points(X, X - 0.1 * UP - 1e-9 * comm.rank)
    pair = ContactPair(scene.facet_tags, SLAVE, MASTER, partners=points)
    if comm.size == 1:
        assert match_contact(MeshBoundary.of(scene.V), pair, 0).summary["pairs"] == 25
        return
    with pytest.raises(ValueError, match="points differ between ranks"):
        match_contact(MeshBoundary.of(scene.V), pair, 0)

"""The deformed contact on any number of ranks is that of one."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from moved_blocks import CELLS, blocks, lifted, shifted
from scenes import Ball, dimension

from dolfinx import fem

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.deformed import deformed_contact
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary

COMM = MPI.COMM_WORLD
every_cell = pytest.mark.parametrize("cell", CELLS)


def motions(gdim):
    """Bend both blocks, slide the upper one between the nodes and into the lower one."""
    slide = np.zeros(gdim)
    slide[0], slide[-1] = 0.37, -0.2

    def height(x, *y):
        return 0.2 * np.sin(2.0 * x) + (0.1 * x * y[0] if y else 0.0)

    bend, move = lifted(height), shifted(*slide)
    return bend, lambda x: move(bend(x))


def deformed(cell, comm, kind):
    """Return places and results at the slave nodes of this rank."""
    scene = blocks(cell, n=4, comm=comm)
    gdim = dimension(cell)
    ball = Ball((1.4, 0.4, -2.0) if gdim == 3 else (1.4, -2.0, 0.0), 2.1)
    contact = {
        "pair": scene.pair,
        "obstacle": scene.obstacle(ball),
        "gap alone": scene.obstacle(lambda x: x[gdim - 1] + 0.1),
    }[kind]
    known = scene.obstacle(ball) if kind == "gap alone" else contact
    pairing, uh = scene.pairing(known), scene.displacement(*motions(gdim))
    return pairing.coordinates, deformed_contact(MeshBoundary.of(scene.space), contact, pairing, uh)


@every_cell
@pytest.mark.parametrize("kind", ["pair", "obstacle", "gap alone"])
def test_result_is_that_of_one_rank(cell, kind):
    places, found = deformed(cell, COMM, kind)
    every_place, expected = deformed(cell, MPI.COMM_SELF, kind)
    row = {tuple(place): k for k, place in enumerate(np.round(every_place, 9) + 0.0)}
    rows = [row[tuple(place)] for place in np.round(places, 9) + 0.0]
    assert COMM.allreduce(len(rows)) == len(every_place)
    for name in ("normal", "gap", "penetration"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name)[rows], atol=1e-13, err_msg=name
        )
    assert expected.penetration.max() > 0.01


def test_ghosts_of_the_displacement_are_brought_up_to_date():
    scene = blocks("triangle", comm=COMM)
    pairing, uh = scene.pairing(scene.pair), scene.displacement()
    result = deformed_contact(MeshBoundary.of(scene.space), scene.pair, pairing, uh)
    assert np.isfinite(uh.x.array).all()
    np.testing.assert_allclose(result.gap, 0.1, atol=1e-14)


def test_error_of_one_rank_is_raised_on_all():
    scene = blocks("triangle", comm=COMM)
    pairing, uh = scene.pairing(scene.pair), fem.Function(scene.space)
    if COMM.rank == COMM.size - 1:
        uh.x.array[0] = np.nan
    with pytest.raises(InputError, match="NaN"):
        deformed_contact(MeshBoundary.of(scene.space), scene.pair, pairing, uh)

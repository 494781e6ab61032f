"""Derivatives on several ranks: as on one."""

from functools import partial

from mpi4py import MPI

import numpy as np
import pytest
from sensitivity_scenes import (
    EXACT,
    RTOL,
    block_on_roller,
    blocks,
    mesh_direction,
    of_constant,
    of_contact,
    of_function,
    of_mesh,
    of_motion,
    of_tie,
    periodic_block,
    tied_stack,
)

from fenics_tfeti import BoltPreload, Coulomb, RigidBody, Tresca
from fenics_tfeti.fem.displacement import owned_values

COMM = MPI.COMM_WORLD
KINDS = {
    "mortar": partial(blocks, n=4, m=5),
    "Coulomb": partial(blocks, n=4, m=5, friction=Coulomb(0.2)),
    "3D, Tresca": partial(blocks, "hexahedron", 2, 2, friction=Tresca(1.5e-3)),
    "tied": tied_stack,
    "exact gaps, Coulomb": partial(blocks, n=4, m=5, friction=Coulomb(0.2), gaps=EXACT),
    "body": partial(
        block_on_roller,
        body=RigidBody((0.45, -2.0), force=(0.0, 0.02), rotation=0.0, spring=(0.05, 0.05, 1.0)),
    ),
}


def derivatives(scene, kind):
    """Return derivatives by all data along directions that ranks share, and tangents' values."""
    scene.solve()
    parameters = [
        of_function(scene.E, 1e-3),
        of_function(scene.body_force, 1e-4),
        of_constant(scene.traction, 1e-4),
        of_function(scene.clamp, 1e-5),
        of_mesh(scene, 1e-4),
    ]
    if "Coulomb" in kind:
        parameters.append(of_contact(scene, "coefficient", 1e-3))
    if "Tresca" in kind:
        parameters.append(of_contact(scene, "bound", 1e-5))
    scene.solve()
    adjoint = scene.adjoint()
    by_nodes = 0.0
    if kind in ("mortar", "tied"):
        gradient, along = owned_values(adjoint.by_mesh()), owned_values(mesh_direction(scene))
        by_nodes = scene.scene.mesh.comm.allreduce(float(gradient @ along))
    slopes = [parameter.slope(adjoint) for parameter in parameters]
    tangents = [
        scene.change(scene.problem.tangent(**parameter.tangent, rtol=RTOL))
        for parameter in parameters
        if parameter.tangent is not None
    ]
    loads = adjoint.by_load(0).tolist() if kind == "body" else []
    return np.array([by_nodes, *slopes, *tangents, *loads])


ON_THREE = ("mortar", "3D, Tresca", "shortening")


def on_ranks(kinds):
    """Return cases for `parametrize`, each on two ranks or on three."""
    return [pytest.param(k, marks=pytest.mark.ranks(2 + (k in ON_THREE))) for k in kinds]


@pytest.mark.parametrize("kind", on_ranks(KINDS))
def test_as_on_one_rank(kind):
    dealt, alone = (derivatives(KINDS[kind](comm=comm), kind) for comm in (COMM, MPI.COMM_SELF))
    assert dealt == pytest.approx(alone, rel=1e-8, abs=1e-9 * np.abs(alone).max())


BODY = RigidBody((0.45, -2.0), translation=(1e-3, 2e-3), rotation=1e-3, spring=(0.1, 0.1, 0.0))
OTHERS = {
    "force of a bolt": (partial(tied_stack, kind=BoltPreload, upper=5, force=-3e-3), of_tie),
    "shortening": (partial(tied_stack, kind=BoltPreload, upper=5, shortening=2e-3), of_tie),
    "periodic pair": (periodic_block, of_tie),
    "motion": (partial(block_on_roller, Coulomb(0.3), body=BODY), of_motion),
}


@pytest.mark.parametrize("kind", on_ranks(OTHERS))
def test_ties_and_bodies_as_on_one_rank(kind):
    make, parameter = OTHERS[kind]
    slopes = []
    for comm in (COMM, MPI.COMM_SELF):
        scene = make(comm=comm)
        scene.solve()
        slopes.append(parameter(scene, 1e-4).slope(scene.adjoint()))
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-8)

"""Which rigid motions are resisted, and whether the load works on them: one measure for both."""

from __future__ import annotations

import numpy as np
import pytest
from pairwise import pairwise
from torn import cube, node_rows

from fenics_tfeti import UnresistedMotion
from fenics_tfeti.feti import ContactRows, Options, Prescribed, TornSolver, TornSystem
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.dual_layout import seeded_vector
from fenics_tfeti.feti.constraints.face import Face

pytestmark = pytest.mark.once


def block(load, normals_of, n: int = 2, size: float = 1.0, force: float = 1.0) -> TornSystem:
    """Return a loose cube with rigid obstacles: `normals_of` gives the normals at a point."""
    body = cube(n, load=load)
    nodes, normals = [], []
    for node, x in zip(body.nodes, body.coordinates, strict=True):
        for normal in normals_of(x):
            nodes.append(node)
            normals.append(normal)
    k = len(nodes)
    unit = np.array(normals, float)
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    none = np.zeros(k, dtype=int)
    rows = ContactRows.node_to_node(nodes, none - 1, unit, np.zeros(k), none)
    body = type(body)(
        body.stiffness * (force / size), body.load * force, body.coordinates * size, body.nodes, 0
    )
    return TornSystem([body], Prescribed(), rows, 3, ["block"])


def ground(x):
    return [(0, 0, -1)] if x[2] == 0 else []


NOT_TURNED = np.eye(3)


def valley(tilt: float, turn=NOT_TURNED):
    """Return the normals of ground that slopes by `tilt` to one side or the other, all turned."""

    def normals(x):
        corner = np.count_nonzero(x[:2] == 0.5) == 0
        return [turn @ (tilt if corner else -tilt, 0, -1)] if x[2] == 0 else []

    return normals


def test_a_coefficient_that_is_rounding_bears_no_load():
    """The side walls cannot hold the block down by 3e-18 of their force."""

    def walls(x):
        left = [(-1, 0, 3e-18)] if x[0] == 0 else []
        right = [(1, 0, 3e-18)] if x[0] == 1 else []
        return ground(x) + left + right

    with pytest.raises(UnresistedMotion, match=r"block: translation along \(0, 0, 1\)"):
        TornSolver(block((0, 0, 1.0), walls))


@pytest.mark.parametrize(
    ("size", "tilt", "method"),
    pairwise([1e-6, 1.0, 1e3], [1e-3, 1e-5, 1e-7], ["active_set", "smalbe"]),
)
def test_a_flat_valley_bears_the_load(tilt, method, size):
    """The load leans by a tenth of the slopes."""
    system = block((0.1 * tilt, 0, -1.0), valley(tilt), size=size, force=size**2)
    solution = TornSolver(system, Options(rtol=1e-6, method=method)).solve()
    force = solution.normal_force[:, None] * system.contacts.normal
    np.testing.assert_allclose(force.sum(axis=0)[2], -(size**2), rtol=1e-5)
    np.testing.assert_allclose(force.sum(axis=0)[0], 0.1 * tilt * size**2, rtol=1e-2)


@pytest.mark.parametrize("n", [1, 2, 6])
@pytest.mark.parametrize("lean", [1e-6, 1e-3])
def test_a_plane_bears_no_load_that_leans(n, lean):
    with pytest.raises(UnresistedMotion, match=r"block: translation along \(1, 0, 0\)"):
        TornSolver(block((lean, 0, -1.0), ground, n))


def test_a_small_load_beside_a_large_one_is_noticed():
    """The light cube slides although its load is rounding beside that of the other."""
    heavy = block((0, 0, -1e12), ground)
    light = cube(2, (5, 0, 0), body=1, first=10**9, load=(1.0, 0, -1.0))
    rows = node_rows(light.nodes[light.coordinates[:, 2] == 0], [0.0, 0.0, -1.0])
    rows = ContactRows.concatenate([heavy.contacts, rows])
    parts = [*heavy.subdomains, light]
    with pytest.raises(UnresistedMotion, match=r"light: translation along \(1, 0, 0\)"):
        TornSolver(TornSystem(parts, Prescribed(), rows, 3, ["heavy", "light"]))


@pytest.mark.parametrize("tilt", [1e-1, 1e-3, 1e-6])
def test_motions_that_tilted_normals_resist_are_listed(tilt):
    """A block in a valley; across it the tilts of nine nodes resist it, along it nothing."""
    report = TornSolver(block((0, 0, -1.0), valley(tilt))).solve().report
    assert "block: translation along (0, 1, 0)" in report.free_motions
    if tilt > 1e-2:
        assert report.weak_motions == []
        return
    rotation, translation = report.weak_motions
    assert rotation.startswith("block: rotation about the axis (")
    assert translation.startswith("block: translation along (1, 0, ")
    assert translation.endswith(
        f"; resisted by tilted normals only, which close 'contact 0' by {3 * tilt:.0e} of it"
    )


@pytest.mark.parametrize("tilt", [1e-1, 1e-3, 1e-4, 4e-5, 1e-6])
def test_the_projector_is_accurate_however_weak_the_resistance(tilt):
    """GG' squares it: of 3e-4 a single application of P leaves 1e-9, in forces that do not fade."""
    turn = np.linalg.qr(np.array([[2.0, 1.0, 0.3], [-0.4, 1.5, 1.0], [0.2, -1.0, 2.0]]))[0]
    system = block(turn @ (0, 0, -1.0), valley(tilt, turn))
    coarse_space = TornSolver(system).setup.projector.coarse_space
    projector = Projector.build(coarse_space, Face.whole(coarse_space.constraints))
    # the vector whose error decides on the number of applications
    x = seeded_vector(np.arange(9))
    assert np.linalg.norm(projector.Q(projector.P(x))) < 1e-11 * np.linalg.norm(x)

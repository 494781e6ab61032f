"""Surfaces that stay together: two blocks meshed apart are one."""

from dataclasses import replace

import numpy as np
import pytest
from mortar_blocks import LOADED, LOWER, PRESSURE, SUPPORTED, UPPER, Blocks
from scenes import POISSON, YOUNG, fixed, plane

from dolfinx import fem

from fenics_tfeti import InputError, TiedPair

CELLS = ["triangle", "quadrilateral", "tetrahedron", "hexahedron"]


def blocks(cell, **arguments):
    sizes = {"lower": 5, "upper": 7} if cell in CELLS[:2] else {"lower": 3, "upper": 4}
    return Blocks(cell, **{**sizes, **arguments}).scene()


def solved(scene, slave=LOWER, tied=None):
    """Solve with a tie beside the contacts of a scene."""
    tied = TiedPair(scene.facet_tags, slave, LOWER + UPPER - slave) if tied is None else tied
    problem = scene.problem(
        contacts=[*scene.contacts, tied],
        cell_tags=None,
        options={"rtol": 1e-12, "subdomain_size": 150},
    )
    return problem, problem.solve()


def relative_error(V, uh, exact):
    gdim = V.mesh.geometry.dim
    x = V.tabulate_dof_coordinates()[:, :gdim]
    expected = exact(x)
    return np.abs(uh.x.array.reshape(-1, gdim) - expected).max() / np.abs(expected).max()


@pytest.mark.parametrize("slave", [LOWER, UPPER])
@pytest.mark.parametrize("cell", CELLS)
def test_any_linear_displacement(cell, slave):
    """Prescribed on all faces but the tied ones, whose rims are prescribed: shear and rotation."""
    scene = blocks(cell, jitter=0.05)
    V, d = scene.V, scene.gdim
    gradient = 1e-3 * np.arange(1.0, d * d + 1.0).reshape(d, d) * (-1.0) ** np.arange(d)

    def exact(x):
        return x @ gradient.T

    function = fem.Function(V)
    function.interpolate(lambda x: exact(x[:d].T).T)
    sides = fem.locate_dofs_geometrical(
        V, lambda x: np.any(np.isclose(x[:d], 0.0) | np.isclose(x[:d], 1.0), axis=0)
    )
    x = V.tabulate_dof_coordinates()
    # not the inside of the tied faces
    rim = np.any(np.isclose(x[:, : d - 1], 0.0) | np.isclose(x[:, : d - 1], 1.0), axis=1)
    ends = np.isclose(x[:, d - 1], 0.0) | np.isclose(x[:, d - 1], 2.0)
    dofs = np.union1d(sides[rim[sides]], np.flatnonzero(ends)).astype(np.int32)
    scene.bcs = [fem.dirichletbc(function, dofs)]
    problem, uh = solved(scene, slave)
    assert relative_error(V, uh, exact) < 1e-10
    assert problem.report.contacts[0].pairing["discretisation"] == "tied"


@pytest.mark.parametrize("cell", CELLS)
def test_tension(cell):
    """Tied surfaces pull; the sums of forces on both are equal."""
    scene = blocks(cell)
    V, d = scene.V, scene.gdim
    scene.add_load(LOADED, PRESSURE)
    for axis in range(d):
        scene.fix(SUPPORTED[axis], axis)
    problem, uh = solved(scene)
    nu, unit = POISSON, PRESSURE / YOUNG
    along = [-nu, -nu, 1.0] if d == 3 else [-nu * (1 + nu), 1 - nu**2]
    assert relative_error(V, uh, lambda x: unit * np.array(along) * x) < 1e-10
    (force,) = [c.force for c in problem.report.contacts]
    np.testing.assert_allclose(force, [*[0.0] * (d - 1), PRESSURE], atol=1e-8 * PRESSURE)
    (tie,) = problem.results
    np.testing.assert_allclose(tie.force, force, rtol=0.0, atol=0.0)
    np.testing.assert_allclose(tie.nodal_force.sum(axis=0), force, atol=1e-8 * PRESSURE)
    assert tie.area.sum() == pytest.approx(1.0)
    traction = np.broadcast_to(force, tie.traction.shape)
    np.testing.assert_allclose(tie.traction, traction, atol=1e-7 * PRESSURE)
    assert tie.gather().nodes.tolist() == tie.nodes.tolist()
    # nodes on planes of symmetry have conditions in the other components
    assert problem.report.contacts[0].pairing["unmatched"] == 0


def test_tied_block_with_a_floor():
    """Ties and contacts in one problem, solved again under another load."""
    scene = blocks("quadrilateral")
    push = scene.add_load(LOADED, -PRESSURE)
    scene.add_obstacle(SUPPORTED[1], plane(1, 2))
    scene.fix(SUPPORTED[0], 0)
    problem, _ = solved(scene)
    assert problem.results[0].normal_force.sum() == pytest.approx(PRESSURE)
    push.value = -2.0 * PRESSURE
    problem.solve()
    assert problem.results[0].normal_force.sum() == pytest.approx(2.0 * PRESSURE)
    assert [entry["discretisation"] for entry in [c.pairing for c in problem.report.contacts]] == [
        "obstacle",
        "tied",
    ]


def test_moved_mesh_and_other_supports():
    scene = blocks("triangle")
    scene.add_load(LOADED, PRESSURE)
    for axis in range(2):
        scene.fix(SUPPORTED[axis], axis)
    problem, _ = solved(scene)
    first = problem.system.tied
    scene.mesh.geometry.x[:, 0] *= 2.0
    problem.solve()
    np.testing.assert_allclose(problem.system.tied.length, 2.0 * first.length)
    problem.bcs = [fixed(scene.V, scene.facet_tags, SUPPORTED[1])]
    problem.solve()
    # the node at x = 0 is not held any more, and has a condition in x as well
    assert problem.system.tied.size == first.size + 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": "joint", "master": LOADED}, "joint: no facet .* opposite|joint: the surfaces"),
        ({"slave": SUPPORTED[0]}, "tied pair 0: slave and master share"),
    ],
)
def test_mistakes(change, message):
    scene = blocks("triangle")
    scene.fix(SUPPORTED[1])
    with pytest.raises(InputError, match=message):
        solved(scene, tied=replace(TiedPair(scene.facet_tags, LOWER, UPPER), **change))


def test_surfaces_that_are_apart():
    scene = blocks("triangle")
    x, upper = scene.mesh.geometry.x, scene.nodes(2)
    x[upper[np.isclose(x[upper, 1], 1.0)], 1] += 0.2
    scene.fix(SUPPORTED[1])
    with pytest.raises(InputError, match=r"tied pair 0: the surfaces are apart.* 8 slave nodes"):
        solved(scene, slave=UPPER)


def test_what_is_no_tied_pair():
    with pytest.raises(InputError, match=r"contact 0 is a str; .* TiedPair, .* is expected"):
        solved(blocks("triangle"), tied="upper")

"""Surfaces that stay together: two blocks meshed apart are one."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from mortar_blocks import LOADED, LOWER, PRESSURE, SUPPORTED, UPPER, Blocks
from moved_blocks import turned
from scenes import POISSON, YOUNG, fixed, plane

import ufl
from dolfinx import fem

from fenics_tfeti import InputError, TiedPair
from fenics_tfeti.fem.contact.conditions.contact_conditions import row_values

COMM = MPI.COMM_WORLD

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
    assert problem.report.contacts[0].matching["discretisation"] == "tied"


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
    assert problem.report.contacts[0].matching["unmatched"] == 0


def test_tied_block_with_a_floor():
    """Ties and contacts in one problem, solved again under another load."""
    scene = blocks("quadrilateral")
    push = scene.add_load(LOADED, -PRESSURE)
    scene.add_obstacle(SUPPORTED[1], plane(1, 2))
    scene.fix(SUPPORTED[0], 0)
    problem, _ = solved(scene)
    assert problem.results[0].nodal_normal_force.sum() == pytest.approx(PRESSURE)
    push.value = -2.0 * PRESSURE
    problem.solve()
    assert problem.results[0].nodal_normal_force.sum() == pytest.approx(2.0 * PRESSURE)
    assert [entry["discretisation"] for entry in [c.matching for c in problem.report.contacts]] == [
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


# -- surfaces with gaps ----------------------------------------------------------------------------


def bent(cell, degree, gap=0.0):
    """Return blocks that are tied along a wave: coarse facets do not lie on fine ones."""
    scene = Blocks(cell, 3, 5, degree=degree).scene(COMM)
    x, up = scene.mesh.geometry.x, scene.gdim - 1
    x[scene.nodes(2), up] += gap
    x[:, up] += 0.1 * np.sin(3.0 * x[:, 0]) + 0.05 * np.cos(2.0 * x[:, 1 - up // 2])
    scene.contacts = [TiedPair(scene.facet_tags, UPPER, LOWER)]
    return scene


@pytest.mark.ranks(1, 2, 3)
@pytest.mark.parametrize(("cell", "degree"), [*((cell, 1) for cell in CELLS), ("tetrahedron", 2)])
def test_gaps_leave_rigid_motions_free(cell, degree):
    """Small rotations of the linear problem, and any with finite strains."""
    scene = bent(cell, degree, gap=0.02)
    V, d = scene.V, scene.gdim
    found = scene.problem(cell_tags=None)._torn.undeformed
    nodes = found.boundary.nodes
    rows, x = found.tied_rows(), nodes.coordinates
    skew = np.arange(d * d, dtype=float).reshape(d, d)
    spin = x @ (skew - skew.T)
    # at vertices 5 along a line, of the coarse block 3
    assert COMM.allreduce(rows.size) == d * 6 ** (d - 1)
    assert np.abs(rows.gap).max(initial=0.0) < 1e-15
    np.testing.assert_allclose(row_values(nodes, rows, spin) / rows.length, 0.0, atol=1e-14)
    np.testing.assert_allclose(row_values(nodes, rows, np.ones_like(x)), 0.0, atol=1e-14)
    uh = fem.Function(V)
    for angle in (0.5, 3.0):
        Q, motion = turned(angle, d, shift=0.3)
        uh.x.array[: x.size] = (motion(x.T).T - x).ravel()
        uh.x.scatter_forward()
        now = found.with_turned_ties(uh).tied_rows()
        left = row_values(nodes, now, uh.x.array[: x.size]) - now.gap
        np.testing.assert_allclose(left / now.length, 0.0, atol=1e-14)
        # further rotations, about where the bodies are
        spin = (x @ Q.T) @ (skew - skew.T)
        np.testing.assert_allclose(row_values(nodes, now, spin) / now.length, 0.0, atol=1e-13)


def test_rows_are_the_derivative_of_turned_gaps():
    """By finite differences of the condition, at a displacement that strains the surface."""
    scene = bent("hexahedron", 1, gap=0.02)
    found = scene.problem(cell_tags=None)._torn.undeformed
    nodes = found.boundary.nodes
    x, n = nodes.coordinates, nodes.owned
    strained = 0.3 * x @ np.arange(9.0).reshape(3, 3) + 0.1 * np.sin(5.0 * x[:, ::-1])
    step = np.cos(7.0 * x)

    def at(t):
        uh = fem.Function(scene.V)
        uh.x.array[: 3 * n] = (strained + t * step).ravel()
        uh.x.scatter_forward()
        rows = found.with_turned_ties(uh).tied_rows()
        return rows, row_values(nodes, rows, uh.x.array[: 3 * n]) - rows.gap

    rows, size = at(0.0)[0], 1e-5
    change = (at(size)[1] - at(-size)[1]) / (2.0 * size)
    expected = row_values(nodes, rows, step)
    np.testing.assert_allclose(change, expected, atol=1e-9 * np.abs(expected).max())


def test_free_tied_body_with_gaps_turns_without_stress():
    """A block is turned by prescribed displacements; the one tied to it over gaps follows."""
    scene = bent("triangle", 1)
    turn = fem.Function(scene.V)
    turn.interpolate(lambda x: 1e-3 * np.array([-x[1], x[0]]))
    bottom = fem.locate_dofs_geometrical(scene.V, lambda x: x[1] < 0.2 * np.ones_like(x[1]))
    scene.bcs = [fem.dirichletbc(turn, bottom)]
    scene.L = ufl.inner(fem.Constant(scene.mesh, np.zeros(2)), scene.v) * scene.dx
    uh = scene.problem(cell_tags=None, options={"rtol": 1e-12}).solve()
    assert np.abs(uh.x.array - turn.x.array).max() < 1e-13

"""Periodic and cyclic surfaces, and any linear rows."""

from dataclasses import replace
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
from periodic_cells import grains, homogeneous_cell, ring
from scenes import Scene, at

import ufl
from dolfinx import fem

from fenics_tfeti import (
    Coulomb,
    InputError,
    LinearRows,
    NonlinearContactProblem,
    PeriodicPair,
    Tresca,
)
from fenics_tfeti.models import neo_hookean

STRAIN = np.array([[-1e-3, 4e-4, 2e-4], [4e-4, 6e-4, -3e-4], [2e-4, -3e-4, -8e-4]])
CELLS = {"triangle": 2, "quadrilateral": 2, "tetrahedron": 3, "hexahedron": 3}


def displacement_error(problem, uh, expected):
    """Return the largest difference from x -> u, up to a translation."""
    gdim = problem.space.mesh.geometry.dim
    u = uh.x.array.reshape(-1, gdim)
    difference = u - expected(problem.space.tabulate_dof_coordinates()[:, :gdim])
    return np.abs(difference - difference[0]).max() / np.abs(u - u[0]).max()


@pytest.mark.parametrize(("cell", "degree"), list(zip(CELLS, (2, 1, 1, 2), strict=True)))
def test_any_strain(cell, degree):
    """Edges and corners are in several pairs: their rows depend on each other."""
    E = STRAIN[: CELLS[cell], : CELLS[cell]]
    scene = homogeneous_cell(cell, E, degree)
    problem = scene.problem(options={"rtol": 1e-12, "subdomain_size": 100})
    uh = problem.solve()
    assert displacement_error(problem, uh, lambda x: x @ E.T) < 1e-9


GRAINS = np.array([[-1e-3, 3e-4], [3e-4, -6e-4]]), Coulomb(0.3)


@pytest.mark.once
def test_touching_grains():
    """Some of them stick; the sum of nodal forces is the force of a periodic surface."""
    problem = grains(1, *GRAINS)
    problem.solve()
    assert 0 < problem.report.unknowns["sticking"] < problem.report.unknowns["friction"]
    for k in (-1, -2):
        sums = problem.results[k].nodal_force.sum(axis=0)
        np.testing.assert_allclose(sums, problem.results[k].force, rtol=1e-7)


@pytest.mark.heavy
def test_touching_grains_of_a_larger_cell():
    """A cell is one of its four."""
    one, four = grains(1, *GRAINS), grains(2, *GRAINS)
    one.solve()
    four.solve()
    assert four.report.energy == pytest.approx(4 * one.report.energy, rel=1e-8)
    # what the periodic surfaces transmit is the mean stress, times the length of the cell
    for k in (-1, -2):
        np.testing.assert_allclose(four.results[k].force, 2 * one.results[k].force, rtol=1e-7)


@pytest.mark.once
def test_sector_of_a_ring():
    """Pads between two rings: a sector of sixty degrees is a sixth of the whole."""
    sector, whole = ring(1, 6, law=Tresca(1e6)), ring(6, 6, law=Tresca(1e6))
    sector.solve()
    whole.solve()
    assert 0 < sector.report.unknowns["active"] < sector.report.unknowns["inequalities"]
    assert whole.report.energy == pytest.approx(6 * sector.report.energy, rel=1e-8)
    largest = [np.linalg.norm(p.u.x.array.reshape(-1, 2), axis=1).max() for p in (sector, whole)]
    assert largest[0] == pytest.approx(largest[1], rel=1e-8)
    for k in range(2):
        pressures = [np.sort(p.results[k].pressure) for p in (sector, whole)]
        np.testing.assert_allclose(
            np.repeat(pressures[0], 6), pressures[1], atol=1e-6 * pressures[1].max()
        )
    # the border carries the tension or pressure of the hoop
    assert sector.results["outer"].force @ sector.results["outer"].force > 0.0


def test_other_jump_in_the_next_step():
    E = STRAIN[:2, :2]
    scene = homogeneous_cell("quadrilateral", E)
    problem = scene.problem(options={"rtol": 1e-12})
    problem.solve()
    problem.contacts = [
        replace(pair, jump=lambda x, t=pair.translation: np.outer(2 * E @ t, np.ones(x.shape[1])))
        for pair in scene.contacts
    ]
    uh = problem.solve()
    assert displacement_error(problem, uh, lambda x: 2 * x @ E.T) < 1e-9


def test_large_strain():
    """A homogeneous deformation, whatever the material."""
    H = np.array([[0.2, 0.3], [-0.1, -0.15]])
    scene = homogeneous_cell("triangle", H)
    u = fem.Function(scene.V)
    residual = ufl.derivative(neo_hookean(1e6, 0.3)(u) * ufl.dx, u)
    problem = NonlinearContactProblem(residual, u, contacts=scene.contacts)
    problem.solve()
    assert displacement_error(problem, u, lambda x: x @ H.T) < 1e-7
    # first Piola-Kirchhoff stress times the length of the side
    F = np.identity(2) + H
    mu, lmbda, inverse = 1e6 / 2.6, 3e5 / 1.3 / 0.4, np.linalg.inv(F).T
    P = mu * (F - inverse) + lmbda * np.log(np.linalg.det(F)) * inverse
    np.testing.assert_allclose(problem.results[0].force, 1.5 * P[:, 0], rtol=1e-6)


class Rows:
    """What a finalized dolfinx_mpc.MultiPointConstraint has, on one rank."""

    def __init__(self, space, slaves, masters, coefficients):
        size = 2 * (space.dofmap.index_map.size_local + space.dofmap.index_map.num_ghosts)
        counts = np.zeros(size, dtype=np.int64)
        counts[slaves] = 1
        order = np.argsort(slaves)
        self.function_space, self.slaves, self.num_local_slaves = space, slaves, len(slaves)
        self.masters = SimpleNamespace(array=masters[order])
        self.coefficients = lambda: (coefficients[order], np.append(0, np.cumsum(counts)))


@pytest.mark.parametrize("kind", ["arrays", "MultiPointConstraint"])
def test_linear_rows(kind):
    """The conditions of a periodic pair, one by one."""
    E = STRAIN[:2, :2] * [[0, 0], [0, 1]]
    scene = homogeneous_cell("quadrilateral", E)
    scene.add_load(2, scene.constant([1e7, 0.0]))
    scene.add_load(1, scene.constant([-1e7, 0.0]))
    vertical = scene.contacts[1]
    problem = scene.problem(contacts=vertical, options={"rtol": 1e-11})
    expected = problem.solve().x.array.copy()
    tie = problem.results[0]
    pairs = problem.system.tied
    assert (np.diff(pairs.offsets) == 2).all()
    component = np.argmax(np.abs(pairs.coefficients[::2]), axis=1)
    slaves, masters = (2 * pairs.nodes[k::2] + component for k in range(2))
    ones = np.ones(slaves.size)
    if kind == "arrays":
        rows = LinearRows(slaves, masters, ones, np.arange(ones.size + 1), values=pairs.gap)
    else:
        rows = LinearRows.from_mpc(Rows(scene.V, slaves, masters, ones), name="mpc")
        rows = replace(rows, values=pairs.gap)
    problem = scene.problem(contacts=rows, options={"rtol": 1e-11})
    found = problem.solve().x.array
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())
    result = problem.results[0]
    assert result.name == ("linear rows 0" if kind == "arrays" else "mpc")
    np.testing.assert_allclose(result.force, tie.force, rtol=1e-8, atol=1e-3)
    assert np.isnan(result.traction).all()


SQUARE = homogeneous_cell("quadrilateral", STRAIN[:2, :2])
PAIR = SQUARE.contacts[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"translation": "x"}, "the translation is 'x'"),
        ({"rotation": [1.0, 0.0]}, r"the rotation has shape \(2,\)"),
        ({"rotation": [[-1.0, 0.0], [0.0, 1.0]]}, "the rotation is a reflection"),
        ({"jump": 0.1}, "the jump is 0.1"),
    ],
)
def test_mistakes_in_a_pair(change, message):
    with pytest.raises(InputError, match=message):
        replace(PAIR, **change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"master": 3}, r"cell: \d of 3 facets of the slave have .*, the first around \(1, "),
        ({"translation": (1.0, 0.0, 0.0)}, r"cell: the translation has shape \(3,\)"),
        ({"jump": lambda x: x[0]}, "the jump of cell returned shape"),
    ],
)
def test_mistakes_on_a_mesh(change, message):
    with pytest.raises(InputError, match=message):
        SQUARE.problem(contacts=replace(PAIR, name="cell", **change))


def test_facets_of_a_master_that_share_no_nodes():
    """The right side of one body, and the left sides of two that lie on each other."""
    parts = [((2, 0), (3, 1), (1, 2)), ((0, 0), (1, 0.5), (1, 1)), ((0, 0.5), (1, 1), (1, 1))]
    scene = Scene.of_boxes(MPI.COMM_SELF, "quadrilateral", parts, [(1, at(0, 0)), (2, at(0, 3))])
    pair = PeriodicPair(scene.facet_tags, 2, 1, translation=(3.0, 0.0))
    with pytest.raises(InputError, match=r"1 nodes of the slave have several .* \(3, 0.5\)"):
        scene.problem(contacts=pair)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0], [4], [1.0, 2.0], [0, 1]), r"coefficients has shape \(2,\), expected \(1,\)"),
        (([0.5], [4], [1.0], [0, 1]), "slaves: an array of integers"),
        (([0], [4], [np.nan], [0, 1]), "coefficients: a number is NaN"),
        (([10**6], [4], [1.0], [0, 1]), "linear rows 0: a slave is none of the"),
        (([0], [10**6], [1.0], [0, 1]), "linear rows 0: a master is none of the"),
    ],
)
def test_mistakes_in_rows(arguments, message):
    with pytest.raises(InputError, match=message):
        SQUARE.problem(contacts=LinearRows(*arguments))

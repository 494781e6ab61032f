"""Contact patch test on meshes that do not match: exact on any two meshes, also down to slivers."""

import numpy as np
import pytest
from mortar_blocks import LOADED, LOWER, PRESSURE, SUPPORTED, UPPER, Blocks, solved
from mortar_feet import FOOT, LOW, TABLE, WIDTH, foot_on_table
from pairwise import pairwise
from scenes import POISSON, YOUNG, axisymmetric_strain, elasticity

import ufl

CASES = {
    "same footprint, 1:1.4": {"lower": 5, "upper": 7},
    "same footprint, 1:3": {"lower": 3, "upper": 9},
    "overhang of the lower block": {"width": 0.63},
    "overhang of the upper block": {"width": 1.27},
    "inclined": {"slope": 0.3},
    "graded": {"jitter": 0.3},
}


@pytest.mark.parametrize(
    ("cell", "case", "slave", "degree"),
    pairwise(
        ["triangle", "quadrilateral", "tetrahedron", "hexahedron"], CASES, [LOWER, UPPER], [1, 2]
    ),
)
def test_uniform_pressure(cell, case, slave, degree):
    arguments = dict(CASES[case])
    if cell == "hexahedron" and case == "graded":
        # quadrilaterals that are no parallelograms have rational shape functions
        arguments["jitter"] = 0.05
    if cell in ("tetrahedron", "hexahedron") and (degree == 2 or "lower" not in arguments):
        lower, upper = (3, 4) if degree == 1 else (2, 6 if case.endswith("1:3") else 3)
        arguments.update(lower=lower, upper=upper)
    result = solved(Blocks(cell, degree=degree, **arguments), slave)
    assert result.displacement < 1e-10
    assert result.pressure < 1e-8
    check_resultants(result.problem, min(1.0, arguments.get("width", 1.0)))


def check_resultants(problem, width):
    """Forces on the two surfaces, and what supports bear, are equal to rounding."""
    report = problem.report
    gdim = problem.system.gdim
    on_slave = np.array(report.contacts[0].force)
    force = abs(on_slave[-1])
    contact = problem.results[0]
    sums = contact.nodal_normal_force @ contact.normal
    np.testing.assert_allclose(-sums, on_slave, atol=1e-12 * force)
    rows = problem.system.contacts
    # each condition is in equilibrium: what it exerts on the slave it takes from the master
    total = np.zeros((rows.size, gdim))
    np.add.at(total, rows.row, rows.coefficients)
    assert np.abs(total).max() < 1e-13 * rows.length.max()
    assert report.equilibrium < 1e-10
    assert force == pytest.approx(PRESSURE * width ** (gdim - 1), rel=1e-10)


@pytest.mark.once
@pytest.mark.parametrize(
    ("cell", "degree", "exponent"),
    [
        *(("triangle", 1, exponent) for exponent in (1, 3, 5, 8)),
        *(("triangle", 2, exponent) for exponent in (2, 8)),
        *(("tetrahedron", 1, exponent) for exponent in (2, 6)),
        *(("hexahedron", 1, exponent) for exponent in (1, 8)),
    ],
)
def test_border_beyond_a_line_of_nodes_by_a_sliver(cell, degree, exponent):
    """The upper block ends a little beyond a line of the lower block's nodes."""
    n = 4 if cell == "triangle" else 3
    width = 2.0 / n + 10.0**-exponent / n
    result = solved(Blocks(cell, lower=n, upper=3, width=width, degree=degree), LOWER)
    assert result.displacement < 1e-10
    assert result.pressure < 1e-8


def test_pairing_is_in_the_report():
    problem = solved(Blocks("triangle", width=0.63), LOWER).problem
    (entry,) = [c.matching for c in problem.report.contacts]
    assert entry["discretisation"] == "mortar"
    assert entry["pairs"] + entry["unmatched"] == 6
    assert entry["covered_area"] == pytest.approx(0.63)
    assert entry["smallest_gap"] == entry["largest_gap"] == entry["mean_gap"] == 0.0
    assert problem.results[0].area.sum() == pytest.approx(0.63)
    assert "mortar" in problem.report.matching_table()


@pytest.mark.parametrize("slave", [LOWER, UPPER])
def test_axisymmetric(slave):
    """With the weight of the measure; stress uniform along the axis, radial expansion linear."""
    scene = Blocks("triangle", 5, 7).scene()
    r = ufl.SpatialCoordinate(scene.mesh)[0]
    scene.a = elasticity(scene.u, scene.v, scene.young * r, strain=axisymmetric_strain)
    scene.L = -scene.constant(PRESSURE) * scene.v[1] * r * scene.ds(LOADED)
    for axis in range(2):
        scene.fix(SUPPORTED[axis], axis)
    scene.add_pair(slave, LOWER + UPPER - slave)
    options = {"rtol": 1e-12, "subdomain_size": 150}
    problem = scene.problem(cell_tags=None, measure_weight=r, options=options)
    uh = problem.solve().x.array.reshape(-1, 2)
    exact = PRESSURE / YOUNG * np.array([POISSON, -1.0]) * scene.V.tabulate_dof_coordinates()[:, :2]
    assert np.abs(uh - exact).max() < 1e-10 * np.abs(exact).max()
    np.testing.assert_allclose(problem.results[0].pressure, PRESSURE, rtol=1e-8)
    assert problem.results[0].nodal_normal_force.sum() == pytest.approx(0.5 * PRESSURE)


@pytest.mark.once
@pytest.mark.parametrize(
    ("offset", "grid", "cell"),
    pairwise([0.0, 0.015, 0.03], [(8, 6), (12, 5)], ["triangle", "hexahedron"]),
)
def test_largest_pressure_with_either_side_as_slave(cell, grid, offset):
    """Beside a foot, nodes of the table are covered by any small part."""
    table, foot = (foot_on_table(cell, grid, offset, slave) for slave in (TABLE, FOOT))
    for problem in (table, foot):
        contact = problem.results[0]
        assert contact.pressure @ contact.area == pytest.approx(
            problem.report.contacts[0].normal_force
        )
        assert contact.area.sum() == pytest.approx(
            problem.report.contacts[0].matching["covered_area"]
        )
    largest = [problem.results[0].pressure.max() for problem in (table, foot)]
    assert 0.7 < largest[0] / largest[1] < 1.3
    np.testing.assert_allclose(foot.results[0].coverage, 1.0)


def mean_around_corner(contact, low, area):
    """Return the largest mean pressure over an area around a corner of the foot, by forces."""
    x, means = contact.coordinates[:, :2] - low, []
    for corner in WIDTH * np.array([[0, 0], [0, 1], [1, 0], [1, 1]]):
        distance = np.abs(x - corner)
        order = np.lexsort((distance.sum(axis=1), distance.max(axis=1).round(9)))
        areas, forces = contact.area[order], contact.nodal_normal_force[order]
        means.append(np.interp(area, np.cumsum(areas), np.cumsum(forces)) / area)
    return max(means)


@pytest.mark.once
@pytest.mark.parametrize(
    ("cell", "grid"), [("tetrahedron", (8, 6)), ("hexahedron", (6, 8)), ("hexahedron", (10, 12))]
)
def test_pressure_at_sharp_corners_is_the_same_over_equal_areas(cell, grid):
    """It is singular there: the finer surface as slave shows up to 2.6 times as much at a node."""
    table, foot = (
        mean_around_corner(
            foot_on_table(cell, grid, 0.03, slave, roles="given").results[0],
            LOW + 0.03,
            # a facet of the table
            grid[0] ** -2.0,
        )
        for slave in (TABLE, FOOT)
    )
    assert table == pytest.approx(foot, rel=0.06)


@pytest.mark.once
@pytest.mark.parametrize(
    ("cell", "grid"),
    [
        *(("triangle", grid) for grid in [(8, 6), (12, 5), (10, 12)]),
        ("tetrahedron", (12, 5)),
        ("hexahedron", (8, 6)),
    ],
)
def test_largest_pressure_of_a_rounded_foot_with_either_side_as_slave(cell, grid):
    """A paraboloid of 5 km presses on about half of the foot's width; its pressure is bounded."""
    offset = 0.015
    middle, across = LOW + offset + WIDTH / 2.0, 1 if cell == "triangle" else 2

    def gap(x):
        return np.sum((x[:across] - middle) ** 2, axis=0) / (2.0 * 5e3)

    table, foot = (
        foot_on_table(cell, grid, offset, slave, roles="given", initial_gap=gap).results[0]
        for slave in (TABLE, FOOT)
    )
    assert 1.0 / 1.5 < table.pressure.max() / foot.pressure.max() < 1.5

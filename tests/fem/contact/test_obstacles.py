"""Rigid obstacles: distances and normals against what they are by hand."""

import warnings
from xml.etree import ElementTree

from mpi4py import MPI

import numpy as np
import pytest
from matching import match_contacts
from scenes import GROUND, at, normal_forces, pressed_block

from fenics_tfeti import Cylinder, Deformed, Plane, RigidObstacle, Sphere
from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.io import contact_fields, tag_facets, write_fields

X = np.array([[3.0, 0.0], [4.0, -10.0], [0.0, 0.0]])


def matched(obstacle, cell="quadrilateral", gap=0.0):
    scene = pressed_block(MPI.COMM_SELF, cell, 2, gap=gap)
    return match_contacts(
        MeshBoundary.of(scene.V), [RigidObstacle(scene.facet_tags, GROUND, obstacle)]
    )[0]


@pytest.mark.parametrize(
    ("obstacle", "gap", "normal"),
    [
        (Sphere((0, 0, 0), 2.0), [3.0, 8.0], [[0.6, 0.8, 0], [0, -1, 0]]),
        (Sphere((0, 0), 2.0), [3.0, 8.0], [[0.6, 0.8], [0, -1]]),
        (Sphere((0, 0, 0), 12.0, hollow=True), [7.0, 2.0], [[-0.6, -0.8, 0], [0, 1, 0]]),
        (Cylinder((0, 0, 9), (0, 0, -3), 2.0), [3.0, 8.0], [[0.6, 0.8, 0], [0, -1, 0]]),
        (
            Cylinder((0, 0, 0), (0, 0, 1), 12.0, hollow=True),
            [7.0, 2.0],
            [[-0.6, -0.8, 0], [0, 1, 0]],
        ),
        (Plane((0, 1, 0), (0, 5, 0)), [3.0, -11.0], [[0, 1, 0], [0, 1, 0]]),
    ],
)
def test_gap_and_normal(obstacle, gap, normal):
    found = obstacle(X)
    np.testing.assert_allclose(found[0], gap, rtol=1e-15)
    np.testing.assert_allclose(found[1].T, normal, atol=1e-15)


def test_cylinder_has_no_normal_on_its_axis():
    with pytest.raises(InputError, match=r"\(3, 4, 0\) is on the axis"):
        Cylinder((7, 4, 0), (2, 0, 0), 1.0)(X)


@pytest.mark.parametrize("hollow", [False, True])
def test_sphere_has_no_normal_at_its_centre(hollow):
    with pytest.raises(InputError, match=r"\(3, 4, 0\) is at the centre"):
        Sphere((3, 4, 0), 1.0, hollow)(X)


@pytest.mark.parametrize("radius", [0.0, -1.0, np.nan, np.inf, "wide", None])
@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
def test_radius_is_positive(kind, radius):
    with pytest.raises(InputError, match=f"{kind}'s radius is .* positive number"):
        Sphere((0, 0), radius) if kind == "sphere" else Cylinder((0, 0, 0), (0, 0, 1), radius)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Sphere((0, np.nan), 1.0), "sphere's centre"),
        (lambda: Sphere(5.0, 1.0), "sphere's centre"),
        (lambda: Sphere("origin", 1.0), "sphere's centre"),
        (lambda: Cylinder((0, 0, 0), (0, 0, 0), 1.0), "cylinder's axis .* no direction"),
        (lambda: Cylinder((0, 0, 0), (0, np.inf, 0), 1.0), "cylinder's axis"),
        (lambda: Cylinder((0, 0), (0, 1), 1.0), "three coordinates .* Sphere"),
        (lambda: Plane((0, 0, 0), (0, 0, 0)), "plane's normal .* no direction"),
        (lambda: Plane((0, 0), (0, 0, 1)), "plane's point .* fewer coordinates"),
        (lambda: Plane((0, np.nan), (0, 1)), "plane's point"),
    ],
)
def test_data_that_make_no_obstacle(make, words):
    with pytest.raises(InputError, match=words):
        make()


def test_gap_alone_is_along_the_own_normal():
    contact = matched(lambda x: 0.25 + x[1])
    np.testing.assert_allclose(contact.gap, 0.25, rtol=1e-15)
    np.testing.assert_allclose(contact.normal, np.tile([0.0, -1.0], (3, 1)), atol=1e-15)


def test_gap_alone_of_two_nodes_is_not_taken_for_gap_and_normal():
    scene = pressed_block(MPI.COMM_SELF, "quadrilateral", 1)
    contact = RigidObstacle(scene.facet_tags, GROUND, lambda x: [0.25 + 0 * y for y in x[1]])
    np.testing.assert_allclose(match_contacts(MeshBoundary.of(scene.V), [contact])[0].gap, 0.25)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_sphere_below_the_body(cell):
    """The lowest point of the body is 0.5 above the top of the ball, in 2D of the disc."""
    gdim = 3 if cell == "tetrahedron" else 2
    centre = np.array([0.5, 0.5, -1.5] if gdim == 3 else [0.5, -1.5])
    contact = matched(Sphere(centre, 1.0), cell)
    offset = contact.coordinates[:, :gdim] - centre
    distance = np.linalg.norm(offset, axis=1)
    np.testing.assert_allclose(contact.gap, distance - 1.0, rtol=1e-14)
    np.testing.assert_allclose(contact.normal, -offset / distance[:, None], atol=1e-15)
    assert contact.summary["smallest_gap"] == pytest.approx(0.5, rel=1e-14)
    steepest = np.degrees(np.arccos(1.5 / distance.max()))
    assert contact.summary["largest_angle"] == pytest.approx(steepest, rel=1e-12)


def punch(far):
    """Return an obstacle below x <= 0.5 only; beyond, its gap is `far`."""

    def gap_and_normal(x):
        # no normal where there is no obstacle
        there = x[0] < 0.5 + 1e-9
        normal = np.array([0.0 * x[0], np.where(there | (far < np.inf), 1.0, np.nan)])
        return np.where(there, x[1], far), normal

    return gap_and_normal


def test_infinite_gap_means_no_obstacle():
    contact = matched(punch(np.inf), gap=0.25)
    right = contact.coordinates[:, 0] > 0.6
    np.testing.assert_array_equal(np.isinf(contact.gap), right)
    np.testing.assert_array_equal(contact.normal, np.tile([0.0, -1.0], (3, 1)))
    summary = contact.summary
    assert (summary["pairs"], summary["unmatched"]) == (2, 1)
    assert (summary["smallest_gap"], summary["largest_gap"]) == (0.0, 0.0)


def test_pairing_of_an_obstacle():
    assert matched(Plane((0, -0.5), (0, 1))).summary == {
        "contact": "contact 0 (obstacle)",
        "discretisation": "obstacle",
        "pairs": 3,
        "unmatched": 0,
        "largest_distance": None,
        "largest_relative_distance": None,
        "largest_angle": 0.0,
        "smallest_gap": 0.5,
        "largest_gap": 0.5,
        "mean_gap": 0.5,
        "covered_area": None,
        "deviation": None,
        "blurred": None,
    }


HALF, WHOLE = 31, 32


def pressed_on_a_punch(obstacle, tag, comm=MPI.COMM_SELF, **arguments):
    """Solve a block of 1 m pushed down by 0.01 mm on a flat punch below its left half."""
    scene = pressed_block(comm, "quadrilateral", 8, approach=1e-5)
    below = [(HALF, lambda x: np.isclose(x[1], 0.0) & (x[0] < 0.5 + 1e-9)), (WHOLE, at(1, 0.0))]
    tags = tag_facets(scene.mesh, below[:1] if tag == HALF else below[1:])
    problem = scene.problem(contacts=[RigidObstacle(tags, tag, obstacle)], **arguments)
    return problem, problem.solve()


@pytest.mark.parametrize(
    ("far", "method"),
    [
        *((far, method) for far in (np.inf, 1e10) for method in ("active_set", "smalbe")),
        (1e300, "active_set"),
        (1.0, "smalbe"),
    ],
)
def test_far_away_is_no_obstacle(far, method):
    options = {"rtol": 1e-8, "method": method}
    exact, u = pressed_on_a_punch(Plane((0, 0), (0, 1)), HALF, options=options)
    problem, uh = pressed_on_a_punch(punch(far), WHOLE, options=options)
    force = exact.report.contacts[0].normal_force
    assert problem.report.reactions[0].force[1] == pytest.approx(-force, rel=1e-7)
    assert force > 0.5e-5 * 2.1e11 / 2
    np.testing.assert_allclose(normal_forces(problem), force, rtol=1e-7)
    np.testing.assert_allclose(uh.x.array, u.x.array, atol=1e-7 * 1e-5)
    assert problem.report.converged


@pytest.fixture(scope="module")
def on_punch():
    return pressed_on_a_punch(punch(np.inf), WHOLE)[0]


def test_report_of_an_obstacle_that_is_not_everywhere(tmp_path, on_punch):
    problem = on_punch
    (entry,) = [c.matching for c in problem.report.contacts]
    assert (entry["pairs"], entry["unmatched"]) == (5, 4)
    assert (entry["smallest_gap"], entry["largest_gap"]) == (0.0, 0.0)
    assert problem.report.unknowns["infinite_gaps"] == 4
    assert "inf" not in problem.report.matching_table()
    problem.report.to_json(tmp_path / "report.json")
    assert "Infinity" not in (tmp_path / "report.json").read_text()


def test_files_of_an_obstacle_that_is_not_everywhere(tmp_path, on_punch):
    """NaN in the gap where there is none: ParaView draws nothing there; never infinity."""
    fields = contact_fields(on_punch.space, on_punch.results)
    gap = fields[2]
    x = gap.function_space.tabulate_dof_coordinates()
    covered = np.isclose(x[:, 1], 0.0) & (x[:, 0] < 0.5 + 1e-9)
    np.testing.assert_array_equal(np.isfinite(gap.x.array), covered)
    assert not np.isinf(gap.x.array).any()
    write_fields(tmp_path / "contact.pvd", fields)
    (file,) = tmp_path.glob("*.vtu")
    (written,) = ElementTree.parse(file).getroot().iterfind(".//DataArray[@Name='initial_gap']")
    values = np.array(written.text.split(), dtype=float)
    assert np.count_nonzero(np.isfinite(values)) == np.count_nonzero(covered) == 5
    assert not np.isinf(values).any()


def test_gap_of_a_node_with_two_obstacles_is_that_of_the_finite_one():
    scene = pressed_block(MPI.COMM_SELF, "quadrilateral", 2)
    nowhere = RigidObstacle(scene.facet_tags, GROUND, lambda x: np.full(x.shape[1], np.inf))
    plane = RigidObstacle(scene.facet_tags, GROUND, lambda x: x[1] + 0.25)
    for contacts in ([nowhere, plane], [plane, nowhere]):
        problem = scene.problem(contacts=contacts)
        problem.solve()
        gap = contact_fields(problem.space, problem.results).gap
        height = gap.function_space.tabulate_dof_coordinates()[:, 1]
        np.testing.assert_allclose(gap.x.array, np.where(height < 1e-9, 0.25, np.nan), rtol=1e-14)


def test_obstacle_that_is_nowhere():
    scene = pressed_block(MPI.COMM_SELF, "quadrilateral", 2)
    contact = RigidObstacle(scene.facet_tags, GROUND, lambda x: np.full(x.shape[1], np.inf))
    problem = scene.problem(contacts=[contact])
    problem.solve()
    assert normal_forces(problem) == [0.0]
    assert problem.report.contacts[0].matching["largest_gap"] is None
    head, line = problem.report.matching_table().splitlines()
    assert head.split()[-1] == "unmatched" and line.split()[-2:] == ["0", "3"]


def test_punch_with_exact_non_penetration():
    arguments = {"gaps": Deformed(), "options": {"rtol": 1e-8}}
    exact, u = pressed_on_a_punch(Plane((0, 0), (0, 1)), HALF, **arguments)
    _, uh = pressed_on_a_punch(lambda x: np.where(x[0] < 0.6, x[1], np.inf), WHOLE, **arguments)
    np.testing.assert_allclose(uh.x.array, u.x.array, atol=1e-6 * 1e-5)


@pytest.mark.parametrize("exact", [True, False])
def test_normal_that_is_not_the_gradient_of_its_gap(exact):
    """A plane with a slope of a half, whose normal is that of a level one."""
    plane = Plane((0.0, -0.6), (-0.5, 1.0))

    def level(x):
        return plane(x)[0], np.repeat([[0.0], [1.0]], x.shape[1], axis=1)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        matched(level if not exact else lambda x: plane(x))
    told = [
        str(w.message) for w in caught if "not the gradient of its gap at 3 nodes" in str(w.message)
    ]
    assert len(told) == (0 if exact else 1)


def test_gap_with_a_kink_has_a_gradient_on_each_side():
    def wedge(x):
        rises = x[0] >= 0.5
        normal = np.array([np.where(rises, -0.6, 0.6), np.full(x.shape[1], 0.8)])
        return 0.8 * (x[1] + 0.3) + 0.6 * np.abs(x[0] - 0.5) * -1.0, normal

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        matched(wedge)

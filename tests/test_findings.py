"""What reports list to check: each kind of finding where it is, and nowhere else."""

from __future__ import annotations

import warnings

from mpi4py import MPI

import finite_strains
import numpy as np
import pytest
import scenes
from scenes import CLAMPED, MASTER, SLAVE, Scene, at, two_beams

from dolfinx import fem

from fenics_tfeti import Coulomb, NotConverged, Sphere

COMM = MPI.COMM_WORLD
RADIUS = 5.0

pytestmark = [pytest.mark.ranks, pytest.mark.once]
# what is found is the same on all ranks: of many cases, a few are for several
one_rank = pytest.mark.ranks(1)


def block_on(obstacle, n=16, degree=1, cell="quadrilateral", **more):
    """Return a unit block that hangs at its top, with its lower face at an obstacle."""
    gdim, up = scenes.dimension(cell), scenes.dimension(cell) - 1
    parts = [(np.zeros(gdim), np.ones(gdim), (n,) * gdim)]
    marks = [(CLAMPED, at(up, 1.0), 1), (SLAVE, at(up, 0.0), 1)]
    scene = Scene.of_boxes(COMM, cell, parts, marks, degree=degree)
    scene.fix(CLAMPED)
    scene.add_obstacle(SLAVE, obstacle, name="fit", **more)
    return scene


def ball(depth, gdim=2):
    """Return a ball that is `depth` inside the middle of the block's lower face."""
    return Sphere([*[0.5] * (gdim - 1), depth - RADIUS], RADIUS)


def to_check(problem, quiet=True):
    """Solve, and return what is to be checked, the same on all ranks."""
    with warnings.catch_warnings():
        warnings.simplefilter("error" if quiet else "ignore")
        problem.solve()
    found = problem.report.to_check
    assert COMM.allgather(found) == [found] * COMM.size
    return found


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize(
    "depth", [pytest.param(1e-4 * d, marks=[one_rank] * (d != 20)) for d in (1, 4, 10, 20, 40, 80)]
)
def test_nodes_across_a_contact_are_counted(depth, degree):
    """In two dimensions all nodes that press are side by side; between vertices is another node."""
    problem = block_on(ball(depth), degree=degree).problem()
    found = to_check(problem)
    across = degree * (problem.results[0].gather().active.sum() - 1) + 1
    expected = f"fewer than 5 nodes press across 'fit' ({across}): pressures there are not "
    assert [text.startswith(expected) for text in found] == [True] * int(across < 5)


@pytest.mark.parametrize("cell", ["tetrahedron", "hexahedron"])
@pytest.mark.parametrize(
    ("depth", "across"), [pytest.param(1e-3, 1, marks=one_rank), (1e-2, 3), (5e-2, None)]
)
def test_nodes_across_a_round_patch(cell, depth, across):
    """On 8 x 8 facets: the middle one, with its neighbours, and a wide patch."""
    found = to_check(block_on(ball(depth, 3), 8, cell=cell).problem())
    assert [f"'fit' ({across})" in text for text in found] == [True] * (across is not None)


@pytest.mark.parametrize(
    "cell", [pytest.param(c, marks=[one_rank] * (c != "triangle")) for c in scenes.CELLS]
)
def test_whole_face_that_presses_is_resolved(cell):
    """By however few nodes."""
    plane = scenes.plane(scenes.dimension(cell) - 1, scenes.dimension(cell), 1e-3)
    assert to_check(block_on(plane, 1, cell=cell).problem()) == ()


@pytest.mark.parametrize(
    "depth", [1e-3, pytest.param(4e-3, marks=one_rank), pytest.param(1e-2, marks=one_rank)]
)
def test_plane_of_symmetry_has_the_other_half(depth):
    """The ball is below the left end of the block."""
    problem = block_on(Sphere([0.0, depth - RADIUS], RADIUS)).problem()
    found = to_check(problem)
    across = 2 * problem.results[0].gather().active.sum() - 1
    assert [f"'fit' ({across})" in text for text in found] == [True] * int(across < 5)


def test_contact_that_is_open():
    (found,) = to_check(block_on(scenes.plane(1, 2, -0.1)).problem())
    assert found == "nothing touches: 'fit' is open by 0.1 m"


def test_open_contact_beside_one_that_presses_is_not_told():
    scene = block_on(scenes.plane(1, 2, 1e-3), 2)
    scene.add_obstacle(SLAVE, scenes.plane(1, 2, -0.1))
    assert to_check(scene.problem()) == ()


@pytest.mark.parametrize(("gap", "initial_gap", "told"), [
    (-0.02, "geometric", False), (-0.1, "geometric", True), (-0.1, -0.1, False)
])  # fmt: skip
def test_meshes_that_overlap_by_a_tenth_of_a_facet(gap, initial_gap, told):
    """Facets are 0.25 m; an interference of initial_gap is meant."""
    scene = scenes.beams(COMM, "quadrilateral", 4, gap)
    scene.contacts.clear()
    scene.add_pair(name="foot", initial_gap=initial_gap)
    found = [text for text in to_check(scene.problem(), quiet=False) if "overlap" in text]
    text = "'foot': the bodies overlap by up to 0.1 m at 5 of 5 nodes: drawn so?"
    assert found == [text] * told


def test_contact_of_prescribed_nodes():
    scene = two_beams(COMM, "quadrilateral", 4)
    for tag in (SLAVE, MASTER):
        scene.fix(tag)
    (found,) = to_check(scene.problem())
    assert "displacements are prescribed in all of its 5 conditions" in found


def test_contact_with_one_prescribed_surface_is_not_told():
    scene = two_beams(COMM, "quadrilateral", 4)
    scene.fix(MASTER)
    assert not any("prescribed" in text for text in to_check(scene.problem()))


def test_obstacle_deeper_than_the_body_is_long():
    deep, shallow = (block_on(scenes.plane(1, 2, depth), 2).problem() for depth in (3.0, 0.9))
    text = "'fit': the obstacle is 3 m deep in body 0 (cell tag 1), which is 1 m long"
    assert sum(found.startswith(text) for found in to_check(deep, quiet=False)) == 1
    assert not any("deep in" in found for found in to_check(shallow, quiet=False))


@pytest.mark.parametrize(("factor", "told"), [(1.0, False), (1e6, True)])
def test_strains_out_of_all_proportion(factor, told):
    """Beams of steel, with Young's modulus in Pa where it has to be in MPa."""
    scene = two_beams(COMM, "quadrilateral", 4)
    scene.young.value *= factor
    assert [text.startswith("the largest strain is ") for text in to_check(scene.problem())] == (
        [True] * told
    )


def sheared():
    """Return a problem with friction, a block that is moved along a plane, and its support."""
    scene = block_on(scenes.plane(1, 2, 1e-3), 4, friction=Coulomb(0.1))
    scene.bcs.clear()
    motion = fem.Constant(scene.mesh, np.array([1e-3, 0.0]))
    held = fem.locate_dofs_topological(scene.V, 1, scene.facet_tags.find(CLAMPED))
    scene.bcs.append(fem.dirichletbc(motion, held, scene.V))
    return scene.problem(), motion


@pytest.mark.parametrize("between", ["nothing", "the same", "advance", "reset_slip"])
def test_friction_in_solves_that_are_not_accepted(between):
    problem, motion = sheared()
    assert to_check(problem) == ()
    if between != "the same":
        motion.value[0] = -1e-3
    if between in ("advance", "reset_slip"):
        getattr(problem, between)()
    found = to_check(problem)
    assert ["advance() accepts" in text for text in found] == [True] * (between == "nothing")


def test_warnings_of_set_up_and_solve():
    """That a support has no nodes is in each report, wrong units in that of the solve."""
    scene = two_beams(COMM, "quadrilateral", 4)
    scene.fix(99)
    scene.young.value *= 1e-6
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        problem = scene.problem()
        problem.solve()
    first = problem.report.to_check
    # supports are evaluated at the set-up and in the solve
    told = list(dict.fromkeys(str(warning.message) for warning in caught))
    assert len(first) == 2
    assert told == (list(first) if COMM.rank == 0 else [])
    scene.young.value *= 1e6
    assert to_check(problem, quiet=False) == first[:1]


def test_report_of_an_error_has_what_to_check():
    scene = block_on(scenes.plane(1, 2, 3.0), 4)
    with pytest.raises(NotConverged) as caught:
        scene.problem(options={"rtol": 1e-9, "max_products": 1}).solve()
    assert any("deep in" in text for text in caught.value.report.to_check)


def test_newtons_method_has_findings_too():
    """A beam above a cylinder; without its load it does not move."""
    (found,) = to_check(finite_strains.beam(COMM).problem)
    assert found == "nothing touches: 'contact 0 (obstacle)' is open by 2 m"


def test_largest_displacement_and_strain():
    """A block that is pressed by a plane, free to expand sideways in plane strain."""
    scene = block_on(scenes.plane(1, 2, 1e-3), 4)
    scene.bcs.clear()
    scene.fix(CLAMPED, 1)
    problem = scene.problem()
    assert to_check(problem) == ()
    nu = scenes.POISSON
    assert problem.report.largest_strain == pytest.approx(1e-3 * np.hypot(1.0, nu / (1.0 - nu)))


def test_printed_report_begins_with_what_to_check():
    problem = block_on(scenes.plane(1, 2, -0.1), 2).problem()
    problem.solve()
    first, *others = str(problem.report).splitlines()
    assert first == "        to check  nothing touches: 'fit' is open by 0.1 m"
    assert "         largest  displacement 0 m, strain 0" in others

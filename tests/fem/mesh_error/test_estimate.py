"""The estimate of the mesh's error, against exact solutions and solutions on finer meshes."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from joints import plane_joint
from mesh_arrays import block, mesh_of
from mesh_errors import (
    ABOVE,
    BELOW,
    CASES,
    FOOT,
    LEFT,
    TIGHT,
    TOP,
    beams,
    cells_of,
    distance,
    posed,
    roller,
    true_error,
)
from scenes import CELLS, POISSON, Scene, at, dimension, pressed_block, stress

import ufl
from dolfinx import fem

from fenics_tfeti import Deformed, InputError, Nearest, Plane, RigidBody, SoftContact, TiedPair
from fenics_tfeti.io import tag_facets

COMM = MPI.COMM_SELF
DEGREES = (1, 2)


# -- no error ----------------------------------------------------------------------------------


def distorted(cell: str, degree: int) -> tuple[Scene, np.ndarray]:
    """Return a cube of distorted cells that tractions stretch, and the gradient."""
    gdim, rng = dimension(cell), np.random.default_rng(0)

    def moved(x):
        inner = ((x > 1e-9) & (x < 1 - 1e-9)).all(axis=0)
        return x + 0.05 * inner * rng.uniform(-1, 1, x.shape)

    sides = [(3, at(axis, float(side))) for axis in range(gdim) for side in (0, 1)]
    sides[0] = (0, sides[0][1])
    parts = [((0.0,) * gdim, (1.0,) * gdim, (2,) * gdim)]
    scene = Scene.of_boxes(COMM, cell, parts, sides, moved, degree=degree, young=1.0)
    gradient = rng.uniform(-1, 1, (gdim, gdim))
    w = fem.Function(scene.V)
    w.interpolate(lambda x: gradient @ x[:gdim])
    scene.fix(0, None, w)
    strain = (gradient + gradient.T) / 2
    mu, lam = 1.0 / (2 * (1 + POISSON)), POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    sigma = scene.constant(2 * mu * strain + lam * np.trace(strain) * np.eye(gdim))
    traction = ufl.dot(sigma, ufl.FacetNormal(scene.mesh))
    scene.L = ufl.inner(traction, scene.v) * scene.ds(3)
    return scene


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("cell", CELLS)
def test_linear_displacements_have_none(cell, degree):
    problem = distorted(cell, degree).problem(cell_tags=None, options={"rtol": 1e-10})
    problem.solve()
    estimate = problem.mesh_error()
    assert estimate.cells.x.array.max() < 1e-9
    assert estimate.energy_norm > 0.1


@pytest.mark.parametrize("cell", ("triangle", "quadrilateral"))
def test_uniform_pressure_on_an_obstacle_has_none(cell):
    problem = pressed_block(COMM, cell).problem(options=TIGHT)
    problem.solve()
    assert problem.mesh_error().error < 1e-6


@pytest.mark.parametrize("tied", (False, True))
def test_uniform_pressure_between_unlike_meshes_has_none(tied):
    parts = [((0.0, 0.0), (1.0, 1.0), (4, 4)), ((0.0, 1.0), (1.0, 2.0), (3, 3))]
    marks = [(1, at(1, 0.0), 1), (2, at(1, 1.0), 1), (4, at(1, 1.0), 2), (3, at(1, 2.0), 2)]
    scene = Scene.of_boxes(COMM, "triangle", parts, [*marks, (5, at(0, 0.0))], young=1.0)
    scene.fix(1, 1)
    scene.fix(5, 0)
    scene.add_load(3, [0.0, -1e-3])
    scene.add_pair(4, 2)
    if tied:
        scene.contacts = [TiedPair(scene.facet_tags, slave=4, master=2)]
    problem = scene.problem(options=TIGHT)
    problem.solve()
    assert problem.mesh_error().error < 1e-7


def test_free_expansion_has_none():
    """Stresses of a temperature stand in L: they balance those of the strain."""
    parts = [((0.0, 0.0), (1.0, 1.0), (3, 3))]
    scene = Scene.of_boxes(COMM, "triangle", parts, [(1, at(0, 0.0)), (2, at(1, 0.0))], young=1.0)
    scene.fix(1, 0)
    scene.fix(2, 1)
    w = fem.Function(scene.V)
    w.interpolate(lambda x: 0.1 * x[:2])
    scene.L += ufl.inner(stress(w, scene.young), ufl.grad(scene.v)) * ufl.dx
    problem = scene.problem(cell_tags=None, options={"rtol": 1e-10})
    problem.solve()
    assert problem.mesh_error().error < 1e-9


# -- the theorem -------------------------------------------------------------------------------


@pytest.mark.once
@pytest.mark.parametrize(
    ("name", "n", "degree", "cell"),
    [
        ("roller", 8, 1, "triangle"),
        ("beams", 2, 1, "triangle"),
        ("beams", 2, 1, "quadrilateral"),
        ("slider", 4, 1, "triangle"),
        ("ball", 8, 1, "triangle"),
        ("beams", 1, 1, "tetrahedron"),
        ("beams", 1, 1, "hexahedron"),
        ("beams", 2, 2, "triangle"),
        ("beams", 2, 2, "quadrilateral"),
    ],
)
def test_bounds_the_distance_to_one_degree_more(name, n, degree, cell):
    """After each step of conjugate gradients, which makes it smaller."""
    problem = posed(CASES[name](COMM, n, degree, cell))
    problem.solve()
    cells = cells_of(problem)
    exact = distance(cells, 0)
    squares = np.array([cells.energies(steps)[0][:, 0].sum() for steps in range(5)])
    ratios = np.sqrt(squares / exact)
    assert (ratios >= 1.0 - 1e-8).all()
    assert (np.diff(ratios) < 1e-12).all()
    assert ratios[-1] < 1.25


@pytest.mark.parametrize("steps", (0, 5))
@pytest.mark.parametrize(
    ("name", "n", "cell"),
    [("beams", 2, "quadrilateral"), ("beams", 2, "tetrahedron"), ("punch", 4, "triangle")],
)
def test_tractions_balance_each_cell(name, n, cell, steps):
    """Also at corners where one side is supported, and after steps that improve them."""
    problem = posed(CASES[name](COMM, n, 1, cell))
    problem.solve()
    cells = cells_of(problem)
    faces, m = cells.faces, np.zeros_like(cells.tractions.moments)

    def keep(rows, moments):
        m[rows] = moments[..., 0]

    cells.energies(steps, keep)
    # opposite on both sides of a facet
    sums, sizes = {}, np.abs(m).max()
    for k, f in zip(*np.nonzero(~cells.kinds.single), strict=True):
        for t, node in enumerate(faces.facet_nodes()[k, f]):
            key = faces.facets[k, f], node
            sums[key] = sums.get(key, 0.0) + m[k, f, t]
    assert np.abs(list(sums.values())).max() < 1e-9 * sizes
    # forces and moments of the loads of the Neumann problems
    x = faces.node_points(2).reshape(faces.size, -1, faces.dim)
    load = cells.neumann.loads(np.arange(faces.size), cells.u(slice(None)), m[..., None]).reshape(
        x.shape
    )
    assert np.abs(load.sum(axis=1)).max() < 1e-9 * sizes
    x, load = (np.pad(values, ((0, 0), (0, 0), (0, 3 - faces.dim))) for values in (x, load))
    turning = np.cross(x, load).sum(axis=1)
    assert np.abs(turning).max() < 1e-8 * sizes


# -- effectivity -------------------------------------------------------------------------------

# energy norms [sqrt(J)] of differences to solutions of degree 2 on meshes six times finer
TRUE_ERRORS = {
    ("beams", 4, 1, "triangle"): 155.76,
    ("roller", 8, 1, "triangle"): 3.916,
    ("graded", 8, 1, "quadrilateral"): 1.6508,
    ("punch", 8, 1, "triangle"): 12.755,
    ("inclusion", 8, 1, "triangle"): 2.7163,
    ("slider", 8, 1, "quadrilateral"): 1.0718,
    ("slender", 2, 2, "triangle"): 0.16937,
    ("incompressible", 8, 2, "triangle"): 1.3381,
    ("ball", 8, 1, "triangle"): 0.64358,
}


@pytest.mark.once
@pytest.mark.parametrize("case", TRUE_ERRORS, ids=lambda case: case[0])
def test_is_about_the_true_error(case):
    name, n, degree, cell = case
    problem = posed(CASES[name](COMM, n, degree, cell))
    problem.solve()
    estimate = problem.mesh_error()
    assert 0.8 < estimate.error * estimate.energy_norm / TRUE_ERRORS[case] < 1.7


def test_is_about_the_difference_to_a_finer_solution():
    """Of each cell, too."""
    scene = beams(COMM, 8, 2)
    coarse, fine = posed(beams(COMM, 2)), posed(scene)
    coarse.solve()
    fine.solve()
    estimate = coarse.mesh_error()
    error = true_error(coarse, fine, scene)
    assert estimate.error * estimate.energy_norm == pytest.approx(error, rel=0.15)


# -- what changes nothing ----------------------------------------------------------------------


def error_of(scene: Scene, **arguments):
    problem = posed(scene, **arguments)
    problem.solve()
    return problem.mesh_error()


@pytest.mark.parametrize("degree", DEGREES)
def test_does_not_depend_on_units(degree):
    """Lengths in millimetres, forces in kilonewtons; energies are those of a unit of length."""
    metres = error_of(beams(COMM, 2, degree))
    others = error_of(beams(COMM, 2, degree, metre=1e3, newton=1e-3))
    assert others.error == pytest.approx(metres.error, rel=1e-9)
    assert others.energy_norm == pytest.approx(np.sqrt(1e-3) * metres.energy_norm, rel=1e-8)


@pytest.mark.parametrize("cell", ("triangle", "tetrahedron"))
def test_does_not_depend_on_the_order_of_cells(cell):
    """Nor on that of nodes, in the mesh and in each cell."""
    rng = np.random.default_rng(0)
    given = points, cells = block(cell, 4)
    nodes, order = rng.permutation(len(points)), rng.permutation(len(cells))
    mixed = np.argsort(nodes)[rng.permuted(np.asarray(cells)[order], axis=1)]
    errors = []
    for x, of_cells in (given, (np.asarray(points)[nodes], mixed)):
        domain = mesh_of(COMM, cell, x, of_cells)
        up = domain.geometry.dim - 1
        top = float(np.asarray(points)[:, up].max())
        scene = Scene(domain, tag_facets(domain, {TOP: at(up, top), FOOT: at(up, 0.0)}))
        scene.fix(TOP, None, np.array([0.0] * up + [-1e-2 * top]))
        scene.add_obstacle(FOOT, Plane((0.0,) * (up + 1), (0.0,) * up + (1.0,)))
        errors.append(error_of(scene, cell_tags=None).error)
    assert errors[1] == pytest.approx(errors[0], rel=1e-9)


def test_does_not_depend_on_slave_and_master():
    given = beams(COMM, 4)
    exchanged = beams(COMM, 4, pair={"partners": Nearest()})
    pair = {"partners": Nearest(), "name": "joint"}
    exchanged.contacts = []
    exchanged.add_pair(BELOW, ABOVE, partial=True, **pair)
    given.contacts = []
    given.add_pair(ABOVE, BELOW, partial=True, **pair)
    assert error_of(exchanged).error == pytest.approx(error_of(given).error, rel=1e-9)


@pytest.mark.parametrize("rtol", (1e-1, 1e-3))
def test_hardly_depends_on_the_iterations(rtol):
    tight = error_of(beams(COMM, 4))
    loose = error_of(beams(COMM, 4), options={"rtol": rtol})
    assert loose.error == pytest.approx(tight.error, rel=0.05)
    assert loose.total > loose.error


def test_sums_of_cells_and_bodies_are_the_total():
    estimate = error_of(beams(COMM, 4))
    cells = np.linalg.norm(estimate.cells.x.array)
    assert cells == pytest.approx(estimate.error * estimate.energy_norm, rel=1e-12)
    shares = [body.share for body in estimate.bodies.values()]
    assert np.linalg.norm(shares) == pytest.approx(estimate.error, rel=1e-12)


# -- what there is in problems -----------------------------------------------------------------


def test_exact_gaps_of_small_displacements_are_as_others():
    linear = error_of(roller(COMM, 8, depth=1e-5))
    exact = error_of(roller(COMM, 8, depth=1e-5), gaps=Deformed(tolerance=1e-8))
    assert exact.error == pytest.approx(linear.error, rel=1e-2)


@pytest.mark.once
@pytest.mark.parametrize("cell", ("triangle", "quadrilateral"))
def test_springs_in_place_of_a_support(cell):
    """Stiff springs are as good as the support."""
    supported = error_of(roller(COMM, 8, 1, cell))
    scene = roller(COMM, 8, 1, cell)
    spring = scene.constant(1e15)
    del scene.bcs[0]
    scene.a += spring * scene.u[0] * scene.v[0] * scene.ds(LEFT)
    assert error_of(scene).error == pytest.approx(supported.error, rel=0.03)


def soft_roller(stiffness, n, degree=1):
    scene = roller(COMM, n, degree)
    obstacle, scene.contacts = scene.contacts[0].obstacle, []
    scene.add_obstacle(FOOT, obstacle, law=SoftContact(stiffness), name="roller")
    return scene


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("stiffness", (1e10, 1e12))
def test_soft_contact_with_an_obstacle(stiffness, degree):
    """About as stiff as the block, and much stiffer."""
    fine_scene = soft_roller(stiffness, 24, 2)
    problem, fine = posed(soft_roller(stiffness, 8, degree)), posed(fine_scene)
    problem.solve()
    fine.solve()
    estimate = problem.mesh_error()
    error = true_error(problem, fine, fine_scene)
    assert 0.8 < estimate.error * estimate.energy_norm / error < 1.7


def test_very_stiff_contact_is_as_hard_contact():
    hard, soft = error_of(roller(COMM, 8)), error_of(soft_roller(1e17, 8))
    assert soft.error == pytest.approx(hard.error, rel=1e-4)


def test_rigid_body_on_springs_carries_the_obstacle():
    held = error_of(roller(COMM, 8))
    scene = roller(COMM, 8)
    obstacle = scene.contacts[0].obstacle
    scene.contacts = []
    body = RigidBody((0.0, 0.05), translation=(0.0, 0.0), rotation=0.0)
    scene.add_obstacle(FOOT, obstacle, rigid_body=body, name="roller")
    assert error_of(scene).error == pytest.approx(held.error, rel=1e-6)


# -- results -----------------------------------------------------------------------------------


def test_marked_cells_are_the_fewest_with_their_share():
    estimate = error_of(roller(COMM, 8))
    squares = estimate.cells.x.array**2
    marked = estimate.mark(0.5)
    assert squares[marked].sum() >= 0.5 * squares.sum()
    largest = np.sort(squares)[::-1]
    assert marked.size == np.searchsorted(np.cumsum(largest), 0.5 * squares.sum()) + 1
    assert estimate.mark(1.0).size == np.count_nonzero(squares)


def test_sizes_for_the_same_error_are_the_present_ones_in_the_mean():
    estimate = error_of(roller(COMM, 8))
    h = 0.02 / 8 * (2 / np.sqrt(3)) ** 0.5
    sizes = estimate.sizes(estimate.error)
    assert 0.25 * h <= sizes.x.array.min() < h < sizes.x.array.max() <= 2.0001 * h
    finer = estimate.sizes(0.5 * estimate.error)
    assert (finer.x.array <= sizes.x.array).all()


def test_density_of_the_error_compares_cells_of_any_size():
    estimate = error_of(roller(COMM, 8, 1, "triangle", grade=1.6))
    squares, total = 10.0**estimate.density.x.array, 0.02**2
    cells = estimate.cells.x.array**2 / estimate.energy_norm**2
    assert np.sum(cells) == pytest.approx(estimate.error**2)
    assert (cells * total / squares).sum() == pytest.approx(total)


def test_report_has_it_once_it_was_called():
    problem = posed(beams(COMM, 4))
    problem.solve()
    assert problem.report.mesh_error is None
    assert "error of mesh" not in str(problem.report)
    estimate = problem.mesh_error()
    entry = problem.report.to_dict()["mesh_error"]
    assert entry["error"] == estimate.error
    assert entry["contacts"]["joint"]["error"] == estimate.contacts["joint"].error
    lines = str(problem.report).splitlines()
    (first,) = (number for number, text in enumerate(lines) if "error of mesh" in text)
    line, advice = " ".join(map(str.strip, lines[first : first + 2])), lines[first + 2]
    assert advice.strip() == "of both errors that of the mesh is larger: refine it"
    assert "about 48 % in the energy norm (cell tag 1 49, cell tag 2 47)" in line
    assert "% at the largest pressure of 'joint'" in line


@pytest.mark.parametrize(
    ("name", "degree", "told"), [("punch", 1, ""), ("punch", 2, "the gap jumps"), ("roller", 2, "")]
)
def test_gaps_that_jump_are_told_with_degree_two(name, degree, told):
    estimate = error_of(CASES[name](COMM, 8, degree))
    assert len(estimate.remarks) == bool(told)
    assert all(told in remark for remark in estimate.remarks)
    assert told in str(estimate)


@pytest.mark.parametrize("degree", DEGREES)
def test_curved_surfaces_are_told_with_degree_two(degree):
    problem = plane_joint(1.5, degree)
    problem.solve()
    remarks = problem.mesh_error().remarks
    assert [("curved surfaces" in remark) for remark in remarks] == [True] * (degree == 2)


# -- errors ------------------------------------------------------------------------------------


def test_needs_a_solution():
    with pytest.raises(InputError, match=r"call solve\(\) first"):
        posed(beams(COMM, 1)).mesh_error()


def test_supports_of_single_nodes_are_told():
    scene = beams(COMM, 2)
    del scene.bcs[1]
    corner = fem.locate_dofs_geometrical(
        (scene.V.sub(0), scene.V.sub(0).collapse()[0]), lambda x: at(0, 3.0)(x) & at(1, 2.0)(x)
    )
    zero = fem.Function(scene.V.sub(0).collapse()[0])
    scene.bcs.append(fem.dirichletbc(zero, corner, scene.V.sub(0)))
    scene.add_load(TOP, [20e6, 0.0])
    problem = posed(scene)
    problem.solve()
    with pytest.raises(InputError, match=r"acts on the node at \(3, 2\) alone"):
        problem.mesh_error()


def test_names_that_are_missing_are_told_with_those_that_there_are():
    estimate = error_of(beams(COMM, 1))
    with pytest.raises(InputError, match=r"of 'bolt'; the names are \['joint'\]"):
        estimate.contacts["bolt"]


@pytest.mark.parametrize("share", (0.0, 2.0))
def test_shares_to_mark_are_checked(share):
    with pytest.raises(InputError, match="mark: share"):
        error_of(beams(COMM, 1)).mark(share)

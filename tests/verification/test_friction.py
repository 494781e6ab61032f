"""Friction: blocks, and a strip whose slip has a formula."""

from dataclasses import replace

import numpy as np
import pytest
from friction_scenes import (
    BALL_RADIUS,
    SHEAR_STRENGTH,
    THICKNESS,
    belt,
    half_planes,
    half_spaces,
    pulled_plate,
    pulled_strip,
    pushed_cube,
    sheared_square,
)
from scenes import POISSON

from dolfinx.mesh import compute_midpoints

from fenics_tfeti import Coulomb, NotConverged, Tresca, UnresistedMotion

pytestmark = pytest.mark.once

CASES = {
    "square on the ground": ("quadrilateral", 6, None),
    "cube on the ground": ("hexahedron", 3, None),
    "matching triangles": ("triangle", 5, 5),
    "mortar of triangles": ("triangle", 5, 4),
    "matching hexahedra": ("hexahedron", 3, 3),
    "mortar of tetrahedra": ("tetrahedron", 3, 2),
}


@pytest.mark.parametrize("case", list(CASES)[::2])
def test_block_that_is_pushed(case):
    """With a slip bound that is given."""
    rubbing = pushed_cube(*CASES[case], friction=Tresca(0.037))
    rubbing.problem.solve()
    assert_friction_holds_the_load(rubbing)
    assert_conditions_of_friction(rubbing)
    assert_work_of_friction(rubbing)


def assert_friction_holds_the_load(rubbing):
    contact, push = rubbing.problem.results[0], rubbing.traction.value[:-1]
    np.testing.assert_allclose(contact.friction.force.sum(axis=0)[:-1], -push, rtol=1e-8)
    np.testing.assert_allclose(contact.nodal_normal_force.sum(), 0.1, rtol=1e-8)
    on_slave = rubbing.problem.report.contacts[0].force
    np.testing.assert_allclose(on_slave[:-1], -push, rtol=1e-8)


def assert_conditions_of_friction(rubbing):
    """At most the bound; nothing slips below it; slip is opposite to the force at it."""
    found = rubbing.problem.results[0].friction
    size, slip = np.linalg.norm(found.force, axis=1), np.linalg.norm(found.slip, axis=1)
    assert np.all(size <= found.bound * (1.0 + 1e-12))
    assert 0 < np.count_nonzero(found.sticking) < found.sticking.size
    assert np.array_equal(found.state, np.where(found.sticking, 1, 2))
    assert slip[found.sticking].max() <= 1e-6 * slip.max()
    clear = slip > 1e-4 * slip.max()
    assert clear.any()
    cosine = -np.sum(found.force * found.slip, axis=1)[clear] / (size * slip)[clear]
    np.testing.assert_allclose(cosine, 1.0, atol=1e-6)
    np.testing.assert_allclose(found.bound.sum(), 0.037, rtol=1e-12)
    area = rubbing.problem.results[0].area
    np.testing.assert_allclose(found.traction * area[:, None], found.force, atol=1e-15)


def assert_work_of_friction(rubbing):
    found, report = rubbing.problem.results[0].friction, rubbing.problem.report
    work = -np.sum(found.force * found.slip)
    assert work > 0.0
    assert found.work.sum() == pytest.approx(work, rel=1e-9)
    assert [c.friction_work for c in report.contacts] == [pytest.approx(work, rel=1e-9)]
    assert report.unknowns["sticking"] == np.count_nonzero(found.sticking)
    assert report.unknowns["friction"] == found.sticking.size
    assert f"{report.unknowns['sticking']} of {found.sticking.size} nodes stick" in str(report)


# -- a strip on the ground: shear lag -------------------------------------------------------------

FORCE = 0.8 * SHEAR_STRENGTH  # slips over 0.8 of the length


def slip_length(contact):
    """Return the length over which the strip slips: slip is a parabola from its end on."""
    slip, x = np.linalg.norm(contact.friction.slip, axis=1), contact.coordinates[:, 0]
    clear = slip > 0.05 * slip.max()
    slope, constant = np.polyfit(x[clear], np.sqrt(slip[clear]), 1)
    return 1.0 + constant / slope


def test_strip():
    """End displacements, lengths that slip and works of a cycle of loads, by formulas."""
    scene = pulled_strip()
    ends, lengths, work = [], [], []
    for part in (1.0, 0.0, 1.0):
        scene.traction.value[0] = part * FORCE / THICKNESS
        uh = scene.problem.solve()
        scene.problem.advance()
        x = uh.function_space.tabulate_dof_coordinates()
        u = uh.x.array.reshape(-1, 2)[: len(x), 0]
        ends.append(u[np.isclose(x[:, 0], 1.0)].mean())
        lengths.append(slip_length(scene.problem.results[0]))
        work.append(scene.problem.report.contacts[0].friction_work)
    # u'' = psi / (E t) over F / psi from the end, which moves by F^2 / (2 E t psi)
    assert lengths[0] == pytest.approx(FORCE / SHEAR_STRENGTH, rel=0.02)
    assert ends[0] == pytest.approx(FORCE**2 / (2.0 * THICKNESS * SHEAR_STRENGTH), rel=0.002)
    # friction turns round, twice as much of it: half of the end's displacement stays
    assert lengths[1] == pytest.approx(0.5 * FORCE / SHEAR_STRENGTH, rel=0.02)
    assert ends[1] == pytest.approx(0.5 * ends[0], rel=0.002)
    # the loop is closed: slips forth and back are the same, and so is their work
    assert ends[2] == pytest.approx(ends[0], rel=1e-4)
    assert lengths[2] == pytest.approx(lengths[1], rel=1e-3)
    # the integral of psi times slip: F^3 / (6 E t psi) at first, a quarter of it each way after it
    first = FORCE**3 / (6.0 * THICKNESS * SHEAR_STRENGTH)
    np.testing.assert_allclose(work, [first, 0.25 * first, 0.25 * first], rtol=0.01)


# -- Coulomb's law --------------------------------------------------------------------------------


@pytest.mark.parametrize("case", list(CASES)[1::2])
def test_block_that_is_pushed_with_coulomb_friction(case):
    coulomb = pushed_cube(*CASES[case], friction=Coulomb(0.37), options={"rtol": 1e-7})
    coulomb.problem.solve()
    assert_bounds_are_those_of_the_normal_forces(coulomb)
    assert_contraction_is_in_the_report(coulomb)


def assert_bounds_are_those_of_the_normal_forces(coulomb):
    """The forces hold the push; where something slips they are 0.37 times the normal force."""
    contact, report = coulomb.problem.results[0], coulomb.problem.report
    found = contact.friction
    push = coulomb.traction.value[:-1]
    np.testing.assert_allclose(found.force.sum(axis=0)[:-1], -push, rtol=1e-8)
    size, slip = np.linalg.norm(found.force, axis=1), np.linalg.norm(found.slip, axis=1)
    bound = 0.37 * contact.nodal_normal_force
    assert 0 < np.count_nonzero(found.sticking) < found.sticking.size
    error = np.where(slip > 0.0, size - bound, np.maximum(size - bound, 0.0))
    assert np.linalg.norm(error) <= 1e-6 * np.linalg.norm(bound)
    np.testing.assert_allclose(found.bound, bound, atol=1e-6 * bound.max())
    assert report.certificate.slip_bound_error <= 1e-7


def assert_contraction_is_in_the_report(coulomb):
    steps = coulomb.problem.report.slip_bounds
    assert 3 <= len(steps) <= 20
    assert sum(step.products for step in steps) == coulomb.problem.report.products["total"]
    assert min(step.ratio for step in steps if step.ratio is not None) < 0.5
    assert steps[-1].change <= 1e-7
    assert steps[-1].rtol <= 1e-7


@pytest.mark.parametrize("case", ["square on the ground", "mortar of triangles"])
def test_limit_of_coulomb(case):
    """A block slides where the push is more than the coefficient times its weight."""
    cell, n, lower = CASES[case]
    low = {"friction": Coulomb(0.03 / 0.999), "press": 1.0, "options": {"rtol": 1e-6}}
    scene = pushed_cube(cell, n, lower, **low)
    scene.problem.solve()
    assert scene.problem.report.converged
    high = pushed_cube(cell, n, lower, friction=Coulomb(0.03 / 1.001), press=1.0)
    with pytest.raises(UnresistedMotion, match=r"slides .* 1\.001 times the coefficients of fri"):
        high.problem.solve()


def test_block_that_topples_before_it_slides():
    """Friction cannot help: what turns the block over its edge is named."""
    scene = pushed_cube("quadrilateral", 4, friction=Coulomb(2.0), push=(0.08, 0.0))
    with pytest.raises(UnresistedMotion, match="rotation through") as raised:
        scene.problem.solve()
    assert "coefficient" not in str(raised.value)


def test_thin_plate_that_slips_in_varying_directions():
    """Its free end contracts by Poisson's ratio: few nodes stick there, and slips point to them."""
    for friction, products in ((Tresca(2e-4), 250), (Coulomb(0.2), 400)):
        problem = pulled_plate(friction)
        problem.solve()
        assert problem.report.products["total"] < products
        found, slip = problem.results[0].friction, problem.results[0].friction.slip
        size, length = np.linalg.norm(found.force, axis=1), np.linalg.norm(slip, axis=1)
        assert 0 < np.count_nonzero(found.sticking & (found.bound > 0.0)) < 20
        assert np.all(size <= found.bound + 1e-5 * found.bound.max())
        clear = (length > 1e-3 * length.max()) & (found.bound > 1e-3 * found.bound.max())
        cosine = -np.sum(found.force * slip, axis=1)[clear] / (size * length)[clear]
        np.testing.assert_allclose(cosine, 1.0, atol=1e-6)


@pytest.mark.parametrize(("mu", "angle"), [(0.5, 2.2), (2.0, 0.9)])
def test_bounds_that_swing(mu, angle):
    """Slip across stiff fibres changes the pressure by up to 2.6 times the friction that it makes.

    Steps of the whole difference would swing more and more.
    """
    problem = sheared_square(Coulomb(mu), (0.05, -0.01), fibre=angle)
    problem.solve()
    contact = problem.results[0]
    np.testing.assert_allclose(
        np.abs(contact.friction.force[:, 0]),
        mu * contact.nodal_normal_force,
        atol=1e-5 * mu * contact.nodal_normal_force.max(),
    )
    assert contact.nodal_normal_force.sum() > 1e-3


@pytest.mark.parametrize(("mu", "angle"), [(0.3, 1.81), (1.0, 2.19)])
def test_bounds_that_grow_until_something_sticks(mu, angle):
    """Slip along the fibres presses them on the ground, by more the more friction holds them."""
    problem = sheared_square(Coulomb(mu), (0.05, -0.01), fibre=angle)
    problem.solve()
    contact = problem.results[0]
    assert contact.friction.sticking[contact.nodal_normal_force > 0.0].any()
    force, bound = np.abs(contact.friction.force[:, 0]), mu * contact.nodal_normal_force
    assert np.all(force <= bound + 1e-5 * bound.max())
    assert contact.nodal_normal_force.sum() > 0.1


def test_bounds_that_do_not_contract_are_an_error():
    problem = sheared_square(Coulomb(10.0), (0.05, -0.01), fibre=1.24)
    with pytest.raises(
        NotConverged, match=r"slip bounds .* factor of [0-9.]+ a step only"
    ) as raised:
        problem.solve()
    assert not raised.value.report.converged
    assert raised.value.report.certificate.slip_bound_error > 0.1
    assert len(raised.value.report.slip_bounds) >= 6


# -- Cattaneo and Mindlin -------------------------------------------------------------------------

MU = 0.3


def test_half_planes_of_cattaneo_and_mindlin():
    """Pressed by a cylinder's gap, then pushed: c / a = sqrt(1 - Q / (mu P)), and tractions."""
    scene = half_planes(friction=Coulomb(MU))
    scene.traction.value[:] = 0.0, -0.06
    scene.problem.solve()
    # none by symmetry, but for the tolerance of 1e-5
    assert np.abs(scene.problem.results[0].friction.force).max() < 1e-6 * 0.06
    scene.problem.advance()
    scene.traction.value[:] = 0.02, -0.06
    scene.problem.solve()
    problem = scene.problem
    contact = problem.results[0].gather()
    a, p0 = hertz(contact)
    P, Q = contact.nodal_normal_force.sum(), -contact.friction.force[:, 0].sum()
    assert 0.5 < Q / (MU * P) < 0.8
    # within one element
    x = np.abs(contact.coordinates[:, 0])
    c = a * np.sqrt(1.0 - Q / (MU * P))
    assert abs(x[contact.friction.sticking].max() - c) <= contact.area[x < a].max()
    reaction = problem.report.reactions[0].force
    np.testing.assert_allclose(reaction, [-Q, P], rtol=1e-6)
    q = np.sqrt(np.maximum(1.0 - (x / a) ** 2, 0.0))
    q -= c / a * np.sqrt(np.maximum(1.0 - (x / c) ** 2, 0.0))
    difference = -contact.friction.traction[:, 0] - MU * p0 * q
    error = np.sqrt(
        np.sum(contact.area * difference**2) / np.sum(contact.area * (MU * p0 * q) ** 2)
    )
    assert error < 0.05


def hertz(contact):
    """Return half-width and largest pressure by a fit of p^2 over x^2."""
    x, p = contact.coordinates[:, 0], contact.pressure
    inner = p > 0.3 * p.max()
    slope, constant = np.polyfit(x[inner] ** 2, p[inner] ** 2, 1)
    return np.sqrt(-constant / slope), np.sqrt(constant)


@pytest.mark.parametrize(
    ("n", "limit"), [(8, 0.15), pytest.param(15, 0.08, marks=pytest.mark.heavy)]
)
def test_ball_of_cattaneo_and_mindlin(n, limit):
    """c / a = (1 - Q / (mu P))^(1/3), within one element; the traction in L2.

    The formula leaves out slip across the push, which Poisson's ratio of 0.3 makes.
    """
    scene = half_spaces(n, friction=Coulomb(MU))
    scene.traction.value[:] = 0.0, 0.0, -0.05
    scene.problem.solve()
    assert np.abs(scene.problem.results[0].friction.force).max() < 1e-6 * 0.05
    scene.problem.advance()
    scene.traction.value[:] = 0.01, 0.0, -0.05
    scene.problem.solve()
    contact = scene.problem.results[0].gather()
    P, Q = contact.nodal_normal_force.sum(), -contact.friction.force[:, 0].sum()
    reaction = scene.problem.report.reactions[0].force
    np.testing.assert_allclose((reaction[0], reaction[2]), (-Q, P), rtol=1e-6)
    assert 0.5 < Q / (MU * P) < 0.8
    # Hertz's formulas for the whole ball, of which the mesh has one half
    a = (3.0 * 2.0 * P * BALL_RADIUS * 2.0 * (1.0 - POISSON**2) / 4.0) ** (1.0 / 3.0)
    p0, c = 3.0 * 2.0 * P / (2.0 * np.pi * a**2), a * (1.0 - Q / (MU * P)) ** (1.0 / 3.0)
    r = np.linalg.norm(contact.coordinates[:, :2], axis=1)
    size = np.sqrt(contact.area[r < a].max())
    sticking = contact.friction.sticking & (contact.pressure > 0.0)
    assert abs(r[sticking].max() - c) <= size
    q = np.sqrt(np.maximum(1.0 - (r / a) ** 2, 0.0))
    q -= c / a * np.sqrt(np.maximum(1.0 - (r / c) ** 2, 0.0))
    exact = np.stack([MU * p0 * q, np.zeros_like(q)], axis=1)
    square = np.sum((-contact.friction.traction[:, :2] - exact) ** 2, axis=1)
    error = np.sqrt(contact.area @ square / (contact.area @ np.sum(exact**2, axis=1)))
    print(f"a/h {a / size:.1f}, c/a {c / a:.3f}, traction {error:.3f}")
    assert error < limit


# -- belt on a drum -------------------------------------------------------------------------------


@pytest.mark.parametrize("mu", [0.3, pytest.param(0.6, marks=pytest.mark.heavy)])
def test_belt_on_a_drum(mu):
    """The held end of a belt that slips has e^(-mu phi) of the force at the other one.

    phi is less by half an element at the held node, where displacements are prescribed. Friction
    acts below the middle of the belt, of thickness t: the exponent has a factor of 1 / (1 + t / 2).
    """
    n, thickness = 60, 0.01
    scene = belt(n, mu, thickness=thickness)
    scene.problem.solve()
    held = np.linalg.norm(scene.problem.report.reactions[0].force)
    assert held == pytest.approx(1e-4 * np.exp(-mu * np.pi), rel=0.03)
    exponent = mu * np.pi * (1.0 - 0.5 / n) / (1.0 + 0.5 * thickness)
    assert held == pytest.approx(1e-4 * np.exp(-exponent), rel=0.005)
    friction = scene.problem.results[0].friction
    assert not friction.sticking[friction.bound > 0.0].any()


@pytest.mark.parametrize("parts", [2, 3, 4, 7])
def test_products_of_a_belt_do_not_depend_on_how_it_is_cut(parts):
    """The bounds of the first step lift half of the belt: a problem that need not be solved."""
    scene = belt(mu=0.6).scene
    cells = scene.mesh.topology.index_map(2).size_local
    x = compute_midpoints(scene.mesh, 2, np.arange(cells, dtype=np.int32))
    label = (parts * np.arctan2(x[:, 1], x[:, 0]) / np.pi).astype(int)
    problem = scene.problem(subdomains=label, options={"rtol": 1e-5})
    problem.solve()
    report = problem.report
    assert report.subdomains == parts
    assert report.certificate.worst <= 1e-5
    # 356 to 503 for 2 to 9 parts
    assert report.products["total"] <= 600
    # without friction 29 with the accuracy of the first step, from contact at almost all nodes
    assert report.slip_bounds[0].products <= 40


@pytest.mark.parametrize(
    ("cell", "n", "lower"), [("quadrilateral", 3, None), ("hexahedron", 1, None)]
)
def test_ground_carries_a_block_that_slips_everywhere(cell, n, lower):
    """Forces in balance, all at the bound, leave its place to slips outwards at both ends."""
    scene = pushed_cube(cell, n, lower, friction=Tresca(1e-5), push=(0.0, 0.0), press=0.05)
    (given,), d = scene.problem.contacts, scene.problem.space.mesh.geometry.dim
    rest = scene.problem.solve().x.array.reshape(-1, d).copy()
    scene.problem.reset_slip()
    scene.problem.contacts = [replace(given, displacement=np.eye(d)[0] * 0.3)]
    carried = scene.problem.solve().x.array.reshape(-1, d)
    friction = scene.problem.results[0].friction
    assert not friction.sticking.any()
    np.testing.assert_allclose(np.linalg.norm(friction.force, axis=1), friction.bound, rtol=1e-9)
    assert np.all(np.sum(friction.force * friction.slip, axis=1) <= 0.0)
    # anywhere between slips to one side and to the other
    np.testing.assert_allclose(carried[:, 0] - rest[:, 0], 0.3, atol=abs(np.ptp(rest[:, 0])))

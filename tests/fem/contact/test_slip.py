"""Tangents, slip from the last load step, moving obstacles, results and fields."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from friction_scenes import LOADED, SLAVE, pushed_cube
from scenes import plane

import ufl
from dolfinx import fem

from fenics_tfeti import Deformed, InputError, RigidObstacle, Tresca
from fenics_tfeti.fem.contact.conditions.friction import tangents
from fenics_tfeti.io import contact_fields


@pytest.mark.parametrize("held", [(), (0,), (1,), (2,), (0, 1), (0, 1, 2)])
def test_tangents_are_orthonormal_and_along_what_is_held(held):
    rng = np.random.default_rng(1)
    normal = np.concatenate([rng.normal(size=(20, 3)), np.identity(3), -np.identity(3)])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    prescribed = np.zeros(normal.shape, dtype=bool)
    prescribed[:, held] = True
    found = tangents(normal, prescribed)
    frames = np.concatenate([normal[:, None], found], axis=1)
    np.testing.assert_allclose(
        frames @ frames.transpose(0, 2, 1), np.tile(np.identity(3), (len(normal), 1, 1)), atol=1e-12
    )
    for k in held:
        # the other tangent has no part of a held direction across the normal
        across = np.abs(normal[:, k]) < 1e-12
        parts = np.sort(np.abs(found[across][:, :, k]), axis=1)
        np.testing.assert_allclose(parts, np.tile([0.0, 1.0], (len(parts), 1)), atol=1e-12)


def test_tangents_in_the_plane():
    normal = np.array([[0.0, -1.0], [0.6, 0.8]])
    found = tangents(normal, np.zeros((2, 2), dtype=bool))[:, 0]
    np.testing.assert_allclose(np.sum(found * normal, axis=1), 0.0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0)


# -- sequences of loads ---------------------------------------------------------------------------


@pytest.fixture(params=[None, 4], ids=["ground", "mortar"])
def pushed(request):
    scene = pushed_cube("triangle", 5, request.param, friction=Tresca(0.035))
    return scene, scene.problem.solve()


def test_slip_is_counted_from_the_last_accepted_step(pushed):
    """A repeated solve is the same one; as a further step it slips nothing, after a reset anew."""
    scene, first = pushed
    problem = scene.problem
    u, slip = first.x.array.copy(), problem.results[0].friction.slip
    assert np.abs(slip).max() > 0.0
    repeated = problem.solve()
    np.testing.assert_allclose(repeated.x.array, u, atol=1e-6 * np.abs(u).max())
    np.testing.assert_allclose(
        problem.results[0].friction.slip, slip, atol=1e-6 * np.abs(slip).max()
    )
    problem.advance()
    with pytest.raises(InputError, match="no step to accept"):
        problem.advance()
    again = problem.solve()
    np.testing.assert_allclose(again.x.array, u, atol=1e-6 * np.abs(u).max())
    assert np.abs(problem.results[0].friction.slip).max() <= 1e-6 * np.abs(slip).max()
    assert problem.report.contacts[0].friction_work <= 1e-6 * np.abs(slip).max()
    problem.reset_slip()
    anew = problem.solve()
    np.testing.assert_allclose(anew.x.array, u, atol=1e-6 * np.abs(u).max())
    np.testing.assert_allclose(
        problem.results[0].friction.slip, slip, atol=1e-6 * np.abs(slip).max()
    )


@pytest.mark.parametrize(("cell", "divisions"), [("triangle", 4), ("tetrahedron", 3)])
def test_step_at_rest_is_solved_to_the_root_of_rounding(cell, divisions):
    """Forces are at their bounds without slip: of rounding, a bound times a slip has no energy."""
    problem = pushed_cube(cell, divisions, divisions - 1, friction=Tresca(0.035)).problem
    problem.solve()
    problem.advance()
    problem.solve()
    assert problem.options.solver.rtol == 1e-8
    assert problem.report.certificate.worst <= 1e-8


def test_friction_keeps_what_has_slipped(pushed):
    """Without the push the body does not go back all the way, and friction turns round."""
    scene, first = pushed
    first = first.copy()
    scene.problem.advance()
    scene.traction.value[0] = 0.0
    back = scene.problem.solve()
    assert np.abs(back.x.array).max() > 1e-3 * np.abs(first.x.array).max()
    force = scene.problem.results[0].friction.force
    assert force[:, 0].sum() == pytest.approx(0.0, abs=1e-9)
    assert force[:, 0].max() > 1e-3
    assert force[:, 0].min() < -1e-3


def test_step_that_is_not_accepted_is_no_step():
    scene = pushed_cube(
        "triangle",
        5,
        friction=Tresca(0.035),
        options={"rtol": 1e-8, "max_products": 2, "error_if_not_converged": False},
    )
    scene.problem.solve()
    assert not scene.problem.report.converged
    assert not scene.problem._accepted.origin.displacement.any()


def test_moved_mesh_counts_slip_anew(pushed):
    scene, _ = pushed
    scene.problem.advance()
    mesh = scene.problem.space.mesh
    mesh.geometry.x[:, 0] *= 1.0 + 1e-9
    scene.problem.solve()
    assert np.abs(scene.problem.results[0].friction.slip).max() > 0.0


def test_checkpoint_has_the_origin_of_slip(tmp_path, pushed):
    """A run that goes on counts slip from where the other one stopped."""
    scene, _ = pushed
    scene.problem.advance()
    scene.traction.value[0] = 0.01
    scene.problem.solve()
    scene.problem.advance()
    scene.problem.save(tmp_path / "step")
    scene.traction.value[0] = 0.02
    expected = scene.problem.solve().x.array
    lower = None if isinstance(scene.problem.contacts[0], RigidObstacle) else 4
    other = pushed_cube("triangle", 5, lower, friction=Tresca(0.035), push=(0.02, 0.0))
    assert other.problem.restore(tmp_path / "step") == 2
    found = other.problem.solve().x.array
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(
        other.problem.results[0].friction.slip, scene.problem.results[0].friction.slip, atol=1e-7
    )


# -- moving obstacles -----------------------------------------------------------------------------


def held_square(displacement, held: float = 0.0):
    """Return a square that is pressed on a plane, its top held at a displacement sideways."""
    scene = pushed_cube("quadrilateral", 4).scene
    top = scene.constant(np.array([held, -0.01]))
    scene.fix(LOADED, None, top)
    scene.L, scene.contacts = 0, []
    friction = Tresca(0.003)
    scene.add_obstacle(SLAVE, plane(1, 2), friction=friction, displacement=displacement)
    return scene.problem(cell_tags=None, options={"rtol": 1e-9}), top


@pytest.fixture(scope="module")
def conveyor():
    """Return friction of two steps with a moving plane, and with a body that moves the other way.

    In the second step the plane goes back by half.
    """
    way = [0.0]
    problem, _ = held_square(lambda x: np.stack([np.full(x.shape[1], way[0]), 0.0 * x[1]]))
    other, top = held_square(None)
    steps = []
    for moved in (0.04, 0.02):
        way[0] = moved
        problem.solve()
        top.value[0] = -moved
        other.solve()
        problem.advance()
        other.advance()
        steps.append((problem.results[0].friction, other.results[0].friction))
    return steps


def test_slip_is_relative_to_the_obstacle(conveyor):
    """A plane that moves to the right is a body that moves to the left."""
    for moving, at_rest in conveyor:
        size = np.abs(at_rest.force).max()
        np.testing.assert_allclose(moving.force, at_rest.force, atol=1e-6 * size)
        np.testing.assert_allclose(moving.slip, at_rest.slip, atol=1e-9)


def test_obstacle_drags_the_body_along(conveyor):
    """Forth it slips at all nodes, with the whole bound; back it turns the force."""
    (first, _), (second, _) = conveyor
    assert first.force[:, 0].sum() == pytest.approx(0.003, rel=1e-6)
    assert np.all(first.slip[:, 0] <= 0.0)
    assert second.force[:, 0].sum() < -0.002
    assert np.all(second.slip[:, 0] >= 0.0)


def test_slip_on_an_obstacle_that_has_moved_is_counted_anew():
    problem, _ = held_square((0.04, 0.0))
    problem.solve()
    assert problem.results[0].friction.force[:, 0].sum() == pytest.approx(0.003, rel=1e-6)
    slip = problem.results[0].friction.slip
    problem.advance()
    problem.reset_slip()
    problem.solve()
    np.testing.assert_allclose(problem.results[0].friction.slip, slip, atol=1e-9)


@pytest.mark.parametrize(
    ("displacement", "message"),
    [
        ((0.1, 0.0, 0.0), r"the obstacle's displacement has shape \(3,\), expected \(2,\)"),
        ((np.nan, 0.0), "the obstacle's displacement is .*: two or three finite numbers"),
        ("far", "two or three finite numbers"),
        (lambda x: x[0], r"the obstacle's displacement returned shape \(5,\)"),
        (lambda x: np.full((2, x.shape[1]), np.inf), "displacement is NaN or infinite at 5 points"),
        (lambda x: 1 / 0, "ZeroDivisionError"),
    ],
)
def test_wrong_displacements_of_obstacles(displacement, message):
    with pytest.raises(InputError, match=message):
        held_square(displacement)


# -- results --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def solved():
    scene = pushed_cube("tetrahedron", 3, 2, friction=Tresca(0.037))
    return scene.problem, scene.problem.solve()


def test_fields(solved):
    """Friction traction on a surface covered wholly integrates to the force."""
    problem, uh = solved
    fields = contact_fields(uh.function_space, problem.results)
    assert [field.name for field in fields] == [
        *("contact_pressure", "contact_force", "initial_gap", "opening"),
        *("friction_traction", "slip", "friction_state"),
    ]
    tags, comm = problem.contacts[0].facet_tags, uh.function_space.mesh.comm
    ds = ufl.Measure("ds", domain=uh.function_space.mesh, subdomain_data=tags)
    for k in range(3):
        form = fem.form(fields.traction[k] * ds(SLAVE))
        total = comm.allreduce(fem.assemble_scalar(form))
        expected = problem.results[0].friction.force[:, k].sum()
        assert total == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert set(np.unique(fields.state.x.array)) == {0.0, 1.0, 2.0}
    size = np.linalg.norm(problem.results[0].friction.slip, axis=1).max()
    found = np.linalg.norm(fields.slip.x.array.reshape(-1, 3), axis=1).max()
    assert found == pytest.approx(size, rel=1e-12)


def test_contact_without_friction_has_none():
    scene = pushed_cube("triangle", 3)
    (contact,) = scene.problem.contacts
    scene.problem.contacts = [replace(contact, friction=None)]
    scene.traction.value[0] = 0.0
    uh = scene.problem.solve()
    assert scene.problem.results[0].friction is None
    assert scene.problem.results[0].gather().friction is None
    fields = contact_fields(uh.function_space, scene.problem.results)
    assert fields._fields == ("pressure", "force", "gap", "opening")
    assert "stick" not in str(scene.problem.report)


def test_gathered_results_are_by_node(solved):
    contact = solved[0].results[0]
    whole = contact.gather()
    order = np.argsort(contact.nodes)
    np.testing.assert_array_equal(whole.friction.force, contact.friction.force[order])
    np.testing.assert_array_equal(whole.friction.state, contact.friction.state[order])


def test_page_has_friction(tmp_path, solved):
    problem, _ = solved
    problem.report.to_html(tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    for words in ("nodes stick", "work of friction [J]", "slip across force"):
        assert words in text


def test_deformed_surfaces_rub(solved):
    """Passes with exact non-penetration balance the load as well, with the deformed normals."""
    scene = pushed_cube("triangle", 4, 3, friction=Tresca(0.04), young=10.0, gaps=Deformed())
    scene.problem.solve()
    assert scene.problem.report.passes[-1].error <= 1e-3
    force = scene.problem.report.contacts[0].force
    np.testing.assert_allclose(force, [-0.03, 0.1], rtol=1e-6)


def test_displacements_of_degree_2():
    scene = pushed_cube("triangle", 3, 2, friction=Tresca(0.04), degree=2)
    scene.problem.solve()
    found = scene.problem.results[0].friction
    assert found.force[:, 0].sum() == pytest.approx(-0.03, rel=1e-8)
    assert 0 < np.count_nonzero(found.sticking) < found.sticking.size


@pytest.mark.parametrize("lower", [None, 2, 3], ids=["ground", "mortar", "matching"])
def test_plane_of_symmetry(lower):
    """Nothing slips across it, also where mortar conditions couple nodes in it with others."""
    law = Tresca(0.034)
    scene = pushed_cube("hexahedron", 3, lower, friction=law, push=(0.03, 0.0), symmetry=True)
    scene.problem.solve()
    contact = scene.problem.results[0]
    assert contact.friction.force[:, 0].sum() == pytest.approx(-0.03, rel=1e-8)
    inside = contact.coordinates[:, 1] < 1e-9
    assert np.count_nonzero(inside) == 4
    if lower != 2:
        np.testing.assert_allclose(contact.friction.slip[inside, 1], 0.0, atol=1e-12)
    assert 0 < np.count_nonzero(contact.friction.sticking) < 16


def test_what_is_left_of_a_problem_keeps_the_mesh_of_its_communicator(pushed):
    problem = pushed[0].problem
    result = problem.results[0]
    for comm in (problem.system.comm, problem.report.comm, result.comm):
        assert comm.mesh is problem.space.mesh

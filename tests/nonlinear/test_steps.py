"""Load steps that are cut where they fail and lengthened where they are easy; checkpoints."""

from dataclasses import replace

import numpy as np
import pytest
from finite_strains import indented_block, ironing

from fenics_tfeti import Coulomb, InputError, NotConverged, Plane

pytestmark = pytest.mark.once


def test_easy_steps_are_lengthened():
    scene = indented_block(n=4)
    assert list(scene.problem.steps(scene.set_load, 0.0, 1.0, first=0.125)) == [
        0.125,
        0.25,
        0.5,
        0.75,
        1.0,
    ]
    assert scene.problem.results[0].force[1] < -0.3


def test_steps_after_hard_ones_are_shorter():
    scene = indented_block(n=2)
    scene.problem._was_easy, scene.problem._was_hard = lambda: False, lambda: True
    loads = scene.problem.steps(scene.set_load, 0.0, 1.0, first=0.5)
    assert [next(loads) for _ in range(3)] == [0.5, 0.75, 0.875]


def test_no_rest_of_rounding_is_a_step():
    scene = indented_block(n=2)
    scene.problem._was_easy = lambda: False
    loads = list(scene.problem.steps(scene.set_load, 0.0, 1.0, first=1 / 6))
    assert len(loads) == 6
    assert loads[-1] == 1.0


def test_steps_that_fail_are_halved():
    scene = indented_block(newton_max_it=4)
    loads = list(scene.problem.steps(scene.set_load, 0.0, 1.0))
    assert loads[0] < 1.0
    assert loads[-1] == 1.0
    whole = indented_block()
    whole.solve([1.0])
    np.testing.assert_allclose(
        scene.problem.results[0].force, whole.problem.results[0].force, atol=1e-6
    )


def test_where_the_shortest_step_fails():
    scene = indented_block(n=4)
    loads, options = [], scene.problem.options

    def set_load(t):
        loads.append(t)
        scene.set_load(t)
        steps = 1 if t > 0.5 else options.newton_max_it
        scene.problem.options = replace(options, newton_max_it=steps)

    with pytest.raises(NotConverged, match="load step from 0.5 to 0.50"):
        for _ in scene.problem.steps(set_load, 0.0, 1.0, first=0.25):
            accepted = scene.problem.u.x.array.copy()
    assert loads[-1] == 0.5
    np.testing.assert_array_equal(scene.problem.u.x.array, accepted)


def test_obstacle_without_a_gap_at_the_end_of_the_step():
    """The centre of the ball would be at a node."""
    scene = indented_block(n=4, depth=0.5)
    loads = scene.problem.steps(scene.set_load, 0.0, 1.0)
    assert next(loads) == 0.5
    assert list(loads) == [1.0]
    scene = indented_block(n=4, depth=0.5)
    with pytest.raises(InputError, match="centre of the sphere"):
        list(scene.problem.steps(lambda t: scene.set_load(1.0), 0.0, 1.0))


def test_wrong_steps():
    scene = indented_block(n=4)
    for arguments in [(1.0, 1.0, None), (0.0, 1.0, 0.0), (1.0, 0.0, -0.1)]:
        begin, end, first = arguments
        with pytest.raises(InputError, match="load steps from"):
            list(scene.problem.steps(scene.set_load, begin, end, first=first))
    with pytest.raises(InputError, match="steps: set_load is a dict; a function of the load"):
        list(scene.problem.steps({"load": 1.0}, 0.0, 1.0))


def test_repeated_solve_gives_the_same():
    scene = indented_block(newton_rtol=1e-9)
    scene.solve([0.5])
    first = scene.problem.u.x.array.copy()
    scene.problem.solve()
    np.testing.assert_allclose(scene.problem.u.x.array, first, atol=1e-9)
    assert len(scene.problem.report.newton) <= 2


def test_restored_problem_goes_on(tmp_path):
    file = tmp_path / "step"
    scene = indented_block(n=4, newton_rtol=1e-9)
    scene.solve([0.5])
    scene.problem.save(file)
    scene.solve([1.0])
    other = indented_block(n=4, newton_rtol=1e-9, subdomain_size=60)
    assert other.problem.restore(file) == 1
    other.solve([1.0])
    np.testing.assert_allclose(other.problem.u.x.array, scene.problem.u.x.array, atol=1e-8)
    with pytest.raises(InputError, match="not solved yet"):
        other.problem.restore(file)


def test_restored_steps_go_on(tmp_path):
    """As many as without the interruption, as long, and to the same end."""
    file, scene = tmp_path / "step", indented_block(n=4)
    loads = []
    for t in scene.problem.steps(scene.set_load, 0.0, 1.0, first=0.125):
        loads.append(t)
        if t == 0.25:
            scene.problem.save(file)
    other, called = indented_block(n=4), []
    other.problem.restore(file)
    assert list(other.problem.steps(called.append, 0.0, 0.2)) == []
    assert called == [0.2]
    assert list(other.problem.steps(other.set_load, 0.0, 1.0, first=0.125)) == loads[2:]
    np.testing.assert_allclose(other.problem.u.x.array, scene.problem.u.x.array, atol=1e-6)
    # also where they are called with that load
    other = indented_block(n=4)
    other.problem.restore(file)
    assert list(other.problem.steps(other.set_load, 0.25, 1.0, first=0.125)) == loads[2:]
    # later steps are those that are asked for
    assert list(other.problem.steps(other.set_load, 0.0, 0.1)) == [0.1]


def test_steps_towards_smaller_loads(tmp_path):
    """They end where those towards larger ones have been, and go on from a checkpoint."""
    file, scene = tmp_path / "step", indented_block(n=4)
    scene.solve([0.5])
    u = scene.problem.u.x.array.copy()
    assert list(scene.problem.steps(scene.set_load, 0.5, 1.0)) == [1.0]
    scene.problem.save(file)
    loads = []
    for t in scene.problem.steps(scene.set_load, 1.0, 0.5, first=0.125):
        loads.append(t)
        if t == 0.875:
            scene.problem.save(tmp_path / "unloaded")
    assert loads == [0.875, 0.75, 0.5]
    np.testing.assert_allclose(scene.problem.u.x.array, u, atol=1e-5)
    other = indented_block(n=4)
    other.problem.restore(file)
    assert next(other.problem.steps(other.set_load, 1.0, 0.5, first=0.125)) == 0.875
    other = indented_block(n=4)
    other.problem.restore(tmp_path / "unloaded")
    with pytest.raises(InputError, match="another direction .* at the load 0.875 of steps to 0.5"):
        next(other.problem.steps(other.set_load, 0.5, 1.0))
    assert list(other.problem.steps(other.set_load, 1.0, 0.5)) == loads[1:]


def test_errors_of_the_user_end_steps_at_once():
    scene, loads = indented_block(n=2), []

    def set_load(t):
        loads.append(t)
        if len(loads) == 2:
            raise InputError("mine")
        if len(loads) > 2:
            scene.problem.contacts = ["floor"]

    steps = scene.problem.steps(set_load, 0.0, 1.0, first=0.1)
    next(steps)
    with pytest.raises(InputError, match="mine"):
        next(steps)
    with pytest.raises(InputError, match="contact 0 is a str"):
        next(scene.problem.steps(set_load, 0.1, 1.0))
    assert loads == [0.1, 0.2, 1.0]


def test_slip_is_counted_anew():
    """The drag of a second run is that of the first."""
    scene, forces = ironing(Coulomb(0.3), n=3, depth=0.1, newton_rtol=1e-7), []
    for _ in range(2):
        scene.problem.u.x.array[:] = 0.0
        scene.problem.reset_slip()
        scene.solve([1.0, 1.02])
        forces.append(scene.problem.results[0].force)
    np.testing.assert_allclose(forces[1], forces[0], atol=1e-6)


def test_moved_mesh_counts_slip_from_the_present_displacement():
    scene = indented_block(n=2)
    scene.solve([0.5])
    scene.problem.u.x.array[:] = 0.0
    scene.problem.space.mesh.geometry.x[:] *= 1.0 + 1e-9
    scene.problem.solve()
    assert scene.problem.u.x.array.any()
    assert not scene.problem._accepted.origin.displacement.any()


def test_list_of_contacts_that_grows_and_shrinks():
    scene = indented_block(n=2, newton_rtol=0.1)
    contacts = scene.problem.contacts
    contacts.append(replace(contacts[0], obstacle=Plane((0.0, 0.9), (0.0, -1.0))))
    scene.problem.solve()
    assert len(scene.problem.results) == 2
    scene.problem.contacts.pop(0)
    scene.problem.solve()
    assert len(scene.problem.results) == 1


def test_checkpoint_of_a_solve_that_was_cut_short(tmp_path):
    file = tmp_path / "step"
    scene = indented_block(newton_max_it=3)
    scene.set_load(0.5)
    with pytest.raises(NotConverged):
        scene.problem.solve(checkpoint=file)
    other = indented_block()
    assert other.problem.restore(file) == 0
    other.solve([0.5])
    assert len(other.problem.report.newton) <= 4


@pytest.mark.parametrize("degree", [1, 2])
def test_replaced_obstacle_near_the_deformed_surface(degree):
    """It has no value where the surface was before, and the first one touches other facets."""

    def left(x):
        return np.where(x[0] < -0.6, 0.9 - x[1], np.inf), down(x)

    def lower(x):
        return np.where(x[1] > 0.95, np.nan, 0.85 - x[1]), down(x)

    def down(x):
        return np.vstack([0.0 * x[0], -1.0 + 0.0 * x[0]])

    whole = pressed_by(Plane((0, 0.85), (0, -1)), degree)
    scene = pressed_by(left, degree)
    scene.problem.u.x.array[:] = whole.problem.u.x.array
    scene.problem.contacts = [replace(scene.problem.contacts[0], obstacle=lower)]
    scene.solve([1.0])
    np.testing.assert_allclose(
        scene.problem.results[0].force, whole.problem.results[0].force, atol=1e-7
    )


def pressed_by(obstacle, degree):
    """Return a solved block under an obstacle."""
    scene = indented_block(n=4 // degree, degree=degree, obstacle=obstacle, newton_rtol=1e-8)
    scene.solve([1.0])
    return scene

"""Laws of friction: what users may give, and the errors for what they may not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from friction_scenes import pushed_cube
from scenes import scalar_space, vector_space

from dolfinx.fem import Function

from fenics_tfeti import Coulomb, InputError, Tresca
from fenics_tfeti.io import Box, boxes


def test_number_callable_and_function_are_the_same():
    """A bound that is linear in x; nodal forces have the area of the node."""
    problem = pushed_cube("hexahedron", 2).problem
    field = Function(scalar_space(problem.space.mesh))
    field.interpolate(lambda x: 0.05 + 0.01 * x[0])
    problem.solve()
    contact, (given,) = problem.results[0], problem.contacts
    np.testing.assert_allclose(contact.friction.bound, 0.05 * contact.area, rtol=1e-14)
    assert contact.area.sum() == pytest.approx(1.0)
    for law in (Tresca(lambda x: 0.05 + 0.01 * x[0]), Tresca(field)):
        problem.contacts = [replace(given, friction=law)]
        problem.solve()
        expected = contact.area * (0.05 + 0.01 * contact.coordinates[:, 0])
        np.testing.assert_allclose(problem.results[0].friction.bound, expected, rtol=1e-12)


def test_bound_may_change_between_solves():
    scale = [0.05]
    scene = pushed_cube("triangle", 3, friction=Tresca(lambda x: np.full(x.shape[1], scale[0])))
    scene.problem.solve()
    scale[0] = 0.04
    scene.problem.solve()
    assert scene.problem.results[0].friction.bound.sum() == pytest.approx(0.04)


def on_other_mesh(scene):
    mesh = boxes(scene.problem.space.mesh.comm, [Box((0, 0), (1, 1), (1, 1))], "triangle").mesh
    return Function(scalar_space(mesh))


@pytest.mark.parametrize(
    ("friction", "message"),
    [
        (Coulomb(lambda x: -x[0]), "coefficient is negative, NaN or infinite at [0-9] points"),
        (Tresca(lambda x: x), r"returned shape \(3, 4\) for points of shape \(3, 4\)"),
        (Tresca(lambda x: x[0] - 0.5), "negative, NaN or infinite at 2 points, the first at"),
        (Tresca(lambda x: x[0] / 0.0), "slip_bound (failed|is negative, NaN or infinite)"),
        (Tresca(lambda x: 1 / 0), "slip_bound failed .* ZeroDivisionError"),
        (Tresca(lambda x: "much"), "expected an array of numbers, not str"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero", "ignore:invalid value")
def test_misuse_is_named(friction, message):
    with pytest.raises(InputError, match=message):
        pushed_cube("triangle", 3, friction=friction)


def test_functions_of_wrong_spaces():
    scene = pushed_cube("triangle", 3)
    mesh = scene.problem.space.mesh
    for given, message in (
        (on_other_mesh(scene), "Function on another mesh"),
        (Function(vector_space(mesh)), "shape .*; a scalar one"),
        (Function(scalar_space(mesh, degree=2)), "of degree 2"),
        (Function(scalar_space(mesh, "DG", 0)), "Discontinuous Lagrange elements of degree 0"),
    ):
        contact = scene.problem.contacts[0]
        changed = type(contact)(scene.tags, contact.slave, contact.obstacle, friction=Tresca(given))
        scene.problem.contacts = [changed]
        with pytest.raises(InputError, match=message):
            scene.problem.solve()

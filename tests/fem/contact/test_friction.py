"""Laws of friction: what users may give, and the errors for what they may not."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from friction_scenes import pushed_cube
from scenes import scalar_space

from dolfinx.fem import Function

from fenics_tfeti import Coulomb, InputError, Tresca
from fenics_tfeti.io import Box, boxes, displacement_space

COMM = MPI.COMM_WORLD


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
    mesh, (contact,) = scene.problem.space.mesh, scene.problem.contacts
    other = boxes(mesh.comm, [Box((0, 0), (1, 1), (1, 1))], "triangle").mesh
    for given, message in (
        (Function(scalar_space(other)), "Function on another mesh"),
        (Function(displacement_space(mesh)), "shape .*; a scalar one"),
        (Function(scalar_space(mesh, degree=2)), "of degree 2"),
        (Function(scalar_space(mesh, "DG", 0)), "Discontinuous Lagrange elements of degree 0"),
    ):
        scene.problem.contacts = [replace(contact, friction=Tresca(given))]
        with pytest.raises(InputError, match=message):
            scene.problem.solve()


CASES = {
    "ground": ("quadrilateral", 4, None),
    "matching": ("hexahedron", 3, 3),
    "mortar of triangles": ("triangle", 4, 3),
    "mortar of tetrahedra": ("tetrahedron", 3, 2),
}


def steps(case, comm, law):
    """Push, and let go by half; return the results by place after each step."""
    scene = pushed_cube(*CASES[case], friction=law, comm=comm, options={"rtol": 1e-10})
    found = []
    for part in (1.0, 0.5):
        scene.traction.value[0] = 0.03 * part
        scene.problem.solve()
        scene.problem.advance()
        contact = scene.problem.results[0].gather()
        order = np.lexsort(np.round(contact.coordinates, 9).T)
        friction = contact.friction
        found.append(
            {
                "normal force": contact.nodal_normal_force[order],
                "force": friction.force[order],
                "slip": friction.slip[order],
                "bound": friction.bound[order],
                "state": friction.state[order],
                "work": np.array([c.friction_work for c in scene.problem.report.contacts]),
            }
        )
    return found


SOLVED = [("mortar of tetrahedra", Tresca(0.037)), ("mortar of triangles", Coulomb(0.37))]
SOLVED += [
    pytest.param(case, Tresca(0.037), marks=pytest.mark.heavy) for case in ("ground", "matching")
]


@pytest.mark.ranks(2)
@pytest.mark.parametrize(("case", "law"), SOLVED)
def test_solution_does_not_depend_on_ranks(case, law):
    here, alone = steps(case, COMM, law), steps(case, MPI.COMM_SELF, law)
    sizes = {name: np.abs(values).max() for name, values in alone[0].items()}
    assert {1, 2} <= set(alone[0]["state"])
    for found, expected in zip(here, alone, strict=True):
        for name, values in expected.items():
            atol = (1e-6 if name == "work" else 1e-8) * sizes[name]
            np.testing.assert_allclose(found[name], values, rtol=0.0, atol=atol, err_msg=name)


@pytest.mark.ranks(2)
@pytest.mark.parametrize(
    ("law", "message"),
    [
        (Tresca(lambda x: x[0] - 0.01), "negative, NaN or infinite at [0-9]+ points, the first at"),
        (Tresca(lambda x: x), "returned shape|negative"),
    ],
)
def test_misuse_is_an_error_on_all_ranks(law, message):
    with pytest.raises(InputError, match=message):
        pushed_cube("triangle", 6, 5, friction=law, comm=COMM)


@pytest.mark.ranks(2)
def test_ground_carries_a_block_that_slips_everywhere():
    moved = []
    for comm in (COMM, MPI.COMM_SELF):
        law = Tresca(1e-5)
        scene = pushed_cube("quadrilateral", 3, friction=law, push=(0.0, 0.0), comm=comm)
        (given,) = scene.problem.contacts
        scene.problem.contacts = [replace(given, displacement=[0.3, 0.0])]
        scene.problem.solve()
        friction = scene.problem.results[0].gather().friction
        assert np.all(np.sum(friction.force * friction.slip, axis=1) <= 0.0)
        moved.append(np.sort(friction.slip[:, 0]))
    np.testing.assert_allclose(moved[0], moved[1], rtol=0.0, atol=1e-8)

"""Friction of contact problems on several ranks: the solution of one rank; errors on all ranks."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from friction_scenes import pushed_cube

from fenics_tfeti import Coulomb, InputError, Tresca, UnresistedMotion

COMM = MPI.COMM_WORLD
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
                "normal force": contact.normal_force[order],
                "force": friction.force[order],
                "slip": friction.slip[order],
                "bound": friction.bound[order],
                "state": friction.state[order],
                "work": np.array([c.friction_work for c in scene.problem.report.contacts]),
            }
        )
    return found


SOLVED = [(case, Tresca(0.037)) for case in CASES]
SOLVED += [(case, Coulomb(0.37)) for case in ("ground", "mortar of triangles")]


@pytest.mark.parametrize(("case", "law"), SOLVED)
def test_solution_does_not_depend_on_ranks(case, law):
    here, alone = steps(case, COMM, law), steps(case, MPI.COMM_SELF, law)
    sizes = {name: np.abs(values).max() for name, values in alone[0].items()}
    assert {1, 2} <= set(alone[0]["state"])
    for found, expected in zip(here, alone, strict=True):
        for name, values in expected.items():
            atol = (1e-6 if name == "work" else 1e-8) * sizes[name]
            np.testing.assert_allclose(found[name], values, rtol=0.0, atol=atol, err_msg=name)


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


@pytest.mark.parametrize("law", [Tresca(0.025), Coulomb(0.25)], ids=["tresca", "coulomb"])
def test_load_that_friction_cannot_hold_is_an_error_on_all_ranks(law):
    scene = pushed_cube("triangle", 6, 5, friction=law, press=0.1, comm=COMM)
    with pytest.raises(UnresistedMotion, match=r"which slides .*It would take 1\.2 times"):
        scene.problem.solve()


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

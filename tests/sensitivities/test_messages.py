"""What cannot be differentiated is told."""

import re

from mpi4py import MPI

import numpy as np
import pytest
from scenes import LOADED, pressed_block
from sensitivity_scenes import block_on_roller, blocks

import ufl
from dolfinx import fem

from fenics_tfeti import (
    Coulomb,
    Deformed,
    InputError,
    RigidBody,
    RoughContact,
    SoftContact,
    UnresistedMotion,
)


@pytest.fixture(scope="module")
def scene():
    made = blocks(n=3, m=3)
    made.solve()
    return made


def message(call, error=InputError):
    with pytest.raises(error) as raised:
        call()
    return str(raised.value)


def test_functional(scene):
    problem = scene.problem
    other = fem.Function(scene.scene.V)
    assert "does not depend on the displacement" in message(
        lambda: problem.adjoint(other[0] * ufl.dx)
    )
    v = ufl.TestFunction(scene.scene.V)
    assert "rank 1" in message(lambda: problem.adjoint(ufl.dot(problem.u, v) * ufl.dx))
    assert "3.0" in message(lambda: problem.adjoint(3.0))
    assert "there is no contact 'pin'; there are ['joint']" in message(
        lambda: problem.adjoint(forces={"pin": (0.0, 1.0)})
    )
    wrong = message(lambda: problem.adjoint(forces={"joint": (0.0, 1.0, 0.0)}))
    assert re.search(r"forces\['joint'\] has the shape \(3,\)", wrong)


def test_parameter(scene):
    adjoint = scene.problem.adjoint(scene.J)
    unknown = fem.Function(scene.scene.V, name="w")
    assert "'w' stands in no form" in message(lambda: adjoint.by(unknown))
    assert "is a float" in message(lambda: adjoint.by(1.0))
    assert "has no friction" in message(lambda: adjoint.by_slip_bound("joint"))
    assert "has no law" in message(lambda: adjoint.by_law("joint"))
    assert "rigid obstacle" in message(lambda: adjoint.by_obstacle("joint"))
    assert "no rigid body 'disc'" in message(lambda: adjoint.by_load("disc"))
    assert "'w' stands in no form" in message(lambda: scene.problem.tangent({unknown: unknown}))


def test_what_rough_contact_has_no_derivatives_by():
    law = RoughContact(lambda d: 50.0 * d.clip(0) ** 2, lambda d: 100.0 * d.clip(0))
    made = blocks(n=3, m=3, law=law)
    made.solve()
    adjoint = made.problem.adjoint(made.J)
    assert "has no law with a number" in message(lambda: adjoint.by_law("joint"))
    assert "know no law RoughContact" in message(adjoint.by_mesh)


def test_solutions_of_other_data():
    made = blocks(n=3, m=3, friction=Coulomb(0.3))
    problem = made.problem
    assert "call solve()" in message(lambda: problem.adjoint(made.J))
    made.solve()
    adjoint = problem.adjoint(made.J)
    made.E.x.array[:] *= 1.1
    assert "take them anew after solve()" in message(lambda: adjoint.by(made.E))
    assert "have changed since the last solve" in message(lambda: problem.adjoint(made.J))
    made.solve()
    problem.advance()
    assert "before it" in message(lambda: problem.adjoint(made.J))


def test_exact_gaps():
    """Motions of rigid bodies, and derivatives of one side, are those of undeformed surfaces."""
    body = RigidBody((0.45, -2.0), force=(0.0, 0.02), rotation=0.0, spring=(0.05, 0.05, 1.0))
    made = block_on_roller(body=body, gaps=Deformed())
    made.solve()
    assert "has motions of its own" in message(lambda: made.problem.adjoint(made.J))
    made = blocks(n=3, m=3, gaps=Deformed())
    made.solve()
    one_sided = message(lambda: made.problem.tangent({made.E: made.E}, one_sided=True))
    assert "one_sided with gaps=Deformed()" in one_sided


def test_laws():
    made = blocks(n=3, m=3, law=SoftContact(0.3))
    made.solve()
    assert "has no friction" in message(lambda: made.adjoint().by_elastic_slip("joint"))
    object.__setattr__(made.joint, "law", 3.0)
    assert "joint: derivatives know no law float" in message(lambda: made.problem.adjoint(made.J))


def test_motion_that_nothing_resists():
    """A block on a plane without friction, pressed down: nothing holds it sideways."""
    scene = pressed_block(MPI.COMM_SELF, "triangle")
    scene.bcs = []
    scene.add_load(LOADED, np.array([0.0, -1e6]))
    problem = scene.problem()
    problem.solve()
    text = message(lambda: problem.adjoint(problem.u[0] * scene.ds(LOADED)), UnresistedMotion)
    assert text.startswith("J changes by a motion that no closed contact and no support resists")
    assert "translation" in text

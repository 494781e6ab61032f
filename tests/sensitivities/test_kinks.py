"""Nodes that touch without a force: derivatives of one side."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from scenes import CLAMPED, GROUND, LOADED, SLAVE, Scene, at, plane, pressed_block

from dolfinx import fem

from fenics_tfeti import Coulomb, InputError, SoftContact

OPTIONS = {"rtol": 1e-12}


def touching_block(gdim_cell):
    """Return a block whose foot touches a plane without a force, and its top's displacement."""
    scene = pressed_block(MPI.COMM_SELF, gdim_cell, n=3, approach=0.0)
    up = scene.gdim - 1
    top = fem.Constant(scene.mesh, 0.0)
    scene.bcs = scene.bcs[1:]
    scene.fix(LOADED, up, top)
    problem = scene.problem(options=OPTIONS)
    problem.solve()
    return scene, problem, top


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_derivative_of_one_side(cell, sign):
    """The solution is linear on both sides of the kink."""
    scene, problem, top = touching_block(cell)
    nodes = problem.results[0].nodes.size
    tangent = problem.tangent({top: sign}, one_sided=True, rtol=1e-12)
    assert tangent.kinks == {problem.report.contacts[0].name: (nodes, 0)}
    u, force = tangent.u.x.array.copy(), tangent.nodal_normal_force(0)
    top.value = 1e-3 * sign
    exact = problem.solve().x.array / 1e-3
    assert u == pytest.approx(exact, abs=1e-6 * np.abs(exact).max())
    scale = max(np.abs(force).max(), 1.0)
    assert force == pytest.approx(problem.results[0].nodal_normal_force / 1e-3, abs=1e-6 * scale)


def test_by_default_nodes_that_touch_open():
    scene, problem, top = touching_block("triangle")
    tangent = problem.tangent({top: -1.0}, rtol=1e-12)
    assert not tangent.nodal_normal_force(0).any()


def test_one_sided_with_a_law():
    scene, _, top = touching_block("triangle")
    scene.contacts[0] = replace(scene.contacts[0], law=SoftContact(1e9))
    problem = scene.problem(options=OPTIONS)
    problem.solve()
    with pytest.raises(InputError, match="one_sided with a law of an interface"):
        problem.tangent({top: 1.0}, one_sided=True)


def test_one_sided_with_sites_that_slip():
    """A block that slips by Coulomb's law beside one that touches without a force."""
    boxes = [((x, 0.0), (x + 1.0, 1.0), (2, 2)) for x in (0.0, 2.0)]
    marks = [(GROUND, at(1, 0.0), 1), (SLAVE, at(1, 0.0), 2)]
    marks += [(LOADED, at(1, 1.0), 1), (CLAMPED, at(1, 1.0), 2)]
    scene = Scene.of_boxes(MPI.COMM_SELF, "triangle", boxes, marks)
    scene.add_obstacle(GROUND, plane(1, 2), friction=Coulomb(0.1))
    scene.add_obstacle(SLAVE, plane(1, 2))
    top = fem.Constant(scene.mesh, np.array([1e-3, -1e-3]))
    scene.fix(CLAMPED)
    scene.fix(LOADED, value=top)
    problem = scene.problem(options=OPTIONS)
    problem.solve()
    assert not problem.results[0].friction.sticking.any()
    with pytest.raises(InputError, match="one_sided with sites that slip by Coulomb's law"):
        problem.tangent({top: (1.0, 0.0)}, one_sided=True)

"""Contact problems on a tape of dolfinx-adjoint, where that is installed."""

from functools import partial

import numpy as np
import pytest
import scenes
from scenes import at, strain, stress

import ufl
from dolfinx import fem

from fenics_tfeti import Coulomb, Deformed, InputError, NonlinearContactProblem, Plane, tape
from fenics_tfeti.models import neo_hookean

pyadjoint = pytest.importorskip("pyadjoint")
dolfinx_adjoint = pytest.importorskip("dolfinx_adjoint")

GROUND, TOP = 1, 2


class Pressed:
    """A block that its top presses onto a plane, with data of dolfinx-adjoint."""

    def __init__(self, kind, has_overloaded_support=False, **arguments):
        marks = [(GROUND, at(1, 0.0)), (TOP, at(1, 1.0))]
        box = (0.0, 0.0), (1.0, 1.0), (4, 4)
        self.scene = scene = scenes.Scene.of_boxes(scenes.MPI.COMM_WORLD, "triangle", [box], marks)
        mesh, V = scene.mesh, scene.V
        scene.cell_tags = None
        plane = Plane((0.3, -0.002), (0.05, 1.0))
        scene.add_obstacle(GROUND, plane, friction=Coulomb(0.2), name="floor")
        self.E = dolfinx_adjoint.Function(scenes.scalar_space(mesh, "DG", 0), name="E")
        self.E.interpolate(lambda x: 1.0 + 0.2 * np.sin(3 * x[0]))
        self.force = dolfinx_adjoint.Function(V, name="b")
        self.force.interpolate(lambda x: np.stack([2e-2 * x[1], -1e-2 * x[0]]))
        self.top = dolfinx_adjoint.Function(V, name="top")
        self.top.interpolate(lambda x: np.stack([0 * x[0] + 0.02, -0.05 + 0.01 * x[0]]))
        mesh.topology.create_connectivity(1, 2)
        dofs = fem.locate_dofs_topological(V, 1, scene.facet_tags.find(TOP))
        if has_overloaded_support:
            self.support = dolfinx_adjoint.dirichletbc(self.top, dofs)
            # what it interpolates its value into
            self.top = self.support.g
        else:
            self.support = fem.dirichletbc(self.top, dofs)
        bcs = [self.support]
        a = ufl.inner(stress(scene.u, self.E, strain=strain), strain(scene.v)) * ufl.dx
        self.pull = dolfinx_adjoint.Constant(mesh, (1e-3, -2e-3))
        L = ufl.dot(self.force + self.pull, scene.v) * ufl.dx
        given = {"bcs": bcs, "contacts": scene.contacts, **arguments}
        if kind == "finite":
            u = fem.Function(V)
            F = ufl.derivative(neo_hookean(self.E, 0.3)(u) * ufl.dx, u, scene.v) - L
            self.problem = NonlinearContactProblem(F, u, **given, options={"newton_rtol": 1e-11})
        else:
            self.problem = scenes.ContactProblem(a, L, **given, options={"rtol": 1e-12})

    def J(self, u):
        return dolfinx_adjoint.assemble_scalar((u[0] ** 2 + 3 * u[1] ** 2) * self.E * ufl.dx)


KINDS = {
    "small": partial(Pressed, "small"),
    "exact gaps": partial(Pressed, "small", gaps=Deformed(1e-11, 40)),
    "finite": partial(Pressed, "finite"),
    "overloaded support": partial(Pressed, "small", has_overloaded_support=True),
}


@pytest.fixture(autouse=True)
def working_tape():
    # annotation goes on for other tests of the process as it was
    with pyadjoint.set_working_tape() as own:
        is_on = pyadjoint.annotate_tape()
        pyadjoint.continue_annotation()
        yield own
        if not is_on:
            pyadjoint.pause_annotation()


def check(J, m, size=0.01):
    """By pyadjoint's own test: remainders of second order, and the tangent's slope is the same."""
    reduced = pyadjoint.ReducedFunctional(J, pyadjoint.Control(m))
    h, start = (m._ad_new_like() for _ in range(2))
    h.x.array[:] = size * np.sin(1.0 + np.arange(h.x.array.size))
    h.x.scatter_forward()
    start.x.array[:] = m.x.array
    assert pyadjoint.taylor_test(reduced, start, h) == pytest.approx(2.0, abs=0.05)
    reduced(start)
    slope = reduced.derivative()._ad_dot(h)
    assert reduced.tlm(h) == pytest.approx(slope, rel=1e-7)


@pytest.mark.ranks
@pytest.mark.parametrize("name", ["E", "force", "pull", "top"])
@pytest.mark.parametrize("kind", KINDS)
def test_taylor(kind, name):
    scene = KINDS[kind]()
    check(scene.J(tape.solve(scene.problem, [scene.top])), getattr(scene, name))


def test_two_solves_of_a_problem():
    """The second one with the displacement of the first as its load."""
    scene = KINDS["small"]()
    first = tape.solve(scene.problem)
    dolfinx_adjoint.assign(first, scene.force)
    check(scene.J(tape.solve(scene.problem)), scene.E)


def test_beside_another_problem():
    """A load that a linear problem of dolfinx-adjoint has found; values are given back."""
    scene = KINDS["small"]()
    V, v = scene.scene.V, scene.scene.v
    source = dolfinx_adjoint.Function(V)
    source.x.array[:] = 1e-2
    a = ufl.inner(scene.scene.u, v) * ufl.dx
    direct = {"ksp_type": "preonly", "pc_type": "lu"}
    mass = dolfinx_adjoint.LinearProblem(
        a,
        ufl.inner(source * scene.E, v) * ufl.dx,
        u=scene.force,
        **dict.fromkeys(("petsc_options", "adjoint_petsc_options", "tlm_petsc_options"), direct),
    )
    mass.solve()
    values = scene.E.x.array.copy()
    check(scene.J(tape.solve(scene.problem)), scene.E, size=0.1)
    assert np.array_equal(scene.E.x.array, values)


def test_nothing_on_the_tape():
    problem = scenes.pressed_block(scenes.MPI.COMM_WORLD, "triangle").problem()
    with pytest.raises(InputError, match="nothing in the problem is on a tape"):
        tape.solve(problem)

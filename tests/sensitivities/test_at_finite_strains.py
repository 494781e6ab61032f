"""Changes of solutions with finite strains: remainders along changes of data are quadratic."""

from dataclasses import replace
from functools import cache, partial
from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from scenes import at

import ufl
from dolfinx import fem

from fenics_tfeti import Coulomb, InputError, NonlinearContactProblem, Plane, RigidBody, Sphere
from fenics_tfeti.models import neo_hookean

pytestmark = pytest.mark.once

BASE, FOOT, ROOF, TOP = 1, 2, 3, 4
COMM = MPI.COMM_WORLD


class Pressed:
    """A rubber block that its top presses on another one, or on an obstacle, and moves aside."""

    def __init__(self, below, dim=2, friction=None, comm=COMM, **options):
        up = dim - 1
        low, high, step = np.zeros(dim), np.ones(dim), 1.02 * np.eye(dim)[up]
        high[up] = 0.6
        parts, marks = [(low + step, high + step, (4,) * dim)], []
        if below == "block":
            parts.insert(
                0, (low + 0.42 * np.eye(dim)[up] - 0.1, high + 0.42 * step / 1.02, (5,) * dim)
            )
            parts[0][0][up], parts[0][1][up] = 0.42, 1.02
            parts[0][1][:up] += 0.1
            marks = [(BASE, at(up, 0.42), 1), (ROOF, at(up, 1.02), 1)]
        number = len(parts)
        marks += [(FOOT, at(up, 1.02), number), (TOP, at(up, 1.62), number)]
        self.scene = scene = scenes.Scene.of_boxes(
            comm, {2: "quadrilateral", 3: "hexahedron"}[dim], parts, marks
        )
        if below == "block":
            scene.fix(BASE)
            scene.add_pair(FOOT, ROOF, friction=friction, name="joint")
        else:
            scene.add_obstacle(FOOT, below, friction=friction, name="joint")
        self.E, self.pull = scene.constant(1.0), scene.constant(np.array([0.02, -0.01, 0.01][:dim]))
        self.moved = fem.Constant(scene.mesh, np.array([0.05, -0.08, 0.02][:dim])[[0, -1, 1][:dim]])
        facet = scene.mesh.topology.dim - 1
        scene.mesh.topology.create_connectivity(facet, facet + 1)
        dofs = fem.locate_dofs_topological(scene.V, facet, scene.facet_tags.find(TOP))
        bcs = [*scene.bcs, fem.dirichletbc(self.moved, dofs, scene.V)]
        self.u = u = fem.Function(scene.V)
        energy = neo_hookean(self.E, 0.3)(u) - ufl.dot(self.pull, u)
        self.problem = NonlinearContactProblem(
            ufl.derivative(energy * ufl.dx, u, scene.v),
            u,
            bcs=bcs,
            contacts=scene.contacts,
            options={"newton_rtol": 1e-11, **options},
        )

    def parameter(self, name):
        """A parameter, and a direction."""
        m = {"stiffness": self.E, "load": self.pull, "support": self.moved}[name]
        return m, 0.1 * np.ones(m.value.shape) * (
            1.0 if m is self.E else np.cos(np.arange(m.value.size))
        )

    @property
    def J(self):
        """A form with squares of displacements."""
        u, dim = self.u, self.scene.gdim
        return (u[0] ** 2 + 3 * u[dim - 1] ** 2 + u[0] * u[dim - 1]) * self.E * ufl.dx

    def value(self):
        """J, the sum of squares of normal forces, and a component of the force."""
        result, up = self.problem.results["joint"], np.eye(self.scene.gdim)[-1]
        squares = 0.5 * float(result.nodal_normal_force @ result.nodal_normal_force)
        of_form = fem.assemble_scalar(fem.form(self.J)) + squares
        return self.scene.mesh.comm.allreduce(of_form) + result.force @ (
            up + 0.5 * np.eye(up.size)[0]
        )

    def adjoint(self, rtol=1e-12):
        """That of the value."""
        weights = {"joint": self.problem.results["joint"].nodal_normal_force}
        up = np.eye(self.scene.gdim)[-1]
        forces = {"joint": up + 0.5 * np.eye(up.size)[0]}
        return self.problem.adjoint(self.J, forces=forces, normal_forces=weights, rtol=rtol)

    def remainders(self, name):
        """Those of displacements, normal forces and the value for two steps, one half of the other."""
        problem, (m, dm) = self.problem, self.parameter(name)
        problem.solve()
        tangent = problem.tangent({m: dm}, rtol=1e-10)
        u, force = self.u.x.array.copy(), problem.results["joint"].nodal_normal_force.copy()
        du, df = tangent.u.x.array.copy(), tangent.nodal_normal_force("joint")
        value, slope = self.value(), np.sum(self.adjoint(1e-10).by(m) * dm)
        first, found = m.value.copy(), []
        for h in (2e-3, 1e-3):
            m.value = first + h * dm
            problem.solve()
            now = problem.results["joint"].nodal_normal_force
            assert np.array_equal(now > 0.0, force > 0.0), "the set in contact"
            errors = (self.u.x.array - u - h * du, now - force - h * df)
            largest = [COMM.allreduce(np.abs(e).max(initial=0.0), MPI.MAX) for e in errors]
            found.append([*largest, abs(self.value() - value - h * slope)])
        m.value = first
        return np.array(found)


def plane(dim):
    return Plane(1.01 * np.eye(dim)[-1], np.eye(dim)[-1])


KINDS = {
    "plane": partial(Pressed, plane(2)),
    "ball": partial(Pressed, Sphere((0.45, 0.01), 1.0)),
    "mortar": partial(Pressed, "block"),
    "mortar, Coulomb": partial(Pressed, "block", friction=Coulomb(0.3)),
    "plane, Coulomb": partial(Pressed, plane(2), friction=Coulomb(0.2)),
    "3D ball": partial(Pressed, Sphere((0.45, 0.5, 0.01), 1.0), 3),
    "3D ball, Coulomb": partial(Pressed, Sphere((0.45, 0.5, 0.01), 1.0), 3, Coulomb(0.1)),
    "3D mortar": partial(Pressed, "block", 3),
}


@cache
def posed(kind):
    return KINDS[kind]()


NAMES = ("stiffness", "load", "support")
ON_RANKS = ("mortar, Coulomb", "support")


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        pytest.param(*case, marks=[pytest.mark.ranks] if case == ON_RANKS else [])
        for case in product(KINDS, NAMES)
    ],
)
def test_remainders_are_of_second_order(kind, name):
    """Also of forces, but those that are linear in the stiffness, to rounding."""
    first, second = posed(kind).remainders(name)
    rates = np.log2(first / second)
    print(kind, name, rates, "with the same nodes in contact")
    assert np.all((second < 1e-12) | (rates > 1.95) & (rates < 2.05))


def test_no_factor_is_made_anew():
    """With the set-up of the last Newton step, where the same conditions hold."""
    problem = posed("mortar").problem
    problem.solve()
    solver = problem._solver
    assert problem.tangent({posed("mortar").E: 1.0}).products > 0
    assert problem._solver is solver


def changed(scene):
    scene.E.value *= 1.5


def accepted(scene):
    scene.problem.advance()


@pytest.mark.parametrize(
    ("spoil", "data", "message"),
    [
        (changed, lambda s: {s.E: 1.0}, "have changed since the last solve"),
        (accepted, lambda s: {s.E: 1.0}, "call solve\\(\\), and let it end"),
        (lambda s: None, lambda s: {fem.Constant(s.scene.mesh, 1.0): 1.0}, "stands in no form"),
        (lambda s: None, lambda s: {"E": 1.0}, "the parameter is a str"),
    ],
)
def test_mistakes(spoil, data, message):
    scene = Pressed(plane(2), comm=MPI.COMM_SELF)
    scene.problem.solve()
    spoil(scene)
    with pytest.raises(InputError, match=message):
        scene.problem.tangent(data(scene))


def test_bodies_with_motions_of_their_own_are_refused():
    scene = Pressed(plane(2), comm=MPI.COMM_SELF)
    body = RigidBody((0.0, 0.0), translation=(0.0, 0.0), rotation=0.0, name="table")
    scene.problem.contacts[0] = replace(scene.problem.contacts[0], rigid_body=body)
    scene.problem.solve()
    with pytest.raises(InputError, match="table has motions of its own"):
        scene.problem.tangent({scene.E: 1.0})

"""Derivatives with finite strains: remainders along changes of data are quadratic."""

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

from fenics_tfeti import (
    Coulomb,
    InputError,
    NonlinearContactProblem,
    Plane,
    RigidBody,
    Sphere,
    TiedPair,
    Tresca,
)
from fenics_tfeti.fem.displacement import owned_values
from fenics_tfeti.models import follower_pressure, neo_hookean
from fenics_tfeti.sensitivities.forms import node_changes, places_space

pytestmark = pytest.mark.once

BASE, FOOT, ROOF, TOP, SIDE, JOINED, GLUED = range(1, 8)
COMM = MPI.COMM_WORLD


class Pressed:
    """A rubber block that its top presses on another one, or on an obstacle, and moves aside."""

    def __init__(self, below, dim=2, friction=None, comm=COMM, degree=1, squeeze=0.0, tied=False):
        up = dim - 1
        heights = {"base": (0.42, 1.02), "block": (1.02, 1.62), "cap": (1.62, 1.92)}
        # the lower block is wider, unless it is meshed alike
        wider = 0.0 if below == "alike" else 0.1
        bodies = [("base", 5 if wider else 4, wider)] if below in ("block", "alike") else []
        bodies += [("block", 4, 0.0), *([("cap", 3, 0.0)] if tied else [])]
        number, up = {name: k + 1 for k, (name, *_) in enumerate(bodies)}, dim - 1
        parts = [
            ([*[-more] * up, heights[name][0]], [*[1.0 + more] * up, heights[name][1]], (n,) * dim)
            for name, n, more in bodies
        ]
        marks = [(FOOT, at(up, 1.02), number["block"]), (SIDE, at(0, 0.0), number["block"])]
        if "base" in number:
            marks += [(BASE, at(up, 0.42), 1), (ROOF, at(up, 1.02), 1)]
        if tied:
            marks += [(JOINED, at(up, 1.62), number["block"]), (GLUED, at(up, 1.62), number["cap"])]
        marks.append((TOP, at(up, 1.92 if tied else 1.62), len(bodies)))
        self.scene = scene = scenes.Scene.of_boxes(
            comm, {2: "quadrilateral", 3: "hexahedron"}[dim], parts, marks, degree=degree
        )
        if "base" in number:
            scene.fix(BASE)
            scene.add_pair(FOOT, ROOF, friction=friction, name="joint")
        else:
            scene.add_obstacle(FOOT, below, friction=friction, name="joint")
        if tied:
            scene.contacts.append(TiedPair(scene.facet_tags, GLUED, JOINED, name="tie"))
        self.E, self.pull = scene.constant(1.0), scene.constant(np.array([0.02, -0.01, 0.01][:dim]))
        self.moved = fem.Constant(scene.mesh, np.array([0.05, -0.08, 0.02][:dim])[[0, -1, 1][:dim]])
        facet = scene.mesh.topology.dim - 1
        scene.mesh.topology.create_connectivity(facet, facet + 1)
        dofs = fem.locate_dofs_topological(scene.V, facet, scene.facet_tags.find(TOP))
        bcs = [*scene.bcs, fem.dirichletbc(self.moved, dofs, scene.V)]
        self.u = u = fem.Function(scene.V)
        energy = neo_hookean(self.E, 0.3)(u) - ufl.dot(self.pull, u)
        F = ufl.derivative(energy * ufl.dx, u, scene.v)
        if squeeze:
            F += follower_pressure(fem.Constant(scene.mesh, squeeze), u, scene.ds(SIDE))
        self.problem = NonlinearContactProblem(
            F,
            u,
            bcs=bcs,
            contacts=scene.contacts,
            options={"newton_rtol": 1e-11},
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
        """Of displacements, normal forces and the value, for two steps, one half of the other."""
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
    "mortar that slips": partial(Pressed, "block", friction=Coulomb(0.1)),
    "mortar, Tresca": partial(Pressed, "block", friction=Tresca(0.02)),
    "pairs of nodes": partial(Pressed, "alike", friction=Coulomb(0.1)),
    "mortar, degree 2": partial(Pressed, "block", degree=2),
    "plane, tied": partial(Pressed, plane(2), tied=True),
    "plane, pressure that follows": partial(Pressed, plane(2), squeeze=0.1),
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
QUICK = ("ball", "mortar that slips", "3D ball")


def marks(kind, name):
    """Of the others most are for the long run."""
    if (kind, name) == ON_RANKS:
        return [pytest.mark.ranks]
    return [] if kind in QUICK or name == "support" and "3D" not in kind else [pytest.mark.heavy]


@pytest.mark.parametrize(
    ("kind", "name"), [pytest.param(*case, marks=marks(*case)) for case in product(KINDS, NAMES)]
)
def test_remainders_are_of_second_order(kind, name):
    """Also of forces, except where they are linear in the stiffness, to rounding."""
    first, second = posed(kind).remainders(name)
    rates = np.log2(first / second)
    print(kind, name, rates, "with the same nodes in contact")
    assert np.all((second < 1e-12) | (rates > 1.95) & (rates < 2.05))


def change(scene, tangent):
    """What the value changes by along a tangent, but by its own data."""
    result, u = scene.problem.results["joint"], scene.u
    along = fem.assemble_scalar(fem.form(ufl.derivative(scene.J, u, tangent.u)))
    of_forces = result.nodal_normal_force @ tangent.nodal_normal_force("joint")
    return scene.scene.mesh.comm.allreduce(along + of_forces)


@pytest.mark.parametrize("name", ["load", "support"])
@pytest.mark.parametrize(
    "kind",
    [pytest.param(k, marks=[pytest.mark.heavy] * (k not in QUICK and "3D" in k)) for k in KINDS],
)
def test_tangent_is_the_transposed_adjoint(kind, name):
    scene = posed(kind)
    scene.problem.solve()
    m, dm = scene.parameter(name)
    weights = {"joint": scene.problem.results["joint"].nodal_normal_force}
    adjoint = scene.problem.adjoint(scene.J, normal_forces=weights, rtol=1e-12)
    slope = np.sum(adjoint.by(m) * dm)
    tangent = scene.problem.tangent({m: dm}, rtol=1e-12)
    assert change(scene, tangent) == pytest.approx(slope, rel=1e-10)


@pytest.mark.ranks
@pytest.mark.parametrize("kind", ["mortar that slips", "plane, tied"])
def test_as_on_one_rank(kind):
    slopes = []
    for comm in (COMM, MPI.COMM_SELF):
        scene = KINDS[kind](comm=comm)
        scene.problem.solve()
        adjoint = scene.adjoint()
        slopes.append([np.sum(adjoint.by(m) * dm) for m, dm in map(scene.parameter, NAMES)])
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-9)


@pytest.mark.parametrize("kind", ["mortar", "3D ball, Coulomb"])
def test_no_factor_is_made_anew(kind):
    """With the set-up of the last Newton step, where the same conditions hold."""
    problem = posed(kind).problem
    problem.solve()
    solver = problem._solver
    assert problem.tangent({posed(kind).E: 1.0}).products > 0
    assert posed(kind).adjoint().products > 0
    assert problem._solver is solver


def difference(scene, change, h=1e-4):
    """That of the value by a change of data, of solves from no displacement."""
    values = []
    for s in (h, -h, 0.0):
        change(s)
        scene.u.x.array[:] = 0.0
        scene.problem.solve()
        values.append(scene.value())
    return (values[0] - values[1]) / (2 * h)


@pytest.mark.parametrize("kind", ["ball", "mortar that slips", "plane, tied", "3D ball"])
def test_by_mesh(kind):
    """Along a direction, and by all nodes."""
    scene = KINDS[kind]()
    mesh, up = scene.scene.mesh, scene.scene.gdim - 1
    along = fem.Function(places_space(mesh))
    along.interpolate(
        lambda x: np.stack([*[0.1 * np.sin(3 * x[0] + x[1])] * up, 0.05 * np.cos(3 * x[0]) * x[up]])
    )
    x, moves = mesh.geometry.x.copy(), node_changes(along, mesh)

    def change(s):
        mesh.geometry.x[:] = x + s * moves

    expected = difference(scene, change)
    adjoint = scene.adjoint()
    assert adjoint.by_mesh(along) == pytest.approx(expected, rel=1e-6)
    gradient = owned_values(adjoint.by_mesh())
    assert gradient @ owned_values(along) == pytest.approx(expected, rel=1e-6)


CONTACTS = {
    "obstacle": (
        "ball",
        lambda joint, s: replace(joint, obstacle=Sphere((0.45 + s, 0.01), 1.0 + 0.5 * s)),
    ),
    "gap": ("plane", lambda joint, s: replace(joint, obstacle=Plane((0.0, 1.01 - s), (0.0, 1.0)))),
    "coefficient": (
        "mortar that slips",
        lambda joint, s: replace(joint, friction=Coulomb(0.1 + s)),
    ),
    "bound": ("mortar, Tresca", lambda joint, s: replace(joint, friction=Tresca(0.02 + s))),
}


@pytest.mark.parametrize("name", CONTACTS)
def test_data_of_contacts(name):
    kind, changed = CONTACTS[name]
    scene = KINDS[kind]()
    joint = scene.problem.contacts[0]

    def change(s):
        scene.problem.contacts = [changed(joint, s) if s else joint]

    expected = difference(scene, change)
    adjoint = scene.adjoint()
    slope = {
        "obstacle": lambda: adjoint.by_obstacle("joint", partial(changed, joint)),
        "gap": lambda: adjoint.by_gap("joint").sum(),
        "coefficient": lambda: adjoint.by_coefficient("joint").sum(),
        "bound": lambda: adjoint.by_slip_bound("joint").sum(),
    }[name]()
    assert slope == pytest.approx(expected, rel=1e-6)


def changed(scene):
    scene.E.value *= 1.5


def moved(scene):
    scene.moved.value[0] += 1e-3


def accepted(scene):
    scene.problem.advance()


@pytest.mark.parametrize(
    ("spoil", "data", "message"),
    [
        (changed, lambda s: {s.E: 1.0}, "have changed since the last solve"),
        (moved, lambda s: {s.E: 1.0}, "have changed since the last solve"),
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


def test_mistakes_of_adjoints():
    scene = Pressed(plane(2), comm=MPI.COMM_SELF)
    scene.problem.solve()
    with pytest.raises(InputError, match="does not depend on the displacement"):
        scene.problem.adjoint(scene.E * ufl.dx)
    adjoint = scene.adjoint()
    with pytest.raises(InputError, match="stands in no form"):
        adjoint.by(fem.Constant(scene.scene.mesh, 1.0))
    changed(scene)
    with pytest.raises(InputError, match="take them anew after solve"):
        adjoint.by(scene.E)


def test_bodies_with_motions_of_their_own_are_refused():
    scene = Pressed(plane(2), comm=MPI.COMM_SELF)
    body = RigidBody((0.0, 0.0), translation=(0.0, 0.0), rotation=0.0, name="table")
    scene.problem.contacts[0] = replace(scene.problem.contacts[0], rigid_body=body)
    scene.problem.solve()
    with pytest.raises(InputError, match="table has motions of its own"):
        scene.problem.tangent({scene.E: 1.0})

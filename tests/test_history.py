"""What is kept from step to step belongs to a contact, not to its place; errors change nothing."""

from dataclasses import replace
from functools import cache

from mpi4py import MPI

import numpy as np
import pytest
from scenes import Scene, at

import ufl
from dolfinx import fem

from fenics_tfeti import (
    ContactPair,
    ContactProblem,
    Coulomb,
    Deformed,
    InputError,
    NonlinearContactProblem,
    NotConverged,
    Plane,
    RigidBody,
    RigidObstacle,
    Sphere,
)
from fenics_tfeti.models import neo_hookean

pytestmark = pytest.mark.once

SIDE, BOTTOM, TOP = 1, 2, 3
COMM = MPI.COMM_WORLD
NAMED, UNNAMED = ("floor", "lid"), ("", "")


def away(height):
    """Return where facets at a height are away from the side that is held."""
    return lambda x: np.isclose(x[1], height) & (x[0] > 0.4)


class PressedBlock:
    """A block, held at one side, between two obstacles that press it and drag it by friction."""

    def __init__(self, kind, moved_by="functions", names=UNNAMED):
        marks = [(SIDE, at(0, 0.0)), (BOTTOM, away(0.0)), (TOP, away(1.0))]
        self.travel = {BOTTOM: 0.0, TOP: 0.0}
        self.bodies, self.contacts = {}, []
        scene = Scene.of_boxes(COMM, "quadrilateral", [((0, 0), (2, 1), (4, 2))], marks, young=1.0)
        scene.fix(SIDE)
        for name, tag, sign in zip(names, (BOTTOM, TOP), (1.0, -1.0), strict=True):
            self.contacts.append(self.obstacle(scene.facet_tags, name, tag, sign, moved_by))
        data = {"bcs": scene.bcs, "contacts": self.contacts, "cell_tags": scene.cell_tags}
        if kind == "nonlinear":
            u = fem.Function(scene.V)
            F = ufl.derivative(neo_hookean(1.0, 0.3)(u) * ufl.dx(degree=2), u, scene.v)
            options = {"newton_rtol": 1e-6, "rtol": 1e-6}
            self.problem = NonlinearContactProblem(F, u, options=options, **data)
        else:
            gaps = Deformed(1e-7) if kind == "exact" else None
            data |= {"gaps": gaps, "options": {"rtol": 1e-8}}
            self.problem = ContactProblem(scene.a, scene.L, **data)

    def obstacle(self, tags, name, tag, sign, moved_by):
        """Return a plane that overlaps the block by 0.02."""
        plane = Plane((0.0, (1.0 - sign) / 2.0 + 0.02 * sign), (0.0, sign))
        more = {"name": name, "friction": Coulomb(0.4)}
        if moved_by == "functions":
            more["displacement"] = lambda x: np.array([[self.travel[tag]], [0.0]]) + 0.0 * x[:2]
        else:
            self.bodies[tag] = [0.0, 0.0]
            more["rigid_body"] = RigidBody((0.0, 0.0), translation=self.bodies[tag], rotation=0.0)
        return RigidObstacle(tags, tag, plane, **more)

    def move(self, bottom, top):
        """Move the obstacles so far."""
        for tag, travel in zip((BOTTOM, TOP), (bottom, top), strict=True):
            self.travel[tag] = travel
            if tag in self.bodies:
                self.bodies[tag][0] = travel

    def step(self, bottom, top):
        """Solve with the obstacles moved so far; return forces and slips by surface."""
        self.move(bottom, top)
        self.problem.solve()
        found = {BOTTOM: np.zeros(4), TOP: np.zeros(4)}
        for contact, result in zip(self.problem.contacts, self.problem.results, strict=True):
            slip = result.gather().friction.slip.sum(axis=0)
            found[contact.slave] += np.append(result.force, slip)
        return np.concatenate([found[BOTTOM], found[TOP]])


@cache
def whole(kind, moved_by):
    """Return forces and slips of a second step, of which nothing is interrupted or exchanged."""
    block = PressedBlock(kind, moved_by)
    block.step(0.01, -0.02)
    block.problem.advance()
    return block.step(0.03, -0.03)


def swapped(contacts, how):
    """Return contacts in another order: the same objects, or others in their place."""
    return [replace(c) if how == "others" else c for c in reversed(contacts)]


@pytest.mark.parametrize(
    ("kind", "moved_by", "how", "names"),
    [
        ("linear", "functions", "same", NAMED),
        ("linear", "functions", "others", UNNAMED),
        pytest.param("linear", "bodies", "restored", UNNAMED, marks=pytest.mark.ranks),
        ("exact", "functions", "restored", UNNAMED),
        ("exact", "bodies", "same", NAMED),
        ("nonlinear", "functions", "others", NAMED),
        ("nonlinear", "functions", "restored", UNNAMED),
        ("nonlinear", "bodies", "same", UNNAMED),
        ("nonlinear", "bodies", "restored", NAMED),
    ],
)
def test_history_of_a_contact_does_not_depend_on_its_place(
    kind, moved_by, how, names, shared_folder
):
    expected, other = whole(kind, moved_by), PressedBlock(kind, moved_by, names)
    other.step(0.01, -0.02)
    other.problem.advance()
    if how == "restored":
        other.problem.save(shared_folder / "step")
        other = PressedBlock(kind, moved_by, names)
        other.problem.contacts = swapped(other.problem.contacts, "same")
        assert other.problem.restore(shared_folder / "step") == 1
    else:
        other.problem.contacts = swapped(other.problem.contacts, how)
    np.testing.assert_allclose(other.step(0.03, -0.03), expected, atol=1e-5)
    assert np.abs(expected).max() > 1e-3


def test_contact_that_is_left_out_for_a_solve_keeps_its_history():
    """Names tell what contacts at one surface are, without them the objects do."""
    forces = []
    for names in (UNNAMED, ("left", "right")):
        block = PressedBlock("linear")
        floor, lid = block.contacts
        left, right = (half_of(floor, *half) for half in zip(names, (False, True), strict=True))
        block.problem.contacts = [left, right, lid]
        block.step(0.01, -0.02)
        block.problem.advance()
        for contacts in ([right, lid], [left, right, lid]):
            block.problem.contacts = contacts
            forces.append(block.step(0.03, -0.03))
    np.testing.assert_allclose(forces[:2], forces[2:], atol=1e-5)


def half_of(contact, name, is_right):
    """Return a contact with a half of its obstacle, which moves by another distance."""

    def obstacle(x):
        gap, normal = contact.obstacle(x)
        return np.where((x[0] > 1.2) == is_right, gap, np.inf), normal

    def displacement(x):
        return (2.0 if is_right else 1.0) * contact.displacement(x)

    return replace(contact, name=name, obstacle=obstacle, displacement=displacement)


@pytest.mark.parametrize("kind", ["linear", "nonlinear"])
def test_checkpoints_of_other_problems(kind, tmp_path):
    written, path = PressedBlock(kind, names=NAMED), tmp_path / "step"
    written.step(0.01, 0.0)
    written.problem.save(path)
    other = PressedBlock({"linear": "nonlinear", "nonlinear": "linear"}[kind])
    with pytest.raises(InputError, match=r"kinds differ: it has \w*ContactProblem, this problem"):
        other.problem.restore(path)
    renamed = PressedBlock(kind, names=("floor", "roof"))
    with pytest.raises(InputError, match="contacts differ: it has RigidObstacle 'floor', Rigid"):
        renamed.problem.restore(path)


def test_kept_conditions_do_not_depend_on_the_place():
    """The second solve starts where the first one has ended."""
    block = PressedBlock("exact")
    problem, without = block.problem, {"friction": None, "displacement": None}
    curved = replace(block.contacts[0], obstacle=Sphere((1.05, -0.95), 1.0), **without)
    problem.contacts = [curved, replace(block.contacts[1], **without)]
    problem.solve()
    first = len(problem.report.passes)
    problem.contacts = swapped(problem.contacts, "same")
    problem.solve()
    assert len(problem.report.passes) == 1 < first


# -- errors leave no trace ------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [pytest.param("linear", marks=pytest.mark.ranks), "nonlinear"])
@pytest.mark.parametrize("is_moved", [False, True], ids=["still", "moved"])
def test_contacts_that_are_refused_are_refused_again(kind, is_moved):
    """Also by steps, which solve several times; after them the problem is as it was before."""
    block, alone = PressedBlock(kind), PressedBlock(kind)
    for each in (block, alone):
        each.step(0.01, -0.02)
        if is_moved:
            each.problem.space.mesh.geometry.x[:, 0] *= 1.1
    problem, u = block.problem, block.problem.u.x.array.copy()
    # at finite strains surfaces that face nothing may meet later
    slave, message = (
        (TOP, "no facet of the slave") if kind == "linear" else (99, "tag 99 is on no facet")
    )
    wrong = ContactPair(block.contacts[0].facet_tags, slave=slave, master=SIDE)
    problem.contacts = [*block.contacts, wrong]
    for _ in range(2):
        with pytest.raises(InputError, match=message):
            problem.solve()
    with pytest.raises(InputError, match=message):
        list(problem.steps(lambda t: None, 0.0, 1.0, first=1.5e-3))
    assert len(problem.results) == 2
    np.testing.assert_array_equal(problem.u.x.array, u)
    problem.contacts = list(block.contacts)
    np.testing.assert_allclose(block.step(0.02, -0.03), alone.step(0.02, -0.03), atol=1e-5)


def limited(problem, is_limited):
    """Set limits that no solve keeps, or take them away."""
    solver = replace(
        problem.options.solver,
        max_products=1 if is_limited else 1000,
        error_if_not_converged=not is_limited,
    )
    problem.options = replace(problem.options, solver=solver)
    if isinstance(problem, NonlinearContactProblem):
        problem.options = replace(problem.options, newton_max_it=1 if is_limited else 30)


@pytest.mark.parametrize("kind", ["linear", "nonlinear"])
def test_states_that_have_not_converged_are_not_accepted(kind):
    block, alone = PressedBlock(kind), PressedBlock(kind)
    problem = block.problem
    for each in (block, alone):
        each.step(0.01, -0.02)
        each.problem.advance()
    results, u = problem.results, problem.u.x.array.copy()
    limited(problem, True)
    with pytest.raises(NotConverged, match="load step from 0 to 0.0015 is") as raised:
        list(problem.steps(lambda t: block.move(0.01, -0.03), 0.0, 1.0, first=1.5e-3))
    # the problem is as at the last step, the error has the iterate
    assert problem.results is results
    np.testing.assert_array_equal(problem.u.x.array, u)
    assert not np.array_equal(raised.value.solution.x.array, u)
    block.step(0.01, -0.03)
    assert not problem.report.converged
    with pytest.raises(InputError, match=r"has not converged \(.*\); call solve\(\) before adv"):
        problem.advance()
    limited(problem, False)
    np.testing.assert_allclose(block.step(0.02, -0.03), alone.step(0.02, -0.03), atol=1e-5)
    problem.advance()


@pytest.mark.ranks
@pytest.mark.parametrize(("calls", "reason"), [(99, "newton_max_it"), (8, "cannot go on")])
def test_last_iterate_of_newtons_method(calls, reason):
    """Openings of the results are distances of the plane from where u is."""
    block, evaluated = PressedBlock("nonlinear"), []

    def plane(x):
        evaluated.append(0)
        gap = np.full(x.shape[1], np.nan) if len(evaluated) > calls else 0.9 - x[1]
        return gap, np.array([[0.0], [-1.0]]) + 0.0 * x[:2]

    problem = block.problem
    problem.contacts = [RigidObstacle(block.contacts[1].facet_tags, TOP, plane)]
    solver = replace(problem.options.solver, error_if_not_converged=False)
    problem.options = replace(problem.options, solver=solver, newton_max_it=2)
    uh = problem.solve()
    report, result = problem.report, problem.results[0]
    assert uh is problem.u and not report.converged and 0 < len(report.newton) <= 2
    assert reason in report.reason
    height = uh.x.array.reshape(-1, 2)[result.dofs, 1] + result.coordinates[:, 1]
    np.testing.assert_allclose(result.opening, 0.9 - height, atol=1e-12)


def test_supports_in_place_of_others():
    """The corner has a mortar condition once it is no longer held along the normal."""
    marks = [(SIDE, at(1, -1.0)), (9, at(1, 1.0)), (8, lambda x: np.isclose(x[0], 0) & (x[1] >= 0))]
    marks += [(BOTTOM, at(1, 0.0), 2), (TOP, at(1, 0.0), 1)]
    parts = [((0, -1), (2, 0), (4, 2)), ((0, 0), (2, 1), (5, 2))]
    scene = Scene.of_boxes(COMM, "quadrilateral", parts, marks)
    scene.fix(SIDE)
    scene.fix(9, value=np.array([0.0, -0.1]))
    scene.fix(8, 1)

    def solved(*bcs):
        """Return the force after solves with some of the supports."""
        u, pair = fem.Function(scene.V), ContactPair(scene.facet_tags, BOTTOM, TOP, roles="given")
        F = ufl.derivative(neo_hookean(1.0, 0.3)(u) * ufl.dx(degree=2), u, scene.v)
        options = {"newton_rtol": 1e-8}
        problem = NonlinearContactProblem(F, u, bcs=bcs[0], contacts=pair, options=options)
        for problem.bcs in bcs:
            problem.solve()
        return problem.results[0].gather()

    free, held = scene.bcs[:2], [scene.bcs[2], scene.bcs[0]]
    expected, found = solved(free), solved(held, free)
    np.testing.assert_array_equal(found.nodes, expected.nodes)
    np.testing.assert_allclose(found.force, expected.force, rtol=1e-6)

"""Obstacles that move and turn under what sticks to them; arms that change; the law of friction."""

from mpi4py import MPI

from petsc4py import PETSc

import numpy as np
import pytest
from scenes import GROUND, LOADED, Scene, at

import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_vector

from fenics_tfeti import (
    ContactProblem,
    Coulomb,
    Deformed,
    NonlinearContactProblem,
    Plane,
    RigidBody,
    RigidObstacle,
    Sphere,
)
from fenics_tfeti.models import isotropic, neo_hookean

pytestmark = pytest.mark.once

COMM = MPI.COMM_WORLD
TWO = pytest.mark.ranks(1, 2)


def posed(scene, is_exact, **options):
    """Return a problem of rubber, or a linear one with exact non-penetration."""
    if is_exact:
        a = ufl.inner(isotropic(1e3, 0.3)(scene.u), ufl.grad(scene.v)) * ufl.dx
        problem = {"gaps": Deformed(tolerance=1e-9), "options": {"rtol": 1e-11, **options}}
        return ContactProblem(a, 0, bcs=scene.bcs, contacts=scene.contacts, **problem)
    u = fem.Function(scene.V)
    F = ufl.derivative(neo_hookean(1e3, 0.3)(u) * ufl.dx, u, scene.v)
    return NonlinearContactProblem(
        F, u, bcs=scene.bcs, contacts=scene.contacts, options={"newton_rtol": 1e-9, **options}
    )


def block(dim, n=4, degree=1, comm=COMM):
    """Return a block of two by one that is pressed by a motion of its top."""
    marks = [(GROUND, at(dim - 1, 0.0)), (LOADED, at(dim - 1, 1.0))]
    box = ((0.0,) * dim, (2.0,) + (1.0,) * (dim - 1), (2 * n,) + (n,) * (dim - 1))
    cell = {2: "quadrilateral", 3: "hexahedron"}[dim]
    return Scene.of_boxes(comm, cell, [box], marks, degree=degree)


@pytest.mark.parametrize(
    ("dim", "degree", "is_exact"),
    [
        (2, 1, True),
        pytest.param(2, 1, False, marks=TWO),
        pytest.param(2, 2, True, marks=TWO),
        (2, 2, False),
        pytest.param(3, 1, True, marks=TWO),
        (3, 1, False),
    ],
)
def test_what_sticks_to_a_belt_that_stretches(dim, degree, is_exact):
    """Places x of the belt have moved by a share of x: the nodes there came from x less that."""
    scene, share = block(dim, 3 - degree, degree), 0.02
    scene.fix(LOADED, dim - 1, -0.05)
    belt = Plane((0.0,) * dim, (0.0,) * (dim - 1) + (1.0,))
    scene.contacts = [
        RigidObstacle(
            scene.facet_tags,
            GROUND,
            belt,
            friction=Coulomb(100.0),
            displacement=lambda x: share * np.array([x[0], *(0.0 * x[1:dim])]),
            name="belt",
        )
    ]
    problem = posed(scene, is_exact)
    problem.solve()
    belt = problem.results["belt"]
    assert belt.friction.sticking.all() and belt.active.all()
    (found,) = problem._solved.contact_set.contacts
    nodes = found.conditions.surface.boundary.nodes
    u = problem.u.x.array.reshape(-1, dim)[: nodes.owned]
    # of degree 2 the conditions are for means around nodes
    moved, place = (found.conditions.relative(v)[:, 0] for v in (u, nodes.coordinates + u))
    np.testing.assert_allclose(moved, share * place, atol=1e-9)


def plate_on_blocks(is_cells, travel, weight):
    """Return a plate that has travelled over two blocks, loaded at its reference point."""
    parts = [((x, 0), (x + 1, 1), (3, 2)) for x in (0, 4)]
    marks = [(GROUND, at(1, 0.0))]
    marks += [(11 + k, at(1, 1.0), 1 + k) for k in range(2)]
    if is_cells:
        parts.append(((-1, 1), (6, 1.5), (7, 1)))
        marks.append((13, at(1, 1.0), 3))
    scene = Scene.of_boxes(COMM, "quadrilateral", parts, marks)
    scene.fix(GROUND)
    force = 0.0 if is_cells else (0.0, -weight)
    plate = RigidBody((2.5, 1.0), force=force, translation=(travel, None), name="plate")
    more = {}
    if is_cells:
        # of a uniform weight, whose resultant is at the reference point
        scene.L = ufl.inner(fem.Constant(scene.mesh, (0.0, -weight / 3.5)), scene.v) * scene.dx(3)
        more = {"rigid_bodies": {3: plate}, "cell_tags": scene.cell_tags}
        for k in range(2):
            scene.add_pair(11 + k, 13)
    else:
        flat = Plane((0, 1), (0, -1))
        for k in range(2):
            scene.add_obstacle(11 + k, flat, rigid_body=plate)
        more = {"cell_tags": None}
    a = ufl.inner(isotropic(1e7, 0.3)(scene.u), ufl.grad(scene.v)) * scene.dx
    return ContactProblem(
        a,
        scene.L,
        bcs=scene.bcs,
        contacts=scene.contacts,
        gaps=Deformed(tolerance=1e-7),
        options={"rtol": 1e-10},
        **more,
    )


@pytest.mark.parametrize(
    ("travel", "weight", "is_cells"),
    [
        (0.0, 1e3, False),
        (0.0, 1e3, True),
        pytest.param(0.75, 1e3, False, marks=TWO),
        (0.75, 1e3, True),
        (0.75, 1e-3, False),
        pytest.param(0.75, 1e-3, True, marks=TWO),
    ],
)
def test_arms_of_a_plate_that_travels(is_cells, travel, weight):
    """The moment of the contact forces about the moved reference point vanishes."""
    problem = plate_on_blocks(is_cells, travel, weight)
    u = problem.solve().x.array.reshape(-1, 2)
    sums = np.zeros(2)
    for result in problem.results:
        arm = result.coordinates[:, 0] + u[result.dofs, 0] - 2.5 - travel
        sums += [result.nodal_normal_force.sum(), result.nodal_normal_force @ arm]
    force, moment = COMM.allreduce(sums)
    assert force == pytest.approx(weight, rel=1e-6)
    assert abs(moment) < 1e-5 * weight
    passes = problem.report.passes
    assert passes[-1].imbalance < 1e-7
    assert travel == 0.0 or passes[0].imbalance > 0.05


@pytest.mark.ranks(1, 2)
def test_friction_carries_a_body_along():
    """A plate on springs sticks to a block that moves sideways, with exact non-penetration."""
    parts = [((0, 0), (1, 1), (3, 3))]
    marks = [(GROUND, at(1, 0.0)), (11, at(1, 1.0))]
    scene = Scene.of_boxes(COMM, "quadrilateral", parts, marks)
    scene.fix(GROUND, 0, 0.02)
    scene.fix(GROUND, 1, 0.02)
    plate = RigidBody((0.5, 1.0), spring=np.full(3, 1e6), name="plate")
    scene.add_obstacle(11, Plane((0, 1), (0, -1)), rigid_body=plate, friction=Coulomb(0.9))
    a = ufl.inner(isotropic(1e7, 0.3)(scene.u), ufl.grad(scene.v)) * scene.dx
    given = {"bcs": scene.bcs, "contacts": scene.contacts, "gaps": Deformed(tolerance=1e-6)}
    problem = ContactProblem(a, scene.L, **given)
    u = problem.solve().x.array.reshape(-1, 2)
    way = problem.rigid_bodies[0].translation[0]
    assert way > 0.01
    friction, dofs = problem.results[0].friction, problem.results[0].dofs
    stuck = friction.sticking & (problem.results[0].nodal_normal_force > 0.0)
    np.testing.assert_allclose(u[dofs[stuck], 0], way, rtol=1e-3)
    assert COMM.allreduce(int(stuck.sum())) >= 2


@pytest.mark.parametrize(("dim", "mu"), [(2, 0.3), (2, 2.0), pytest.param(3, 0.3, marks=TWO)])
def test_forces_are_those_of_the_last_state(dim, mu):
    """They fulfil the law of friction and are in equilibrium with u, by dolfinx, by default.

    A ball is the obstacle, whose normals turn as the block slides.
    """
    scene = block(dim, 2 if dim == 3 else 6)
    motion = np.array([0.1, -0.05] if dim == 2 else [0.1, 0.05, -0.05])
    scene.bcs = [
        fem.dirichletbc(
            motion,
            fem.locate_dofs_topological(scene.V, dim - 1, scene.facet_tags.find(LOADED)),
            scene.V,
        )
    ]
    centre = (1.0,) + (0.5,) * (dim - 2) + (-4.0,)
    ball = Sphere(centre, 4.01)
    scene.contacts = [
        RigidObstacle(scene.facet_tags, GROUND, ball, friction=Coulomb(mu), name="ball")
    ]
    problem = posed(scene, False, newton_rtol=1e-6, subdomain_size=60)
    problem.solve()
    ball = problem.results["ball"]
    largest = COMM.allreduce(ball.nodal_normal_force.max(initial=0.0), MPI.MAX)
    excess = np.linalg.norm(ball.friction.force, axis=1) - mu * ball.nodal_normal_force
    sticks = ball.friction.sticking
    broken = np.where(sticks, np.maximum(excess, 0.0), np.abs(excess))
    assert COMM.allreduce(broken.max(initial=0.0), MPI.MAX) < 1e-5 * largest
    assert COMM.allreduce(int((~sticks & ball.active).sum())) > 0

    u = problem.u
    F = ufl.derivative(neo_hookean(1e3, 0.3)(u) * ufl.dx, u, scene.v)
    vector = assemble_vector(fem.form(F))
    vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    internal = vector.array.reshape(-1, dim)
    contact = np.zeros_like(internal)
    contact[ball.dofs] = ball.friction.force - ball.nodal_normal_force[:, None] * ball.normal
    rest = internal - contact
    x = scene.V.tabulate_dof_coordinates()[: len(internal), dim - 1]
    held = np.isclose(x, 1.0)
    reaction = COMM.allreduce(rest[held].sum(axis=0))
    size = np.sqrt(COMM.allreduce((internal[held] ** 2).sum()))
    left = np.sqrt(COMM.allreduce((rest[~held] ** 2).sum()))
    assert left < 2e-6 * size
    np.testing.assert_allclose(problem.report.reactions[0].force, reaction, atol=1e-9 * size)
    whole = COMM.allreduce(contact.sum(axis=0))
    np.testing.assert_allclose(ball.force, whole, atol=1e-12 * size)
    np.testing.assert_allclose(ball.force, -reaction, atol=1e-5 * size)

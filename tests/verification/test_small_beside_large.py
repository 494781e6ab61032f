"""Small displacements beside large ones, and obstacles far away: each part as right as if alone.

The scripts are those of a user of dolfinx, with the default options unless said otherwise.
"""

from __future__ import annotations

from functools import lru_cache

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from primal_reference import Obstacle, Pair, reference_solution
from scenes import at

import ufl
from dolfinx import fem, mesh

from fenics_tfeti import ContactPair, ContactProblem, Plane, RigidObstacle, Sphere
from fenics_tfeti.io import Box, boxes, tag_facets

# -- a soft body beside a stiff one that moves far -------------------------------------------------

FIXED, SQUEEZED, LOWER, UPPER, HELD, LIFTED = 1, 2, 3, 4, 5, 6
SQUEEZE, LIFT = 1e-4, 20e-3  # [m]


def elasticity(u, v, young, poisson, dx):
    mu, lmbda = young / 2 / (1 + poisson), young * poisson / (1 + poisson) / (1 - 2 * poisson)
    strain = ufl.sym(ufl.grad(u))
    stress = 2 * mu * strain + lmbda * ufl.tr(strain) * ufl.Identity(len(u))
    return ufl.inner(stress, ufl.sym(ufl.grad(v))) * dx


@lru_cache(maxsize=None)
def pad_and_bar():
    """A pad of rubber, 0.1 m high and in two halves, is squeezed by 0.1 mm between plates.

    Beside it the end of a bar of steel, 1 m long, is lifted by 20 mm.
    """
    parts = [
        Box((0, 0, 0), (0.1, 0.1, 0.05), (4, 4, 2)),
        Box((0, 0, 0.05), (0.1, 0.1, 0.1), (4, 4, 2)),
        Box((0.3, 0, 0), (1.3, 0.1, 0.1), (10, 2, 2)),
    ]
    tagged = boxes(MPI.COMM_SELF, parts, "hexahedron")
    marks = [
        (FIXED, at(2, 0.0), 1),
        (LOWER, at(2, 0.05), 1),
        (UPPER, at(2, 0.05), 2),
        (SQUEEZED, at(2, 0.1), 2),
        (HELD, at(0, 0.3), 3),
        (LIFTED, at(0, 1.3), 3),
    ]
    tags = tag_facets(tagged.mesh, marks, tagged.cell_tags)
    V = scenes.vector_space(tagged.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    dx = ufl.Measure("dx", domain=tagged.mesh, subdomain_data=tagged.cell_tags)
    a = elasticity(u, v, 1e6, 0.45, dx((1, 2))) + elasticity(u, v, 2.1e11, 0.3, dx(3))
    bcs = [scenes.fixed(V, tags, tag, None) for tag in (FIXED, HELD)]
    bcs += [scenes.fixed(V, tags, SQUEEZED, i, (0.0, 0.0, -SQUEEZE)[i]) for i in range(3)]
    bcs += [scenes.fixed(V, tags, LIFTED, 2, LIFT)]
    zero = fem.Constant(tagged.mesh, 0.0)
    exact = reference_solution(V, a, zero * v[0] * ufl.dx, bcs, tags, [Pair(UPPER, LOWER)])
    return V, a, bcs, tags, tagged.cell_tags, dx, exact


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
@pytest.mark.parametrize("rtol", [None, 1e-4])
def test_rubber_beside_steel_that_moves(rtol, method):
    V, a, bcs, tags, cell_tags, dx, exact = pad_and_bar()
    options = {"method": method} | ({} if rtol is None else {"rtol": rtol})
    problem = ContactProblem(
        a,
        0,
        bcs=bcs,
        contacts=ContactPair(tags, UPPER, LOWER),
        cell_tags=cell_tags,
        options=options,
    )
    uh = problem.solve()

    def at_facets(tag):
        dofs = fem.locate_dofs_topological(V, 2, tags.find(tag))
        return uh.x.array.reshape(-1, 3)[dofs, 2]

    np.testing.assert_allclose(at_facets(SQUEEZED), -SQUEEZE, rtol=1e-12)
    np.testing.assert_allclose(at_facets(LIFTED), LIFT, rtol=1e-12)

    true, error = fem.Function(V), fem.Function(V)
    true.x.array[:] = exact.displacement
    error.x.array[:] = uh.x.array - true.x.array

    def energy(w):
        return fem.assemble_scalar(fem.form(elasticity(w, w, 1e6, 0.45, dx((1, 2)))))

    assert np.sqrt(energy(error) / energy(true)) <= problem.report.options["rtol"]
    assert problem.report.converged


# -- obstacles far away ----------------------------------------------------------------------------

TOP, BOTTOM, SIDE, UNDER = 1, 2, 3, 4
YOUNG, POISSON = 2.1e11, 0.3


def block(n=8):
    """Return mesh and tags of a block of steel, 0.2 m wide and high; UNDER is half of its face."""
    domain = mesh.create_rectangle(
        MPI.COMM_SELF, [np.array([0.0, 0.0]), np.array([0.2, 0.2])], [n, n]
    )
    half = (UNDER, lambda x: np.isclose(x[1], 0.0) & (x[0] < 0.1 + 1e-9))
    marks = [(TOP, at(1, 0.2)), (SIDE, at(0, 0.0))]
    return domain, tag_facets(domain, [*marks, (BOTTOM, at(1, 0.0))]), tag_facets(domain, [half])


def pressed_in(domain, tags, contact, depth, options=None):
    """Push the block down onto an obstacle, in plane strain; return the force [N/m]."""
    V = scenes.vector_space(domain)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = elasticity(u, v, YOUNG, POISSON, ufl.dx)
    bcs = [scenes.fixed(V, tags, TOP, 1, -depth), scenes.fixed(V, tags, SIDE, 0)]
    problem = ContactProblem(a, 0, bcs=bcs, contacts=contact, options=options)
    problem.solve()
    assert problem.report.converged
    assert problem.report.reactions[0].force[1] == pytest.approx(
        -problem.report.contacts[0].normal_force
    )
    return problem.report.contacts[0].normal_force


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
@pytest.mark.parametrize("far", [1e10, np.inf])
def test_punch_below_half_of_a_block(far, method):
    """The same force as with the half tagged alone, where the punch is a plane."""
    domain, tags, half = block()
    plane = RigidObstacle(half, UNDER, Plane((0, 0), (0, 1)))
    punch = RigidObstacle(tags, BOTTOM, lambda x: np.where(x[0] < 0.1 + 1e-9, x[1], far))
    options = {"method": method, "rtol": 1e-8}
    exact = pressed_in(domain, tags, plane, 10e-6, options)
    assert exact > 0.5 * YOUNG * 10e-6 / 0.2 * 0.1
    assert pressed_in(domain, tags, punch, 10e-6, options) == pytest.approx(exact, rel=1e-7)
    assert pressed_in(domain, tags, punch, 10e-6) == pytest.approx(exact, rel=1e-5)


BALL = 0.2  # radius [m]
DEPTHS = (1e-7, 1e-6, 1e-5)  # indentation [m]


def half_space(growth=1.2):
    """Return mesh and tags of a quarter plane of 0.2 m, whose elements grow from the corner on.

    The smallest ones are an eighth of the radius of contact at the first depth.
    """
    smallest = np.sqrt(BALL * DEPTHS[0]) / 8
    n = int(np.log(1 + 0.2 / smallest * (growth - 1)) / np.log(growth)) + 1
    corners = [np.array([0.0, 0.0]), np.array([1.0, 1.0])]
    kind = mesh.CellType.quadrilateral
    domain = mesh.create_rectangle(MPI.COMM_SELF, corners, [n, n], kind)
    x = domain.geometry.x
    x[:, :2] = 0.2 * (growth ** (n * x[:, :2]) - 1) / (growth**n - 1)
    return domain, tag_facets(domain, [(TOP, at(1, 0.2)), (BOTTOM, at(1, 0.0)), (SIDE, at(0, 0.0))])


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
def test_first_steps_of_a_rigid_ball(method):
    """Hertz's force F = 4/3 E* sqrt(R) d^(3/2); gaps at the rim are 10^5 times the first depth.

    The mesh leaves 2 % at 6 elements on the radius of contact.
    """
    domain, tags = half_space()
    V = scenes.vector_space(domain)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    r = ufl.SpatialCoordinate(domain)[0]
    weight = 2 * ufl.pi * r
    mu, lmbda = YOUNG / 2 / (1 + POISSON), YOUNG * POISSON / (1 + POISSON) / (1 - 2 * POISSON)

    def epsilon(w):
        e = ufl.sym(ufl.grad(w))
        return ufl.as_tensor([[e[0, 0], e[0, 1], 0], [e[1, 0], e[1, 1], 0], [0, 0, w[0] / r]])

    stress = lmbda * ufl.tr(epsilon(u)) * ufl.Identity(3) + 2 * mu * epsilon(u)
    a = ufl.inner(stress, epsilon(v)) * weight * ufl.dx
    depth = fem.Constant(domain, 0.0)
    top = fem.locate_dofs_topological(V.sub(1), 1, tags.find(TOP))
    bcs = [fem.dirichletbc(depth, top, V.sub(1)), scenes.fixed(V, tags, SIDE, 0)]
    ball = RigidObstacle(tags, BOTTOM, Sphere((0.0, -BALL), BALL))
    problem = ContactProblem(
        a, 0, bcs=bcs, contacts=ball, options={"method": method}, measure_weight=weight
    )
    for d in DEPTHS:
        depth.value = -d
        problem.solve()
        hertz = 4 / 3 * YOUNG / (1 - POISSON**2) * np.sqrt(BALL) * d**1.5
        assert problem.report.contacts[0].normal_force == pytest.approx(hertz, rel=0.02)


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
def test_first_step_of_a_rigid_ball_on_a_coarse_mesh(method):
    """One node touches; the force is that of the same mesh solved directly."""
    tagged = boxes(MPI.COMM_SELF, [Box((-0.1, -0.1, 0), (0.1, 0.1, 0.2), (8, 8, 8))], "hexahedron")
    tags = tag_facets(tagged.mesh, [(TOP, at(2, 0.2)), (BOTTOM, at(2, 0.0))])
    V = scenes.vector_space(tagged.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = elasticity(u, v, YOUNG, POISSON, ufl.dx)
    bcs = [scenes.fixed(V, tags, TOP, i, -DEPTHS[0] * (i == 2)) for i in range(3)]
    centre = (0.0, 0.0, -BALL)
    ball = RigidObstacle(tags, BOTTOM, Sphere(centre, BALL))
    options = {"method": method, "subdomain_size": 500}
    problem = ContactProblem(a, 0, bcs=bcs, contacts=ball, options=options)
    problem.solve()
    zero = fem.Constant(tagged.mesh, 0.0)
    obstacle = Obstacle(BOTTOM, scenes.Ball(centre, BALL))
    exact = reference_solution(V, a, zero * v[0] * ufl.dx, bcs, tags, [obstacle])
    force = exact.contacts[0].forces
    assert np.count_nonzero(force) == np.count_nonzero(problem.results[0].active) == 1
    assert [c.normal_force for c in problem.report.contacts] == pytest.approx(
        [force.sum()], rel=1e-6
    )

"""One surface against several bodies side by side, under one tag."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import at

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, Coulomb
from fenics_tfeti.io import Box, boxes, displacement_space, piecewise_constant, tag_facets
from fenics_tfeti.models import isotropic, small_strain, symmetry_plane
from fenics_tfeti.parallel import largest_of_ranks

pytestmark = [pytest.mark.ranks, pytest.mark.once]

BAR, LEFT, TOP, FLOOR, RIGHT, SIDE = 1, 2, 3, 4, 5, 6
PRESSURE, YOUNG = 1e3, 1e6


def bar_on_two_blocks(bodies, pairs, young=YOUNG):
    """Solve for a bar that is pressed on two blocks side by side; return the problem."""
    V = displacement_space(bodies.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    tags = pairs[0].facet_tags
    ds = ufl.Measure("ds", domain=bodies.mesh, subdomain_data=tags)
    E = piecewise_constant(bodies.mesh, bodies.cell_tags, {1: young, 2: YOUNG, 3: YOUNG})
    floor = fem.locate_dofs_topological(V, 1, tags.find(FLOOR))
    bcs = [fem.dirichletbc(np.zeros(2), floor, V), symmetry_plane(V, tags, SIDE, 0)]
    a = ufl.inner(isotropic(E, 0.0)(u), small_strain(v)) * ufl.dx
    L = -PRESSURE * v[1] * ds(TOP)
    problem = ContactProblem(
        a, L, bcs=bcs, contacts=pairs, cell_tags=bodies.cell_tags, options={"rtol": 1e-10}
    )
    problem.solve()
    return problem


def tagged(n, on_bar, left=LEFT, right=LEFT):
    """Return the bodies, n cells on each block and `on_bar` on the bar, and the tags of facets."""
    parts = [
        Box((0, 0), (1, 1), (n, n)),
        Box((1, 0), (2, 1), (n, n)),
        Box((0, 1), (2, 2), (on_bar, n)),
    ]
    bodies = boxes(MPI.COMM_WORLD, parts, "quadrilateral")
    marks = [(BAR, at(1, 1.0), 3), (left, at(1, 1.0), 1), (right, at(1, 1.0), 2)]
    marks += [(FLOOR, at(1, 0.0)), (TOP, at(1, 2.0)), (SIDE, at(0, 0.0), 3)]
    return bodies, tag_facets(bodies.mesh, marks, bodies.cell_tags)


def test_two_bodies_are_the_slave_of_one():
    """Of meshes alike, two slave nodes are opposite one node of the master."""
    bodies, tags = tagged(4, 8)
    pair = ContactPair(tags, LEFT, BAR, roles="given")
    problem = bar_on_two_blocks(bodies, [pair])
    contact = problem.results[0].gather()
    assert contact.pressure.size == 10
    np.testing.assert_allclose(contact.pressure, PRESSURE, rtol=1e-8)
    largest = largest_of_ranks(MPI.COMM_WORLD, np.abs(problem.u.x.array))
    assert largest == pytest.approx(2.0 * PRESSURE / YOUNG, rel=1e-9)


@pytest.mark.parametrize(
    ("on_bar", "friction"),
    [
        (8, Coulomb(0.2)),
        pytest.param(8, None, marks=pytest.mark.ranks(1)),
        pytest.param(9, Coulomb(0.2), marks=pytest.mark.ranks(1)),
        (9, None),
    ],
)
def test_two_bodies_are_the_master_of_one(on_bar, friction):
    """As two pairs: a step between the two blocks, of which one is soft, is not bridged."""
    solved = []
    for right in (LEFT, RIGHT):
        bodies, tags = tagged(4, on_bar, right=right)
        masters = [LEFT] if right == LEFT else [LEFT, RIGHT]
        pairs = [
            ContactPair(tags, BAR, master, roles="given", friction=friction) for master in masters
        ]
        solved.append(bar_on_two_blocks(bodies, pairs, young=YOUNG / 100))
    one, two = solved
    largest = largest_of_ranks(MPI.COMM_WORLD, np.abs(two.u.x.array))
    np.testing.assert_allclose(one.u.x.array, two.u.x.array, rtol=0.0, atol=1e-7 * largest)
    np.testing.assert_allclose(
        one.results[0].force, np.sum([result.force for result in two.results], axis=0), rtol=1e-7
    )
    contact = one.results[0].gather()
    assert contact.nodes.size == sum(result.gather().nodes.size for result in two.results)
    assert np.sum(contact.nodal_normal_force) == pytest.approx(2.0 * PRESSURE, rel=1e-6)

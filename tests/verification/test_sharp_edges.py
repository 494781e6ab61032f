"""Boxes whose sides are tagged with their foot act as their foot; wedges touch by their edge."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import Scene, at

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, Deformed, NonlinearContactProblem
from fenics_tfeti.fem.contact.descriptions.partners import Nearest
from fenics_tfeti.io import Box, boxes, displacement_space, piecewise_constant, tag_facets
from fenics_tfeti.models import isotropic, neo_hookean, small_strain

pytestmark = pytest.mark.once

BOX, TABLE, FLOOR, TOP = 1, 2, 3, 4


def solved(dim, kind, whole, grid, **of_pair):
    """Solve for a stiff box pressed on a wider table; return its displacements and its contact."""
    up = dim - 1
    parts = [
        Box((0.0,) * dim, (3.0,) * up + (1.0,), (grid[0],) * up + (2,)),
        Box((1.0,) * dim, (2.0,) * dim, (grid[1],) * dim),
    ]
    bodies = boxes(MPI.COMM_WORLD, parts, "quadrilateral" if dim == 2 else "hexahedron")
    sides = [(BOX, at(axis, end), 2) for axis in range(up) for end in (1.0, 2.0)] if whole else []
    marks = [*sides, (BOX, at(up, 1.0), 2), (TABLE, at(up, 1.0), 1), (FLOOR, at(up, 0.0))]
    tags = tag_facets(bodies.mesh, [*marks, (TOP, at(up, 2.0), 2)], bodies.cell_tags)
    V = displacement_space(bodies.mesh)
    w, v, u = ufl.TrialFunction(V), ufl.TestFunction(V), fem.Function(V)
    young = piecewise_constant(bodies.mesh, bodies.cell_tags, {1: 1.0, 2: 1e2})
    bcs = [
        fem.dirichletbc(np.array([0.0] * up + [value]), dofs, V)
        for tag, value in ((FLOOR, 0.0), (TOP, -0.05))
        for dofs in [fem.locate_dofs_topological(V, up, tags.find(tag))]
    ]
    pair = ContactPair(tags, BOX, TABLE, roles="given", **of_pair)
    if kind == "finite":
        F = ufl.derivative(neo_hookean(young, 0.3)(u) * ufl.dx(degree=3), u, v)
        problem = NonlinearContactProblem(F, u, bcs=bcs, contacts=[pair])
    else:
        a = ufl.inner(isotropic(young, 0.3)(w), small_strain(v)) * ufl.dx
        more = {"gaps": Deformed()} if kind == "exact" else {}
        options = {"rtol": 1e-11}
        problem = ContactProblem(a, 0, bcs=bcs, contacts=[pair], options=options, **more)
    return problem.solve().x.array.copy(), problem.results[0]


@pytest.mark.parametrize(
    ("dim", "kind", "nodes"),
    [
        (2, "small", False),
        (2, "small", True),
        (2, "exact", False),
        (2, "finite", False),
        (3, "small", False),
        (3, "small", True),
        (3, "exact", False),
        (3, "finite", False),
    ],
)
def test_box_with_its_sides_is_its_foot(dim, kind, nodes):
    """Of mortar conditions and of pairs of nodes."""
    grid = {2: (12, 4), 3: (6, 2)}[dim] if nodes else (13 // (dim - 1), 3)
    of_pair = {"partners": Nearest(), "partial": True} if nodes else {}
    foot, alone = solved(dim, kind, False, grid, **of_pair)
    box, contact = solved(dim, kind, True, grid, **of_pair)
    np.testing.assert_allclose(box, foot, rtol=0.0, atol=1e-8 * np.abs(foot).max())
    assert contact.force[-1] == pytest.approx(alone.force[-1], rel=1e-8)
    largest = np.abs(contact.normal[:, :-1]).max(initial=0.0)
    assert MPI.COMM_WORLD.allreduce(largest, MPI.MAX) < 1e-12 or kind != "small"


@pytest.mark.ranks
@pytest.mark.parametrize("slope", [1.0, 3.0])
@pytest.mark.parametrize("n", [4, 7])
def test_wedge_presses_by_its_edge(slope, n):
    """Under facets of any size, from the first touch on; one side of a wedge has no inside."""
    parts = [((0.8, 0.0), (1.0, 1.0), (2, 2)), ((0.0, 1.0), (2.0, 2.0), (n, 3))]
    marks = [(BOX, at(1, 1.0), 2), (TABLE, at(1, 1.0), 1), (FLOOR, at(1, 0.0)), (TOP, at(1, 2.0))]
    scene = Scene.of_boxes(MPI.COMM_WORLD, "quadrilateral", parts, marks, young=1.0)
    x, wedge = scene.mesh.geometry.x, scene.nodes(1)
    x[wedge, 1] *= 1.0 - slope * np.abs(x[wedge, 0] - 0.9)
    scene.fix(FLOOR)
    scene.fix(TOP, 1, -1e-4)
    scene.fix(TOP, 0)
    scene.add_pair(BOX, TABLE, roles="given")
    problem = scene.problem(options={"rtol": 1e-8})
    problem.solve()
    contact = problem.results[0]
    assert contact.force[1] > 1e-5
    assert contact.entry.penetration < 1e-3 * 1e-4

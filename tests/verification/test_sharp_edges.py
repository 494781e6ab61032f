"""A box whose sides are tagged with its foot, which sides face nothing, acts as its foot."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from scenes import at

from fenics_tfeti import ContactPair, ContactProblem, Exact, NonlinearContactProblem
from fenics_tfeti.fem.contact.descriptions.partners import Nearest
from fenics_tfeti.io import Box, boxes, displacement_space, piecewise_constant, tag_facets
from fenics_tfeti.models import isotropic, neo_hookean, small_strain

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
        options = {"newton_rtol": 1e-10, "rtol": 1e-11}
        problem = NonlinearContactProblem(F, u, bcs=bcs, contacts=[pair], options=options)
    else:
        a = ufl.inner(isotropic(young, 0.3)(w), small_strain(v)) * ufl.dx
        more = {"geometry": Exact()} if kind == "exact" else {}
        options = {"rtol": 1e-11}
        problem = ContactProblem(a, 0, bcs=bcs, contacts=[pair], options=options, **more)
    return problem.solve().x.array.copy(), problem.results[0]


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["small", "exact", "finite"])
@pytest.mark.parametrize("nodes", [False, True])
def test_box_with_its_sides_is_its_foot(dim, kind, nodes):
    grid = ((6, 2) if dim == 3 else (12, 4)) if nodes else ((7, 3) if dim == 3 else (13, 6))
    of_pair = {"partners": Nearest(), "partial": True} if nodes else {}
    foot, alone = solved(dim, kind, False, grid, **of_pair)
    box, contact = solved(dim, kind, True, grid, **of_pair)
    print(np.abs(box - foot).max(), np.abs(foot).max(), contact.force, alone.force)
    np.testing.assert_allclose(box, foot, atol=1e-9 * np.abs(foot).max())

"""Surfaces that stay together: two blocks meshed apart are one."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from mortar_blocks import LOADED, LOWER, PRESSURE, SUPPORTED, UPPER, Blocks
from scenes import POISSON, YOUNG, elasticity, fixed, vector_space

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, InputError, Plane, RigidObstacle, TiedPair
from fenics_tfeti.fem.topology import cell_vertices, vertex_nodes
from fenics_tfeti.io import tag_facets

CELLS = ["triangle", "quadrilateral", "tetrahedron", "hexahedron"]


def blocks(cell, **arguments):
    sizes = {"lower": 5, "upper": 7} if cell in CELLS[:2] else {"lower": 3, "upper": 4}
    return Blocks(cell, **{**sizes, **arguments})


def pose(shape, comm=MPI.COMM_SELF):
    beams = shape.mesh(comm)
    return vector_space(beams.mesh), tag_facets(beams.mesh, shape.markers(), beams.cell_tags)


def solved(V, tags, L, bcs, slave=LOWER, **arguments):
    young = fem.Constant(V.mesh, YOUNG)
    a = elasticity(ufl.TrialFunction(V), ufl.TestFunction(V), young)
    problem = ContactProblem(
        a,
        L,
        bcs=bcs,
        contacts=[
            *arguments.pop("contacts", []),
            arguments.pop("tied", TiedPair(tags, slave, LOWER + UPPER - slave)),
        ],
        options={"rtol": 1e-12, "subdomain_size": 150},
        **arguments,
    )
    problem.kept = young
    return problem, problem.solve()


def relative_error(V, uh, exact):
    gdim = V.mesh.geometry.dim
    x = V.tabulate_dof_coordinates()[:, :gdim]
    expected = exact(x)
    return np.abs(uh.x.array.reshape(-1, gdim) - expected).max() / np.abs(expected).max()


@pytest.mark.parametrize("slave", [LOWER, UPPER])
@pytest.mark.parametrize("cell", CELLS)
def test_any_linear_displacement(cell, slave):
    """Prescribed on all faces but the tied ones, whose rims are prescribed: shear and rotation."""
    V, tags = pose(blocks(cell, jitter=0.05))
    d = V.mesh.geometry.dim
    gradient = 1e-3 * np.arange(1.0, d * d + 1.0).reshape(d, d) * (-1.0) ** np.arange(d)

    def exact(x):
        return x @ gradient.T

    function = fem.Function(V)
    function.interpolate(lambda x: exact(x[:d].T).T)
    sides = fem.locate_dofs_geometrical(
        V, lambda x: np.any(np.isclose(x[:d], 0.0) | np.isclose(x[:d], 1.0), axis=0)
    )
    x = V.tabulate_dof_coordinates()
    # not the inside of the tied faces
    rim = np.any(np.isclose(x[:, : d - 1], 0.0) | np.isclose(x[:, : d - 1], 1.0), axis=1)
    ends = np.isclose(x[:, d - 1], 0.0) | np.isclose(x[:, d - 1], 2.0)
    dofs = np.union1d(sides[rim[sides]], np.flatnonzero(ends)).astype(np.int32)
    problem, uh = solved(V, tags, 0, [fem.dirichletbc(function, dofs)], slave)
    assert relative_error(V, uh, exact) < 1e-10
    assert problem.report.contacts[0].pairing["discretisation"] == "tied"


@pytest.mark.parametrize("cell", CELLS)
def test_tension(cell):
    """Tied surfaces pull; the sums of forces on both are equal."""
    V, tags = pose(blocks(cell))
    d = V.mesh.geometry.dim
    ds = ufl.Measure("ds", domain=V.mesh, subdomain_data=tags)
    pull = fem.Constant(V.mesh, PRESSURE)
    L = pull * ufl.TestFunction(V)[d - 1] * ds(LOADED)
    bcs = [fixed(V, tags, SUPPORTED[axis], axis) for axis in range(d)]
    problem, uh = solved(V, tags, L, bcs)
    nu, unit = POISSON, PRESSURE / YOUNG
    along = [-nu, -nu, 1.0] if d == 3 else [-nu * (1 + nu), 1 - nu**2]
    assert relative_error(V, uh, lambda x: unit * np.array(along) * x) < 1e-10
    (force,) = [c.force for c in problem.report.contacts]
    np.testing.assert_allclose(force, [*[0.0] * (d - 1), PRESSURE], atol=1e-8 * PRESSURE)
    (tie,) = problem.results
    np.testing.assert_allclose(tie.force, force, rtol=0.0, atol=0.0)
    np.testing.assert_allclose(tie.nodal_force.sum(axis=0), force, atol=1e-8 * PRESSURE)
    assert tie.area.sum() == pytest.approx(1.0)
    traction = np.broadcast_to(force, tie.traction.shape)
    np.testing.assert_allclose(tie.traction, traction, atol=1e-7 * PRESSURE)
    assert tie.gather().nodes.tolist() == tie.nodes.tolist()
    # nodes on planes of symmetry have conditions in the other components
    assert problem.report.contacts[0].pairing["unmatched"] == 0


def test_tied_block_with_a_floor():
    """Ties and contacts in one problem, solved again under another load."""
    V, tags = pose(blocks("quadrilateral"))
    ds = ufl.Measure("ds", domain=V.mesh, subdomain_data=tags)
    push = fem.Constant(V.mesh, PRESSURE)
    L = -push * ufl.TestFunction(V)[1] * ds(LOADED)
    floor = RigidObstacle(tags, SUPPORTED[1], Plane((0.0, 0.0), (0.0, 1.0)))
    bcs = [fixed(V, tags, SUPPORTED[0], 0)]
    problem, _ = solved(V, tags, L, bcs, contacts=[floor])
    assert problem.results[0].normal_force.sum() == pytest.approx(PRESSURE)
    push.value = 2.0 * PRESSURE
    problem.solve()
    assert problem.results[0].normal_force.sum() == pytest.approx(2.0 * PRESSURE)
    assert [entry["discretisation"] for entry in [c.pairing for c in problem.report.contacts]] == [
        "obstacle",
        "tied",
    ]


def test_moved_mesh_and_other_supports():
    V, tags = pose(blocks("triangle"))
    ds = ufl.Measure("ds", domain=V.mesh, subdomain_data=tags)
    pull = fem.Constant(V.mesh, PRESSURE)
    L = pull * ufl.TestFunction(V)[1] * ds(LOADED)
    bcs = [fixed(V, tags, SUPPORTED[axis], axis) for axis in range(2)]
    problem, _ = solved(V, tags, L, bcs)
    first = problem.system.tied
    V.mesh.geometry.x[:, 0] *= 2.0
    problem.solve()
    np.testing.assert_allclose(problem.system.tied.length, 2.0 * first.length)
    problem.bcs = [fixed(V, tags, SUPPORTED[1], None)]
    problem.solve()
    # the node at x = 0 is not held any more, and has a condition in x as well
    assert problem.system.tied.size == first.size + 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": "joint", "master": LOADED}, "joint: no facet .* opposite|joint: the surfaces"),
        ({"slave": SUPPORTED[0]}, "tied pair 0: slave and master share"),
    ],
)
def test_mistakes(change, message):
    V, tags = pose(blocks("triangle"))
    pair = replace(TiedPair(tags, LOWER, UPPER), **change)
    with pytest.raises(InputError, match=message):
        solved(V, tags, 0, [fixed(V, tags, SUPPORTED[1], None)], tied=pair)


def test_surfaces_that_are_apart():
    V, tags = pose(blocks("triangle"))
    upper = fem.locate_dofs_topological(V, 1, tags.find(UPPER))
    rows, nodes = cell_vertices(V.mesh), vertex_nodes(V)
    V.mesh.geometry.x[np.unique(rows[np.isin(nodes, upper)]), 1] += 0.2
    with pytest.raises(InputError, match=r"tied pair 0: the surfaces are apart.* 8 slave nodes"):
        solved(V, tags, 0, [fixed(V, tags, SUPPORTED[1], None)], slave=UPPER)


def test_what_is_no_tied_pair():
    V, tags = pose(blocks("triangle"))
    with pytest.raises(InputError, match=r"contact 0 is a str; .* or a TiedPair"):
        solved(V, tags, 0, [], tied="upper")

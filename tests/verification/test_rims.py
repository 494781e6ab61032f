"""Rims of a contact that lie anywhere in the slave's facets: statics, patch tests, either side."""

import warnings

from mpi4py import MPI

import numpy as np
import pytest
from msh_files import gmsh_model
from scenes import Scene, at, dimension

import ufl
from dolfinx import fem

from fenics_tfeti import Coulomb, Mortar, NonlinearContactProblem, UnresistedMotion
from fenics_tfeti.io import read_msh
from fenics_tfeti.models import neo_hookean

pytestmark = pytest.mark.once

GROUND, LOADED, LOWER, UPPER = 1, 3, 10, 11


def heavy_from(limit, values):
    """Mark larger values as heavy."""
    return [pytest.param(v, marks=pytest.mark.heavy) if v > limit else v for v in values]


# -- blocks that tip over ----------------------------------------------------------------------


def stack(blocks, facets, share, slave):
    """Return blocks under their weight, each beyond the edge of the one below.

    At share 1 all stand on the edge: with k blocks above an edge, their centre of gravity is there
    if each is beyond the next by 1/2, 1/4, ... from the top.
    """
    x, parts, marks = 0.0, [((0.0, 0.0), (1.0, 0.2), (facets, 2))], [(GROUND, at(1, 0.0), 1)]
    for k in range(1, blocks):
        x += share * 0.5 / (blocks - k)
        parts.append(((x, 0.2 * k), (x + 1.0, 0.2 * (k + 1)), (facets, 2)))
        marks += [(10 * k + body, at(1, 0.2 * k), body) for body in (k, k + 1)]
    scene = Scene.of_boxes(MPI.COMM_SELF, "quadrilateral", parts, marks, young=1e7)
    scene.L = -scene.constant(1.0) * scene.v[1] * scene.dx
    scene.fix(GROUND)
    for k in range(1, blocks):
        sides = (10 * k + k, 10 * k + k + 1)
        scene.add_pair(*(sides if slave == "lower" else sides[::-1]), roles="given")
    return scene.problem()


@pytest.mark.parametrize("slave", ["lower", "upper"])
@pytest.mark.parametrize("facets", heavy_from(10, [10, 20, 40]))
@pytest.mark.parametrize("blocks", [2, 3])
def test_stack_falls_at_its_limit(blocks, facets, slave):
    stack(blocks, facets, 0.99, slave).solve()
    with pytest.raises(UnresistedMotion):
        stack(blocks, facets, 1.01, slave).solve()


@pytest.mark.parametrize(
    ("t", "degree"),
    [(0.02, 1), (0.1, 1), (0.3, 1), (0.5, 1), (0.95, 1), (0.1, 2), (0.5, 2)]
    + [pytest.param(t, 2, marks=pytest.mark.heavy) for t in (0.02, 0.3, 0.95)],
)
def test_edge_anywhere_in_a_facet(t, degree):
    """The upper block, the slave, tips where its centre is at the edge, to a tenth of a facet."""
    k = 10

    def solve(x):
        parts = [((0.0, 0.0), (1.0, 0.2), (k, 2)), ((x, 0.2), (x + 1.0, 0.4), (k, 2))]
        marks = [(GROUND, at(1, 0.0), 1), (LOWER, at(1, 0.2), 1), (UPPER, at(1, 0.2), 2)]
        scene = Scene.of_boxes(
            MPI.COMM_SELF, "quadrilateral", parts, marks, degree=degree, young=1e7
        )
        places, upper = scene.mesh.geometry.x, scene.nodes(2)
        inner = upper[(places[upper, 0] > x + 1e-9) & (places[upper, 0] < x + 1.0 - 1e-9)]
        # the edge of the lower block is at t of a facet where the upper one tips
        places[inner, 0] -= (t if t <= 0.5 else t - 1.0) / k
        scene.L = -scene.constant(1.0) * scene.v[1] * scene.dx
        scene.fix(GROUND)
        scene.add_pair(UPPER, LOWER, partners=Mortar(), roles="given")
        scene.problem().solve()

    solve(0.5 - 0.1 / k)
    with pytest.raises(UnresistedMotion):
        solve(0.5 + 0.1 / k)


# -- a stiff foot on a soft table --------------------------------------------------------------


def stiff_foot(cell, n, t, ratio=1e3, degree=1, apart=0.0, **of_pair):
    """Return a scene, solved, its depth and the corner: a foot whose edges are at t of a facet."""
    up = dimension(cell) - 1
    low, m = 0.2 - t / n, max(6 * n // 10, 4) + (t > 0.0)
    high, half = 1.0 - low, max(n // 2, 1)
    parts = [((0.0,) * up + (0.0,), (1.0,) * up + (0.5,), (n,) * up + (half,))]
    parts += [((low,) * up + (0.5,), (high,) * up + (1.0,), (m,) * up + (half,))]
    marks = [(GROUND, at(up, 0.0)), (LOADED, at(up, 1.0))]
    marks += [(LOWER, at(up, 0.5), 1), (UPPER, at(up, 0.5), 2)]
    scene = Scene.of_boxes(
        MPI.COMM_SELF, cell, parts, marks, young={1: 1.0, 2: ratio}, degree=degree
    )
    scene.fix(GROUND)
    scene.fix(LOADED, value=0.0)
    value = np.zeros(up + 1)
    value[up] = -0.01
    dofs = fem.locate_dofs_topological(scene.V, up, scene.facet_tags.find(LOADED))
    scene.bcs[-1] = fem.dirichletbc(value, dofs, scene.V)
    scene.mesh.geometry.x[scene.nodes(2), up] += apart
    scene.add_pair(LOWER, UPPER, partners=Mortar(), roles="given", **of_pair)
    problem = scene.problem(options={"rtol": 1e-9})
    return scene, problem, problem.solve(), low


def sink(scene, uh, low, n, apart=0.0):
    """Return by how much the foot's corner is below the table there, over the approach."""
    up = scene.gdim - 1
    x = scene.V.tabulate_dof_coordinates()[:, : up + 1]
    u = uh.x.array.reshape(-1, up + 1)[:, up]
    corner = np.append(np.full(up, low), 0.5 + apart)
    foot = u[np.linalg.norm(x - corner, axis=1) < 1e-9].min()
    first = np.floor(low * n + 1e-9)
    a, table = low * n - first, 0.0
    for step in np.ndindex(*(2,) * up):
        place = np.append((first + step) / n, 0.5)
        # the table's node is the higher one
        value = u[np.linalg.norm(x - place, axis=1) < 1e-9].max()
        table += value * np.prod(np.where(np.array(step) == 1, a, 1.0 - a))
    return (table - foot) / 0.01


@pytest.mark.parametrize(
    ("cell", "n"),
    [
        ("quadrilateral", 20),
        ("triangle", 20),
        ("hexahedron", 10),
        pytest.param("hexahedron", 20, marks=pytest.mark.heavy),
        pytest.param("tetrahedron", 10, marks=pytest.mark.heavy),
    ],
)
def test_corner_on_mesh_lines_does_not_sink_in(cell, n):
    scene, _, uh, low = stiff_foot(cell, n, 0.0)
    assert abs(sink(scene, uh, low, n)) < 0.02


@pytest.mark.parametrize("t", [0.2, 0.5, 0.9])
def test_corner_inside_of_facets_does_not_sink_in(t):
    scene, problem, uh, low = stiff_foot("quadrilateral", 20, t)
    assert abs(sink(scene, uh, low, 20)) < 0.02
    # the pressure at the foot's edge is singular; over the covered part of a facet it is 50
    found = problem.results[0]
    pressure, middle = found.pressure, np.abs(found.coordinates[:, 0] - 0.5) < 0.1
    assert pressure.max() < 6.0 * np.median(pressure[middle])
    assert pressure @ found.area == pytest.approx(found.nodal_normal_force.sum(), rel=1e-12)


def test_corner_with_displacements_of_degree_2():
    """The conditions are means, not values at nodes: 2.0 %, 1.6 % with the edge on a mesh line."""
    scene, _, uh, low = stiff_foot("quadrilateral", 10, 0.5, ratio=1.0, degree=2)
    assert 0.0 < sink(scene, uh, low, 10) < 0.025


@pytest.mark.parametrize(
    ("apart", "initial_gap"), [(0.0, "geometric"), (0.0, "touching"), (0.02, 0.0)]
)
@pytest.mark.parametrize(("t", "degree"), [(0.0, 1), (0.09, 1), (0.5, 1), (0.5, 2)])
def test_corner_in_the_other_body_is_told(t, degree, apart, initial_gap):
    """A strip of 0.09 of a facet has no condition of its own; those of degree 2 are of means."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        scene, problem, uh, low = stiff_foot(
            "quadrilateral", 10, t, degree=degree, apart=apart, initial_gap=initial_gap
        )
    told = [str(w.message) for w in found if "is inside the other body" in str(w.message)]
    depth = problem.report.contacts[0].penetration
    if degree == 1:
        # the depth is perpendicular to the table's facet, which is inclined
        corner = 0.01 * sink(scene, uh, low, 10, apart)
        # over an initial gap the point opposite is a little farther along an inclined table
        rounding = 1e-9 + 2e-3 * apart
        assert depth == pytest.approx(corner, rel=0.1, abs=rounding)
    if t == 0.09 or degree == 2:
        assert depth > 2e-4
        assert len(told) == 1
        y = f"{0.5 + apart:.3g})"
        assert any(f"a node at ({x:.3g}, {y}" in told[0] for x in (low, 1.0 - low))
    else:
        assert depth <= rounding
        assert not told


# -- patch test with two masters ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("cell", "joint"),
    [
        ("quadrilateral", 0.437),
        ("triangle", 0.403),
        ("hexahedron", 0.403),
        ("tetrahedron", 0.437),
        pytest.param("quadrilateral", 0.403, marks=pytest.mark.heavy),
        pytest.param("triangle", 0.437, marks=pytest.mark.heavy),
        pytest.param("hexahedron", 0.437, marks=pytest.mark.heavy),
        pytest.param("tetrahedron", 0.403, marks=pytest.mark.heavy),
    ],
)
def test_joint_of_two_masters_anywhere_in_the_facets(cell, joint):
    """Uniform pressure without Poisson's effect: the displacement is linear."""
    d = dimension(cell)
    low, n = (0.0,) * (d - 1), 4 if d == 3 else 5
    parts = [
        ((*low, 0.0), (1.0,) * d, (n,) * d),
        ((*low, 1.0), (joint, *(1.0,) * (d - 2), 2.0), (3,) * d),
        ((joint, *low[1:], 1.0), (*(1.0,) * (d - 1), 2.0), (2,) * d),
    ]
    marks = [(GROUND, at(d - 1, 0.0)), (LOADED, at(d - 1, 2.0))]
    marks += [(10 + body, at(d - 1, 1.0), body) for body in (1, 2, 3)]
    scene = Scene.of_boxes(MPI.COMM_SELF, cell, parts, marks)
    e = ufl.sym(ufl.grad(scene.u))
    scene.a = 1e3 * ufl.inner(e, ufl.sym(ufl.grad(scene.v))) * ufl.dx
    scene.add_load(LOADED, -1.0)
    scene.fix(GROUND)
    for axis in range(d - 1):
        scene.fix(LOADED, axis)
    for master in (12, 13):
        scene.add_pair(11, master, partners=Mortar(), roles="given")
    problem = scene.problem(options={"rtol": 1e-11})
    u = problem.solve().x.array.reshape(-1, d)[:, d - 1]
    height = scene.V.tabulate_dof_coordinates()[:, d - 1]
    assert np.abs(u + 1e-3 * height).max() < 1e-10 * 2e-3
    for contact in problem.results:
        np.testing.assert_allclose(contact.pressure, 1.0, rtol=1e-8)
        # also without the means
        np.testing.assert_allclose(contact.nodal_normal_force / contact.area, 1.0, rtol=1e-7)


# -- meshes of gmsh --------------------------------------------------------------------------------


def foot_of_tetrahedra(path, size, low, width):
    """Mesh a block on a table of 1 m."""
    with gmsh_model(path, 3) as gmsh:
        occ = gmsh.model.occ
        bodies = occ.addBox(0, 0, 0, 1, 1, 1), occ.addBox(low, low, 1, width, width, 1)
        occ.synchronize()
        faces = [(0, 0.0, GROUND), (0, 1.0, LOWER), (1, 1.0, UPPER), (1, 2.0, LOADED)]
        for body, height, tag in faces:
            found = [
                face
                for _, face in gmsh.model.getBoundary([(3, bodies[body])], oriented=False)
                if abs(occ.getCenterOfMass(2, face)[2] - height) < 1e-9
            ]
            gmsh.model.addPhysicalGroup(2, found, tag)
        for number, body in enumerate(bodies, 1):
            gmsh.model.addPhysicalGroup(3, [body], number)
        gmsh.option.setNumber("Mesh.MeshSizeMax", size)
    return read_msh(path, MPI.COMM_SELF)


@pytest.mark.parametrize(
    ("size", "low", "width"),
    [
        (0.25, 0.2, 0.6),
        *(
            pytest.param(*case, marks=pytest.mark.heavy)
            for case in [
                (0.25, 0.23, 0.5),
                (0.2, 0.2, 0.6),
                (0.2, 0.17, 0.55),
                (0.15, 0.2, 0.6),
                (0.15, 0.26, 0.45),
                (0.12, 0.2, 0.6),
            ]
        ),
    ],
)
def test_largest_pressure_on_meshes_of_tetrahedra(tmp_path, size, low, width):
    """Table nodes beside the block are covered by any small part; 17,000 times as much once."""
    bodies = foot_of_tetrahedra(str(tmp_path / "foot.msh"), size, low, width)
    largest, products = [], []
    for slave in (LOWER, UPPER):
        scene = Scene.of(bodies)
        scene.add_load(LOADED, -1e6)
        scene.fix(GROUND)
        scene.add_pair(slave, LOWER + UPPER - slave, roles="given")
        problem = scene.problem()
        problem.solve()
        largest.append(problem.results[0].pressure.max())
        products.append(problem.report.products["total"])
    assert 0.7 < largest[0] / largest[1] < 1.3
    assert products[0] <= 1.6 * products[1]


# -- finite sliding ----------------------------------------------------------------------------


def sliding(lower, upper, young, slave, approach, distance, steps=20, friction=None):
    """Return the normal force at each step while the upper block slides by a distance."""
    marks = [(GROUND, at(1, 0.0)), (LOWER, at(1, lower[1][1]), 1), (UPPER, at(1, lower[1][1]), 2)]
    marks += [(LOADED, at(1, upper[1][1]))]
    scene = Scene.of_boxes(MPI.COMM_SELF, "quadrilateral", [lower, upper], marks, young=young)
    u, top = fem.Function(scene.V), fem.Constant(scene.mesh, np.zeros(2))
    scene.fix(GROUND)
    dofs = fem.locate_dofs_topological(scene.V, 1, scene.facet_tags.find(LOADED))
    bcs = [*scene.bcs, fem.dirichletbc(top, dofs, scene.V)]
    scene.add_pair(
        slave, LOWER + UPPER - slave, partners=Mortar(), roles="given", friction=friction
    )
    energy = neo_hookean(scene.young, 0.3)(u) * ufl.dx(metadata={"quadrature_degree": 3})
    F = ufl.derivative(energy, u, scene.v)
    problem = NonlinearContactProblem(F, u, bcs=bcs, contacts=scene.contacts)
    forces = []
    for k in range(steps + 1):
        top.value[:] = distance * k / steps, -approach
        problem.solve()
        forces.append(abs(problem.results[0].force[1]))
    return np.array(forces)


@pytest.mark.heavy
def test_steps_of_force_of_a_foot_that_slides_over_facets():
    """A stiff foot over one facet of a soft table, which is the slave."""
    lower, upper = ((0, 0), (1, 0.5), (20, 10)), ((0.21, 0.5), (0.6, 0.8), (11, 6))
    forces = sliding(lower, upper, {1: 1.0, 2: 1e2}, LOWER, 0.02, 0.05)
    assert np.abs(np.diff(forces)).max() < 0.035 * forces.mean()


@pytest.mark.heavy
@pytest.mark.parametrize("mu", [0.0, 0.3])
def test_steps_of_force_of_a_block_that_slides_over_an_edge(mu):
    """The block is the slave; of its 10 facets, 2 leave a stiff table."""
    lower, upper = ((0, 0), (0.6, 0.2), (16, 5)), ((0.197, 0.2), (0.597, 0.4), (10, 5))
    friction = Coulomb(mu) if mu else None
    forces = sliding(lower, upper, {1: 1e2, 2: 1.0}, UPPER, 0.01, 0.08, friction=friction)
    assert np.abs(np.diff(forces)).max() < 0.035 * forces.mean()

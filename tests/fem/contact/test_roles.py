"""Which of two surfaces is better the slave."""

import warnings

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from mortar_blocks import LOWER, UPPER, Blocks
from scenes import YOUNG, at

import ufl
from dolfinx import fem
from dolfinx.mesh import meshtags

from fenics_tfeti import ContactPair, ContactProblem, Coulomb, Deformed, Mortar
from fenics_tfeti.fem.contact.search.roles import nodal_stiffness, roles_ratios
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.io import (
    Box,
    boxes,
    contact_fields,
    displacement_space,
    tag_facets,
)

TOP, BOTTOM = 1, 2


def posed(cell="triangle", upper_young=YOUNG, lower=4, upper=4, weight=None, **pair):
    """Two clamped blocks, of which the upper one may be of another material."""
    shape = Blocks(cell, lower, upper)
    up = shape.gdim - 1
    marks = [*shape.contact, (TOP, at(up, 2.0)), (BOTTOM, at(up, 0.0))]
    scene = shape.scene(marks=marks, young={1: YOUNG, 2: upper_young})
    scene.fix(BOTTOM)
    scene.fix(TOP, up, -1e-3)
    scene.add_pair(**{"slave": UPPER, "master": LOWER, "partners": Mortar(), **pair})
    measure_weight = None if weight is None else weight(scene.mesh)
    return scene.problem(options={"rtol": 1e-9}, measure_weight=measure_weight)


def ratio_of(problem):
    stiffness = nodal_stiffness(problem._torn.nodes, problem.system.subdomains)
    all_conditions = problem._torn.undeformed.all_conditions[:1]
    return roles_ratios(MPI.COMM_WORLD, all_conditions, stiffness)[0]


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_ratio_of_moduli_and_sizes(cell):
    assert ratio_of(posed(cell)) == pytest.approx(1.0, rel=1e-12)
    assert ratio_of(posed(cell, upper_young=3 * YOUNG)) == pytest.approx(3.0, rel=1e-12)
    # facets half as large; cells are as high as before
    assert 1.5 < ratio_of(posed(cell, upper=8, roles="given")) < 8.0


def test_bad_choice_is_a_warning():
    with pytest.warns(UserWarning, match=r"contact 0 \(pair\): the slave .* 50 times .*roles"):
        posed(upper_young=50 * YOUNG, roles="given")


def test_good_choice_is_none():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        posed(upper_young=YOUNG / 50)
        posed(upper_young=50 * YOUNG)


@pytest.mark.parametrize(("upper_young", "slave"), [(50 * YOUNG, LOWER), (YOUNG / 50, UPPER)])
def test_automatic_roles(upper_young, slave):
    problem = posed(upper_young=upper_young, upper=5)
    uh = problem.solve()
    entry = problem.report.contacts[0].matching
    assert (entry["slave"], entry["master"]) == (slave, LOWER + UPPER - slave)
    assert problem.results[0].on_master == (slave == LOWER)
    assert problem.report.contacts[0].roles_ratio < 1.0
    assert ("slave and master are exchanged" in str(problem.report)) == (slave == LOWER)
    np.testing.assert_allclose(problem.results[0].normal[:, 1], -1.0, rtol=1e-12)
    other = posed(upper_young=upper_young, slave=slave, master=LOWER + UPPER - slave, upper=5)
    np.testing.assert_allclose(uh.x.array, other.solve().x.array, atol=1e-9)
    # again, with the same roles
    problem.solve()
    assert problem.report.contacts[0].matching["slave"] == slave


def test_exact_passes_of_exchanged_roles():
    problem = posed(upper_young=50 * YOUNG, upper=5)
    problem.gaps = Deformed()
    problem.solve()
    assert problem.report.converged


@pytest.mark.parametrize("roles", ["given", "auto"])
@pytest.mark.filterwarnings("ignore:contact 0")
def test_forces_are_those_on_the_given_slave(roles):
    problem = posed(upper_young=50 * YOUNG, upper=5, roles=roles, friction=Coulomb(0.3))
    problem.solve()
    contact, report = problem.results[0], problem.report
    assert contact.on_master == (roles == "auto")
    force = report.contacts[0].force
    assert force[1] > 0.0
    scale = 1e-9 * force[1]
    np.testing.assert_allclose(report.contacts[0].force_on_master, -np.array(force), atol=scale)
    assert report.contacts[0].force == force
    at_nodes = contact.friction.force.sum(axis=0) - contact.nodal_normal_force @ contact.normal
    np.testing.assert_allclose(at_nodes, force, atol=scale)
    friction = contact.friction
    np.testing.assert_allclose(friction.traction * contact.area[:, None], friction.force)
    dissipated = -np.sum(friction.force * friction.slip, axis=1)
    np.testing.assert_allclose(dissipated, friction.work, atol=1e-9 * friction.work.max())
    assert friction.work.max() > 0.0
    # the field is the force on the body that has the nodes
    drawn = contact_fields(problem.space, [contact]).force.x.array.reshape(-1, 2).sum(axis=0)
    np.testing.assert_allclose(drawn[1], -force[1] if roles == "auto" else force[1], rtol=1e-9)


def test_roles_that_are_a_little_worse_stay():
    problem = posed(upper_young=3 * YOUNG)
    problem.solve()
    assert not problem.results[0].on_master
    assert problem.report.contacts[0].roles is None


def values(domain):
    """Return a weight with values at the nodes."""
    weight = fem.Function(scenes.scalar_space(domain))
    weight.x.array[:] = 1.0
    return weight


@pytest.mark.filterwarnings("ignore:contact 0")
@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("normal", {"normal": (0.0, -1.0)}),
        ("initial_gap", {"initial_gap": lambda x: 0.0 * x[0]}),
        ("friction", {"friction": Coulomb(lambda x: 0.3 + 0.0 * x[0])}),
    ],
)
def test_roles_stay_where_data_belong_to_the_slave(name, data):
    problem = posed(upper_young=50 * YOUNG, **data)
    problem.solve()
    assert not problem.results[0].on_master
    assert f"'{name}' belongs to the given slave" in str(problem.report)


@pytest.mark.parametrize(
    "data",
    [
        {"initial_gap": 1e-5},
        {"initial_gap": "touching"},
        {"friction": Coulomb(0.3)},
        {"weight": lambda domain: 1.0 + ufl.SpatialCoordinate(domain)[0]},
        {"weight": values},
    ],
)
def test_data_of_both_sides_do_not_keep_the_roles(data):
    problem = posed(upper_young=50 * YOUNG, **data)
    problem.solve()
    assert problem.results[0].on_master


def without_area(mesh, facets):
    """Return a weight that is 1, and negative at nodes of facets: they can be no slave's."""
    weight = values(mesh)
    weight.x.array[fem.locate_dofs_topological(weight.function_space, 1, facets)] = -1.0
    return weight


@pytest.mark.filterwarnings("ignore:joint")
def test_roles_stay_where_the_master_can_be_no_slave():
    marks = [(BOTTOM, at(1, 0.0), 1), (LOWER, at(1, 1.0), 1)]
    marks += [(UPPER, at(1, 1.0), 2), (TOP, at(1, 2.0), 2)]
    scene = Blocks("quadrilateral", 4, 6).scene(marks=marks, young={1: YOUNG, 2: 50 * YOUNG})
    scene.fix(BOTTOM)
    scene.fix(TOP, 1, -1e-3)
    scene.add_pair(UPPER, LOWER, name="joint")
    weight = without_area(scene.mesh, scene.facet_tags.find(LOWER))
    problem = scene.problem(measure_weight=weight)
    problem.solve()
    assert not problem.results[0].on_master
    assert "joint: slave and master are as given, though E / h" in str(problem.report)


@pytest.mark.filterwarnings("ignore:joint")
def test_pairs_are_exchanged_but_those_that_cannot_be():
    """Of three stiff blocks on soft ones; the second master can be no slave."""
    columns = [Box((2 * k, y), (2 * k + 1, y + 1), (3 + y, 2)) for k in range(3) for y in (0, 1)]
    mesh = boxes(MPI.COMM_SELF, columns, "quadrilateral").mesh
    bodies = find_bodies(mesh, None)
    of_cell = meshtags(mesh, 2, np.arange(bodies.of_cell.size), bodies.of_cell.astype(np.int32))
    marks = [(1 + k, lambda x: np.isclose(x[1], 1.0), k) for k in range(6)]
    tags = tag_facets(mesh, marks, of_cell)
    V = displacement_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    young = ufl.conditional(ufl.gt(ufl.SpatialCoordinate(mesh)[1], 1.0), 50 * YOUNG, YOUNG)
    a = young * ufl.inner(ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v))) * ufl.dx
    pairs = [ContactPair(tags, 2 + k, 1 + k, name=f"joint {k}") for k in (0, 2, 4)]
    load = ufl.inner(ufl.as_vector([0.0, -1.0]), v) * ufl.dx
    weight = without_area(mesh, tags.find(3))
    problem = ContactProblem(a, load, contacts=pairs, measure_weight=weight)
    roles = [found.roles for found in problem._torn.undeformed.contacts]
    assert [entry.used is entry.given for entry in roles] == [False, True, False]
    assert ["are exchanged" in entry.reason for entry in roles] == [True, False, True]
    assert "the other way round joint 2: the master covers" in roles[1].reason


def test_matching_nodes_have_no_roles():
    problem = scenes.two_beams(MPI.COMM_SELF, "triangle", 3).problem()
    assert ratio_of(problem) is None

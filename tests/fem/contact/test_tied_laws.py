"""Tied surfaces with a law: bonds that break, and elastic layers."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from columns import FOOT, MASTER, MESHES, SLAVE, TOP, YOUNG, columns, pulled, shear, sheared
from scenes import plane

from fenics_tfeti import (
    Cohesive,
    ContactPair,
    Deformed,
    ElasticLayer,
    InputError,
    SoftContact,
    TiedPair,
    Tresca,
)

# mm-N-MPa
OPTIONS = {"rtol": 1e-11, "subdomain_size": 60, "damage_rtol": 1e-10}
BOND = {"strength": 5.0, "energy": 0.05, "stiffness": 2500.0}
TAGS = columns("quadrilateral").facet_tags


def tied(scene, law, **more):
    """Tie the halves of columns by a law."""
    scene.contacts = [TiedPair(scene.facet_tags, SLAVE, MASTER, law=law, **more)]


@MESHES
def test_a_tie_that_breaks_is_contact(cell, upper):
    """As the same bond of a contact: on the falling line, failed, pressed."""
    results = []
    for is_tied in (True, False):
        scene = columns(cell, upper)
        moved = pulled(scene, 0.0)
        scene.add_pair(law=Cohesive(**BOND), name="bond", initial_gap=0.0)
        if is_tied:
            tied(scene, Cohesive(**BOND), name="bond")
        problem = scene.problem(options=OPTIONS)
        for displacement in (0.014, 0.03, -0.01):
            moved.x.array.reshape(-1, scene.gdim)[:, -1] = displacement
            problem.solve()
            bond = problem.results["bond"]
            results.append((bond.pressure, bond.opening, bond.damage))
            problem.advance()
    for of_tie, of_contact in zip(results[:3], results[3:], strict=True):
        for one, other in zip(of_tie, of_contact, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(results[2][0], 0.005 * YOUNG, rtol=1e-7)
    assert (results[2][2] == 1.0).all()


def test_a_gap_between_tied_meshes_is_no_opening():
    """What is meshed a little apart is one at first, and a name of its own."""
    scene = columns("quadrilateral")
    scene.mesh.geometry.x[scene.nodes(2), 1] += 0.01
    pulled(scene, 0.004)
    tied(scene, Cohesive(**BOND))
    problem = scene.problem(options=OPTIONS)
    problem.solve()
    assert problem.report.contacts[0].name == "tied pair 0"
    assert problem.results[0].opening.max() < 0.002


@MESHES
@pytest.mark.parametrize("displacement", [0.01, -0.01])
def test_layer_that_is_pulled_or_pressed(cell, upper, displacement):
    scene = columns(cell, upper)
    pulled(scene, displacement)
    tied(scene, ElasticLayer(300.0), name="layer")
    problem = scene.problem(options=OPTIONS)
    problem.solve()
    layer, stress = problem.results["layer"], displacement / (2.0 / YOUNG + 1.0 / 300.0)
    np.testing.assert_allclose(layer.pressure, -stress, rtol=1e-9)
    np.testing.assert_allclose(layer.opening, stress / 300.0, rtol=1e-9)
    assert problem.report.certificate.guaranteed
    # of the columns and of the layer
    assert problem.report.energy == pytest.approx(0.5 * stress * displacement, rel=1e-9)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
@pytest.mark.parametrize("shear_stiffness", [None, 100.0])
def test_layer_that_is_sheared(cell, shear_stiffness):
    """In load steps, too: there and back."""
    scene, moved = sheared(cell)
    tied(scene, ElasticLayer(300.0, shear_stiffness), name="layer")
    problem = scene.problem(options=OPTIONS)
    for displacement in (0.01, -0.005):
        shear(moved, displacement)
        problem.solve()
        layer = problem.results["layer"]
        stress = displacement / (4.0 / YOUNG + 1.0 / (shear_stiffness or 300.0))
        np.testing.assert_allclose(layer.friction.traction[:, 0], -stress, rtol=1e-9)
        problem.advance()


def test_layer_that_leaves_surfaces_free_to_slide():
    scene, moved = sheared()
    tied(scene, ElasticLayer(300.0, shear_stiffness=0.0), name="layer")
    problem = scene.problem(options=OPTIONS)
    shear(moved, 0.01)
    problem.solve()
    assert problem.results["layer"].friction is None
    assert problem.report.energy == pytest.approx(0.0, abs=1e-12)


def test_stiff_layer_is_a_tie():
    displacements = []
    for law in (None, ElasticLayer(1e9 * YOUNG)):
        scene = columns("quadrilateral", 5)
        scene.add_load(TOP, (0.3, 1.0))
        tied(scene, law)
        problem = scene.problem(options={"rtol": 1e-10})
        displacements.append(problem.solve().x.array.copy())
    np.testing.assert_allclose(displacements[1], displacements[0], atol=1e-7 * 0.01)


def test_a_layer_alone_holds_a_body():
    """On a foundation that pulls, too, against forces and moments."""
    scene = columns("quadrilateral")
    scene.bcs = []
    scene.add_load(TOP, (0.5, 2.0))
    scene.contacts = [TiedPair(scene.facet_tags, SLAVE, MASTER)]
    scene.add_obstacle(FOOT, plane(1, 2), law=ElasticLayer(300.0), name="ground")
    problem = scene.problem(options={"rtol": 1e-9})
    problem.solve()
    ground = problem.results["ground"]
    np.testing.assert_allclose(ground.entry.force, (-0.5, -2.0), rtol=1e-7)
    # the moment of the load at the height 2
    moment = np.sum((ground.coordinates[:, 0] - 0.5) * ground.nodal_normal_force)
    assert moment == pytest.approx(1.0, rel=1e-7)


@pytest.mark.ranks(2, 3)
@pytest.mark.parametrize("upper", [4, 5])
def test_laws_of_ties_on_several_ranks(upper):
    scene = columns("quadrilateral", upper, MPI.COMM_WORLD)
    moved = pulled(scene, 0.01)
    tied(scene, ElasticLayer(300.0), name="joint")
    problem = scene.problem(options=OPTIONS)
    problem.solve()
    stress = 0.01 / (2.0 / YOUNG + 1.0 / 300.0)
    np.testing.assert_allclose(problem.results["joint"].pressure, -stress, rtol=1e-9)
    problem.contacts = [TiedPair(scene.facet_tags, SLAVE, MASTER, law=Cohesive(**BOND))]
    moved.x.array.reshape(-1, 2)[:, 1] = 0.03
    problem.solve()
    np.testing.assert_allclose(problem.results[0].damage, 1.0)


@pytest.mark.parametrize(("wrong", "message"), [
    (lambda: TiedPair(TAGS, 5, 6, law=SoftContact(1.0)), "law is a SoftContact; Cohesive"),
    (lambda: ElasticLayer(0.0), "ElasticLayer: the stiffness is 0.0; a positive number"),
    (lambda: ElasticLayer(1.0, -1.0), "ElasticLayer: the shear_stiffness is -1.0"),
    (lambda: ContactPair(TAGS, 5, 6, law=ElasticLayer(1.0), friction=Tresca(1.0)),
     "an ElasticLayer holds along the surfaces: leave friction out"),
])  # fmt: skip
def test_wrong_laws_are_named(wrong, message):
    with pytest.raises(InputError, match=message):
        wrong()


def test_where_ties_may_have_no_law():
    scene = columns("quadrilateral", 5)
    tied(scene, ElasticLayer(lambda x: x[0]))
    with pytest.raises(InputError, match="stiffness of an elastic layer is not positive at 1"):
        scene.problem()
    tied(scene, ElasticLayer(1.0))
    with pytest.raises(InputError, match="small strains on undeformed surfaces, but gaps=Deformed"):
        scene.problem(gaps=Deformed())
    scene.mesh.geometry.x[scene.nodes(2), 1] += 1.0
    with pytest.raises(InputError, match="apart, or overlap, by more than half a facet at 6"):
        scene.problem()

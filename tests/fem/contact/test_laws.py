"""Soft contact, adhesion and elastic slip, in columns of uniform stress."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from columns import FOOT, MASTER, MESHES, SLAVE, TOP, YOUNG, columns, pulled, shear, sheared
from scenes import plane, scalar_space
from scipy.optimize import brentq

import ufl
from dolfinx import fem

from fenics_tfeti import (
    Adhesive,
    Cohesive,
    ContactPair,
    Coulomb,
    Deformed,
    ElasticBond,
    InputError,
    NonlinearContactProblem,
    RigidObstacle,
    RoughContact,
    SoftContact,
    TiedPair,
    Tresca,
)
from fenics_tfeti.fem.contact.descriptions.arguments import as_contacts

# mm-N-MPa; a certificate of this size leaves errors of stresses below 1e-9
OPTIONS = {"rtol": 1e-11, "subdomain_size": 60}
PATCH = 1e-9
TAGS = columns("quadrilateral").facet_tags


@MESHES
@pytest.mark.parametrize("stiffness", [10.0, 1e5])
def test_soft_contact(cell, upper, stiffness):
    """Two columns and the layer in series, whether meshes match or not."""
    scene = columns(cell, upper)
    pulled(scene, -0.01)
    scene.add_pair(law=SoftContact(stiffness), name="layer")
    problem = scene.problem(options=OPTIONS)
    problem.solve()
    layer, pressure = problem.results["layer"], 0.01 / (2.0 / YOUNG + 1.0 / stiffness)
    np.testing.assert_allclose(layer.pressure, pressure, rtol=PATCH)
    np.testing.assert_allclose(layer.opening, -pressure / stiffness, rtol=PATCH)
    assert layer.active.all()
    assert problem.report.certificate.guaranteed


@MESHES
@pytest.mark.filterwarnings("ignore:.*inside the other body")
def test_stiff_layer_is_hard_contact_and_soft_one_is_none(cell, upper):
    forces = []
    for law in (None, SoftContact(1e7 * YOUNG), SoftContact(1e-7 * YOUNG)):
        scene = columns(cell, upper)
        pulled(scene, -0.01)
        scene.add_pair(law=law)
        problem = scene.problem(options={"rtol": 1e-8})
        problem.solve()
        forces.append(problem.report.contacts[0].normal_force)
    assert forces[1] == pytest.approx(forces[0], rel=1e-6)
    assert forces[2] == pytest.approx(0.01e-7 * YOUNG, rel=1e-6)


@pytest.mark.parametrize("form", [float, "callable", "Function"])
def test_stiffness_that_varies(form):
    """Springs side by side on stiff blocks: pressures follow the stiffness at each node."""
    scene = columns("quadrilateral")
    scene.young.value = 1e9
    pulled(scene, -0.01)

    def stiffness(x):
        return 1.0 + x[0]

    law = 1.5
    if form == "callable":
        law = stiffness
    elif form == "Function":
        law = fem.Function(scalar_space(scene.mesh))
        law.interpolate(stiffness)
    scene.add_pair(law=SoftContact(law))
    problem = scene.problem(options={"rtol": 1e-8})
    problem.solve()
    result = problem.results[0]
    expected = 0.015 if form is float else 0.01 * stiffness(result.coordinates.T)
    np.testing.assert_allclose(result.pressure, expected, rtol=1e-6)


def test_soft_obstacle():
    """Blocks on a soft plane, which carries their load, and nothing else holds along it."""
    scene = columns("quadrilateral")
    scene.bcs = []
    scene.fix(FOOT, 0)
    scene.fix(TOP, 0)
    scene.add_load(TOP, (0.0, -3.0))
    scene.add_pair()
    scene.add_obstacle(FOOT, plane(1, 2), law=SoftContact(50.0), name="ground")
    problem = scene.problem(options=OPTIONS)
    problem.solve()
    ground = problem.results["ground"]
    np.testing.assert_allclose(ground.pressure, 3.0, rtol=PATCH)
    np.testing.assert_allclose(ground.opening, -3.0 / 50.0, rtol=PATCH)


@MESHES
@pytest.mark.parametrize("traction", [3.0, 8.0])
def test_adhesion(cell, upper, traction):
    """The surfaces open where the columns would carry more; the traction stays."""
    scene = columns(cell, upper)
    pulled(scene, 0.01)
    scene.add_pair(law=Adhesive(traction))
    problem = scene.problem(options=OPTIONS)
    problem.solve()
    result, stress = problem.results[0], min(traction, 0.005 * YOUNG)
    np.testing.assert_allclose(result.pressure, -stress, rtol=PATCH)
    opening = 0.01 - 2.0 * stress / YOUNG
    np.testing.assert_allclose(result.opening, opening, atol=1e-11)
    assert result.active.all() == (opening == 0.0)
    # of the columns, and of the traction on the opening
    energy = stress**2 / YOUNG + traction * opening
    assert problem.report.energy == pytest.approx(energy, rel=1e-9)


@MESHES
@pytest.mark.parametrize("displacement", [0.01, -0.01])
def test_elastic_bond(cell, upper, displacement):
    """In series with the columns where it is pulled; pressed it is hard contact."""
    stiffness = 300.0
    scene = columns(cell, upper)
    pulled(scene, displacement)
    scene.add_pair(law=ElasticBond(stiffness))
    problem = scene.problem(options=OPTIONS)
    problem.solve()
    result, soft = problem.results[0], 1.0 / stiffness if displacement > 0.0 else 0.0
    pressure = -displacement / (2.0 / YOUNG + soft)
    np.testing.assert_allclose(result.pressure, pressure, rtol=PATCH)
    np.testing.assert_allclose(result.opening, -pressure * soft, atol=1e-11)


def test_bond_that_is_weakened_between_solves():
    """Where it has failed there is contact; neither factors nor the coarse problem are renewed."""
    scene = columns("quadrilateral")
    scene.young.value = 1e6
    moved = pulled(scene, 0.01)
    stiffness = fem.Function(scalar_space(scene.mesh))
    stiffness.x.array[:] = 2.0
    scene.add_pair(law=ElasticBond(stiffness))
    problem = scene.problem(options={"rtol": 1e-8})
    problem.solve()
    np.testing.assert_allclose(problem.results[0].pressure, -0.02, rtol=1e-5)
    stiffness.interpolate(lambda x: np.maximum(x[0] - 0.5, 0.0))
    problem.solve()
    assert {"factors", "coarse problem", "norm"} <= set(problem.report.reused)
    result = problem.results[0]
    expected = -0.01 * np.maximum(result.coordinates[:, 0] - 0.5, 0.0)
    np.testing.assert_allclose(result.pressure, expected, rtol=1e-4, atol=1e-8)
    moved.x.array[:] *= -1.0
    problem.solve()
    assert (problem.results[0].pressure > 0.0).all()


# -- elastic slip ----------------------------------------------------------------------------------


def test_elastic_slip_goes_back_and_the_rest_stays(tmp_path):
    """Load steps out, back and on again, and a checkpoint between them."""
    stiffness, bound, half = 50.0, 2.0, 0.5 * YOUNG
    series = 1.0 / (2.0 / half + 1.0 / stiffness)
    plastic, stress, work = 0.0, 0.0, 0.0
    problem, moved = None, None
    for step, displacement in enumerate([0.02, 0.1, 0.05, -0.05, 0.0]):
        if step in (0, 3):
            # as a later run goes on
            scene, moved = sheared(friction=Tresca(bound, elastic_slip=1.0 / stiffness))
            problem = scene.problem(options=OPTIONS)
            if step:
                assert problem.restore(tmp_path / "state") == step
        shear(moved, displacement)
        problem.solve()
        joint = problem.results["joint"].friction
        tried = series * (displacement - plastic)
        stress = np.clip(tried, -bound, bound)
        yielded = (tried - stress) / series
        plastic, work = plastic + yielded, abs(stress * yielded)
        np.testing.assert_allclose(joint.traction[:, 0], -stress, rtol=1e-7)
        np.testing.assert_allclose(joint.slip[:, 0], stress / stiffness + yielded, rtol=1e-7)
        assert joint.sticking.all() == (abs(tried) < bound)
        assert joint.work.sum() == pytest.approx(work, abs=1e-9)
        assert problem.report.contacts[0].friction_work == pytest.approx(work, abs=1e-9)
        problem.advance()
        problem.save(tmp_path / "state")


def test_elastic_slip_of_coulombs_law():
    """On soft contact: the bound is a part of the pressure, which the springs make."""
    scene = columns("quadrilateral")
    moved = pulled(scene, -0.05)
    moved.x.array.reshape(-1, 2)[:, 0] = 0.002
    scene.add_pair(law=SoftContact(100.0), friction=Coulomb(0.5, elastic_slip=1e-3))
    problem = scene.problem(options={"rtol": 1e-9})
    problem.solve()
    result = problem.results[0]
    friction = result.friction
    np.testing.assert_allclose(friction.bound, 0.5 * result.nodal_normal_force, rtol=1e-6)
    slip = friction.traction[:, 0] * -1e-3
    np.testing.assert_allclose(friction.slip[friction.sticking, 0], slip[friction.sticking])
    assert friction.sticking.any()


# -- rough surfaces --------------------------------------------------------------------------------

SQUARE = RoughContact(lambda d: 1e5 * d.clip(0) ** 2, lambda d: 2e5 * d.clip(0))
ROUGH = {
    "square": SQUARE,
    "power": RoughContact(lambda d: 1e4 * d.clip(0) ** 1.5, lambda d: 1.5e4 * d.clip(0) ** 0.5),
    "exponential": RoughContact(lambda d: 2.0 * np.exp(d / 2e-3), lambda d: 1e3 * np.exp(d / 2e-3)),
    "linear": RoughContact(lambda d: 500.0 * d.clip(0), lambda d: 500.0 * (d > 0.0)),
}


def in_series(law: RoughContact, moved: float) -> float:
    """Return the pressure of columns whose top has moved down."""
    return brentq(
        lambda p: p - float(law.pressure(np.array([moved - 2.0 * p / YOUNG]))[0]), 0.0, 1e4
    )


@MESHES
@pytest.mark.parametrize("law", ROUGH)
def test_rough_contact(cell, upper, law):
    """Two columns and the law in series: pressed more, less, apart and pressed again."""
    scene = columns(cell, upper)
    moved = pulled(scene, 0.0)
    scene.add_pair(law=ROUGH[law], name="rough")
    problem = scene.problem(options={"rtol": 1e-9, "subdomain_size": 60})
    for displacement in (0.01, 0.02, 0.001, -0.003, 0.01):
        moved.x.array.reshape(-1, scene.gdim)[:, -1] = -displacement
        problem.solve()
        rough, pressure = problem.results["rough"], in_series(ROUGH[law], displacement)
        np.testing.assert_allclose(rough.pressure, pressure, rtol=1e-6, atol=1e-12)
        assert 1 <= len(problem.report.rough_products) <= 8
        followed = ROUGH[law].pressure(-rough.opening)
        np.testing.assert_allclose(rough.pressure, followed, rtol=1e-6, atol=1e-12)
        problem.advance()


def test_a_body_that_only_its_weight_holds_on_a_rough_floor():
    """The pressure is the weight over the area; sideways friction carries a part of it."""
    scene = columns("quadrilateral")
    scene.bcs = []
    scene.add_load(TOP, (-0.2, -2.0))
    scene.add_obstacle(FOOT, plane(1, 2), law=SQUARE, friction=Coulomb(0.3), name="ground")
    scene.contacts.append(TiedPair(scene.facet_tags, SLAVE, MASTER))
    problem = scene.problem(options={"rtol": 1e-8})
    problem.solve()
    ground = problem.results["ground"]
    np.testing.assert_allclose(ground.entry.force, (0.2, 2.0), rtol=1e-7)
    np.testing.assert_allclose(ground.pressure, SQUARE.pressure(-ground.opening), rtol=1e-5)


def test_rough_surfaces_make_hertz_contact_wider():
    """As the stiffness grows the pressures become those of hard contact."""
    peaks = []
    for stiffness in (1e3, 1e5, 1e9, None):
        law = stiffness and RoughContact(
            lambda d, c=stiffness: c * d.clip(0) ** 2, lambda d, c=stiffness: 2 * c * d.clip(0)
        )
        scene = columns("quadrilateral", 5)
        pulled(scene, -0.01)
        scene.add_pair(
            law=law or None, initial_gap=lambda x: 0.02 * (x[0] - 0.5) ** 2, name="rough"
        )
        problem = scene.problem(options={"rtol": 1e-9})
        problem.solve()
        peaks.append(problem.results["rough"].pressure.max())
    assert peaks[0] < peaks[1] < peaks[2]
    assert peaks[2] == pytest.approx(peaks[3], rel=1e-2)


@pytest.mark.parametrize(("law", "message"), [
    (RoughContact(lambda d: 1.0 + d.clip(0), np.ones_like), "has to grow from zero where surfaces"),
    (RoughContact(lambda d: d.clip(0, 1e-9), np.ones_like), "at no larger one"),
    (RoughContact(lambda d: 1e5 * d.clip(0), np.zeros_like), "stiffness .* is not positive at 5"),
    (RoughContact(lambda d: d.wrong, np.ones_like), "rough: the pressure of RoughContact failed"),
    (RoughContact(lambda d: 1e3 * d, np.ones_like), "is negative, NaN or infinite at"),
])  # fmt: skip
def test_wrong_laws_of_the_approach(law, message):
    scene = columns("quadrilateral")
    pulled(scene, -0.01)
    scene.add_pair(law=law, name="rough")
    problem = scene.problem()
    with pytest.raises(InputError, match=message):
        problem.solve()
    assert not problem.u.x.array.any()


# -- ranks, messages -------------------------------------------------------------------------------


@pytest.mark.ranks(2, 3)
@pytest.mark.parametrize("law", [SoftContact(300.0), SQUARE, Adhesive(3.0), ElasticBond(300.0)])
@pytest.mark.parametrize("upper", [4, 5])
def test_laws_on_several_ranks(law, upper):
    scene = columns("quadrilateral", upper, MPI.COMM_WORLD)
    soft = isinstance(law, SoftContact | RoughContact)
    pulled(scene, -0.01 if soft else 0.01)
    scene.add_pair(law=law)
    problem = scene.problem(options=OPTIONS)
    problem.solve()
    series = 0.01 / (2.0 / YOUNG + 1.0 / 300.0)
    pressure = -3.0 if isinstance(law, Adhesive) else series if soft else -series
    rtol = PATCH
    if isinstance(law, RoughContact):
        pressure, rtol = in_series(law, 0.01), 1e-6
    np.testing.assert_allclose(problem.results[0].pressure, pressure, rtol=rtol)


@pytest.mark.parametrize(("wrong", "message"), [
    (lambda: SoftContact(0.0), "SoftContact: the stiffness is 0.0; a positive number"),
    (lambda: Adhesive(-1.0), "Adhesive: the traction is -1.0; a finite number, at least 0"),
    (lambda: RoughContact(1e9, 1e9), "RoughContact: the pressure is 1000000000.0; a function of a"),
    (lambda: as_contacts([bonded(SQUARE), bonded(Cohesive(1.0, 1.0))]), "need solves of their own"),
    (lambda: Coulomb(0.3, elastic_slip=-1.0), "Coulomb: the elastic_slip is -1.0"),
    (lambda: ContactPair(TAGS, 1, 2, law=Tresca(1.0)), "law is a Tresca; SoftContact"),
    (lambda: RigidObstacle(TAGS, 1, plane(1, 2), law="soft"), "law is a str; SoftContact"),
])  # fmt: skip
def test_wrong_laws_are_named(wrong, message):
    with pytest.raises(InputError, match=message):
        wrong()


def bonded(law):
    return ContactPair(TAGS, 1, 2, law=law)


LAWS = [{"law": Adhesive(1.0)}, {"friction": Tresca(1.0, elastic_slip=1.0)}]


@pytest.mark.parametrize("data", LAWS)
def test_what_is_for_undeformed_surfaces_alone(data):
    scene = columns("quadrilateral")
    pulled(scene, -0.01)
    scene.add_pair(**data)
    with pytest.raises(InputError, match="small strains on undeformed surfaces, but gaps=Deformed"):
        scene.problem(gaps=Deformed())
    u = fem.Function(scene.V)
    F = ufl.replace(scene.a, {scene.u: u})
    with pytest.raises(InputError, match="small strains on undeformed surfaces"):
        NonlinearContactProblem(F, u, bcs=scene.bcs, contacts=scene.contacts)
    problem = scene.problem()
    problem.solve()
    with pytest.raises(InputError, match=r"mesh_error\(\) is of hard or soft contact"):
        problem.mesh_error()


def test_stiffness_that_vanishes_somewhere():
    scene = columns("quadrilateral")
    pulled(scene, -0.01)
    scene.add_pair(law=SoftContact(lambda x: x[0]), name="layer")
    with pytest.raises(
        InputError, match="layer: the stiffness of soft contact is not positive at 1"
    ):
        scene.problem()

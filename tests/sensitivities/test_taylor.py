"""Derivatives against differences of solves, and tangents against adjoints."""

from __future__ import annotations

import functools
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from sensitivity_scenes import (
    EXACT,
    RTOL,
    Parameter,
    block_on_roller,
    blocks,
    of_constant,
    of_contact,
    of_function,
    of_mesh,
    taylor,
    tied_stack,
)

from fenics_tfeti import (
    Adhesive,
    Coulomb,
    ElasticBond,
    RigidBody,
    RoughContact,
    SoftContact,
    Sphere,
    Tresca,
)

KINDS = {
    "node pairs": blocks,
    "mortar": partial(blocks, n=4, m=5),
    "degree 2": partial(blocks, n=2, m=2, degree=2),
    "degree 2, mortar": partial(blocks, "quadrilateral", 2, 3, degree=2),
    "axisymmetric": partial(blocks, is_axisymmetric=True),
    "Tresca": partial(blocks, friction=Tresca(1.5e-3)),
    "Tresca, mortar": partial(blocks, n=4, m=5, friction=Tresca(1.5e-3)),
    "Coulomb": partial(blocks, friction=Coulomb(0.3)),
    "Coulomb, mortar": partial(blocks, n=4, m=5, friction=Coulomb(0.2)),
    "3D, mortar": partial(blocks, "hexahedron", 2, 3),
    "3D, Tresca": partial(blocks, "hexahedron", 2, 2, friction=Tresca(1.5e-3)),
    "3D, Coulomb": partial(blocks, "tetrahedron", 2, 3, friction=Coulomb(0.3)),
    "tied": tied_stack,
    "obstacle": block_on_roller,
    "obstacle, Tresca": partial(block_on_roller, Tresca(1.5e-3)),
    "3D obstacle, Coulomb": partial(block_on_roller, Coulomb(0.3), "hexahedron"),
    "body": partial(
        block_on_roller,
        body=RigidBody((0.45, -2.0), force=(0.0, 0.02), rotation=0.0, spring=(0.05, 0.05, 1.0)),
    ),
    "law, soft": partial(blocks, n=4, m=5, friction=Coulomb(0.2), law=SoftContact(0.3)),
    "law, node pairs": partial(blocks, law=SoftContact(0.3)),
    "law, rough": partial(
        blocks, n=4, m=5, law=RoughContact(lambda d: 50 * d.clip(0) ** 2, lambda d: 100 * d.clip(0))
    ),
    "law, bond": partial(blocks, n=4, m=5, law=ElasticBond(0.3)),
    "law, adhesive": partial(blocks, n=4, m=5, law=Adhesive(2e-3)),
    "law, obstacle": partial(block_on_roller, law=SoftContact(0.3)),
    "elastic slip, Tresca": partial(blocks, friction=Tresca(1.5e-3, elastic_slip=4e-3)),
    "elastic slip, Coulomb": partial(blocks, n=4, m=5, friction=Coulomb(0.2, elastic_slip=4e-3)),
    "elastic slip, 3D, Tresca": partial(
        blocks, "hexahedron", 2, 2, friction=Tresca(1.5e-3, elastic_slip=4e-3)
    ),
    "exact gaps": partial(blocks, n=4, m=5, gaps=EXACT),
    "exact gaps, node pairs": partial(blocks, gaps=EXACT),
    "exact gaps, degree 2": partial(blocks, "quadrilateral", 2, 3, degree=2, gaps=EXACT),
    "exact gaps, axisymmetric": partial(blocks, n=4, m=5, is_axisymmetric=True, gaps=EXACT),
    "exact gaps, Tresca": partial(blocks, friction=Tresca(1.5e-3), gaps=EXACT),
    "exact gaps, Coulomb": partial(blocks, n=4, m=5, friction=Coulomb(0.2), gaps=EXACT),
    "exact gaps, 3D": partial(blocks, "hexahedron", 2, 3, gaps=EXACT),
    "exact gaps, 3D, Coulomb": partial(
        blocks, "hexahedron", 2, 3, friction=Coulomb(0.3), gaps=EXACT
    ),
    "exact gaps, obstacle": partial(block_on_roller, gaps=EXACT),
}
PARAMETERS = {
    "modulus": lambda s: of_function(s.E, 4e-4),
    "body force": lambda s: of_function(s.body_force, 1e-4),
    "traction": lambda s: of_constant(s.traction, 1e-4),
    "support": lambda s: of_function(s.clamp, 1e-5),
    "gap": lambda s: of_contact(s, "gap", 1e-5),
    "bound": lambda s: of_contact(s, "bound", 1e-5),
    "coefficient": lambda s: of_contact(s, "coefficient", 1e-3),
    "law": lambda s: of_contact(s, "law", 1e-5),
    "elastic slip": lambda s: of_contact(s, "elastic slip", 1e-4),
    "nodes": lambda s: of_mesh(s, 2e-4),
}


# factors of steps, where J has a large part of third order, or a small one of second
FACTORS = {
    ("exact gaps, 3D, Coulomb", "coefficient"): 0.2,
    ("exact gaps, obstacle", "modulus"): 4.0,
    ("law, bond", "law"): 4.0,
    ("law, obstacle", "law"): 20.0,
    ("law, rough", "gap"): 20.0,
}


@functools.cache
def made(kind):
    return KINDS[kind]()


def solved(kind):
    scene = made(kind)
    scene.problem.contacts = list(scene.contacts)
    scene.solve()
    return scene


def has(kind, name):
    # with exact gaps they are those of the mesh
    if name == "gap" and any(other in kind for other in ("obstacle", "tied", "body", "exact")):
        return False
    # a law of the approach has no numbers at nodes, which stay where they are
    if kind == "law, rough" and name in ("law", "nodes"):
        return False
    law = {"bound": "Tresca", "coefficient": "Coulomb", "law": "law", "elastic slip": "elastic"}
    return law.get(name, "") in kind


# those of other kinds are for the long run
QUICK = ("Coulomb, mortar", "3D, Tresca", "body", "law, soft", "exact gaps, Coulomb")
CASES = [
    pytest.param(
        kind,
        name,
        marks=[pytest.mark.heavy] * (kind not in QUICK and (kind, name) != ("mortar", "nodes")),
    )
    for kind in KINDS
    for name in PARAMETERS
    if has(kind, name)
]


# adjoints alone have them
ALONE = ("law", "elastic slip", "nodes")


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_remainder_of_second_order(kind, name):
    scene = solved(kind)
    parameter = PARAMETERS[name](scene)
    step = FACTORS.get((kind, name), 1.0) * parameter.step
    rates, same = taylor(scene, replace(parameter, step=step))
    assert same
    assert np.all(np.abs(rates - 2.0) < 0.05), rates


@pytest.mark.parametrize(("kind", "name"), [case for case in CASES if case.values[1] not in ALONE])
def test_tangent_is_the_transposed_adjoint(kind, name):
    scene = solved(kind)
    parameter = PARAMETERS[name](scene)
    scene.solve()
    slope = parameter.slope(scene.adjoint())
    tangent = scene.problem.tangent(**parameter.tangent, rtol=RTOL)
    assert scene.change(tangent) == pytest.approx(slope, rel=1e-10)


@pytest.mark.parametrize("kind", ["obstacle", "exact gaps, obstacle"])
def test_obstacle(kind):
    """Its place, by translations, and its radius."""
    scene = solved(kind)
    contact = scene.joint
    centre = np.array([0.45, -2.0])

    def changed(s):
        return replace(contact, obstacle=Sphere(centre + [s, 2 * s], 2.0 + 0.5 * s))

    def set_value(s):
        scene.problem.contacts = [changed(s)]

    along = Parameter(set_value, lambda adjoint: adjoint.by_obstacle("joint", changed), None, 1e-4)
    rates, same = taylor(scene, along)
    assert same and np.all(np.abs(rates - 2.0) < 0.05), rates
    scene.solve()
    adjoint = scene.adjoint()
    radius = adjoint.by_obstacle(
        "joint", lambda s: replace(contact, obstacle=Sphere(centre, 2 + s))
    )
    place = adjoint.by_obstacle("joint")
    assert place @ [1.0, 2.0] + 0.5 * radius == pytest.approx(along.slope(adjoint), rel=1e-7)

"""A roller between two plates: Hertz's line contact, equilibrium, motions that nothing resists."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from mesh_arrays import of_script
from scenes import POISSON, YOUNG, Scene

import ufl
from dolfinx import fem

from fenics_tfeti import Along, UnresistedMotion

pytestmark = pytest.mark.once

RADIUS, LOAD = 0.1, 4e6  # [m], [N/m]
HALF_WIDTH = np.sqrt(8 * LOAD * RADIUS * (1 - POISSON**2) / (np.pi * YOUNG))
PEAK = 2 * LOAD / (np.pi * HALF_WIDTH)


@lru_cache(maxsize=None)
def meshed(elements):
    """Return the bodies, meshed by the script of the demo."""
    return of_script("roller", 2, elements, function="roller_between_plates")


def problem(elements, slave, force=(0.0, 0.0)):
    """Return the problem with a force [N/m] on the roller."""
    bodies = meshed(elements)
    scene, tags = Scene.of(bodies), bodies.names
    scene.add_load(tags["upper outer"], np.array([0.0, -LOAD / 0.4]))
    body_force = scene.constant(np.array(force) / (np.pi * RADIUS**2))
    scene.L += ufl.inner(body_force, scene.v) * scene.dx(tags["roller"])
    scene.fix(tags["lower outer"])
    for side in ("left", "right"):
        scene.fix(tags[f"upper {side}"], 0)
    for where, plate in (("below", "lower"), ("above", "upper")):
        surfaces = tags[f"roller {where}"], tags[f"{plate} inner"]
        round_ = slave == "roller"
        normal = (lambda x: x[:2]) if round_ else None
        roles = surfaces if round_ else surfaces[::-1]
        scene.add_pair(*roles, partners=Along((0, 1)), normal=normal)
    return scene.problem(options={"rtol": 1e-9})


def resultant(contact):
    """Return the force on the slave."""
    return -contact.normal_force @ contact.normal


@pytest.mark.parametrize(
    ("slave", "motion"), [("roller", "rotation through (0, 0)"), ("plates", "translation along (")]
)
def test_pressed_roller(slave, motion):
    """Statics, and Hertz's formulas for half spaces.

    The bodies are 48 and 70 half-widths thick, a half-width 10 elements.
    """
    solved = problem(24, slave)
    solved.solve()
    forces = [resultant(contact) for contact in solved.results]
    up = LOAD if slave == "roller" else -LOAD
    assert [force[1] for force in forces] == pytest.approx([up, -up], rel=1e-8)
    np.testing.assert_allclose(sum(forces), 0.0, atol=1e-8 * LOAD, err_msg="equilibrium")
    for contact in solved.results:
        x, force = contact.coordinates, contact.normal_force
        if slave == "roller":
            n = contact.normal
            moment = force @ (x[:, 0] * n[:, 1] - x[:, 1] * n[:, 0])
            assert abs(moment) <= 1e-12 * LOAD * RADIUS
        width = 2.0 * np.sqrt(force @ x[:, 0] ** 2 / force.sum())
        assert width == pytest.approx(HALF_WIDTH, rel=0.01)
        assert contact.pressure.max() == pytest.approx(PEAK, rel=0.01)
        square = 1.0 - (x[:, 0] / HALF_WIDTH) ** 2
        inner = square > 0.2
        hertz = PEAK * np.sqrt(square[inner])
        np.testing.assert_allclose(contact.pressure[inner], hertz, atol=0.02 * PEAK)
        assert not contact.active[square < -0.3].any()
    # the roller's normals leave it free to spin, the plates' free to slide
    (free,) = solved.report.free_motions
    assert motion in free
    assert "[-0.1, 0.1] x [-0.1, 0.1]" in free


@pytest.mark.parametrize("sign", [1, -1])
def test_force_along_the_plates_is_an_error(sign):
    """It names the body and the motion."""
    with pytest.raises(UnresistedMotion, match=r"body 1 \(roller\) in \[-0.1, 0.1\]") as error:
        problem(6, "plates", force=(sign * 1e3, 0.0)).solve()
    assert f"translation along ({sign}, 0)" in str(error.value)


def test_force_across_the_plates_is_carried():
    """The weight of the roller adds to the lower contact."""
    found = problem(6, "plates", force=(0.0, -1e5))
    found.solve()
    lower, upper = (contact.normal_force.sum() for contact in found.results)
    assert upper == pytest.approx(LOAD, rel=1e-8)
    weight = 1e5 * meshed_area(6) / (np.pi * RADIUS**2)
    assert lower == pytest.approx(LOAD + weight, rel=1e-8)


def meshed_area(elements):
    """Return the area of the roller's polygon."""
    bodies = meshed(elements)
    dx = ufl.Measure("dx", domain=bodies.mesh, subdomain_data=bodies.cell_tags)
    one = fem.Constant(bodies.mesh, 1.0)
    return fem.assemble_scalar(fem.form(one * dx(bodies.names["roller"])))

"""Shrink fit of two rings, meshed apart, against Lamé's formulas.

Both contact surfaces are polygons with the same radius and other numbers of sides; the interference
is prescribed.
"""

from __future__ import annotations

import numpy as np
import pytest
from scenes import MASTER, POISSON, SIDE_X, SIDE_Y, SLAVE, YOUNG, Scene, at
from strips import bend, strips

from fenics_tfeti.io import tag_facets

pytestmark = pytest.mark.once

INNER, RADIUS, OUTER = 0.6, 1.0, 1.5
INTERFERENCE = 1e-3


def lame_pressure():
    """Return the pressure of rings of one material in plane strain."""
    modulus = YOUNG / (1.0 - POISSON**2)
    inside = (RADIUS**2 + INNER**2) / (RADIUS**2 - INNER**2)
    outside = (OUTER**2 + RADIUS**2) / (OUTER**2 - RADIUS**2)
    return INTERFERENCE * modulus / (RADIUS * (inside + outside))


def rings(inner, outer, roles, **pair):
    """Return the solved quarter of two rings with numbers of elements around and through each."""
    V, tags = strips(inner, outer, gap=0.1)
    # the lower strip becomes the inner ring
    sides = [(SIDE_X, at(0, 0.0)), (SIDE_Y, at(0, 1.0))]
    sides += [(MASTER, at(1, 1.0)), (SLAVE, at(1, 1.1))]
    tags = tag_facets(V.mesh, sides)

    def polar(x):
        height = x[:, 1]
        inside = INNER + (RADIUS - INNER) * height
        radius = np.where(height < 1.05, inside, RADIUS + (OUTER - RADIUS) * (height - 1.1))
        angle = 0.5 * np.pi * (1.0 - x[:, 0])
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)

    bend(V, lambda x: np.ones(len(x), dtype=bool), polar)
    scene = Scene(V.mesh, tags)
    scene.fix(SIDE_X, 0)
    scene.fix(SIDE_Y, 1)
    scene.add_pair(*roles, **pair)
    problem = scene.problem()
    problem.solve()
    return problem


@pytest.mark.parametrize("roles", [(SLAVE, MASTER), (MASTER, SLAVE)])
def test_prescribed_interference(roles):
    problem = rings((30, 14), (42, 18), roles, initial_gap=-INTERFERENCE)
    contact = problem.results[0]
    mean = contact.pressure @ contact.area / contact.area.sum()
    assert mean == pytest.approx(lame_pressure(), rel=0.01)
    assert contact.pressure.std() < 0.02 * mean
    assert problem.report.contacts[0].pairing["discretisation"] == "mortar"


def test_touching_rings_have_no_pressure():
    roles = (SLAVE, MASTER)
    geometric = rings((42, 4), (30, 4), roles).results[0]
    touching = rings((42, 4), (30, 4), roles, initial_gap="touching").results[0]
    assert geometric.pressure.max() > 0.1 * lame_pressure()
    assert (touching.gap == 0.0).all()
    assert touching.pressure.max() < 1e-6 * lame_pressure()

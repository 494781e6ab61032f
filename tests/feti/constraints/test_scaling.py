"""Weights of the copies of nodes by multiplicity and by the diagonal of the stiffness."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from torn import column, cube

from fenics_tfeti.feti import ContactRows, Prescribed, TornSystem
from fenics_tfeti.feti.constraints.scaling import node_weights

pytestmark = pytest.mark.once


def cubes(*factors: float) -> TornSystem:
    """Return a column of glued cubes of one element with multiples of one stiffness."""
    parts = []
    for k, factor in enumerate(factors):
        part = cube(1, (0, 0, k))
        parts.append(dataclasses.replace(part, stiffness=factor * part.stiffness))
    return TornSystem(parts, Prescribed(), ContactRows.none(3), 3, ["beam"])


# all nodes of a cube of one element have the same diagonal
DIAGONAL = cube(1).stiffness.diagonal()[0]


def test_stiffness_is_relative_to_the_largest():
    weights = node_weights(cubes(5.0, 0.5, 5e-4), "stiffness").values
    np.testing.assert_allclose(weights, np.repeat([1.0, 0.1, 1e-4], 8), rtol=1e-14)
    assert node_weights(cubes(1.0, 1e-3), "multiplicity").values.tolist() == [1.0] * 16
    # a rank without subdomains
    assert node_weights(cubes(), "stiffness").values.size == 0


def test_stiffness_is_the_mean_over_the_components():
    system = cubes(1.0)
    K = system.subdomains[0].stiffness.tolil()
    K[0, 0], K[1, 1], K[2, 2] = 4 * DIAGONAL, DIAGONAL, DIAGONAL
    part = dataclasses.replace(system.subdomains[0], stiffness=K.tocsr())
    weights = node_weights(dataclasses.replace(system, subdomains=[part]), "stiffness").values
    np.testing.assert_allclose(weights, [1.0] + 7 * [0.5], rtol=1e-14)


@pytest.mark.parametrize("unit", [1e-12, 1e12])
def test_weights_by_stiffness_have_no_unit(unit):
    system = column()
    parts = [dataclasses.replace(s, stiffness=unit * s.stiffness) for s in system.subdomains]
    scaled = dataclasses.replace(system, subdomains=parts)
    weights = node_weights(system, "stiffness").values
    assert weights.max() == 1.0
    np.testing.assert_allclose(node_weights(scaled, "stiffness").values, weights, rtol=1e-14)


def test_stiffness_of_a_weight():
    """The largest diagonal, or the mean one where all weights are equal."""
    system = cubes(4.0, 2.0)
    assert node_weights(system, "stiffness").unit == pytest.approx(4 * DIAGONAL, rel=1e-14)
    assert node_weights(system, "multiplicity").unit == pytest.approx(3 * DIAGONAL, rel=1e-14)

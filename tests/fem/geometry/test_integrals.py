"""Integrals over the covered parts of facets."""

import numpy as np
import pytest
from facet_grids import chain, grid

from fenics_tfeti.fem.geometry.facets import Facets
from fenics_tfeti.fem.geometry.integrals import integrate


def test_exact_mass_of_a_covered_triangle():
    slave = Facets(np.array([[0.0, 0, 0], [2, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    result = integrate(slave, grid((5, 4), (-1, -1), (3, 3), up=False, jitter=0.4))
    assert np.allclose(result.mass[0], (np.ones((3, 3)) + np.eye(3)) / 12.0)
    assert np.allclose(result.ones[0], 1.0 / 3.0)
    assert np.isclose(result.covered[0], 1.0)


def test_half_a_segment():
    result = integrate(chain([1.0, 0.0][::-1]), chain([0.5, 2.0], up=False))
    # corner 0 is at x = 1
    assert np.allclose(result.ones[0], [3.0 / 8.0, 1.0 / 8.0])
    assert np.allclose(result.mass[0], [[7.0 / 24.0, 1.0 / 12.0], [1.0 / 12.0, 1.0 / 24.0]])
    assert np.isclose(result.covered[0], 0.5)


def test_gap_is_that_between_the_surfaces():
    slave = grid((3, 3), corners=4)
    master = grid((4, 5), height=lambda x, y: 0.1 + 0.2 * x, up=False)
    result = integrate(slave, master)
    corners = slave.coordinates(result.facet)
    x = np.einsum("cij,cjd->cid", result.mass, corners)
    assert np.allclose(result.gap[..., 2], 0.1 * result.ones + 0.2 * x[..., 0])
    assert np.allclose(result.gap[..., :2], 0.0)


def test_gap_does_not_suffer_from_a_distant_origin():
    slave, master = grid((3, 3)), grid((4, 4), height=lambda x, y: 0.0 * x + 1e-6, up=False)
    far = [Facets(s.points + [1000.0, -700.0, 0.0], s.corners) for s in (slave, master)]
    result = integrate(*far)
    # in the plane the coordinates themselves are rounded
    assert np.allclose(result.gap[..., 2], 1e-6 * result.ones, rtol=1e-12)
    assert np.abs(result.gap[..., :2]).max() < 1e-12


@pytest.mark.parametrize("corners", [2, 3, 4])
def test_linear_weight(corners):
    if corners == 2:
        slave, master = chain(np.linspace(1, 2, 4)), chain(np.linspace(0, 3, 7), up=False)
    else:
        slave = grid((3, 3), (1, 0), (2, 1), corners=corners, jitter=0.4)
        master = grid((4, 5), (0, -1), (3, 2), up=False)
    weight = slave.coordinates()[..., 0]
    result = integrate(slave, master, weight)
    assert np.isclose(result.ones.sum(), 1.5)
    assert np.isclose(result.share.sum(), 1.0)
    assert np.allclose(result.mass.sum(axis=2), result.ones)


def test_no_common_part():
    result = integrate(grid((2, 2)), grid((2, 2), (5, 5), (6, 6), up=False, corners=4))
    assert not result.facet.size
    assert result.coupling.shape == (0, 3, 4)


@pytest.mark.parametrize("empty", ["slave", "master"])
def test_no_facets(empty):
    surfaces = {"slave": grid((2, 2)), "master": grid((2, 2), up=False)}
    surfaces[empty] = Facets(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    assert not integrate(surfaces["slave"], surfaces["master"]).facet.size


def test_facets_are_integrated_block_by_block():
    """A facet has the same integrals, whichever others there are."""
    slave, master = grid((33, 33)), grid((5, 7), (0.2, 0.2), (1.1, 1.1), up=False)
    last = np.arange(len(slave) - 300, len(slave))
    whole, alone = (
        integrate(slave, master),
        integrate(Facets(slave.points, slave.corners[last]), master),
    )
    chosen = np.isin(whole.facet, last)
    pairs = chosen[whole.pair]
    assert np.array_equal(whole.facet[chosen], last[alone.facet])
    assert np.array_equal(whole.master[pairs], alone.master)
    for name in ("covered", "mass", "gap"):
        assert np.array_equal(getattr(whole, name)[chosen], getattr(alone, name))
    assert np.array_equal(whole.coupling[pairs], alone.coupling)

"""D and M: the identities of dual mortars, down to slivers."""

from itertools import permutations

import numpy as np
import pytest
import scipy.sparse as sp
from facet_grids import chain, grid

from fenics_tfeti.fem.contact.mortar.facets import Planes
from fenics_tfeti.fem.contact.mortar.integrals import integrate
from fenics_tfeti.fem.contact.mortar.matrices import (
    BARELY_COVERED,
    HARDLY_COVERED,
    MortarMatrices,
    mortar_matrices,
    multiplier_shares,
    node_areas,
)


def assemble(slave, master, weight=None):
    integrals = integrate(slave, master, weight)
    matrices = mortar_matrices(integrals, slave, master)
    shares = shares_of(slave, integrals)
    D, M, gap, area = (
        shares @ part for part in (matrices.D, matrices.M, matrices.gap, matrices.area)
    )
    return MortarMatrices(D, M, gap, area), integrals, shares.getnnz(axis=1) > 0


def shares_of(slave, integrals):
    whole, covered = node_areas(integrals, slave)
    corners = slave.corners[integrals.facet]
    pairs = [corners[:, [j, k]] for j, k in permutations(range(corners.shape[1]), 2)]
    return multiplier_shares(
        covered / whole,
        np.full(whole.size, BARELY_COVERED),
        np.zeros(whole.size, dtype=bool),
        np.concatenate(pairs),
    )


def check_identities(slave, master, matrices, rows, flat=True):
    assert np.array_equal(matrices.area > 0.0, rows)
    area = matrices.area[rows]
    assert np.abs(np.asarray(matrices.M.sum(axis=1)).ravel()[rows] / area - 1.0).max() < 1e-13
    if flat:
        ours, theirs = matrices.D @ slave.points, matrices.M @ master.points
        assert np.abs((theirs - ours)[rows] / area[:, None]).max() < 1e-12
        assert np.abs(matrices.gap[rows] / area[:, None]).max() < 1e-12


@pytest.mark.parametrize("corners", [3, 4])
@pytest.mark.parametrize("of_master", [3, 4])
def test_identities_on_flat_surfaces(corners, of_master):
    slave = grid((6, 5), corners=corners, jitter=0.5)
    master = grid((8, 9), (-0.1, -0.1), (1.1, 1.2), up=False, corners=of_master, jitter=0.5, seed=1)
    matrices, _, rows = assemble(slave, master)
    check_identities(slave, master, matrices, rows)
    off_diagonal = matrices.D - sp.diags(matrices.D.diagonal())
    assert rows.all() and abs(off_diagonal).max() == 0.0
    assert np.isclose(matrices.area.sum(), 1.0)


def test_identities_of_segments():
    slave = chain(np.linspace(0, 1, 8) ** 1.3)
    master = chain(np.linspace(-0.2, 0.83, 12), up=False)
    matrices, _, rows = assemble(slave, master)
    check_identities(slave, master, matrices, rows)
    assert np.isclose(matrices.area.sum(), 0.83)


@pytest.mark.parametrize("corners", [2, 3, 4])
def test_nodes_at_the_same_places(corners):
    """Structured grids whose nodes and edges lie on each other, one of them twice as fine."""
    if corners == 2:
        slave, master = chain(np.linspace(0, 1, 9)), chain(np.linspace(0, 1, 17), up=False)
    else:
        slave = grid((8, 8), corners=corners)
        master = grid((16, 16), up=False, corners=corners)
    matrices, integrals, rows = assemble(slave, master)
    assert rows.all()
    check_identities(slave, master, matrices, rows)
    assert np.allclose(integrals.covered, Planes.of(slave.coordinates()).area, rtol=1e-12)


def test_matching_surfaces_give_node_to_node_rows():
    surfaces = grid((5, 5)), grid((5, 5), up=False)
    matrices, *_ = assemble(*surfaces)
    assert abs(matrices.M - matrices.D).max() < 1e-15


@pytest.mark.parametrize("exponent", [1, 3, 6, 9, 12])
@pytest.mark.parametrize("corners", [2, 3, 4])
def test_slivers(corners, exponent):
    """The master's border is a little beyond a line of the slave's nodes."""
    border = 0.5 + 10.0**-exponent / 6.0
    if corners == 2:
        slave, master = chain(np.linspace(0, 1, 7)), chain(np.linspace(0.013, border, 8), up=False)
    else:
        slave = grid((6, 6), corners=corners)
        master = grid((7, 5), (0.013, 0.021), (border, 0.6), up=False, corners=corners)
    matrices, integrals, rows = assemble(slave, master)
    check_identities(slave, master, matrices, rows)
    # all of the common area has a multiplier, and no coefficient is out of proportion
    assert np.isclose(matrices.area.sum(), integrals.covered.sum(), rtol=1e-13)
    assert (abs(matrices.M).max(axis=1).toarray().ravel() <= 5.0 * matrices.area).all()
    whole, covered = node_areas(integrals, slave)
    assert (covered[rows] > 1e-2 * whole[rows]).all()


def test_barely_covered_nodes_share_out_their_functions():
    """Node 0 gives to 1, which is covered by less than 0.4 and gives all of it to 2 and 3."""
    coverage = np.array([0.1, 0.3, 0.9, 1.0, 0.39])
    edges = np.array([[0, 1], [1, 2], [1, 3], [2, 3], [3, 4]])
    pairs = np.concatenate([edges, edges[:, ::-1]])
    shares = multiplier_shares(
        coverage, np.full(5, BARELY_COVERED), np.zeros(5, dtype=bool), pairs
    ).toarray()
    assert shares[:, 0].tolist() == shares[:, 1].tolist() == [0.0, 0.0, 0.5, 0.5, 0.0]
    assert shares[:, 2:4].tolist() == np.eye(5)[:, 2:4].tolist()
    assert shares[:, 4].tolist() == [0.0, 0.0, 0.0, 1.0, 0.0]


def test_barely_covered_nodes_without_better_neighbours_keep_their_functions():
    """Of a small foot inside of one facet; those of the same coverage, but for rounding, too."""
    coverage = np.array([0.1, np.nextafter(0.1, 1.0), 0.05])
    pairs = np.array(list(permutations(range(3), 2)))
    shares = multiplier_shares(
        coverage, np.full(3, BARELY_COVERED), np.zeros(3, dtype=bool), pairs
    ).toarray()
    assert shares.tolist() == [[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 0.0]]


def test_nodes_that_must_not_have_a_multiplier_give_theirs_to_all_others():
    coverage, free = np.array([1.0, 0.5, 0.2]), np.array([True, False, False])
    pairs = np.array(list(permutations(range(3), 2)))
    shares = multiplier_shares(coverage, np.full(3, BARELY_COVERED), free, pairs).toarray()
    assert shares.tolist() == [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]


def test_slivers_alone_have_no_rows():
    slave = chain([0.0, 1.0, 2.0])
    matrices, integrals, rows = assemble(slave, chain([2.0 - 1e-5, 3.0], up=False))
    assert integrals.facet.size == 1
    assert not rows.any() and matrices.M.nnz == matrices.D.nnz == 0


def test_curved_surfaces_keep_constants():
    def bowl(x, y):
        return 0.3 * (x * x + 0.5 * y * y)

    slave = grid((16, 16), height=bowl)
    master = grid((22, 20), (-0.1, -0.1), (1.1, 1.1), bowl, up=False)
    matrices, _, rows = assemble(slave, master)
    check_identities(slave, master, matrices, rows, flat=False)
    # facets of one curved surface are apart by their chords
    assert 0.0 < np.abs(matrices.gap / matrices.area[:, None]).max() < 2.0 * 0.6 / 8.0 / 16.0**2


def test_weight_of_the_measure():
    slave = chain(np.linspace(1, 2, 6))
    master = chain(np.linspace(1, 2, 8), up=False)
    matrices, _, rows = assemble(slave, master, slave.coordinates()[..., 0])
    check_identities(slave, master, matrices, rows)
    assert np.isclose(matrices.area.sum(), 1.5)


@pytest.mark.parametrize("corners", [3, 4])
def test_many_facets(corners):
    """Twenty thousand triangles, or half as many distorted quadrilaterals."""
    slave = grid((100, 100), corners=corners, jitter=0.3)
    low, high = (-0.001, -0.001), (1.001, 1.001)
    master = grid((99, 101), low, high, up=False, corners=corners, jitter=0.3, seed=1)
    matrices, _, rows = assemble(slave, master)
    assert rows.all()
    check_identities(slave, master, matrices, rows)
    assert np.isclose(matrices.area.sum(), 1.0)


def test_nodes_that_had_a_multiplier_keep_it_longer():
    coverage, free = np.array([0.3, 0.9]), np.zeros(2, dtype=bool)
    pairs = np.array([[0, 1], [1, 0]])
    for least, kept in ((HARDLY_COVERED, 1.0), (BARELY_COVERED, 0.0)):
        limits = np.array([least, BARELY_COVERED])
        shares = multiplier_shares(coverage, limits, free, pairs).toarray()
        assert shares.tolist() == [[kept, 0.0], [1.0 - kept, 1.0]]

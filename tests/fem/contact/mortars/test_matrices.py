"""D and M: the identities of dual mortars, down to slivers."""

from itertools import permutations

import numpy as np
import pytest
import scipy.sparse as sp
from facet_grids import chain, grid

from fenics_tfeti.fem.contact.conditions.mortar_matrices import (
    BARELY_SUPPORTED,
    HARDLY_SUPPORTED,
    MortarMatrices,
    coverage_and_support,
    dual_functions,
    mortar_matrices,
    multiplier_shares,
    node_sums,
)
from fenics_tfeti.fem.geometry.facets import Facets, Planes
from fenics_tfeti.fem.geometry.integrals import integrate


def assemble(slave, master, weight=None):
    integrals = integrate(slave, master, weight)
    matrices = mortar_matrices(integrals, slave, master)
    shares = shares_of(slave, integrals)
    D, M, gap, area = (
        shares @ part
        for part in (matrices.D.matrix(), matrices.M.matrix(), matrices.gap, matrices.area)
    )
    return MortarMatrices(D, M, gap, area), integrals, shares.getnnz(axis=1) > 0


def shares_of(slave, integrals):
    _, support = coverage_and_support(node_sums(integrals, slave))
    corners = slave.corners[integrals.facet]
    pairs = [corners[:, [j, k]] for j, k in permutations(range(corners.shape[1]), 2)]
    return shares_by(support, np.concatenate(pairs))


def shares_by(support, pairs, free=None):
    support = np.asarray(support)
    least = np.full(support.size, BARELY_SUPPORTED)
    free = np.zeros(support.size, dtype=bool) if free is None else free
    return multiplier_shares(support, least, free, pairs)


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
    coverage, support = coverage_and_support(node_sums(integrals, slave))
    assert (coverage[rows] > 1e-3).all() and (support[rows] > 0.1).all()


def test_barely_supported_nodes_share_out_their_functions():
    """Node 0 gives to 1, which has a support below 0.1 and gives all of it to 2 and 3."""
    edges = np.array([[0, 1], [1, 2], [1, 3], [2, 3], [3, 4]])
    pairs = np.concatenate([edges, edges[:, ::-1]])
    shares = shares_by([0.02, 0.08, 0.9, 1.0, 0.09], pairs).toarray()
    assert shares[:, 0].tolist() == shares[:, 1].tolist() == [0.0, 0.0, 0.5, 0.5, 0.0]
    assert shares[:, 2:4].tolist() == np.eye(5)[:, 2:4].tolist()
    assert shares[:, 4].tolist() == [0.0, 0.0, 0.0, 1.0, 0.0]


def test_barely_supported_nodes_without_better_neighbours_keep_their_functions():
    """Of a small foot inside of one facet; those of the same support, but for rounding, too."""
    pairs = np.array(list(permutations(range(3), 2)))
    shares = shares_by([0.05, np.nextafter(0.05, 1.0), 0.03], pairs).toarray()
    assert shares.tolist() == [[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 0.0]]


def test_nodes_that_must_not_have_a_multiplier_give_theirs_to_all_others():
    pairs = np.array(list(permutations(range(3), 2)))
    shares = shares_by([1.0, 0.5, 0.02], pairs, np.array([True, False, False])).toarray()
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
    support, free = np.array([0.07, 0.9]), np.zeros(2, dtype=bool)
    pairs = np.array([[0, 1], [1, 0]])
    for least, kept in ((HARDLY_SUPPORTED, 1.0), (BARELY_SUPPORTED, 0.0)):
        limits = np.array([least, BARELY_SUPPORTED])
        shares = multiplier_shares(support, limits, free, pairs).toarray()
        assert shares.tolist() == [[kept, 0.0], [1.0 - kept, 1.0]]


@pytest.mark.parametrize("share", [0.2, 0.3, 0.8, 1.0])
@pytest.mark.parametrize("corners", [2, 3, 4])
def test_support_on_strips_and_at_corners(corners, share):
    """It is the covered part of the facets' width, at a corner the product of both."""
    n = 4
    border = (2.0 + share) / n
    if corners == 2:
        slave, master = chain(np.linspace(0, 1, n + 1)), chain([0.0, border], up=False)
    else:
        slave = grid((n, n), corners=corners)
        master = grid((1, 1), (0.0, 0.0), (border, 1.0), up=False, corners=corners)
    _, support = coverage_and_support(node_sums(integrate(slave, master), slave))
    x = slave.points[:, 0]
    np.testing.assert_allclose(support[x < 0.49], 1.0, rtol=1e-12)
    assert (support[x > 0.8] == 0.0).all()
    # of triangles up to 4/3 of it, and 1 where all of them are covered
    beyond = support[np.isclose(x, 0.75)] / share
    np.testing.assert_array_less(1.0 - 1e-12, beyond)
    np.testing.assert_array_less(beyond, 4 / 3 if corners == 3 else 1.0 + 1e-12)
    if corners == 4:
        foot = grid((1, 1), (0.0, 0.0), (border, border), up=False, corners=4)
        _, support = coverage_and_support(node_sums(integrate(slave, foot), slave))
        corner = np.isclose(slave.points[:, :2], 0.75).all(axis=1)
        # of 0.2, less than a thousandth of the area around the node is a sliver
        expected = share**2 if share > 0.2 else 0.0
        assert support[corner] == pytest.approx(expected, rel=1e-12)


# -- dual functions on partly covered facets -------------------------------------------------------

FACETS = {
    "segment": np.array([[0.0, 0.0], [1.0, 0.0]]),
    "triangle": np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.3, 0.9, 0.0]]),
    "parallelogram": np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [1.2, 0.9, 0.0], [0.2, 0.8, 0.0]]),
    "quadrilateral": np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.8, 0.9, 0.0], [0.1, 0.7, 0.0]]),
}
SWEEP = np.linspace(0.03, 1.3, 23)
KINDS = ["along", "oblique", "against", "pieces", "hole"]


def half_plane(angle, border, low=-2.0):
    """Return the corners of a strip from `low` to a border along a direction, in the plane."""
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), 1.0])
    across[1] = np.cos(angle)
    return [low * along - 3 * across, border * along - 3 * across] + [
        border * along + 3 * across,
        low * along + 3 * across,
    ]


def masters(kind, border):
    """Return quadrilaterals over a part of the facets: strips, two pieces, or all but a hole."""
    if kind == "hole":
        low, high = 0.3 - 0.2 * border, 0.3 + 0.2 * border
        lines = [-2.0, low, high, 3.0]
        return [
            [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
            for i, (x0, x1) in enumerate(zip(lines[:-1], lines[1:], strict=True))
            for j, (y0, y1) in enumerate(zip(lines[:-1], lines[1:], strict=True))
            if (i, j) != (1, 1)
        ]
    angle = {"along": 0.0, "oblique": 0.7, "against": 2.6, "pieces": 0.4}[kind]
    if kind == "against":
        return [half_plane(angle, border - 0.9)]
    if kind == "pieces":
        return [half_plane(angle, 0.4 * border), half_plane(angle, 2.0, 0.5 + 0.4 * border)]
    return [half_plane(angle, border)]


def partly_covered(shape, kind):
    """Return facets beside each other, each with its own part covered, and the master."""
    x = FACETS[shape]
    v, d = x.shape
    points, master = [], []
    for number, border in enumerate(SWEEP):
        shift = 20.0 * number * np.eye(d)[0]
        points.append(x + shift)
        if d == 2:
            pieces = [(-2.0, border)]
            if kind == "pieces":
                pieces = [(-2.0, 0.4 * border), (0.5 + 0.4 * border, 2.0)]
            master += [np.array([[a, 0.0], [b, 0.0]]) + shift for a, b in pieces]
        else:
            flat = [np.pad(np.array(q), ((0, 0), (0, 1))) for q in masters(kind, border)]
            master += [q[::-1] + shift for q in flat]
    points, nodes = np.concatenate(points), np.arange(v * SWEEP.size).reshape(-1, v)
    if d == 2:
        nodes = nodes[:, ::-1]
    corners = np.concatenate(master)
    return Facets(points, nodes), Facets(corners, np.arange(len(corners)).reshape(len(master), -1))


@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        ("segment", "along"),
        ("segment", "pieces"),
        *((shape, kind) for shape in list(FACETS)[1:] for kind in KINDS),
    ],
)
def test_dual_functions_of_partly_covered_facets(shape, kind):
    """With the corners x_j of the smallest facet: int psi_j N_i = d_j N_i(x_j), d > 0."""
    slave, master = partly_covered(shape, kind)
    integrals = integrate(slave, master)
    psi, products = dual_functions(integrals, slave)
    v = slave.number_of_corners
    regular = integrals.covered > 1e-4 * Planes.of(slave.coordinates()).area[integrals.facet]
    assert regular.sum() >= 15
    partly = regular & (integrals.covered < 0.999 * integrals.covered.max())
    assert partly.sum() >= 8
    T = integrals.rim
    d = np.linalg.solve(T, integrals.ones[..., None])[..., 0]
    size = integrals.ones.sum(axis=1)
    assert (d[regular] > 0.0).all()
    np.testing.assert_allclose(T.sum(axis=1), 1.0, rtol=1e-13)
    # by the functions themselves, with the mass matrix
    exact = d[:, :, None] * T.swapaxes(1, 2)
    found = psi @ integrals.mass
    assert np.abs((found - exact) / size[:, None, None])[regular].max() < 1e-11
    np.testing.assert_allclose(products[regular], exact[regular], atol=1e-13)
    assert np.abs(psi.sum(axis=1) - 1.0)[regular].max() < 1e-9
    assert np.abs(products.sum(axis=1) - integrals.ones)[regular].max() < 1e-13
    # the corners of the small facet are in the facet
    assert T[regular].min() > -1e-13
    whole = np.abs(integrals.covered - Planes.of(slave.coordinates()).area[integrals.facet]) < 1e-12
    assert (T[whole] == np.eye(v)).all()
    assert all(np.count_nonzero(p) == v for p in products[whole])

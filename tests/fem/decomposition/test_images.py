"""Rotated and mirrored sets of points are found, with the matrix and the pairs."""

import numpy as np
import pytest
from scipy.stats import ortho_group

from fenics_tfeti.fem.decomposition.images import find_images


def find_image(points, reference):
    return next(find_images(points, reference), None)


def image_of(points, mirrored=False, seed=0):
    """Return the points turned by any matrix, moved and reordered."""
    rng = np.random.default_rng(seed)
    turn = ortho_group.rvs(points.shape[1], random_state=seed)
    if (np.linalg.det(turn) < 0.0) != mirrored:
        turn[:, 0] *= -1
    return turn, (points @ turn.T + rng.random(points.shape[1]))[rng.permutation(len(points))]


def grid(*lengths):
    axes = (np.linspace(0.0, length, 4) for length in lengths)
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(lengths))


def assert_image(points, reference, found):
    turn, order = found
    np.testing.assert_allclose(turn @ turn.T, np.eye(len(turn)), atol=1e-14)
    assert sorted(order) == list(range(len(points)))
    offset = points[order] - reference @ turn.T
    np.testing.assert_allclose(offset, offset[:1] + 0 * offset, atol=1e-13)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("d", [2, 3])
def test_matrix_of_points_without_symmetry(d, mirrored):
    reference = np.random.default_rng(1).random((40, d))
    expected, points = image_of(reference, mirrored)
    turn, order = find_image(points, reference)
    np.testing.assert_allclose(turn, expected, atol=1e-13)
    assert_image(points, reference, (turn, order))


@pytest.mark.parametrize(
    ("lengths", "symmetries"),
    [((1, 1), 8), ((1, 2), 4), ((1, 1, 1), 48), ((1, 1, 2), 16), ((1, 2, 3), 8)],
)
def test_all_matrices_of_symmetric_points(lengths, symmetries):
    reference = grid(*lengths)
    _, points = image_of(reference)
    found = list(find_images(points, reference))
    for image in found:
        assert_image(points, reference, image)
    assert len({tuple(order) for _, order in found}) == symmetries
    handed = [np.linalg.det(turn) > 0.0 for turn, _ in found]
    assert handed == sorted(handed, reverse=True)


def test_right_angles_are_exact():
    turn, _ = find_image(grid(3, 2, 1) @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], grid(3, 2, 1))
    assert np.isin(turn, [-1.0, 0.0, 1.0]).all()


def test_a_point_that_moved_along_its_sphere():
    reference = np.random.default_rng(1).random((40, 3))
    _, points = image_of(reference)
    centre = points.mean(axis=0)
    # two points, so that neither the centre nor the distances from it change
    one, other = points[3] - centre, points[7] - centre
    axis = np.cross(one, other)
    axis /= np.linalg.norm(axis)
    points[3] += 1e-9 * np.cross(axis, one)
    assert find_image(points, reference) is None


def test_points_that_moved_beside_those_compared_first():
    reference = np.random.default_rng(1).random((100, 3))
    points = reference.copy()
    points[[1, 2]] += [[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]
    assert find_image(points, reference) is None


def test_other_numbers_of_points():
    assert find_image(grid(1, 2)[1:], grid(1, 2)) is None


def test_shells_are_given_up_before_all_pairs_are_tried():
    """All points of a sphere have the same distance from the centre."""
    k = np.arange(1500) + 0.5
    height, angle = 1.0 - 2.0 * k / k.size, np.pi * (1.0 + np.sqrt(5.0)) * k
    across = np.sqrt(1.0 - height**2)
    half = np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=1)
    sphere = np.concatenate([half, -half])
    assert find_image(image_of(sphere)[1], sphere) is None

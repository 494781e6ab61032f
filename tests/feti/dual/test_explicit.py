"""Dense matrices of symmetric subdomains in blocks, against solves."""

from __future__ import annotations

import numpy as np
import pytest
from fibres import reinforced_block
from torn import cube

from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.dual.explicit import ExplicitInverse, Orbits
from fenics_tfeti.feti.factors.cholesky import available_packages
from fenics_tfeti.feti.local.generalized_inverse import GeneralizedInverse
from fenics_tfeti.feti.local.rigid_body_modes import rigid_body_modes
from fenics_tfeti.feti.local.symmetry import find_symmetries

PART = cube(4)
SYMMETRIES = find_symmetries(PART.stiffness, PART.coordinates)

SIDES = {
    "all": lambda x: np.any((x == 0) | (x == 1), axis=1),
    "one": lambda x: x[:, 0] == 0,
    "two that meet": lambda x: (x[:, 0] == 0) | (x[:, 1] == 0),
    "a corner": lambda x: np.all(x == 0, axis=1),
    "none": lambda x: np.zeros(len(x), dtype=bool),
}


def inverse(symmetries=SYMMETRIES) -> GeneralizedInverse:
    R = rigid_body_modes(PART.coordinates)
    return GeneralizedInverse(PART, R, available_packages()[0], symmetries=symmetries)


def unknowns(sides: str) -> np.ndarray:
    return np.flatnonzero(np.repeat(SIDES[sides](PART.coordinates), 3))


@pytest.mark.parametrize("sides", SIDES)
def test_products_are_those_of_solves(sides):
    local, K_plus = unknowns(sides), inverse()
    rows = np.random.default_rng(0).standard_normal((70, local.size))
    forces = np.zeros((K_plus.size, len(rows)))
    forces[local] = rows.T
    expected = K_plus.solve(forces)[local].T
    found = ExplicitInverse.build(K_plus, Orbits.build(K_plus.symmetries, local))(rows)
    np.testing.assert_allclose(
        found, expected, rtol=0.0, atol=1e-13 * np.abs(expected).max(initial=1e-30)
    )


@pytest.mark.parametrize(("sides", "blocks"), [("all", 8), ("one", 4), ("two that meet", 2)])
def test_blocks_are_as_small_as_the_symmetries_allow(sides, blocks):
    local = unknowns(sides)
    orbits = Orbits.build(SYMMETRIES, local)
    explicit = ExplicitInverse.build(inverse(), orbits)
    assert len(explicit.blocks) == blocks
    assert explicit.blocks.size == orbits.entries
    # nodes in the planes of mirrors have smaller orbits
    assert local.size / blocks <= orbits.representatives.size <= 1.7 * local.size / blocks
    images = orbits.group.images[:, orbits.representatives]
    np.testing.assert_array_equal(np.unique(images), np.arange(local.size))


def test_inverse_without_the_symmetries_of_the_stiffness_has_one_block():
    """As where rounding breaks the symmetry: here the fixing nodes do."""
    K_plus = inverse(symmetries=None)
    local = unknowns("all")
    explicit = ExplicitInverse.build(K_plus, Orbits.build(SYMMETRIES, local))
    assert len(explicit.blocks) == 1
    x = np.random.default_rng(0).standard_normal(K_plus.size)
    x[np.setdiff1d(np.arange(x.size), local)] = 0.0
    np.testing.assert_allclose(explicit(x[local][None])[0], K_plus.solve(x)[local], atol=1e-15)


def test_symmetries_make_a_dense_matrix_pay_earlier():
    K_plus, local = inverse(), unknowns("all")
    plain = Orbits.build(type(SYMMETRIES).trivial(K_plus.size), local)
    symmetric = Orbits.build(SYMMETRIES, local)
    members = [
        next(k for k in range(1, 10_000) if orbits.pays(K_plus, k)) for orbits in (symmetric, plain)
    ]
    assert members[0] < members[1]


@pytest.mark.parametrize(("jump", "fewest"), [(1.0, 4), (1e6, 1)])
def test_blocks_only_where_rounding_leaves_the_symmetry(jump, fewest):
    """Rows of fibres are symmetric, too, but their K^+ is so to ten digits only."""
    system = reinforced_block(2, jump, columns=4, layers=2)
    F = TornSolver(system, Options(dual_operator="explicit", deflation="off")).setup.F
    assert min(len(explicit.blocks) for explicit in F.on_interface) == fewest

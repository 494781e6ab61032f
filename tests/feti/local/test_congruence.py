from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.stats import ortho_group
from springs import on_springs
from torn import column, cube

from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.local.congruence import (
    CongruenceClass,
    apply_by_class,
    find_congruence_classes,
)
from fenics_tfeti.feti.local.frames import Frames

pytestmark = pytest.mark.once

OPTIONS = [
    {},
    {"preconditioner": "lumped", "scaling": "stiffness"},
    {"preconditioner": "dirichlet", "deflation": "on", "dual_operator": "explicit"},
    {"method": "smalbe"},
]


def members(subdomains) -> list[list[int]]:
    return [congruent.members.tolist() for congruent in find_congruence_classes(subdomains)]


def softer(size: float):
    return replace(cube(2), stiffness=cube(2).stiffness * (1.0 - size))


def with_another(part: str, entry: int, factor: float, shift: float):
    """Return a cube with another entry of the stiffness or place of a node."""
    other = cube(2)
    K, x = other.stiffness.copy(), other.coordinates.copy()
    values = K.data if part == "stiffness" else x.reshape(-1)
    values[entry] = factor * values[entry] + shift
    return replace(other, stiffness=K, coordinates=x)


def turned(subdomain, seed):
    """Return the subdomain rotated or mirrored about the origin, in the frame of the given one."""
    turn = ortho_group.rvs(3, random_state=seed)
    return replace(subdomain, coordinates=subdomain.coordinates @ turn.T, frame=turn)


@pytest.mark.parametrize(("parts", "expected"), [
    ([cube(2), cube(2, (1, 0, 0)), cube(2, (5, 3, 7))], [[0, 1, 2]]),
    ([cube(2), cube(3), cube(2), cube(3)], [[0, 2], [1, 3]]),
    # loads and numbers do not matter
    ([cube(2), cube(2, load=(1, 2, 3), body=4, first=99)], [[0, 1]]),
    *(([cube(2), softer(size), cube(2)], [[0, 2], [1]]) for size in (1e-11, 1e-5, 0.5)),
    # a soft spring is enough, and so is an entry
    ([cube(2), on_springs(cube(2), 0.0, 1e-13), cube(2)], [[0, 2], [1]]),
    ([cube(2), with_another("stiffness", 7, 1.0 + 1e-9, 0.0)], [[0], [1]]),
    # the rigid rotations of another shape are others
    ([cube(2), with_another("coordinates", -1, 1.0, 1e-6)], [[0], [1]]),
    # a turned cube without its frame
    ([cube(2), replace(turned(cube(2), 0), frame=None)], [[0], [1]]),
])  # fmt: skip
def test_classes(parts, expected):
    assert members(parts) == expected


def test_turned_cubes_are_congruent_in_their_frames():
    cubes = [cube(2), turned(cube(2, (1, 0, 0)), 0), turned(cube(2), 1)]
    assert members(cubes) == [[0, 1, 2]]
    (congruent,) = find_congruence_classes(cubes)
    x = np.concatenate([s.coordinates.ravel() for s in cubes])
    rows = congruent.rows(x)
    np.testing.assert_allclose(rows[2], cubes[0].coordinates.ravel(), atol=1e-14)
    back = np.empty_like(x)
    congruent.put(back, rows)
    np.testing.assert_allclose(back, x, atol=1e-14)


def in_any_frames(system):
    """Return the same system with stiffness matrices in frames."""
    parts = []
    for seed, s in enumerate(system.subdomains):
        turn = ortho_group.rvs(3, random_state=seed)
        T = sp.kron(sp.identity(s.nodes.size), turn).tocsr()
        parts.append(replace(s, stiffness=(T.T @ s.stiffness @ T).tocsr(), frame=turn))
    return replace(system, subdomains=parts)


def with_weak_spring(system):
    parts = list(system.subdomains)
    parts[0] = on_springs(parts[0], 0.0, 1e-6)
    return replace(system, subdomains=parts)


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("with_springs", [False, True])
def test_frames_of_the_stiffness_change_nothing(options, with_springs):
    system = column(height=3, load=(0.1, 0.2, -1.0))
    if with_springs:
        system = with_weak_spring(system)
    options = Options(rtol=1e-10, **options)
    expected = TornSolver(system, options).solve()
    found = TornSolver(in_any_frames(system), options).solve()
    assert found.report.converged
    assert found.report.certificate.worst <= 1e-10
    for one, other in zip(found.displacements, expected.displacements, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9 * np.abs(other).max())
    np.testing.assert_allclose(found.normal_force, expected.normal_force, atol=1e-9)


def test_one_softer_cube_among_equal_ones():
    """Classes are of different sizes then; the force still is the load."""
    system = column(height=4, load=(0, 0, -2.0))
    parts = list(system.subdomains)
    parts[1] = replace(parts[1], stiffness=0.3 * parts[1].stiffness)
    report = TornSolver(replace(system, subdomains=parts), Options()).solve().report
    assert report.classes == 2
    np.testing.assert_allclose([c.normal_force for c in report.contacts], 2.0, rtol=1e-6)


@pytest.mark.parametrize("adjacent", [True, False])
@pytest.mark.parametrize("with_frames", [True, False])
def test_many_members_are_taken_in_batches(adjacent, with_frames):
    """K in the frame of each of 150 members is TKT' of the torn unknowns."""
    k, nodes = 150, 2
    rng = np.random.default_rng(0)
    K, torn = rng.standard_normal((6, 6)), rng.standard_normal(6 * k + k)
    turns = ortho_group(3, seed=0).rvs(k) if with_frames else np.tile(np.eye(3), (k, 1, 1))
    starts = 6 * np.arange(k) if adjacent else 7 * np.arange(k)
    frames = Frames(turns, nodes) if with_frames else None
    members = CongruenceClass(np.arange(k), starts, 6, frames)
    sizes = []

    def times(rows):
        sizes.append(len(rows))
        return rows @ K.T

    result = apply_by_class([members], [times], torn)
    assert sum(sizes) == k and len(sizes) > 1
    for start, turn in zip(starts, turns, strict=True):
        T, own = np.kron(np.eye(nodes), turn), slice(start, start + 6)
        np.testing.assert_allclose(result[own], T @ K @ T.T @ torn[own], rtol=1e-12, atol=1e-12)

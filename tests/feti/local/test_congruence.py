from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from springs import on_springs
from torn import column, cube

from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.local.congruence import find_congruence_classes


def members(subdomains) -> list[list[int]]:
    return [congruent.members.tolist() for congruent in find_congruence_classes(subdomains)]


def changed(subdomain, **parts):
    return dataclasses.replace(subdomain, **parts)


def test_cubes_assembled_one_by_one_are_congruent():
    assert members([cube(2), cube(2, (1, 0, 0)), cube(2, (5, 3, 7))]) == [[0, 1, 2]]


def test_cubes_of_other_meshes_are_not():
    assert members([cube(2), cube(3), cube(2), cube(3)]) == [[0, 2], [1, 3]]


@pytest.mark.parametrize("size", [1e-12, 1e-6, 0.5])
def test_a_softer_cube_stands_alone(size):
    soft = cube(2)
    soft = changed(soft, stiffness=soft.stiffness * (1.0 - 10 * size if size < 0.1 else size))
    assert members([cube(2), soft, cube(2)]) == [[0, 2], [1]]


def test_a_soft_spring_is_enough():
    assert members([cube(2), on_springs(cube(2), 0.0, 1e-13), cube(2)]) == [[0, 2], [1]]


def test_an_entry_that_differs_is_enough():
    other = cube(2)
    K = other.stiffness.copy()
    K.data[7] *= 1.0 + 1e-9
    assert members([cube(2), changed(other, stiffness=K)]) == [[0], [1]]


def test_the_same_stiffness_on_another_shape_is_not_congruent():
    """Its rigid rotations are others."""
    bent = cube(2)
    points = bent.coordinates.copy()
    points[-1] += 1e-6
    assert members([cube(2), changed(bent, coordinates=points)]) == [[0], [1]]


def test_loads_and_numbers_do_not_matter():
    assert members([cube(2), cube(2, load=(1, 2, 3), body=4, first=99)]) == [[0, 1]]


def test_one_softer_cube_among_equal_ones():
    """Classes are of different sizes then; the force still is the load."""
    system = column(height=4, load=(0, 0, -2.0))
    parts = list(system.subdomains)
    parts[1] = changed(parts[1], stiffness=0.3 * parts[1].stiffness)
    report = TornSolver(dataclasses.replace(system, subdomains=parts), Options()).solve().report
    assert report.classes == 2
    np.testing.assert_allclose(report.contact_force, 2.0, rtol=1e-6)

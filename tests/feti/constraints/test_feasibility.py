"""Contact conditions and prescribed displacements without a common solution are an error."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import linprog
from sparse_rows import clamped
from torn import cube, with_prescribed

from fenics_tfeti import InputError
from fenics_tfeti.feti import ContactRows, Options, TornSolver, TornSystem
from fenics_tfeti.feti.constraints.feasibility import contradiction

pytestmark = pytest.mark.once

NODE = 2 * 1000 * 1000 + 2 * 1000 + 2
X, Y, Z = np.eye(3)


def conditions(*rows) -> ContactRows:
    """Make rows (normal, gap) of a node against rigid obstacles."""
    normal, gap = zip(*rows, strict=True)
    k = len(rows)
    return ContactRows.node_to_node(np.full(k, NODE), np.full(k, -1), normal, gap, np.arange(k))


def held_cubes(contacts: ContactRows, z: float | None = None) -> TornSystem:
    """Two glued cubes held at one face; the node may have a prescribed z displacement."""
    cubes = [cube(2), cube(2, (1, 0, 0))]
    system = TornSystem(cubes, clamped(cubes, (0, 0.0)), contacts, 3)
    return system if z is None else with_prescribed(system, [NODE], [2], z)


def walls(gap: float) -> ContactRows:
    """Three walls around a node, 120 degrees apart."""
    normals = [X, -0.5 * X + 0.75**0.5 * Y, -0.5 * X - 0.75**0.5 * Y]
    return conditions(*((n, gap) for n in normals))


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
@pytest.mark.parametrize("size", [1e-9, 1.0, 1e3])
def test_walls_turned_inside_out_are_named(method, size):
    with pytest.raises(InputError, match=f"contradict each other.*contact 0.*{NODE}"):
        TornSolver(held_cubes(walls(-0.01 * size)), Options(method=method)).solve()


@pytest.mark.parametrize("gap", [0.0, 1e-3])
def test_walls_that_leave_room_do_not(gap):
    assert TornSolver(held_cubes(walls(gap))).solve().report.converged


def test_prescribed_displacement_into_a_wedge():
    """The walls leave x <= -|y|, and the third one x >= 0.1 z - 0.014."""
    rows = conditions((X + Y, 0.0), (X - Y, 0.0), (-X + 0.1 * Z, 0.014))
    assert TornSolver(held_cubes(rows, 0.1)).solve().report.converged
    with pytest.raises(InputError, match="prescribed displacements contradict"):
        TornSolver(held_cubes(rows, 0.2))


@pytest.mark.parametrize("far", [1e3, 1e12])
def test_far_gap_beside_a_contradiction(far):
    """In the coordinates of the three walls, the fourth one is far away."""
    rows = np.array([[1.0, 0.0], [-0.5, 0.75**0.5], [-0.5, -(0.75**0.5)], [0.0, 1.0]])
    W = rows @ rows.T
    assert contradiction(W, np.array([-1e-4, -1e-4, -1e-4, far])).tolist() == [0, 1, 2]
    assert contradiction(W, np.array([1e-4, 1e-4, -1e-4, far])).size == 0


@pytest.mark.parametrize("rounding", [0.9e-9, 1.1e-9])
def test_contradiction_within_rounding_is_none(rounding):
    W = np.array([[1.0, -0.5, -0.5], [-0.5, 1.0, -0.5], [-0.5, -0.5, 1.0]])
    found = contradiction(W, np.full(3, -1e-9), np.full(3, rounding))
    assert found.size == (3 if rounding < 1e-9 else 0)


def test_tied_rows_and_a_wall_beside_a_far_one():
    """The node is tied to the origin along x and y, and a wall pushes it along (1, 1)."""
    walls = conditions((X + Y, -1e-4), (X - Y, 1e9))
    system = dataclasses.replace(held_cubes(walls), tied=conditions((X, 0.0), (Y, 0.0)))
    with pytest.raises(InputError, match=f"1 conditions contradict tied ones.*{NODE}"):
        TornSolver(system).solve()


@pytest.mark.parametrize("seed", range(12))
def test_contradiction_is_that_of_a_linear_programme(seed):
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((rng.integers(2, 9), 3))
    rows /= np.linalg.norm(rows, axis=1)[:, None]
    gaps = rng.standard_normal(len(rows)) * 10.0 ** rng.uniform(-9, 9)
    found = contradiction(rows @ rows.T, gaps)
    scale = np.abs(gaps).max()

    def feasible(at):
        return linprog(np.zeros(3), rows[at], gaps[at] / scale, bounds=(None, None)).success

    assert feasible(np.arange(len(rows))) == (found.size == 0)
    if found.size:
        assert not feasible(found)

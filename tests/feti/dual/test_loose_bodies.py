from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from torn import column, cube, node_rows, operators_on

from fenics_tfeti.feti import ContactRows, Options, TornSolver, TornSystem
from fenics_tfeti.feti.constraints.row_table import Kind
from fenics_tfeti.feti.dual.active_set import _without_tensile_rows
from fenics_tfeti.feti.dual.pcpg import PCPGIterate

pytestmark = pytest.mark.once

WALLS = np.concatenate([np.identity(3), -np.identity(3)])


def with_loose_cubes(clearance: float, shifts: np.ndarray) -> TornSystem:
    """Add cubes without load, each in a box that it penetrates as it is drawn.

    The walls of a box are `clearance` away from a cube that is shifted by -shift.
    """
    system = column(n=2)
    rows, cubes = [system.contacts], []
    for k, shift in enumerate(shifts):
        loose = cube(2, (3 * k + 3, 0, 0), 2 + k, 2 * 10**9 + k * 10**8)
        cubes.append(loose)
        x = loose.coordinates - loose.coordinates.mean(axis=0)
        for outwards in WALLS:
            on_side = loose.nodes[x @ outwards > 0.49]
            rows.append(node_rows(on_side, outwards, gap=clearance + outwards @ shift, contact=1))
    return replace(
        system,
        subdomains=[*system.subdomains, *cubes],
        contacts=ContactRows.concatenate(rows),
        body_names=(),
        contact_names=("joint", "walls"),
    )


SHIFTS = np.array([[0.2, -0.1, 0.05], [-0.02, 0.0, 0.3], [0.0, 0.1, 0.0]])


@pytest.mark.parametrize("clearance", [0.01, 0.1])
def test_bodies_that_have_a_position_change_no_faces(clearance):
    """No row of the loose cubes is ever active: the faces are those of the column alone."""
    alone = TornSolver(column(n=2), Options(rtol=1e-6)).solve().report
    solution = TornSolver(with_loose_cubes(clearance, SHIFTS), Options(rtol=1e-6)).solve()
    faces = [(face.active, face.changed) for face in solution.report.faces]
    assert faces == [(face.active, face.changed) for face in alone.faces]
    assert solution.report.products["total"] == alone.products["total"]
    # recovery moves them by what is missing
    assert solution.report.certificate.penetration <= 1e-9


def test_bodies_that_have_none_are_squeezed_on_both_sides():
    """Walls that are too near: the rows of the next set balance each other."""
    solver = TornSolver(with_loose_cubes(-0.01, SHIFTS))
    problem = solver.dual_problem()
    coarse_space, rows = problem.coarse_space, problem.constraints.inequality
    operators = operators_on(problem, np.zeros(rows.size, dtype=bool))
    assert operators.loose is not None
    settled = operators.loose.at_least_penetration(problem.c)
    contact = problem.constraints.rows.of(Kind.CONTACT).contact
    penetration = np.where(contact == 1, np.maximum(-settled[rows], 0.0), 0.0)
    squeezing = np.zeros_like(settled)
    squeezing[rows] = penetration
    assert np.count_nonzero(penetration) == len(SHIFTS) * len(WALLS) * 9
    depth = penetration / problem.constraints.lengths_of_rows()[rows]
    np.testing.assert_allclose(depth[depth > 0.0], 0.01, rtol=1e-8)
    balance = operators.projector.free.T @ coarse_space.restrict(squeezing)
    np.testing.assert_allclose(balance, 0.0, atol=1e-8 * np.linalg.norm(squeezing))


def test_positions_of_many_bodies():
    """More conditions than recovery takes in one by one."""
    shifts = 0.3 * np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3))
    alone = TornSolver(column(n=2), Options(rtol=1e-6)).solve().report
    report = TornSolver(with_loose_cubes(0.01, shifts), Options(rtol=1e-6)).solve().report
    assert report.products["total"] == alone.products["total"]
    assert report.certificate.worst <= 1e-6


@pytest.mark.parametrize("force, holds", [(-1.0, False), (0.0, False), (1.0, True)])
def test_rows_that_do_not_push_hold_no_body(force, holds):
    """Cubes at their first walls that penetrate others: only rows that push hold them there."""
    solver = TornSolver(with_loose_cubes(0.1, SHIFTS))
    problem = solver.dual_problem()
    rows, size = problem.constraints.inequality, problem.d.size
    contact = problem.constraints.rows.of(Kind.CONTACT).contact
    active = np.zeros(rows.size, dtype=bool)
    for k in range(len(SHIFTS)):
        active[9 + 54 * k : 18 + 54 * k] = True
    operators = operators_on(problem, active | (contact == 0))
    multipliers, gradient = np.zeros(size), problem.c.copy()
    multipliers[rows] = np.where(active, force, 1.0)
    # they touch the first wall, and the whole play is at the opposite one
    lengths = problem.constraints.lengths_of_rows()[rows]
    opposite = np.roll(active, 27)
    gradient[rows] = np.where(active, 0.0, np.where(opposite, 0.2 * lengths, problem.c[rows]))
    nothing = PCPGIterate(operators.face, multipliers, gradient, 0.0, 0.0, 0.0 * gradient, 1.0, ())
    sign_test_gradient = _without_tensile_rows(problem, operators.face, nothing)
    penetrated = (sign_test_gradient[rows] < 0.0) & (contact == 1) & ~active
    assert penetrated.any() == holds


def test_faces_that_hold_all_bodies_have_none():
    problem = TornSolver(column(n=2)).dual_problem()
    every = np.ones(problem.constraints.inequality.size, dtype=bool)
    assert operators_on(problem, every).loose is None

"""Rigid motions that supports and gaps prescribe: out of c, and back in the displacement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from torn import column, cube, with_fields

from fenics_tfeti.feti import ContactRows, Options, Prescribed, TornSolution, TornSolver, TornSystem
from fenics_tfeti.feti.coarse.prescribed_motion import closing_motion, prescribed_motion

pytestmark = pytest.mark.once

SHIFT = np.array([3.0, -2.0, 1.0])


def shifted(size: float) -> TornSystem:
    """Return a loaded column, all of one body, whose supports are moved by the same translation."""
    system = column(contact=False, load=(0, 0, -1.0))
    old = system.prescribed
    return replace(
        system, prescribed=replace(old, values=old.values + size * SHIFT[old.components])
    )


def motion(system: TornSystem) -> np.ndarray:
    solver = TornSolver(system)
    coarse_space = solver.setup.projector.coarse_space
    return coarse_space.rigid_motion(prescribed_motion(coarse_space, solver.data.c))


def test_translation_of_the_supports():
    found = motion(shifted(1e3)).reshape(-1, 3)
    np.testing.assert_allclose(found, np.tile(1e3 * SHIFT, (len(found), 1)), rtol=1e-12)


def test_nothing_prescribed():
    assert not motion(shifted(0.0)).any()


def test_motion_out_of_proportion_is_none():
    """The rotation of a tall tower that tilts its foot by 1 moves its top by 20."""
    tower = [cube(1, (0, 0, k)) for k in range(20)]
    foot = tower[0].nodes[tower[0].coordinates[:, 2] == 0]
    y = tower[0].coordinates[tower[0].coordinates[:, 2] == 0, 1]
    prescribed = Prescribed(
        np.repeat(foot, 3),
        np.tile([0, 1, 2], foot.size),
        np.column_stack([0 * y, 0 * y, y]).ravel(),
    )
    assert not motion(TornSystem(tower, prescribed, ContactRows.none(3), 3)).any()


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
@pytest.mark.parametrize("size", [1.0, 1e4, 1e8])
def test_a_motion_of_any_size_changes_nothing_else(method, size):
    options = Options(rtol=1e-6, method=method)
    here, there = (TornSolver(shifted(s), options).solve() for s in (0.0, size))
    # c is rounded to the size of the motion; the deformation is about 1
    accuracy = 2e-6 + 64 * np.finfo(float).eps * size
    for u, moved in zip(here.displacements, there.displacements, strict=True):
        np.testing.assert_allclose(moved, u + np.tile(size * SHIFT, len(u) // 3), atol=accuracy)
    assert there.report.products["total"] <= here.report.products["total"] + 1


@pytest.mark.parametrize("gap", [1e-3, -1e-3])
@pytest.mark.parametrize("stiff", [1.0, 1e10, 4e16])
@pytest.mark.parametrize("size", [2.0**-60, 1e-30, 1e-130])
def test_loads_of_any_size_press_in_the_same_way(gap, stiff, size):
    """A body that falls through a gap onto another one has the forces of one without a gap."""

    def solution(load: float, gap: float) -> TornSolution:
        system = column(2, load=(0.3 * load, 0.2 * load, -load))
        lower, *others = system.subdomains
        parts = [replace(lower, stiffness=stiff * lower.stiffness), *others]
        system = with_fields(system, "contacts", gap=np.full(system.contacts.size, gap))
        return TornSolver(replace(system, subdomains=parts)).solve()

    expected, found = solution(1.0, 0.0), solution(size, gap)
    np.testing.assert_allclose(found.normal_force / size, expected.normal_force, atol=2e-6)
    assert 0.0 < found.report.certificate.error < 1e-6
    assert found.report.products["total"] <= expected.report.products["total"] + 1
    rise = found.displacements[-1].reshape(-1, 3)[:, 2]
    np.testing.assert_allclose(rise, -gap, rtol=1e-12)


@pytest.mark.parametrize(("gaps", "rise"), [((1, 1, 1, 1), -1.0), ((1, 0, 0, 1), 0.0)])
def test_gaps_that_no_motion_closes_are_left(gaps, rise):
    """A cube above another one moves down by a gap, but not where it touches at corners across."""
    solver = TornSolver(with_fields(column(1), "contacts", gap=1e-3 * np.array(gaps)))
    coarse_space, rows = solver.setup.projector.coarse_space, solver.setup.constraints.inequality
    a = closing_motion(coarse_space, solver.data.c, np.ones(rows.size, dtype=bool))
    upper = coarse_space.rigid_motion(a).reshape(-1, 3)[-8:]
    np.testing.assert_allclose(upper, np.tile([0, 0, 1e-3 * rise], (8, 1)), atol=1e-15)

"""Elastic supports that are soft or stiff beside the subdomains, against direct solutions."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from springs import glued_column, pressed_column, standing_cube

from fenics_tfeti.feti import Options, TornSolver

SOFT = [1e-13, 1e-12, 1e-10, 1e-9, 1e-8, 1e-6, 1e-4, 1e-3]
STIFF = [1e-2, 1.0, 1e3]


def direct_solution(system, active):
    """Return the torn displacements with the active contact rows closed, and their forces."""
    nodes = np.unique(np.concatenate([s.nodes for s in system.subdomains]))
    K, f = np.zeros((3 * nodes.size,) * 2), np.zeros(3 * nodes.size)
    places = []
    for s in system.subdomains:
        at = (3 * np.searchsorted(nodes, s.nodes)[:, None] + np.arange(3)).ravel()
        K[np.ix_(at, at)] += s.stiffness.toarray()
        f[at] += s.load
        places.append(at)
    contacts = system.contacts
    C = np.zeros((contacts.slave.size, f.size))
    for row, (slave, master, normal) in enumerate(
        zip(contacts.slave, contacts.master, contacts.normal, strict=True)
    ):
        C[row, 3 * np.searchsorted(nodes, slave) + np.arange(3)] += normal
        C[row, 3 * np.searchsorted(nodes, master) + np.arange(3)] -= normal
    C, c = C[active], contacts.gap[active]
    A = np.block([[K, C.T], [C, np.zeros((len(C), len(C)))]])
    b, factors = np.concatenate([f, c]), scipy.linalg.lu_factor(A)
    x = scipy.linalg.lu_solve(factors, b)
    for _ in range(8):
        residual = b - A.astype(np.longdouble) @ x
        x = x + scipy.linalg.lu_solve(factors, residual.astype(float))
    return np.concatenate([x[at] for at in places]), x[f.size :]


def largest_error(system, solution):
    """Return the largest error of the displacements, relative to the largest displacement."""
    u, force = direct_solution(system, solution.active)
    assert (force >= 0.0).all()
    return np.abs(np.concatenate(solution.displacements) - u).max() / np.abs(u).max()


def rounding(stiffness):
    """Return by how much u may change because the sum of stiffness and springs is rounded."""
    return 1e-13 / stiffness


def products(system, rtol=1e-8, method="active_set"):
    return TornSolver(system, Options(rtol=rtol, method=method)).solve().report.products["total"]


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
@pytest.mark.parametrize("stiffness", SOFT + STIFF)
@pytest.mark.parametrize("height", [1, 2])
def test_glued_cubes(height, stiffness, method):
    """One cube alone has no multipliers but those of its ground."""
    system = glued_column(stiffness, height)
    solution = TornSolver(system, Options(rtol=1e-8, method=method)).solve()
    assert solution.report.certificate.worst <= 1e-8
    assert largest_error(system, solution) <= 1e-6 + rounding(stiffness)


@pytest.mark.parametrize("stiffness", SOFT + STIFF)
def test_contact(stiffness):
    system = pressed_column(stiffness)
    solution = TornSolver(system, Options(rtol=1e-6)).solve()
    assert solution.report.certificate.worst <= 1e-6
    np.testing.assert_allclose(solution.report.springs.force, [-0.2, 0.0, 1.0], atol=1e-8)
    assert largest_error(system, solution) <= 1e-5 + rounding(stiffness)


@pytest.mark.parametrize("stiffness", SOFT)
def test_products_do_not_grow(stiffness):
    assert products(glued_column(stiffness, 2)) <= products(glued_column(1e3, 2))
    pressed = products(pressed_column(stiffness), rtol=1e-4)
    assert pressed <= products(pressed_column(1e3), rtol=1e-4)


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
@pytest.mark.parametrize("stiffness", [1e-13, 1e-10, 1e-8, 1e-6, 1e-4, 1e-3, *STIFF])
def test_springs_along_one_component(stiffness, method):
    """The floor and the springs carry the load; the cube may slide and spin about the vertical."""
    system = standing_cube(stiffness)
    solution = TornSolver(system, Options(rtol=1e-4, method=method)).solve()
    block = system.subdomains[0]
    u = solution.displacements[0].reshape(-1, 3)
    foot = block.coordinates[:, 2] == 0.0
    assert len(solution.report.free_motions) == 3
    assert solution.report.certificate.worst <= 1e-4
    force = solution.report.contact_force[0]
    if stiffness <= 1e-6:
        assert force == pytest.approx(1.0, rel=1e-3)
        assert u[foot, 2].min() == pytest.approx(-0.01, rel=1e-6)
    assert force <= 1.0

"""Multipliers of bodies without load vanish, and only these."""

from dataclasses import replace

import numpy as np
import pytest
from torn import column, cube, node_rows

from fenics_tfeti.feti import ContactRows, Options, TornSolver
from fenics_tfeti.feti.constraints.row_table import Kind
from fenics_tfeti.feti.solution.row_bodies import RowBodies, without_unloaded_groups

pytestmark = pytest.mark.once

LOOSE = 2 * 10**9


def with_unloaded_body(gap=0.1):
    """Add a body of two cubes without load, between two walls."""
    system = column(n=2)
    loose = [cube(2, (5, 0, k), 2, LOOSE) for k in range(2)]
    walls = [
        node_rows(
            loose[0].nodes[loose[0].coordinates[:, 0] == x], [n, 0.0, 0.0], gap=gap, contact=1
        )
        for x, n in ((5.0, -1.0), (6.0, 1.0))
    ]
    return replace(
        system,
        subdomains=[*system.subdomains, *loose],
        contacts=ContactRows.concatenate([system.contacts, *walls]),
        body_names=(),
        contact_names=("joint", "walls"),
    )


def changed_rows(system, force_of_walls=0.0):
    """Return the body of each row that loses its multiplier, and of each that keeps it."""
    constraints = TornSolver(system).dual_problem().constraints
    ends = np.cumsum([0, *(s.size for s in system.subdomains)])
    bodies = RowBodies.build(system, constraints, ends)
    multipliers = np.random.default_rng(0).standard_normal(constraints.size)
    walls = constraints.inequality[constraints.rows.of(Kind.CONTACT).contact == 1]
    multipliers[walls] = force_of_walls
    c = np.zeros(constraints.size)
    c[constraints.inequality[: system.contacts.size]] = system.contacts.gap
    load = np.concatenate([s.load for s in system.subdomains])
    found = without_unloaded_groups(constraints, bodies, load, c, multipliers)
    lost = found == 0.0
    np.testing.assert_array_equal(found[~lost], multipliers[~lost])
    of_row = bodies.of_unknowns(constraints.matrix.indices[constraints.matrix.indptr[:-1]])
    moved = multipliers != 0.0
    return set(of_row[lost & moved]), set(of_row[~lost])


def test_gluing_of_a_body_without_load():
    assert changed_rows(with_unloaded_body()) == ({2}, {0, 1})


def test_a_body_with_load_keeps_them():
    system = with_unloaded_body()
    *others, last = system.subdomains
    # pulled on two nodes, one above the other
    pulled = np.flatnonzero((last.coordinates[:, :2] == last.coordinates[0, :2]).all(axis=1))[:2]
    load = last.load.copy()
    load[3 * pulled + 2] = [-1e-30, 1e-30]
    system = replace(system, subdomains=[*others, replace(last, load=load)])
    assert changed_rows(system) == (set(), {0, 1, 2})


@pytest.mark.parametrize(("gap", "lost"), [(0.1, {2}), (-0.1, set())])
def test_a_squeezed_body_keeps_them(gap, lost):
    """Walls that press although there is play; walls that are too near press with reason."""
    assert changed_rows(with_unloaded_body(gap), force_of_walls=1.0)[0] == lost


def test_bodies_without_load_do_not_tighten_the_tolerance():
    report = TornSolver(with_unloaded_body(), Options(rtol=1e-4)).solve().report
    alone = TornSolver(column(n=2), Options(rtol=1e-4)).solve().report
    assert report.products["total"] == alone.products["total"]
    assert report.certificate.worst <= 1e-4
    (unloaded,) = (group for group in report.certificate.groups if group.bodies == ["body 2"])
    assert unloaded.energy_norm == unloaded.error == 0.0

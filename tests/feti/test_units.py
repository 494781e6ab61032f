"""The same problem in other units takes the same iterations; a load on supports moves nothing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from torn import column, cube, in_units, node_rows, with_fields, with_prescribed

from fenics_tfeti.feti import Options, Prescribed, TornSolver, TornSystem

pytestmark = pytest.mark.once

METHODS = pytest.mark.parametrize("method", ["active_set", "smalbe"])


def column_with_gap() -> TornSystem:
    """The upper cube is pushed down over a gap."""
    system = column(load=(0.1, 0, -1.0))
    return with_fields(system, "contacts", gap=np.linspace(0.0, 0.1, system.contacts.gap.size))


def squeezed_column() -> TornSystem:
    system = column(load=(0, 0, 0))
    upper = system.subdomains[-1]
    top = upper.nodes[np.isclose(upper.coordinates[:, 2], 3)]
    return with_prescribed(system, top, [2], -0.05)


UNITS = [(1.0, 1.0), (1e-12, 1e3), (1e12, 1e-9), (1e12, 1e3)]  # of force and length


@pytest.mark.parametrize(
    ("method", "preconditioner"), [("active_set", "lumped"), ("smalbe", "none")]
)
@pytest.mark.parametrize("problem", [column, column_with_gap, squeezed_column])
def test_units_do_not_matter(problem, method, preconditioner):
    options = Options(method=method, preconditioner=preconditioner)
    solvers = (TornSolver(in_units(problem(), *units), options) for units in UNITS)
    counts = [solver.solve().report.products["total"] for solver in solvers]
    assert max(counts) <= min(counts) + 1


def loaded(system: TornSystem, *places: tuple[float, float]) -> TornSystem:
    """Return the system with a load of all components at a height of the first subdomains."""
    parts = list(system.subdomains)
    for i, (height, size) in enumerate(places):
        load = np.where(np.repeat(parts[i].coordinates[:, 2] == height, 3), size, 0.0)
        parts[i] = dataclasses.replace(parts[i], load=load)
    return dataclasses.replace(system, subdomains=parts)


@METHODS
@pytest.mark.parametrize("places", [
    [(0, 1e-12)], [(0, 1.0)], [(0, 1e12)], [(1, 1.0), (1, -1.0)],
], ids=["tiny", "on held nodes", "huge", "copies of glued nodes against each other"])  # fmt: skip
def test_a_load_on_held_nodes_or_shared_out_by_glued_ones_moves_nothing(method, places):
    system = loaded(column(load=(0, 0, 0)), *places)
    solution = TornSolver(system, Options(method=method)).solve()
    assert not any(u.any() for u in solution.displacements)
    assert solution.report.converged and solution.report.products["total"] == 0


def test_a_loose_cube_without_load_stays_where_it_is():
    body = cube(2)
    bottom = body.nodes[body.coordinates[:, 2] == 0]
    rows = node_rows(bottom, [0.0, 0, -1.0])
    solution = TornSolver(TornSystem([body], Prescribed(), rows, 3)).solve()
    assert not solution.displacements[0].any()


@METHODS
def test_lengths_of_contact_rows_do_not_matter(method):
    """Forces are in newtons and gaps in metres, whatever the lengths of the coefficients."""
    system, options = column_with_gap(), Options(rtol=1e-8, method=method)
    rows = system.contacts
    length = 10.0 ** np.random.default_rng(0).uniform(-6.0, 6.0, rows.size)
    coefficients = length[rows.row][:, None] * rows.coefficients
    scaled = with_fields(system, "contacts", coefficients=coefficients, gap=length * rows.gap)
    expected, found = (TornSolver(s, options).solve() for s in (system, scaled))
    np.testing.assert_allclose(found.normal_force, expected.normal_force, rtol=1e-7, atol=1e-9)
    assert found.report.products == expected.report.products
    assert found.report.equilibrium == pytest.approx(expected.report.equilibrium, abs=1e-10)
    for ours, theirs in zip(found.report.contacts, expected.report.contacts, strict=True):
        assert ours.normal_force == pytest.approx(theirs.normal_force, rel=1e-8)
        np.testing.assert_allclose(ours.force, theirs.force, rtol=1e-8, atol=1e-10)

"""The same problem in other units takes the same iterations; a load on supports moves nothing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from torn import column, cube, node_rows

from fenics_tfeti.feti import Options, Prescribed, TornSolver, TornSystem

pytestmark = pytest.mark.once

METHODS = pytest.mark.parametrize("method", ["active_set", "smalbe"])


def in_units(system: TornSystem, force: float, length: float) -> TornSystem:
    """Return the system with forces and lengths in other units; stiffness is force over length."""
    subdomains = [
        dataclasses.replace(
            s,
            stiffness=s.stiffness * (force / length),
            load=s.load * force,
            coordinates=s.coordinates * length,
        )
        for s in system.subdomains
    ]
    contacts = dataclasses.replace(system.contacts, gap=system.contacts.gap * length)
    prescribed = dataclasses.replace(system.prescribed, values=system.prescribed.values * length)
    return dataclasses.replace(
        system, subdomains=subdomains, contacts=contacts, prescribed=prescribed
    )


def column_with_gap() -> TornSystem:
    """The upper cube is pushed down over a gap."""
    system = column(load=(0.1, 0, -1.0))
    gap = np.linspace(0.0, 0.1, system.contacts.gap.size)
    return dataclasses.replace(system, contacts=dataclasses.replace(system.contacts, gap=gap))


def squeezed_column() -> TornSystem:
    system = column(load=(0, 0, 0))
    upper = system.subdomains[-1]
    top = upper.nodes[np.isclose(upper.coordinates[:, 2], 3)]
    held = system.prescribed
    prescribed = Prescribed(
        np.concatenate([held.nodes, top]),
        np.concatenate([held.components, np.full(top.size, 2)]),
        np.concatenate([held.values, np.full(top.size, -0.05)]),
    )
    return dataclasses.replace(system, prescribed=prescribed)


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


@METHODS
@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
def test_a_load_on_held_nodes_moves_nothing(method, size):
    system = column(load=(0, 0, 0))
    lower = system.subdomains[0]
    load = np.where(np.repeat(lower.coordinates[:, 2] == 0, 3), size, 0.0)
    lower = dataclasses.replace(lower, load=load)
    system = dataclasses.replace(system, subdomains=[lower, *system.subdomains[1:]])
    solution = TornSolver(system, Options(method=method)).solve()
    assert not any(u.any() for u in solution.displacements)
    assert solution.report.converged and solution.report.products["total"] == 0


@METHODS
def test_a_load_that_nodes_on_both_sides_of_glue_share_out_moves_nothing(method):
    """Copies of the nodes between two subdomains are loaded against each other."""
    system = column(load=(0, 0, 0))
    first, second = system.subdomains[:2]
    up = np.where(np.repeat(first.coordinates[:, 2] == 1, 3), 1.0, 0.0)
    down = np.where(np.repeat(second.coordinates[:, 2] == 1, 3), -1.0, 0.0)
    subdomains = [
        dataclasses.replace(first, load=up),
        dataclasses.replace(second, load=down),
        system.subdomains[2],
    ]
    solution = TornSolver(
        dataclasses.replace(system, subdomains=subdomains), Options(method=method)
    ).solve()
    assert not any(u.any() for u in solution.displacements)


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
    scaled = dataclasses.replace(
        rows, coefficients=length[rows.row][:, None] * rows.coefficients, gap=length * rows.gap
    )
    expected = TornSolver(system, options).solve()
    found = TornSolver(dataclasses.replace(system, contacts=scaled), options).solve()
    np.testing.assert_allclose(found.normal_force, expected.normal_force, rtol=1e-7, atol=1e-9)
    assert found.report.products == expected.report.products
    for report, other in (
        (found.report, expected.report),
        *zip(found.report.contacts, expected.report.contacts, strict=True),
    ):
        for name in ("equilibrium",) if report is found.report else ("normal_force", "force"):
            np.testing.assert_allclose(
                getattr(report, name), getattr(other, name), rtol=1e-8, atol=1e-10
            )

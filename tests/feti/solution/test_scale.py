"""The scale of the tolerances: energy norms at the feasible start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from torn import column, with_fields

from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.solution.monitor import Monitor
from fenics_tfeti.feti.solution.scale import EnergyScale, FeasibleState
from fenics_tfeti.feti.solution.setup import SolveContext
from fenics_tfeti.feti.solution.states import History
from fenics_tfeti.feti.timer import Timer

pytestmark = pytest.mark.once


def scale_of(solver: TornSolver) -> EnergyScale:
    """Return the scale of a solver's problem, with no gap shortened."""
    setup, data = solver.setup, solver.data
    shortened = np.zeros(setup.constraints.inequality.size, dtype=bool)
    monitor = Monitor(History(), setup.constraints.layout.comm)
    context = SolveContext(setup, data, solver.options, Timer(), monitor)
    return EnergyScale.of(context, FeasibleState.of(setup, data), shortened)


@pytest.mark.parametrize("preconditioner", ["none", "lumped", "dirichlet"])
def test_energy_norm_is_not_below_the_solution(preconditioner):
    solver = TornSolver(column(n=2, load=(0, 0, -1.0)), Options(preconditioner=preconditioner))
    scale = scale_of(solver)
    solution = solver.solve()
    work = sum(
        u @ (s.stiffness @ u)
        for u, s in zip(solution.displacements, solver.system.subdomains, strict=True)
    )
    assert 1.0 <= scale.energy_norm / np.sqrt(work) <= 100.0


def test_rounding_counts_prescribed_jumps():
    """The rigid motions that close them are larger than the strain that is left."""
    system = column(n=2)
    far = with_fields(system, "prescribed", values=system.prescribed.values + 1e6)
    assert scale_of(TornSolver(system)).closing == 0.0
    moved = scale_of(TornSolver(far))
    assert moved.rounding_at(0.0) >= 1e6 * np.finfo(float).eps
    assert moved.rounding_at(moved.closing) == pytest.approx(2.0 * moved.rounding_at(0.0))


def test_largest_jump_counts_penetration():
    """Of bodies that a prescribed motion presses together, nothing has moved yet at the start."""
    system = column(n=2, load=(0, 0, 0))
    solver = TornSolver(with_fields(system, "contacts", gap=system.contacts.gap - 0.25))
    data = replace(solver.data, feasible=np.zeros_like(solver.data.feasible))
    largest = FeasibleState.of(solver.setup, data).largest_jump
    scale = solver.setup.constraints.contacts.scale.max()
    assert largest == pytest.approx(0.25 * scale)

"""A half that is much stiffer costs no more products, and the solution is as accurate."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from stiff_half import stiff_half
from torn import Glued

from fenics_tfeti.feti import Options, TornSolution, TornSolver

COMM = MPI.COMM_WORLD
JUMP = 1e8


@lru_cache(maxsize=None)
def solution(jump: float, pressed: bool, **options: Any) -> TornSolution:
    return TornSolver(stiff_half(jump, pressed, comm=COMM), Options(**options)).solve()


@pytest.mark.parametrize(
    ("preconditioner", "pressed"), [("lumped", False), ("dirichlet", True), ("none", True)]
)
def test_products_do_not_depend_on_the_jump(preconditioner, pressed):
    counts = [
        solution(jump, pressed, preconditioner=preconditioner).report.products["total"]
        for jump in (JUMP, 1e2)
    ]
    assert counts[0] <= 1.2 * counts[1] + 2


@pytest.mark.parametrize(("pressed", "options"), [
    (False, {"method": "smalbe"}),
    (True, {"coarse_solver": "distributed"}),
], ids=["clamped, smalbe", "pressed, distributed"])  # fmt: skip
def test_other_methods_converge(pressed, options):
    assert solution(JUMP, pressed, **options).report.converged


def energy(jump: float) -> float:
    """Return the energy of the clamped block by a dense solution."""
    system = stiff_half(jump)
    whole = Glued.of(system)
    K, f, free = whole.K, whole.f, whole.free
    # in units in which the stiffness of each unknown is 1
    scale = 1.0 / np.sqrt(K.diagonal()[free])
    load = scale * f[free]
    return -0.5 * load @ np.linalg.solve(scale[:, None] * K[free][:, free] * scale, load)


def test_energy_of_the_clamped_block():
    # the dense solution amplifies rounding by the condition number, about 1e3 times the jump, so
    # the energy is extrapolated: it is a + b / jump but for squares of 1 / jump
    jumps = np.array([1e4, 1e5])
    b, a = np.polyfit(1.0 / jumps, [energy(jump) for jump in jumps], 1)
    found = solution(JUMP, False, rtol=1e-7).report.energy
    assert found == pytest.approx(a + b / JUMP, rel=1e-7)


def test_forces_of_the_pressed_block_balance_the_load():
    found = solution(JUMP, True, preconditioner="none").report
    assert found.contacts[0].normal_force == pytest.approx(16.0, rel=1e-9)

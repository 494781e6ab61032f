"""A half that is much stiffer costs no more products, and the solution is as accurate."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from pairwise import pairwise
from stiff_half import stiff_half
from torn import Glued

from fenics_tfeti.feti import Options, TornSolution, TornSolver

COMM = MPI.COMM_WORLD
each_jump = pytest.mark.parametrize("jump", [1e6, 1e8])
each_kind = pytest.mark.parametrize("pressed", [False, True], ids=["clamped", "pressed"])


@lru_cache(maxsize=None)
def solution(jump: float, pressed: bool, **options: Any) -> TornSolution:
    return TornSolver(stiff_half(jump, pressed, comm=COMM), Options(**options)).solve()


@pytest.mark.parametrize(
    ("preconditioner", "jump", "pressed"),
    pairwise(["lumped", "dirichlet", "none"], [1e6, 1e8], [False, True]),
)
def test_products_do_not_depend_on_the_jump(jump, pressed, preconditioner):
    counts = [
        solution(size, pressed, preconditioner=preconditioner).report.products["total"]
        for size in (jump, 1e2)
    ]
    assert counts[0] <= 1.2 * counts[1] + 2


@pytest.mark.parametrize("options", [{"method": "smalbe"}, {"coarse_solver": "iterative"}], ids=str)
@each_kind
def test_other_methods_converge(pressed, options):
    assert solution(1e8, pressed, **options).report.converged


@lru_cache(maxsize=None)
def energy(jump: float) -> float:
    """Return the energy of the clamped block by a dense solution."""
    system = stiff_half(jump)
    whole = Glued.of(system)
    K, f, free = whole.K, whole.f, whole.free
    # in units in which the stiffness of each unknown is 1
    scale = 1.0 / np.sqrt(K.diagonal()[free])
    load = scale * f[free]
    return -0.5 * load @ np.linalg.solve(scale[:, None] * K[free][:, free] * scale, load)


@each_jump
def test_energy_of_the_clamped_block(jump):
    # the dense solution amplifies rounding by the condition number, about 1e3 times the jump
    found = solution(jump, False, rtol=1e-7).report.energy
    assert found == pytest.approx(energy(jump), rel=1e-12 + 1e-13 * jump)


@each_jump
def test_forces_of_the_pressed_block_balance_the_load(jump):
    assert solution(jump, True).report.contacts[0].normal_force == pytest.approx(16.0, rel=1e-9)

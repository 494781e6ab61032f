"""A double cantilever beam that delaminates, against beam theory and a serial model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from delaminating import CASES, Beam

from fenics_tfeti import Adhesive, Cohesive

pytestmark = pytest.mark.once


def test_peak_passes_and_products():
    """Steps of the opening: solves between which nothing but forces is renewed.

    A serial model has a peak of 163.7 N on cells of this length, and 162.5 N on the finest ones.
    """
    case = CASES["C"]
    options = {"rtol": 1e-5, "preconditioner": "dirichlet", "subdomain_size": 1000}
    beam = Beam(case, 0.25, 6, options, Cohesive(case.strength, case.energy))
    beam.open_by(1.0)
    tied = beam.problem.report.products["total"]
    curve, entries = beam.open_in_steps(np.array([3.0, 5.0, *np.arange(5.5, 6.6, 0.1)]))
    opening, load = curve.T
    assert load.max() == pytest.approx(163.7, rel=0.01)
    assert load.max() == pytest.approx(case.beam_theory()[0], rel=0.015)
    passes, products = (sum(getattr(e, name) for e in entries) for name in ("passes", "products"))
    grown = [entry for entry in entries if entry.path]
    assert products <= 0.5 * tied * passes
    assert sum(entry.products for entry in grown) <= 8 * tied * len(grown)
    assert passes <= 25 * len(entries)
    # the work of the load less what is stored, but for contact that opens in a step
    spent = case.b * sum(e.dissipated["bond"] for e in entries[1:])
    begin = len(entries[0].path)
    before, after = curve[begin:-1], curve[begin + 1 :]
    work = 0.5 * (before[:, 1] * after[:, 0] - after[:, 1] * before[:, 0]).sum()
    assert spent == pytest.approx(work, rel=3e-4)
    reused = beam.problem.report.reused
    assert {"factors", "coarse problem", "norm"} <= set(reused)


@pytest.mark.parametrize(("tips", "modes", "cell", "bound"), [
    pytest.param((0.0, 1.0), (0.25, 1.0), 0.5, 0.02, id="lifted-arm"),
    pytest.param((0.0, -1.0), (0.0, 1.0), 1.0, 0.04, id="pressed-arm"),
])  # fmt: skip
def test_mixed_modes(tips, modes, cell, bound):
    """An arm is lifted, or pressed on the other one, which contact in the crack bends with it.

    Beam theory has no zone where bonds soften, which takes 3 % off the load in shear.
    """
    shear_energy = 2.0
    case = replace(CASES["C"], a0=60.0, strength=60.0)
    law = Cohesive(
        lambda x: np.where(x[0] > case.a0 - 1e-6, case.strength, 0.0),
        case.energy,
        shear_strength=90.0,
        shear_energy=shear_energy,
    )
    options = {"rtol": 1e-5, "preconditioner": "dirichlet", "subdomain_size": 1000}
    beam = Beam(case, cell, 6, options, law, tips, 0.0)
    theory = case.load_in_modes(*modes, shear_energy)
    opening = theory / beam.open_by(0.1) * 0.1
    curve, _ = beam.open_in_steps(opening * np.array([0.8, 1.0, 1.05, 1.1]))
    assert curve[:, 1].max() == pytest.approx(theory, rel=bound)
    bond = beam.problem.results["bond"]
    crack = bond.coordinates[:, 0] < case.a0 - 1e-6
    assert bond.opening.min() > -1e-12
    assert (bond.nodal_normal_force[crack] > 0.0).any() == (tips[1] < 0.0)
    assert bond.damage[~crack].max() == 1.0


def test_adhesion_of_limited_energy():
    """The crack grows where as much is released as adhesion takes, but for single nodes.

    Rice's integral of arms whose ends are loaded is the load times their rotation.
    """
    case = replace(CASES["C"], strength=15.0)
    options = {"rtol": 1e-5, "preconditioner": "dirichlet", "subdomain_size": 1000}
    beam = Beam(case, 0.25, 6, options, Adhesive(case.strength, case.energy))
    beam.open_in_steps(np.array([3.0, 5.0, 6.0]))
    for opening in np.arange(6.5, 8.0, 0.1):
        beam.open_by(opening)
        bond, damage = beam.problem.results["bond"], beam.problem.report.damage
        assert damage.passes <= 3
        zone = np.count_nonzero((bond.damage == 0.0) & (bond.opening > 1e-9))
        assert 1.0 < beam.released() / case.energy < 1.0 + 1.1 / zone
        beam.problem.advance()

"""A double cantilever beam that delaminates, against beam theory and a serial model."""

from __future__ import annotations

import pytest
from delaminating import CASES, Beam, Bilinear, propagate

pytestmark = pytest.mark.once


def test_peak_passes_and_products():
    """The bond is weakened between solves that renew nothing but the forces.

    A serial model has a peak of 165.5 N on cells of this length, and 162.5 N on the finest ones.
    """
    case, cell = CASES["C"], 0.5
    law = Bilinear(10.0 * case.strength**2 / case.energy, case.strength, case.energy)
    options = {"rtol": 1e-5, "preconditioner": "dirichlet", "subdomain_size": 1000}
    beam = Beam(case, cell, 6, options)
    curve = propagate(beam, law, case, cell, 4.0)
    _, load, passes, products = curve.T
    assert load.max() == pytest.approx(165.5, rel=0.02)
    assert load.max() == pytest.approx(case.beam_theory()[0], rel=0.02)
    assert passes.mean() <= 12.0
    assert products.sum() / passes.sum() <= 1.2 * beam.tied
    assert products.mean() <= 10.0 * beam.tied
    reused = beam.problem.report.reused
    assert {"factors", "coarse problem", "norm"} <= set(reused)

"""A rigid flat punch on a half space: the pressure is infinite at its edge.

All lengths in metres. Of the formulas, that of the pressure takes the force that the solution
transmits. The body ends, and is held, at 200 a: that makes the force under a disc 0.3 % too large.
The rest is linear elements that cannot follow the edge, where displacements go like the square root
of the distance. The grid shrinks towards the edge by the square of its divisions; halving it makes
the errors three times smaller. Exact solutions of the discrete problem are off by 1.3 and 0.4 % in
the pressure up to 3/4 a, with 16 and 32 elements on half the strip; by 8.4 and 2.8 % with 6 and 12
on the radius of the disc, where the force is 6.5 and 2.2 % too large.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from mesh_arrays import of_script
from scenes import POISSON, Scene

pytestmark = pytest.mark.once

RADIUS, DEPTH, YOUNG = 0.01, 1e-4, 2e9
REDUCED = YOUNG / (1.0 - POISSON**2)

# dimension: (divisions, limit of the error of the pressure up to 3/4 a), coarse and fine
GRIDS = {2: ((8, 0.015), (16, 0.005)), 3: ((3, 0.09), (6, 0.03))}


@dataclass
class Solved:
    problem: Any
    force: float  # on the whole punch [N], or [N/m] in 2D
    radii: Any  # of the slave's nodes, relative to that of the punch
    pressure: Any  # relative to the formula's; zero beside the punch


def pushed(gdim: int, divisions: int) -> Solved:
    cell = "quadrilateral" if gdim == 2 else "hexahedron"
    bodies = of_script("half_space", gdim, cell, divisions, RADIUS)
    scene, tags = Scene.of(bodies, young=YOUNG), bodies.names
    scene.fix(tags["far"])
    for component, name in enumerate(("symmetry_x", "symmetry_y")[: gdim - 1]):
        scene.fix(tags[name], component)

    def punch(x: Any) -> tuple[Any, Any]:
        below = np.linalg.norm(x[: gdim - 1], axis=0) < RADIUS * (1.0 + 1e-6)
        down = np.zeros((gdim, below.size))
        down[-1] = -1.0
        return np.where(below, -DEPTH, RADIUS), down

    scene.add_obstacle(tags["top"], punch)
    options = {"rtol": 1e-6, "preconditioner": "lumped", "subdomain_size": 6000}
    problem = scene.problem(cell_tags=None, options=options)
    problem.solve()
    contact = problem.results[0]
    r = np.linalg.norm(contact.coordinates[:, : gdim - 1], axis=1) / RADIUS
    force = 2 ** (gdim - 1) * problem.report.contacts[0].normal_force
    scale = force / (np.pi * RADIUS) if gdim == 2 else force / (2.0 * np.pi * RADIUS**2)
    root = np.sqrt(np.maximum(0.0, 1.0 - r**2))
    return Solved(problem, force, r, contact.pressure * root / scale)


def pressure_error(solved: Solved) -> float:
    return float(np.abs(solved.pressure[solved.radii < 0.75] - 1.0).max())


@pytest.mark.parametrize("gdim", GRIDS)
def test_punch(gdim):
    """The pressure converges, and the whole punch touches and nothing else."""
    grids = [(pushed(gdim, divisions), limit) for divisions, limit in GRIDS[gdim]]
    errors = [pressure_error(solved) for solved, _ in grids]
    assert all(error <= limit for error, (_, limit) in zip(errors, grids, strict=True)), errors
    assert errors[1] <= 0.4 * errors[0]
    fine = grids[1][0]
    np.testing.assert_array_equal(fine.problem.results[0].active, fine.radii < 1.0 + 1e-6)
    if gdim == 3:
        # F = 2 a E* delta; the mesh and the boundary both make the body too stiff
        for (solved, _), limit in zip(grids, (0.07, 0.025), strict=True):
            assert 0.0 < solved.force / (2.0 * RADIUS * REDUCED * DEPTH) - 1.0 <= limit

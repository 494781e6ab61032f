"""Hertz's formulas for balls and rollers, at about 4 and 8 elements on the radius of contact.

All lengths in metres. The formulas take the force that the solution transmits. a and p0 come from a
straight line, p^2 = p0^2 (1 - r^2 / a^2), through the nodes with more than 30 % of the largest
pressure: near the edge of the contact the pressure has a vertical tangent, which no mesh resolves.
An exact solution of the discrete problem is off by 0.1 to 0.4 % in p0; in a by 0.1 to 0.5 % on
hexahedra and by 2 to 4 % on tetrahedra. The limits leave room for other versions of Gmsh.
"""

import numpy as np
import pytest
from mesh_arrays import of_script
from scenes import POISSON, Scene, dimension, normal_forces, plane

from dolfinx import fem

RADIUS, YOUNG = 0.05, 2e9
REDUCED = YOUNG / (1.0 - POISSON**2)
CONTACT_RADIUS = 4e-3
COARSE, FINE = 1e-3, 5e-4  # a/h = 4, 8

# cell: limits of the relative errors of p0 and of a at a/h = 8
LIMITS = {
    "triangle": (0.01, 0.02),
    "quadrilateral": (0.01, 0.01),
    "tetrahedron": (0.01, 0.05),
    "hexahedron": (0.01, 0.02),
}


def pressed(cell, size):
    """Return the solved problem of a ball or roller on a plane, and its load on the meshed part."""
    gdim = dimension(cell)
    bodies = of_script("half_balls", gdim, cell, size, (RADIUS,))
    tags, up = bodies.names, gdim - 1
    if gdim == 3:
        traction = -4.0 / 3.0 * REDUCED * CONTACT_RADIUS**3 / RADIUS / (np.pi * RADIUS**2)
    else:
        traction = -np.pi / 4.0 * REDUCED * CONTACT_RADIUS**2 / RADIUS / (2.0 * RADIUS)
    scene = Scene.of(bodies, young=YOUNG)
    scene.L = scene.constant(traction) * scene.v[up] * scene.ds(tags["flat"])
    for component, name in enumerate(("symmetry_x", "symmetry_y")[:up]):
        scene.fix(tags[name], component)
    scene.add_obstacle(tags["contact"], plane(up, gdim))
    options = {"rtol": 1e-6, "preconditioner": "lumped", "subdomain_size": 6000}
    problem = scene.problem(cell_tags=None, options=options)
    problem.solve()
    area = fem.assemble_scalar(fem.form(scene.constant(1.0) * scene.ds(tags["flat"])))
    return problem, -traction * area


def compare(problem):
    """Return Hertz's radius, and the relative errors of p0, of a and of the pressures."""
    contact, gdim = problem.results[0], problem.system.gdim
    r, p = np.linalg.norm(contact.coordinates[:, : gdim - 1], axis=1), contact.pressure
    F = 2 ** (gdim - 1) * problem.report.contacts[0].normal_force
    if gdim == 3:
        a = (3.0 * F * RADIUS / (4.0 * REDUCED)) ** (1.0 / 3.0)
        p0 = 3.0 * F / (2.0 * np.pi * a**2)
    else:
        a = np.sqrt(4.0 * F * RADIUS / (np.pi * REDUCED))
        p0 = np.sqrt(F * REDUCED / (np.pi * RADIUS))
    inner = p > 0.3 * p.max()
    slope, intercept = np.polyfit(r[inner] ** 2, p[inner] ** 2, 1)
    hertz = p0 * np.sqrt(np.maximum(0.0, 1.0 - (r / a) ** 2))
    errors = np.sqrt(intercept) / p0 - 1.0, np.sqrt(-intercept / slope) / a - 1.0
    return a, *np.abs(errors), np.linalg.norm(p - hertz) / np.linalg.norm(hertz)


@pytest.mark.parametrize("cell", LIMITS)
def test_pressed_by_a_force(cell):
    """Pressures converge nearly with the order 1: the tangent at the edge is vertical."""
    (coarse, load), (fine, _) = pressed(cell, COARSE), pressed(cell, FINE)
    np.testing.assert_allclose(normal_forces(coarse), load, rtol=1e-6)
    (_, _, coarse_radius, coarse_pressure), (a, peak, radius, pressure) = map(
        compare, (coarse, fine)
    )
    assert peak <= LIMITS[cell][0]
    assert radius <= min(LIMITS[cell][1], 0.7 * coarse_radius)
    assert pressure <= 0.65 * coarse_pressure
    # nothing touches beyond the radius, but for the last element
    contact = fine.results[0]
    r = np.linalg.norm(contact.coordinates[:, : contact.normal.shape[1] - 1], axis=1)
    assert r[contact.active].max() <= a + FINE
    assert r[~contact.active].min() >= a - FINE

"""Materials with a history that the user keeps: plasticity with its consistent tangent."""

from mpi4py import MPI

import numpy as np
import pytest
from finite_strains import BASE, ENDS, TOP
from scenes import Scene, at

import ufl
from dolfinx import fem

from fenics_tfeti import NonlinearContactProblem, Plane, Sphere
from fenics_tfeti.fem._compat import lagrange_space

one_point = ufl.dx(metadata={"quadrature_degree": 0})
SHEAR, BULK, YIELD, HARDENING = 0.4, 0.8, 0.02, 0.1


class Plastic:
    """J2 plasticity with linear hardening, plane strain, on triangles of constant strain."""

    def __init__(self, mesh):
        self.space = lagrange_space(mesh, 0, discontinuous=True)
        self.test = ufl.TestFunction(self.space)
        self.volumes = fem.assemble_vector(fem.form(self.test * one_point)).array
        # the plastic strains xx, yy, xy, and the equivalent one
        self.history = [fem.Function(self.space) for _ in range(4)]

    def trial(self, u):
        """Return the deviator of stress without plastic flow, its size, and the flow."""
        xx, yy, xy, p = self.history
        plastic = ufl.as_tensor([[xx, xy, 0], [xy, yy, 0], [0, 0, -xx - yy]])
        s = 2 * SHEAR * (ufl.dev(strain(u)) - plastic)
        size = ufl.sqrt(1.5 * ufl.inner(s, s) + 1e-30)
        excess = size - YIELD - HARDENING * p
        # what has just yielded is elastic at first, whatever the sign of its excess by rounding
        flow = ufl.conditional(ufl.gt(excess, 1e-12), excess, 0.0) / (3 * SHEAR + HARDENING)
        return s, size, flow

    def stress(self, u):
        """Return the stress after the radial return."""
        s, size, flow = self.trial(u)
        return BULK * ufl.tr(strain(u)) * ufl.Identity(3) + (1 - 3 * SHEAR * flow / size) * s

    def tangent(self, u, du):
        """Return the derivative of the stress, consistent with the radial return."""
        s, size, flow = self.trial(u)
        ds = 2 * SHEAR * ufl.dev(strain(du))
        change = 1.5 * ufl.inner(s, ds) / size
        flows = ufl.conditional(ufl.gt(flow, 0), 1 / (3 * SHEAR + HARDENING), 0)
        ratio = (flows - flow / size) * change / size
        volumetric = BULK * ufl.tr(strain(du)) * ufl.Identity(3)
        return volumetric + (1 - 3 * SHEAR * flow / size) * ds - 3 * SHEAR * ratio * s

    def update(self, u):
        """Keep the plastic strains of an accepted step."""
        s, size, flow = self.trial(u)
        increments = [1.5 * flow * s[i] / size for i in [(0, 0), (1, 1), (0, 1)]] + [flow]
        forms = [fem.form(value * self.test * one_point) for value in increments]
        sums = [fem.assemble_vector(form).array for form in forms]
        for function, values in zip(self.history, sums, strict=True):
            function.x.array[:] += values / self.volumes


def strain(u):
    """Return the small strain, 3 x 3."""
    e = ufl.sym(ufl.grad(u))
    return ufl.as_tensor([[e[0, 0], e[0, 1], 0], [e[1, 0], e[1, 1], 0], [0, 0, 0]])


def press(tool, n, with_tangent=True):
    """Return a block of 1 by 1 between planes of symmetry, and a function that solves a step.

    It has n x n squares. The tool is a function of the depth. A step accepts the solution and
    returns the force.
    """
    marks = [(ENDS, lambda x: np.isclose(x[0], 0) | np.isclose(x[0], 1))]
    marks += [(TOP, at(1, 1)), (BASE, at(1, 0))]
    bodies = Scene.of_boxes(MPI.COMM_WORLD, "triangle", [((0, 0), (1, 1), (n, n))], marks)
    u, v, material, load = fem.Function(bodies.V), bodies.v, Plastic(bodies.mesh), {"depth": 0.0}
    bodies.fix(ENDS, 0)
    bodies.fix(BASE, 1)
    bodies.add_obstacle(TOP, lambda x: tool(load["depth"])(x))
    J = ufl.inner(material.tangent(u, bodies.u), strain(v)) * one_point
    problem = NonlinearContactProblem(
        ufl.inner(material.stress(u), strain(v)) * one_point,
        u,
        J=J if with_tangent else None,
        bcs=bodies.bcs,
        contacts=bodies.contacts,
        options={"newton_rtol": 1e-9, "subdomain_size": 40},
    )

    def step(depth):
        load["depth"] = depth
        problem.solve()
        problem.advance()
        material.update(u)
        return problem.results[0].force[1]

    return problem, material, step


def test_confined_compression():
    """Loaded three times and unloaded: the closed form of uniaxial strain."""
    (_, material, step), flow = press(lambda depth: Plane((0, 1 - depth), (0, -1)), 3), 0.0
    for e in [0.01, 0.05, 0.1, 0.09]:
        force = step(e)
        flow = max(flow, (2 * SHEAR * e - YIELD) / (3 * SHEAR + HARDENING))
        size = 2 * SHEAR * e - 3 * SHEAR * flow
        assert force == pytest.approx(-BULK * e - 2 / 3 * size, rel=1e-7)
        np.testing.assert_allclose(material.history[3].x.array, flow, atol=1e-8)


def test_indentation():
    """The consistent tangent is the derivative of the residual; a dent is left."""
    forces, steps = [], []
    for with_tangent in [False, True]:
        problem, _, step = press(lambda depth: Sphere((0.5, 1.5 - depth), 0.5), 6, with_tangent)
        for depth in [0.08, 0.07]:
            forces.append(step(depth))
            steps.append(len(problem.report.newton))
    step(0.0)
    assert 0.03 < np.abs(problem.u.x.array).max() < 0.08
    np.testing.assert_allclose(forces[:2], forces[2:], atol=1e-7)
    assert steps[:2] == steps[2:]

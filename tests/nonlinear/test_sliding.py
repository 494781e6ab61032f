"""Large sliding and rotations: an ironed block, a beam bent over a cylinder, a crushed ring.

The references of the ironed block without friction and of the beam are those of a Newton method
with an active set and sparse LU of the whole tangent.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import scipy.integrate
from finite_strains import SLIDER, TOP, beam, cell_space, clamped, ironing, ring

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, Coulomb, NonlinearContactProblem, Plane, RigidObstacle
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
from fenics_tfeti.models import neo_hookean, symmetry_plane

heavy = pytest.mark.heavy


def test_pressing():
    scene = ironing(newton_rtol=1e-8, subdomain_size=400)
    scene.solve([0.5, 1.0])
    reaction = scene.problem.report.reactions[1].force
    np.testing.assert_allclose(reaction, [0.001797, -0.221102], atol=1e-6)


@heavy
@pytest.mark.parametrize("slave", [SLIDER, TOP])
def test_ironing(slave):
    scene = ironing(slave=slave, newton_rtol=1e-8, subdomain_size=400)
    scene.solve([0.5, 1.0, 1.25, 1.5, 1.75, 2.0])
    tolerance = 1e-6 if slave == SLIDER else 1e-3
    reaction = scene.problem.report.reactions[1].force
    np.testing.assert_allclose(reaction, [-0.000017, -0.225897], atol=tolerance)
    assert scene.energy == pytest.approx(0.028203, abs=tolerance)


@heavy
def test_ironing_with_friction():
    scene = ironing(Coulomb(0.3), subdomain_size=400)
    scene.solve([0.5, *np.linspace(1.0, 2.0, 11)])
    reaction = scene.problem.report.reactions[1].force
    np.testing.assert_allclose(reaction, [0.068950, -0.227359], atol=5e-6)


@pytest.mark.parametrize("loads", [[1.0], pytest.param([0.5, 1.0], marks=heavy)])
def test_beam(loads):
    scene = beam(newton_rtol=1e-7, subdomain_size=100)
    scene.solve(loads)
    largest = np.abs(scene.problem.u.x.array).max()
    assert largest == pytest.approx(4.109780668, abs=1e-6)
    assert scene.energy == pytest.approx(0.000545923834, rel=1e-7)
    force = np.linalg.norm(scene.problem.results[0].force)
    assert force == pytest.approx(0.00163538133, rel=2e-3)
    steps, products = scene.counts()
    assert steps <= 15 and products <= 25


def elastica(thickness, height=1.0):
    """Return the force of a plate on half a ring, an inextensible rod of mean radius 1.

    The rod is flat under the plate. From there to the equator, where its angle is pi/2, the
    curvature k fulfils k^2 = p sin(angle), with the force of the plate p EI on the whole ring.
    """
    up = scipy.integrate.quad(lambda angle: np.sqrt(np.sin(angle)), 0.0, np.pi / 2)[0]
    p = (2.0 * up / height) ** 2
    # with the angle s^2
    bent = scipy.integrate.quad(
        lambda s: 2.0 * s / np.sqrt(p * np.sin(s**2)), 0.0, np.sqrt(np.pi / 2)
    )[0]
    assert bent < np.pi / 2
    return 0.5 * p * thickness**3 / 12.0 / (1.0 - 0.3**2)


@pytest.mark.parametrize("loads", [[1.0], pytest.param([0.5, 1.0], marks=heavy)])
def test_ring_is_an_elastica(loads):
    scene = ring(subdomain_size=100)
    scene.solve(loads)
    lower, upper = scene.problem.results
    assert lower.force[1] == pytest.approx(elastica(0.05), rel=0.015)
    assert upper.force[1] == pytest.approx(-lower.force[1], rel=1e-5)


def test_counts_of_the_ring():
    scene = ring(0.1, 48, 3, degree=1, subdomain_size=100)
    scene.solve([1.0])
    steps, products = scene.counts()
    assert steps <= 10 and products <= 25


@pytest.mark.ranks
def test_edge_of_a_master_that_passes_nodes_of_the_slave():
    """A block dragged over a larger one: the roles of the surfaces hardly matter."""
    forces = []
    for slave, master in ((3, 2), (2, 3)):
        tagged = boxes(
            MPI.COMM_WORLD,
            [Box((0, 0), (2, 1), (8, 4)), Box((0.3, 1), (1.2, 1.6), (5, 3))],
            "quadrilateral",
        )
        surfaces = [
            (1, lambda x: np.isclose(x[1], 0), 1),
            (2, lambda x: np.isclose(x[1], 1), 1),
            (3, lambda x: np.isclose(x[1], 1), 2),
            (4, lambda x: np.isclose(x[1], 1.6), 2),
        ]
        tags = tag_facets(tagged.mesh, surfaces, tagged.cell_tags)
        V = displacement_space(tagged.mesh)
        u, motion = fem.Function(V), fem.Function(V)
        moved = fem.locate_dofs_topological(V, 1, tags.find(4))
        problem = NonlinearContactProblem(
            ufl.derivative(neo_hookean(1.0, 0.3)(u) * ufl.dx, u, ufl.TestFunction(V)),
            u,
            bcs=[clamped(V, tags.find(1)), fem.dirichletbc(motion, moved)],
            contacts=[ContactPair(tags, slave=slave, master=master)],
        )
        for way, depth in [(0.0, 0.06), *((0.05 * k, 0.12) for k in range(6))]:
            motion.x.array.reshape(-1, 2)[:] = way, -depth
            problem.solve()
            problem.advance()
            # a node that got and lost its condition in turn took all 30 steps
            assert len(problem.report.newton) <= 10
        forces.append(abs(problem.results[0].force[1]))
    assert forces[0] == pytest.approx(forces[1], rel=0.02)


class TestRingOfRoundSection:
    """A rubber ring of radius 8 and a round section of radius 1, squeezed between two plates.

    While one node presses on each plate, the section rolls over them: only the hoop strain, the
    elastic support of the meridian, resists, and less than the load drives it. The plane through
    its middle is one of symmetry.
    """

    @staticmethod
    def force(is_half):
        """Return the force of the upper plate on the section, or on its upper half."""
        low = 0 if is_half else -1
        section = Box((-1, low), (1, 1), (8, 4 * (1 - low)))
        mesh = boxes(MPI.COMM_SELF, [section], "quadrilateral").mesh
        markers = {1: lambda x: np.isclose(np.maximum(abs(x[0]), abs(x[1])), 1)}
        if is_half:
            markers[2] = lambda x: np.isclose(x[1], 0)
        tags = tag_facets(mesh, markers)
        x, y = mesh.geometry.x[:, :2].T
        section = 8 + x * np.sqrt(1 - y**2 / 2), y * np.sqrt(1 - x**2 / 2)
        mesh.geometry.x[:, :2] = np.transpose(section)
        V = displacement_space(mesh)
        u, r = fem.Function(V), ufl.SpatialCoordinate(mesh)[0]
        F, hoop = ufl.Identity(2) + ufl.grad(u), 1 + u[0] / r
        log = ufl.ln(ufl.det(F) * hoop)
        energy = (0.5 * (ufl.inner(F, F) + hoop**2 - 3) - log + log**2) * r
        squeeze = {"now": 0.0}
        contacts = [
            RigidObstacle(tags, 1, lambda x, s=s: Plane((0, s - s * squeeze["now"]), (0, -s))(x))
            for s in (1, low)
            if s
        ]
        problem = NonlinearContactProblem(
            ufl.derivative(energy * ufl.dx, u, ufl.TestFunction(V)),
            u,
            bcs=symmetry_plane(V, tags, 2, axis=1) if is_half else None,
            contacts=contacts,
            measure_weight=r,
        )
        for _ in problem.steps(lambda t: squeeze.update(now=t), 0.0, 0.1, first=0.05):
            pass
        return problem.results[0].force[1]

    def test_force_is_that_of_the_half(self):
        assert self.force(False) == pytest.approx(self.force(True), rel=1e-6)


def crown_between_plates(is_held):
    """Return the force of a lid on a body with a crown, and the Newton steps."""
    parts = [
        Box((-1, 0), (1, 1), (8, 4)),
        Box((-2, -0.5), (2, 0), (10, 1)),
        Box((-2, 1.5), (2, 2), (10, 1)),
    ]
    tagged = boxes(MPI.COMM_WORLD, parts, "quadrilateral")
    mesh = tagged.mesh
    surfaces = [
        (1, lambda x: np.isclose(x[1], 0), 1),
        (2, lambda x: np.isclose(x[1], 1), 1),
        (3, lambda x: np.isclose(x[1], 0), 2),
        (4, lambda x: np.isclose(x[1], 1.5), 3),
        (5, lambda x: np.isclose(x[1], -0.5), 2),
        (6, lambda x: np.isclose(x[1], 2), 3),
    ]
    tags = tag_facets(mesh, surfaces, tagged.cell_tags)
    x, y = mesh.geometry.x[:, 0], mesh.geometry.x[:, 1]
    mesh.geometry.x[:, 1] = np.where((y > 0) & (y < 1.1), y * (1.5 - 0.5 * x**2), y)
    V = displacement_space(mesh)
    u, motion = fem.Function(V), fem.Function(V)
    E = fem.Function(cell_space(mesh))
    E.x.array[:] = 300.0
    E.x.array[tagged.cell_tags.find(1)] = 1.0
    moved = fem.locate_dofs_topological(V, 1, tags.find(6))
    bcs = [clamped(V, tags.find(5)), fem.dirichletbc(motion, moved)]
    if is_held:
        middle = fem.locate_dofs_geometrical(
            (V.sub(0), V.sub(0).collapse()[0]),
            lambda x: np.isclose(x[0], 0) & (x[1] > 0.1) & (x[1] < 1.4),
        )[0]
        bcs.append(fem.dirichletbc(0.0, middle, V.sub(0)))
    problem = NonlinearContactProblem(
        ufl.derivative(neo_hookean(E, 0.3)(u) * ufl.dx, u, ufl.TestFunction(V)),
        u,
        bcs=bcs,
        contacts=[ContactPair(tags, slave=1, master=3), ContactPair(tags, slave=2, master=4)],
    )
    steps = 0
    for depth in (0.05, 0.2):
        motion.x.array.reshape(-1, 2)[:, 1] = -depth
        problem.solve()
        problem.advance()
        steps += len(problem.report.newton)
    return problem.results[1].force[1], steps


@pytest.mark.ranks
def test_body_that_only_contact_holds():
    """It may slide freely between two plates: increments would take it far to either side."""
    (free, steps), (held, _) = crown_between_plates(False), crown_between_plates(True)
    assert free == pytest.approx(held, rel=1e-4)
    assert steps <= 20

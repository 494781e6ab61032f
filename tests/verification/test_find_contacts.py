"""Pairs of bricks that are found: forces, and what the search and open joints cost."""

import gc
import sys
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Coulomb, Plane, RigidObstacle, find_contacts
from fenics_tfeti.io import boxes, displacement_space
from fenics_tfeti.models import isotropic

ROOT = Path(__file__).parents[2]
COMM = MPI.COMM_SELF

pytestmark = pytest.mark.once


def forms(mesh, load, modulus=2.1e11):
    """Return space, bilinear form and the work of a force per volume."""
    V = displacement_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(isotropic(modulus, 0.3)(u), ufl.grad(v)) * ufl.dx
    return V, a, ufl.inner(fem.Constant(mesh, np.array(load, dtype=float)), v) * ufl.dx


def test_head_joints_that_are_open_have_no_friction():
    """Pairs of bricks that do not touch change neither the solution nor the iterations."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    import bricks

    parts, course_of = bricks.wall(60, 2)
    made, friction = boxes(COMM, parts, "quadrilateral"), Coulomb(0.3)
    _, a, L = forms(made.mesh, (0, -bricks.WEIGHT), 5e9)
    tags, plane = bricks.bed_joints(made, course_of), Plane((0, 0), (0, 1))
    ground = RigidObstacle(tags, bricks.GROUND, plane, friction=friction)
    pairs, energies, products = [], [], []
    for distance in (1e-3, None):
        arguments = {"friction": friction, "distance": distance}
        pairs.append(find_contacts(made.mesh, made.cell_tags, **arguments))
        problem = ContactProblem(a, L, contacts=[*pairs[-1], ground])
        problem.solve()
        energies.append(problem.report.energy)
        products.append(problem.report.products["total"])
    assert len(pairs[1]) > len(pairs[0])
    assert energies[1] == pytest.approx(energies[0], rel=1e-6)
    assert products[1] <= 1.2 * products[0]


@pytest.mark.heavy
def test_a_thousand_bricks():
    """Each bed joint carries what is above it; the search is a small part of the solve."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    import bricks

    parts, course_of = bricks.wall(1000, 2)
    made = boxes(COMM, parts, "quadrilateral")
    _, a, L = forms(made.mesh, (0, -bricks.WEIGHT), 5e9)
    ground = RigidObstacle(bricks.bed_joints(made, course_of), bricks.GROUND, Plane((0, 0), (0, 1)))
    # in processor time, without the garbage of other tests
    gc.collect()
    begin = time.process_time()
    pairs = find_contacts(made.mesh, made.cell_tags, distance=1e-3)
    searched = time.process_time() - begin
    problem = ContactProblem(a, L, contacts=[*pairs, ground], options={"rtol": 1e-6})
    problem.solve()
    total = time.process_time() - begin
    weights = bricks.WEIGHT * np.array([np.prod(np.subtract(b.upper, b.lower)) for b in parts])
    course_of = np.array(course_of)
    forces = np.zeros(max(course_of) + 1)
    for pair, contact in zip(pairs, problem.report.contacts, strict=False):
        bodies = [int(part.split()[1]) for part in pair.name.split(" on ")]
        assert abs(np.diff(course_of[bodies])[0]) == 1
        forces[course_of[bodies].min()] += contact.normal_force
    above = [weights[course_of > course].sum() for course in range(forces.size)]
    assert np.allclose(forces, above, rtol=1e-6, atol=1e-6 * weights.sum())
    assert searched < 0.1 * total

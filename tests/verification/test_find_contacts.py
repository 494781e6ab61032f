"""Pairs that are found give the solution of named pairs: bolt, pile, bearing, a wall of bricks."""

from __future__ import annotations

import gc
import re
import sys
import time
from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
from matching import match_contacts
from random_assemblies import random_assembly

import ufl
from dolfinx import fem

from fenics_tfeti import (
    ContactPair,
    ContactProblem,
    Coulomb,
    InputError,
    Plane,
    RigidObstacle,
    find_contacts,
)
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.io import boxes, displacement_space, read_msh
from fenics_tfeti.models import isotropic, symmetry_plane

ROOT = Path(__file__).parents[2]
COMM = MPI.COMM_SELF

pytestmark = pytest.mark.once


def forms(mesh, load, modulus=2.1e11):
    """Return space, bilinear form and the work of a force per volume."""
    V = displacement_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(isotropic(modulus, 0.3)(u), ufl.grad(v)) * ufl.dx
    return V, a, ufl.inner(fem.Constant(mesh, np.array(load, dtype=float)), v) * ufl.dx


def test_bolt_in_lug():
    """With the clearance of the demo, which the mesh has not."""
    parts = read_msh(ROOT / "meshes" / "bolt_in_lug.msh", COMM)
    facets, tags = parts.facet_tags, parts.names
    V, a, L = forms(parts.mesh, (1e9, 0, 0))
    clamped = fem.locate_dofs_topological(V, 2, facets.find(tags["clamped"]))
    bcs = [fem.dirichletbc(np.zeros(3), clamped, V)]
    bcs += [
        symmetry_plane(V, facets, tags[f"symmetry_{axis}"], k) for k, axis in ((1, "y"), (2, "z"))
    ]
    named = ContactPair(facets, tags["lug surface"], tags["bolt surface"])
    (found,) = find_contacts(parts.mesh, parts.cell_tags)
    solutions = []
    for pair in (named, found):
        pair = replace(pair, initial_gap=lambda x: 2e-5 * (1 + x[0] / 0.01))
        problem = ContactProblem(a, L, bcs=bcs, contacts=pair, options={"rtol": 1e-8})
        solutions.append(problem.solve().x.array.copy())
    assert np.abs(solutions[1] - solutions[0]).max() < 1e-6 * np.abs(solutions[0]).max()


@pytest.mark.parametrize("gdim", [2, pytest.param(3, marks=pytest.mark.heavy)])
def test_pile_of_cylinders(gdim):
    """More of the discs is found than has tags, but no more of it touches."""
    name = "pile_of_cylinders" if gdim == 2 else "pile_of_cylinders_3d"
    parts = read_msh(ROOT / "meshes" / f"{name}.msh", COMM, gdim=gdim)
    facets, tags, up = parts.facet_tags, parts.names, np.eye(gdim)[1]
    _, a, L = forms(parts.mesh, -9810.0 * up, 0.5e9)
    obstacles, named = [], []
    for side, sign in (("left", 1.0), ("right", -1.0)):
        wall = Plane(-0.55 * sign * np.eye(gdim)[0], sign * np.eye(gdim)[0])
        obstacles += [
            RigidObstacle(facets, tags[f"{side} floor"], Plane(np.zeros(gdim), up)),
            RigidObstacle(facets, tags[f"{side} wall"], wall),
        ]
        named.append(ContactPair(facets, tags[f"{side} top"], tags[f"top {side}"]))
    forces = []
    for pairs in (named, find_contacts(parts.mesh, parts.cell_tags)):
        problem = ContactProblem(a, L, contacts=[*pairs, *obstacles], options={"rtol": 1e-8})
        problem.solve()
        forces.append([contact.force for contact in problem.report.contacts])
    assert np.abs(np.subtract(*forces)).max() < 1e-6 * np.abs(forces[0]).max()


@pytest.mark.heavy
@pytest.mark.filterwarnings("ignore:find_contacts. 16 pairs of bodies:UserWarning")
def test_roller_bearing(tmp_path):
    """32 pairs of rollers and rings: loads as with four named pairs, in not many more products."""
    sys.path.insert(0, str(ROOT / "meshes"))
    from roller_bearing import roller_bearing, small_bearing

    bearing = small_bearing()
    roller_bearing(tmp_path / "bearing.msh", bearing)
    parts = read_msh(tmp_path / "bearing.msh", COMM, gdim=3)
    facets, tags = parts.facet_tags, parts.names
    V, a, _ = forms(parts.mesh, (0, 0, 0))
    bore = ufl.Measure("ds", domain=parts.mesh, subdomain_data=facets)(tags["bore"])
    traction = fem.Constant(parts.mesh, np.array([0.0, -2e7, -4e6]))
    L = ufl.inner(traction, ufl.TestFunction(V)) * bore
    outside = fem.locate_dofs_topological(V, 2, facets.find(tags["outside"]))
    named = [
        ContactPair(facets, tags[f"rollers {row} {side}"], tags[f"{side} raceway {row}"])
        for row in (1, 2)
        for side in ("outer", "inner")
    ]
    loads, products = [], []
    for pairs in (named, find_contacts(parts.mesh, parts.cell_tags)):
        problem = ContactProblem(
            a,
            L,
            bcs=fem.dirichletbc(np.zeros(3), outside, V),
            contacts=pairs,
            cell_tags=parts.cell_tags,
            options={"rtol": 1e-6, "preconditioner": "dirichlet", "deflation": "on"},
        )
        problem.solve()
        of_rollers = np.zeros((2, bearing.rollers))
        for contact in problem.results:
            x = contact.coordinates
            row = int(x[:, 2].mean() > 0.0)
            np.add.at(of_rollers[row], bearing.roller_of(x.T), contact.nodal_normal_force)
        loads.append(of_rollers)
        products.append(problem.report.products["total"])
    assert len(pairs) == 32
    assert np.abs(loads[1] - loads[0]).max() < 1e-4 * loads[0].max()
    assert products[1] < 2.0 * products[0]


def test_head_joints_that_are_open_have_no_friction():
    """Pairs of bricks that do not touch change neither the solution nor the iterations."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    import bricks

    parts, course_of = bricks.wall(30, 2)
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


@pytest.mark.heavy
@pytest.mark.filterwarnings("ignore")
def test_random_assemblies():
    """Pairs are those of boxes one after the other, of the faces between them and no others."""
    refused = 0
    for seed in range(144):
        assembly = random_assembly(seed, MPI.COMM_WORLD)
        mesh, joints = assembly.bodies.mesh, assembly.joints
        pairs = find_contacts(mesh, assembly.bodies.cell_tags)
        numbers = [[int(n) - 1 for n in re.findall(r"cell tag (\d+)", p.name)] for p in pairs]
        assert sorted(map(sorted, numbers)) == [[k, k + 1] for k in range(joints.size)], seed
        try:
            all_conditions = match_contacts(MeshBoundary.of(displacement_space(mesh)), pairs)
        except InputError:
            refused += 1
            continue
        for conditions, bodies in zip(all_conditions, numbers, strict=True):
            joint = min(bodies)
            for surface in conditions.surfaces:
                off = surface.corners[:, :, assembly.axis] - joints[joint]
                assert np.abs(off).max() <= assembly.height + 1e-12, seed
            assert np.abs(conditions.gap).max() <= assembly.height + 1e-12, seed
            area = mesh.comm.allreduce(conditions.area.sum())
            assert area == pytest.approx(assembly.overlaps[joint], rel=0.01), seed
    assert refused <= 2

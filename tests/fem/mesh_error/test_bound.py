"""The strict bound of the mesh's error, against solutions on finer meshes."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from mesh_errors import CASES, TIGHT, beams, posed, roller, true_error
from scenes import Scene, at, dimension

import ufl

from fenics_tfeti import Plane, RigidBody, TiedPair

COMM = MPI.COMM_SELF
BOTTOM, TOP, LEFT, BELOW, ABOVE = 1, 2, 3, 4, 5


def block(kind: str, n: int, degree: int = 1, cell: str = "triangle", seed: int | None = None):
    """Return a block on the ground, or one block on another, under a load that varies.

    Nodes inside are moved at random.
    """
    gdim = dimension(cell)
    up, rng = gdim - 1, np.random.default_rng(seed)
    heights = (0.0, 1.0) if kind in ("alone", "ground") else (0.0, 1.0, 2.0)
    parts = [
        ((0.0,) * up + (low,), (1.0,) * up + (high,), (n,) * gdim)
        for low, high in zip(heights, heights[1:], strict=False)
    ]
    marks = [(BOTTOM, at(up, 0.0)), (TOP, at(up, heights[-1]))]
    marks += [(LEFT + 10 * axis, at(axis, 0.0)) for axis in range(up)]
    if len(parts) == 2:
        marks += [(BELOW, at(up, 1.0), 1), (ABOVE, at(up, 1.0), 2)]

    def moved(x):
        distance = np.min([np.abs(x - side) for side in (0.0, 1.0, 2.0)], axis=0)
        inner = (distance > 1e-9).all(axis=0)
        return x + 0.25 / n * inner * rng.uniform(-1, 1, x.shape) * (seed is not None)

    scene = Scene.of_boxes(COMM, cell, parts, marks, moved, degree=degree, young=1.0)
    for axis in range(up):
        scene.fix(LEFT + 10 * axis, axis)
    x = ufl.SpatialCoordinate(scene.mesh)
    scene.L = -1e-3 * (1 + 2 * x[0]) * scene.v[up] * scene.ds(TOP)
    if len(parts) == 2:
        scene.fix(BOTTOM, up)
        scene.add_pair(ABOVE, BELOW, name="joint")
        if kind == "tied":
            scene.contacts = [TiedPair(scene.facet_tags, slave=ABOVE, master=BELOW)]
    elif kind == "alone":
        scene.fix(BOTTOM)
        scene.add_obstacle(TOP, Plane((0.0,) * up + (9.0,), (0.0,) * up + (-1.0,)))
    else:
        scene.add_obstacle(BOTTOM, Plane((0.0,) * gdim, (0.0,) * up + (1.0,)), name="ground")
    return scene


def solved(scene: Scene):
    problem = scene.problem(options=TIGHT)
    problem.solve()
    return problem


@pytest.fixture(scope="module")
def energies():
    """The squares of the energy norms of solutions on fine meshes: below those of exact ones."""
    found: dict[tuple[str, str], float] = {}

    def energy(kind: str, cell: str) -> float:
        if (kind, cell) not in found:
            fine = solved(block(kind, 16 if cell == "triangle" else 6, 2, cell))
            found[kind, cell] = fine.mesh_error().energy_norm ** 2
        return found[kind, cell]

    return energy


@pytest.mark.parametrize("seed", (0, 1, 2))
@pytest.mark.parametrize(
    ("kind", "cell"),
    [
        *((kind, "triangle") for kind in ("alone", "ground", "pair", "tied")),
        ("ground", "tetrahedron"),
        ("pair", "tetrahedron"),
    ],
)
def test_is_above_the_true_error(kind, cell, seed, energies):
    """Without prescribed displacements, initial gaps and energy of the ground.

    The difference of the potential energies is half of that of the squares of the norms, and above
    half of the square of the error.
    """
    problem = solved(block(kind, 4 if cell == "triangle" else 2, 1, cell, seed))
    bound = problem.mesh_error(bound=True)
    assert bound.reasons == ()
    assert bound.guaranteed
    square = energies(kind, cell) - bound.energy_norm**2
    assert square > 0.0
    assert 1.0 <= bound.error * bound.energy_norm / np.sqrt(square) < 1.8


def parabola(x):
    """Return the gap below a shallow round body that stays in place, and its normal."""
    gap = x[0] ** 2 / 0.1
    return gap, np.stack([np.zeros_like(gap), np.full_like(gap, -1.0)])


def on_parabola(n: int, degree: int = 1) -> Scene:
    scene = roller(COMM, n, degree)
    tag = scene.contacts[0].slave
    scene.contacts = []
    scene.add_obstacle(tag, parabola, name="roller")
    return scene


@pytest.mark.parametrize("n", (8, 16))
def test_facets_are_moved_off_a_round_obstacle(n):
    """Between nodes they penetrate it."""
    fine_scene = on_parabola(32, 2)
    problem, fine = solved(on_parabola(n)), solved(fine_scene)
    bound = problem.mesh_error(bound=True)
    assert bound.guaranteed
    error = true_error(problem, fine, fine_scene)
    assert 1.0 <= bound.error * bound.energy_norm / error < 2.0


@pytest.mark.parametrize("rtol", (1e-1, 1e-3))
def test_has_the_error_of_the_iterations(rtol, energies):
    problem = block("pair", 4, seed=0).problem(options={"rtol": rtol})
    problem.solve()
    bound = problem.mesh_error(bound=True)
    assert bound.guaranteed
    assert bound.total == bound.error
    square = energies("pair", "triangle") - bound.energy_norm**2
    assert bound.error * bound.energy_norm >= np.sqrt(square)


def changed(change) -> Scene:
    scene = block("ground", 2)
    change(scene)
    return scene


def add(scene: Scene, to: str, term) -> None:
    setattr(scene, to, getattr(scene, to) + term)


AGAINST = {
    "the degree is not 1": lambda: block("ground", 2, degree=2),
    "cells are no triangles or tetrahedra": lambda: block("ground", 2, cell="quadrilateral"),
    "the bilinear form has integrals over facets": lambda: changed(
        lambda s: add(s, "a", s.constant(1.0) * s.u[0] * s.v[0] * s.ds(TOP))
    ),
    "the bilinear form may vary inside cells": lambda: changed(
        lambda s: setattr(s, "a", varying(s))
    ),
    "the bilinear form is not that of strains alone": lambda: changed(
        lambda s: add(s, "a", s.constant(1.0) * ufl.inner(s.u, s.v) * ufl.dx)
    ),
    "the linear form has stresses": lambda: changed(
        lambda s: add(s, "L", s.constant(1e-5) * ufl.div(s.v) * ufl.dx)
    ),
    "forces on the volume vary inside cells": lambda: changed(
        lambda s: add(s, "L", 1e-4 * ufl.SpatialCoordinate(s.mesh)[0] * s.v[0] * ufl.dx)
    ),
    "loads are not linear on facets": lambda: changed(
        lambda s: add(s, "L", 1e-4 * ufl.SpatialCoordinate(s.mesh)[0] ** 2 * s.v[1] * s.ds(TOP))
    ),
    "'contact 0 (obstacle)' has friction": lambda: CASES["slider"](COMM, 2),
    "'roller' has an obstacle whose normal turns inside facets": lambda: roller(COMM, 4),
    "'contact 0 (obstacle)' has negative pressures between nodes": lambda: CASES["punch"](COMM, 8),
    "there are rigid bodies": lambda: on_a_rigid_body(),
    "'joint' has an initial gap": lambda: beams(COMM, 2, pair={"initial_gap": 1e-6}),
    "'joint' has facets that do not coincide": lambda: beams(COMM, 4, unlike=1.5),
}


def on_a_rigid_body() -> Scene:
    scene = block("ground", 2)
    scene.contacts = []
    ground = Plane((0.0, 0.0), (0.0, 1.0))
    body = RigidBody((0.0, 0.0), translation=(0.0, 0.0), rotation=0.0)
    scene.add_obstacle(BOTTOM, ground, rigid_body=body, name="ground")
    return scene


def varying(scene: Scene):
    factor = 1.0 + ufl.SpatialCoordinate(scene.mesh)[0]
    return ufl.Form([i.reconstruct(integrand=i.integrand() * factor) for i in scene.a.integrals()])


@pytest.mark.once
@pytest.mark.parametrize("reason", AGAINST)
def test_reasons_against_it_are_told(reason):
    problem = posed(AGAINST[reason]())
    problem.solve()
    estimate = problem.mesh_error(bound=True)
    assert not estimate.guaranteed
    assert reason in estimate.reasons
    assert estimate.error == problem.mesh_error().error
    assert f"no bound: {', '.join(estimate.reasons)}" in str(estimate)


def test_text_says_that_it_is_a_bound():
    estimate = solved(block("ground", 2)).mesh_error(bound=True)
    assert str(estimate).startswith("error of the mesh at most ")

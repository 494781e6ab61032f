"""What is drawn in addition to a mesh problem: friction, roles, degree 2, tilts, exact passes.

Each option has a random generator of its own: problems without it stay what they were.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mesh_problems import (
    Ground,
    MeshProblem,
    Rubbing,
    Support,
    draw_mesh,
    keep_held_roles,
    penetrations,
)
from numpy.random import Generator
from numpy.typing import NDArray
from oracle import Answer
from outcome import Found, Outcome, outcome_of, without_solution, worst
from torn_problems import SOFT

from fenics_tfeti import Deformed, Mortar
from fenics_tfeti.errors import NotConverged

Vector = NDArray[np.float64]


# of degree 2, unknowns of the largest problems
UNKNOWNS = 1500
# ratio of Young's moduli that the package has to call large, and one that it must not
STIFFER, ALIKE = 10.0, 2.0
# exact non-penetration: depth relative to the largest displacement
PENETRATION = 1e-3


def draw_mesh_case(seed: int) -> MeshProblem:
    """Draw the problem of a seed with its options."""
    problem = draw_mesh(seed)
    _add_friction(problem, np.random.default_rng([seed, 4]))
    _choose_pairing(problem, np.random.default_rng([seed, 5]))
    _raise_degree(problem, np.random.default_rng([seed, 6]))
    _tilt_facets(problem, np.random.default_rng([seed, 7]))
    if np.random.default_rng([seed, 8]).random() < 0.1 and problem.slider is None:
        problem.gaps = Deformed(PENETRATION)
        problem.grounds = [replace(g, tilt=0.0) for g in problem.grounds]
        problem.story.append("exact non-penetration, no tilts")
    keep_held_roles(problem)
    return problem


def compare_exact(
    problem: MeshProblem, coordinates: Vector, answer: Answer, found: Found
) -> Outcome:
    """Compare a solution with exact non-penetration with what may be said of it.

    Its first pass is the linearised problem. Later ones may find surfaces folded or bodies without
    hold, or not converge.
    """
    other = without_solution(answer, found)
    if other is not None:
        return other
    error, said = found.error, found.said
    if error is not None:
        limit = isinstance(error, NotConverged) and "max_passes" not in said
        return Outcome("no convergence" if limit else "no contraction", said)
    u = found.displacement
    assert u is not None
    if not np.isfinite(u).all():
        return Outcome("wrong", "displacements are not finite")
    deformed = coordinates + u.reshape(coordinates.shape)
    allowed = np.array([PENETRATION * np.abs(u).max() + 1e-12 * np.abs(deformed).max()])
    depths = penetrations(problem, deformed)
    return outcome_of({"penetration": worst(depths, allowed)})


def _tilt_facets(problem: MeshProblem, rng: Generator) -> None:
    """Tilt facets of obstacles, which then resist motions along them weakly."""
    if rng.random() < 0.1:
        _let_slide(problem, rng)
        return
    grounds = [
        replace(g, tilt=float(10.0 ** rng.uniform(-7, -3)))
        if rng.random() < 0.3 and g.kind != "sphere"
        else g
        for g in problem.grounds
    ]
    if any(g.tilt for g in grounds):
        problem.story.append(f"tilts of obstacles {[g.tilt for g in grounds]}")
        problem.grounds = grounds


def _let_slide(problem: MeshProblem, rng: Generator) -> None:
    """Press a box against an obstacle of tilted facets, and take from it what else holds it."""
    box = int(rng.integers(len(problem.lower)))
    stress = _stress(problem, box)
    strain = stress / problem.young[box]
    everywhere = dict.fromkeys(range(problem.gdim), 0.0)
    held = {s.box for s in problem.supports}
    for j in problem.joints:
        # what leant on the box is held instead
        other, side = (j.slave, j.side) if box == j.master else (j.master, -j.side)
        if box in (j.slave, j.master) and other not in held:
            problem.supports.append(Support(other, j.axis, side, everywhere))
            held.add(other)
    problem.joints = [j for j in problem.joints if box not in (j.slave, j.master)]
    problem.grounds = [g for g in problem.grounds if g.box != box]
    problem.supports = [s for s in problem.supports if s.box != box]
    problem.springs = [s for s in problem.springs if s.box != box]
    problem.tractions = [t for t in problem.tractions if t[0] != box]
    problem.friction, problem.pairing = {}, {}
    axis, side = int(rng.integers(problem.gdim)), int(rng.choice([-1, 1]))
    gap = strain * float(problem.edges.max()) * float(rng.choice([0.0, rng.random()]))
    kind, tilt = str(rng.choice(["plane", "rough"])), float(10.0 ** rng.uniform(-7, -3))
    nowhere = np.zeros(problem.gdim)
    problem.grounds.append(Ground(box, axis, side, kind, gap, np.inf, nowhere, tilt))
    problem.weights[box] = 0.0
    problem.weights[box, axis] = side * stress / problem.edges.max()
    problem.story.append(f"instead box {box} slides: {problem.grounds[-1]}, no friction")
    problem.slider = box


def check_weak_motions(problem: MeshProblem, active: int, motions: list[str]) -> None:
    """Check that motions along tilted facets are named, if the last contact is that of a slider.

    It presses at `active` nodes. Rows that are not tilted resist three motions, or two in the
    plane.
    """
    if problem.slider is None or problem.grounds[-1].tilt < 1e-6:
        return
    if active > (2 if problem.gdim == 2 else 3):
        name = f"(cell tag {problem.slider + 1})"
        assert any(name in motion for motion in motions), f"a weak motion of {name} is not named"


def _choose_pairing(problem: MeshProblem, rng: Generator) -> None:
    """Choose mortar conditions, the same as those of nodes on meshes that match, and roles."""
    for number in range(len(problem.joints)):
        kind, roles = str(rng.choice(["auto", "mortar"])), str(rng.choice(["auto", "given"]))
        if rng.random() < 0.4:
            problem.pairing[number] = {
                "partners": None if kind == "auto" else Mortar(),
                "roles": roles,
            }
    problem.story.append(f"pairing {problem.pairing}")


def _raise_degree(problem: MeshProblem, rng: Generator) -> None:
    """Take displacements of degree 2, whose conditions are on means."""
    gdim = problem.gdim
    unknowns = len(problem.lower) * gdim * (2 * problem.divisions + 1) ** gdim
    patches = any(g.kind == "patch" for g in problem.grounds)
    if rng.random() < 0.2 and unknowns <= UNKNOWNS and not patches:
        problem.degree = 2
        problem.story.append("displacements of degree 2")


def check_roles(problem: MeshProblem, exchanged: list[bool]) -> None:
    """Check that slave and master are exchanged where that is wanted and better."""
    for number, j in enumerate(problem.joints):
        given = problem.pairing.get(number, {})
        mortar = given.get("partners") == Mortar() or problem.degree > 1
        rubbing = problem.friction.get(number)
        may = mortar and given.get("roles") != "given" and (rubbing is None or rubbing.part == 1.0)
        assert may or not exchanged[number], "exchanged without need"
        ratio = problem.young[j.slave] / problem.young[j.master]
        if problem.springs or problem.jump != 1.0 or not may:
            continue
        assert exchanged[number] or ratio < STIFFER, "not exchanged"
        assert not exchanged[number] or ratio > ALIKE, "exchanged"


def _add_friction(problem: MeshProblem, rng: Generator) -> None:
    """Add friction to some contacts, and push boxes as it holds them."""
    contacts = problem.faces()
    soft = any(
        s.stiffness < SOFT * problem.young[s.box] / problem.edges.max() for s in problem.springs
    )
    if rng.random() > 0.35 or not contacts or soft:
        return
    infinite = {
        number
        for number, g in enumerate(problem.grounds, start=len(problem.joints))
        if g.kind == "patch" and g.far == np.inf
    }
    for number, (box, _, _) in enumerate(contacts):
        stress = _stress(problem, box)
        law = str(rng.choice(["Tresca", "Coulomb"]))
        value = stress * 10.0 ** rng.uniform(-3, 1)
        value *= float(rng.choice([0.0, 1.0], p=[0.05, 0.95]))
        if law == "Coulomb":
            value = float(rng.choice([0.0, 0.05, 0.1, 0.3, 0.5, 0.8]))
        part = float(rng.choice([1.0, 0.55], p=[0.7, 0.3]))
        moved = np.zeros(problem.gdim)
        if number >= len(problem.joints):
            moved += problem.grounds[number - len(problem.joints)].moved
            if rng.random() < 0.3:
                size = stress / problem.young[box] * problem.edges.max()
                moved += size * rng.normal(size=problem.gdim)
        if rng.random() < 0.8 and number not in infinite:
            problem.friction[number] = Rubbing(law, value, part, moved)
    _push(problem, rng)
    problem.story.append(f"friction {problem.friction}")


def _stress(problem: MeshProblem, box: int) -> float:
    """Return the size of stresses in a box."""
    loads = [np.abs(value).max() / problem.young[b] for b, _, _, value in problem.tractions]
    weights = np.abs(problem.weights).max(axis=1, initial=0.0) * problem.edges.max() / problem.young
    strain = max([*loads, *weights.tolist()])
    return float(problem.young[box] * (strain or 1e-6))


def _push(problem: MeshProblem, rng: Generator) -> None:
    """Push boxes that nothing holds along their contacts, less or more than friction resists."""
    held = {s.box for s in problem.supports if len(s.values) == problem.gdim}
    for number, rubbing in problem.friction.items():
        box, axis, _ = problem.faces()[number]
        if box in held or rng.random() < 0.3:
            continue
        way = rng.normal(size=problem.gdim)
        way[axis] = 0.0
        way /= np.linalg.norm(way)
        if rubbing.law == "Tresca":
            force = rubbing.value / problem.edges[axis]
        else:
            force = rubbing.value * abs(problem.weights[box, axis])
        problem.weights[box] += rng.uniform(0.0, 1.1) * rubbing.part * force * way

"""Public problems of finite-strain contact, to their ends with default options.

    python benchmarks/run.py finite_strain_suite [--cases "spheres, friction 0.5" twist] [--chosen]

A die with a round foot is pressed into a slab and drawn along it (shallow ironing of Fischer and
Wriggers 2006); two concentric hollow half spheres are crushed between planes (compressed spheres of
Puso and Laursen 2004); a half ball is pressed on a block and turned by 180 degrees. A row for each
mark has the forces and their distance from the band of published ones, which were read off figures.
The last row of a case has how far it got, load steps and those that failed, Newton steps of all of
them, products with F of a Newton step, and processor seconds. Load steps have a constant length,
halved where they fail, or with `--chosen` that which `problem.steps` chooses; forces at marks are
then between those of two load steps.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from mpi4py import MPI

import numpy as np
import scenes
from scenes import at

import ufl
from dolfinx import fem

from fenics_tfeti import Coulomb, NonlinearContactProblem, NotConverged, Plane
from fenics_tfeti.io import Box
from fenics_tfeti.models import neo_hookean
from fenics_tfeti.newton.iteration import NewtonStep

DEGREE = {"quadrature_degree": 3}


class CountedProblem(NonlinearContactProblem):
    """A problem that keeps the Newton steps of all its solves, also of those that fail."""

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self.solves: list[list[NewtonStep]] = []

    def solve(self, **_: Any) -> Any:
        """Solve, and keep the steps."""
        steps: list[NewtonStep] = []
        self.solves.append(steps)

        def keep(event: Any) -> None:
            if isinstance(event, NewtonStep):
                steps.append(event)

        return super().solve(monitor=keep)


@dataclass(frozen=True)
class Case:
    """A problem, its load steps and marks, and published forces.

    The load has a length of `step` in constant steps up to `end`; of chosen steps it is the first.
    A table has for each mark the forces by name, each of them as several codes have it.
    """

    problem: CountedProblem
    set_load: Callable[[float], None]
    forces: Callable[[], dict[str, float]]
    end: float
    step: float
    published: dict[float, dict[str, Sequence[float]]] = field(default_factory=dict)
    # downwards, of the same mesh in small steps
    own: dict[float, float] = field(default_factory=dict)


# vertical force, then horizontal force, of five codes
IRONING = {
    0.5: ((85.8, 92.3, 94.8, 96.0, 81.5), (15.8, 17.2, 17.5, 18.7, 15.5)),
    1.0: ((298.8, 290.8, 320.4, 333.3, 269.0), (65.9, 63.2, 70.1, 75.0, 58.9)),
    1.1: ((363.1, 352.0, 394.5, 404.3, 324.2), (173.7, 168.0, 147.7, 138.1, 99.4)),
    1.25: ((368.1, 365.4, 407.8, 418.8, 334.9), (186.1, 172.4, 155.9, 141.5, 100.2)),
    1.5: ((365.0, 359.9, 408.6, 421.0, 337.5), (194.2, 172.8, 158.9, 145.1, 102.1)),
    1.75: ((358.5, 351.4, 401.3, 415.4, 335.2), (183.0, 162.4, 155.3, 140.6, 100.5)),
    1.9: ((342.3, 334.1, 379.5, 394.1, 321.9), (134.5, 136.6, 132.0, 119.7, 89.8)),
    1.99: ((312.9, 305.4, 344.1, 355.9, 292.4), (85.2, 101.4, 100.8, 86.5, 66.5)),
}
# force on a quarter, without friction and with a coefficient of 0.5
SPHERES = {
    2.0: ((0.799, 0.776, 0.667, 0.662), (0.819, 0.830, 0.699)),
    4.0: ((1.819, 1.804, 1.641, 1.816), (1.918, 1.946, 1.702)),
    5.0: ((2.402, 2.441, 2.241, 2.322), (2.576, 2.586, 2.343)),
    6.0: ((2.506, 2.722, 2.792, 2.794), (3.125, 3.201, 3.002)),
    7.0: ((3.199, 3.303, 3.386, 3.083), (3.392, 3.405, 3.516)),
    8.0: ((3.746, 4.040, 4.245, 4.085), (4.207, 4.342, 4.443)),
    9.0: ((4.845, 4.762), (5.475, 5.345)),
    9.5: ((5.545, 5.929), (6.256, 6.807)),
    9.8: ((6.201, 7.248), (7.076, 8.490)),
}
# of this mesh, without friction
OWN_SPHERES = {
    2.0: 0.732,
    4.0: 1.755,
    5.0: 2.312,
    5.5: 2.316,
    6.0: 2.308,
    6.5: 2.544,
    7.0: 3.045,
    8.0: 3.908,
    9.0: 4.321,
    9.5: 4.609,
    10.0: 10.532,
}


def _plain_problem(
    bodies: scenes.Scene, u: fem.Function, nu: float, options: dict[str, Any]
) -> CountedProblem:
    """Return the problem of neo-Hookean bodies in the plane or in space."""
    W = neo_hookean(bodies.young, nu)(u)
    F = ufl.derivative(W * ufl.dx(metadata=DEGREE), u, bodies.v)
    return CountedProblem(F, u, bcs=bodies.bcs, contacts=bodies.contacts, options=options)


def ironing(**options: Any) -> Case:
    """Pose the ironing, mm-N-MPa: the die goes down by 1 up to t = 1, and along by 10 up to 2."""
    base, top, foot, head = 1, 2, 3, 4
    parts = [Box((0, 0), (12, 4), (120, 30)), Box((20, 0), (21.2, 1.2), (12, 6))]

    def on_foot(x: Any) -> Any:
        return np.isclose(x[1], 0) | np.isclose(x[0], 20) | np.isclose(x[0], 21.2)

    def bent(x: Any) -> Any:
        s, h = (x[0] - 20) / 1.2, x[1] / 1.2
        angle = np.arcsin(0.8) * (2 * s - 1)
        low = np.stack([0.8 + 0.75 * np.sin(angle), 4.95 - 0.75 * np.cos(angle)])
        high = np.stack([0.2 + 1.2 * s, np.full(s.size, 5.4)])
        return np.where(x[0] > 15, low + h * (high - low), x)

    marks = [(base, at(1, 0), 1), (top, at(1, 4), 1), (foot, on_foot, 2), (head, at(1, 1.2), 2)]
    bodies = scenes.Scene.of_boxes(
        MPI.COMM_WORLD, "quadrilateral", parts, marks, bent, young={1: 689.6, 2: 6896.0}
    )
    u, motion = fem.Function(bodies.V), fem.Function(bodies.V)
    bodies.fix(base)
    bodies.fix(head, None, motion)
    bodies.add_pair(foot, top, friction=Coulomb(0.3))
    problem = _plain_problem(bodies, u, 0.32, options)

    def set_load(way: float) -> None:
        """Move the head by a way: 1 down, and then along."""
        motion.x.array.reshape(-1, 2)[:] = max(way - 1.0, 0.0), -min(way, 1.0)

    def forces() -> dict[str, float]:
        along, up = problem.report.reactions[1].force[:2]
        return {"down": -float(up), "along": float(along)}

    table = {way_of(t): {"down": v, "along": h} for t, (v, h) in IRONING.items()}
    return Case(problem, set_load, forces, 11.0, 0.1, table)


def way_of(t: float) -> float:
    """Return the way of the die [mm] up to a published time."""
    return round(min(t, 1.0) + 10.0 * max(t - 1.0, 0.0), 9)


def spheres(friction: float, **options: Any) -> Case:
    """Pose the half spheres, mm-N-MPa, in a meridional plane: the upper plane goes down by 10."""
    inner, low, high, outer, floor, axis = 1, 2, 3, 4, 5, 6
    parts = [Box((0, 10), (1, 12), (27, 4)), Box((2, 12), (3, 14), (33, 4))]
    marks = [
        (inner, at(1, 10), 1),
        (low, at(1, 12), 1),
        (high, at(1, 12), 2),
        (outer, at(1, 14), 2),
        (floor, lambda x: np.isclose(x[0], 1) | np.isclose(x[0], 3)),
        (axis, lambda x: np.isclose(x[0], 0) | np.isclose(x[0], 2)),
    ]

    def bent(x: Any) -> Any:
        angle = np.where(np.isclose(x[0] % 2, 1), 1, x[0] % 2) * np.pi / 2
        places = x[1] * np.stack([np.sin(angle), np.cos(angle)])
        return np.where(np.abs(places) < 1e-12, 0.0, places)

    bodies = scenes.Scene.of_boxes(MPI.COMM_WORLD, "quadrilateral", parts, marks, bent)
    u, r, down = fem.Function(bodies.V), ufl.SpatialCoordinate(bodies.mesh)[0], {"way": 0.0}
    H, weight = ufl.grad(u), ufl.pi / 2 * r
    F = ufl.as_tensor([[1 + H[0, 0], H[0, 1], 0], [H[1, 0], 1 + H[1, 1], 0], [0, 0, 1 + u[0] / r]])
    J, mu, lmbda = ufl.det(F), 1 / 2.6, 0.3 / (1.3 * 0.4)
    energy = mu / 2 * (ufl.inner(F, F) - 3) - mu * ufl.ln(J) + lmbda / 2 * ufl.ln(J) ** 2
    bodies.fix(axis, 0)
    bodies.fix(floor, 1)
    bodies.add_obstacle(outer, lambda x: Plane((0, 14 - down["way"]), (0, -1))(x), name="plate")
    bodies.add_obstacle(inner, Plane((0, 0), (0, 1)), name="floor")
    law = Coulomb(friction) if friction else None
    bodies.add_pair(low, high, friction=law, name="between")
    problem = CountedProblem(
        ufl.derivative(energy * weight * ufl.dx(metadata=DEGREE), u, bodies.v),
        u,
        bcs=bodies.bcs,
        contacts=bodies.contacts,
        measure_weight=weight,
        options=options,
    )
    table = {d: {"down": codes[friction > 0]} for d, codes in SPHERES.items()}
    return Case(
        problem,
        lambda d: down.update(way=d),
        lambda: {"down": abs(float(problem.results["plate"].force[1]))},
        10.0,
        0.25,
        table,
        {} if friction else OWN_SPHERES,
    )


def twist(**options: Any) -> Case:
    """Pose a half ball of radius 1 on a block: down by 0.3 up to a load of 1, then 180 degrees."""
    base, top, cap, grip = 1, 2, 3, 4
    parts = [
        Box((-1.5, -1.5, -1.5), (1.5, 1.5, 0), (12, 12, 6)),
        Box((9, -1, 0), (11, 1, 1), (8, 8, 4)),
    ]

    def bent(x: Any) -> Any:
        # the lower half of a cube to that of a ball that touches the block
        a, b, c = (x - np.array([[10], [0], [1]])).clip(-1, 1)
        ball = [
            p * np.sqrt(1 - q**2 / 2 - r**2 / 2 + q**2 * r**2 / 3)
            for p, q, r in ((a, b, c), (b, c, a), (c, a, b))
        ]
        return np.where(x[0] > 5, np.stack(ball) + [[0], [0], [1]], x)

    marks = [(base, at(2, -1.5), 1), (top, at(2, 0), 1), (cap, at(2, 0), 2), (grip, at(2, 1), 2)]
    bodies = scenes.Scene.of_boxes(
        MPI.COMM_WORLD, "hexahedron", parts, marks, bent, young={1: 1.0, 2: 5.0}
    )
    u, motion = fem.Function(bodies.V), fem.Function(bodies.V)
    bodies.fix(base)
    bodies.fix(grip, None, motion)
    bodies.add_pair(cap, top, friction=Coulomb(0.5))
    problem = _plain_problem(bodies, u, 0.3, options)

    def set_load(load: float) -> None:
        angle, down = np.pi * max(load - 1.0, 0.0), 0.3 * min(load, 1.0)
        cos, sin = np.cos(angle), np.sin(angle)
        motion.interpolate(
            lambda x: np.stack(
                [cos * x[0] - sin * x[1] - x[0], sin * x[0] + cos * x[1] - x[1], 0 * x[2] - down]
            )
        )

    def forces() -> dict[str, float]:
        reaction = problem.report.reactions[1]
        return {"down": -float(reaction.force[2]), "moment": float(reaction.moment[2])}

    marks_of = {float(load): {} for load in np.linspace(1.0, 2.0, 7)}
    return Case(problem, set_load, forces, 2.0, 1 / 18, marks_of)


CASES: dict[str, Callable[..., Case]] = {
    "ironing": ironing,
    "spheres": lambda **options: spheres(0.0, **options),
    "spheres, friction 0.5": lambda **options: spheres(0.5, **options),
    "twist": twist,
}


def run(cases=tuple(CASES), chosen=False):
    """Go to the end of each case, and yield what was found at the marks."""
    for name in cases:
        yield from run_case(name, CASES[name](), chosen)


def run_case(name, case, chosen):
    """Yield a row for each mark that is reached, and one for the case."""
    start, problem, history, failure = time.process_time(), case.problem, [(0.0, {})], ""
    marks = sorted({*case.published, *case.own})
    try:
        for load in loads_of(case, chosen):
            history.append((load, case.forces()))
            for mark in marks:
                if history[-2][0] < mark - 1e-9 <= load:
                    yield at_mark(name, case, mark, history[-2:])
    except NotConverged as error:
        failure = str(error)
    accepted = len(history) - 1
    steps = sum(problem.solves, [])
    row = {
        "case": name,
        "reached": float(history[-1][0]),
        "load steps": accepted,
        "failed": len(problem.solves) - accepted,
        "Newton": len(steps),
        "each": len(steps) / max(accepted, 1),
        "most": max(map(len, problem.solves)),
        "products": float(np.mean([step.products for step in steps])),
        "cpu": time.process_time() - start,
    }
    yield {**row, "stopped": failure} if failure else row


def loads_of(case, chosen):
    """Yield the loads of accepted steps, of one length or of that which is chosen."""
    steps = case.problem.steps
    if chosen:
        yield from steps(case.set_load, 0.0, case.end, first=case.step)
        return
    for ends in pairwise(np.linspace(0.0, case.end, round(case.end / case.step) + 1)):
        yield from steps(case.set_load, *(round(float(end), 9) for end in ends))


def at_mark(name, case, mark, history):
    """Return the forces at a mark, and their distances from the published band and own values.

    The history is the accepted loads before and behind the mark, between which forces are linear.
    """
    (before, old), (behind, new) = history
    part = min((mark - before) / (behind - before), 1.0)
    forces = {force: (1.0 - part) * old.get(force, 0.0) + part * new[force] for force in new}
    row = {"case": name, "load": mark}
    for force, value in forces.items():
        row[force] = value
        if codes := case.published.get(mark, {}).get(force):
            row[f"{force}, band"] = f"{min(codes):.4g} to {max(codes):.4g}"
            low, high = value / min(codes) - 1.0, value / max(codes) - 1.0
            row[f"{force}, outside"] = f"{min(low, 0.0) or max(high, 0.0):.1%}"
    if mark in case.own:
        row["down, own"] = f"{forces['down'] / case.own[mark] - 1.0:.2%}"
    return row

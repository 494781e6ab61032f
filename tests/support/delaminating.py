"""Double cantilever beams that delaminate, with an `ElasticBond` that a bilinear law weakens.

With the damage of a step the problem is homogeneous: it is solved with an opening of 1, and the
factor follows from the energy that the step dissipates. A step has passes "solve, update the
damage" with Anderson's acceleration of memory 1.
"""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, ElasticBond
from fenics_tfeti.fem.topology import nodes_in
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets

Vector = NDArray[np.float64]

# data of Alfano and Crisfield, IJNME 50 (2001) 1701-1736 (A), of XAS-913C (B), and of Tijs et al.,
# Composites A 162 (2022) 107101 (C); mm, N, MPa
LENGTH, NU23 = 100.0, 0.46
# change of tractions, relative to the strength, at which passes end; limit on passes
ACCURATE, MOST = 1e-3, 100


@dataclass(frozen=True)
class Case:
    """Moduli, height of an arm, width, length of the crack, energy and strength of the bond."""

    E1: float
    E2: float
    G12: float
    nu12: float
    h: float
    b: float
    a0: float
    energy: float
    strength: float

    def beam_theory(self) -> tuple[float, float]:
        """Return load and opening at which the crack grows, with Williams' correction."""
        root = np.sqrt(self.E1 * self.E2) / self.G12
        factor = 1.18 * root
        chi = np.sqrt(self.E1 / (11 * self.G12) * (3 - 2 * (factor / (1 + factor)) ** 2))
        inertia, arm = self.b * self.h**3 / 12, self.a0 + chi * self.h
        load = np.sqrt(self.energy * self.b * self.E1 * inertia) / arm
        return load, 2 * load * arm**3 / (3 * self.E1 * inertia)

    def elasticity(self) -> Vector:
        """Return the stiffness (3, 3) of plane strain."""
        S = np.diag([1 / self.E1, 1 / self.E2, 1 / self.E2])
        S[0, 1:] = S[1:, 0] = -self.nu12 / self.E1
        S[1, 2] = S[2, 1] = -NU23 / self.E2
        C = np.zeros((3, 3))
        C[:2, :2] = np.linalg.inv(S)[:2, :2]
        C[2, 2] = self.G12
        return C


CASES = {
    "A": Case(135300, 9000, 5200, 0.24, 1.5, 20, 30, 0.28, 57),
    "B": Case(126000, 7500, 4981, 0.263, 1.5, 30, 30, 0.281, 57),
    "C": Case(133150, 10950, 5190, 0.316, 2.1, 25, 48, 1.12, 87),
}


@dataclass(frozen=True)
class Bilinear:
    """Traction over opening: up to the strength, then down to zero at the failure."""

    stiffness: float
    strength: float
    energy: float

    @property
    def elastic(self) -> float:
        """Opening at the strength."""
        return self.strength / self.stiffness

    @property
    def failure(self) -> float:
        """Opening at which nothing is left."""
        return 2 * self.energy / self.strength

    def damage(self, largest: Vector) -> Vector:
        """Return the damage where the largest openings have been these."""
        softening = self.failure - self.elastic
        return np.clip(self.failure * (largest - self.elastic) / (largest * softening), 0.0, 1.0)

    def dissipated(self, largest: Vector) -> Vector:
        """Return the energy per area that the largest openings have taken."""
        softening = self.failure - self.elastic
        return self.energy * np.clip((largest - self.elastic) / softening, 0.0, 1.0)


class Beam:
    """The arms, opened by 1 at the end of the crack, per unit of width."""

    def __init__(self, case: Case, cell: float, cells: int, options: dict[str, object]) -> None:
        nx, h = round(LENGTH / cell), case.h
        arms = [
            Box((0, k * h), (LENGTH, (k + 1) * h), (nx, cells), name)
            for k, name in enumerate(["lower", "upper"])
        ]
        beams = boxes(MPI.COMM_WORLD, arms, "quadrilateral")

        def bonded(x: Vector) -> NDArray[np.bool_]:
            return np.isclose(x[1], h) & (x[0] > case.a0 - 1e-6)

        ends = lambda x: np.isclose(x[0], LENGTH)  # noqa: E731
        marks = [(1, bonded, 1), (2, bonded, 2), (3, ends, 1), (3, ends, 2)]
        tags = tag_facets(beams.mesh, marks, beams.cell_tags)
        V = displacement_space(beams.mesh)
        D = ufl.as_matrix(case.elasticity().tolist())

        def strain(u: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
            e = ufl.sym(ufl.grad(u))
            return ufl.as_vector([e[0, 0], e[1, 1], 2 * e[0, 1]])

        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        a = ufl.inner(D * strain(u), strain(v)) * ufl.dx
        clamp = fem.locate_dofs_topological(V, 1, np.sort(tags.find(3)))
        bcs = [fem.dirichletbc(np.zeros(2), clamp, V)]
        across = V.sub(1).collapse()[0]
        for level, value in ((1.5, 0.5), (0.5, -0.5)):
            moved = fem.Function(across)
            moved.x.array[:] = value
            tip = fem.locate_dofs_geometrical(
                (V.sub(1), across),
                lambda x, y=level * h: np.isclose(x[0], 0) & np.isclose(x[1], y),
            )
            bcs.append(fem.dirichletbc(moved, tip, V.sub(1)))
        functionspace = getattr(fem, "functionspace", fem.FunctionSpace)
        scalar = functionspace(beams.mesh, ("Lagrange", 1))
        self.stiffness = fem.Function(scalar)
        self.stiffness.x.array[:] = 1e9 * case.E1
        self.problem = ContactProblem(
            a,
            0,
            bcs=bcs,
            contacts=ContactPair(tags, 1, 2, law=ElasticBond(self.stiffness), name="bond"),
            cell_tags=beams.cell_tags,
            options={"units": "mm-N-MPa", **options},
        )
        self.problem.solve()
        self.tied = self.problem.report.products["total"]
        self.products = 0
        bond = self.problem.results["bond"]
        self.area, self.dofs = bond.area, nodes_in(scalar, V)[bond.dofs]

    def solve(self, stiffness: Vector) -> tuple[Vector, float]:
        """Return openings at the nodes of the bond and the load, for an opening of 1."""
        self.stiffness.x.array[self.dofs] = stiffness
        self.problem.solve()
        report = self.problem.report
        self.products += report.products["total"]
        load = abs(report.reactions[1].force[1])
        return np.maximum(self.problem.results["bond"].opening, 0.0), load


def step(
    beam: Beam, law: Bilinear, known: Vector, guess: Vector, energy: float, far: float
) -> tuple[Vector, float, float, int]:
    """Return the largest openings with an energy that is dissipated, load, opening and passes."""
    now, last = guess, None
    for passes in range(1, MOST + 1):
        stiffness = law.stiffness * (1.0 - law.damage(now))
        openings, load = beam.solve(np.where(now >= law.failure, 0.0, stiffness))

        def missing(factor: float, openings: Vector = openings) -> float:
            largest = np.maximum(known, factor * openings)
            return float(law.dissipated(largest) @ beam.area - energy)

        while missing(far) < 0.0:
            far *= 2.0
        factor = brentq(missing, 0.0, far, xtol=1e-14, rtol=1e-12)
        wanted = np.clip(np.maximum(known, factor * openings), law.elastic, law.failure)
        change = np.abs(law.damage(wanted) - law.damage(now))
        change *= law.stiffness * np.minimum(factor * openings, law.failure) / law.strength
        if change.max() <= ACCURATE:
            return wanted, factor * load, factor, passes
        residual = wanted - now
        following = wanted
        if last is not None and np.any(residual != last[1]):
            turn = residual - last[1]
            weight = (turn @ residual) / (turn @ turn)
            following = wanted - weight * (now - last[0] + turn)
        last = now, residual
        now = np.clip(following, known, law.failure)
    raise RuntimeError(f"{MOST} passes do not end: take a smaller step of energy")


def propagate(beam: Beam, law: Bilinear, case: Case, cell: float, growth: float) -> Vector:
    """Return opening, load, passes and products of each step until the crack has grown."""
    known = before = np.full(beam.area.size, law.elastic)
    energy, curve = 0.0, []
    while energy < growth * case.energy:
        energy += 2.0 * cell * case.energy
        products = beam.products
        guess = np.clip(2.0 * known - before, known, law.failure)
        wanted, load, opening, passes = step(beam, law, known, guess, energy, case.beam_theory()[1])
        before, known = known, wanted
        curve.append((opening, load * case.b, passes, beam.products - products))
    return np.array(curve)

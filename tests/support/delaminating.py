"""Double cantilever beams of laminate that delaminate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem

from fenics_tfeti import Adhesive, Cohesive, ContactPair, ContactProblem, DamageEntry
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets

Array = NDArray[np.float64]

# data of Alfano and Crisfield, IJNME 50 (2001) 1701-1736 (A), of XAS-913C (B), and of Tijs et al.,
# Composites A 162 (2022) 107101 (C); mm, N, MPa
LENGTH, NU23 = 100.0, 0.46


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
        inertia, arm = self.b * self.h**3 / 12, self.a0 + self.correction * self.h
        load = np.sqrt(self.energy * self.b * self.E1 * inertia) / arm
        return load, 2 * load * arm**3 / (3 * self.E1 * inertia)

    def load_in_modes(self, opening: float, shear: float, shear_energy: float) -> float:
        """Return the load of an arm at which the crack grows.

        Energies released are 12 a^2 of `opening` and 9 a^2 / 4 of `shear`, relative to P^2 / (b^2
        h^3 E), with a of each mode (Williams); they are blended by the exponent 2.
        """
        arms = self.a0 + np.array([1.0, 0.42]) * self.correction * self.h
        released = np.array([12.0 * opening, 2.25 * shear]) * arms**2
        share = released[1] / released.sum()
        energy = self.energy + (shear_energy - self.energy) * share**2
        return float(np.sqrt(energy * self.b**2 * self.h**3 * self.E1 / released.sum()))

    @property
    def correction(self) -> float:
        """Length that a crack is longer by in beam theory, relative to the height of an arm."""
        factor = 1.18 * np.sqrt(self.E1 * self.E2) / self.G12
        shear = 3 - 2 * (factor / (1 + factor)) ** 2
        return float(np.sqrt(self.E1 / (11 * self.G12) * shear))

    def elasticity(self) -> Array:
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


class Beam:
    """Two arms, bonded beyond the crack, that are opened at its end."""

    def __init__(
        self,
        case: Case,
        cell: float,
        cells: int,
        options: dict[str, object],
        law: Cohesive | Adhesive,
        tips: Sequence[float] = (-0.5, 0.5),
        begin: float | None = None,
    ) -> None:
        """Set up; `tips` of the lower and the upper arm are moved by parts of the opening.

        An arm with a part of 0 is left free. The surfaces that may touch begin where the crack
        ends, or elsewhere.
        """
        nx, h = round(LENGTH / cell), case.h
        begin = case.a0 if begin is None else begin
        arms = [
            Box((0, k * h), (LENGTH, (k + 1) * h), (nx, cells), name)
            for k, name in enumerate(["lower", "upper"])
        ]
        beams = boxes(MPI.COMM_WORLD, arms, "quadrilateral")

        def bonded(x: Array) -> NDArray[np.bool_]:
            return np.isclose(x[1], h) & (x[0] > begin - 1e-6)

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
        self.tips = [(part, fem.Function(across)) for part in tips if part]
        levels = [level for level, part in zip((0.5, 1.5), tips, strict=True) if part]
        for level, (_, moved) in zip(levels, self.tips, strict=True):
            tip = fem.locate_dofs_geometrical(
                (V.sub(1), across),
                lambda x, y=level * h: np.isclose(x[0], 0) & np.isclose(x[1], y),
            )
            bcs.append(fem.dirichletbc(moved, tip, V.sub(1)))
        self.problem = ContactProblem(
            a,
            0,
            bcs=bcs,
            contacts=ContactPair(tags, 1, 2, law=law, name="bond"),
            cell_tags=beams.cell_tags,
            options={"units": "mm-N-MPa", **options},
        )
        self.case, self.width = case, case.b

    def open_by(self, opening: float) -> float:
        """Solve with an opening at the end of the crack; return the load."""
        for part, moved in self.tips:
            moved.x.array[:] = part * opening
        self.problem.solve()
        return abs(self.problem.report.reactions[1].force[1]) * self.width

    def released(self) -> float:
        """Return the energy that the growth of the crack releases, by the ends' rotation [N/mm]."""
        u, h = self.problem.u, self.case.h
        x, values = u.function_space.tabulate_dof_coordinates(), u.x.array.reshape(-1, 2)
        load = abs(self.problem.report.reactions[1].force[1])
        rotation = 0.0
        # the surfaces of both arms have nodes at the same places, which go apart
        for middle, sign in ((0.5 * h, -1.0), (1.5 * h, 1.0)):
            at_end = np.isclose(x[:, 0], 0.0) & (np.abs(x[:, 1] - middle) < 0.51 * h)
            at_end &= sign * values[:, 1] > 0.0
            rotation += abs(np.polyfit(x[at_end, 1], values[at_end, 0], 1)[0])
        return load * rotation

    def open_in_steps(self, openings: Array) -> tuple[Array, list[DamageEntry]]:
        """Return openings and loads of all equilibria in load steps, and their reports."""
        curve, entries = [(0.0, 0.0)], []
        for now in openings:
            load = self.open_by(now)
            entry = self.problem.report.damage
            assert entry is not None
            self.problem.advance()
            curve += [
                (step.factor * now, abs(step.reactions[1][1]) * self.width) for step in entry.path
            ] or [(now, load)]
            entries.append(entry)
        return np.array(curve), entries

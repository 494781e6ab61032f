"""Torn systems whose contact rows have springs, and their solution by a conic solver."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import clarabel
import numpy as np
import scipy.sparse as sp
from sparse_rows import clamped, interpolated, random_rows, two_blocks
from torn import Glued, column

from fenics_tfeti.feti import TornSystem


def with_springs(system: TornSystem, pressed, pulled) -> TornSystem:
    """Return a system whose contact rows have the compliances where they press and pull."""
    size = system.contacts.size
    compliance = np.column_stack([np.broadcast_to(x, size) for x in (pressed, pulled)])
    contacts = dataclasses.replace(system.contacts, compliance=compliance)
    return dataclasses.replace(system, contacts=contacts)


def random_compliances(rng: np.random.Generator, size: int, decades=(-3.0, 3.0)) -> np.ndarray:
    """Return compliances (size, 2): contact, soft contact, cohesion, springs, kinks and ties."""
    a, b = 10.0 ** rng.uniform(*decades, (2, size))
    none, apart = np.zeros(size), np.full(size, np.inf)
    kinds = [(none, apart), (a, apart), (none, b), (a, a), (a, b), (none, none)]
    columns = np.array([np.column_stack(kind) for kind in kinds])
    return columns[rng.choice(len(kinds), size), np.arange(size)]


def random_system(seed: int) -> TornSystem:
    """Return two bodies, the upper one held sideways, with springs at all or some of their rows.

    Rows join nodes to nodes, interpolate, or are any; they are pressed or pulled, with gaps.
    """
    rng = np.random.default_rng(seed)
    load = rng.uniform(-1.0, 1.0, 3)
    kind = seed % 3
    if kind == 0:
        system = column(2, 1 + seed % 2, load=load)
    else:
        subdomains = two_blocks(2, 3, load=load)
        if kind == 1:
            rows = interpolated(subdomains, 2, [[0.0, 0.0, -1.0]], area=lambda x: 0.2 + x[:, 0])
        else:
            rows = random_rows(subdomains, rng, 8, terms=(2, 4), lengths=(-2.0, 2.0))
        prescribed = clamped(subdomains, (2, 0.0), (2, 2.0))
        system = TornSystem(subdomains, prescribed, rows, 3, ["lower", "upper"], ["joint"])
    rows = system.contacts
    gap = rows.length * rng.uniform(-0.05, 0.2, rows.size)
    gap[rng.random(rows.size) < 0.5] = 0.0
    compliance = random_compliances(rng, rows.size)
    rows = dataclasses.replace(rows, gap=gap, compliance=compliance)
    return dataclasses.replace(system, contacts=rows)


@dataclass
class WithSprings(Glued):
    """The glued problem and its solution by interior points, with the energies of springs.

    `force` are the nodal forces of rows, `closing` what they are closed by [m], beyond the gap.
    """

    force: np.ndarray = field(default_factory=lambda: np.zeros(0))
    closing: np.ndarray = field(default_factory=lambda: np.zeros(0))
    energy: float = 0.0

    @classmethod
    def solve(cls, system: TornSystem) -> WithSprings:
        """Solve a system on one rank, without ties and friction."""
        self = cls.of(system)
        rows = system.contacts
        length = rows.length
        pressed, pulled = np.asarray(rows.compliance).T
        K, u, free = self.K, self.u, self.free
        C, gap = self.C / length[:, None], rows.gap / length - (self.C / length[:, None]) @ u
        n, m = free.size, rows.size
        # u, then closings p and openings q with Cu - gap = p - q, each in units of sqrt(compliance)
        moving, at, unit, stiffness = [], [], [], []
        for c in (pressed, pulled):
            moving.append(np.flatnonzero(c > 0.0))
            at.append(n + sum(map(len, moving[:-1])) + np.arange(moving[-1].size))
            soft = np.isfinite(c[moving[-1]])
            unit.append(np.where(soft, np.sqrt(np.where(soft, c[moving[-1]], 1.0)), 1.0))
            stiffness.append(soft.astype(float))
        parts = n + sum(map(len, moving))
        P = sp.block_diag(
            [sp.csc_matrix(K[np.ix_(free, free)]), sp.diags(np.concatenate(stiffness))]
        )
        q = np.append(-(self.f - K @ u)[free], np.zeros(parts - n))
        split = np.zeros((m, parts))
        for sign, row, part, factor in zip((-1.0, 1.0), moving, at, unit, strict=True):
            split[row, part] = sign * factor
        split[:, :n] = C[:, free]
        A = sp.csc_matrix(np.vstack([split, -np.identity(parts)[n:]]))
        b = np.append(gap, np.zeros(parts - n))
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
        settings.reduced_tol_gap_abs = settings.reduced_tol_gap_rel = 1e-10
        settings.reduced_tol_feas = 1e-10
        cones = [clarabel.ZeroConeT(m), clarabel.NonnegativeConeT(parts - n)]
        found = clarabel.DefaultSolver(sp.triu(P, format="csc"), q, A, b, cones, settings).solve()
        assert str(found.status) in ("Solved", "AlmostSolved"), found.status
        x = np.array(found.x)
        u[free] = x[:n]
        self.force, self.closing = np.array(found.z)[:m], gap - C[:, free] @ x[:n]
        self.closing *= -1.0
        energies = 0.5 * np.concatenate(stiffness) @ x[n:] ** 2
        self.energy = float(0.5 * u @ K @ u - self.f @ u + energies)
        return self

    def energy_norm(self, displacements: list[np.ndarray]) -> float:
        """Return the energy norm of torn displacements that are glued."""
        u = np.zeros(self.f.size)
        for at, part in zip(self.places, displacements, strict=True):
            u[at] = part
        return float(np.sqrt(max(0.0, u @ self.K @ u)))

"""Torn systems whose contact rows have springs, and their solution by a conic solver."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import clarabel
import numpy as np
import scipy.sparse as sp
from friction_problems import random_tangents
from sparse_rows import clamped, interpolated, random_rows, two_blocks
from torn import Glued, column, matrix

from fenics_tfeti.feti import Friction, TornSystem


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


def with_friction(system: TornSystem, seed: int) -> TornSystem:
    """Return a system with friction at some of its rows, with and without elastic slip."""
    rng, size = np.random.default_rng(seed), system.contacts.size
    rows = np.flatnonzero(rng.random(size) < 0.7)
    first, second = random_tangents(system.contacts.normal[rows], rng).swapaxes(0, 1)
    friction = Friction(
        rows,
        np.stack([first, second], axis=1),
        10.0 ** rng.uniform(-3.0, 0.0, rows.size),
        rng.uniform(-0.05, 0.05, (rows.size, 2)) * (rng.random(rows.size) < 0.3)[:, None],
        compliance=10.0 ** rng.uniform(-2.0, 2.0, rows.size) * (rng.random(rows.size) < 0.7),
    )
    return dataclasses.replace(system, friction=friction)


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
    """The glued problem and its solution by interior points, with springs and bounds of friction.

    `force` are the nodal forces of rows, `tangential` (sites, gdim - 1) those of friction, `slip`
    their slips.
    """

    force: np.ndarray = field(default_factory=lambda: np.zeros(0))
    tangential: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    slip: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    energy: float = 0.0

    @classmethod
    def solve(cls, system: TornSystem) -> WithSprings:
        """Solve a system on one rank, without ties."""
        self = cls.of(system)
        contacts, friction, gdim = system.contacts, system.friction, system.gdim
        tangential = friction.tangential_rows(contacts)
        K, u, free, m, sites = self.K, self.u, self.free, contacts.size, friction.size
        C = self.C / contacts.length[:, None]
        T = matrix(tangential, self.nodes) / tangential.length[:, None]
        pressed, pulled = np.asarray(contacts.compliance).T
        elastic = np.repeat(np.asarray(friction.compliance), gdim - 1)
        # u; closings and openings of rows and elastic slips of sites, in units of sqrt(compliance);
        # the lengths of other slips
        columns = _Columns(free.size)
        at = [
            (np.flatnonzero(pressed > 0.0), pressed, -1.0),
            (np.flatnonzero(pulled > 0.0), pulled, 1.0),
            (np.flatnonzero(elastic > 0.0), elastic, 1.0),
        ]
        parts = [columns.add(compliance[here]) for here, compliance, _ in at]
        slack = columns.add(np.full(sites, np.inf))
        of_rows, of_slips = np.zeros((m, columns.size)), np.zeros((tangential.size, columns.size))
        of_rows[:, : free.size], of_slips[:, : free.size] = C[:, free], -T[:, free]
        for (here, _, sign), part, matrix_of in zip(
            at, parts, (of_rows, of_rows, of_slips), strict=True
        ):
            matrix_of[here, part] = sign * columns.unit[part]
        positive = np.zeros((parts[0].size + parts[1].size, columns.size))
        positive[np.arange(len(positive)), np.concatenate(parts[:2])] = -1.0
        cones = np.zeros((sites, gdim, columns.size))
        cones[np.arange(sites), 0, slack] = -1.0
        cones[:, 1:] = of_slips.reshape(sites, gdim - 1, columns.size)
        start = (T @ u - np.asarray(friction.slip).ravel()).reshape(sites, gdim - 1)
        right = np.column_stack([np.zeros(sites), start])
        A = sp.csc_matrix(np.vstack([of_rows, positive, cones.reshape(-1, columns.size)]))
        b = np.concatenate(
            [contacts.gap / contacts.length - C @ u, np.zeros(len(positive)), right.ravel()]
        )
        P = sp.block_diag(
            [sp.csc_matrix(K[np.ix_(free, free)]), sp.diags(columns.soft[free.size :])]
        )
        q = np.zeros(columns.size)
        q[: free.size], q[slack] = -(self.f - K @ u)[free], friction.bound
        # of surfaces that come apart, the work of adhesion
        q[parts[1]] += np.asarray(contacts.adhesion)[at[1][0]]
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
        settings.reduced_tol_gap_abs = settings.reduced_tol_gap_rel = 1e-10
        settings.reduced_tol_feas = 1e-10
        kinds = [clarabel.ZeroConeT(m), clarabel.NonnegativeConeT(len(positive))]
        kinds += [clarabel.SecondOrderConeT(gdim)] * sites
        found = clarabel.DefaultSolver(sp.triu(P, format="csc"), q, A, b, kinds, settings).solve()
        assert str(found.status) in ("Solved", "AlmostSolved"), found.status
        x, z = np.array(found.x), np.array(found.z)
        u[free] = x[: free.size]
        self.force = z[:m]
        self.tangential = -z[m + len(positive) :].reshape(sites, gdim)[:, 1:]
        self.slip = (T @ u - np.asarray(friction.slip).ravel()).reshape(sites, gdim - 1)
        springs = 0.5 * columns.soft[free.size :] @ x[free.size :] ** 2
        of_slips = friction.bound @ x[slack] + q[parts[1]] @ x[parts[1]]
        self.energy = float(0.5 * u @ K @ u - self.f @ u + springs + of_slips)
        return self

    def energy_norm(self, displacements: list[np.ndarray]) -> float:
        """Return the energy norm of torn displacements that are glued."""
        u = np.zeros(self.f.size)
        for at, part in zip(self.places, displacements, strict=True):
            u[at] = part
        return float(np.sqrt(max(0.0, u @ self.K @ u)))


@dataclass
class _Columns:
    """The columns of a programme: their units, and whether they have the energy x^2 / 2."""

    size: int
    unit: np.ndarray = field(init=False)
    soft: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.unit, self.soft = np.ones(self.size), np.zeros(self.size)

    def add(self, compliance: np.ndarray) -> np.ndarray:
        """Return the positions of columns with compliances; infinite ones have no energy."""
        soft = np.isfinite(compliance)
        self.unit = np.append(self.unit, np.sqrt(np.where(soft, compliance, 1.0)))
        self.soft = np.append(self.soft, soft)
        first, self.size = self.size, self.unit.size
        return np.arange(first, self.size)

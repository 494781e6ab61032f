"""Faces of the dual feasible set: which rows are equalities, and what is fixed on the others.

On a face some contact rows are closed and some sites of friction stick: their rows and the equality
rows are on it. The multipliers of the others vanish, but for the forces of sites that slip, which
have the size of their bound:

    l = fixed + E'E l.

E are unit rows and, where a site slips in three dimensions, the combination of its two rows across
the force: a force that keeps its size turns on the circle |l_T| = r, to first order along the
tangent, and the cost has the curvature |slip| / r. Contact rows with springs have the cost
C l^2 / 2; those that may pull are on every face, and the active ones of them press. A proximal term
|l - centre|^2 / (2 rho) of the rows with bounds may be added to the cost. With all of these the
second derivative of the cost is F + C.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.constraints.springs import Springs
from fenics_tfeti.qp import balls
from fenics_tfeti.typing import Mask, Vector


@dataclass(frozen=True)
class Proximal:
    """The proximal term |l - centre|^2 / (2 stiffness) on the rows with bounds."""

    centre: Vector  # (m,): feasible multipliers; zero on equality rows
    stiffness: float  # rho [N/m]

    def forces(self, gradient: Vector) -> Vector:
        """Return centre + rho v for the jumps v = -gradient; the bounds do not limit them yet."""
        return self.centre - self.stiffness * gradient


@dataclass(frozen=True)
class Face:
    """A face of the dual feasible set, and the terms of the cost beside 1/2 l'Fl - d'l on it."""

    constraints: Constraints
    rows: Mask  # (m,): rows of B on it
    active: Mask  # (i,): the contact rows that press; others with springs that pull are on it, too
    # (m,): friction forces of sites that slip, as multipliers; those of other sites do not matter
    forces: Vector
    # (k,): slip along the force / r, the second derivative of the cost for a force that turns
    curvature: Vector
    # (k, 2): unit vectors across the forces that turn, zero at other sites; None if none may turn
    tangents: Vector | None = None
    springs: Springs | None = None
    proximal: Proximal | None = None

    @staticmethod
    def of(
        constraints: Constraints,
        active: Mask,
        sticking: Mask | None = None,
        forces: Vector | None = None,
        curvature: Vector | None = None,
        springs: Springs | None = None,
    ) -> Face:
        """Return the face of contact rows (i,) that press and sites (k,) that stick.

        By default no site sticks, and sites that slip have no force. None of the forces turns.
        """
        friction, rows = constraints.friction, constraints.equality
        if sticking is not None:
            rows = rows | friction.on_rows(sticking, constraints.size)
        rows[constraints.inequality] = active if springs is None else active | springs.pulling
        forces = np.zeros(constraints.size) if forces is None else forces
        curvature = np.zeros(friction.size) if curvature is None else curvature
        return Face(constraints, rows, active, forces, curvature, springs=springs)

    @staticmethod
    def of_multipliers(
        constraints: Constraints,
        multipliers: Vector,
        radius: Vector,
        active: Mask | None = None,
        slips: Vector | None = None,
        springs: Springs | None = None,
    ) -> Face:
        """Return the face of feasible multipliers (m,), whose sites stick below their bounds (k,).

        Contact rows (i,) that are active press by default. Without `slips` (k, gdim - 1) the cost
        has no curvature.
        """
        forces = constraints.friction.at_sites(multipliers)
        sticking = balls.inside(forces, radius)
        curvature = np.zeros_like(radius)
        if slips is not None:
            curvature = np.where(sticking, 0.0, balls.curvature(forces, slips, radius))
        if active is None:
            active = multipliers[constraints.inequality] > 0.0
        return Face.of(constraints, active, sticking, multipliers, curvature, springs)

    @staticmethod
    def of_rows(constraints: Constraints, rows: Mask) -> Face:
        """Return the face of some rows (m,), with zero multipliers of the others."""
        none = np.zeros(constraints.friction.size)
        active = rows[constraints.inequality]
        return Face(constraints, rows, active, np.zeros(constraints.size), none)

    @staticmethod
    def supports(constraints: Constraints, springs: Springs | None = None) -> Face:
        """Return the face of the equality rows, and of springs that may pull."""
        return Face.of(
            constraints, np.zeros(constraints.inequality.size, dtype=bool), springs=springs
        )

    @staticmethod
    def whole(constraints: Constraints) -> Face:
        """Return all multipliers."""
        return Face.of_rows(constraints, np.ones(constraints.size, dtype=bool))

    @cached_property
    def sticking(self) -> Mask:
        """The sites (k,) that stick."""
        return self.constraints.friction.within(self.rows)

    @cached_property
    def directions(self) -> Vector:
        """The unit vectors (k, gdim - 1) along the forces of sites; zero without force."""
        return balls.directions(self.constraints.friction.at_sites(self.forces))

    @cached_property
    def fixed(self) -> Vector:
        """The multipliers (m,) off the face: forces of the sites that slip."""
        friction = self.constraints.friction
        forces = np.where(self.sticking[:, None], 0.0, friction.at_sites(self.forces))
        return friction.spread(forces, self.forces.size)

    @property
    def turning(self) -> Mask:
        """The sites (k,) whose force turns."""
        if self.tangents is None:
            return np.zeros(self.constraints.friction.size, dtype=bool)
        return self.tangents.any(axis=1)

    @property
    def touched(self) -> Mask:
        """The rows (m,) that a vector on the face may have entries in."""
        if self.tangents is None:
            return self.rows
        return self.rows | self.constraints.friction.on_rows(self.turning, self.rows.size)

    def with_rows(self, active: Mask, sticking: Mask) -> Face:
        """Return the face with other contact rows and sites."""
        rows = Face.of(self.constraints, active, sticking, springs=self.springs).rows
        return replace(self, rows=rows, active=active)

    def with_turning_forces(self, but: Mask | None = None) -> Face:
        """Return the face with the forces of sites that slip turning, but for some sites (k,).

        Its forces are the fixed ones. Where the sets are intervals, on all ranks, none turns.
        """
        friction, fixed = self.constraints.friction, self.fixed
        if not friction.curved:
            return replace(self, forces=fixed, tangents=None)
        keeping = self.sticking if but is None else self.sticking | but
        along = balls.directions(friction.at_sites(fixed))
        along *= friction.present.all(axis=1, keepdims=True)
        tangents = np.where(keeping[:, None], 0.0, balls.tangents(along))
        return replace(self, forces=fixed, tangents=tangents)

    def has_rows_of(self, other: Face) -> bool:
        """Tell whether another face has the same rows and combinations, on this rank."""
        pairs = (self.rows, other.rows), (self.tangents, other.tangents)
        return all(np.array_equal(x, y) for x, y in pairs)  # type: ignore[arg-type]

    def combinations(self) -> sp.csr_matrix | None:
        """Return the combinations (k, m) of the rows of sites whose force turns, if any."""
        if self.tangents is None:
            return None
        return self.constraints.friction.combined(self.tangents, self.rows.size)

    def part(self, x: Vector) -> Vector:
        """Return E'Ex, the part of a vector (m,) on the face."""
        chosen = np.where(self.rows, x, 0.0)
        if self.tangents is not None:
            friction = self.constraints.friction
            size = np.sum(friction.at_sites(x) * self.tangents, axis=1, keepdims=True)
            chosen[friction.flat] += (size * self.tangents)[friction.present]
        return chosen

    @property
    def proximal_compliance(self) -> float:
        """1 / rho, what the proximal term adds to C on all rows with bounds [m/N]."""
        return 0.0 if self.proximal is None else 1.0 / self.proximal.stiffness

    @property
    def has_terms(self) -> bool:
        """Whether there are terms beside 1/2 l'Fl - d'l."""
        return any(part is not None for part in (self.proximal, self.tangents, self.springs))

    @cached_property
    def spring_compliance(self) -> Vector | None:
        """The part of springs of the diagonal of C (m,) [m/N]; None without springs."""
        if self.springs is None:
            return None
        compliance = np.zeros(self.rows.size)
        compliance[self.constraints.inequality] = self.springs.at(self.active)
        friction, sticking = self.constraints.friction, self.springs.sticking
        if friction.size:
            elastic = np.where(self.sticking, sticking, 0.0)
            compliance += friction.spread(elastic, compliance.size)
        return compliance

    @property
    def compliance(self) -> Vector | None:
        """The diagonal of C (m,) without forces that turn [m/N]; None where it vanishes."""
        if self.proximal is None:
            return self.spring_compliance
        bounded = self.rows & ~self.constraints.equality
        compliance = np.where(bounded, self.proximal_compliance, 0.0)
        springs = self.spring_compliance
        return compliance if springs is None else compliance + springs

    @property
    def soft(self) -> Mask | None:
        """The rows (m,) of springs that are too soft to hold bodies; None without springs."""
        compliance = self.spring_compliance
        if self.springs is None or compliance is None:
            return None
        return self.rows & (compliance > self.springs.soft)

    def closed_by_springs(self, multipliers: Vector) -> Vector | float:
        """Return what forces (m,) close springs by."""
        springs = self.spring_compliance
        return 0.0 if springs is None else springs * multipliers

    def curved(self, x: Vector) -> Vector:
        """Return Cx, with the second derivative C of the terms beside 1/2 l'Fl."""
        product = np.zeros_like(x)
        if self.proximal is not None:
            bounded = self.rows & ~self.constraints.equality
            product = np.where(bounded, x, 0.0) / self.proximal.stiffness
        if self.springs is not None:
            product += self.closed_by_springs(x)
        if self.tangents is not None:
            friction = self.constraints.friction
            size = self.curvature * np.sum(friction.at_sites(x) * self.tangents, axis=1)
            product += friction.spread(size[:, None] * self.tangents, x.size)
        return product

    def gradient_of_terms(self, multipliers: Vector) -> Vector:
        """Return the gradient on the face of the terms beside 1/2 l'Fl - d'l."""
        if self.proximal is None:
            return self.curved(multipliers)
        pull = self.part(self.proximal.centre) / self.proximal.stiffness
        return self.curved(multipliers) - pull

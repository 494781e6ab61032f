"""Rows of a face that depend on each other and cannot be closed together.

At a node with more conditions than dimensions some combination y of the rows of a face vanishes,
B'y = o: of contact rows, of tangential rows that stick, and of tied rows. F does not see it, and
c'y is the cost of moving along it. Unless that is zero, the cost on the face falls without limit.
As in the simplex method the forces move along -y until the first one meets its bound: a contact row
whose force vanishes leaves the face, a site of friction whose force is as large as its bound slips.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fenics_tfeti.feti.constraints.coupling import Coupling
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.feti.tolerances import MANY, ZERO, rounding
from fenics_tfeti.qp import balls
from fenics_tfeti.typing import Numbers, Vector


def closable(problem: DualProblem, face: Face, multipliers: Vector) -> Face | None:
    """Return a face without the rows and sites that cannot be closed together with the others.

    Friction forces are those of the face; sites that slip from now on have theirs at the bound.
    Negative contact forces count as zero. None if all of its rows can be closed. Collective.
    """
    constraints, coupling = problem.constraints, problem.constraints.coupling
    if not coupling.groups:
        return None
    friction, size = constraints.friction, multipliers.size
    rigid, springs = face.rows, face.spring_compliance
    if springs is not None:
        # the cost has a minimum along a combination with springs
        rigid = rigid & (springs == 0.0)
    forces = np.maximum(multipliers, 0.0)
    forces[friction.flat] = face.forces[friction.flat]
    of_site = (
        friction.numbers(constraints.layout),
        np.linalg.norm(friction.at_sites(forces), axis=1),
        problem.radius,
    )
    on_tangents = [friction.spread(values, size) for values in of_site]
    on_face = rigid.astype(float)
    coupled = _CoupledRows(coupling, *coupling.gather(on_face, forces, problem.c, *on_tangents))
    before = coupled.on_face.copy()
    for cluster in coupling.clusters:
        coupled.remove_dependent(cluster)
    removed = before & ~coupled.on_face
    if not removed.any():
        return None
    here, position = coupling.rows, coupling.positions
    gone, moved = np.zeros(size, dtype=bool), face.forces.copy()
    gone[here] = removed[position]
    tangential = here[coupling.tangential[position]]
    moved[tangential] = coupled.force[position[coupling.tangential[position]]]
    left = face.with_rows(
        face.active & ~gone[constraints.inequality], face.sticking & ~friction.within(gone)
    )
    return replace(left, forces=np.where(gone, moved, face.forces))


class _CoupledRows:
    """The coupled rows of all ranks, in the order of W, and the forces on them.

    Arrays are (w,): `on_face` tells which rows are on the face, `force` is lambda.
    """

    def __init__(
        self,
        coupling: Coupling,
        on_face: Vector,
        force: Vector,
        gap: Vector,
        site: Vector,
        size: Vector,
        radius: Vector,
    ) -> None:
        self._coupling, self._gap, self._radius = coupling, gap, radius
        self.on_face, self.force = on_face > 0.0, force
        # rows without friction are sites of their own
        self._site = np.where(coupling.tangential, site, -1.0 - np.arange(site.size))
        # a force has a part in a row that is not coupled, or in another group
        self._size2 = size**2
        # of the rows of a group that are on the face
        self._vanishing: dict[bytes, tuple[Vector, Vector]] = {}

    def remove_dependent(self, cluster: Sequence[Numbers]) -> None:
        """Move forces of a cluster, and take rows off the face, until the others can be closed."""
        coupling = self._coupling
        while True:
            groups = [group[self.on_face[group]] for group in cluster]
            rows, y = np.concatenate(groups), -self._vanishing_part(groups)
            largest = np.abs(y).max(initial=0.0)
            if largest <= rounding(np.abs(self._gap[rows]).max(initial=0.0), MANY):
                return
            y[np.abs(y) <= ZERO * largest] = 0.0
            step = np.where(coupling.tangential[rows], self._to_bound(rows, y), np.inf)
            falling = ~(coupling.tied | coupling.tangential)[rows] & (y < 0.0)
            step[falling] = self.force[rows[falling]] / -y[falling]
            nearest = int(np.argmin(step))
            if not np.isfinite(step[nearest]):
                return
            self._move(rows, step[nearest] * y)
            self.on_face &= self._site != self._site[rows[nearest]]

    def _vanishing_part(self, groups: Sequence[Numbers]) -> Vector:
        """Return the part of the gaps of the rows (k,) of some groups that lies in B'y = o."""
        for rows in groups:
            if (key := rows.tobytes()) not in self._vanishing:
                self._vanishing[key] = self._coupling.vanishing(rows)
        null, on_bodies = zip(*(self._vanishing[rows.tobytes()] for rows in groups), strict=True)
        parts = [N.T @ self._gap[rows] for N, rows in zip(null, groups, strict=True)]
        z, M = np.concatenate(parts), np.hstack(on_bodies)
        z = z - np.linalg.lstsq(M, M @ z, rcond=ZERO)[0]
        parts = np.split(z, np.cumsum([part.size for part in parts])[:-1])
        return np.concatenate([N @ part for N, part in zip(null, parts, strict=True)])

    def _to_bound(self, rows: Numbers, y: Vector) -> Vector:
        """Return the step along y to the bound of the friction force of each row's site."""
        at = np.unique(self._site[rows], return_inverse=True)[1].ravel()
        yy, ly = (np.bincount(at, weights=x)[at] for x in (y**2, y * self.force[rows]))
        return balls.longest_steps(yy, -ly, self._radius[rows] ** 2 - self._size2[rows])

    def _move(self, rows: Numbers, change: Vector) -> None:
        """Add to the forces of some rows; contact forces stay nonnegative."""
        before = self.force[rows]
        self.force[rows] += change
        contact = rows[~(self._coupling.tied | self._coupling.tangential)[rows]]
        self.force[contact] = np.maximum(self.force[contact], 0.0)
        change2 = self.force[rows] ** 2 - before**2
        for site in np.unique(self._site[rows]):
            self._size2[self._site == site] += change2[self._site[rows] == site].sum()

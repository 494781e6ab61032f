"""Rigid bodies that contacts, loads, springs and prescribed motions move: a frame of few nodes.

The nodes of a body are the corners of a simplex. As a rigid motion is an affine function of the
place, a row at any place of the body is one at the corners, with barycentric coordinates as
weights. Displacements of the subdomain are those beside the prescribed motion, which goes to the
right-hand sides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from scipy.spatial.transform import Rotation

from fenics_tfeti.fem.contact.descriptions.rigid_body import RigidBody
from fenics_tfeti.fem.contact.descriptions.shapes import Obstacle
from fenics_tfeti.feti.system import ContactRows, Subdomain, are_same
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class BodyFrame:
    """A rigid body as nodes of a torn system, the corners of a simplex, and where it is."""

    body: RigidBody
    key: str  # from step to step and in files
    name: str
    corners: Vector  # (gdim + 1, gdim), undeformed [m]
    # without loads: the body, and its spring as an elastic body at the same nodes
    templates: list[Subdomain] = field(repr=False)
    # (modes, n): of displacements of the corners; its transpose makes forces there of a load
    to_motion: Vector = field(repr=False)
    motion: Vector  # (modes,): translation [m], and the sum of small rotations [rad]
    turned: Rotation  # what the rotations make together, in space, in 2D about z
    load_on_cells: Vector | None = None  # (modes,): of the form on the cells of the mesh's body

    @staticmethod
    def undeformed(
        body: RigidBody,
        key: str,
        name: str,
        box: Vector,
        first: int,
        number: int,
        known: BodyFrame | None,
    ) -> BodyFrame:
        """Make a frame around a box (2, gdim) with nodes from `first` on.

        `number` is the body's in the torn system. The matrices of a known frame with the same
        spring and the same free components are used again.
        """
        gdim = body.gdim
        size = float(np.ptp(box, axis=0).max()) or 1.0
        simplex = np.vstack([np.identity(gdim), np.zeros(gdim)]) - 1.0 / (gdim + 1)
        corners = box.mean(axis=0) + 2.0 * size * simplex
        modes = _modes(corners - body.point)
        nodes = first + np.arange(gdim + 1)
        load = np.zeros(corners.size)
        rigid = Subdomain.rigid(load, corners, nodes, number, modes[:, body.is_free])
        templates, C = [rigid], body.stiffness
        if C.any():
            templates.append(Subdomain(_spring(modes, C), load, corners, nodes, number))
        if known is not None and are_same(templates, known.templates):
            templates = known.templates
        start = np.zeros(body.modes), Rotation.identity()
        return BodyFrame(body, key, name, corners, templates, np.linalg.pinv(modes), *start)

    @property
    def nodes(self) -> Numbers:
        """The global numbers of the corners (gdim + 1,)."""
        return self.templates[0].nodes

    @property
    def load(self) -> Vector:
        """Force and moment now (modes,), of the body and on its cells."""
        own = self.body.load
        return own if self.load_on_cells is None else own + self.load_on_cells

    def subdomains(self, start: Vector) -> list[Subdomain]:
        """Return the body, and its spring if it has one, with the loads now, at a motion."""
        loads = [self.load, -self.body.stiffness @ self.with_prescribed(start)]
        return [
            replace(template, load=load @ self.to_motion)
            for template, load in zip(self.templates, loads, strict=False)
        ]

    def with_prescribed(self, motion: Vector) -> Vector:
        """Return a motion (modes,) with the prescribed components as they are now."""
        return np.where(self.body.is_free, motion, self.body.prescribed_motion)

    def motion_outside_unknowns(self, from_here: bool) -> Vector:
        """Return the motion (modes,) that is not among the unknowns, from where the body is."""
        return self.with_prescribed(from_here * self.motion) - self.motion

    def moved(self, motion: Vector) -> BodyFrame:
        """Return the body after a further rotation, up to a sum of motions."""
        step = motion - self.motion
        small = step[3:] if step.size == 6 else np.array([0.0, 0.0, step[2]])
        return replace(self, motion=motion, turned=Rotation.from_rotvec(small) * self.turned)

    @property
    def rotation(self) -> Vector:
        """Axis times angle (3,), in 2D the angle (1,) [rad]."""
        vector: Vector = self.turned.as_rotvec()
        return vector if self.motion.size == 6 else vector[2:]

    def turn(self, vectors: Vector, back: bool = False) -> Vector:
        """Return vectors (k, gdim) of the body as they are after its rotation, or before it."""
        padded = np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))
        return self.turned.apply(padded, inverse=back)[:, : vectors.shape[1]]

    def turned_places(self, x: Vector) -> Vector:
        """Return where points (k, gdim) of the undeformed body are, less its translation."""
        return self.body.point + self.turn(x - self.body.point)

    def undeformed_places(self, x: Vector) -> Vector:
        """Return where the points of the body that are at x (k, gdim) now have been."""
        point = self.body.point
        return self.turn(x - point - self.motion[: point.size], back=True) + point

    def obstacle(self, shape: Obstacle) -> Obstacle:
        """Return the obstacle with a shape of the undeformed body where it is."""
        gdim = self.body.gdim

        def moved(x: Vector) -> Any:
            before = np.array(x)
            before[:gdim] = self.undeformed_places(x[:gdim].T).T
            values = shape(before)
            if not (isinstance(values, tuple | list) and len(values) == 2):
                return values
            return values[0], self.turn(np.asarray(values[1], dtype=float)[:gdim].T).T

        return moved

    def displacements(self, motion: Vector, points: Vector) -> Vector:
        """Return the displacements (k, gdim) of points (k, gdim) in a small motion [m]."""
        return _displacements(motion, points - self.body.point)

    def work(self, forces: Vector) -> Vector:
        """Return the work (modes,) of forces (n, gdim) at the corners in unit motions."""
        work: Vector = forces.ravel() @ _modes(self.corners - self.body.point)
        return work

    def terms(
        self, row: Numbers, points: Vector, coefficients: Vector
    ) -> tuple[Numbers, Numbers, Vector]:
        """Return terms (t,) at points of the body as ones at its corners, one a row and corner."""
        simplex = np.vstack([self.corners.T, np.ones(len(self.corners))])
        weights = np.linalg.solve(simplex, np.vstack([points.T, np.ones(len(points))])).T
        rows, position = np.unique(row, return_inverse=True)
        sums = np.zeros((rows.size, *self.corners.shape))
        np.add.at(sums, position.ravel(), weights[:, :, None] * coefficients[:, None, :])
        corners, gdim = self.corners.shape
        return np.repeat(rows, corners), np.tile(self.nodes, rows.size), sums.reshape(-1, gdim)

    def joined(
        self, rows: ContactRows, row: Numbers, points: Vector, coefficients: Vector, moved: Vector
    ) -> ContactRows:
        """Return rows with terms (t,) at points of the body, which are moved (t, gdim) anyway."""
        gap = rows.gap.copy()
        np.subtract.at(gap, row, np.sum(coefficients * moved, axis=1))
        return replace(rows.with_terms(*self.terms(row, points, coefficients)), gap=gap)


@dataclass(frozen=True)
class RigidBodies:
    """All rigid bodies of a problem, and where they are; the same on all ranks."""

    comm: MPI.Intracomm
    gdim: int
    frames: Sequence[BodyFrame] = ()
    # whether unknowns are displacements from where bodies are, not from the undeformed state
    from_here: bool = False

    @property
    def names(self) -> list[str]:
        """The names of the bodies."""
        return [frame.name for frame in self.frames]

    @property
    def motions(self) -> list[Vector]:
        """The motion of each body."""
        return [frame.motion for frame in self.frames]

    @property
    def _own(self) -> Sequence[BodyFrame]:
        """The bodies of this rank."""
        return self.frames[self.comm.rank :: self.comm.size]

    def frame_of(self, body: RigidBody | None) -> BodyFrame:
        """Return the frame of a body, which is one of these."""
        return next(frame for frame in self.frames if frame.body is body)

    def moved(self, motions: Sequence[Vector]) -> RigidBodies:
        """Return the bodies after further rotations, up to sums of motions."""
        frames = [f.moved(motion) for f, motion in zip(self.frames, motions, strict=True)]
        return replace(self, frames=frames)

    def subdomains(self) -> list[Subdomain]:
        """Return the subdomains of this rank, with their loads now."""
        return [s for f in self._own for s in f.subdomains(self.from_here * f.motion)]

    def motions_after(self, displacements: Sequence[Vector]) -> list[Vector]:
        """Return motions after displacements that end with this rank's `subdomains`. Collective."""
        motions = np.zeros((len(self.frames), 3 if self.gdim == 2 else 6))
        position = len(displacements) - sum(len(frame.templates) for frame in self._own)
        for motion, frame in zip(motions[self.comm.rank :: self.comm.size], self._own, strict=True):
            motion[:] = frame.to_motion @ displacements[position]
            position += len(frame.templates)
        self.comm.Allreduce(MPI.IN_PLACE, motions)
        return [
            frame.with_prescribed(motion + self.from_here * frame.motion)
            for frame, motion in zip(self.frames, motions, strict=True)
        ]

    def loaded(self, loads: Vector) -> RigidBodies:
        """Return the bodies with loads (k, modes) on the cells of the first ones."""
        frames = list(self.frames)
        for k, load in enumerate(loads):
            frames[k] = replace(frames[k], load_on_cells=load)
        return replace(self, frames=frames)

    def saved(self) -> dict[str, Vector]:
        """Return the places (modes + 4,) by key, of motions and quaternions."""
        return {f.key: np.append(f.motion, f.turned.as_quat()) for f in self.frames}

    def restored(self, saved: Mapping[str, Vector]) -> RigidBodies:
        """Return the bodies at saved places; others are where they are."""
        frames = list(self.frames)
        for k, frame in enumerate(frames):
            if frame.key in saved:
                motion, turned = np.split(saved[frame.key], [-4])
                frames[k] = replace(frame, motion=motion, turned=Rotation.from_quat(turned))
        return replace(self, frames=frames)

    def free_displacements(self, first: int) -> Vector:
        """Return the displacements of the corners in the free components [m].

        They are rows (b, gdim) for the nodes with numbers from `first` on, zero for other nodes.
        """
        last = max((frame.nodes[-1] for frame in self.frames), default=first - 1)
        rows = np.zeros((int(last) - first + 1, self.gdim))
        for frame in self.frames:
            free = np.where(frame.body.is_free, frame.motion, 0.0)
            rows[frame.nodes - first] = frame.displacements(free, frame.corners)
        return rows

    def as_vector(self, motions: Sequence[Vector]) -> Vector:
        """Return the displacements of all corners as a vector; empty but on the first rank."""
        if self.comm.rank:
            return np.zeros(0)
        moved = [
            frame.displacements(motion, frame.corners).ravel()
            for frame, motion in zip(self.frames, motions, strict=True)
        ]
        return np.concatenate([np.zeros(0), *moved])

    def from_vector(self, part: Vector) -> list[Vector]:
        """Return the motions of a vector as of `as_vector`. Collective."""
        parts = np.split(self.comm.bcast(part), max(len(self.frames), 1))
        return [frame.to_motion @ x for frame, x in zip(self.frames, parts, strict=False)]

    def free_forces(self, forces: Vector, first: int) -> Vector:
        """Return what load, spring and forces leave of each body's equilibrium.

        The forces (b, gdim) are rows as of `free_displacements`. It is that of free components, as
        forces (n,) at the corners [N]. Prescribed components count as reached.
        """
        left = [np.zeros(0)]
        for frame in self.frames:
            body = frame.body
            load = frame.load - body.stiffness @ frame.with_prescribed(frame.motion)
            load += frame.work(forces[frame.nodes - first])
            left.append(np.where(body.is_free, load, 0.0) @ frame.to_motion)
        return np.concatenate(left)


def _displacements(motion: Vector, arms: Vector) -> Vector:
    """Return the displacements (k, gdim) of points at arms (k, gdim) from the reference point."""
    gdim = arms.shape[1]
    turned = (
        np.cross(motion[3:], arms)
        if gdim == 3
        else motion[2] * np.column_stack([-arms[:, 1], arms[:, 0]])
    )
    return motion[:gdim] + turned


def _modes(arms: Vector) -> Vector:
    """Return the displacements (n, modes) in unit motions, of points at arms (k, gdim)."""
    units = np.identity(3 if arms.shape[1] == 2 else 6)
    return np.column_stack([_displacements(unit, arms).ravel() for unit in units])


def _spring(modes: Vector, stiffness: Vector) -> sp.csr_matrix:
    """Return a stiffness (n, n) at the corners with a given one of motions (modes, modes).

    What is no rigid motion is resisted, too; as the corners are glued to the body, that strains
    nothing.
    """
    P = np.linalg.pinv(modes)
    K, Q = P.T @ stiffness @ P, np.linalg.qr(modes)[0]
    K += np.abs(K.diagonal()).max() * (np.identity(len(Q)) - Q @ Q.T)
    return sp.csr_matrix(0.5 * (K + K.T))

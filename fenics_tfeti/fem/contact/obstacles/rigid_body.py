"""Rigid bodies that contacts, loads, springs and prescribed motions move: a frame of few nodes.

The nodes of a body are the corners of a simplex. As a rigid motion is an affine function of the
place, a row at any place of the body is one at the corners, with barycentric coordinates as
weights. Displacements of the subdomain are those beside the prescribed motion, which goes to the
right-hand sides.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from typing import Any, TypeAlias

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.obstacles.shapes import Obstacle
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.fem.user_data import as_coordinates, is_number
from fenics_tfeti.feti.system import ContactRows, Subdomain
from fenics_tfeti.typing import Mask, Numbers, Vector

# a number for each component or one for all; or a dolfinx Constant, read by each solve
Components: TypeAlias = Any


@dataclass(frozen=True, eq=False)
class RigidBody:
    """A rigid body that forces move: the `body` of obstacles, or cells of the mesh.

    Its shape is that of the obstacles and cells, where nothing has moved it. The same object in
    several places is one body.

    Attributes
    ----------
    reference : (gdim,) array-like
        The point that translations, rotations, moments and springs refer to [m].
    force : (gdim,) array-like or dolfinx.fem.Constant
        Force on the body, at the reference point [N], beside that of forms on its cells.
    moment : (3,) array-like, in 2D a number, or dolfinx.fem.Constant
        Moment on the body [N m].
    translation, rotation : sequence, number, dolfinx.fem.Constant or None
        Prescribed components of the motion, None where it is free: ``translation=(0, 0, None)`` is
        a slide along z. A number is for all components. In 2D the rotation is a number. Angles are
        in [rad], and small where they are not corrected by ``geometry=Exact()``. By default the
        body is free.
    spring : array-like, optional
        Stiffness of a support: numbers for the components of the translation [N/m], or of
        translation and rotation [N m], or a symmetric matrix of all components.
    name : str
        For messages and results.

    Examples
    --------
    >>> punch = RigidBody((0.0, 0.0, 1.0), force=(0.0, 0.0, -1e3), rotation=0.0)
    >>> punch.is_free.tolist()
    [True, True, True, False, False, False]
    """

    reference: ArrayLike
    _: KW_ONLY
    force: Components = 0.0
    moment: Components = 0.0
    translation: Components = None
    rotation: Components = None
    spring: ArrayLike | None = None
    name: str = ""

    def __post_init__(self) -> None:
        """Check the data."""
        if not isinstance(self.name, str):
            raise InputError(f"RigidBody: name is {self.name!r}; a text is expected")
        as_coordinates(self.reference, f"{self._label}: the reference point")
        _ = self.load, self.prescribed_motion, self.stiffness

    @property
    def _label(self) -> str:
        return self.name or "RigidBody"

    @property
    def point(self) -> Vector:
        """The reference point (gdim,) [m]."""
        return np.asarray(self.reference, dtype=float)

    @property
    def gdim(self) -> int:
        """2 or 3."""
        return self.point.size

    @property
    def modes(self) -> int:
        """Number of components of a motion."""
        return 3 if self.gdim == 2 else 6

    @property
    def load(self) -> Vector:
        """Force and moment now (modes,)."""
        return np.append(
            self._components("force", self.gdim), self._components("moment", self.modes - self.gdim)
        )

    @property
    def is_free(self) -> Mask:
        """Which components of the motion are not prescribed (modes,)."""
        return np.isnan(self._motion)

    @property
    def prescribed_motion(self) -> Vector:
        """The prescribed components of the motion now, zero where it is free (modes,)."""
        return np.nan_to_num(self._motion, nan=0.0)

    @property
    def stiffness(self) -> Vector:
        """The stiffness of the spring (modes, modes)."""
        C = np.zeros((self.modes, self.modes))
        if self.spring is None:
            return C
        try:
            given = np.asarray(self.spring, dtype=float)
        except (TypeError, ValueError):
            given = np.full(1, np.nan)
        if given.shape in ((self.gdim,), (self.modes,)):
            C[np.arange(given.size), np.arange(given.size)] = given
        elif given.shape == C.shape:
            C = given
        else:
            raise InputError(
                f"{self._label}: the spring is {self.spring!r}; {self.gdim} numbers for the "
                f"translation, {self.modes} for translation and rotation, or a {self.modes} x "
                f"{self.modes} matrix are expected"
            )
        largest = np.abs(C).max()
        if not np.isfinite(C).all() or np.abs(C - C.T).max() > RELATIVE_ROUNDING * largest:
            raise InputError(f"{self._label}: the stiffness of the spring is not symmetric")
        size = np.sqrt(np.abs(C.diagonal()))
        size[size == 0.0] = 1.0
        if np.linalg.eigvalsh(C / np.outer(size, size))[0] < -RELATIVE_ROUNDING:
            raise InputError(
                f"{self._label}: the stiffness of the spring is negative in some direction"
            )
        return C

    @property
    def _motion(self) -> Vector:
        """The motion now (modes,), NaN where it is free."""
        parts = (("translation", self.gdim), ("rotation", self.modes - self.gdim))
        return np.concatenate([self._components(name, size, free=True) for name, size in parts])

    def _components(self, name: str, size: int, free: bool = False) -> Vector:
        """Return the components of an attribute now, NaN where it is free."""
        given = getattr(self, name)
        value = getattr(given, "value", given)
        entries = [value] * size if value is None or np.ndim(value) == 0 else list(value)
        fits = len(entries) == size and all(
            is_number(entry) or (free and entry is None) for entry in entries
        )
        if not fits:
            words = "numbers or None" if free else "finite numbers"
            raise InputError(
                f"{self._label}: {name} is {value!r}; {size} {words} are expected, or one for all"
            )
        return np.array([np.nan if entry is None else entry for entry in entries], dtype=float)


@dataclass(frozen=True)
class BodyPlace:
    """Where a body is: the sum of its motions, and what its rotations make together."""

    motion: Vector  # (modes,): translation [m], and the sum of small rotations [rad]
    turned: Rotation  # in space, in 2D about z

    @staticmethod
    def undeformed(body: RigidBody) -> BodyPlace:
        """Return the place where nothing has moved."""
        return BodyPlace(np.zeros(body.modes), Rotation.identity())

    def moved(self, motion: Vector) -> BodyPlace:
        """Return the place after a further rotation, up to a sum of motions."""
        step = motion - self.motion
        small = step[3:] if step.size == 6 else np.array([0.0, 0.0, step[2]])
        return BodyPlace(motion, Rotation.from_rotvec(small) * self.turned)

    @property
    def rotation(self) -> Vector:
        """Axis times angle (3,), in 2D the angle (1,) [rad]."""
        vector: Vector = self.turned.as_rotvec()
        return vector if self.motion.size == 6 else vector[2:]

    def turn(self, vectors: Vector) -> Vector:
        """Return vectors (k, gdim) of the body as they are after its rotation."""
        padded = np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))
        turned: Vector = self.turned.apply(padded)[:, : vectors.shape[1]]
        return turned

    def undeformed_places(self, body: RigidBody, x: Vector) -> Vector:
        """Return where the points of the body that are at x (k, gdim) now have been."""
        back = BodyPlace(self.motion, self.turned.inv())
        return back.turn(x - body.point - self.motion[: body.gdim]) + body.point

    def obstacle(self, body: RigidBody, shape: Obstacle) -> Obstacle:
        """Return the obstacle with a shape of the body that was moved here."""
        gdim = body.gdim

        def moved(x: Vector) -> Any:
            back = np.array(x)
            back[:gdim] = self.undeformed_places(body, x[:gdim].T).T
            values = shape(back)
            if not (isinstance(values, tuple | list) and len(values) == 2):
                return values
            return values[0], self.turn(np.asarray(values[1], dtype=float)[:gdim].T).T

        return moved


@dataclass(frozen=True)
class BodyFrame:
    """A rigid body as nodes of a torn system: the corners of a simplex."""

    body: RigidBody
    name: str
    corners: Vector  # (gdim + 1, gdim) [m]
    # without loads: the body, and its spring as an elastic body at the same nodes
    templates: list[Subdomain] = field(repr=False)
    load_on_cells: Vector | None = None  # (modes,): of the form on the cells of the mesh's body

    @staticmethod
    def build(
        body: RigidBody, name: str, box: Vector, first: int, number: int, known: BodyFrame | None
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
        frame = BodyFrame(body, name, corners, templates)
        if known is not None and frame._has_matrices_of(known):
            return replace(frame, templates=known.templates)
        return frame

    def _has_matrices_of(self, other: BodyFrame) -> bool:
        return len(self.templates) == len(other.templates) and all(
            np.array_equal(s.nodes, t.nodes)
            and np.array_equal(s.coordinates, t.coordinates)
            and s.body == t.body
            and s.has_kernel_of(t)
            and (s.stiffness != t.stiffness).nnz == 0
            for s, t in zip(self.templates, other.templates, strict=True)
        )

    @property
    def nodes(self) -> Numbers:
        """The global numbers of the corners (gdim + 1,)."""
        return self.templates[0].nodes

    @property
    def load(self) -> Vector:
        """Force and moment now (modes,), of the body and on its cells."""
        own = self.body.load
        return own if self.load_on_cells is None else own + self.load_on_cells

    @cached_property
    def _motion_of_corners(self) -> Vector:
        """The matrix (modes, n) of the motion that displacements of the corners are."""
        inverse: Vector = np.linalg.pinv(_modes(self.corners - self.body.point))
        return inverse

    def subdomains(self, start: Vector) -> list[Subdomain]:
        """Return the body, and its spring if it has one, with the loads now, at a motion."""
        loads = [self.load, -self.body.stiffness @ self.with_prescribed(start)]
        return [
            replace(template, load=self.nodal(load))
            for template, load in zip(self.templates, loads, strict=False)
        ]

    def with_prescribed(self, motion: Vector) -> Vector:
        """Return a motion (modes,) with the prescribed components as they are now."""
        return np.where(self.body.is_free, motion, self.body.prescribed_motion)

    def nodal(self, load: Vector) -> Vector:
        """Return forces (n,) at the corners with a resultant and a moment (modes,)."""
        forces: Vector = load @ self._motion_of_corners
        return forces

    def motion(self, displacement: Vector) -> Vector:
        """Return the motion (modes,) of displacements (n,) of the corners."""
        motion: Vector = self._motion_of_corners @ displacement
        return motion

    def corner_displacements(self, motion: Vector) -> Vector:
        """Return the displacements (gdim + 1, gdim) of the corners in a small motion [m]."""
        return self.displacements(motion, self.corners)

    def displacements(self, motion: Vector, points: Vector) -> Vector:
        """Return the displacements (k, gdim) of points (k, gdim) in a small motion [m]."""
        return _displacements(motion, points - self.body.point)

    def weights(self, points: Vector) -> Vector:
        """Return the barycentric coordinates (k, gdim + 1) of points (k, gdim)."""
        simplex = np.vstack([self.corners.T, np.ones(len(self.corners))])
        columns = np.vstack([points.T, np.ones(len(points))])
        weights: Vector = np.linalg.solve(simplex, columns).T
        return weights

    def joined(self, rows: ContactRows, points: Vector) -> ContactRows:
        """Return rows (k,) with the body at points (k, gdim) as the master."""
        k, corners = rows.size, len(self.corners)
        weights = self.weights(points)
        sums = rows.length[:, None] * rows.normal
        order = np.argsort(np.append(rows.row, np.repeat(np.arange(k), corners)), kind="stable")
        terms = (-weights[:, :, None] * sums[:, None, :]).reshape(-1, points.shape[1])
        moved = self.displacements(self.body.prescribed_motion, points)
        return replace(
            rows,
            offsets=rows.offsets + corners * np.arange(k + 1),
            nodes=np.append(rows.nodes, np.tile(self.nodes, k))[order],
            coefficients=np.concatenate([rows.coefficients, terms])[order],
            gap=rows.gap + np.sum(sums * moved, axis=1),
        )


@dataclass(frozen=True)
class RigidBodies:
    """All rigid bodies of a problem, and where they are; the same on all ranks."""

    comm: MPI.Intracomm
    gdim: int
    frames: Sequence[BodyFrame] = ()
    places: Sequence[BodyPlace] = ()

    @property
    def names(self) -> list[str]:
        """The names of the bodies."""
        return [frame.name for frame in self.frames]

    @property
    def motions(self) -> list[Vector]:
        """The motion of each body."""
        return [place.motion for place in self.places]

    @property
    def _mine(self) -> range:
        """The numbers of this rank's bodies."""
        return range(self.comm.rank, len(self.frames), self.comm.size)

    def number(self, body: RigidBody | None) -> int | None:
        """Return the number of a body; None for none."""
        return next((k for k, frame in enumerate(self.frames) if frame.body is body), None)

    def moved(self, motions: Sequence[Vector]) -> RigidBodies:
        """Return the bodies after further rotations, up to sums of motions."""
        places = [p.moved(motion) for p, motion in zip(self.places, motions, strict=True)]
        return replace(self, places=places)

    def subdomains(self, from_here: bool = False) -> list[Subdomain]:
        """Return the subdomains of this rank, with their loads now.

        Their displacements are from the undeformed state, or from the places of the bodies.
        """
        return [
            subdomain
            for k in self._mine
            for subdomain in self.frames[k].subdomains(from_here * self.places[k].motion)
        ]

    def motions_after(
        self, displacements: Sequence[Vector], from_here: bool = False
    ) -> list[Vector]:
        """Return the motions after displacements of this rank's `subdomains`. Collective.

        Displacements of other subdomains may be before these.
        """
        motions = np.zeros((len(self.frames), 3 if self.gdim == 2 else 6))
        position = len(displacements) - sum(len(self.frames[k].templates) for k in self._mine)
        for k in self._mine:
            motions[k] = self.frames[k].motion(displacements[position])
            position += len(self.frames[k].templates)
        self.comm.Allreduce(MPI.IN_PLACE, motions)
        return [
            frame.with_prescribed(motion + from_here * place.motion)
            for frame, place, motion in zip(self.frames, self.places, motions, strict=True)
        ]

    def ahead(self, k: int, from_here: bool) -> Vector:
        """Return the motion (modes,) of a body that is not among the unknowns, from its place."""
        frame, here = self.frames[k], self.places[k].motion
        start = from_here * here
        return frame.with_prescribed(start) - here

    def loaded(self, loads: Vector) -> RigidBodies:
        """Return the bodies with loads (k, modes) on the cells of the first ones."""
        frames = list(self.frames)
        for k, load in enumerate(loads):
            frames[k] = replace(frames[k], load_on_cells=load)
        return replace(self, frames=frames)

    def saved(self) -> Vector:
        """Return the places as an array (bodies, modes + 4), of motions and quaternions."""
        rows = [np.append(place.motion, place.turned.as_quat()) for place in self.places]
        return np.array(rows).reshape(len(rows), -1 if rows else 0)

    def restored(self, saved: Vector) -> RigidBodies:
        """Return the bodies at saved places, or where they are if there are not as many."""
        if len(saved) != len(self.places):
            return self
        places = [BodyPlace(row[:-4].copy(), Rotation.from_quat(row[-4:])) for row in saved]
        return replace(self, places=places)

    def free_displacements(self, first: int) -> Vector:
        """Return the displacements of the corners in the free components [m].

        They are rows (b, gdim) for the nodes with numbers from `first` on, zero for other nodes.
        """
        rows = np.zeros((self._last - first + 1 if self.frames else 0, self.gdim))
        for frame, place in zip(self.frames, self.places, strict=True):
            free = np.where(frame.body.is_free, place.motion, 0.0)
            rows[frame.nodes - first] = frame.corner_displacements(free)
        return rows

    @property
    def _last(self) -> int:
        """The largest number of a node."""
        return int(max(frame.nodes[-1] for frame in self.frames))

    def as_vector(self, motions: Sequence[Vector]) -> Vector:
        """Return the displacements of all corners as a vector; empty but on the first rank."""
        if self.comm.rank:
            return np.zeros(0)
        moved = [
            frame.corner_displacements(motion).ravel()
            for frame, motion in zip(self.frames, motions, strict=True)
        ]
        return np.concatenate([np.zeros(0), *moved])

    def from_vector(self, part: Vector) -> list[Vector]:
        """Return the motions of a vector as of `as_vector`. Collective."""
        whole: Vector = self.comm.bcast(part)
        return [
            frame.motion(x)
            for frame, x in zip(
                self.frames, np.split(whole, max(len(self.frames), 1)), strict=False
            )
        ]

    def free_forces(self, forces: Vector, first: int) -> Vector:
        """Return what load, spring and forces leave of each body's equilibrium.

        The forces (b, gdim) are rows as of `free_displacements`. It is that of free components, as
        forces (n,) at the corners [N]. Prescribed components count as reached.
        """
        left = [np.zeros(0)]
        for frame, place in zip(self.frames, self.places, strict=True):
            body, modes = frame.body, _modes(frame.corners - frame.body.point)
            load = frame.load - body.stiffness @ frame.with_prescribed(place.motion)
            load += forces[frame.nodes - first].ravel() @ modes
            left.append(frame.nodal(np.where(body.is_free, load, 0.0)))
        return np.concatenate(left)


@dataclass(frozen=True)
class RigidBodyResult:
    """The motion of a rigid body and the forces on it; equal on all ranks.

    Attributes
    ----------
    name : str
        Name of the body.
    translation : list of float
        Displacement of the reference point, (gdim,) [m].
    rotation : list of float
        Axis times angle (3,), in 2D the angle (1,) [rad].
    force, moment : list of float
        Sum of the contact forces on the body (gdim,) [N], and their moment about the reference
        point (3,) [N m], in 2D (1,).
    reaction, reaction_moment : list of float
        The same of what holds the body: of prescribed components of the motion and of the spring.
    """

    name: str
    translation: list[float]
    rotation: list[float]
    force: list[float]
    moment: list[float]
    reaction: list[float]
    reaction_moment: list[float]

    @staticmethod
    def of(frame: BodyFrame, place: BodyPlace, force: Vector, moment: Vector) -> RigidBodyResult:
        """Return the result for contact forces and their moment about the origin."""
        body, gdim = frame.body, frame.body.gdim
        r = body.point
        arm = np.cross(r, force) if gdim == 3 else np.array([r[0] * force[1] - r[1] * force[0]])
        contact = np.append(force, moment - arm)
        held = 0.0 - (frame.load + contact)
        return RigidBodyResult(
            frame.name,
            place.motion[:gdim].tolist(),
            place.rotation.tolist(),
            contact[:gdim].tolist(),
            contact[gdim:].tolist(),
            held[:gdim].tolist(),
            held[gdim:].tolist(),
        )


def _displacements(motion: Vector, arms: Vector) -> Vector:
    """Return the displacements (k, gdim) of points at arms (k, gdim) from the reference point."""
    gdim = arms.shape[1]
    turned = (
        np.cross(motion[3:], arms)
        if gdim == 3
        else motion[2] * np.column_stack([-arms[:, 1], arms[:, 0]])
    )
    moved: Vector = motion[:gdim] + turned
    return moved


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


def find_frames(
    bodies: Sequence[RigidBody],
    box_of: Callable[[RigidBody], Vector],
    first: tuple[int, int],
    known: Sequence[BodyFrame],
) -> list[BodyFrame]:
    """Return the frames of bodies; `first` are the first free numbers of a node and of a body.

    `box_of` returns the corners (2, gdim) of a box with the body's contacts, the same on all ranks.
    """
    frames = list[BodyFrame]()
    node, number = first
    for k, body in enumerate(bodies):
        name = body.name or f"rigid body {k}"
        known_frame = known[k] if k < len(known) else None
        start = node + k * (body.gdim + 1)
        frames.append(BodyFrame.build(body, name, box_of(body), start, number + k, known_frame))
    return frames

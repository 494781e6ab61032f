"""A block upon a longer one, and displacements that give them any shape and place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np
from matching import match_contacts
from numpy.typing import NDArray
from scenes import GROUND, MASTER, SLAVE, Scene, at, dimension

from dolfinx import fem

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.conditions.contact_conditions import ContactConditions
from fenics_tfeti.fem.contact.conditions.deformed import DeformedContact, deformed_contacts
from fenics_tfeti.fem.contact.descriptions.contacts import ContactPair, RigidObstacle
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary

CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")
LOWER, UPPER = 1, 2
Vector = NDArray[np.float64]
Motion = Callable[[Vector], Vector]


class Blocks(Scene):
    """Slave is the lower face of the upper block, master the upper face of the lower one.

    The lower block's is GROUND where it stands.
    """

    @property
    def body(self) -> NDArray[np.int64]:
        """The body of each node of this rank."""
        index_map = self.V.dofmap.index_map
        body = np.zeros(index_map.size_local + index_map.num_ghosts, dtype=np.int64)
        body[_compat.cell_dofs(self.V)[self.cell_tags.indices]] = self.cell_tags.values[:, None]
        return body

    @property
    def pair(self) -> ContactPair:
        return ContactPair(self.facet_tags, slave=SLAVE, master=MASTER)

    def obstacle(self, surface: Any) -> RigidObstacle:
        return RigidObstacle(self.facet_tags, slave=GROUND, obstacle=surface)

    def conditions(self, contact: Any) -> ContactConditions:
        return match_contacts(MeshBoundary.of(self.V), [contact])[0]

    def displacement(
        self, lower: Motion | None = None, upper: Motion | None = None
    ) -> fem.Function:
        """Move the blocks: each motion maps places (gdim, n) to where they go."""
        gdim = self.mesh.geometry.dim
        uh = fem.Function(self.V)
        u, of_node = uh.x.array.reshape(-1, gdim), self.body
        x = self.V.tabulate_dof_coordinates()[:, :gdim]
        for body, motion in ((LOWER, lower), (UPPER, upper)):
            if motion is not None:
                own = of_node == body
                u[own] = motion(x[own].T).T - x[own]
        # ghosts have to be brought up to date by who needs them
        u[self.V.dofmap.index_map.size_local :] = np.nan
        return uh

    def deformed(
        self, lower: Motion | None = None, upper: Motion | None = None, **arguments: Any
    ) -> tuple[ContactConditions, DeformedContact, Vector, Vector]:
        """Return the pair before and after, and the slave's and partners' displacements; serial."""
        pair, uh = replace(self.pair, **arguments), self.displacement(lower, upper)
        conditions = self.conditions(pair)
        result = deformed_contacts([(pair, conditions)], uh)[0]
        u = uh.x.array.reshape(-1, self.mesh.geometry.dim)
        return conditions, result, u[conditions.slave], u[result.conditions.master]


def blocks(
    cell: str, n: int = 3, gap: float = 0.1, length: int = 3, comm: MPI.Comm = MPI.COMM_SELF
) -> Blocks:
    """Return a unit block, `gap` above the middle of one of a length of 3, n cells a metre."""
    gdim, up = dimension(cell), dimension(cell) - 1
    low, high, shift = np.zeros(gdim), np.ones(gdim), np.zeros(gdim)
    shift[0], shift[up] = (length - 1) // 2, 1.0 + gap
    wide = high + (length - 1) * np.eye(gdim)[0]
    parts = [(low, wide, (length * n, *(n,) * up)), (low + shift, high + shift, (n,) * gdim)]
    marks = [(MASTER, at(up, 1.0), 1), (SLAVE, at(up, 1.0 + gap), 2), (GROUND, at(up, 0.0), 1)]
    return Blocks.of_boxes(comm, cell, parts, marks)


def turned(angle: float, gdim: int, shift: float = 0.0) -> tuple[Vector, Motion]:
    """Return a rotation (about a skew axis in 3D) and the motion by it and a shift."""
    if gdim == 2:
        c, s = np.cos(angle), np.sin(angle)
        Q = np.array([[c, -s], [s, c]])
    else:
        a = np.array([1.0, -2.0, 2.0]) / 3.0
        A = np.cross(np.eye(3), a)
        Q = np.eye(3) + np.sin(angle) * A + (1.0 - np.cos(angle)) * A @ A
    return Q, lambda x: Q @ x + shift


def lifted(height: Callable[..., Vector]) -> Motion:
    """Return the motion that adds a height, a function of the other coordinates, to the last."""

    def motion(x: Vector) -> Vector:
        y = x.copy()
        y[-1] += height(*x[:-1])
        return y

    return motion


def shifted(*by: float) -> Motion:
    return lambda x: x + np.array(by)[:, None]

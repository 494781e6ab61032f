"""Two strips, one above the other with a gap, which may be bent; and how their nodes are paired."""

from mpi4py import MPI

import numpy as np
from matching import match_contacts
from scenes import MASTER, SLAVE, Scene, at

from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary


def matched(space, contact, measure_weight=None):
    """Return the pairing of one contact."""
    return match_contacts(MeshBoundary.of(space, measure_weight), [contact])[0]


def strips(lower=(4, 2), upper=(4, 2), gap=0.1, comm=MPI.COMM_SELF):
    """Return space and facet tags of two squares, one above the other with a gap; 2D."""
    parts = [((0, 0), (1, 1), lower), ((0, 1 + gap), (1, 2 + gap), upper)]
    marks = [(MASTER, at(1, 1.0), 1), (SLAVE, at(1, 1 + gap), 2)]
    scene = Scene.of_boxes(comm, "triangle", parts, marks)
    return scene.V, scene.facet_tags


def bend(space, where, move):
    """Move the nodes of a mesh: x[where(x)] = move(x)."""
    x = space.mesh.geometry.x
    chosen = where(x)
    x[chosen] = move(x[chosen])


def ring(outer_radius=2.0, n=8):
    """Return two concentric quarter rings, the inner one's outside the slave, and their tags."""
    V, tags = strips((n, 2), (n, 2), gap=0.5)

    def polar(x):
        # the upper strip inside, so that its slave side faces outwards
        angle, height = 0.5 * np.pi * x[:, 0], x[:, 1]
        radius = np.where(height > 1.2, 2.5 - height, outer_radius + 1.0 - height)
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)

    bend(V, lambda x: np.ones(len(x), dtype=bool), polar)
    return V, tags


def partners(space, contact):
    """Match, and return slave and partner coordinates, by the slave's."""
    conditions = matched(space, contact)
    gdim = space.mesh.geometry.dim
    order = np.lexsort(np.round(conditions.coordinates, 12).T[::-1])
    points = space.tabulate_dof_coordinates()[:, :gdim]
    return conditions.coordinates[order, :gdim], points[conditions.master[order]], conditions

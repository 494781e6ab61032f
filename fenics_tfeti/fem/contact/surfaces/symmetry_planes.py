"""Normals at nodes in planes of symmetry.

At the border of a curved surface, facets on one side alone enter the mean of their normals. In a
plane of symmetry, where the displacement across the plane is prescribed, the mean of the whole
surface has no component across it.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from fenics_tfeti.fem.contact.surfaces.tagged import Surface
from fenics_tfeti.feti.system import Prescribed
from fenics_tfeti.typing import Mask, Vector

# How much larger a component of the normals is at neighbours, if it is that of a curved surface
# whose symmetry plane the node is in: 2 on a uniform mesh. On a plane, inclined or not, it is 1.
_GROWTH = 1.3

# Length of the rest of a unit normal, below which the prescribed components are no symmetry.
_SHORTEST = 0.5


def prescribed_components(surface: Surface, prescribed: Prescribed) -> Mask:
    """Tell which components (k, gdim) of a surface's nodes, on this rank, are prescribed."""
    mask = np.zeros_like(surface.normal, dtype=bool)
    if surface.nodes.size:
        rows = np.minimum(np.searchsorted(surface.nodes, prescribed.nodes), surface.nodes.size - 1)
        owned = surface.nodes[rows] == prescribed.nodes
        mask[rows[owned], prescribed.components[owned]] = True
    return mask


def still_holds(surface: Surface, prescribed: Prescribed, mask: Mask) -> bool:
    """Tell whether mortar conditions hold that were found with other supports. Collective.

    They do if they have no weight and the prescribed components are those of the mask.
    """
    if surface.boundary.weight is not None:
        return False
    same = np.array_equal(prescribed_components(surface, prescribed), mask)
    return bool(surface.comm.allreduce(same, MPI.LAND))


def normals_in_symmetry_planes(surface: Surface, prescribed: Mask) -> Vector:
    """Return a surface's unit normals without components that symmetry rules out. Collective.

    A prescribed component (k, gdim) is left out if it is larger at the neighbours where it is not
    prescribed, as on a curved surface; on planes it is the same there.
    """
    normal = np.abs(surface.at_corners(surface.normal))
    fixed = surface.at_corners(prescribed)
    values = np.where(fixed, 0.0, normal), (~fixed).astype(float)
    of_facets = np.concatenate(values, axis=2).sum(axis=1, keepdims=True)
    v = fixed.shape[1]
    total = surface.sum_of_corners(np.repeat(of_facets, v, axis=1))
    gdim = surface.normal.shape[1]
    neighbour_mean = total[:, :gdim] / np.maximum(total[:, gdim:], 1.0)
    removed = prescribed & (neighbour_mean > _GROWTH * np.abs(surface.normal))
    projected = np.where(removed, 0.0, surface.normal)
    length = np.linalg.norm(projected, axis=1)
    curved = length > _SHORTEST
    normals: Vector = np.where(
        curved[:, None], projected / np.where(curved, length, 1.0)[:, None], surface.normal
    )
    return normals

"""Checks of a mesh, before anything is computed on it: sound cells, connected bodies.

All checks are vectorised over the cells or the surface nodes that a rank owns. Their findings are
gathered, so that all ranks raise the same error with the totals and the same first place.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.checks.bodies import (
    check_cracks,
    check_joints,
    check_pieces,
    check_split_nodes,
    surface_nodes,
)
from fenics_tfeti.fem.checks.cells import CellGeometry, check_overlaps, check_shapes
from fenics_tfeti.fem.contact.description import Contact, Tie
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.parallel import raise_collectively


def check_mesh(domain: Mesh, bodies: Bodies, contacts: Sequence[Contact | Tie]) -> None:
    """Check the cells, and that each body is connected through facets. Collective.

    The surfaces of a contact pair may be the two faces of a crack in one body, those of a bolt the
    sides of a cut.
    """
    cells = check_cells(domain, bodies)
    check_overlaps(domain, bodies, cells)
    surface = surface_nodes(domain, cells, contacts)
    check_pieces(domain, bodies, cells, surface)
    check_joints(domain, bodies, surface)
    check_split_nodes(domain, surface)
    check_cracks(domain, bodies, surface)


def check_cells(domain: Mesh, bodies: Bodies) -> CellGeometry:
    """Check that nodes are somewhere and cells are not degenerate. Collective."""
    with raise_collectively(domain.comm):
        _check_finite(domain)
    cells = CellGeometry.from_mesh(domain, bodies.of_cell)
    check_shapes(domain, bodies, cells)
    return cells


def _check_finite(domain: Mesh) -> None:
    bad = np.count_nonzero(~np.isfinite(domain.geometry.x).all(axis=1))
    if bad:
        raise InputError(
            f"{bad} of {len(domain.geometry.x)} nodes of the mesh on rank {domain.comm.rank} have "
            "coordinates that are NaN or infinite"
        )

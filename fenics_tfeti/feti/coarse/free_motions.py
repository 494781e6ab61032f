"""Rigid motions of bodies that supports and pressing contacts leave free, by their rows alone.

At finite strains the tangent of a body has more than its material and its supports: stress resists
or drives rotations, and increments of a body that only contact holds are damped. Neither holds it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.coarse.body_motions import (
    centres_and_sizes,
    describe_body_motions,
    motions_and_supports,
)
from fenics_tfeti.feti.coarse.resistance import weak_motions
from fenics_tfeti.feti.local.rigid_body_modes import (
    possible_kernel,
    raw_modes,
    rigid_body_modes,
    translations_and_rotations,
)
from fenics_tfeti.feti.system import ContactRows, Subdomain, TornSystem
from fenics_tfeti.feti.tolerances import ENERGY, FACETED, ZERO, rounding
from fenics_tfeti.parallel import Directory, first_of_rank
from fenics_tfeti.typing import Mask, Numbers, Vector


def describe_free_motions(system: TornSystem, active: Mask, sticking: Mask) -> list[str]:
    """Name the motions that supports, ties and pressing contacts leave free. Collective.

    Parameters
    ----------
    system : TornSystem
        With the tangents of the material and its supports as stiffness matrices.
    active : (contact rows of this rank,) bool array
        Whether the row is pressed.
    sticking : (sites of this rank,) bool array
        Whether friction holds the site.

    Returns
    -------
    list of str
        On all ranks. Motions that only the tilt of deformed surfaces resists are among them.
    """
    kernels = [_unsupported_motions(s) for s in system.subdomains]
    basis, supports, units, _ = motions_and_supports(system, kernels)
    contacts, friction = system.contacts, system.friction
    holding = np.repeat(sticking & active[friction.row], system.gdim - 1)
    parts = [
        system.tied,
        contacts.chosen(np.flatnonzero(active)),
        friction.tangential_rows(contacts).chosen(np.flatnonzero(holding)),
    ]
    rows = rows_on_bodies(system, parts, *centres_and_sizes(system)[:2])
    rows = (rows @ sp.block_diag([sp.csr_matrix(unit) for unit in units])).tocsr()
    free = weak_motions(system.comm, rows, supports, FACETED, FACETED).motions
    own = sum(R.shape[1] for R in kernels)
    first, _ = first_of_rank(system.comm, own)
    motions = sp.csr_matrix((basis @ free)[first : first + own].T)
    return describe_body_motions(system, kernels, motions, True, FACETED)


def rows_on_bodies(
    system: TornSystem, parts: Sequence[ContactRows], centres: Vector, sizes: Vector
) -> sp.csr_matrix:
    """Return what motions of bodies do to supports and rows: (m, modes * bodies). Collective.

    Rows are those that this rank gave, of unit length, as a motion is resisted or not whatever the
    area of a node. Motions are the raw modes about the centres (bodies, gdim), in units of the
    sizes (bodies,).
    """
    gdim, modes, prescribed = system.gdim, 3 * system.gdim - 3, system.prescribed
    nodes = np.concatenate([prescribed.nodes, *(part.nodes for part in parts)])
    first = np.cumsum([prescribed.nodes.size, *(part.size for part in parts)])
    of_parts = [start + part.row for start, part in zip(first, parts, strict=False)]
    row = np.concatenate([np.arange(prescribed.nodes.size), *of_parts])
    terms = [np.identity(gdim)[prescribed.components], *(part.coefficients for part in parts)]
    body, x = _bodies_and_places(system, nodes)
    motions = raw_modes((x - centres[body]) / sizes[body, None], np.zeros(gdim))
    coefficients = np.vstack(terms)
    moved = np.einsum("ti,tim->tm", coefficients, motions.reshape(-1, gdim, modes))
    squares = np.bincount(row, np.sum(coefficients**2, axis=1))
    moved /= np.sqrt(squares[row, None])
    columns = body[:, None] * modes + np.arange(modes)
    places = np.repeat(row, modes), columns.ravel()
    return sp.csr_matrix((moved.ravel(), places), shape=(squares.size, modes * sizes.size))


def _bodies_and_places(system: TornSystem, nodes: Numbers) -> tuple[Numbers, Vector]:
    """Return the bodies (k,) and the places (k, gdim) of any nodes (k,). Collective."""
    directory = Directory(system.comm, np.unique(system.nodes))
    tables = directory.table(system.nodes, system.at_copies(system.bodies), system.coordinates)
    _, body, x = directory.lookup(nodes, *tables)
    return body, x


def _unsupported_motions(subdomain: Subdomain) -> Vector:
    """Return the rigid motions (n, k) that elastic supports leave free, in the frame of K.

    Only supports resist translations, those of axisymmetry included. Stress resists rotations, too:
    where there are supports, it counts as one.
    """
    K, x = subdomain.stiffness, subdomain.coordinates_in_frame
    if not isinstance(subdomain.kernel, str):
        return possible_kernel(subdomain)
    R, (translations, _) = rigid_body_modes(x), translations_and_rotations(x)
    largest = rounding(np.abs(K.data).max(initial=0.0), ENERGY)
    if np.abs(translations.T @ (K @ translations)).max() <= largest:
        return R
    _, forces, motions = np.linalg.svd(K @ R, full_matrices=False)
    return R @ motions[forces <= ZERO * forces.max()].T

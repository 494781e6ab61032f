"""Tangents of finite strains: exact ones, or projected so that rigid motions cost nothing.

The tangent K of a torn subdomain does not resist translations. With an objective material it does
to a rotation W x what the internal forces of the torn subdomain do, K W x = W f: under compression
rotations have negative energy, and torn pieces may buckle. The exact tangents are good for Total
FETI with translations as kernels (`coarse.deflation`). The projected tangent P'KP with
P = I - R A', A'R = I, has the kernel R of all rigid motions, and drops the stiffness of stress
against them. It is taken where

- K R is so small that the dual operator would be large: at the start, in thin or hardly stressed
  parts, and for rotations about the axis of a uniaxial stress;
- the stress of a torn subdomain outweighs the stiffness of a node;
- only contact holds a body against rotations: multipliers of contact rows have bounds, so no
  deflation can remove negative directions of them;
- the exact tangent of the glued bodies is unstable. Of subdomains with elastic supports R is then
  what these leave free.

A body that only contact holds may slide nearly freely. What resists or drives that are contact
forces that turn with the surfaces, whose stiffness is not in K: without it, increments would slide
as far as the linearised surfaces allow, and Newton's method alternates. So increments of such a
body have the energy s |u|^2 / 2 besides, s being as large as the stiffness of its stress against
rotations. In equilibrium they vanish, and it changes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.errors import FactorizationError, InputError, format_point
from fenics_tfeti.feti.checks.system import skewness
from fenics_tfeti.feti.coarse.body_motions import centres_and_sizes
from fenics_tfeti.feti.coarse.free_motions import rows_on_bodies
from fenics_tfeti.feti.coarse.resistance import weak_motions
from fenics_tfeti.feti.factors.cholesky import SparseFactor, choose_package, sparse_cholesky
from fenics_tfeti.feti.local.congruence import find_congruence_classes
from fenics_tfeti.feti.local.elastic_supports import forces_of_motions
from fenics_tfeti.feti.local.fixing_nodes import FIXING_NODES, fixing_nodes, unknowns_of_nodes
from fenics_tfeti.feti.local.moduli import bulk_over_shear, share_of_shear
from fenics_tfeti.feti.local.rigid_body_modes import (
    raw_modes,
    rigid_body_modes,
    translations_and_rotations,
)
from fenics_tfeti.feti.system import Subdomain, TornSystem
from fenics_tfeti.feti.tolerances import ENERGY, NEGLIGIBLE, WEAK, ZERO, rounding
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Mask, Numbers, Vector

TangentKind = Literal["auto", "exact", "projected"]

# force K R of a rotation R of length 1, relative to the part of the mean diagonal of K that shear
# has, below which the tangent is projected: a thin ring, where it is 1e-7, takes 45 products
# instead of 1579
_STRESSED = 1e-4


def has_small_strains(subdomain: Subdomain) -> bool:
    """Tell whether rigid motions of the undeformed coordinates cost nothing.

    So it is with linearised strains, whatever the stress, and in objective materials at rest.
    """
    R = rigid_body_modes(subdomain.coordinates_in_frame)
    return not forces_of_motions(subdomain.stiffness, R).any()


def prepare_tangents(
    system: TornSystem,
    kind: TangentKind = "auto",
    known: tuple[TornSystem, TornSystem] | None = None,
) -> TornSystem:
    """Choose exact or projected tangents for the subdomains of a system. Collective.

    Parameters
    ----------
    system : TornSystem
        With the exact tangents as stiffness matrices, and the deformed coordinates. They need not
        be symmetric, as with pressures that follow the surface: their symmetric part is taken.
    kind : {"auto", "exact", "projected"}
        Where exact tangents are taken: in bodies that prescribed displacements and tied rows hold
        against all rotations, in all bodies, or in none. With "auto" subdomains with elastic
        supports have exact tangents, too. Rotations that hardly cost anything are projected in any
        case. Rigid bodies and their springs, which have no stress, stay as they are.
    known : pair of TornSystem, optional
        A system with the same subdomains and other rows, and what was made of it for the same kind:
        its matrices are taken where the rows of both hold the same bodies.

    Returns
    -------
    TornSystem
        The system with other stiffness matrices and kernels; those of bodies that only contact
        holds against rotations resist all motions a little. A matrix without stress is left as it
        is, the same object.
    """
    centres, sizes, _ = centres_and_sizes(system)
    held = _held_bodies(system, centres, sizes)
    if known is not None and np.array_equal(held, _held_bodies(known[0], centres, sizes)):
        pairs = zip(system.subdomains, known[1].subdomains, strict=True)
        taken = [replace(s, stiffness=t.stiffness, kernel=t.kernel) for s, t in pairs]
        return replace(system, subdomains=taken)
    exact = held if kind == "auto" else np.full_like(held, kind == "exact")
    subdomains = list(system.subdomains)
    body = np.array([s.body for s in subdomains], dtype=np.int64)
    # the springs of rigid bodies are elastic supports
    deformable = ~np.isin(body, [s.body for s in subdomains if s.is_rigid])
    with raise_collectively(system.comm):
        for congruent in find_congruence_classes(subdomains):
            members = congruent.members[deformable[congruent.members]]
            # congruent ones of different bodies
            is_held = held[body[members]]
            for some in (members[is_held], members[~is_held]):
                if some.size:
                    given = subdomains[some[0]]
                    first = replace(given, stiffness=_symmetric_part(given.stiffness))
                    chosen = _tangent(first, bool(exact[first.body]), kind)
                    if not (held[first.body] or kind == "exact"):
                        chosen = _damped(chosen, first.stiffness, sizes[first.body])
                    unchanged = chosen.stiffness is given.stiffness
                    for i in some:
                        K = subdomains[i].stiffness if unchanged else chosen.stiffness
                        subdomains[i] = replace(subdomains[i], stiffness=K, kernel=chosen.kernel)
    return replace(system, subdomains=subdomains)


def have_symmetric_tangents(subdomains: Sequence[Subdomain]) -> bool:
    """Tell whether all stiffness matrices are symmetric."""
    matrices = {id(s.stiffness): s.stiffness for s in subdomains}
    return not any(skewness(K) for K in matrices.values())


def _symmetric_part(K: sp.csr_matrix) -> sp.csr_matrix:
    """Return (K + K') / 2; K itself where it is symmetric."""
    return 0.5 * (K + K.T).tocsr() if skewness(K) else K


def _tangent(subdomain: Subdomain, exact: bool, kind: TangentKind) -> Subdomain:
    """Return a subdomain with its exact or projected tangent."""
    K, x = subdomain.stiffness, subdomain.coordinates_in_frame
    if not np.isfinite(K.data).all():
        raise InputError(
            "the tangent is NaN or infinite in the subdomain around "
            f"{format_point(subdomain.coordinates.mean(axis=0))}: is the energy smooth there?"
        )
    stressed = replace(subdomain, kernel="translations")
    translations, rotations = translations_and_rotations(x)
    share = share_of_shear(bulk_over_shear(K, x), x.shape[1])
    limit = _STRESSED * share * K.diagonal().mean()
    energies = np.abs(translations.T @ (K @ translations))
    if energies.max() > rounding(np.abs(K.data).max(initial=0.0), ENERGY):
        # elastic supports, or axisymmetry
        if kind != "projected":
            free = _without_energy(K, translations)
            return _without_small_forces(stressed, free, limit)
        _, sizes, motions = np.linalg.svd(K @ translations, full_matrices=False)
        R = translations @ motions[sizes <= ZERO * sizes.max()].T
        return replace(stressed, stiffness=_semidefinite(K, x, R))
    _, sizes, motions = np.linalg.svd(K @ rotations, full_matrices=False)
    free = sizes <= limit
    # weights of the copies of nodes need a positive diagonal
    if not exact or free.all() or K.diagonal().min() <= 0.0:
        return replace(subdomain, stiffness=projected_tangent(K, x), kernel="rigid")
    R = np.hstack([translations, rotations @ motions[free].T])
    return _without_small_forces(stressed, R, np.inf if free.any() else limit)


def _without_energy(K: sp.csr_matrix, motions: Vector) -> Vector:
    """Return the motions without energy among orthonormal ones."""
    energies, vectors = np.linalg.eigh(motions.T @ (K @ motions))
    none = rounding(np.abs(K.data).max(initial=0.0), ENERGY)
    return motions @ vectors[:, np.abs(energies) <= none]


def _without_small_forces(subdomain: Subdomain, R: Vector, limit: float) -> Subdomain:
    """Return a subdomain whose tangent does nothing to motions R without energy.

    Forces above a limit are left: those of pressures that follow the surface (`set_free`).
    """
    K, x = subdomain.stiffness, subdomain.coordinates_in_frame
    forces = forces_of_motions(K, R)
    if not forces.any() or np.linalg.norm(forces, axis=0).max() > limit:
        return subdomain
    projected = _projected(K, R, forces, _fixed_unknowns(x, FIXING_NODES))
    return replace(subdomain, stiffness=projected)


def _damped(chosen: Subdomain, K: sp.csr_matrix, size: float) -> Subdomain:
    """Return a subdomain with the energy s |u|^2 / 2; K is its exact tangent.

    Rotations are those that move points at the distance of the body's size by 1. Without stress, or
    on elastic supports, s is zero.
    """
    x, gdim = chosen.coordinates_in_frame, chosen.coordinates.shape[1]
    R = raw_modes((x - x.mean(axis=0)) / size, np.zeros(gdim))
    energies = np.abs(np.sum(R * (K @ R), axis=0))
    none = rounding(np.abs(K.data).max(initial=0.0), ENERGY) * len(x)
    if energies[:gdim].max() > none or energies[gdim:].max() <= none:
        return chosen
    s = energies[gdim:].max() / len(x)
    return replace(chosen, stiffness=(chosen.stiffness + s * sp.identity(len(R))).tocsr())


def projected_tangent(stiffness: sp.csr_matrix, coordinates: Vector) -> sp.csr_matrix:
    """Return P'KP, positive semidefinite with the rigid body modes R as its kernel.

    A of P = I - R A' is on the fixing nodes. K R vanishes where internal and inertial forces do, so
    the projection is sparse.

    Parameters
    ----------
    stiffness : (n, n) scipy.sparse.csr_matrix
        The tangent K [N/m].
    coordinates : (nodes, gdim) array
        Deformed [m].

    Returns
    -------
    (n, n) scipy.sparse.csr_matrix
        K itself where K R is rounding.
    """
    R = rigid_body_modes(coordinates)
    if not forces_of_motions(stiffness, R).any():
        return stiffness
    return _semidefinite(stiffness, coordinates, R)


def _semidefinite(stiffness: sp.csr_matrix, coordinates: Vector, R: Vector) -> sp.csr_matrix:
    """Return P'KP, with the motions R (n, k) as its kernel, without negative energies.

    Those that are left, of buckling and of rotations on elastic supports, are changed to their
    absolute values in the Schur complement on the fixing nodes, and on more of them where the
    subdomain buckles between them.
    """
    number, package = FIXING_NODES, choose_package("auto")
    forces = forces_of_motions(stiffness, R)
    while True:
        fixed = _fixed_unknowns(coordinates, number)
        K = _projected(stiffness, R, forces, fixed) if forces.any() else stiffness
        rest = np.setdiff1d(np.arange(len(R)), fixed)
        try:
            interior = None
            if rest.size:
                inside = K[rest][:, rest].tocsr()
                interior = sparse_cholesky(inside, package, width=coordinates.shape[1])
        except FactorizationError:
            number *= 2
        else:
            return _without_negative_energies(K, R, fixed, rest, interior)


def _fixed_unknowns(coordinates: Vector, number: int) -> Numbers:
    """Return the unknowns of a number of fixing nodes, or of more."""
    nodes = fixing_nodes(coordinates, rigid_body_modes(coordinates), number)
    return unknowns_of_nodes(nodes, coordinates.shape[1])


def _projected(K: sp.csr_matrix, R: Vector, forces: Vector, fixed: Numbers) -> sp.csr_matrix:
    """Return P'KP = K + A G' + G A', with G = A R'KR / 2 - KR for the forces KR."""
    A = R[fixed] @ np.linalg.inv(R[fixed].T @ R[fixed])
    G, energies = -forces, R.T @ forces
    G[fixed] += 0.25 * A @ (energies + energies.T)
    columns = np.flatnonzero(G.any(axis=1))
    indptr = columns.size * np.searchsorted(fixed, np.arange(len(R) + 1))
    values = (A @ G[columns].T).ravel()
    AG = sp.csr_matrix((values, np.tile(columns, fixed.size), indptr), shape=K.shape)
    return K + (AG + AG.T)


def _without_negative_energies(
    K: sp.csr_matrix, R: Vector, fixed: Numbers, rest: Numbers, interior: SparseFactor | None
) -> sp.csr_matrix:
    """Return K with the absolute eigenvalues of its Schur complement on the fixed unknowns.

    The rest of K is positive definite, with its factor `interior`, so the result has no negative
    eigenvalues.
    """
    S = K[fixed][:, fixed].toarray()
    if interior is not None:
        coupling = K[rest][:, fixed]
        S = S - coupling.T @ interior.solve(coupling.toarray())
    # without the rigid motions, which keep their energy of zero
    k = R.shape[1]
    deforming = np.linalg.svd(R[fixed])[0][:, k:]
    energies, vectors = np.linalg.eigh(deforming.T @ (0.5 * (S + S.T)) @ deforming)
    if energies.min(initial=0.0) >= 0.0:
        return K
    least = np.maximum(np.abs(energies), ZERO * np.abs(energies).max())
    vectors = deforming @ vectors
    data, s = (vectors * (least - energies)) @ vectors.T, fixed.size
    places = np.repeat(fixed, s), np.tile(fixed, s)
    return (K + sp.csr_matrix((data.ravel(), places), shape=K.shape)).tocsr()


def _held_bodies(system: TornSystem, centres: Vector, sizes: Vector) -> Mask:
    """Tell which bodies supports, tied and held rows hold against rotations. Collective.

    Bodies have their centres (bodies, gdim) and sizes (bodies,).
    """
    gdim, bodies, contacts = system.gdim, sizes.size, system.contacts
    held = contacts.chosen(np.flatnonzero(np.asarray(contacts.held)))
    rows = rows_on_bodies(system, [system.tied, held], centres, sizes)
    modes = rows.shape[1] // bodies
    weak = weak_motions(system.comm, rows, np.zeros((bodies, modes, modes)), WEAK, ZERO)
    rotations = np.abs(weak.motions.toarray()).reshape(bodies, modes, -1)[:, gdim:]
    return rotations.max(axis=(1, 2), initial=0.0) <= NEGLIGIBLE

"""Rigid body modes R, the kernels of the subdomains' stiffness matrices (11.27)."""

from __future__ import annotations

import numpy as np

from fenics_tfeti.errors import format_point
from fenics_tfeti.feti.system import Subdomain
from fenics_tfeti.feti.tolerances import ENERGY, NEGLIGIBLE, SOFT_SUPPORT, ZERO, rounding
from fenics_tfeti.typing import Vector

# length of a rotation's part that is orthogonal to other modes, in units of the subdomain's size,
# below which it moves nothing
_NO_ROTATION = 1e-7
# distance of a pole from the body, relative to its size, from which on a rotation looks like a
# translation
_AS_WIDE = 2.0


def raw_modes(coordinates: Vector, origin: Vector) -> Vector:
    """Return unit translations and rotations about an origin.

    The columns (gdim * nodes, 3 or 6) are translations along the axes, then the rotation (2D), or
    those about x, y and z (3D). Coordinates (nodes, gdim) and origin (gdim,) are in [m].
    """
    nodes, gdim = coordinates.shape
    x = coordinates - origin
    rotations = 1 if gdim == 2 else 3
    modes = np.zeros((nodes, gdim, gdim + rotations))
    modes[:, np.arange(gdim), np.arange(gdim)] = 1.0
    planes = [(0, 1)] if gdim == 2 else [(1, 2), (2, 0), (0, 1)]
    for column, (i, j) in enumerate(planes, start=gdim):
        modes[:, i, column] = -x[:, j]
        modes[:, j, column] = x[:, i]
    return modes.reshape(nodes * gdim, gdim + rotations)


def rigid_body_modes(coordinates: Vector) -> Vector:
    """Return an orthonormal basis of the rigid body modes of a set of nodes.

    It is R (gdim * nodes, k) with R'R = I; k = 3 in 2D, 6 in 3D, less for nodes on a line or a
    single node.
    """
    centre = coordinates.mean(axis=0)
    size = np.abs(coordinates - centre).max()
    # in units of the subdomain's size, so translations and rotations are alike in magnitude
    modes = raw_modes((coordinates - centre) / (size or 1.0), np.zeros_like(centre))
    R, triangle = np.linalg.qr(modes)
    if len(triangle) == modes.shape[1] and np.abs(triangle.diagonal()).min() > _NO_ROTATION:
        return R
    # rotations about a line, or about a node, move nothing
    left, values, _ = np.linalg.svd(modes, full_matrices=False)
    return left[:, values > _NO_ROTATION * values[0]]


def translations_and_rotations(coordinates: Vector) -> tuple[Vector, Vector]:
    """Return the rigid body modes as translations (n, gdim) and rotations (n, k) about the centre.

    Together they are orthonormal.
    """
    nodes, gdim = coordinates.shape
    translations: Vector = np.tile(np.identity(gdim), (nodes, 1)) / np.sqrt(nodes)
    R = rigid_body_modes(coordinates)
    rotations = np.linalg.svd(R - translations @ (translations.T @ R), full_matrices=False)[0]
    return translations, rotations[:, : R.shape[1] - gdim]


def possible_kernel(subdomain: Subdomain) -> Vector:
    """Return orthonormal motions (n, k) that K_i resists only by elastic supports, if at all."""
    K, x = subdomain.stiffness, subdomain.coordinates_in_frame
    if not isinstance(subdomain.kernel, str):
        return np.linalg.qr(subdomain.kernel)[0]
    if subdomain.kernel == "rigid":
        return rigid_body_modes(x)
    translations, rotations = translations_and_rotations(x)
    # the stress need not act on all rotations: a uniaxial one leaves that about its axis free
    _, forces, motions = np.linalg.svd(K @ rotations, full_matrices=False)
    free = forces <= ZERO * K.diagonal().mean()
    return np.hstack([translations, rotations @ motions[free].T])


def low_energy_modes(subdomain: Subdomain) -> tuple[Vector, Vector]:
    """Return the motions of its kernel that K_i resists softly or not at all, in the frame of K_i.

    An elastic support (a term u.v ds in the form) resists some or all of them. Modes that it
    resists firmly are left out. Returns R (n, k) with R'R = I, k <= 6 (3 in 2D), and the energies
    (k,), the diagonal matrix R'KR [N/m]; 0 for modes in the kernel.
    """
    R = possible_kernel(subdomain)
    stiffness = np.abs(subdomain.stiffness.data).max(initial=0.0)
    gram, none = R.T @ (subdomain.stiffness @ R), rounding(stiffness, ENERGY)
    # rounding would couple motions along a soft support with others that it leaves free
    energies, vectors = np.linalg.eigh(np.where(np.abs(gram) > none, gram, 0.0))
    if energies.max(initial=0.0) <= none:
        return R, np.zeros(energies.size)
    low = energies <= SOFT_SUPPORT * stiffness
    return R @ vectors[:, low], np.where(energies > none, energies, 0.0)[low]


def kernel(subdomain: Subdomain) -> Vector:
    """Return an orthonormal basis of the motions that K_i resists softly or not at all.

    Without soft elastic supports it is the kernel of K_i. It is R_i (n, k) with R_i'R_i = I,
    k <= 6 (3 in 2D).
    """
    return low_energy_modes(subdomain)[0]


def describe_motion(
    coordinates: Vector,
    displacement: Vector,
    either_way: bool = False,
    negligible: float = NEGLIGIBLE,
    about: tuple[Vector, float] | None = None,
) -> str:
    """Say in words which rigid motion a displacement field is.

    For instance "translation along (0, 0, 1)". With either_way the opposite motion is meant as
    well: the one whose first component is positive is named. A translation or rotation is left out
    if its size, relative to the motion, is at most negligible. `about` is the mean place (gdim,)
    and the size of the body that moves [m], by default those of the nodes.
    """
    gdim = coordinates.shape[1]
    if about is None:
        centre = coordinates.mean(axis=0)
        about = centre, float(np.abs(coordinates - centre).max())
    centre, size = about
    modes = raw_modes(coordinates, centre)
    parts = np.linalg.lstsq(modes, displacement, rcond=None)[0]
    if either_way:
        parts = parts * np.sign(parts[np.abs(parts) > NEGLIGIBLE * np.abs(parts).max()][0])
    translation, rotation = parts[:gdim], parts[gdim:]
    amount = np.linalg.norm(np.append(translation, size * rotation))
    words = []
    rotates = size * np.linalg.norm(rotation) > negligible * amount
    if rotates:
        pole, translation_of_pole = _pole(centre, translation, rotation)
        # a rotation about a point farther than the body is wide looks like a translation
        if np.linalg.norm(pole - centre) <= _AS_WIDE * size:
            centre, translation = pole, translation_of_pole
    if np.linalg.norm(translation) > negligible * amount:
        words.append(f"translation along {_direction(translation)}")
    if rotates:
        axis = "" if gdim == 2 else f" about the axis {_direction(rotation)}"
        words.append(f"rotation{axis} through {format_point(centre, size)}")
    return " with ".join(words)


def _pole(centre: Vector, translation: Vector, rotation: Vector) -> tuple[Vector, Vector]:
    """Return the point next to the centre that moves along the axis at most, and how it moves."""
    if rotation.size == 1:
        return centre + np.array([-translation[1], translation[0]]) / rotation, np.zeros(2)
    square = rotation @ rotation
    translation_along = rotation * (rotation @ translation) / square
    return centre + np.cross(rotation, translation) / square, translation_along


def _direction(vector: Vector) -> str:
    unit = vector / np.linalg.norm(vector)
    # 0.0 is added because of -0.0
    return (
        "("
        + ", ".join(f"{v + 0.0:.3g}" for v in np.where(np.abs(unit) < NEGLIGIBLE, 0.0, unit))
        + ")"
    )

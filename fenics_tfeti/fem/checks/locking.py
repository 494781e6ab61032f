"""Check whether displacements of degree 1 lock, because a material is nearly incompressible.

Some cells are measured by their element matrices. The energies of linear displacements are the
elasticity tensor. Its largest eigenvalue, d lambda + 2 mu, belongs to the dilatation, the next, 2
mu, to shear, and 0 to rotations. Quadrilaterals and hexahedra lock if the volumetric term resists
dilatations that vary within the cell, too: where it is integrated by one point, it stiffens no
other displacement.
"""

from __future__ import annotations

import numpy as np

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.assembly import PreparedForms
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.decomposition.forms import flat_rows
from fenics_tfeti.fem.geometry.reference_cells import ReferenceCell
from fenics_tfeti.fem.topology import cell_type, cell_vertices
from fenics_tfeti.parallel import warn_on_first_rank
from fenics_tfeti.typing import Indices, Vector

# Poisson's ratio from which on linear elements are much too stiff
_NEARLY_INCOMPRESSIBLE = 0.49
# cosine between the stiffest strain and the dilatation of a material that is stiff in no other way
_DILATATION = 0.99
# second eigenvalue of a cell relative to the first: a sixth and more, whatever the cell looks like,
# if the volumetric term is integrated by several points, a fiftieth or less if by one
_SECOND = 0.06


def warn_of_locking(forms: PreparedForms, bodies: Bodies) -> None:
    """Warn, on rank 0, if cells of degree 1 lock. Collective."""
    space = forms.space
    domain = space.mesh
    if _compat.element_facts(space)[1] > 1:
        return
    cells, type_ = _samples(forms, bodies), cell_type(domain)
    corners = domain.geometry.x[cell_vertices(domain)[cells], : domain.geometry.dim]
    matrices = forms.cell_matrices(cells)
    # NaN is told of when all cells are assembled
    matrices = np.where(np.isfinite(matrices).all(axis=(1, 2), keepdims=True), matrices, 0.0)
    ratios = locking_ratios(type_, corners, matrices).tolist()
    largest = max(zip(ratios, bodies.of_cell[cells].tolist(), strict=True), default=(0.0, 0))
    ratio, body = max(domain.comm.allgather(largest))
    if ratio <= _NEARLY_INCOMPRESSIBLE:
        return
    remedy = "Take displacements of degree 2 (displacement_space(mesh, degree=2))"
    if not type_.is_simplex:
        remedy += (
            ", or integrate the volumetric term, lambda div(u) div(v), by one point: "
            "dx(metadata={'quadrature_degree': 0})"
        )
    warn_on_first_rank(
        domain.comm,
        f"{bodies.names[body]}: displacements of degree 1 lock at a Poisson's ratio of "
        f"{ratio:.4g}: the result is much too stiff. {remedy}",
    )


def _samples(forms: PreparedForms, bodies: Bodies) -> Indices:
    """Return some cells of each body and tag, and those where coefficients are extreme."""
    groups = [np.flatnonzero(bodies.of_cell == body) for body in np.unique(bodies.of_cell)]
    form = forms.bilinear
    if "cell" in form.numbers:
        numbers = form.numbers["cell"]
        groups += [np.flatnonzero(numbers == number) for number in np.unique(numbers)]
    selected = [group[:: max(1, -(-group.size // 4))] for group in groups]  # four of each
    for values in form.cell_data():
        if values.dtype.kind == "f" and bodies.of_cell.size:
            rows = flat_rows(values[: bodies.of_cell.size])
            selected += [rows.argmin(axis=0), rows.argmax(axis=0)]
    return np.unique(np.concatenate([np.zeros(0), *selected])).astype(np.int32)


def locking_ratios(type_: ReferenceCell, corners: Vector, K: Vector) -> Vector:
    """Return Poisson's ratio (c,) of each cell's material, or 0 where the cell does not lock.

    `corners` (c, v, gdim) are the vertices [m], K (c, v gdim, v gdim) the stiffness matrices of
    degree 1 [N/m].
    """
    d, x = type_.dim, corners - corners.mean(axis=1, keepdims=True)
    # the linear displacements x_j e_i
    linear = np.einsum("cvj,ki->cvkji", x, np.eye(d)).reshape(*K.shape[:2], d * d)
    moduli, gradients = np.linalg.eigh(linear.transpose(0, 2, 1) @ K @ linear)
    dilatation = np.eye(d).ravel() / np.sqrt(d)
    locks = moduli[:, -2] > 0.0
    locks &= np.abs(dilatation @ gradients[:, :, -1:])[:, 0] >= _DILATATION
    if not type_.is_simplex:
        second, first = np.linalg.eigvalsh(K[locks])[:, -2:].T
        locks[locks] = second >= _SECOND * first
    # of the moduli d lambda + 2 mu and 2 mu, times the volume
    lame = 2.0 / d * (moduli[locks, -1] / moduli[locks, -2] - 1.0)
    ratios = np.zeros(len(K))
    ratios[locks] = 0.5 * lame / (1.0 + lame)
    return ratios

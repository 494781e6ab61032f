"""Stiffness of contact forces whose directions turn with the surfaces.

The gap of a pair has the second variation 2 (du_slave - du_master)'dn, and the normal turns by
dn = -(grad du)'n along the surface. Where contact is closed both surfaces turn alike, so each body
can take its own normal: the stiffness is a sum over the bodies, and stays with their subdomains.

An obstacle on a rigid body turns with it, so that its slave has such a stiffness, too. The rigid
body has none. Where friction sticks, the parts of the two would cancel, as nothing slides: there
the slave of a rigid body has none, either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

import ufl
from dolfinx.fem import Function
from dolfinx.mesh import meshtags

from fenics_tfeti.fem._compat import CompilerOptions, cell_dofs, element_facts
from fenics_tfeti.fem.contact.descriptions.contacts import Contact, ContactPair
from fenics_tfeti.fem.contact.descriptions.surfaces import surface_tags
from fenics_tfeti.fem.decomposition.assembly import PreparedForms, TornMesh, prepare_forms
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import cell_type
from fenics_tfeti.feti.system import Subdomain
from fenics_tfeti.typing import Numbers, Vector

# nodes are far from the contact from this part of the largest distance on
_FAR = 0.8


class ContactStiffness:
    """The pressures on surfaces with normals that turn, and their stiffness on subdomains."""

    def __init__(self, u: Function, contacts: Sequence[Contact], compiler: CompilerOptions) -> None:
        self._nodes = NodeMap(u.function_space)
        self._forms: PreparedForms | None = None
        turning = [contact for contact in contacts if has_turning_normals(contact)]
        if turning:
            facets = [c.facet_tags.find(tag) for c in turning for tag in surface_tags(c)]
            self._at_vertices = _at_vertices(self._nodes)
            self._pressure, self._forms = _forms(u, np.unique(np.concatenate(facets)), compiler)

    def matrices(self, torn: TornMesh, force: Vector) -> list[sp.csr_matrix | None]:
        """Return the stiffness of nodal forces (owned, gdim) on each subdomain. Collective."""
        comm = self._nodes.comm
        if self._forms is None or not comm.allreduce(float(np.abs(force).sum())):
            return [None] * len(torn.subdomains)
        self._fill_pressure(force, torn.load(self._forms))
        return [K if np.abs(K.data).max(initial=0.0) else None for K in torn.matrices(self._forms)]

    def _fill_pressure(self, force: Vector, area: Vector) -> None:
        """Find the pressure of degree 1 from forces and areas (owned, gdim) of nodes. Collective.

        Both are summed over shape functions of degree 1: those of degree 2 at the vertices of
        triangles have an area of zero.
        """
        nodes, weights = self._nodes, self._at_vertices
        sums = weights[: nodes.owned].T @ np.hstack([force, area])
        loaded = np.flatnonzero(sums.any(axis=1))
        sums = nodes.sum_at_owners(nodes.to_global(loaded), sums[loaded])
        force, area = np.hsplit(sums, 2)
        square = np.sum(area**2, axis=1)
        pressing = np.maximum(np.sum(force * area, axis=1), 0.0)
        pressure = self._pressure.x.array.reshape(nodes.size, -1)[:, 0]
        pressure[: nodes.owned] = np.divide(
            pressing, square, out=np.zeros_like(square), where=square > 0.0
        )
        self._pressure.x.scatter_forward()
        pressure[:] = weights @ pressure


def has_turning_normals(contact: Contact) -> bool:
    """Tell whether the master is a deformable or a rigid body, not an obstacle by itself."""
    return isinstance(contact, ContactPair) or contact.body is not None


def with_contact_stiffness(subdomain: Subdomain, K: sp.csr_matrix) -> Subdomain:
    """Return the subdomain with a stiffness added to that of its material."""
    stiffness = subdomain.stiffness
    if subdomain.frame is not None:
        T = sp.kron(sp.identity(len(subdomain.coordinates)), subdomain.frame).tocsr()
        stiffness = T @ stiffness @ T.T
    stiffness = (stiffness + _relative_to_far_nodes(K, subdomain.coordinates)).tocsr()
    return replace(subdomain, stiffness=stiffness, frame=None)


def _forms(
    u: Function, facets: Numbers, compiler: CompilerOptions
) -> tuple[Function, PreparedForms]:
    """Return the pressure, the first component of a function, and its stiffness and nodal areas."""
    V = u.function_space
    mesh, pressure = V.mesh, Function(V, name="contact_pressure")
    degree = element_facts(V)[1]
    tags = meshtags(mesh, mesh.topology.dim - 1, facets, np.ones(facets.size, dtype=np.int32))
    ds = ufl.Measure("ds", mesh, subdomain_data=tags, metadata={"quadrature_degree": 2 * degree})(1)
    inverse = ufl.inv(ufl.Identity(len(u)) + ufl.grad(u))
    area = inverse.T * ufl.FacetNormal(mesh) / ufl.det(inverse)
    size = ufl.sqrt(ufl.inner(area, area))
    n = area / size
    v, du = ufl.TestFunction(V), ufl.TrialFunction(V)

    def sliding_and_turning(a: ufl.core.expr.Expr, b: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
        return ufl.inner(a - ufl.inner(a, n) * n, (ufl.grad(b) * inverse).T * n)

    energy = sliding_and_turning(v, du) + sliding_and_turning(du, v)
    stiffness = -pressure[0] * energy * size * ds
    return pressure, prepare_forms(V, stiffness, ufl.inner(area, v) * ds, compiler)


def _at_vertices(nodes: NodeMap) -> sp.csr_matrix:
    """Return the matrix (nodes, nodes) that takes values at vertices to all nodes, in degree 1."""
    kind, dofs = cell_type(nodes.space.mesh), cell_dofs(nodes.space)
    around = [(k,) for k in range(kind.vertices)] + list(kind.midpoints)
    pairs = [(k, j) for k in range(dofs.shape[1]) for j in around[k]]
    rows, columns = (dofs[:, list(side)].ravel() for side in zip(*pairs, strict=True))
    cells = sp.csr_matrix((np.ones(rows.size), (rows, columns)), shape=(nodes.size, nodes.size))
    return sp.diags(1.0 / cells.sum(axis=1).A1) @ cells


def _relative_to_far_nodes(K: sp.csr_matrix, x: Vector) -> sp.csr_matrix:
    """Return P'KP, P = I - T A' with translations T, so that none has a force; A'T = I.

    Sliding is that relative to the mean of the nodes far from the contact.
    """
    nodes, gdim = x.shape
    T = np.tile(np.eye(gdim), (nodes, 1))
    forces = K @ T
    loaded = np.unique(K.nonzero()[0] // gdim)
    distance = cKDTree(x[loaded]).query(x)[0]
    far = np.flatnonzero(distance >= _FAR * distance.max())
    rows = (gdim * far[:, None] + np.arange(gdim)).ravel()
    columns = np.tile(np.arange(gdim), far.size)
    A = sp.csr_matrix((np.full(rows.size, 1.0 / far.size), (rows, columns)), shape=T.shape)
    low = A @ sp.csr_matrix(forces).T
    return K - low - low.T + A @ sp.csr_matrix(T.T @ forces) @ A.T

"""Stiffness of contact forces whose directions turn with the surfaces.

The gap of a pair has the second variation (du_slave - du_master)'(dn_slave + dn_master), and a
normal turns by dn = -(grad du)'n along its surface. Where contact is closed the normals stay
opposite each other: they turn alike but for the curvature Q = grad n of the surface along which
they slide, dn_slave - dn_master = Q (du_slave - du_master). So the second variation is a difference
of the bodies' own 2 du'dn - du'Q du: the stiffness is a sum over the bodies, and stays with their
subdomains. At the rim of the contact the surfaces part, and Q counts less and less: with the least
pressure nearby, as a Q that comes and goes makes steps alternate.

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
from dolfinx.fem import Function, FunctionSpace, locate_dofs_topological
from dolfinx.mesh import meshtags

from fenics_tfeti.fem._compat import CompilerOptions, cell_dofs, element_facts
from fenics_tfeti.fem.contact.descriptions.contacts import Contact, ContactPair
from fenics_tfeti.fem.contact.descriptions.surfaces import surface_key, surface_tags
from fenics_tfeti.fem.contact.surfaces.faceted import unit
from fenics_tfeti.fem.decomposition.assembly import PreparedForms, TornMesh, prepare_forms
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import cell_type
from fenics_tfeti.feti.system import Subdomain
from fenics_tfeti.typing import Mask, Numbers, Vector

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
            self._pressure, self._normal, self._forms = _forms(
                u, np.unique(np.concatenate(facets)), compiler
            )
            self._without_curvature = _without_curvature(u.function_space, turning)

    def matrices(self, torn: TornMesh, force: Vector) -> list[sp.csr_matrix | None]:
        """Return the stiffness of nodal forces (owned, gdim) on each subdomain. Collective."""
        comm = self._nodes.comm
        if self._forms is None or not comm.allreduce(float(np.abs(force).sum())):
            return [None] * len(torn.subdomains)
        self._fill(force, torn.load(self._forms))
        return [K if np.abs(K.data).max(initial=0.0) else None for K in torn.matrices(self._forms)]

    def _fill(self, force: Vector, area: Vector) -> None:
        """Find pressure and normal from forces and areas (owned, gdim) of nodes. Collective.

        They are of degree 1, and so are the shape functions over which both are summed: those of
        degree 2 at the vertices of triangles have an area of zero.
        """
        nodes, weights = self._nodes, self._at_vertices
        sums = weights[: nodes.owned].T @ np.hstack([force, area])
        loaded = np.flatnonzero(sums.any(axis=1))
        sums = nodes.sum_at_owners(nodes.to_global(loaded), sums[loaded])
        force, area = np.hsplit(sums, 2)
        square = np.sum(area**2, axis=1)
        pressing = np.maximum(np.sum(force * area, axis=1), 0.0)
        pressure, normal = (
            f.x.array.reshape(nodes.size, -1) for f in (self._pressure, self._normal)
        )
        pressure[: nodes.owned, 0] = np.divide(
            pressing, square, out=np.zeros_like(square), where=square > 0.0
        )
        normal[: nodes.owned] = unit(area)
        self._pressure.x.scatter_forward()
        self._normal.x.scatter_forward()
        pressure[:, 1] = pressure[:, 0]
        # normals at the rim are means with those of facets that are not in contact
        for _ in range(2):
            pressure[: nodes.owned, 1] = self._least_around(pressure[:, 1], normal)
            self._pressure.x.scatter_forward()
        pressure[:, :2] = weights @ pressure[:, :2]
        normal[:] = weights @ normal

    def _least_around(self, pressure: Vector, normal: Vector) -> Vector:
        """Return the least pressure around each owned vertex. Collective.

        The pressures (size,) and normals (size, gdim) are those at vertices.
        """
        nodes, on_surface = self._nodes, normal.any(axis=1)
        values = np.where(on_surface, np.where(self._without_curvature, 0.0, pressure), np.inf)
        cells = cell_dofs(nodes.space)
        cells = cells[on_surface[cells].any(axis=1)]
        least = np.repeat(values[cells].min(axis=1), cells.shape[1])
        chosen = on_surface[cells.ravel()]
        around = nodes.to_global(cells.ravel()[chosen])
        return nodes.sum_at_owners(around, least[chosen], np.minimum)


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
) -> tuple[Function, Function, PreparedForms]:
    """Return the pressure, the normal, and the stiffness with them and nodal areas.

    The first component of the pressure's function is that on normals that turn, the second one that
    on the curvature.
    """
    V = u.function_space
    mesh, pressure, normal = V.mesh, Function(V, name="contact_pressure"), Function(V)
    degree = element_facts(V)[1]
    tags = meshtags(mesh, mesh.topology.dim - 1, facets, np.ones(facets.size, dtype=np.int32))
    ds = ufl.Measure("ds", mesh, subdomain_data=tags, metadata={"quadrature_degree": 2 * degree})(1)
    inverse = ufl.inv(ufl.Identity(len(u)) + ufl.grad(u))
    area = inverse.T * ufl.FacetNormal(mesh) / ufl.det(inverse)
    size = ufl.sqrt(ufl.inner(area, area))
    n = area / size
    v, du = ufl.TestFunction(V), ufl.TrialFunction(V)

    def sliding(a: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
        return a - ufl.inner(a, n) * n

    def turning(a: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
        return -(ufl.grad(a) * inverse).T * n

    curvature = ufl.sym(ufl.grad(normal) * inverse)
    energy = ufl.inner(sliding(v), turning(du)) + ufl.inner(sliding(du), turning(v))
    stiffness = pressure[0] * energy - pressure[1] * ufl.inner(sliding(v), curvature * sliding(du))
    stiffness = stiffness * size * ds
    return pressure, normal, prepare_forms(V, stiffness, ufl.inner(area, v) * ds, compiler)


def _without_curvature(V: FunctionSpace, contacts: Sequence[Contact]) -> Mask:
    """Tell which nodes (size,) are on several tagged surfaces or have friction. Collective.

    Normals of several surfaces are those of none. Friction forces turn along the curvature, too, by
    a stiffness that is not symmetric; with the symmetric part alone there are more steps.
    """
    surfaces, with_friction = {}, set()
    for contact in contacts:
        for tag in surface_tags(contact):
            key = surface_key(contact.facet_tags, tag)
            surfaces[key] = contact.facet_tags.find(tag)
            if contact.friction is not None:
                with_friction.add(key)
    number = np.zeros(NodeMap(V).size)
    for key, facets in surfaces.items():
        nodes = locate_dofs_topological(V, V.mesh.topology.dim - 1, facets)
        number[nodes] += 2.0 if key in with_friction else 1.0
    return number > 1.0


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
    row = np.repeat(np.arange(len(K.indptr) - 1), np.diff(K.indptr))[K.data != 0.0]
    distance = cKDTree(x[np.unique(row // gdim)]).query(x)[0]
    far = np.flatnonzero(distance >= _FAR * distance.max())
    forces = K @ np.tile(np.eye(gdim), (nodes, 1))
    # P'KP = K + A G' + G A' with G = A T'KT / 2 - KT
    G = -forces.reshape(nodes, gdim, gdim)
    G[far] += 0.5 / far.size * forces.reshape(nodes, gdim, gdim).sum(axis=0)
    G = G.reshape(-1, gdim)
    columns = np.flatnonzero(G.any(axis=1))
    rows = (gdim * far[:, None] + np.arange(gdim)).ravel()
    indptr = columns.size * np.searchsorted(rows, np.arange(len(G) + 1))
    values = np.tile(G[columns].T / far.size, (far.size, 1)).ravel()
    AG = sp.csr_matrix((values, np.tile(columns, rows.size), indptr), shape=K.shape)
    return K + (AG + AG.T)

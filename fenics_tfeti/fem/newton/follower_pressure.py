"""Stiffness of contact pressures that follow the surfaces of both bodies of a pair.

It is what the tangent lacks where both surfaces can rotate: their normals take the forces along.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.sparse as sp

import ufl
from dolfinx.fem import Function
from dolfinx.mesh import meshtags

from fenics_tfeti.fem._compat import CompilerOptions
from fenics_tfeti.fem.contact.description import Contact, ContactPair
from fenics_tfeti.fem.decomposition.assembly import PreparedForms, prepare_forms
from fenics_tfeti.fem.decomposition.parts import Part, sum_over_parts
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.feti.system import Subdomain
from fenics_tfeti.typing import Numbers, Vector


class FollowerPressure:
    """The pressure on the surfaces of all contact pairs, and its stiffness on subdomains."""

    def __init__(self, u: Function, contacts: Sequence[Contact], compiler: CompilerOptions) -> None:
        self._nodes = NodeMap(u.function_space)
        self._forms: PreparedForms | None = None
        facets = [np.zeros(0, dtype=np.int32)]
        pairs = [contact for contact in contacts if isinstance(contact, ContactPair)]
        for pair in pairs:
            facets += [pair.facet_tags.find(tag) for tag in (pair.slave, pair.master)]
        if pairs:
            self._pressure, self._forms = _forms(u, np.unique(np.concatenate(facets)), compiler)

    def added(
        self, subdomains: Sequence[Subdomain], parts: Sequence[Part], force: Vector
    ) -> list[Subdomain]:
        """Return subdomains with the stiffness of nodal forces (owned, gdim) added. Collective."""
        if self._forms is None or not self._nodes.comm.allreduce(float(np.abs(force).sum())):
            return list(subdomains)
        area = sum_over_parts(self._nodes, parts, self._forms.loads(parts))
        square = np.sum(area**2, axis=1)
        pressing = np.maximum(np.sum(force * area, axis=1), 0.0)
        pressure = np.divide(pressing, square, out=np.zeros_like(square), where=square > 0.0)
        self._nodes.values(self._pressure)[: self._nodes.owned, 0] = pressure
        self._pressure.x.scatter_forward()
        return [_with(s, K) for s, K in zip(subdomains, self._forms.matrices(parts), strict=True)]


def _forms(
    u: Function, facets: Numbers, compiler: CompilerOptions
) -> tuple[Function, PreparedForms]:
    """Return the pressure, the first component of a function, and its stiffness and nodal areas."""
    V = u.function_space
    mesh, pressure = V.mesh, Function(V, name="contact_pressure")
    tags = meshtags(mesh, mesh.topology.dim - 1, facets, np.ones(facets.size, dtype=np.int32))
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    F = ufl.Identity(len(u)) + ufl.grad(u)
    area = ufl.det(F) * ufl.inv(F).T * ufl.FacetNormal(mesh)
    v = ufl.TestFunction(V)
    work = pressure[0] * ufl.inner(area, v) * ds(1)
    stiffness = ufl.derivative(work, u, ufl.TrialFunction(V))
    return pressure, prepare_forms(V, stiffness, ufl.inner(area, v) * ds(1), compiler)


def _with(subdomain: Subdomain, K: sp.csr_matrix) -> Subdomain:
    """Return the subdomain with the symmetric part of a stiffness added."""
    if not np.abs(K.data).max(initial=0.0):
        return subdomain
    stiffness = subdomain.stiffness
    if subdomain.frame is not None:
        T = sp.kron(sp.identity(len(subdomain.coordinates)), subdomain.frame).tocsr()
        stiffness = T @ stiffness @ T.T
    stiffness = (stiffness + _for_translations(0.5 * (K + K.T), subdomain.coordinates)).tocsr()
    return replace(subdomain, stiffness=stiffness, frame=None)


def _for_translations(K: sp.csr_matrix, x: Vector) -> sp.csr_matrix:
    """Return P'KP, P = I - T A' with translations T, so that none has a force; A'T = I.

    The symmetric part of the stiffness has forces at edges and where pressures change. A is on the
    node next to the middle of those that are loaded.
    """
    nodes, gdim = x.shape
    T = np.tile(np.eye(gdim), (nodes, 1))
    forces = K @ T
    loaded = np.unique(K.nonzero()[0] // gdim)
    middle = loaded[np.argmin(np.linalg.norm(x[loaded] - x[loaded].mean(axis=0), axis=1))]
    A = sp.csr_matrix(
        (np.ones(gdim), (gdim * middle + np.arange(gdim), np.arange(gdim))), shape=T.shape
    )
    low = A @ sp.csr_matrix(forces).T
    return K - low - low.T + A @ sp.csr_matrix(T.T @ forces) @ A.T

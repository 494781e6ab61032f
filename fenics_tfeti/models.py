"""Material laws and supports that many problems have, as UFL expressions and dolfinx conditions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import ufl
from dolfinx import fem


def small_strain(u: Any) -> Any:
    """Return the symmetric gradient of a displacement."""
    return ufl.sym(ufl.grad(u))


def axisymmetric_strain(u: Any) -> Any:
    """Return the strain, 3 x 3, of a displacement (u_r, u_z) that does not change around the axis.

    The coordinates of the mesh are (r, z), the third direction is that of the circumference.
    """
    r = ufl.SpatialCoordinate(u.ufl_function_space().ufl_domain())[0]
    e = ufl.sym(ufl.grad(u))
    return ufl.as_tensor([[e[0, 0], e[0, 1], 0], [e[1, 0], e[1, 1], 0], [0, 0, u[0] / r]])


def _lame(E: Any, nu: Any) -> tuple[Any, Any]:
    """Return the Lame parameters mu and lambda [Pa]."""
    return E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))


def isotropic(E: Any, nu: Any, strain: Callable[[Any], Any] = small_strain) -> Callable[[Any], Any]:
    """Return the stress of an isotropic linear elastic material as a function of the displacement.

    Parameters
    ----------
    E : float or UFL expression
        Young's modulus [Pa].
    nu : float or UFL expression
        Poisson's ratio.
    strain : callable, optional
        The strain as a function of the displacement. By default `small_strain`, which in two
        dimensions means plane strain; `axisymmetric_strain` is the other one of this module. For
        plane stress pass E (1 + 2 nu) / (1 + nu)^2 for `E` and nu / (1 + nu) for `nu`.

    Returns
    -------
    callable
        Of a displacement, the stress tensor [Pa] of the shape of the strain.
    """
    mu, lmbda = _lame(E, nu)

    def stress(u: Any) -> Any:
        e = strain(u)
        return 2 * mu * e + lmbda * ufl.tr(e) * ufl.Identity(e.ufl_shape[0])

    return stress


def neo_hookean(E: Any, nu: Any) -> Callable[[Any], Any]:
    """Return the strain energy density of a compressible neo-Hookean material.

    W = mu/2 (tr C - 3) - mu ln J + lambda/2 (ln J)^2, with C = F'F, F = I + grad u and J = det F.
    For small strains it is that of `isotropic`.

    Parameters
    ----------
    E : float or UFL expression
        Young's modulus [Pa].
    nu : float or UFL expression
        Poisson's ratio.

    Returns
    -------
    callable
        Of a displacement, the energy per undeformed volume [J/m^3]; in two dimensions that of plane
        strain.
    """
    mu, lmbda = _lame(E, nu)

    def energy(u: Any) -> Any:
        dim = u.ufl_shape[0]
        F = ufl.Identity(dim) + ufl.grad(u)
        log = ufl.ln(ufl.det(F))
        return mu / 2 * (ufl.inner(F, F) - dim) - mu * log + lmbda / 2 * log**2

    return energy


def neo_hookean_stress(E: Any, nu: Any) -> Callable[[Any], Any]:
    """Return the Cauchy stress of the material of `neo_hookean`.

    sigma = (mu (F F' - I) + lambda ln J I) / J, the force per deformed area.

    Parameters
    ----------
    E : float or UFL expression
        Young's modulus [Pa].
    nu : float or UFL expression
        Poisson's ratio.

    Returns
    -------
    callable
        Of a displacement, the stress tensor [Pa], 3 x 3; in two dimensions that of plane strain.
    """
    mu, lmbda = _lame(E, nu)

    def stress(u: Any) -> Any:
        dim = u.ufl_shape[0]
        F = ufl.Identity(dim) + ufl.grad(u)
        left, J = F * F.T, ufl.det(F)
        if dim == 2:
            left = ufl.as_tensor(
                [[left[0, 0], left[0, 1], 0], [left[1, 0], left[1, 1], 0], [0, 0, 1]]
            )
        identity = ufl.Identity(3)
        return (mu * (left - identity) + lmbda * ufl.ln(J) * identity) / J

    return stress


def symmetry_plane(V: Any, facet_tags: Any, tag: int, axis: int) -> Any:
    """Return the Dirichlet condition that nothing moves across a plane of symmetry.

    Parameters
    ----------
    V : dolfinx.fem.FunctionSpace
        The space of the displacement.
    facet_tags : dolfinx.mesh.MeshTags
        Tags of facets.
    tag : int
        Tag of the facets in the plane, or on any surface that is guided along it.
    axis : int
        The axis of coordinates that is normal to the plane.

    Returns
    -------
    dolfinx.fem.DirichletBC
        Zero displacement along the axis.
    """
    facet = V.mesh.topology.dim - 1
    V.mesh.topology.create_connectivity(facet, facet + 1)
    dofs = fem.locate_dofs_topological(V.sub(axis), facet, facet_tags.find(tag))
    return fem.dirichletbc(0.0, dofs, V.sub(axis))

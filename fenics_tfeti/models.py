"""Material laws, pressures, densities and supports that many problems have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem
from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError, wrong_type
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.arguments import as_contacts
from fenics_tfeti.fem.contact.descriptions.contacts import Contact
from fenics_tfeti.fem.contact.descriptions.surfaces import surface_tags
from fenics_tfeti.fem.contact.descriptions.ties import Tie
from fenics_tfeti.fem.contact.surfaces.tagged import as_ufl_weight
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.fem.io.fields import with_third_direction
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import owned_cells
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Mask, Numbers


def small_strain(u: Any) -> Any:
    """Return the symmetric gradient of a displacement.

    Examples
    --------
    >>> a = ufl.inner(sigma(u), small_strain(v)) * ufl.dx  # doctest: +SKIP
    """
    return ufl.sym(ufl.grad(u))


def axisymmetric_strain(u: Any) -> Any:
    """Return the strain, 3 x 3, of a displacement (u_r, u_z) that does not change around the axis.

    The coordinates of the mesh are (r, z), the third direction is that of the circumference.

    Examples
    --------
    >>> sigma = isotropic(2.1e11, 0.3, axisymmetric_strain)  # doctest: +SKIP
    >>> r = ufl.SpatialCoordinate(mesh)[0]  # doctest: +SKIP
    >>> a = ufl.inner(sigma(u), axisymmetric_strain(v)) * 2 * ufl.pi * r * ufl.dx  # doctest: +SKIP
    """
    r = ufl.SpatialCoordinate(u.ufl_function_space().ufl_domain())[0]
    e = ufl.sym(ufl.grad(u))
    return with_third_direction(e, u[0] / r)


def _lame(E: Any, nu: Any) -> tuple[Any, Any]:
    """Return the Lame parameters mu and lambda [Pa]; collective if nu is a Function."""
    comm, values = MPI.COMM_SELF, np.zeros(0)
    if isinstance(nu, fem.Function):
        comm, values = nu.function_space.mesh.comm, nu.x.array
    elif isinstance(nu, fem.Constant):
        values = np.ravel(nu.value)
    elif isinstance(nu, int | float | np.number):
        values = np.ravel(nu)
    with raise_collectively(comm):
        wrong = values[~((values > -1.0) & (values < 0.5))]
        if wrong.size:
            raise InputError(
                f"Poisson's ratio is {wrong[0]:.6g}, it has to be between -1 and 0.5. At 0.5 the "
                "bulk modulus is infinite: rubber has 0.49 to 0.49999. Young's modulus is the "
                "argument before it"
            )
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

    Examples
    --------
    >>> sigma = isotropic(2.1e11, 0.3)
    >>> a = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx  # doctest: +SKIP
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
    E, nu : float or UFL expression
        Young's modulus [Pa] and Poisson's ratio.

    Returns
    -------
    callable
        Of a displacement, the energy per undeformed volume [J/m^3]; in two dimensions that of plane
        strain.

    Examples
    --------
    >>> energy = neo_hookean(1e6, 0.45)
    >>> F = ufl.derivative(energy(u) * ufl.dx, u, v)  # doctest: +SKIP
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
    E, nu : float or UFL expression
        Young's modulus [Pa] and Poisson's ratio.

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
        left = with_third_direction(left, 1) if dim == 2 else left
        identity = ufl.Identity(3)
        return (mu * (left - identity) + lmbda * ufl.ln(J) * identity) / J

    return stress


def follower_pressure(
    p: Any, u: fem.Function, measure: ufl.Measure, measure_weight: Any = 1.0
) -> ufl.Form:
    """Return the residual of a pressure that follows the deformed surface.

    It acts against the outward normal, over the present area: p J G^-T N . v ds with Nanson's
    formula, G = I + grad u, J = det G and the undeformed normal N. Its derivative is in general not
    symmetric.

    Parameters
    ----------
    p : float or UFL expression
        The pressure [Pa], in terms of undeformed places.
    u : Function
        The displacement of `NonlinearContactProblem`.
    measure : ufl.Measure
        The undeformed surface: ``ds`` with a tag.
    measure_weight : float or UFL expression
        Factor of ``dx`` in the forms, such as ``2 * pi * r`` in axisymmetric ones; here, x in it is
        the deformed place.

    Returns
    -------
    ufl.Form
        The term to be added to `F`.

    Raises
    ------
    InputError
        If an argument is of another kind.

    Examples
    --------
    >>> F = ufl.derivative(energy(u) * ufl.dx, u, v)  # doctest: +SKIP
    >>> F += follower_pressure(2e5, u, ds(TOP))  # doctest: +SKIP
    """
    if not isinstance(u, fem.Function):
        raise wrong_type("follower_pressure: u", u, "the displacement, a dolfinx.fem.Function,")
    expected = "one of facets on the boundary, such as ufl.Measure('ds', subdomain_data=tags)(tag),"
    if not isinstance(measure, ufl.Measure):
        raise wrong_type("follower_pressure: the measure", measure, expected)
    if (kind := measure.integral_type()) != "exterior_facet":
        raise InputError(
            f"follower_pressure: the measure is one of kind {kind!r}; {expected} is expected"
        )
    if shape := p.ufl_shape if hasattr(p, "ufl_shape") else np.shape(p):
        raise InputError(
            f"follower_pressure: p has shape {shape}; a scalar is expected, positive where it "
            "presses on the body"
        )
    space = u.function_space
    x, N = ufl.SpatialCoordinate(space.mesh), ufl.FacetNormal(space.mesh)
    weight = ufl.replace(as_ufl_weight(space.mesh, measure_weight), {x: x + u})
    area = _cofactors(ufl.Identity(u.ufl_shape[0]) + ufl.grad(u)) * N
    return p * weight * ufl.inner(area, ufl.TestFunction(space)) * measure


def _cofactors(G: Any) -> Any:
    """Return J G^-T as a polynomial in G, which rules of quadrature integrate exactly."""
    trace, identity = ufl.tr(G), ufl.Identity(G.ufl_shape[0])
    if G.ufl_shape[0] == 2:
        return trace * identity - G.T
    return (G * G).T - trace * G.T + (trace**2 - ufl.tr(G * G)) / 2 * identity


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

    Raises
    ------
    InputError
        If there is no such axis.

    Examples
    --------
    >>> bcs = [symmetry_plane(V, facet_tags, tag=3, axis=0)]  # doctest: +SKIP
    """
    facet = V.mesh.topology.dim - 1
    if axis not in range(facet + 1):
        raise InputError(f"symmetry_plane: axis is {axis!r}; the axes are {[*range(facet + 1)]}")
    V.mesh.topology.create_connectivity(facet, facet + 1)
    dofs = fem.locate_dofs_topological(V.sub(axis), facet, facet_tags.find(tag))
    return fem.dirichletbc(0.0, dofs, V.sub(axis))


def redistributed_density(
    mesh: Mesh, rho: Any, contacts: Sequence[Contact | Tie] | Contact, measure_weight: Any = 1.0
) -> fem.Function:
    """Return the density of bodies that have no mass at the nodes of contact surfaces. Collective.

    Nodes with mass that stop at a contact rebound in the next time step: contact forces oscillate,
    and Newmark's method gains energy. Without mass there, contact forces follow from the
    deformation alone, and energy is conserved [1]_. Cells that touch a contact surface are without
    mass; in each body the next layer of cells takes it over.

    Parameters
    ----------
    mesh : dolfinx.mesh.Mesh
        The mesh of the displacement.
    rho : float or UFL expression
        The density [kg/m^3].
    contacts : sequence of ContactPair, RigidObstacle or ties, or one of them
        Those of the problem; tied surfaces keep their mass.
    measure_weight : float or UFL expression
        Factor of ``dx`` in the forms, such as ``2 * pi * r`` in axisymmetric ones.

    Returns
    -------
    dolfinx.fem.Function
        A density for each cell, with the same mass of each body [kg/m^3].

    Raises
    ------
    InputError
        On all ranks, if all cells of a body touch contact surfaces, or an argument is no scalar.

    References
    ----------
    .. [1] H. B. Khenous, P. Laborde, Y. Renard: Mass redistribution method for finite element
       contact problems in elastodynamics. European Journal of Mechanics A 27 (2008), 918-932.

    Examples
    --------
    >>> rho_h = redistributed_density(V.mesh, 7850.0, contacts)  # doctest: +SKIP
    """
    if shape := rho.ufl_shape if hasattr(rho, "ufl_shape") else np.shape(rho):
        raise InputError(
            f"rho has shape {shape}; a scalar is expected: a number, or a function such as "
            "piecewise_constant makes from a number for each body"
        )
    weight = as_ufl_weight(mesh, measure_weight)
    bodies, cells = find_bodies(mesh, None), owned_cells(mesh)
    density = fem.Function(_compat.lagrange_space(mesh, 0, discontinuous=True))
    q, dx = ufl.TestFunction(density.function_space), ufl.Measure("dx", domain=mesh)
    dofs = _compat.cell_dofs(density.function_space)[:cells, 0]
    with _compat.compiling():
        forms = [fem.form(factor * weight * q * dx) for factor in (rho, 1.0)]
    mass, size = (fem.assemble_vector(form).array[dofs] for form in forms)
    touching = [contact for contact in as_contacts(contacts) if isinstance(contact, Contact)]
    first, second = _layers_at(mesh, touching)
    moved, taking = (
        mesh.comm.allreduce(np.bincount(bodies.of_cell, mass * layer, len(bodies.names)), MPI.SUM)
        for layer in (first, second)
    )
    with raise_collectively(mesh.comm):
        for name in np.array(bodies.names)[(moved > 0.0) & (taking == 0.0)]:
            raise InputError(
                f"{name}: all cells touch contact surfaces, and none is left to have the mass: "
                "give the body two layers of cells or more"
            )
    factor = 1.0 + np.divide(moved, taking, out=np.zeros_like(moved), where=taking > 0.0)
    share = np.where(first, 0.0, np.where(second, factor[bodies.of_cell], 1.0))
    density.x.array[dofs] = share * mass / size
    density.x.scatter_forward()
    return density


def _layers_at(mesh: Mesh, contacts: Sequence[Contact]) -> tuple[Mask, Mask]:
    """Tell which of this rank's cells touch contact surfaces, and which are next to these cells."""
    space = _compat.lagrange_space(mesh, 1)
    nodes, facet = NodeMap(space), mesh.topology.dim - 1
    mesh.topology.create_connectivity(facet, facet + 1)
    facets = [c.facet_tags.find(tag) for c in contacts for tag in surface_tags(c)]
    at_contact = [fem.locate_dofs_topological(space, facet, part) for part in facets]
    corners = nodes.to_global(_compat.cell_dofs(space)[: owned_cells(mesh)])
    first = _touching(nodes, nodes.to_global(np.concatenate([*at_contact, []])), corners)
    return first, _touching(nodes, corners[first].ravel(), corners) & ~first


def _touching(nodes: NodeMap, marked: Numbers, corners: Numbers) -> Mask:
    """Tell which cells have a corner among marked nodes of any rank. Collective."""
    count = nodes.sum_at_owners(marked, np.ones(marked.size))
    return (nodes.values_at(count, corners) > 0.0).any(axis=1)

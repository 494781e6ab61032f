"""Material laws, loads, densities and supports that many problems have."""

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
from fenics_tfeti.fem.contact.descriptions.arguments import as_contacts
from fenics_tfeti.fem.contact.descriptions.contacts import Contact
from fenics_tfeti.fem.contact.descriptions.surfaces import surface_tags
from fenics_tfeti.fem.contact.descriptions.ties import Tie
from fenics_tfeti.fem.contact.surfaces.tagged import as_ufl_weight
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.fem.io.fields import with_third_direction
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import cell_type, find_tagged, owned_cells
from fenics_tfeti.fem.user_data import check_positive
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Mask, Numbers

# square of the change of C up to which the stress of a time step is that of the mean strain
_SMALL_CHANGE = 1e-12


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
    density = _neo_hookean(E, nu)

    def energy(u: Any) -> Any:
        F = _deformation(u)
        return density(ufl.inner(F, F) - u.ufl_shape[0], ufl.ln(ufl.det(F)))

    return energy


def neo_hookean_of_strain(E: Any, nu: Any) -> Callable[[Any], Any]:
    """Return the energy density of `neo_hookean` as a function of C = F'F.

    Parameters
    ----------
    E, nu : float or UFL expression
        Young's modulus [Pa] and Poisson's ratio.

    Returns
    -------
    callable
        Of the right Cauchy-Green tensor, 2 x 2 in plane strain, the energy per undeformed volume
        [J/m^3], as `EnergyMomentumStep` takes it.
    """
    density = _neo_hookean(E, nu)

    def energy(C: Any) -> Any:
        return density(ufl.tr(C) - C.ufl_shape[0], ufl.ln(ufl.det(C)) / 2)

    return energy


def _neo_hookean(E: Any, nu: Any) -> Callable[[Any, Any], Any]:
    """Return the energy density of `neo_hookean` as a function of tr C - dim and ln J."""
    mu, lmbda = _lame(E, nu)
    return lambda stretch, log: mu / 2 * stretch - mu * log + lmbda / 2 * log**2


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
        dim, F = u.ufl_shape[0], _deformation(u)
        left, J = F * F.T, ufl.det(F)
        left = with_third_direction(left, 1) if dim == 2 else left
        identity = ufl.Identity(3)
        return (mu * (left - identity) + lmbda * ufl.ln(J) * identity) / J

    return stress


def centrifugal_force(
    density: Any,
    speed: Any,
    x: Any,
    axis: Sequence[float] | None = None,
    center: Sequence[float] | None = None,
) -> Any:
    """Return the force on a body that turns steadily, seen from it: density speed^2 r [N/m^3].

    r points from the axis to x.

    Parameters
    ----------
    density : float or UFL expression
        Mass per volume [kg/m^3], at finite strains that of the undeformed body.
    speed : float or UFL expression
        The angular speed [rad/s].
    x : UFL expression
        Where the force acts: ``ufl.SpatialCoordinate(mesh)``, at finite strains that plus u.
    axis : sequence of float, optional
        The direction of the axis, of any length. By default z, in two dimensions across the plane;
        in axisymmetric problems it is (0, 1).
    center : sequence of float, optional
        A point of the axis [m], by default the origin.

    Returns
    -------
    UFL expression
        The vector, for `L` by its product with the test function.

    Raises
    ------
    InputError
        If `axis` or `center` has another number of components than x, or is no direction.

    Examples
    --------
    >>> force = centrifugal_force(7850.0, 314.0, x, axis=(0, 0, 1))  # doctest: +SKIP
    >>> L += ufl.inner(force, v) * ufl.dx  # doctest: +SKIP
    """
    (dim,) = x.ufl_shape
    a = np.zeros(dim) if axis is None else np.asarray(axis, dtype=float)
    if axis is None and dim == 3:
        a[2] = 1.0
    c = np.zeros(dim) if center is None else np.asarray(center, dtype=float)
    for name, value in (("axis", a), ("center", c)):
        if value.shape != (dim,) or not np.isfinite(value).all():
            raise InputError(
                f"centrifugal_force: {name} is {value.tolist()}; {dim} finite numbers are expected"
            )
    if axis is not None:
        if not (length := np.linalg.norm(a)) > 0.0:
            raise InputError(f"centrifugal_force: axis is {a.tolist()}, which is no direction")
        a /= length
    arm = x - ufl.as_vector(c.tolist())
    along = ufl.as_vector(a.tolist())
    return density * speed**2 * (arm - ufl.inner(arm, along) * along)


def pressure(p: Any, v: Any, measure: ufl.Measure) -> ufl.Form:
    """Return the load of a pressure on the undeformed surface, for small strains: -p N . v ds.

    At finite strains `follower_pressure` turns with the surface.

    Parameters
    ----------
    p : float or UFL expression
        The pressure [Pa], positive where it presses on the body.
    v : ufl.Argument
        The test function.
    measure : ufl.Measure
        The surface: ``ds`` with a tag.

    Returns
    -------
    ufl.Form
        The term to be added to `L`; in axisymmetric problems let p have the factor 2 pi r.

    Examples
    --------
    >>> L += pressure(2e5, v, ds(TOP))  # doctest: +SKIP
    """
    N = ufl.FacetNormal(v.ufl_function_space().ufl_domain())
    return -p * ufl.inner(N, v) * measure


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
    area = _cofactors(_deformation(u)) * N
    return p * weight * ufl.inner(area, ufl.TestFunction(space)) * measure


def _cofactors(G: Any) -> Any:
    """Return J G^-T as a polynomial in G, which rules of quadrature integrate exactly."""
    trace, identity = ufl.tr(G), ufl.Identity(G.ufl_shape[0])
    if G.ufl_shape[0] == 2:
        return trace * identity - G.T
    return (G * G).T - trace * G.T + (trace**2 - ufl.tr(G * G)) / 2 * identity


def nearly_incompressible_energy(E: Any, nu: Any, u: Any) -> ufl.Form:
    """Return the energy of `neo_hookean` with a reduced volumetric term, which does not lock.

    lambda/2 (ln J)^2 is integrated by fewer points than the rest (selective reduced integration):
    with displacements of degree 1 on quadrilaterals and hexahedra by one, with degree 2 on these by
    two in each direction, and on triangles and tetrahedra by one. On triangles and tetrahedra of
    degree 1 one point is full integration.

    Parameters
    ----------
    E, nu : float or UFL expression
        Young's modulus [Pa] and Poisson's ratio, such as 0.4999.
    u : Function
        The displacement [m].

    Returns
    -------
    ufl.Form
        The energy [J] of all cells, in two dimensions in plane strain.

    Raises
    ------
    InputError
        For triangles and tetrahedra of degree 1, which lock whatever the rule.

    Examples
    --------
    >>> energy = nearly_incompressible_energy(6e6, 0.4999, u)  # doctest: +SKIP
    >>> F = ufl.derivative(energy, u, v)  # doctest: +SKIP
    """
    if not isinstance(u, fem.Function):
        expected = "the displacement, a dolfinx.fem.Function,"
        raise wrong_type("nearly_incompressible_energy: u", u, expected)
    mesh, degree = u.function_space.mesh, _compat.element_facts(u.function_space)[1]
    is_simplex = cell_type(mesh).is_simplex
    if is_simplex and degree == 1:
        raise InputError(
            f"nearly_incompressible_energy: cells of the type {_compat.cell_name(mesh)} with "
            "displacements of degree 1 lock whatever the rule of quadrature: take displacements of "
            "degree 2 (displacement_space(mesh, degree=2)), or quadrilaterals or hexahedra"
        )
    mu, lmbda = _lame(E, nu)
    F = _deformation(u)
    log = ufl.ln(ufl.det(F))
    shear = mu / 2 * (ufl.inner(F, F) - F.ufl_shape[0]) - mu * log
    full, reduced = 2 * degree, 0 if is_simplex else 2 * degree - 2
    rules = [ufl.Measure("dx", mesh, metadata={"quadrature_degree": d}) for d in (full, reduced)]
    return shear * rules[0] + lmbda / 2 * log**2 * rules[1]


class EnergyMomentumStep:
    """Residual of a time step with inertia at finite strains, for `NonlinearContactProblem`.

    The step is that of Simo and Tarnow [1]_ with the stress of Gonzalez [2]_: from the displacement
    u0 and the velocity v at its begin to u at its end,

        2 rho (u - u0 - dt v) / dt^2 = Div((F0 + F1) / 2 S),

    where the difference of the energies at both ends is the work of S on (C1 - C0) / 2. Without
    loads and contact it keeps momentum, angular momentum and energy, for any `dt`. The mid-point
    rule is its limit for small steps. A dead load b is to be subtracted, ``inner(b, w) * dx``.

    Contact conditions hold at the end of a step, and contact forces act on the whole of it: planes
    give no energy to a body. What closing surfaces lose is the energy of their nodes' mass. Of
    pairs, the forces of mortar conditions are gradients of gaps in the limit of fine meshes.

    Cells without mass, as `redistributed_density` makes, have their stress at the end of the step.
    That takes energy from them, in proportion to `dt`; by the mid-point rule their nodes would
    oscillate from step to step, in contact more and more.

    Parameters
    ----------
    energy : callable
        Of the right Cauchy-Green tensor C = F'F, the energy per undeformed volume [J/m^3], such as
        `neo_hookean_of_strain`.
    u : Function
        The displacement of `NonlinearContactProblem`, at the end of the step [m].
    rho : float or UFL expression
        The density [kg/m^3], in contact better `redistributed_density`.
    dt : float or dolfinx.fem.Constant
        The time step [s], positive.
    dx : ufl.Measure, optional
        Of the undeformed cells; energies are those of its quadrature, by default of twice the
        degree of `u`.

    Attributes
    ----------
    F : ufl.Form
        The residual.
    u0, v : Function
        Displacement [m] and velocity [m/s] at the begin of the step; set them before the first.

    Raises
    ------
    InputError
        If an argument is of another kind, or `dt` is not positive.

    References
    ----------
    .. [1] J. C. Simo, N. Tarnow: The discrete energy-momentum method. Zeitschrift fuer angewandte
       Mathematik und Physik 43 (1992), 757-792.
    .. [2] O. Gonzalez: Exact energy and momentum conserving algorithms for general models in
       nonlinear elasticity. Computer Methods in Applied Mechanics and Engineering 190 (2000),
       1763-1783.

    Examples
    --------
    >>> step = EnergyMomentumStep(neo_hookean_of_strain(1e6, 0.4), u, rho, dt)  # doctest: +SKIP
    >>> problem = NonlinearContactProblem(step.F, u, contacts=contacts)  # doctest: +SKIP
    >>> for _ in range(100):  # doctest: +SKIP
    ...     problem.solve()
    ...     problem.advance()
    ...     step.advance()
    """

    def __init__(
        self,
        energy: Callable[[Any], Any],
        u: fem.Function,
        rho: Any,
        dt: float | fem.Constant,
        *,
        dx: ufl.Measure | None = None,
    ) -> None:
        if not callable(energy):
            raise wrong_type("EnergyMomentumStep: energy", energy, "a function of C = F'F")
        if not isinstance(u, fem.Function):
            expected = "the displacement, a dolfinx.fem.Function,"
            raise wrong_type("EnergyMomentumStep: u", u, expected)
        space = u.function_space
        if not isinstance(dt, fem.Constant):
            check_positive(dt, "EnergyMomentumStep: dt")
            dt = fem.Constant(space.mesh, float(dt))
        if dx is None:
            degree = 2 * _compat.element_facts(space)[1]
            dx = ufl.Measure("dx", domain=space.mesh, metadata={"quadrature_degree": degree})
        self.u, self.dt = u, dt
        self.u0, self.v = fem.Function(space), fem.Function(space)
        self.u0.x.array[:] = u.x.array
        w, (F0, F1) = ufl.TestFunction(space), (_deformation(f) for f in (self.u0, u))
        inertia = 2 * rho / dt**2 * (u - self.u0 - dt * self.v)
        # without mass a mid-point rule has equilibria that alternate from step to step
        later = ufl.conditional(ufl.gt(ufl.as_ufl(rho), 0.0), 0.0, 0.5)
        stress = (F0 + F1) / 2 * _stress_between(energy, F0.T * F0, F1.T * F1, later)
        self.F = (ufl.inner(inertia, w) + ufl.inner(stress, ufl.grad(w))) * dx
        with _compat.compiling():
            densities = (rho / 2 * ufl.inner(self.v, self.v), energy(F0.T * F0))
            self._energies = [fem.form(density * dx) for density in densities]

    def advance(self) -> None:
        """Take the end of the step, `u`, as the begin of the next one."""
        u0, v = self.u0.x.array, self.v.x.array
        v[:] = 2.0 / float(self.dt.value) * (self.u.x.array - u0) - v
        u0[:] = self.u.x.array

    def energies(self) -> tuple[float, float]:
        """Return kinetic and elastic energy at the begin of the step [J]. Collective."""
        comm = self.u.function_space.mesh.comm
        kinetic, elastic = (comm.allreduce(fem.assemble_scalar(e)) for e in self._energies)
        return float(kinetic), float(elastic)


def _deformation(u: Any) -> Any:
    """Return the deformation gradient."""
    return ufl.Identity(u.ufl_shape[0]) + ufl.grad(u)


def _stress_between(energy: Callable[[Any], Any], C0: Any, C1: Any, later: Any) -> Any:
    """Return the stress S whose work on (C1 - C0) / 2 is the difference of the energies.

    It is that of the mean strain, with the least change that makes it so, and a part of the
    stresses' difference: with a half it is that at the end.
    """
    stress, change = _second_stress(energy), C1 - C0
    mean, size = stress((C0 + C1) / 2), ufl.inner(change, change)
    lacking = 2 * (energy(C1) - energy(C0)) - ufl.inner(mean, change)
    # the work that lacks is cubic in the change, and rounding where that is small
    counts = ufl.gt(size, _SMALL_CHANGE)
    part = ufl.conditional(counts, lacking / ufl.conditional(counts, size, 1.0), 0.0)
    return mean + part * change + later * (stress(C1) - stress(C0))


def _second_stress(energy: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return the second Piola-Kirchhoff stress as a function of C."""

    def stress(C: Any) -> Any:
        C = ufl.variable(C)
        return 2 * ufl.sym(ufl.diff(energy(C), C))

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
    facets = [find_tagged(c.facet_tags, tag) for c in contacts for tag in surface_tags(c)]
    at_contact = [fem.locate_dofs_topological(space, facet, part) for part in facets]
    corners = nodes.to_global(_compat.cell_dofs(space)[: owned_cells(mesh)])
    first = _touching(nodes, nodes.to_global(np.concatenate([*at_contact, []])), corners)
    return first, _touching(nodes, corners[first].ravel(), corners) & ~first


def _touching(nodes: NodeMap, marked: Numbers, corners: Numbers) -> Mask:
    """Tell which cells have a corner among marked nodes of any rank. Collective."""
    count = nodes.reduce_at_owners(marked, np.ones(marked.size))
    return (nodes.values_at(count, corners) > 0.0).any(axis=1)

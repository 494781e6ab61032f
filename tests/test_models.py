"""Material laws and supports against formulas."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import integral, scalar_space

import ufl
from dolfinx import fem
from dolfinx.mesh import locate_entities_boundary, meshtags

from fenics_tfeti import ContactPair, ContactProblem, InputError, TiedPair
from fenics_tfeti.fem import _compat
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
from fenics_tfeti.models import (
    axisymmetric_strain,
    centrifugal_force,
    isotropic,
    neo_hookean,
    neo_hookean_stress,
    pressure,
    redistributed_density,
    symmetry_plane,
)

E, NU = 3.0, 0.3


def mean(expression, mesh):
    """Return the mean of a scalar on a mesh of volume 1."""
    dx = ufl.dx(metadata={"quadrature_degree": 2})
    return mesh.comm.allreduce(fem.assemble_scalar(fem.form(expression * dx)))


def unit_mesh(dim):
    """Return a mesh of the unit square or cube that begins at (1, 0, 0)."""
    begin = np.eye(dim)[0]
    kind = {2: "triangle", 3: "hexahedron"}[dim]
    return boxes(MPI.COMM_SELF, [Box(begin, begin + 1, dim * (2,))], kind).mesh


def stretched(mesh, gradient):
    """Return a displacement with a uniform gradient, as a row for each component."""
    gdim = mesh.geometry.dim
    u = fem.Function(displacement_space(mesh))
    u.interpolate(lambda x: gradient @ x[:gdim])
    return u


def components(stress, mesh):
    """Return the means of all components, by one form with a weight."""
    weight, found = fem.Constant(mesh, np.zeros(stress.ufl_shape)), np.zeros(stress.ufl_shape)
    form = fem.form(ufl.inner(stress, weight) * ufl.dx(metadata={"quadrature_degree": 2}))
    for place in np.ndindex(found.shape):
        weight.value[...] = 0.0
        weight.value[place] = 1.0
        found[place] = mesh.comm.allreduce(fem.assemble_scalar(form))
    return found


def hooke(e):
    """Return the strain of a stress by E e = (1 + nu) s - nu tr(s) I, solved for s."""
    mu = E / (2 * (1 + NU))
    return 2 * mu * e + E * NU / ((1 + NU) * (1 - 2 * NU)) * np.trace(e) * np.eye(len(e))


@pytest.mark.parametrize("number", [float, "constant"])
def test_uniaxial_stress_has_the_modulus_and_poissons_ratio(number):
    mesh = unit_mesh(3)
    modulus = fem.Constant(mesh, E) if number == "constant" else E
    u = stretched(mesh, 1e-3 * np.diag([1.0, -NU, -NU]))
    stress = components(isotropic(modulus, NU)(u), mesh)
    np.testing.assert_allclose(stress, 1e-3 * E * np.diag([1.0, 0, 0]), atol=1e-15)


@pytest.mark.parametrize("kind", ["number", "constant", "function"])
def test_arguments_that_are_exchanged(kind):
    mesh = unit_mesh(2)
    modulus = {"number": 7e4, "constant": fem.Constant(mesh, 7e4)}.get(kind)
    if kind == "function":
        modulus = fem.Function(scalar_space(mesh))
        modulus.x.array[:] = 7e4
    for law in (isotropic, neo_hookean):
        with pytest.raises(InputError, match="Poisson's ratio is 70000, .* argument before it"):
            law(NU, modulus)


def test_stress_is_symmetric_and_has_no_part_of_rotations():
    mesh = unit_mesh(3)
    gradient = np.array([[0.0, 2, 0], [0, 0, 0], [0, 0, 0]])
    shear = components(isotropic(E, NU)(stretched(mesh, gradient)), mesh)
    np.testing.assert_allclose(shear, E / (1 + NU) * 0.5 * (gradient + gradient.T), atol=1e-14)


def test_two_dimensions_are_plane_strain_and_with_other_numbers_plane_stress():
    mesh = unit_mesh(2)
    u = stretched(mesh, np.diag([1.0, -NU]))
    strain = np.diag([1.0, -NU, 0])
    plane_strain = components(isotropic(E, NU)(u), mesh)
    np.testing.assert_allclose(plane_strain, hooke(strain)[:2, :2], atol=1e-14)
    plane_stress = isotropic(E * (1 + 2 * NU) / (1 + NU) ** 2, NU / (1 + NU))
    np.testing.assert_allclose(components(plane_stress(u), mesh), np.diag([E, 0.0]), atol=1e-14)


def test_axisymmetric_stretch_has_a_hoop_strain():
    """The radius of each point grows by 1 %, so does its circumference."""
    mesh = unit_mesh(2)
    u = stretched(mesh, np.diag([0.01, 0.0]))
    stress = components(isotropic(E, NU, axisymmetric_strain)(u), mesh)
    np.testing.assert_allclose(stress, hooke(np.diag([0.01, 0.0, 0.01])), atol=1e-14)


@pytest.mark.parametrize("dim", [2, 3])
def test_neo_hookean_stress_does_the_work_that_is_stored(dim):
    """P = J s F^-T is the derivative of the energy with respect to the gradient, by differences."""
    mesh, rng = unit_mesh(dim), np.random.default_rng(5)
    gradient, direction = 0.3 * rng.random((dim, dim)), rng.random((dim, dim))
    stress = components(neo_hookean_stress(E, NU)(stretched(mesh, gradient)), mesh)
    F = np.eye(dim) + gradient
    P = np.linalg.det(F) * stress[:dim, :dim] @ np.linalg.inv(F).T
    near = [stretched(mesh, gradient + step * direction) for step in (1e-5, -1e-5)]
    energies = [mean(neo_hookean(E, NU)(u), mesh) for u in near]
    assert np.sum(P * direction) == pytest.approx((energies[0] - energies[1]) / 2e-5, rel=1e-7)


def test_neo_hookean_stress_across_the_plane_keeps_the_thickness():
    """The strain in two dimensions, as a body of three that is not stretched across."""
    gradient = np.array([[0.3, 0.1, 0], [-0.2, -0.1, 0], [0, 0, 0]])
    stresses = [
        components(neo_hookean_stress(E, NU)(stretched(mesh, gradient[:dim, :dim])), mesh)
        for dim, mesh in ((2, unit_mesh(2)), (3, unit_mesh(3)))
    ]
    np.testing.assert_allclose(*stresses, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_symmetry_plane_holds_the_normal_component_alone(axis):
    mesh = unit_mesh(3)
    V = displacement_space(mesh)
    place = mesh.geometry.x[:, axis].min()
    facets = np.sort(locate_entities_boundary(mesh, 2, lambda x: np.isclose(x[axis], place)))
    tags = meshtags(mesh, 2, facets, np.full(facets.size, 7, dtype=np.int32))
    dofs, prescribed = _compat.bc_values(
        symmetry_plane(V, tags, 7, axis), V.dofmap.index_map.size_local * 3
    )
    x = V.tabulate_dof_coordinates()
    expected = 3 * np.flatnonzero(np.isclose(x[:, axis], place)) + axis
    np.testing.assert_array_equal(np.sort(dofs), expected)
    assert not prescribed.any()
    with pytest.raises(InputError, match=r"axis is 3; the axes are \[0, 1, 2\]"):
        symmetry_plane(V, tags, 7, 3)


def two_boxes(comm, first):
    """Return two boxes beside each other, the first with some cells along x, and their contact."""
    bodies = boxes(comm, [Box((0, 0), (1, 1), (first, 3)), Box((1, 0), (2, 1), (5, 4))], "triangle")
    sides = [(body, lambda x: np.isclose(x[0], 1), body) for body in (1, 2)]
    sides += [(body + 2, lambda x: np.isclose(x[1], 1), body) for body in (1, 2)]
    return bodies, [ContactPair(tag_facets(bodies.mesh, sides, bodies.cell_tags), 1, 2)]


@pytest.mark.ranks
def test_redistributed_density():
    """The same mass of each body, none at nodes in the contact, and no other cells changed."""
    bodies, contacts = two_boxes(MPI.COMM_WORLD, 4)
    mesh = bodies.mesh
    r = ufl.SpatialCoordinate(mesh)[1]
    share = fem.Constant(mesh, 1.0)
    distance = abs(ufl.SpatialCoordinate(mesh)[0] - 1)
    for weight in (1.0, 2 * ufl.pi * r):
        tied = [TiedPair(contacts[0].facet_tags, 3, 4)]
        density = redistributed_density(mesh, 3.0 + 0 * r, contacts + tied, weight)
        for body in (1, 2):
            masses = []
            for share.value in (1.0, 0.0):
                mass = (share * density + (1.0 - share) * 3.0) * weight
                masses.append(integral(mesh, bodies.cell_tags, body, "dx", mass))
            assert masses[0] == pytest.approx(masses[1], rel=1e-12)
        nothing = ufl.conditional(distance < 0.2, abs(density), 0)
        nothing += ufl.conditional(distance > 0.5, (density - 3) ** 2, 0)
        total = mesh.comm.allreduce(fem.assemble_scalar(fem.form(nothing * ufl.dx(degree=0))))
        assert total < 1e-20


@pytest.mark.ranks
def test_no_cells_for_the_mass_of_those_at_the_contact():
    bodies, contacts = two_boxes(MPI.COMM_WORLD, 1)
    with pytest.raises(InputError, match=r"body 0 in \[0, 1\] x \[0, 1\]: all cells touch contact"):
        redistributed_density(bodies.mesh, 1.0, contacts)


def test_densities_and_weights_that_are_vectors():
    bodies, contacts = two_boxes(MPI.COMM_SELF, 4)
    vector = ufl.as_vector([1.0, 2.0])
    for rho in (vector, [1.0, 2.0]):
        with pytest.raises(InputError, match=r"rho has shape \(2,\); a scalar is expected"):
            redistributed_density(bodies.mesh, rho, contacts)
    with pytest.raises(InputError, match=r"measure_weight has shape \(2,\); a scalar"):
        redistributed_density(bodies.mesh, 1.0, contacts, vector)


@pytest.mark.parametrize(
    ("dim", "arguments", "expected"),
    [
        (2, {}, (1.5, 0.5)),
        (2, {"center": (1, 2)}, (0.5, -1.5)),
        (2, {"axis": (0, 3)}, (1.5, 0.0)),
        (3, {}, (1.5, 0.5, 0.0)),
        (3, {"axis": (0, -2, 0), "center": (1, 7, 0)}, (0.5, 0.0, 0.5)),
        (3, {"axis": (1, 1, 0)}, (0.5, -0.5, 0.5)),
    ],
)
def test_centrifugal_force_points_away_from_the_axis(dim, arguments, expected):
    """Its mean is that at the middle (1.5, 0.5, 0.5)."""
    mesh = unit_mesh(dim)
    force = centrifugal_force(2.0, 3.0, ufl.SpatialCoordinate(mesh), **arguments)
    np.testing.assert_allclose(components(force, mesh), 18 * np.array(expected), atol=1e-13)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"axis": (0, 0)}, r"axis is \[0.0, 0.0\], which is no direction"),
        ({"axis": (0, 0, 1)}, "axis is .*; 2 finite numbers"),
        ({"center": (0, np.nan)}, "center is .*; 2 finite numbers"),
    ],
)
def test_axes_of_no_use(arguments, message):
    x = ufl.SpatialCoordinate(unit_mesh(2))
    with pytest.raises(InputError, match=f"centrifugal_force: {message}"):
        centrifugal_force(1.0, 1.0, x, **arguments)


A, B = 1.0, 2.0  # radii of a long tube


def of_lame(r):
    """Return the radial displacement by a pressure of 7e-4 within the tube (plane strain)."""
    return 7e-4 * A**2 / (B**2 - A**2) * (1 + NU) / E * ((1 - 2 * NU) * r + B**2 / r)


def of_rotation(r):
    """Return that by a density of 5e-4 and a speed of 1.2: a disc's, for plane strain."""
    E1, nu = E / (1 - NU**2), NU / (1 - NU)
    inner = A**2 + B**2 + (1 + nu) / (1 - nu) * (A * B / r) ** 2 - (1 + nu) / (3 + nu) * r**2
    return 5e-4 * 1.2**2 * (3 + nu) * (1 - nu) / (8 * E1) * r * inner


@pytest.mark.parametrize("exact", [of_lame, of_rotation])
def test_loads_of_a_tube(exact):
    made = boxes(MPI.COMM_SELF, [Box((A, 0), (B, 0.1), (24, 1))], "quadrilateral")
    at = {1: (0, A), 2: (1, 0.0), 3: (1, 0.1)}
    tags = tag_facets(
        made.mesh, {k: lambda x, i=i, c=c: np.isclose(x[i], c) for k, (i, c) in at.items()}
    )
    V = displacement_space(made.mesh, degree=2)
    u, v, x = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.SpatialCoordinate(made.mesh)
    a = ufl.inner(isotropic(E, NU, axisymmetric_strain)(u), axisymmetric_strain(v)) * x[0] * ufl.dx
    inside = ufl.Measure("ds", domain=made.mesh, subdomain_data=tags)(1)
    L = pressure(7e-4 * x[0], v, inside)
    if exact is of_rotation:
        L = ufl.inner(centrifugal_force(5e-4, 1.2, x, axis=(0, 1)), v) * x[0] * ufl.dx
    held = [symmetry_plane(V, tags, tag, 1) for tag in (2, 3)]
    found = ContactProblem(a, L, bcs=held, contacts=[], options={"rtol": 1e-10}).solve()
    r, displacement = V.tabulate_dof_coordinates()[:, 0], found.x.array.reshape(-1, 2)[:, 0]
    np.testing.assert_allclose(displacement, exact(r), rtol=2e-6)

"""Forms: which integrals, coefficients and tags they may have, and what bound forms integrate."""

from petsc4py import PETSc

import numpy as np
import pytest
from box_rows import BOTTOM, INSIDE, LEFT, assemble, row_of_boxes
from scenes import YOUNG, elasticity, scalar_space

import ufl
from dolfinx import fem, mesh
from dolfinx.fem import petsc

from fenics_tfeti import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.forms import prepare_form
from fenics_tfeti.fem.topology import exterior_cell_facets


def prepared(row, form):
    return prepare_form(row.mesh, form, "form", exterior_cell_facets(row.mesh))


def stiffness(row, factor=1.0):
    u, v = ufl.TrialFunction(row.V), ufl.TestFunction(row.V)
    return elasticity(u, v, YOUNG * factor, row.dx)


@pytest.mark.parametrize("kind", ["dx", "ds"])
def test_everywhere_and_on_tags(kind):
    row = row_of_boxes()
    v, one = ufl.TestFunction(row.V), fem.Constant(row.mesh, 1.0)
    near = row.cells_near(INSIDE)
    cells = mesh.meshtags(row.mesh, 2, near, np.full(near.size, LEFT, "i4"))
    measure = {"dx": ufl.Measure("dx", row.mesh, subdomain_data=cells), "ds": row.ds}[kind]
    L = one * v[0] * measure + 10 * one * v[0] * measure(LEFT)
    total = sum(s.load.sum() for s in assemble(row, stiffness(row), L))
    whole, tagged = {"dx": (4.0, near.size / 9), "ds": (10.0, 1.0)}[kind]
    assert total == pytest.approx(whole + 10 * tagged)


@pytest.mark.parametrize(
    ("term", "compiled_once"),
    [
        (lambda u, v, w, k: 2 * k * ufl.inner(ufl.sym(ufl.grad(u)), ufl.grad(v)), True),
        (lambda u, v, w, k: ufl.conditional(ufl.gt(w[0], k), 0.7, k * w[1]) * u[0] * v[1], True),
        (lambda u, v, w, k: ufl.derivative(ufl.exp(k * w[0]) * w[1] * v[0], w, u), True),
        (lambda u, v, w, k: abs(w[0]) ** k * ufl.dot(u, v), False),
    ],
    ids=["modulus", "condition", "derivative", "exponent"],
)
def test_forms_that_differ_in_a_number_are_compiled_once(term, compiled_once):
    """A number that a form is scaled with is a constant of the code; an exponent is part of it."""
    row = row_of_boxes()
    u, v, w = ufl.TrialFunction(row.V), ufl.TestFunction(row.V), fem.Function(row.V)
    w.interpolate(lambda x: x[:2])
    y = np.random.default_rng(0).standard_normal(w.x.array.size)
    of_cells = y.reshape(-1, 2)[_compat.cell_dofs(row.V)].reshape(-1, 8)
    forms = [term(u, v, w, k) * ufl.dx for k in (1.5, 2.5)]
    one, other = (prepared(row, form) for form in forms)
    K = other.element_tensors(row.mesh, 8, np.arange(len(of_cells)))
    A = petsc.assemble_matrix(fem.form(forms[1]))
    A.assemble()
    product = A * PETSc.Vec().createWithArray(y, comm=row.mesh.comm)
    assert np.einsum("ij,ijk,ik", of_cells, K, of_cells) == pytest.approx(product.array @ y)
    kernels = [form.compiled[0].integrals[0][2] for form in (one, other)]
    assert (kernels[0] == kernels[1]) is compiled_once


@pytest.mark.parametrize("kind", ["residual", "tangent", "load", "load on tags"])
def test_terms_with_other_quadrature_rules_add_up(kind):
    """FFCx 0.5 takes values at points of one rule for others where it compiles them together."""
    row = row_of_boxes()
    w, v, u = fem.Function(row.V), ufl.TestFunction(row.V), ufl.TrialFunction(row.V)
    w.interpolate(lambda x: 0.1 * np.sin(x[:2] + x[1]))
    F = ufl.Identity(2) + ufl.grad(w)
    C, factor = F.T * F, fem.Function(scalar_space(row.mesh, "DG", 0))
    factor.x.array[:] = 1.0 + np.arange(factor.x.array.size)
    densities = {3: factor * ufl.inner(C, C), 0: factor * (ufl.det(F) - 1) ** 2}
    measure = {"load": row.ds, "load on tags": row.ds((BOTTOM, LEFT))}.get(kind, row.dx)
    terms = [
        ufl.derivative(density * measure(metadata={"quadrature_degree": degree}), w, v)
        for degree, density in densities.items()
    ]
    if kind == "tangent":
        # that of the load vanishes, and has a third rule
        terms = [ufl.derivative(term, w, u) for term in (*terms, v[0] * row.dx)]
    cells = np.arange(row.mesh.topology.index_map(2).size_local)
    apart = sum(prepared(row, term).element_tensors(row.mesh, 8, cells) for term in terms)
    together = prepared(row, sum(terms[1:], terms[0])).element_tensors(row.mesh, 8, cells)
    np.testing.assert_allclose(together, apart, rtol=0, atol=1e-13 * np.abs(apart).max())


@pytest.mark.parametrize(
    ("quantity", "expected"),
    [
        (lambda domain: 1.0, True),
        (lambda domain: ufl.JacobianDeterminant(domain), True),
        (lambda domain: ufl.SpatialCoordinate(domain)[0], False),
    ],
    ids=["constant", "JacobianDeterminant", "SpatialCoordinate"],
)
def test_forms_without_coordinates_are_translation_invariant(quantity, expected):
    row = row_of_boxes()
    form = prepared(row, stiffness(row, quantity(row.mesh)))
    assert form.translation_invariant is expected


def test_integrals_over_interior_facets_are_refused():
    row = row_of_boxes()
    u, v = ufl.TrialFunction(row.V), ufl.TestFunction(row.V)
    jump = ufl.inner(ufl.jump(u), ufl.jump(v)) * ufl.Measure("dS", domain=row.mesh)
    with pytest.raises(InputError, match="interior_facet; only dx and ds are supported"):
        prepared(row, stiffness(row) + jump)


@pytest.mark.parametrize(
    ("tags", "total"), [((BOTTOM, LEFT), 5.0), ((LEFT,), 1.0), ("everywhere", 10.0)]
)
def test_loads_on_tags(tags, total):
    row = row_of_boxes()
    v, one = ufl.TestFunction(row.V), fem.Constant(row.mesh, 1.0)
    loads = assemble(row, stiffness(row), one * v[0] * row.ds(tags))
    assert sum(s.load.sum() for s in loads) == pytest.approx(total)


def test_tags_without_subdomain_data_are_refused():
    row = row_of_boxes()
    u, v = ufl.TrialFunction(row.V), ufl.TestFunction(row.V)
    with pytest.raises(InputError, match=r"has dx\(3\), but the measure has no mesh tags"):
        prepared(row, elasticity(u, v, YOUNG, row.dx(3)))


def test_cell_tags_for_an_integral_over_facets_are_refused():
    row = row_of_boxes()
    v = ufl.TestFunction(row.V)
    cells = mesh.meshtags(row.mesh, 2, np.arange(3, dtype="i4"), np.full(3, 1, "i4"))
    ds = ufl.Measure("ds", row.mesh, subdomain_data=cells)
    with pytest.raises(InputError, match="tags entities of dimension 2, expected 1"):
        prepared(row, fem.Constant(row.mesh, 1.0) * v[0] * ds(1))


def test_coefficient_of_another_mesh_is_refused():
    row, other = row_of_boxes(), row_of_boxes()
    factor = fem.Function(scalar_space(other.mesh, "DG", 0), name="modulus")
    with pytest.raises(InputError) as raised:
        prepared(row, stiffness(row, factor))
    assert "modulus" in str(raised.value) and "another mesh" in str(raised.value)


def test_coefficient_of_degree_three_is_refused():
    row = row_of_boxes()
    factor = fem.Function(scalar_space(row.mesh, "Lagrange", 3), name="modulus")
    with pytest.raises(InputError, match=r"modulus.* Lagrange of degree 3"):
        prepared(row, stiffness(row, factor))

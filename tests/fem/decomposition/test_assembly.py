"""K_i and f_i are those of dolfinx on the subdomain's cells, also where subdomains share one."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

from petsc4py import PETSc

import numpy as np
import pytest
from box_rows import BOTTOM, INSIDE, LEFT, Row, assemble, row_of_boxes
from scenes import CELLS, YOUNG, elasticity, scalar_space, two_materials

import ufl
from dolfinx import fem, mesh
from dolfinx.fem import petsc as fem_petsc

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.assembly import prepare_forms, same_values
from fenics_tfeti.fem.topology import cell_facets

COMM = MPI.COMM_WORLD


def over(row: Row, cells: Any) -> Any:
    """Return the measure of some cells, by a tag, so that all tests share their compiled forms."""
    domain, cells = row.mesh, np.sort(cells)
    ones = np.ones(cells.size, dtype="i4")
    tags = mesh.meshtags(domain, domain.topology.dim, cells, ones)
    return ufl.Measure("dx", domain, subdomain_data=tags)(1)


def whole(row: Row) -> tuple[Any, Any]:
    """Return the measures of all cells and of the tagged facets."""
    return over(row, np.arange(row.middle.size, dtype="i4")), row.ds


def alone(row: Row, part: Any, form: Any) -> Any:
    """Assemble a form by dolfinx on the whole mesh, integrated over the part's own cells."""
    domain, dim = row.mesh, row.mesh.topology.dim
    own = np.isin(row.facet_tags.indices, cell_facets(domain)[part.cells])
    facets = row.facet_tags.indices[own], row.facet_tags.values[own]
    ds = ufl.Measure("ds", domain, subdomain_data=mesh.meshtags(domain, dim - 1, *facets))
    gdim = domain.geometry.dim
    dofs = gdim * part.nodes[:, None] + np.arange(gdim)
    compiled = fem.form(form(over(row, part.cells), ds))
    if compiled.rank == 1:
        return fem.assemble_vector(compiled).array[dofs.ravel()]
    A = fem_petsc.assemble_matrix(compiled)
    A.assemble()
    dense = A.getValues(range(A.size[0]), range(A.size[1]))
    return dense[np.ix_(dofs.ravel(), dofs.ravel())]


def shared(subdomains: list[Any]) -> list[int]:
    """Return for each subdomain the first one that has its matrix."""
    matrices = [id(s.stiffness) for s in subdomains]
    return [matrices.index(matrix) for matrix in matrices]


# -- forms: what the mesh, its coefficients and its tags make of them ----------------------------


def uniform(row: Row) -> Any:
    u, v = ufl.TrialFunction(row.V), ufl.TestFunction(row.V)
    young = fem.Constant(row.mesh, YOUNG)
    return lambda dx, ds: elasticity(u, v, young, dx)


def moved_node(distance: float) -> Any:
    def change(row: Row) -> Any:
        x = row.mesh.geometry.x
        inside = np.argmin(np.linalg.norm(x[:, :2] - (0.1 + INSIDE + 1 / 6, 0.1 + 1 / 3), axis=1))
        x[inside, 0] += distance
        return uniform(row)

    return change


def other_coefficient(family: str, degree: int) -> Any:
    def change(row: Row) -> Any:
        young = fem.Function(scalar_space(row.mesh, family, degree))
        young.x.array[:] = YOUNG
        dofs = _compat.cell_dofs(young.function_space)
        young.x.array[dofs[row.cells_near(INSIDE)[0], -1]] *= 1.0 + 1e-13
        u, v = ufl.TrialFunction(row.V), ufl.TestFunction(row.V)
        return lambda dx, ds: elasticity(u, v, young, dx)

    return change


def material_that_repeats(row: Row) -> Any:
    young = fem.Function(scalar_space(row.mesh, "DG", 0))
    young.x.array[:] = np.where(np.floor(row.middle) % 2 == 0, YOUNG, 2 * YOUNG)
    u, v = ufl.TrialFunction(row.V), ufl.TestFunction(row.V)
    return lambda dx, ds: elasticity(u, v, young, dx)


def graded_by_place(row: Row) -> Any:
    x = ufl.SpatialCoordinate(row.mesh)
    u, v = ufl.TrialFunction(row.V), ufl.TestFunction(row.V)
    young, far = (fem.Constant(row.mesh, value) for value in (YOUNG, 1.0))
    return lambda dx, ds: elasticity(u, v, young * (far + x[0]), dx)


def spring(tag: int) -> Any:
    def change(row: Row) -> Any:
        u, v = ufl.TrialFunction(row.V), ufl.TestFunction(row.V)
        bulk, stiffness = uniform(row), fem.Constant(row.mesh, YOUNG)
        return lambda dx, ds: bulk(dx, ds) + stiffness * ufl.inner(u, v) * ds(tag)

    return change


def springs_along_the_normal(row: Row) -> Any:
    u, v, n = ufl.TrialFunction(row.V), ufl.TestFunction(row.V), ufl.FacetNormal(row.mesh)
    bulk, stiffness = uniform(row), fem.Constant(row.mesh, YOUNG)
    return lambda dx, ds: bulk(dx, ds) + stiffness * ufl.dot(u, n) * ufl.dot(v, n) * ds(LEFT)


EQUAL, SECOND_DIFFERS, NONE = [0, 0, 0, 0], [0, 1, 0, 0], [0, 1, 2, 3]
FORMS = {
    "uniform": (uniform, EQUAL),
    "a moved node": (moved_node(1e-2), SECOND_DIFFERS),
    "a node moved by little": (moved_node(1e-12), SECOND_DIFFERS),
    "a node moved by rounding": (moved_node(1e-15), EQUAL),
    "DG0 in one cell": (other_coefficient("DG", 0), SECOND_DIFFERS),
    "P2 at one node": (other_coefficient("Lagrange", 2), SECOND_DIFFERS),
    "materials in turn": (material_that_repeats, [0, 1, 0, 1]),
    "SpatialCoordinate": (graded_by_place, NONE),
    "springs below all": (spring(BOTTOM), EQUAL),
    "springs at the left": (spring(LEFT), [0, 1, 1, 1]),
    "along the normal": (springs_along_the_normal, [0, 1, 1, 1]),
}


@pytest.mark.parametrize("name", FORMS)
def test_who_shares(name):
    change, expected = FORMS[name]
    row = row_of_boxes()
    form = change(row)
    assert shared(assemble(row, form(*whole(row)))) == expected


@pytest.mark.parametrize("name", FORMS)
def test_each_is_what_dolfinx_assembles_there(name):
    row = row_of_boxes()
    form = FORMS[name][0](row)
    for part, subdomain in zip(row.parts, assemble(row, form(*whole(row))), strict=True):
        expected = alone(row, part, form)
        np.testing.assert_allclose(
            subdomain.stiffness.toarray(), expected, rtol=0, atol=1e-13 * np.abs(expected).max()
        )


@pytest.mark.parametrize("cell", CELLS)
def test_every_cell_is_shared(cell):
    row = row_of_boxes(cell)
    form = uniform(row)
    subdomains = assemble(row, form(*whole(row)))
    assert shared(subdomains) == EQUAL
    expected = alone(row, row.parts[2], form)
    np.testing.assert_allclose(
        subdomains[2].stiffness.toarray(), expected, rtol=0, atol=1e-13 * np.abs(expected).max()
    )


def test_far_from_the_origin():
    row = row_of_boxes(far=1234.1)
    assert shared(assemble(row, uniform(row)(*whole(row)))) == EQUAL


def test_loads_are_each_one_s_own():
    row = row_of_boxes()
    v, x = ufl.TestFunction(row.V), ufl.SpatialCoordinate(row.mesh)

    def load(dx: Any, ds: Any) -> Any:
        return x[0] * v[1] * dx + x[1] * v[0] * ds(LEFT)

    subdomains = assemble(row, uniform(row)(*whole(row)), load(*whole(row)))
    assert shared(subdomains) == EQUAL
    for part, subdomain in zip(row.parts, subdomains, strict=True):
        np.testing.assert_allclose(subdomain.load, alone(row, part, load), rtol=0, atol=1e-13)


def test_coordinates_and_nodes_are_each_one_s_own():
    row = row_of_boxes()
    places = row.V.tabulate_dof_coordinates()[:, :2]
    for subdomain in assemble(row, uniform(row)(*whole(row))):
        np.testing.assert_array_equal(subdomain.coordinates, places[subdomain.nodes])


def test_new_loads_on_known_subdomains():
    row = row_of_boxes()
    v, load = ufl.TestFunction(row.V), fem.Constant(row.mesh, 1.0)
    forms = prepare_forms(row.V, uniform(row)(*whole(row)), load * v[0] * row.dx)
    known = forms.subdomains(row.parts)
    load.value = 3.0
    again = forms.subdomains(row.parts, known)
    assert [s.stiffness for s in again] == [s.stiffness for s in known]
    for new, old in zip(again, known, strict=True):
        np.testing.assert_allclose(new.load, 3.0 * old.load, rtol=1e-15)


def test_changed_constants_are_noticed():
    row = row_of_boxes()
    v, load = ufl.TestFunction(row.V), fem.Constant(row.mesh, 1.0)
    forms = prepare_forms(row.V, uniform(row)(*whole(row)), load * v[0] * row.dx)
    before = forms.values()
    load.value = 3.0
    now = forms.values()
    assert same_values(before[0], now[0], row.mesh.comm)
    assert not same_values(before[1], now[1], row.mesh.comm)


@pytest.mark.ranks(2)
@pytest.mark.parametrize(
    ("cell", "place"),
    [("hexahedron", "tagged"), ("triangle", "anywhere"), ("hexahedron", "in space")],
)
def test_energy_and_work(cell, place):
    scene = two_materials(COMM, cell, 4)
    domain, V = scene.mesh, scene.V
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    if place != "tagged":
        young = fem.Function(scalar_space(domain, "DG", 0))
        young.x.array[:] = 1.0
        x = ufl.SpatialCoordinate(domain)
        scene.a = elasticity(u, v, young * (1.0 + x[0]) if place == "in space" else young)
        scene.L = x[1] * v[0] * ufl.dx(domain=domain)
    owned = domain.topology.index_map(domain.topology.dim).size_local
    middles = domain.geometry.x[_compat.geometry_cells(domain)[:owned]].mean(axis=1)
    cubes = np.floor(2 * middles).astype(int) @ (1, 10, 100)
    problem = scene.problem(subdomains=cubes)
    subdomains = problem.system.subdomains

    moved = fem.Function(V)
    gdim = domain.geometry.dim
    moved.interpolate(lambda x: np.sin(3 * x[:gdim] + x[0] ** 2))
    to_global = V.dofmap.index_map.local_to_global
    values = moved.x.array.reshape(-1, gdim)
    local = {int(n): k for k, n in enumerate(to_global(np.arange(len(values), dtype=np.int32)))}
    torn = [values[[local[n] for n in s.nodes]].ravel() for s in subdomains]
    ours = COMM.allreduce(
        np.array(
            [
                sum(x @ (s.stiffness @ x) for x, s in zip(torn, subdomains, strict=True)),
                sum(x @ s.load for x, s in zip(torn, subdomains, strict=True)),
            ]
        )
    )

    A = fem_petsc.assemble_matrix(fem.form(scene.a))
    A.assemble()
    x = A.createVecRight()
    x.array_w[:] = moved.x.array[: x.getLocalSize()]
    b = fem_petsc.assemble_vector(fem.form(scene.L))
    b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    np.testing.assert_allclose(ours, [x.dot(A * x), x.dot(b)], rtol=1e-12)


@pytest.mark.ranks(2)
@pytest.mark.parametrize(("cell", "shapes"), [("quadrilateral", 1), ("tetrahedron", 6)])
def test_cells_of_few_shapes_have_few_matrices(cell, shapes):
    """Each cell is a subdomain."""
    scene = two_materials(COMM, cell, 4)
    domain, V = scene.mesh, scene.V
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    owned = domain.topology.index_map(domain.topology.dim).size_local
    young = fem.Constant(domain, 1.0)
    scene.a = elasticity(u, v, young)
    problem = scene.problem(subdomains=np.arange(owned))
    different = len({id(s.stiffness) for s in problem.system.subdomains})
    assert different <= shapes

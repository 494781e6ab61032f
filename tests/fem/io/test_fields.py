"""The von Mises stress, and files for ParaView that keep every field under its name."""

import sys
from subprocess import run
from xml.etree import ElementTree

from mpi4py import MPI

import numpy as np
import pytest
from mortar_blocks import LOWER, UPPER, Blocks, solved
from scenes import (
    CELLS,
    MASTER,
    SLAVE,
    dimension,
    elasticity,
    normal_forces,
    pressed_block,
    two_beams,
)

import dolfinx
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType, GhostMode, create_unit_cube, locate_entities, meshtags

from fenics_tfeti import ContactPair, Mortar, Nearest
from fenics_tfeti.errors import InputError
from fenics_tfeti.io import Box, boxes, contact_fields, piecewise_constant, von_mises, write_fields

# Reads a file in a process of its own: on Debian 12 VTK does not work in one that used dolfinx.
READ = """
import sys
import pyvista
grid = pyvista.read(sys.argv[1])[0]
print(grid.n_points, grid.n_cells)
for name, values in [*grid.point_data.items(), *grid.cell_data.items()]:
    if not name.startswith("vtk"):
        print(name, values.size, values.max(), sep=",")
"""


def space(mesh, family, degree, shape=()):
    """Return a function space in either version of dolfinx."""
    if hasattr(fem, "functionspace"):
        return fem.functionspace(mesh, (family, degree, shape))
    if shape:
        return fem.VectorFunctionSpace(mesh, (family, degree))
    return fem.FunctionSpace(mesh, (family, degree))


def unit_mesh(cell):
    """Return a mesh of two grid blocks of the unit square or cube."""
    gdim = dimension(cell)
    return boxes(MPI.COMM_SELF, [Box([0] * gdim, [1] * gdim, [2, 1, 1][:gdim])], cell).mesh


@pytest.fixture
def fields():
    """Return a vector and a scalar of degree 1 and a scalar of degree 0, 12 nodes and 2 cells."""
    mesh = unit_mesh("hexahedron")
    displacement = fem.Function(space(mesh, "Lagrange", 1, (3,)), name="displacement")
    pressure = fem.Function(space(mesh, "Lagrange", 1), name="contact pressure")
    body = fem.Function(space(mesh, "DG", 0), name="body")
    displacement.x.array[:] = 4
    pressure.x.array[:] = 5
    body.x.array[:] = 6
    return [displacement, pressure, body]


@pytest.mark.ranks
def test_piecewise_constant_has_the_value_of_each_tag():
    """In all cells of a rank, also in ghosts; a tag without a value is an error on all ranks."""
    shared_facet = GhostMode.shared_facet
    mesh = create_unit_cube(MPI.COMM_WORLD, 4, 4, 4, CellType.hexahedron, ghost_mode=shared_facet)
    cells = mesh.topology.index_map(3)
    assert cells.num_ghosts or mesh.comm.size == 1
    tags = np.ones(cells.size_local + cells.num_ghosts, dtype=np.int32)
    tags[locate_entities(mesh, 3, lambda x: x[2] > 0.4)] = 2
    cell_tags = meshtags(mesh, 3, np.arange(tags.size, dtype=np.int32), tags)
    E = piecewise_constant(mesh, cell_tags, {1: 3.0, 2: 5.0})
    z = E.function_space.tabulate_dof_coordinates()[:, 2]
    np.testing.assert_array_equal(E.x.array, np.where(z < 0.5, 3.0, 5.0))
    with pytest.raises(InputError, match=r"tags \[2\] have no value; .* for the tags \[1, 7\]"):
        piecewise_constant(mesh, cell_tags, {7: 1.0, 1: 3.0})


@pytest.mark.parametrize("cell", ["tetrahedron", "hexahedron"])
@pytest.mark.parametrize(
    ("stress", "expected"),
    [
        (np.diag([3, 0, 0]), 3),  # tension
        (np.diag([-7, -7, -7]), 0),  # pressure
        ([[0, 2, 0], [2, 0, 0], [0, 0, 0]], 2 * np.sqrt(3)),  # shear
    ],
)
def test_stress_states_have_their_von_mises_stress(cell, stress, expected):
    mesh = unit_mesh(cell)
    result = von_mises(mesh, fem.Constant(mesh, np.asarray(stress, dtype=float)))
    assert result.x.array == pytest.approx(expected, abs=1e-14)


def test_von_mises_stress_is_one_number_for_each_cell():
    mesh = unit_mesh("hexahedron")
    x = ufl.SpatialCoordinate(mesh)
    result = von_mises(mesh, x[0] * ufl.diag(ufl.as_vector([1.0, 0.0, 0.0])))
    assert result.name == "von_mises_stress"
    assert sorted(result.x.array) == pytest.approx([1 / 4, 3 / 4])  # at the centres


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
@pytest.mark.parametrize(
    ("poisson_ratio", "expected"), [(0.0, 3), (0.5, 3 * np.sqrt(3) / 2), (0.3, 3 * np.sqrt(0.79))]
)
def test_plane_stress_and_strain(cell, poisson_ratio, expected):
    mesh = unit_mesh(cell)
    tension = fem.Constant(mesh, np.diag([3.0, 0.0]))
    result = von_mises(mesh, tension, poisson_ratio)
    assert result.x.array == pytest.approx(expected)


def test_whole_tensor_on_a_plane_mesh():
    mesh = unit_mesh("triangle")
    tension = fem.Constant(mesh, np.diag([3.0, 0.0, 0.0]))
    assert von_mises(mesh, tension).x.array == pytest.approx(3)


def test_plane_tensor_without_poisson_ratio_is_refused():
    with pytest.raises(InputError, match="pass poisson_ratio"):
        von_mises(unit_mesh("triangle"), ufl.Identity(2))


def test_vector_is_no_stress():
    with pytest.raises(InputError, match=r"shape \(3,\); a tensor of shape"):
        von_mises(unit_mesh("hexahedron"), ufl.as_vector([1.0, 2.0, 3.0]))


def test_paraview_finds_each_field_once_under_its_name(fields, tmp_path):
    pytest.importorskip("vtkmodules")
    path = tmp_path / "new folder" / "result.pvd"
    write_fields(path, fields)
    answer = run([sys.executable, "-c", READ, str(path)], capture_output=True, text=True)
    assert answer.stdout.splitlines() == [
        "12 2", "displacement,36,4.0", "contact pressure,12,5.0", "body,2,6.0",
    ]  # fmt: skip


@pytest.mark.parametrize("cell", CELLS)
def test_mesh_is_written_once_however_many_fields(cell, tmp_path):
    mesh = unit_mesh(cell)
    fields = [fem.Function(space(mesh, "Lagrange", 1), name=name) for name in "abc"]
    fields.append(fem.Function(space(mesh, "Lagrange", 1, (mesh.geometry.dim,)), name="u"))
    write_fields(tmp_path / "result.pvd", fields)
    pieces = ElementTree.parse(tmp_path / "result000000.pvtu").findall(".//Piece")
    assert len(pieces) == 1


def renamed(field, name):
    field.name = name
    return field


def on_another_mesh():
    mesh = dolfinx.mesh.create_unit_cube(MPI.COMM_SELF, 1, 1, 1)
    return fem.Function(space(mesh, "DG", 0), name="other")


def cubic(field):
    return fem.Function(space(field.function_space.mesh, "Lagrange", 3), name="cubic")


@pytest.mark.parametrize(
    ("message", "file", "change"),
    [
        ("does not end in .pvd", "a.vtk", lambda u, p, s: [u]),
        ("no fields", "a.pvd", lambda u, p, s: []),
        ("no name", "a.pvd", lambda u, p, s: [u, renamed(p, "")]),
        ("2 fields have the name 'body'", "a.pvd", lambda u, p, s: [renamed(u, "body"), s]),
        ("'cubic' .* is neither", "a.pvd", lambda u, p, s: [u, cubic(u)]),
        ("'other' is on another mesh", "a.pvd", lambda u, p, s: [u, on_another_mesh()]),
    ],
)
def test_fields_that_are_refused(fields, tmp_path, message, file, change):
    with pytest.raises(InputError, match=message):
        write_fields(tmp_path / file, change(*fields))
    assert list(tmp_path.iterdir()) == []


def test_fields_of_degree_2_raise_the_others(fields, tmp_path):
    pytest.importorskip("pyvista")
    mesh = fields[0].function_space.mesh
    quadratic = fem.Function(space(mesh, "Lagrange", 2), name="quadratic")
    quadratic.x.array[:] = 7
    write_fields(tmp_path / "a.pvd", [*fields, quadratic])
    command = [sys.executable, "-c", READ, str(tmp_path / "a.pvd")]
    first, *values = run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    nodes = quadratic.function_space.dofmap.index_map.size_global
    assert first == f"{nodes} 2"
    largest = {
        name: (int(size), float(most)) for name, size, most in (v.split(",") for v in values)
    }
    expected = {"displacement": (3 * nodes, 4.0), "contact pressure": (nodes, 5.0)}
    expected |= {"quadratic": (nodes, 7.0), "body": (2, 6.0)}
    assert largest.keys() == expected.keys()
    for name, found in largest.items():
        assert found == pytest.approx(expected[name], rel=1e-12)


def test_single_field_is_written_as_a_list_of_one(fields, tmp_path):
    write_fields(tmp_path / "one.pvd", fields[0])
    write_fields(tmp_path / "list.pvd", fields[:1])
    piece, other = (tmp_path / f"{name}_p0_000000.vtu" for name in ("one", "list"))
    assert piece.read_bytes() == other.read_bytes()


# the values of the steps, in a process of its own
READ_SERIES = """
import sys
import pyvista
reader = pyvista.get_reader(sys.argv[1])
for time in reader.time_values:
    reader.set_active_time_value(time)
    print(time, reader.read()[0].point_data["contact pressure"].max())
"""


def test_steps_of_a_series_are_read_back(fields, tmp_path):
    path = tmp_path / "steps.pvd"
    for time in (0.0, 0.5, 2.0):
        fields[1].x.array[:] = 5 + time
        write_fields(path, fields, time=time)
    command = [sys.executable, "-c", READ_SERIES, str(path)]
    lines = run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert lines == ["0.0 5.0", "0.5 5.5", "2.0 7.0"]


def test_series_goes_on_from_an_earlier_step(fields, tmp_path):
    """A run that goes on from a checkpoint replaces the steps that it makes again."""
    path = tmp_path / "steps.pvd"
    for time in np.array([1, 2, 3, 2, 4]):  # NumPy writes its numbers otherwise
        write_fields(path, fields, time=time)
    entries = [entry.attrib for entry in ElementTree.parse(path).iter("DataSet")]
    assert [float(entry["timestep"]) for entry in entries] == [1.0, 2.0, 4.0]
    assert all((tmp_path / entry["file"]).exists() for entry in entries)
    write_fields(path, fields)
    assert len(list(ElementTree.parse(path).iter("DataSet"))) == 1


@pytest.mark.parametrize("content", ["", "<a><DataSet/></a>"])
def test_other_file_is_not_continued(fields, tmp_path, content):
    path = tmp_path / "steps.pvd"
    path.write_text(content)
    with pytest.raises(InputError, match="is not a collection"):
        write_fields(path, fields, time=1)
    assert path.read_text() == content
    for time in (float("nan"), "1"):
        with pytest.raises(InputError, match=f"time is {time!r}"):
            write_fields(path, fields, time=time)


def test_folder_that_is_a_file_is_an_error(fields, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        write_fields(tmp_path / "file" / "a.pvd", fields)


@pytest.mark.parametrize("partners", [Nearest(), Mortar()], ids=["nodes", "mortar"])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_integral_of_the_pressure_is_the_contact_force(cell, partners):
    """Of a pressure that is not uniform: the areas are those of the shape functions."""
    scene = two_beams(MPI.COMM_SELF, cell, 4)
    pair = ContactPair(scene.facet_tags, SLAVE, MASTER, partners=partners)
    problem = scene.problem(contacts=[pair], options={"rtol": 1e-9})
    problem.solve()
    pressure = contact_fields(scene.V, problem.results).pressure
    assert np.ptp(problem.results[0].pressure) > 0.1 * problem.results[0].pressure.max()
    ds = ufl.Measure("ds", domain=scene.mesh, subdomain_data=scene.facet_tags)
    force = fem.assemble_scalar(fem.form(pressure * ds(SLAVE)))
    assert force == pytest.approx(problem.report.contacts[0].normal_force, rel=1e-10)
    assert force == pytest.approx(scene.total_forces[0], rel=1e-6)


@pytest.mark.parametrize("slave", [LOWER, UPPER])
def test_integral_of_the_pressure_of_meshes_that_do_not_match(slave):
    """Where the slave sticks out the areas are those of its covered part."""
    problem = solved(Blocks("quadrilateral", 5, 7, width=0.7), slave).problem
    contact, V = problem.results[0], problem.space
    force = problem.report.contacts[0].normal_force
    assert contact.pressure @ contact.area == pytest.approx(force, rel=1e-12)
    if slave == UPPER:
        pressure = contact_fields(V, [contact]).pressure
        tags = problem.contacts[0].facet_tags
        ds = ufl.Measure("ds", domain=V.mesh, subdomain_data=tags)
        integral = fem.assemble_scalar(fem.form(pressure * ds(UPPER)))
        assert integral == pytest.approx(force, rel=1e-10)


def test_fields_of_the_user_may_have_spaces_in_their_names():
    scene = pressed_block(MPI.COMM_SELF, "quadrilateral")
    young = fem.Function(space(scene.mesh, "DG", 0), name="Young's modulus")
    young.x.array[:] = 2.1e11
    scene.a = elasticity(scene.u, scene.v, young)
    problem = scene.problem()
    problem.solve()
    np.testing.assert_allclose(normal_forces(problem), scene.total_forces, rtol=1e-8)
    assert von_mises(scene.mesh, young * ufl.Identity(3)).x.array == pytest.approx(0.0, abs=1e-3)
    assert young.name == "Young's modulus"


@pytest.mark.ranks(2)
def test_gathered_results_have_the_numbers_of_this_rank_alone():
    """Fields are made of the results of the ranks, not of gathered ones, on several ranks."""
    problem = pressed_block(MPI.COMM_WORLD, "quadrilateral", 6).problem()
    problem.solve()
    own = problem.results[0]
    whole = own.gather()
    np.testing.assert_array_equal(np.sort(whole.dofs[whole.dofs >= 0]), np.sort(own.dofs))
    assert set(whole.nodes[whole.dofs >= 0]) == set(own.nodes)
    with pytest.raises(InputError, match="the results are gathered, .* Pass problem.results"):
        contact_fields(problem.space, [whole])

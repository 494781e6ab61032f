"""Reading of .msh files: tags, names, separate bodies, and errors that say what to do."""

import importlib.util
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
from joined_bodies import measure
from msh_files import CELLS, SQUARE, TETRAHEDRON, write_cell, write_msh

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.topology import cells_of_facets, facet_corners, tag_names
from fenics_tfeti.io import read_msh

gmsh = pytest.importorskip("gmsh")

MESHES = Path(__file__).parents[3] / "meshes"

VOLUME = {"triangle": 1 / 2, "quadrilateral": 1, "tetrahedron": 1 / 6, "hexahedron": 1}
FACET_AREA = {"triangle": 1, "quadrilateral": 1, "tetrahedron": 1 / 2, "hexahedron": 1}


@pytest.mark.parametrize("cell", CELLS)
def test_groups_become_tags_of_cells_and_facets(cell, tmp_path):
    gdim = 3 if "hedron" in cell else 2
    tagged = read_msh(write_cell(tmp_path / "cell.msh", cell), MPI.COMM_SELF, gdim=gdim)
    assert tagged.mesh.geometry.dim == gdim
    assert measure(tagged, "dx", 4) == pytest.approx(VOLUME[cell])
    assert measure(tagged, "ds", 9) == pytest.approx(FACET_AREA[cell])


def test_names_map_to_tags(tmp_path):
    tagged = read_msh(write_cell(tmp_path / "cell.msh", "tetrahedron"), MPI.COMM_SELF)
    assert tagged.names == {"body": 4, "support": 9}
    assert tag_names(tagged.cell_tags) == {4: "body"}
    assert tag_names(tagged.facet_tags) == {9: "support"}


def test_name_of_two_tags_is_left_out_with_a_warning(tmp_path, caplog):
    points, elements = CELLS["triangle"]
    path = write_msh(tmp_path / "a.msh", points, elements, ['2 4 "same"', '1 9 "same"'])
    assert read_msh(path, MPI.COMM_SELF, gdim=2).names == {}
    assert "same" in caplog.text


def test_mesh_without_tagged_facets_has_empty_facet_tags(tmp_path):
    points, elements = CELLS["triangle"]
    path = write_msh(tmp_path / "a.msh", points, elements[:1])
    assert len(read_msh(path, MPI.COMM_SELF, gdim=2).facet_tags.indices) == 0


def test_nodes_at_the_same_place_stay_separate(tmp_path):
    below = [(x, y - 1, z) for x, y, z in SQUARE]
    elements = [(3, 1, (1, 2, 3, 4)), (3, 2, (5, 6, 7, 8))]
    path = write_msh(tmp_path / "a.msh", SQUARE + below, elements)
    mesh = read_msh(path, MPI.COMM_SELF, gdim=2).mesh
    assert mesh.topology.index_map(0).size_global == 8


def test_gaps_in_the_node_numbers_do_no_harm(tmp_path):
    path = write_msh(tmp_path / "a.msh", SQUARE[:3], [(2, 1, (3, 20, 9))], numbers=[3, 20, 9])
    assert measure(read_msh(path, MPI.COMM_SELF, gdim=2), "dx", 1) == pytest.approx(0.5)


def test_nodes_of_no_cell_are_left_out_with_a_warning(tmp_path, caplog):
    points = [*SQUARE[:3], (7, 8, 0), (9, 9, 0)]
    elements = [(2, 1, (1, 2, 3)), (15, 0, (4,)), (15, 2, (5,))]
    path = write_msh(tmp_path / "a.msh", points, elements)
    mesh = read_msh(path, MPI.COMM_SELF, gdim=2).mesh
    assert mesh.geometry.x.shape[0] == mesh.topology.index_map(0).size_global == 3
    assert "a.msh: left out 2 nodes of no cell, one at (7, 8, 0)" in caplog.text


def test_mesh_whose_nodes_are_all_in_cells_gives_no_warning(tmp_path, caplog):
    read_msh(write_cell(tmp_path / "cell.msh", "hexahedron"), MPI.COMM_SELF)
    assert not caplog.text


def test_physical_points_do_no_harm(tmp_path):
    points, elements = CELLS["tetrahedron"]
    elements = [*elements, (15, 5, (1,)), (1, 6, (1, 2))]
    names = ['3 4 "body"', '2 9 "support"', '0 5 "corner"']
    tagged = read_msh(write_msh(tmp_path / "a.msh", points, elements, names), MPI.COMM_SELF)
    assert set(tagged.facet_tags.values) == {9}
    assert tagged.names == {"body": 4, "support": 9}


@pytest.mark.parametrize("cut", [0.3, 0.6, 0.9])
def test_truncated_file_is_refused(cut, tmp_path):
    content = (MESHES / "two_beams.msh").read_text()
    path = tmp_path / "cut.msh"
    path.write_text(content[: int(cut * len(content))])
    with pytest.raises(InputError, match=r"cut\.msh"):
        read_msh(path, MPI.COMM_SELF)


BESIDE = [(7, 7, 0), (8, 8, 0)]
MIDDLES = [(0.5, 0, 0), (1, 0.5, 0), (0.5, 1, 0), (0, 0.5, 0)]
QUADRILATERAL, TETRAHEDRAL = CELLS["quadrilateral"], CELLS["tetrahedron"]
REFUSED = {
    "plane mesh": (
        (SQUARE, [(2, 4, (1, 2, 3))], 3),
        "in the plane pass gdim=2. .* a physical volume",
    ),
    "3D mesh": ((TETRAHEDRON, [(4, 4, (1, 2, 3, 4))], 2), "gdim is 2: pass gdim=3$"),
    "no physical volume": (
        (TETRAHEDRON, [(2, 9, (1, 2, 4))], 3),
        "no volume cells. Give each body a physical volume",
    ),
    "no physical surface": (
        (SQUARE, [(1, 9, (1, 2))], 2),
        "no surface cells. Give each body a physical surface",
    ),
    "cells without groups": (
        (TETRAHEDRAL[0], [(kind, 0, nodes) for kind, _, nodes in TETRAHEDRAL[1]], 3),
        "no physical volume group",
    ),
    "a cell twice": (
        (SQUARE, [(2, 1, (1, 2, 3)), (2, 1, (1, 3, 4)), (2, 1, (3, 1, 2))], 2),
        r"same nodes: 1 of 3, .* \(0\.666667, 0\.333333, 0\)",
    ),
    "a node twice": ((SQUARE, [(3, 1, (1, 2, 3, 3))], 2), "the same node twice: 1 of 1, the first"),
    "a facet in two groups": (
        (TETRAHEDRAL[0], [*TETRAHEDRAL[1], (2, 10, (1, 2, 3))], 3),
        "several physical surface groups, '[0-9]+' and '10'",
    ),
    **{
        f"no facet {ends}": (
            ([*QUADRILATERAL[0], *BESIDE], [*QUADRILATERAL[1], (1, 8, ends)], 2),
            "1 of the 2 elements .* are not facets of cells",
        )
        for ends in [(1, 3), (1, 5), (5, 6)]
    },
    "mixed cells": (
        ([*SQUARE, (2, 0, 0)], [(3, 1, (1, 2, 3, 4)), (2, 2, (2, 5, 3))], 2),
        "of the types quadrilateral, triangle; supported are",
    ),
    "incomplete cells": (
        ([*SQUARE, *MIDDLES], [(16, 1, tuple(range(1, 9)))], 2),
        "of the type Quadrilateral 8; .*SecondOrderIncomplete",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_mesh_that_is_refused(tmp_path, case):
    (points, elements, gdim), message = REFUSED[case]
    path = write_msh(tmp_path / "a.msh", points, elements)
    with pytest.raises(InputError, match=message):
        read_msh(path, MPI.COMM_SELF, gdim=gdim)


def overlapping():
    for tag, surfaces in ((3, [1]), (4, [1, 2])):
        gmsh.model.addPhysicalGroup(2, surfaces, tag)


def one_left_out():
    gmsh.model.addPhysicalGroup(2, [1])
    gmsh.option.setNumber("Mesh.SaveAll", 1)


def not_meshed():
    gmsh.model.occ.addRectangle(5, 0, 0, 1, 1)
    gmsh.model.occ.synchronize()
    gmsh.model.addPhysicalGroup(2, [1, 2, 3], 7)


@pytest.mark.parametrize(
    ("group", "message"),
    [
        (overlapping, "several physical surface groups, '3' and '4'"),
        (one_left_out, "4 of 8 cells are in no physical surface group"),
        (not_meshed, "surface 3 of physical group 7 has elements of 0 types"),
        (gmsh.model.mesh.clear, "has no cells; was it damaged, or saved before meshing"),
    ],
)
def test_groups_that_do_not_fit_the_mesh_are_refused(tmp_path, group, message):
    path = tmp_path / "a.msh"
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("squares")
        for x in (0, 1):
            gmsh.model.occ.addRectangle(x, 0, 0, 1, 1)
        gmsh.model.occ.synchronize()
        gmsh.option.setNumber("Mesh.MeshSizeMin", 2)
        gmsh.model.mesh.generate(2)
        group()
        gmsh.write(str(path))
    finally:
        gmsh.finalize()
    with pytest.raises(InputError, match=message):
        read_msh(path, MPI.COMM_SELF, gdim=2)


def two_beams_script():
    spec = importlib.util.spec_from_file_location("two_beams", MESHES / "two_beams.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module", params=["hexahedron", "tetrahedron"])
def two_beams(request, tmp_path_factory):
    """Return a coarse mesh that the script makes."""
    path = tmp_path_factory.mktemp("meshes") / "two_beams.msh"
    two_beams_script().two_beams(path, request.param, elements_per_metre=3)
    return read_msh(path, MPI.COMM_SELF)


def check_sizes(two_beams):
    """Compare volumes and areas with the drawing."""
    names = two_beams.names
    volumes = [measure(two_beams, "dx", names[name]) for name in ("lower", "upper")]
    surfaces = ("clamped", "guided", "contact_upper", "contact_lower", "loaded")
    areas = [measure(two_beams, "ds", names[name]) for name in surfaces]
    assert volumes == pytest.approx([2, 2])
    assert areas == pytest.approx([1, 1, 1, 1, 3])


def test_two_beams_have_the_volumes_and_areas_of_the_drawing(two_beams):
    check_sizes(two_beams)


def test_two_beams_have_matching_but_separate_nodes_at_the_contact(two_beams):
    nodes = [
        np.unique(
            facet_corners(
                two_beams.mesh,
                *cells_of_facets(two_beams.mesh, two_beams.facet_tags.find(two_beams.names[name])),
            )
        )
        for name in ("contact_upper", "contact_lower")
    ]
    assert len(np.intersect1d(*nodes)) == 0
    upper, lower = (two_beams.mesh.geometry.x[n] for n in nodes)
    distance = np.linalg.norm(upper[:, np.newaxis] - lower, axis=2)
    assert len(upper) == len(lower)
    assert distance.min(axis=1).max() < 1e-12


@pytest.mark.ranks
def test_two_beams_of_the_repository_have_12_elements_per_metre():
    """All ranks together hold the mesh; errors are raised on all of them."""
    path, comm = MESHES / "two_beams.msh", MPI.COMM_WORLD
    beams = read_msh(path, comm)
    assert beams.mesh.topology.index_map(3).size_global == 2 * 24 * 12 * 12
    assert beams.mesh.topology.index_map(0).size_global == 2 * 25 * 13 * 13
    check_sizes(beams)
    with pytest.raises(FileNotFoundError, match="no mesh file"):
        read_msh("nowhere.msh", comm)
    with pytest.raises(InputError, match="pass gdim=3"):
        read_msh(path, comm, gdim=2)

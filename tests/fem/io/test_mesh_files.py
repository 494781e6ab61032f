"""Meshes of other programs: files that Gmsh and meshio write, and decks by hand."""

import sys

from mpi4py import MPI

import numpy as np
import pytest
from joined_bodies import measure
from msh_files import gmsh_model

from dolfinx.mesh import compute_midpoints

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.topology import tag_names
from fenics_tfeti.io import Interface, read_mesh, read_msh

COMM = MPI.COMM_SELF
CUBE = [(x, y, z) for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
# one cell: its type in Abaqus, its nodes, and a function of x that is zero on each numbered face
CELLS = {
    "CPE3": (
        [(0, 0, 0), (1, 0, 0), (0, 1, 0)],
        [lambda x: x[1], lambda x: x[0] + x[1] - 1, lambda x: x[0]],
    ),
    "CPS4": (
        CUBE[:4],
        [lambda x: x[1], lambda x: x[0] - 1, lambda x: x[1] - 1, lambda x: x[0]],
    ),
    "C3D4": (
        [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)],
        [lambda x: x[2], lambda x: x[1], lambda x: x.sum(axis=0) - 1, lambda x: x[0]],
    ),
    "C3D8R": (
        CUBE,
        [
            *(lambda x: x[2], lambda x: x[2] - 1, lambda x: x[1]),
            *(lambda x: x[0] - 1, lambda x: x[1] - 1, lambda x: x[0]),
        ],
    ),
}


def write_deck(path, kind, points, cells, more=""):
    """Write a deck with numbers from 11 on for nodes, from 1 on for elements."""
    lines = ["*HEADING", "a deck", "** a comment", "*Node, nset=Nall"]
    lines += [f"{11 + k}, {', '.join(map(str, x))}" for k, x in enumerate(points)]
    lines += [f"*ELEMENT, TYPE={kind}, ELSET=block"]
    lines += [f"{k}, {', '.join(str(11 + n) for n in cell)}" for k, cell in enumerate(cells, 1)]
    path.write_text("\n".join([*lines, more, "*STEP", "*STATIC", "*END STEP", ""]))
    return path


def one_cell(path, kind, more=""):
    points = CELLS[kind][0]
    return write_deck(path, kind, points, [range(len(points))], more), 3 if "C3" in kind else 2


# two squares side by side, with nodes of their own
SQUARES = [(x + k, y, 0) for k in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
TWO = """*ELSET, ELSET=left
1
*ELSET, ELSET=Right
2
*NSET, NSET=bottom
11, 12, 15, 16,
*NSET, NSET=corner
11
"""


def two_squares(path, more=TWO):
    return write_deck(path, "CPE4", SQUARES, [range(4), range(4, 8)], more)


@pytest.mark.parametrize("end", [".inp", ".med"])
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("boxes", [False, True])
@pytest.mark.parametrize("gdim", [2, 3])
def test_files_of_gmsh_are_its_msh_files(tmp_path, gdim, boxes, order, end):
    """Round bodies of simplices, square ones of boxes; of second order those lack nodes inside."""
    if end == ".med":
        pytest.importorskip("meshio")
        pytest.importorskip("h5py")
    paths = [tmp_path / f"body{e}" for e in (".msh", end)]
    with gmsh_model(paths[0], gdim, order) as gmsh:
        if end == ".med" and "Med" not in gmsh.option.getString("General.BuildOptions"):
            pytest.skip("this Gmsh writes no MED")
        occ, mesh = gmsh.model.occ, gmsh.model.mesh
        if gdim == 2:
            body = occ.addRectangle(0, 0, 0, 2, 1) if boxes else occ.addDisk(0, 0, 0, 1, 1)
        elif boxes:
            base = [(2, occ.addRectangle(0, 0, 0, 1, 1))]
            body = occ.extrude(base, 0, 0, 1, numElements=[2], recombine=True)[1][1]
        else:
            body = occ.addCylinder(0, 0, 0, 0, 0, 1, 0.5)
        occ.synchronize()
        if boxes:
            for _, surface in gmsh.model.getEntities(2):
                mesh.setTransfiniteSurface(surface)
                mesh.setRecombine(2, surface)
        side = gmsh.model.getBoundary([(gdim, body)], oriented=False)[-1][1]
        for dim, entity, name in ((gdim, body, "body"), (gdim - 1, side, "side")):
            group = gmsh.model.addPhysicalGroup(dim, [entity])
            gmsh.model.setPhysicalName(dim, group, name)
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.7)
        mesh.generate(gdim)
        gmsh.option.setNumber("Mesh.SecondOrderIncomplete", 1)
        mesh.setOrder(order)
        gmsh.write(str(paths[1]))
        gmsh.option.setNumber("Mesh.SecondOrderIncomplete", 0)
        mesh.setOrder(1)
    expected, found = read_msh(paths[0], COMM, gdim), read_mesh(paths[1], COMM, gdim)
    assert found.names.keys() == {"body", "side"}
    for kind, name in (("dx", "body"), ("ds", "side")):
        exact = measure(expected, kind, expected.names[name])
        assert measure(found, kind, found.names[name]) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("kind", CELLS)
def test_faces_of_elements_have_the_numbers_of_abaqus(tmp_path, kind):
    zeros = CELLS[kind][1]
    faces = "\n".join(
        f"*SURFACE, NAME=face{k}, TYPE=ELEMENT\n{'1' if k % 2 else 'BLOCK'}, S{k}"
        for k in range(1, len(zeros) + 1)
    )
    path, gdim = one_cell(tmp_path / "cell.inp", kind, faces)
    tagged = read_mesh(path, COMM, gdim)
    assert len(tagged.facet_tags.values) == len(zeros)
    for k, is_on in enumerate(zeros, 1):
        (facet,) = tagged.facet_tags.find(tagged.names[f"face{k}"])
        middle = compute_midpoints(tagged.mesh, gdim - 1, np.array([facet], dtype=np.int32))
        assert is_on(middle.T) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize(("kind", "size"), [("CPE8", 1.05), ("C3D20", 1.025)])
def test_cells_without_inner_nodes_keep_their_shape(tmp_path, kind, size):
    """x + 0.1 x^2 y (z) is a function of serendipity elements."""
    corners = np.array(CUBE if kind == "C3D20" else CUBE[:4], dtype=float)
    ends = [(0, 1), (1, 2), (2, 3), (3, 0)]
    if kind == "C3D20":
        ends += [(a + 4, b + 4) for a, b in ends] + [(k, k + 4) for k in range(4)]
    x = np.vstack([corners, [(corners[a] + corners[b]) / 2 for a, b in ends]])
    x[:, 0] += 0.1 * x[:, 0] ** 2 * x[:, 1] * (x[:, 2] if kind == "C3D20" else 1.0)
    path = write_deck(tmp_path / "cell.inp", kind, x.tolist(), [range(len(x))])
    gdim = 3 if kind == "C3D20" else 2
    tagged = read_mesh(path, COMM, gdim)
    assert measure(tagged, "dx", 1) == pytest.approx(size, rel=1e-12)


@pytest.mark.ranks(1, 2)
def test_sets_become_tags(tmp_path):
    """Sets of elements, except for one of all, and of nodes, except for those with no facet."""
    comm = MPI.COMM_WORLD
    path = comm.bcast(tmp_path) / "two.inp"
    if comm.rank == 0:
        two_squares(path)
    comm.Barrier()
    tagged = read_mesh(path, comm, 2)
    assert tagged.names == {"left": 1, "Right": 2, "bottom": 3}
    assert tag_names(tagged.cell_tags) == {1: "left", 2: "Right"}
    assert tag_names(tagged.facet_tags) == {3: "bottom"}
    assert [measure(tagged, "dx", tag) for tag in (1, 2)] == pytest.approx([1.0, 1.0])
    assert measure(tagged, "ds", 3) == pytest.approx(2.0)
    assert tagged.mesh.topology.index_map(0).size_global == 8


@pytest.mark.parametrize(
    ("members", "length"),
    [
        ("*NSET, NSET=chosen, GENERATE\n11, 13, 1", 2.0),
        ("*NSET, NSET=chosen\nBOTTOM, 13", 3.0),
        ("*NSET, NSET=chosen\n11, 12\n*NSET, NSET=CHOSEN\n13, 17", 2.0),
        ("*SURFACE, NAME=chosen, TYPE=NODE\nbottom, 1.0\n14, 1.0", 3.0),
        ("*SURFACE, NAME=chosen\nblock, S1", 2.0),
        ("*NSET, NSET=chosen, ELSET=Left", 4.0),
        ("*NSET, NSET=chosen\nNall", 8.0),
    ],
)
def test_lines_of_sets(tmp_path, members, length):
    path = two_squares(tmp_path / "two.inp", f"{TWO}{members}")
    tagged = read_mesh(path, COMM, 2, names=["left", "Right", "chosen"])
    assert tagged.names == {"left": 1, "Right": 2, "chosen": 3}
    assert measure(tagged, "ds", 3) == pytest.approx(length)


def test_nodes_of_a_body_are_no_surface(tmp_path):
    """A set of nodes with the name of a set of elements."""
    path = two_squares(tmp_path / "two.inp", f"{TWO}*NSET, NSET=left\n11, 12, 13, 14")
    assert len(read_mesh(path, COMM, 2).facet_tags.values) == 2


def test_deck_in_several_files_and_records_in_several_lines(tmp_path):
    (tmp_path / "nodes.txt").write_text("*NODE\n1, 0.\n2, 1.\n3, 1., 1.\n4, 0., 1.\n")
    more = "*ELEMENT, TYPE=MASS\n9, 1\n*ELEMENT, TYPE=CAX4\n7, 1, 2,\n3, 4\n"
    path = tmp_path / "deck.inp"
    path.write_text(f"*INCLUDE, INPUT=nodes.txt\n{more}")
    tagged = read_mesh(path, COMM, 2)
    assert tagged.names == {} and measure(tagged, "dx", 1) == pytest.approx(1.0)


def test_bodies_that_share_nodes_are_opened(tmp_path):
    points = [(x, y, 0) for y in (0, 1) for x in (0, 1, 2)]
    sets = "*ELSET, ELSET=a\n1\n*ELSET, ELSET=b\n2"
    path = write_deck(tmp_path / "a.inp", "CPS4", points, [(0, 1, 4, 3), (1, 2, 5, 4)], sets)
    opened = Interface(("a", "b"), ("of a", "of b"))
    tagged = read_mesh(path, COMM, 2, split=[opened])
    assert tagged.mesh.topology.index_map(0).size_global == 8
    assert measure(tagged, "ds", tagged.names["of a"]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("more", "arguments", "message"),
    [
        ("*ELSET, ELSET=left\n1", {}, r"1 of 2 cells are in none of the sets \['left'\]"),
        (f"{TWO}*ELSET, ELSET=again\n2", {}, "a cell is in the sets 'Right' and 'again'.*names="),
        (f"{TWO}*NSET, NSET=low\n11, 12", {}, "a facet is in the sets 'bottom' and 'low'.*names="),
        (TWO, {"names": ["top"]}, r"no set 'top'.*\['Nall', 'Right', 'block', 'bottom', 'left'\]"),
        (TWO, {"gdim": 3}, "are of dimension 2, but gdim is 3: pass gdim=2"),
        ("*ELSET, ELSET=a\nb", {}, r"two.inp, line 16: \*ELSET cannot be read \(b\)"),
        ("*NSET\n1", {}, r"line 16: \*NSET cannot be read \(NSET\)"),
        ("*ELEMENT, TYPE=CPE4\n1, 11, 12, 13, 14", {}, "element 1 is there twice.*parts"),
        ("*ELEMENT, TYPE=CPE4\n3, 11, 12, 13, 99", {}, "an element has the node 99"),
        ("*ELEMENT, TYPE=CPE3\n3, 11, 12, 13", {}, "of the types quad, triangle; supported"),
        ("*INSTANCE, NAME=a, PART=p\n1., 0., 0.", {}, "line 16: instances that are moved"),
        ("*SURFACE, NAME=s\nblock, S5", {}, "'s' has the face 'S5' .* S1 to S4 are read"),
        ("*SURFACE, NAME=s\nblock", {}, "'s' has the face 'of no number'"),
        ("*SURFACE, NAME=s\nlid, S1", {}, "'s' is of the set 'lid' of elements, which is not"),
    ],
)
def test_decks_that_cannot_be_read(tmp_path, more, arguments, message):
    with pytest.raises(InputError, match=message):
        read_mesh(two_squares(tmp_path / "two.inp", more), COMM, **{"gdim": 2, **arguments})


@pytest.mark.ranks(1, 2)
def test_errors_are_on_all_ranks(tmp_path):
    with pytest.raises(FileNotFoundError, match="no mesh file"):
        read_mesh(tmp_path / "none.inp")
    (tmp_path / "empty.inp").write_text("*STEP\n")
    with pytest.raises(InputError, match="has no elements"):
        read_mesh(tmp_path / "empty.inp")


def test_msh_files_have_groups_alone(tmp_path):
    with pytest.raises(InputError, match="use read_msh"):
        read_mesh(tmp_path / "a.msh", COMM, names=["body"])


def test_missing_meshio_is_told(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "meshio", None)
    (tmp_path / "a.vtu").write_text("")
    with pytest.raises(ImportError, match="a.vtu needs meshio .* 'pip install meshio h5py'"):
        read_mesh(tmp_path / "a.vtu", COMM)


# -- files of meshio -----------------------------------------------------------------------------


def write_by_meshio(path, cells, x=SQUARES, **more):
    meshio = pytest.importorskip("meshio")
    options = {"data_format": "XML"} if path.suffix == ".xdmf" else {}
    meshio.write(path, meshio.Mesh(np.array(x, dtype=float), cells, **more), **options)
    return path


QUADS = [("quad", np.arange(8).reshape(2, 4))]


def test_numbers_in_two_files(tmp_path):
    """XDMF has the facets in a file of their own."""
    pytest.importorskip("h5py")
    path = write_by_meshio(tmp_path / "a.xdmf", QUADS, cell_data={"part": [np.array([7, 9])]})
    lines = [("line", np.array([[0, 1], [4, 5], [2, 1]]))]
    facets = write_by_meshio(tmp_path / "f.xdmf", lines, cell_data={"f": [np.array([5, 5, 6])]})
    tagged = read_mesh(path, COMM, 2, facets=facets)
    assert tagged.names == {}
    sizes = [measure(tagged, *what) for what in (("dx", 7), ("dx", 9), ("ds", 5), ("ds", 6))]
    assert sizes == pytest.approx([1.0, 1.0, 2.0, 1.0])
    other = write_by_meshio(tmp_path / "g.xdmf", lines, np.array(SQUARES) + 1e-3)
    with pytest.raises(InputError, match="g.xdmf has other points than"):
        read_mesh(path, COMM, 2, facets=other)


def test_data_are_chosen(tmp_path):
    data = {"part": [np.array([3, 4])], "owner": [np.array([0, 0])], "size": [np.array([0.5, 1])]}
    path = write_by_meshio(tmp_path / "a.vtk", QUADS, cell_data=data)
    with pytest.raises(InputError, match=r"several numbers for each cell, \['owner', 'part'\]"):
        read_mesh(path, COMM, 2)
    with pytest.raises(InputError, match=r"no numbers of cells 'size'; there are \['owner', 'par"):
        read_mesh(path, COMM, 2, data="size")
    assert np.unique(read_mesh(path, COMM, 2, data="part").cell_tags.values).tolist() == [3, 4]


def test_what_meshio_cannot_read_is_told(tmp_path):
    pytest.importorskip("meshio")
    for name in ("a.vtu", "a.part"):
        (tmp_path / name).write_text("nothing")
        with pytest.raises(InputError, match=f"meshio cannot read .*{name}"):
            read_mesh(tmp_path / name, COMM)

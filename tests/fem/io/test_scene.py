"""The outer faces of deformed bodies."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import scenes

from dolfinx import fem

from fenics_tfeti import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.io.scene import gather_scene
from fenics_tfeti.io import displacement_space

COMM = MPI.COMM_SELF


def displaced(cell: str, degree: int = 1):
    """Return a displacement field u = (x, 0, ...) / 100 of two beams."""
    mesh = scenes.beams(COMM, cell, 2).mesh
    u = fem.Function(displacement_space(mesh, degree))
    u.interpolate(lambda x: np.stack([0.01 * x[0], *(0 * x[1 : mesh.geometry.dim])]))
    return u


def areas(scene):
    """Return the oriented areas of the triangles."""
    a, b, c = (scene.points[corner] for corner in scene.faces.T)
    return 0.5 * np.cross(b - a, c - a)


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["tetrahedron", "hexahedron"])
def test_outer_faces_are_closed_and_outward(cell, degree):
    """Two beams of 2 m x 1 m x 1 m: by Gauss' theorem, int x.n = 3 V."""
    scene = gather_scene(displaced(cell, degree)).triangulated()
    areas_of = areas(scene)
    np.testing.assert_allclose(areas_of.sum(axis=0), 0.0, atol=1e-12)
    assert np.linalg.norm(areas_of, axis=1).sum() == pytest.approx(2 * 10.0)
    middles = scene.points[scene.faces].mean(axis=1)
    assert np.sum(middles * areas_of) == pytest.approx(3 * 4.0)
    np.testing.assert_allclose(scene.displacement[:, 0], 0.01 * scene.points[:, 0], atol=1e-15)
    assert not scene.flat


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_cells_of_two_dimensions(cell, degree):
    scene = gather_scene(displaced(cell, degree)).triangulated()
    areas_of = areas(scene)
    assert areas_of[:, 2].sum() == pytest.approx(4.0)
    assert (areas_of[:, 2] > 0.0).all() and scene.flat
    assert not scene.displacement[:, 1:].any()


def test_fields_of_nodes_and_cells():
    u = displaced("hexahedron")
    mesh = u.function_space.mesh
    by_node = fem.Function(scenes.scalar_space(mesh), name="height")
    by_node.interpolate(lambda x: x[2])
    by_cell = fem.Function(scenes.scalar_space(mesh, "DG", 0), name="body")
    by_cell.interpolate(lambda x: np.where(x[2] < 1.0, 1.0, 2.0))
    scene = gather_scene(u, [by_node, by_cell])
    assert scene.faces.shape[1] == 4
    scene = scene.triangulated()
    assert list(scene.fields) == ["displacement", "height", "body"]
    np.testing.assert_allclose(scene.fields["height"], scene.points[:, 2], atol=1e-14)
    np.testing.assert_allclose(scene.fields["displacement"], 0.01 * scene.points[:, 0], atol=1e-14)
    middles = scene.points[scene.faces].mean(axis=1)
    lower = middles[:, 2] < 1.0 - 1e-9
    assert scene.fields["body"].shape == (len(scene.faces), 1)
    assert (scene.fields["body"][lower] == 1.0).all()


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_faces_of_degree_2_are_drawn_in_pieces(cell):
    """Of a field of degree 2 as well, on a displacement of degree 1."""
    plain = displaced(cell)
    mesh = plain.function_space.mesh
    by_node = fem.Function(_compat.lagrange_space(mesh, 2), name="square")
    by_node.interpolate(lambda x: x[0] ** 2 + x[1])
    by_cell = fem.Function(scenes.scalar_space(mesh, "DG", 0), name="cell")
    by_cell.x.array[:] = np.arange(by_cell.x.array.size)
    scene, whole = gather_scene(plain, [by_cell, by_node]), gather_scene(plain, [by_cell])
    assert len(scene.faces) == 4 * len(whole.faces)
    x, y, _ = scene.points.T
    assert scene.fields["square"] == pytest.approx(x**2 + y)
    assert scene.displacement == pytest.approx(0.01 * np.outer(x, [1, 0, 0]), abs=1e-15)
    np.testing.assert_array_equal(
        scene.fields["cell"].reshape(-1, 4), np.repeat(whole.fields["cell"], 4, axis=1)
    )


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_corners_of_a_face_are_next_to_each_other(cell):
    """A bowtie would have diagonals."""
    scene = gather_scene(displaced(cell))
    corners = scene.points[scene.faces]
    steps = corners - np.roll(corners, 1, axis=1)
    assert np.all(np.count_nonzero(np.abs(steps) > 1e-12, axis=2) == 1)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_faces_of_some_cells(cell):
    """Those of the upper beam, which is 2 m long."""
    u, space = displaced(cell), scenes.beams(COMM, cell, 2)
    cells = space.cell_tags.find(2)
    scene = gather_scene(u, cells=cells)
    flat = scene.flat
    assert np.ptp(scene.points[:, 2 - flat]) == pytest.approx(1.0)
    area = np.linalg.norm(areas(scene.triangulated()), axis=1).sum()
    assert area == pytest.approx(2.0 if flat else 10.0)


CUT = """
import runpy, sys
import numpy as np
surface = runpy.run_path(sys.argv[1])["build_surface"](dict(np.load(sys.argv[2])))
x = surface.points[:, 0]
wrong = [surface.point_data["colours"] - x, surface.point_data["displacement"][:, 0] - 0.01 * x]
print(surface.area, surface.bounds[1], max(np.abs(part).max() for part in wrong))
"""


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["tetrahedron", "hexahedron"])
def test_cut_bodies_have_the_section_and_its_values(cell, degree, tmp_path):
    """The lower beam is cut at x = 0.3 m; the displacement there is 3 mm."""
    pytest.importorskip("pyvista")
    u = displaced(cell, degree)
    by_node = fem.Function(_compat.lagrange_space(u.function_space.mesh, degree), name="x")
    by_node.interpolate(lambda x: x[0])
    scene = gather_scene(u, [by_node], scenes.beams(COMM, cell, 2).cell_tags.find(1), solid=True)
    data = {"points": scene.points, "displacement": scene.displacement, "faces": scene.faces}
    data |= {"colours": scene.fields["x"], "section": np.array([[0.3, 0, 0], [1, 0, 0]])}
    np.savez(tmp_path / "data.npz", **data)
    script = str(Path(gather_scene.__code__.co_filename).with_name("_render.py"))
    command = [sys.executable, "-P", "-W", "ignore", "-c", CUT, script, str(tmp_path / "data.npz")]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    area, end, wrong = map(float, told)
    # of the box 0.3 m x 1 m x 1 m
    assert area == pytest.approx(2 * (1.0 + 0.3 + 0.3)) and end == pytest.approx(0.3)
    assert wrong < 1e-6


@pytest.mark.parametrize(
    ("largest", "scale"),
    [(0.3, 1.0), (0.15, 2.0), (0.29, 1.0), (1.5e-3, 200.0), (1.0, 1.0), (10.5, 1.0), (0, 1)],
)
def test_scale_is_round_and_makes_displacements_a_tenth(largest, scale):
    """Large ones are drawn as they are."""
    u = displaced("quadrilateral")  # of the length 3
    u.interpolate(lambda x: np.stack([0 * x[0], largest * x[0] / 3]))
    assert gather_scene(u).scale == pytest.approx(scale)


def test_wrong_fields_are_refused():
    u = displaced("triangle")
    with pytest.raises(InputError, match="a scalar is expected"):
        gather_scene(u, [u])
    with pytest.raises(InputError, match="not a displacement"):
        gather_scene(fem.Function(scenes.scalar_space(u.function_space.mesh)))

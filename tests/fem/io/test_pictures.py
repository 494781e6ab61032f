"""Pictures: what is drawn is the field, and errors leave no file behind."""

import os
import re
import sys
import warnings

from mpi4py import MPI

import numpy as np
import pytest
from PIL import Image
from scenes import dimension

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Plane, RigidObstacle
from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.io import pictures
from fenics_tfeti.io import (
    Box,
    boxes,
    displacement_space,
    draw_deformed,
    draw_profile,
    tag_facets,
    write_gif,
)
from fenics_tfeti.models import isotropic

PNG = b"\x89PNG\r\n\x1a\n"


def size_of(path):
    """Return width and height of a PNG file."""
    head = path.read_bytes()[:24]
    assert head.startswith(PNG)
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")


def fields(cell):
    """Return a displacement, a field of degree 1 and one of degree 0 on two boxes that touch."""
    gdim = dimension(cell)
    upwards = np.eye(gdim)[-1]
    grid = [3, 2, 2][:gdim]
    parts = [Box(k * upwards, [2] + [1] * (gdim - 2) + [1 + k], grid) for k in (0, 1)]
    mesh = boxes(MPI.COMM_SELF, parts, cell).mesh
    u = fem.Function(_compat.lagrange_space(mesh, 1, gdim), name="displacement")
    u.interpolate(lambda x: 1e-3 * np.stack([x[0], x[1], x[0] + x[2]])[:gdim])
    p = fem.Function(_compat.lagrange_space(mesh, 1), name="pressure")
    p.interpolate(lambda x: x[0] + 2 * x[1])
    s = fem.Function(_compat.lagrange_space(mesh, 0, discontinuous=True), name="stress")
    s.interpolate(lambda x: 1e6 * x[0])
    return u, p, s


@pytest.mark.parametrize(
    ("cell", "names"), [("triangle", ["floor", "far", "none"]), ("hexahedron", ["floor", "far"])]
)
def test_picture_has_its_size_and_obstacles_where_they_are(cell, names, tmp_path):
    """Of a plane body that does not move and of one in space that does, on a floor or above it."""
    u, _, stress = fields(cell)
    u.x.array[:] *= cell == "hexahedron"
    normal = np.eye(dimension(cell))[-1]
    obstacles = {
        "floor": [Plane((0, 0, 0), normal)],
        "far": [Plane(-5 * normal, normal), lambda x: np.full(x.shape[1], np.inf)],
        "none": [],
    }
    drawn = {}
    for name in names:
        path = tmp_path / "new folder" / f"{name}.png"
        options = {"title": "Two boxes", "size": (480, 300), "obstacles": obstacles[name]}
        draw_deformed(path, u, stress, unit="MPa", **options)
        assert size_of(path) == (480, 300)
        drawn[name] = path.read_bytes()
    assert drawn["floor"] != drawn["far"] == drawn.get("none", drawn["far"])


def test_colour_bar_has_the_range_of_the_whole_field(tmp_path, monkeypatch):
    """The largest value may be within a body, where it is not seen."""
    drawn = {}
    monkeypatch.setattr(pictures, "_render", lambda path, data: drawn.update(data))
    u, pressure, _ = fields("hexahedron")
    pressure.x.array[:] = 0.0
    x = pressure.function_space.tabulate_dof_coordinates()
    pressure.x.array[np.isclose(x, [2 / 3, 0.5, 0.5]).all(axis=1)] = 3e6
    draw_deformed(tmp_path / "a.png", u, pressure, unit="MPa")
    assert drawn["limits"] == pytest.approx([0.0, 3.0])
    assert not drawn["colours"].any()
    draw_deformed(tmp_path / "a.png", u, pressure, unit="MPa", limits=(0, 2))
    assert drawn["limits"].tolist() == [0.0, 2.0]


@pytest.mark.parametrize(
    ("largest", "options", "told"),
    [
        (120.0, {"unit": "MPa"}, True),
        (120.0, {"unit": "MPa", "units": "mm-N-MPa"}, False),
        (120.0, {"unit": "kPa"}, False),
        (120.0, {}, False),
        (0.0, {"unit": "MPa"}, False),
        (3e6, {"unit": "MPa"}, False),
    ],
)
def test_stress_in_other_units_is_told(tmp_path, monkeypatch, largest, options, told):
    """Megapascals that are taken for pascals are tiny in the picture."""
    monkeypatch.setattr(pictures, "_render", lambda path, data: None)
    u, stress, _ = fields("triangle")
    stress.x.array[:] = largest
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        draw_deformed(tmp_path / "a.png", u, stress, **options)
    messages = [str(warning.message) for warning in caught if warning.category is UserWarning]
    assert ["0.00012 MPa" in text and "units='mm-N-MPa'" in text for text in messages] == [
        True
    ] * told


def test_few_large_values_do_not_make_all_else_pale(tmp_path, monkeypatch):
    """Of 4,000 cells 10 have a value a hundred times as large, which the note tells."""
    drawn = {}
    monkeypatch.setattr(pictures, "_render", lambda path, data: drawn.update(data))
    mesh = boxes(MPI.COMM_SELF, [Box((0, 0), (1, 1), (80, 50))], "quadrilateral").mesh
    u = fem.Function(_compat.lagrange_space(mesh, 1, 2), name="u")
    stress = fem.Function(_compat.lagrange_space(mesh, 0, discontinuous=True), name="stress")
    stress.x.array[:] = np.linspace(0.0, 1e6, stress.x.array.size)
    stress.x.array[:10] = 1e8
    draw_deformed(tmp_path / "a.png", u, stress, unit="MPa")
    assert drawn["limits"] == pytest.approx([0.0, 1.0], abs=0.01) and drawn["exceeded"]
    assert drawn["note"].endswith("the largest value is 100 MPa")


@pytest.mark.parametrize(("pressed", "label"), [(-1e-3, "contact pressure [MPa]"), (1e-3, "")])
def test_problem_is_drawn_with_its_pressure_and_obstacles(tmp_path, monkeypatch, pressed, label):
    """Without a contact force the displacement is."""
    drawn = {}
    monkeypatch.setattr(pictures, "_render", lambda path, data: drawn.update(data))
    mesh = boxes(MPI.COMM_SELF, [Box((0, 0), (1, 1), (2, 2))], "quadrilateral").mesh
    tags = tag_facets(mesh, {1: lambda x: np.isclose(x[1], 0), 2: lambda x: np.isclose(x[1], 1)})
    V = displacement_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    top = fem.locate_dofs_topological(V, 1, tags.find(2))
    problem = ContactProblem(
        ufl.inner(isotropic(2e9, 0.0)(u), ufl.grad(v)) * ufl.dx,
        ufl.inner(fem.Constant(mesh, np.zeros(2)), v) * ufl.dx,
        bcs=[fem.dirichletbc(np.array([0.0, pressed]), top, V)],
        contacts=[RigidObstacle(tags, 1, Plane((0, 0), (0, 1)))],
    )
    problem.solve()
    problem.draw(tmp_path / "a.png", scale=1)
    assert drawn["label"] == (label or "displacement [mm]") and "gaps 0" in drawn
    # 2 GPa times a strain of 1e-3, or 1 mm
    assert drawn["colours"].max() == pytest.approx(2.0 if label else 1.0)


def test_pictures_are_joined(tmp_path):
    paths = [tmp_path / f"{number}.png" for number in range(3)]
    for number, path in enumerate(paths):
        Image.new("RGB", (40, 20), (80 * number, 0, 0)).save(path)
    write_gif(tmp_path / "new" / "a.gif", paths, seconds=0.1, width=20)
    with Image.open(tmp_path / "new" / "a.gif") as joined:
        assert joined.size == (20, 10) and joined.n_frames == 3
        times = []
        for frame in range(3):
            joined.seek(frame)
            times.append(joined.info["duration"])
            assert joined.convert("RGB").getpixel((5, 5))[0] == pytest.approx(80 * frame, abs=8)
    assert times == [100, 100, 600]


@pytest.mark.parametrize(
    ("message", "path", "given"),
    [
        ("does not end in .gif", "a.png", {"pictures": ["b.png"]}),
        ("there are no pictures to join", "a.gif", {"pictures": []}),
        ("write_gif: seconds is 0", "a.gif", {"pictures": ["b.png"], "seconds": 0}),
    ],
)
def test_wrong_animations(tmp_path, monkeypatch, message, path, given):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=re.escape(message)):
        write_gif(path, **given)
    assert list(tmp_path.iterdir()) == []


def with_nan(field):
    field.x.array[1] = np.nan
    return field


@pytest.mark.parametrize(
    ("message", "arguments"),
    [
        ("does not end in .png", lambda u, p, s: {"path": "a.jpg"}),
        ("unknown unit 'psi'; choose one of m, mm", lambda u, p, s: {"colour": s, "unit": "psi"}),
        ("'pressure' is not a displacement", lambda u, p, s: {"displacement": p}),
        ("has shape (2,); a scalar is expected", lambda u, p, s: {"colour": u}),
        ("another mesh", lambda u, p, s: {"colour": fields("triangle")[2]}),
        ("'stress' has values that are NaN", lambda u, p, s: {"colour": with_nan(s)}),
        (
            "limits is (2, 1); two numbers, the smaller one first",
            lambda u, p, s: {"limits": (2, 1)},
        ),
        (
            "a section is for bodies in three dimensions",
            lambda u, p, s: {"section": ((0, 0, 0), (1, 0, 0))},
        ),
    ],
)
def test_wrong_arguments(tmp_path, monkeypatch, message, arguments):
    monkeypatch.chdir(tmp_path)
    u, p, s = fields("triangle")
    with pytest.raises(InputError, match=re.escape(message)):
        draw_deformed(**{"path": "a.png", "displacement": u, **arguments(u, p, s)})
    assert list(tmp_path.iterdir()) == []


def test_missing_pyvista_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(ImportError, match="pip install pyvista"):
        draw_deformed(tmp_path / "a.png", fields("triangle")[0])


def test_missing_matplotlib_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match="pip install matplotlib"):
        draw_profile(tmp_path / "a.png", {}, "x", "y", comm=MPI.COMM_SELF)


def other_pyvista(monkeypatch, tmp_path, code):
    """Let the process that draws import another PyVista."""
    (tmp_path / "pyvista.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)


def test_failure_to_draw_is_told_and_keeps_the_old_picture(tmp_path, monkeypatch):
    other_pyvista(monkeypatch, tmp_path, "import sys; sys.exit('no graphics')")
    path = tmp_path / "a.png"
    path.write_text("old")
    with pytest.raises(RuntimeError, match=r"exit code 1(.|\n)*no graphics"):
        draw_deformed(path, fields("triangle")[0])
    assert path.read_text() == "old"


def test_renderer_is_no_rank_of_this_run(tmp_path, monkeypatch):
    code = """
        import os, pathlib, sys
        assert not [name for name in os.environ if name.startswith(("OMPI_", "PMI_", "PMIX_"))]
        pathlib.Path(sys.argv[2]).write_text("drawn")
        sys.exit()
    """
    other_pyvista(monkeypatch, tmp_path, "if True:" + code)
    for name in ("OMPI_COMM_WORLD_SIZE", "PMI_RANK", "PMIX_RANK"):
        monkeypatch.setenv(name, "2")
    draw_deformed(tmp_path / "a.png", fields("triangle")[0])
    assert (tmp_path / "a.png").read_text() == "drawn"


def test_profile_is_drawn(tmp_path):
    x = np.linspace(0, 1, 20)
    curves = {"computed": (x, x**2, "o"), "exact": (x, x**2)}
    draw_profile(tmp_path / "new" / "a.png", curves, "x [m]", "p [MPa]", comm=MPI.COMM_SELF)
    assert size_of(tmp_path / "new" / "a.png")[0] > 1000


@pytest.mark.parametrize(
    ("curve", "message"),
    [(([1, 2], [1, 2, 3]), r"x of shape \(2,\) and y of shape \(3,\)"), (([1],), "has 1 parts")],
)
def test_wrong_curve_is_refused(curve, message, tmp_path):
    with pytest.raises(InputError, match=message):
        draw_profile(tmp_path / "a.png", {"a": curve}, "x", "y", comm=MPI.COMM_SELF)
    assert not (tmp_path / "a.png").exists()


def test_no_curve_is_refused(tmp_path):
    with pytest.raises(InputError, match="no curves"):
        draw_profile(tmp_path / "a.png", {}, "x", "y", comm=MPI.COMM_SELF)

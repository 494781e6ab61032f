"""Pages of reports, in a real browser where the system has one."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import sys
from functools import lru_cache

from mpi4py import MPI

import numpy as np
import pytest
import scenes

from fenics_tfeti import Deformed, InputError
from fenics_tfeti.fem.io.scene import gather_scene
from fenics_tfeti.fem.io.units import units_of
from fenics_tfeti.feti.report.report import without_nan
from fenics_tfeti.io import contact_fields, von_mises

page = pytest.importorskip("fenics_tfeti.fem.io.page")

pytestmark = pytest.mark.once

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
with_browser = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium in the path: apt-get install chromium"
)
PHONE, DESKTOP = (390, 844), (1280, 900)


@lru_cache
def solved(cell: str):
    """Return a solved problem, its displacement and two fields."""
    scene = scenes.two_beams(MPI.COMM_SELF, cell, 2)
    problem = scene.problem(gaps=Deformed())
    uh = problem.solve()
    stress = von_mises(scene.mesh, scenes.stress(uh, scenes.YOUNG), scenes.POISSON)
    return problem, uh, [contact_fields(scene.V, problem.results).pressure, stress]


@pytest.fixture(scope="module")
def written(request, tmp_path_factory):
    """Return the path of a page."""
    problem, uh, fields = solved(request.param)
    path = tmp_path_factory.mktemp("pages") / "page.html"
    problem.report.to_html(path, uh, fields, title="Beams <1 & 2>")
    return path


@pytest.mark.parametrize(("given", "shown"), [(None, ["contact_pressure"]), ([], [])])
def test_field_that_a_problem_shows_first(tmp_path, monkeypatch, given, shown):
    """By default the contact pressure."""
    problem, uh, _ = solved("triangle")
    drawn = []
    monkeypatch.setattr(
        type(problem.report), "to_html", lambda report, *arguments: drawn.append(arguments)
    )
    problem.to_html(tmp_path / "page.html", given)
    ((path, displacement, fields, title),) = drawn
    assert (path.name, displacement, title) == ("page.html", uh, "Contact problem")
    assert [field.name for field in fields] == shown


def test_page_of_what_does_not_press(tmp_path):
    scene = scenes.two_beams(MPI.COMM_SELF, "triangle", 2, gap=1.0)
    scene.traction.value = 0.0 * scene.traction.value
    problem = scene.problem()
    problem.solve()
    problem.to_html(tmp_path / "page.html")
    assert (tmp_path / "page.html").exists()


@pytest.fixture(scope="module")
def browser():
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        launched = playwright.chromium.launch(executable_path=CHROMIUM, args=options)
        yield launched
        launched.close()


def opened(browser, path, size=DESKTOP):
    """Open a page; return it with the errors and requests that it has made."""
    width, height = size
    tab = browser.new_page(viewport={"width": width, "height": height})
    errors, requests = [], []
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.on("console", lambda line: errors.append(line.text) if line.type == "error" else None)
    tab.on("request", lambda request: requests.append(request.url))
    tab.goto(path.as_uri())
    drawn = "[...document.querySelectorAll('.plotly-graph-div')]"
    tab.wait_for_function(f"{drawn}.every((figure) => figure._fullLayout)", timeout=60_000)
    return tab, errors, requests


@with_browser
@pytest.mark.parametrize(
    ("written", "size"), [("hexahedron", DESKTOP), ("triangle", PHONE)], indirect=["written"]
)
def test_page_draws_without_errors_and_without_the_network(browser, written, size):
    tab, errors, requests = opened(browser, written, size)
    assert errors == [] and requests == [written.as_uri()]
    assert tab.title() == tab.text_content("h1") == "Beams <1 & 2>"
    headings = tab.locator("h2").all_text_contents()
    engineers = ["Deformed bodies", "Contact", "Load and supports"]
    solver = ["Solver", "Convergence", "Geometry passes", "Certificate", "Phases"]
    assert [name for name in headings if name != "Motions that are not held"] == engineers + solver
    assert "converged" in tab.text_content(".verdict")
    # no wider than the screen
    assert tab.evaluate("document.documentElement.scrollWidth") <= size[0]
    for name in ("convergence", "passes", "phases"):
        assert tab.locator(f"#{name} .main-svg").count() > 0
    tab.close()


@with_browser
@pytest.mark.parametrize("written", ["hexahedron"], indirect=True)
def test_bodies_can_be_turned_coloured_and_magnified(browser, written):
    tab, errors, _ = opened(browser, written)
    figure = "document.getElementById('bodies')"
    camera = f"{figure}._fullLayout.scene._scene.getCamera().eye"
    before, picture = tab.evaluate(camera), tab.locator("#bodies canvas").first.screenshot()
    box = tab.locator("#bodies").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    tab.mouse.move(*middle)
    tab.mouse.down()
    tab.mouse.move(middle[0] + 120, middle[1] + 60, steps=8)
    tab.mouse.up()
    tab.wait_for_timeout(500)
    turned = tab.evaluate(camera)
    assert turned != pytest.approx(before, rel=0.05)
    assert tab.locator("#bodies canvas").first.screenshot() != picture

    def largest():
        return tab.evaluate(f"Math.max(...Array.from({figure}._fullData[0].intensity))")

    # of the fields that were given the first one is seen first
    assert tab.evaluate(f"{figure}._fullData[0].colorbar.title.text").startswith("contact pressure")
    sizes = []
    for name in ("displacement", "contact pressure", "von mises stress"):
        tab.locator("#bodies .updatemenu-header").click()
        tab.locator("#bodies .updatemenu-item-text", has_text=name).click()
        tab.wait_for_function(f"{figure}._fullData[0].colorbar.title.text.startsWith('{name}')")
        sizes.append(largest())
    assert 0 < sizes[0] < 1 < 1e6 < min(sizes[1:])
    # the load bends the beams downwards, below their undeformed lower face
    lowest = f"Math.min(...Array.from({figure}._fullData[0].z))"
    assert tab.evaluate(lowest) < -0.01
    rail = tab.locator("#bodies .slider-rail-touch-rect")
    rail.click(position={"x": 1, "y": rail.bounding_box()["height"] / 2})
    tab.wait_for_function(f"Math.abs({lowest}) < 1e-6")
    assert tab.text_content("#bodies .slider-label") == "displacements × 0"
    # what was turned and coloured stays
    assert tab.evaluate(camera) == pytest.approx(turned, rel=1e-9)
    assert largest() == sizes[-1]
    assert errors == []
    tab.close()


@pytest.mark.parametrize("written", ["hexahedron", "triangle"], indirect=True)
def test_page_has_the_figures_of_the_report(written):
    text = written.read_text()
    markup = re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)
    assert not re.search(r"\b(src|href)=", markup)
    assert "Beams &lt;1 &amp; 2&gt;" in markup and "<1 & 2>" not in markup
    figures = re.findall(r'<div id="(\w+)" class="plotly-graph-div"', markup)
    assert figures == ["bodies", "convergence", "passes", "phases"]


def test_figures_have_the_data_of_the_report():
    problem, uh, fields = solved("hexahedron")
    scene, report = gather_scene(uh, fields), problem.report.to_dict()
    bodies = page._bodies(scene, units_of("SI"))
    modes = {frame.name: frame.data[0].intensitymode for frame in bodies.frames[:3]}
    assert modes == {
        "displacement": "vertex",
        "contact pressure": "vertex",
        "von mises stress": "cell",
    }
    last = bodies.frames[-1]
    np.testing.assert_allclose(
        np.stack([last.data[0][axis] for axis in "xyz"], axis=1),
        scene.points + 2 * scene.scale * scene.displacement,
        atol=3.0 / 2**13,  # of beams that are 3 m long
    )
    errors = [entry["error"] for entry in report["passes"]]
    assert len(errors) > 1 and list(page._passes(report["passes"]).data[0].y) == errors
    residuals = [face["residual"] for face in report["faces"]]
    assert list(page._convergence(report, units_of("SI")).data[0].y) == residuals


def test_report_that_is_not_converged():
    """Numbers that are not finite have no place in a page, nor zeros on a logarithmic axis."""
    report = solved("triangle")[0].report
    certificate = dataclasses.replace(report.certificate, error=np.inf)
    faces = [dataclasses.replace(report.faces[0], residual=0.0)]
    wrong = dataclasses.replace(
        report, converged=False, reason="a </script> limit", certificate=certificate, faces=faces
    )
    whole = json.loads(json.dumps(without_nan(wrong.to_dict())))
    text = page.report_page(whole, "Open")
    assert 'class="verdict open' in text and "at most not finite" in text
    assert "a &lt;/script&gt; limit" in text
    assert list(page._convergence(whole, units_of("SI")).data[0].y) == [None]
    assert 'id="bodies"' not in text and 'id="convergence"' in text


@pytest.mark.parametrize(("to_check", "kind"), [(("a < b",), "verdict check"), ((), "verdict")])
def test_head_is_amber_where_there_is_something_to_check(to_check, kind):
    """It comes first; green needs a result that has converged, and an empty list."""
    report = dataclasses.replace(solved("triangle")[0].report, to_check=to_check)
    text = page.report_page(without_nan(report.to_dict()), "Beams")
    head = text[text.index("</h1>") :]
    first = "<th>to check</th><td>a &lt; b</td>" if to_check else "<th>result</th>"
    assert head.startswith(f'</h1>\n<div class="{kind} wide"><table><tr>{first}')


def test_wrong_arguments(tmp_path, monkeypatch):
    problem, uh, fields = solved("triangle")
    report = problem.report
    with pytest.raises(InputError, match="pass the displacement"):
        report.to_html(tmp_path / "page.html", None, fields)
    with pytest.raises(InputError, match="a scalar is expected"):
        report.to_html(tmp_path / "page.html", uh, [uh])
    with pytest.raises(OSError, match="the page cannot be written"):
        report.to_html(tmp_path / "missing" / "page.html", uh)
    monkeypatch.setitem(sys.modules, "plotly", None)
    with pytest.raises(ImportError, match="pip install plotly"):
        report.to_html(tmp_path / "page.html")
    assert list(tmp_path.iterdir()) == []


def test_all_faces_have_a_normal():
    """By default Plotly leaves those out that are small beside the bodies, and shades them pale."""
    problem, uh, _ = solved("hexahedron")
    lighting = page._bodies(gather_scene(uh), units_of("SI")).data[0].lighting
    assert lighting.facenormalsepsilon == lighting.vertexnormalsepsilon == 0
